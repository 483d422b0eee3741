"""``tactile fidelity``: compare our engine with recorded outcomes of the authors' simulator."""

from __future__ import annotations

import argparse
import json
import math
import multiprocessing
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table

from reachd.strategies.parameters import parameters
from sim_device.world.engines import make_world
from sim_device.world.recorded_scenes import load_outcomes, load_recorded
from sim_device.world.scene_loading import (
    RECORDED_SCENES,
    find_recorded,
)
from sim_device.world.scenes import Pose, Scene, SceneError
from tactile_tools.reach.lockstep import run_trial

STRATEGIES = ("straight", "burrow", "excavate", "hybrid_clock", "hybrid_event")
REFERENCE_RATES = {
    # Success at 1 mm and its 95 % interval over seeds 1–88 of the authors' simulator.
    "straight": (0.33, 0.24, 0.43),
    "burrow": (0.59, 0.49, 0.69),
    "excavate": (0.40, 0.30, 0.50),
    "hybrid_clock": (0.51, 0.41, 0.61),
    "hybrid_event": (0.63, 0.52, 0.72),
}
REFERENCE_NAMES = {"clock": "hybrid_clock", "event": "hybrid_event"}
"""Names of our strategies in the recorded outcomes, where they differ."""

PERTURBATION_M = 1e-4
"""Standard deviation of a perturbed start across the cupboard: too small to matter to a user."""


@dataclass(frozen=True, slots=True)
class Trial:
    """One trial: scene, strategy, and how it was perturbed (0: not at all).

    ``peak_load``, ``mean_load``: summed normal forces on the finger, N. ``simulated_s``, ``cpu_s``:
    its length, and what it took.
    """

    seed: int
    strategy: str
    perturbed: int
    success: bool
    entered: bool
    distance: float
    time: float
    excavations: int
    ejected: int
    peak_load: float
    mean_load: float
    simulated_s: float
    cpu_s: float


def run(options: argparse.Namespace) -> int:
    """Run, print and write the comparison. Returns 0 if all of it ran, 3 if data are missing."""
    console = Console()
    try:
        file = options.recorded or find_recorded(RECORDED_SCENES)
        scenes = load_recorded(file)[: options.limit]
        outcomes = load_outcomes(options.outcomes or outcomes_of(file))
    except (SceneError, OSError) as error:
        print(f"tactile fidelity: {error}", file=sys.stderr)
        return 3
    reference = {(o.seed, REFERENCE_NAMES.get(o.strategy, o.strategy)): o for o in outcomes}
    tasks = [
        (scene, strategy, repeat)
        for scene in scenes
        for strategy in STRATEGIES
        for repeat in range(options.repeats + 1)
    ]
    work = partial(_trial, engine=options.engine, depth=options.depth)
    with multiprocessing.get_context("spawn").Pool(options.jobs) as pool:
        trials = list(
            track(pool.imap(work, tasks), total=len(tasks), description="trials", console=console)
        )
    summary = {
        strategy: summarise(
            [t for t in trials if t.strategy == strategy],
            {seed: o.success for (seed, name), o in reference.items() if name == strategy},
        )
        for strategy in STRATEGIES
    }
    console.print(_table(summary, len(scenes)))
    if options.out is not None:
        report = {
            "engine": options.engine,
            "depth": options.depth,
            "scenes": len(scenes),
            "perturbation_m": PERTURBATION_M,
            # What was not measured is left out: JSON has no NaN.
            "summary": {
                name: {key: value for key, value in row.items() if not math.isnan(value)}
                for name, row in summary.items()
            },
            "trials": [asdict(t) for t in trials],
        }
        options.out.write_text(json.dumps(report) + "\n", encoding="utf-8")
        console.print(f"wrote {options.out}")
    return 0


def outcomes_of(scenes: Path) -> Path:
    """Outcomes beside a file of scenes: outcomes_1_60.csv for scenes_1_60.json.gz."""
    name = scenes.name.removesuffix(".gz").removesuffix(".json")
    return scenes.with_name(name.replace("scenes", "outcomes", 1) + ".csv")


def _trial(task: tuple[Scene, str, int], engine: str, depth: str) -> Trial:
    scene, strategy, repeat = task
    return run_one(scene, strategy, engine, depth, repeat)


def run_one(scene: Scene, strategy: str, engine: str, depth: str, perturbed: int = 0) -> Trial:
    """Run one trial, the start moved across the cupboard unless ``perturbed`` is 0.

    By `PERTURBATION_M` times a normal number that ``perturbed`` and the scene determine.
    """
    if perturbed:
        rng = np.random.default_rng([scene.seed, perturbed])
        start = scene.start
        moved = Pose(start.x, start.y + PERTURBATION_M * rng.standard_normal(), start.heading)
        scene = replace(scene, start=moved)
    began = time.process_time()
    result = run_trial(
        scene,
        strategy,
        parameters(scene.parameters),
        scene.seed,
        depth="taxels" if depth == "taxels" else "contacts",
        world=make_world(engine, scene),
    )
    o = result.outcome
    return Trial(
        seed=scene.seed,
        strategy=strategy,
        perturbed=perturbed,
        success=o.success,
        entered=result.entered,
        distance=o.distance,
        time=o.time,
        excavations=len(o.excavations),
        ejected=result.ejected,
        peak_load=round(result.peak_load, 3),
        mean_load=round(result.mean_load, 3),
        simulated_s=round(result.simulated_s, 3),
        cpu_s=round(time.process_time() - began, 4),
    )


def summarise(trials: Sequence[Trial], reference: dict[int, bool]) -> dict[str, float]:
    """Success rates, agreement with the reference, and agreement among our own repeated runs."""
    plain = {t.seed: t.success for t in trials if t.perturbed == 0}
    same = [plain[seed] == success for seed, success in reference.items() if seed in plain]
    repeats: dict[int, list[bool]] = {}
    for t in trials:
        repeats.setdefault(t.seed, []).append(t.success)
    own = [
        a == b
        for outcomes in repeats.values()
        for i, a in enumerate(outcomes)
        for b in outcomes[i + 1 :]
    ]
    of_reference = [success for seed, success in reference.items() if seed in plain]
    return {
        "success": float(np.mean(list(plain.values()))),
        "entered": float(np.mean([t.entered for t in trials if t.perturbed == 0])),
        "success_all_repeats": float(np.mean([t.success for t in trials])),
        "reference_success": float(np.mean(of_reference)) if of_reference else float("nan"),
        "agreement": float(np.mean(same)) if same else float("nan"),
        "own_agreement": float(np.mean(own)) if own else float("nan"),
        "ejected": float(np.mean([t.ejected for t in trials])),
    }


def _table(summary: dict[str, dict[str, float]], scenes: int) -> Table:
    table = Table(title=f"{scenes} recorded scenes: success within 1 mm, and agreement")
    for name in ("strategy", "ours", "reference", "95 % of 88", "in 7.5 mm", "agree", "ceiling"):
        table.add_column(name, justify="left" if name == "strategy" else "right")
    for strategy, row in summary.items():
        _, low, high = REFERENCE_RATES[strategy]
        inside = low <= row["success_all_repeats"] <= high
        table.add_row(
            strategy,
            f"[{'green' if inside else 'red'}]{row['success_all_repeats']:.0%}[/]",
            f"{row['reference_success']:.0%}",
            f"{low:.0%}–{high:.0%}",
            f"{row['entered']:.0%}",
            f"{row['agreement']:.0%}",
            "–" if math.isnan(row["own_agreement"]) else f"{row['own_agreement']:.0%}",
        )
    return table
