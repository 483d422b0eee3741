"""``tactile crosscheck``: one engine beside another, trial by trial on the same scenes."""

from __future__ import annotations

import argparse
import json
import multiprocessing
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from functools import partial
from typing import Any, Final, Literal

import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table

from sim_device.world.engines import world_maker
from sim_device.world.scene_loading import load_scene
from sim_device.world.scenes import SceneError
from tactile_core.cli import CommandError
from tactile_tools.dev.fidelity import PERTURBATION_M, STRATEGIES, Trial, run_one

Run = Literal["engine", "beside", "moved"]
"""The engine that is judged; the other; the other with the start moved."""

RUNS: Final[tuple[Run, ...]] = ("engine", "beside", "moved")

Rows = dict[Run, list[Trial]]
"""Trials of the same scenes and strategies, in the same order."""


def run(options: argparse.Namespace) -> int:
    """Run, print and write the comparison; 0 when all of it ran."""
    for engine in (options.engine, options.beside):
        world_maker(engine)  # says here, once, what is not installed
    try:
        load_scene(options.scene, options.from_seed)
    except (SceneError, ValueError) as error:
        raise CommandError(str(error)) from None
    console = Console()
    strategies = tuple(dict.fromkeys(options.strategy or STRATEGIES))
    work = partial(
        _scene,
        name=options.scene,
        strategies=strategies,
        engines=(options.engine, options.beside),
        depth=options.depth,
    )
    seeds = range(options.from_seed, options.from_seed + options.scenes)
    rows: Rows = {"engine": [], "beside": [], "moved": []}
    done = 0
    with multiprocessing.get_context("spawn").Pool(options.jobs) as pool:
        found: Iterator[Rows] = pool.imap(work, seeds)
        try:
            for one in track(found, total=len(seeds), description="scenes", console=console):
                for which in RUNS:
                    rows[which] += one[which]
                done += 1
        except KeyboardInterrupt:
            pool.terminate()
    if not done:
        raise CommandError("no scene was finished", code=1)
    summary = summarise(rows, strategies)
    names: dict[Run, str] = {
        "engine": options.engine,
        "beside": options.beside,
        "moved": f"{options.beside}, moved",
    }
    console.print(_table(summary, names, done))
    console.print(_costs(rows, names))
    if options.out is not None:
        report = {
            "engine": options.engine,
            "beside": options.beside,
            "depth": options.depth,
            "scene": options.scene,
            "seeds": [seeds[0], seeds[done - 1]],
            "perturbation_m": PERTURBATION_M,
            "summary": summary,
            "loads": {which: loads(rows[which]) for which in RUNS},
            "simulated_s_per_cpu_s": {which: speed(rows[which]) for which in RUNS},
            "trials": {which: [asdict(t) for t in rows[which]] for which in RUNS},
        }
        options.out.write_text(json.dumps(report) + "\n", encoding="utf-8")
        console.print(f"wrote {options.out}")
    return 0


def _scene(
    seed: int, name: str, strategies: Sequence[str], engines: tuple[str, str], depth: str
) -> Rows:
    """All trials of one scene."""
    scene = load_scene(name, seed)
    engine, beside = engines
    return {
        "engine": [run_one(scene, strategy, engine, depth) for strategy in strategies],
        "beside": [run_one(scene, strategy, beside, depth) for strategy in strategies],
        "moved": [run_one(scene, strategy, beside, depth, 1) for strategy in strategies],
    }


def summarise(rows: Rows, strategies: Sequence[str]) -> dict[str, dict[str, float]]:
    """By strategy and for ``all``: success in each run, and how often outcomes agree.

    ``won``, ``lost``: trials in which the engine alone succeeded, or the other alone. ``ceiling``:
    agreement of the other engine with itself when starts move.
    """
    summary: dict[str, dict[str, float]] = {}
    for name in (*strategies, "all"):
        mine, other, moved = (
            np.array([t.success for t in rows[which] if name in (t.strategy, "all")])
            for which in RUNS
        )
        summary[name] = {
            "trials": len(mine),
            "success": float(mine.mean()),
            "success_beside": float(other.mean()),
            "success_moved": float(moved.mean()),
            "agreement": float((mine == other).mean()),
            "agreement_moved": float((mine == moved).mean()),
            "ceiling": float((other == moved).mean()),
            "won": int((mine & ~other).sum()),
            "lost": int((~mine & other).sum()),
        }
    return summary


def loads(trials: Sequence[Trial]) -> dict[str, float]:
    """Summed normal forces on the finger, N: of the trials' peaks and of their means."""
    peaks = np.array([t.peak_load for t in trials])
    means = np.array([t.mean_load for t in trials])
    return {
        "peak_median_n": float(np.median(peaks)),
        "peak_p90_n": float(np.percentile(peaks, 90)),
        "mean_median_n": float(np.median(means)),
        "mean_p90_n": float(np.percentile(means, 90)),
        "ejected": float(np.mean([t.ejected for t in trials])),
        "time_s": float(np.mean([t.time for t in trials])),
    }


def speed(trials: Sequence[Trial]) -> float:
    """Simulated s a CPU-second, building the world included."""
    return sum(t.simulated_s for t in trials) / max(1e-9, sum(t.cpu_s for t in trials))


def _table(summary: dict[str, dict[str, float]], names: dict[Run, str], scenes: int) -> Table:
    table = Table(title=f"{scenes} scenes: success, and outcomes alike")
    table.add_column("strategy")
    for heading in (*names.values(), "alike", "ceiling", "won : lost"):
        table.add_column(heading, justify="right")
    for strategy, row in summary.items():
        table.add_row(
            strategy,
            f"{row['success']:.0%}",
            f"{row['success_beside']:.0%}",
            f"{row['success_moved']:.0%}",
            f"{row['agreement']:.1%}",
            f"{row['ceiling']:.1%}",
            f"{row['won']:.0f} : {row['lost']:.0f}",
        )
    return table


def _costs(rows: Rows, names: dict[Run, str]) -> Table:
    table = Table(title="summed normal force on the finger, and speed")
    table.add_column("run")
    for heading in ("peak, median N", "p90", "mean, median N", "p90", "simulated s a CPU-s"):
        table.add_column(heading, justify="right")
    for which in RUNS:
        found: dict[str, Any] = loads(rows[which])
        table.add_row(
            names[which],
            f"{found['peak_median_n']:.1f}",
            f"{found['peak_p90_n']:.1f}",
            f"{found['mean_median_n']:.2f}",
            f"{found['mean_p90_n']:.2f}",
            f"{speed(rows[which]):.0f}",
        )
    return table
