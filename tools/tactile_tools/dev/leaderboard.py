"""Write ``docs/leaderboard.md`` from the entries in ``docs/results/benchmark``."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from tactile_tools.experiments.benchmark import (
    FIRST_SEED,
    LAST_SEED,
    SCENE_SETS,
    EntryError,
    read_entry,
)
from tactile_tools.experiments.document import percent
from tactile_tools.experiments.statistics import Rate

Case = tuple[str, str, str, float]
"""Scene set, engine, depth, time limit in s."""

RANKING: Case = ("squeezed", "mujoco", "contacts", 20.0)
"""The case by which entries are ordered."""

SHOWN: Mapping[Case, str] = {
    RANKING: "squeezed, 20 s",
    ("squeezed", "mujoco", "contacts", 40.0): "squeezed, 40 s",
    ("dense", "mujoco", "contacts", 20.0): "dense, 20 s",
    ("high_friction", "mujoco", "contacts", 20.0): "high friction, 20 s",
    ("narrow", "mujoco", "contacts", 20.0): "narrow, 20 s",
    ("recorded", "mujoco", "contacts", 20.0): "recorded, 20 s",
    ("recorded", "pybullet", "contacts", 20.0): "recorded in Bullet, 20 s",
    ("hardware", "mujoco", "contacts", 40.0): "hardware, 40 s",
    ("squeezed", "pymunk", "contacts", 20.0): "pymunk, 20 s",
    ("squeezed", "mujoco", "taxels", 20.0): "taxels, 20 s",
}
"""Cases of the first table and their headings."""

LEAD = """\
# Leaderboard

Reaching strategies on the fixed scenes of `tactile benchmark`, ordered by success in squeezed
scenes within 20 s. Success with Wilson's 95 % interval and the number of scenes; "–": not run.
Where intervals overlap, the order says little.
"""

RULES = f"""\
## Enter your strategy

```sh
tactile benchmark my_strategies:Wiggle --name "Wiggle, Some Lab" --entry wiggle.json \\
    --note "URL of the code; tuned on …"
```

Without `--sets`, `--engine`, `--depth` and `--time-limit` it runs everything: about two hours of
CPU time for a light strategy. A run that was stopped goes on where it was. Several commands may
write the same `--entry`: it grows by their cases. Send the JSON as a pull request that adds it to
`docs/results/benchmark/`; `make leaderboard` writes this page anew.

1. **Tune on scenes of your own.** Seeds {FIRST_SEED} to {LAST_SEED} and the 60 recorded scenes are
   for judging alone. Every other seed is free, for example with
   `tactile experiment strategies --scene-seed {LAST_SEED + 1}`.
2. **Judge once.** Run the final version on all 100 scenes of a set. If you look at the result and
   then change the strategy, say in the note how often.
3. **Touch and arm only.** A strategy sees what `step` is given ([strategies](strategies.md)). One
   that is told where the objects are (`privileged = True`, see [the ceiling](ceiling.md)) is
   welcome, too: `tactile benchmark` wants "privileged" in its name.
4. **Report** in the note where the code is, and what it was tuned or trained on and how much that
   took (scenes, CPU or GPU hours). `--param` records what differs from a parameter set.
5. **Repeatable.** Whoever runs the command of an entry with its version gets the same rows,
   whatever the number of processes. Chance comes from the generator that a strategy is given.

## Scene sets
"""


def page(entries: Sequence[Mapping[str, Any]]) -> str:
    """The page, as Markdown."""
    ranked = sorted(entries, key=_rank)
    parts = [LEAD, _table(_success(ranked)), "", "## Time, force and cost", ""]
    parts += [
        "In squeezed scenes within 20 s, MuJoCo, exact contacts: mean time (20 s where it did not "
        "arrive), greatest force of one contact and greatest sum of normal forces (median of "
        "trials, 90th percentile), objects pushed out of the cupboard in a trial, and CPU time of "
        "a trial, physics included.",
        "",
        _table(_cost(ranked)),
        "",
        "## Entries",
        "",
        *_entries(ranked),
        RULES,
    ]
    parts += [f"- **{name}**: {scenes.meaning}." for name, scenes in SCENE_SETS.items()]
    return "\n".join(parts) + "\n"


def _cases(entry: Mapping[str, Any]) -> dict[Case, Mapping[str, Any]]:
    return {(c["set"], c["engine"], c["depth"], c["limit_s"]): c for c in entry["cases"]}


def _rank(entry: Mapping[str, Any]) -> tuple[float, str]:
    found = _cases(entry).get(RANKING, {}).get("success")
    return (-found[0] / found[1] if found else 1.0, entry["name"])


def _success(entries: Sequence[Mapping[str, Any]]) -> list[list[str]]:
    rows = [["strategy", *SHOWN.values()]]
    for entry in entries:
        cases = _cases(entry)
        cells = []
        for key in SHOWN:
            found = cases.get(key, {}).get("success")
            if not found:
                cells.append("–")
                continue
            cells.append(f"{percent(Rate(found[0], found[1]))} of {found[1]}")
        rows.append([entry["name"], *cells])
    return rows


def _cost(entries: Sequence[Mapping[str, Any]]) -> list[list[str]]:
    rows = [["strategy", "time", "one contact", "sum", "pushed out", "CPU"]]
    for entry in entries:
        case = _cases(entry).get(RANKING)
        if case is None or "success" not in case:
            continue
        contact, load = case["peak_contact_n"], case["peak_load_n"]
        rows.append(
            [
                entry["name"],
                f"{case['time_s']['mean']:.1f} s",
                f"{contact['median']:.1f} N, {contact['p90']:.1f}",
                f"{load['median']:.1f} N, {load['p90']:.1f}",
                f"{case['ejected_per_trial']:.3f}",
                f"{case['cpu_s_per_trial']:.2f} s",
            ]
        )
    return rows


def _entries(entries: Sequence[Mapping[str, Any]]) -> list[str]:
    lines = []
    for entry in entries:
        changed = ", ".join(f"`{k} = {v}`" for k, v in entry["parameters"].items())
        lines += [
            f"**{entry['name']}** (`{entry['strategy']}`"
            + (f", {changed}" if changed else "")
            + f"). {entry['note']}".rstrip(),
            "",
            "```sh",
            *entry["commands"],
            "```",
            "",
        ]
    return lines


def _table(rows: Sequence[Sequence[str]]) -> str:
    head, *body = rows
    lines = [head, ["---"] * len(head), *body]
    return "\n".join("| " + " | ".join(_escaped(c) for c in line) + " |" for line in lines)


def _escaped(text: str) -> str:
    return text.replace("|", "\\|")


def main(argv: Sequence[str] | None = None) -> int:
    """Write the page, or say with 1 that it is out of date; 2 for a file that is not an entry."""
    parser = argparse.ArgumentParser(prog="leaderboard", description=__doc__)
    parser.add_argument("folder", type=Path, help="docs/results/benchmark")
    parser.add_argument("page", type=Path, help="docs/leaderboard.md")
    parser.add_argument("--check", action="store_true", help="write nothing; end with 1 if stale")
    options = parser.parse_args(argv)
    try:
        entries = [read_entry(path) for path in sorted(options.folder.glob("*.json"))]
    except EntryError as error:
        print(f"leaderboard: {error}", file=sys.stderr)
        return 2
    text = page(entries)
    if options.check:
        if options.page.is_file() and options.page.read_text(encoding="utf-8") == text:
            return 0
        print(f"{options.page} is out of date: run make leaderboard", file=sys.stderr)
        return 1
    options.page.write_text(text, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
