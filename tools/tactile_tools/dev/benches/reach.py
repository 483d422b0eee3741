"""Reaches: speed in lockstep, and punctuality in real time."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from reachd.strategies.parameters import parameters
from sim_device.world.engines import Engine, make_world
from sim_device.world.scene_generation import generate
from tactile_core.bus.topics import COMMAND, FEATURES, REACH_STATE
from tactile_core.types import NS_PER_S
from tactile_tools.reach.lockstep import Depth, run_trial
from tactile_tools.reach.process_rig import LiveReach

SCENES = (0, 1, 19)
"""Scenes of ``authors_sim`` that have 25 objects."""

OBJECTS = 25
STRATEGY = "hybrid_event"
"""The most expensive of the strategies: it is in contact most of the time."""


def bench_reach_speed(*, quick: bool = False) -> dict[str, float]:
    """Return ``reach_rtf_contacts`` and ``reach_rtf_taxels``: simulated seconds per CPU-second.

    Whole trials of 25 objects: building the world, starting the board, physics, sensing at 25 Hz
    with every byte, strategy, safety gate and arm. Processor time of all threads of this process
    counts. Depths and scenes alternate; the worst scene is given as well.
    """
    rates: dict[Depth, list[float]] = {"contacts": [], "taxels": []}
    totals: dict[Depth, list[float]] = {"contacts": [0.0, 0.0], "taxels": [0.0, 0.0]}
    _trial(5, "taxels")  # imports, caches
    for seed in SCENES[:1] if quick else SCENES:
        for depth in rates:
            simulated, spent = _trial(seed, depth)
            rates[depth].append(simulated / spent)
            totals[depth][0] += simulated
            totals[depth][1] += spent
    figures = {}
    for depth, (simulated, spent) in totals.items():
        figures[f"reach_rtf_{depth}"] = simulated / spent
        figures[f"reach_rtf_{depth}_worst"] = min(rates[depth])
    return figures


def bench_reference(*, quick: bool = False) -> dict[str, float]:
    """Return ``speedup_vs_reference_engine``: cost of a simulated second in the authors' engine
    over its cost in ours, as processor time of whole trials of 25 objects, run alternately.

    Bullet makes the authors' 240 steps a second at their scale (`PybulletWorld`); all else is ours
    in both. EngineMissing if the extra ``reference`` is not installed.
    """
    engines: tuple[Engine, ...] = ("mujoco", "pybullet")
    totals = {engine: [0.0, 0.0] for engine in engines}
    _trial(SCENES[0], "contacts", "straight")  # imports, caches
    for seed in SCENES[:1] if quick else SCENES:
        for strategy in ("straight", STRATEGY):
            for engine, total in totals.items():
                simulated, spent = _trial(seed, "contacts", strategy, engine)
                total[0] += simulated
                total[1] += spent
    cost = {engine: spent / simulated for engine, (simulated, spent) in totals.items()}
    return {
        "reference_engine_cpu_s": cost["pybullet"],
        "engine_cpu_s": cost["mujoco"],
        "speedup_vs_reference_engine": cost["pybullet"] / cost["mujoco"],
    }


def _trial(
    seed: int, depth: Depth, strategy: str = STRATEGY, engine: Engine = "mujoco"
) -> tuple[float, float]:
    """Simulated and processor seconds of one trial."""
    began = time.process_time()
    scene = generate("authors_sim", seed)
    result = run_trial(
        scene,
        strategy,
        parameters(scene.parameters),
        seed,
        depth=depth,
        world=make_world(engine, scene),
    )
    spent = time.process_time() - began
    if seed in SCENES and len(scene.objects) != OBJECTS:
        raise RuntimeError(f"scene {seed} has {len(scene.objects)} objects, not {OBJECTS}")
    return result.simulated_s, spent


def bench_reach_live(*, quick: bool = False) -> dict[str, float]:
    """Return ``loop_late_ms_*`` and ``wire_to_twist_ms_*`` of reaches in three processes.

    Lateness is that of every control cycle while reaching, as reachd reports it. Wire to twist:
    from the return of the write of a cycle's last byte to the arrival, in this process, of the
    first command decided with these features or newer ones; it includes the wait for the loop's
    next deadline. ``ordinary``: without the real-time priority that reachd takes where it may.
    """
    seeds = SCENES[:1] if quick else SCENES * 2
    late, wire = _punctuality(seeds, real_time=True)
    ordinary, _ = _punctuality(seeds, real_time=False)
    return {
        "loop_late_ms_p50": float(np.percentile(late, 50)),
        "loop_late_ms_p99": float(np.percentile(late, 99)),
        "loop_late_ms_p99.9": float(np.percentile(late, 99.9)),
        "loop_late_cycles": float(len(late)),
        "loop_late_ordinary_ms_p99": float(np.percentile(ordinary, 99)),
        "loop_late_ordinary_ms_p99.9": float(np.percentile(ordinary, 99.9)),
        "wire_to_twist_ms_p50": float(np.percentile(wire, 50)),
        "wire_to_twist_ms_p99": float(np.percentile(wire, 99)),
    }


def _punctuality(seeds: Sequence[int], *, real_time: bool) -> tuple[list[float], list[float]]:
    """Lateness of control cycles and wire to twist, both in ms, of a reach in each scene."""
    late: list[float] = []
    wire: list[float] = []
    with tempfile.TemporaryDirectory(prefix="tactile-live-") as name:
        scene = ("--scene", "authors_sim", "--seed", str(seeds[0]))
        with LiveReach(
            Path(name), scene, strategy=STRATEGY, relay=True, real_time=real_time
        ) as live:
            for seed in seeds:
                live.begin(seed)
                live.clear()
                live.until(live.ended, "the outcome")
                states = [m for _, m in live.decoded(REACH_STATE) if m.state == "reaching"]
                late += [m.lateness * 1e3 for m in states]
                wire += _wire_to_twist(live, states)
    if len(late) < 200 or len(wire) < 200:
        raise RuntimeError(f"only {len(late)} cycles and {len(wire)} features were seen")
    return late, wire


def _wire_to_twist(live: LiveReach, states: list[Any]) -> list[float]:
    """Latency of each cycle of the board that was acted on while reaching, ms."""
    relay = live.relay
    if relay is None or not states:
        return []
    # State and command of a control cycle have the same stamp, so the stamp identifies the command.
    arrived = {_stamp(m.header): at for at, m in live.decoded(COMMAND)}
    decided = np.array([m.stamped_ns for m in states])
    # The age has 32 bits: exact to a few ns.
    captured = decided - np.array([m.features_age for m in states], float) * NS_PER_S
    found = []
    for _, features in live.decoded(FEATURES):
        written = relay.written.get(features.sequence)
        if written is None or not captured[0] < features.captured_ns <= captured[-1]:
            continue
        first = int(np.searchsorted(captured, features.captured_ns - 1000))
        at = arrived.get(_stamp(states[first].header))
        if at is not None:
            found.append((at - written) * 1e-6)
    return found


def _stamp(header: Any) -> tuple[int, int]:
    return header.stamp.sec, header.stamp.nanosec
