"""Judge ``quick_sweep``, and each of its parts by leaving it out: docs/results/quick_sweep.json.

Judged once, beside hybrid_event, on scenes 700000 on; parts are compared on scenes 710000 on, which
are also those it was tuned on. Stopped or killed, the same command goes on where it was.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any

from tactile_core.cli import count
from tactile_tools.experiments.backends import Processes
from tactile_tools.experiments.benchmark import FIRST_SEED, summary_of
from tactile_tools.experiments.journal import read_lines
from tactile_tools.experiments.rows import Row, replace_file
from tactile_tools.experiments.runner import run_study
from tactile_tools.experiments.spec import TrialSpec, canonical, spec_of
from tactile_tools.experiments.statistics import paired_rates
from tactile_tools.experiments.studies import Study

TUNING_SEED = 710_000


@dataclass(frozen=True, slots=True)
class Variant:
    """A strategy with what differs from its set: what is left out or changed, in words."""

    meaning: str
    strategy: str = "quick_sweep"
    parameters: Mapping[str, float] = field(default_factory=lambda: MappingProxyType({}))


JUDGED = (Variant("quick_sweep"), Variant("hybrid_event", "hybrid_event"))

PARTS = (
    Variant("as it is"),
    Variant("no sweep: straight", "straight"),
    Variant("sweep to a random side", parameters={"sweep_obedience": 0.5}),
    Variant("sweep towards the contact", parameters={"sweep_obedience": 0.0}),
    Variant("sweep of 1.2 s instead of 0.6", parameters={"sweep_time": 1.2}),
    Variant("jam answered after 1 s instead of 0.3", parameters={"jam_time": 1.0}),
    Variant("no turn during a sweep", parameters={"sweep_omega": 0.0}),
    Variant("sweep at 55° instead of 90°", parameters={"sweep_angle": round(math.radians(55), 6)}),
)


def specs_of(variant: Variant, first: int, scenes: int) -> list[TrialSpec]:
    """Trials of ``variant`` in authors_sim, MuJoCo, exact contacts, 20 s."""
    return [
        TrialSpec(
            source="authors_sim",
            scene_seed=seed,
            set="authors_sim",
            engine="mujoco",
            depth="contacts",
            strategy=variant.strategy,
            trial_seed=seed,
            parameters=canonical(variant.parameters),
        )
        for seed in range(first, first + scenes)
    ]


def results(rows: Mapping[TrialSpec, Row], scenes: int, part_scenes: int) -> dict[str, Any]:
    """What the rows that are there say, as JSON values."""
    return {
        "judged": _compared(rows, JUDGED, FIRST_SEED, scenes),
        "parts": _compared(rows, PARTS, TUNING_SEED, part_scenes),
    }


def _compared(
    rows: Mapping[TrialSpec, Row], variants: Sequence[Variant], first: int, scenes: int
) -> list[dict[str, Any]]:
    """Each variant, and in the scenes it shares with the first one how often only one arrived."""
    wholes: dict[int, bool] = {}
    out = []
    for number, variant in enumerate(variants):
        found = [rows[s] for s in specs_of(variant, first, scenes) if s in rows]
        if not found:
            continue
        arrived = {r["scene_seed"]: r["success"] for r in found if r["error"] is None}
        entry: dict[str, Any] = {"variant": variant.meaning, "strategy": variant.strategy}
        entry |= {"parameters": dict(variant.parameters)} | summary_of(found)
        if number == 0:
            wholes = arrived
        else:
            shared = sorted(arrived.keys() & wholes.keys())
            paired = paired_rates([arrived[s] for s in shared], [wholes[s] for s in shared])
            entry["beside_the_first"] = {
                "scenes": paired.scenes,
                "only_this_arrives": paired.only_a,
                "only_the_first_arrives": paired.only_b,
                "p": float(f"{paired.p:.3g}"),
            }
        out.append(entry)
    return out


def main(argv: Sequence[str] | None = None) -> int:
    """Run what is missing and write the file; 1 where a trial could not be run."""
    parser = argparse.ArgumentParser(prog="tactile_tools.dev.quick_sweep", description=__doc__)
    parser.add_argument("--scenes", type=count, default=200, help="judged (default 200)")
    parser.add_argument("--part-scenes", type=count, default=60, help="of each part (default 60)")
    parser.add_argument("--jobs", type=count, default=2, help="processes (default 2)")
    parser.add_argument("--out", type=Path, default=Path("runs/quick_sweep"), help="folder")
    parser.add_argument("--json", type=Path, default=Path("docs/results/quick_sweep.json"))
    options = parser.parse_args(argv)
    specs = [
        spec
        for variants, first, scenes in (
            (JUDGED, FIRST_SEED, options.scenes),
            (PARTS, TUNING_SEED, options.part_scenes),
        )
        for several in zip(*(specs_of(v, first, scenes) for v in variants), strict=True)
        for spec in several
    ]
    study = Study({"study": "quick_sweep"}, tuple(specs))

    def told(finished: int, total: int, row: Row | None) -> None:
        if row is None or finished % 20 == 0:
            print(f"{finished} of {total} trials", flush=True)

    summary = run_study(study, options.out, Processes(options.jobs), told)
    rows = {spec_of(row): row for row in read_lines(options.out).values()}
    text = {
        "what": "quick_sweep judged beside hybrid_event, and its parts; authors_sim, MuJoCo, "
        "exact contacts, 20 s, 1 mm; rates are [count, trials, low, high], Wilson's 95 %",
        "command": "python -m tactile_tools.dev.quick_sweep "
        f"--scenes {options.scenes} --part-scenes {options.part_scenes}",
        "versions": summary["versions_of_rows"],
        **results(rows, options.scenes, options.part_scenes),
    }
    replace_file(options.json, (json.dumps(text, indent=1, ensure_ascii=False) + "\n").encode())
    print(f"wrote {options.json}")
    return 1 if summary["errors"] else 0


if __name__ == "__main__":
    sys.exit(main())
