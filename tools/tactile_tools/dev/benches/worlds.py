"""The planar engine: single reaches in lockstep, and many cupboards at once."""

from __future__ import annotations

import time

import numpy as np

from reachd.strategies.parameters import parameters
from sim_device.world.engines import make_world
from sim_device.world.scene_generation import generate
from tactile_core.cli import require
from tactile_tools.dev.benches.reach import SCENES, STRATEGY
from tactile_tools.reach.lockstep import Depth, run_trial

REPEATS = 5
"""Runs of each trial, of which the fastest counts: the others shared the processor's caches."""

BATCH = 256
"""Worlds of the batch, on all cores."""


def bench_worlds(*, quick: bool = False) -> dict[str, float]:
    """Return ``planar_rtf_contacts``, ``planar_rtf_taxels`` and ``worlds_rtf``.

    Simulated s a CPU-second of whole trials in the planar engine, with 25 objects and the scene at
    hand; beside them those in MuJoCo, taken in turn. ``worlds_rtf``: simulated s a CPU-second of
    `BATCH` worlds stepped together, every finger going straight for its goal, features read each
    10 ms; ``worlds_sim_s_per_s`` the same by the clock on the wall, on all cores. ``physics_us``:
    of a 10 ms step of one world within the batch.
    """
    require("numba", extra="train", what="the group worlds")
    figures: dict[str, float] = {}
    repeats = 2 if quick else REPEATS
    runs: tuple[tuple[str, Depth], ...] = (
        ("planar", "contacts"),
        ("mujoco", "contacts"),
        ("planar", "taxels"),
        ("mujoco", "taxels"),
    )
    best: dict[tuple[str, Depth, int], float] = {}
    simulated: dict[tuple[str, Depth, int], float] = {}
    scenes = {seed: generate("authors_sim", seed) for seed in (SCENES[:1] if quick else SCENES)}
    for repeat in range(repeats + 1):
        for seed, scene in scenes.items():
            for engine, depth in runs:
                world = make_world(engine, scene)
                began = time.thread_time()
                result = run_trial(
                    scene, STRATEGY, parameters(scene.parameters), seed, depth=depth, world=world
                )
                spent = time.thread_time() - began
                key = (engine, depth, seed)
                simulated[key] = result.simulated_s
                if repeat:  # the first imports and compiles
                    best[key] = min(best.get(key, np.inf), spent)
    for engine, depth in runs:
        keys = [(engine, depth, seed) for seed in scenes]
        name = f"{engine}_rtf_{depth}"
        figures[name] = sum(simulated[k] for k in keys) / sum(best[k] for k in keys)
    return figures | _batch(quick=quick)


def _batch(*, quick: bool) -> dict[str, float]:
    from sim_device.world.planar_worlds import Worlds

    distinct = [generate("authors_sim", seed) for seed in range(2 if quick else 16)]
    scenes = [distinct[index % len(distinct)] for index in range(BATCH)]
    v_max = parameters(scenes[0].parameters).v_max
    goal = np.array([scene.goal for scene in scenes])
    cycles = 100 if quick else 1000
    with Worlds(scenes) as worlds:
        worlds.step(0.01, np.zeros((BATCH, 3)))  # compiles
        wall, cpu = time.perf_counter(), time.process_time()
        physics = 0.0
        for _ in range(cycles):
            finger = worlds.finger
            away = goal - finger[:, :2]
            away[:, 0] -= 0.158
            length = np.maximum(np.hypot(away[:, 0], away[:, 1]), 1e-9)
            twists = np.zeros((BATCH, 3))
            twists[:, :2] = away * (v_max / np.maximum(length, v_max))[:, np.newaxis]
            began = time.process_time()
            worlds.step(0.01, twists)
            physics += time.process_time() - began
            worlds.features()
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
        if worlds.failed.any():
            raise RuntimeError(f"{worlds.failed.sum()} of {BATCH} worlds failed")
    simulated = BATCH * cycles * 0.01
    return {
        "worlds_rtf": simulated / cpu,
        "worlds_sim_s_per_s": simulated / wall,
        "worlds_physics_us": physics / BATCH / cycles * 1e6,
    }
