"""Run one trial from its specification to its row. The same specification gives the same row."""

from __future__ import annotations

import os
import socket
import subprocess
import time
from collections import Counter
from collections.abc import Callable, Sequence
from functools import cache
from importlib.metadata import version
from pathlib import Path

import psutil

from sim_device.world.scenes import Scene
from tactile_tools.experiments.conditions import parameters_of, scene_of, sense_of, world_of
from tactile_tools.experiments.rows import DIRECTIONS, NAMES, TRIGGERS, Row
from tactile_tools.experiments.spec import IDENTITY, TrialSpec, canonical
from tactile_tools.reach.lockstep import Result, Step, run_trial

_run_here: Counter[str] = Counter()
"""Trials run in this process, by worker: needed to see memory grow with their number."""


def run_one(
    spec: TrialSpec,
    watch: Callable[[Step], None] | None = None,
    done: Callable[[Result], None] | None = None,
) -> Row:
    """Run ``spec`` and return its row. Errors of the trial are in the column ``error``.

    ``watch``: called once per control cycle. ``done``: called with the result.
    """
    began_wall, began = time.perf_counter(), time.thread_time()
    row: Row = dict.fromkeys(NAMES)
    row.update({name: getattr(spec, name) for name in IDENTITY})
    row["scene_cpu_s"] = 0.0
    try:
        scene = scene_of(spec)
        row["scene_cpu_s"] = round(time.thread_time() - began, 4)
        began = time.thread_time()
        result = run_trial(
            scene,
            spec.strategy,
            parameters_of(spec),
            spec.trial_seed,
            depth=spec.typed_depth,
            world=world_of(spec, scene),
            sense=sense_of(spec, scene),
            watch=watch,
        )
        row.update(_outcome(scene, spec, result))
        if done is not None:
            done(result)
    except Exception as error:  # noqa: BLE001 - boundary of a trial: the others must go on
        row["error"] = f"{type(error).__name__}: {error}"
    row.update(_provenance(time.perf_counter() - began_wall, time.thread_time() - began))
    return row


def run_batch(specs: Sequence[TrialSpec]) -> list[Row]:
    """Rows of ``specs``, for workers that answer once for several."""
    return [run_one(spec) for spec in specs]


def lost_row(spec: TrialSpec, why: str) -> Row:
    """Row of a trial whose worker died; it holds only ``why``."""
    row: Row = dict.fromkeys(NAMES)
    row.update({name: getattr(spec, name) for name in IDENTITY})
    row["error"] = why
    row["version"] = software_version()
    return row


def _outcome(scene: Scene, spec: TrialSpec, result: Result) -> Row:
    """Result of a trial, by column."""
    o = result.outcome
    limit = spec.resolved().time_limit
    counts = Counter(
        (e.direction, e.trigger if e.trigger in TRIGGERS else "other") for e in o.excavations
    )
    return {
        "objects": len(scene.objects),
        "fill": scene.fill,
        "success": o.success,
        "reason": str(o.reason),
        "entered": result.entered,
        "distance_m": o.distance,
        "closest_m": o.closest,
        "normalized_distance": o.distance / scene.depth,
        "normalized_closest": o.closest / scene.depth,
        # A reach that did not arrive took all its time, even if the gate ended it sooner.
        "time_s": o.time if o.success else limit,
        "time_limit_s": limit,
        "normalized_time": o.time / limit if o.success else 1.0,
        "excavations": len(o.excavations),
        **{
            f"excavations_{direction}_{trigger}": counts[direction, trigger]
            for direction in DIRECTIONS
            for trigger in TRIGGERS
        },
        "peak_contact_n": o.peak_force,
        "peak_load_n": result.peak_load,
        "mean_load_n": result.mean_load,
        "peak_arm_n": o.peak_load,
        "ejected": result.ejected,
        "interventions": sum(o.interventions.values()),
        "interventions_by_code": canonical({str(k): v for k, v in o.interventions.items()}),
        "simulated_s": round(result.simulated_s, 6),
    }


def _provenance(wall: float, cpu: float) -> Row:
    """Worker, version and cost of the trial, by column."""
    worker = f"{socket.gethostname()}:{os.getpid()}"
    _run_here[worker] += 1
    return {
        "version": software_version(),
        "wall_s": round(wall, 4),
        "cpu_s": round(cpu, 4),
        "memory_mb": round(psutil.Process().memory_info().rss / 1e6, 2),
        "worker": worker,
        "worker_trials": _run_here[worker],
    }


@cache
def software_version() -> str:
    """Version of the package; in a checkout also its commit, with "+" if files were changed."""
    name = version("tactile-reach")
    here = Path(__file__)
    try:
        _git(here.parent, "ls-files", "--error-unmatch", here.name)
        commit = _git(here.parent, "rev-parse", "--short=10", "HEAD")
        changed = _git(here.parent, "status", "--porcelain", "--untracked-files=no")
    except (OSError, subprocess.SubprocessError):
        return name
    return f"{name} {commit}{'+' if changed else ''}"


def _git(directory: Path, *words: str) -> str:
    """Output of git; SubprocessError outside a checkout."""
    done = subprocess.run(
        ["git", *words], cwd=directory, capture_output=True, text=True, check=True, timeout=10
    )
    return done.stdout.strip()
