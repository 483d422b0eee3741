"""Time until a reach stands still when one of its three processes is stopped or killed."""

from __future__ import annotations

import dataclasses
import signal
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sim_device.world.scene_generation import generate
from tactile_core.bus.topics import ARM_STATE, COMMAND, FEATURES, Topic
from tactile_tools.reach.process_rig import LiveReach, is_moving

TIMES = 20
TIMES_QUICK = 2
"""Signals of each kind to each process, in the whole bench and in a quick one."""

WATCH_S = 0.5  # what is watched after the signal; below the 1 s after which the gate latches
MOVING_S = (0.4, 0.9)  # the arm has moved for so long when the signal comes
TRIES = 4  # an invalid trial is repeated

NS_PER_MS = 1e6


class InvalidTrialError(RuntimeError):
    """The trial says nothing: the arm was not moving, or the signal came too late."""


@dataclass(frozen=True, slots=True)
class Case:
    """Process that is signalled, and how the time until its effect is measured."""

    figure: str
    process: str
    measure: Callable[[LiveReach, int], float]


def bench_stop(*, quick: bool = False) -> dict[str, float]:
    """Return ``stop_ms_max_*``: the longest of 20 SIGSTOPs and 20 SIGKILLs of each process.

    ``features``, ``arm_state``: from the capture of the last one that came to the arrival of the
    zero twist after which only zero twists came. ``commands``: from the arrival of the last command
    to the first state, 200 a second, of an arm at rest. Each is also split by signal. Empty shelf,
    straight reach. ``stop_real_time``: 1 if reachd was granted a real-time priority.
    """
    times = TIMES_QUICK if quick else TIMES
    found: dict[str, list[float]] = {}
    cases = (
        Case("features", "tactiled", lambda live, since: zero_after(live, FEATURES, since)),
        Case("arm_state", "cupboard", lambda live, since: zero_after(live, ARM_STATE, since)),
        Case("commands", "reachd", rest_after),
    )
    rng = np.random.default_rng(1)
    with tempfile.TemporaryDirectory(prefix="tactile-stop-") as name:
        folder = Path(name)
        shelf = dataclasses.replace(generate("authors_sim", 0), objects=())
        (folder / "shelf.json").write_text(shelf.to_json(), encoding="utf-8")
        with LiveReach(folder, ("--scene", "shelf.json"), strategy="straight") as live:
            real_time = live.ask("status")["real_time"]
            for case in cases:
                for number in (signal.SIGSTOP, signal.SIGKILL):
                    kept = found.setdefault(f"{case.figure}_{number.name.lower()}", [])
                    for _ in range(times):
                        kept.append(_trial(live, case, number, rng))
    figures = {}
    for case in cases:
        of_case = {k: v for k, v in found.items() if k.startswith(case.figure)}
        figures[f"stop_ms_max_{case.figure}"] = max(max(v) for v in of_case.values())
        figures |= {f"stop_ms_max_{k}": max(v) for k, v in of_case.items()}
    return figures | {"stop_times_each": float(times), "stop_real_time": float(real_time)}


def _trial(live: LiveReach, case: Case, number: signal.Signals, rng: np.random.Generator) -> float:
    """Milliseconds from the last message of the process to standing still."""
    for left in reversed(range(TRIES)):
        live.begin()
        live.until(live.moving, "motion")
        time.sleep(float(rng.uniform(*MOVING_S)))
        live.clear()
        time.sleep(0.15)
        since = live.signal(case.process, number)
        time.sleep(WATCH_S)
        try:
            found = case.measure(live, since)
        except InvalidTrialError:
            if not left:
                raise
            found = -1.0
        if number == signal.SIGSTOP:
            live.signal(case.process, signal.SIGCONT)
        else:
            live.start(case.process)
        live.wait_ready()
        if found >= 0:
            return found
    raise InvalidTrialError(f"{case.process} was hit {TRIES} times and the arm never moved then")


def zero_after(live: LiveReach, topic: Topic, since: int) -> float:
    """Milliseconds from capture of the last ``topic`` to arrival of the final zero twist."""
    kept = live.decoded(topic)
    commands = live.decoded(COMMAND)
    moving = [k for k, (_, m) in enumerate(commands) if is_moving(m.twist)]
    if not kept or not moving or commands[moving[-1]][0] < since:
        raise InvalidTrialError("the arm was not moving when the signal came")
    if moving[-1] + 1 == len(commands):
        raise RuntimeError(f"no zero twist came within {WATCH_S} s of the signal")
    return float(commands[moving[-1] + 1][0] - kept[-1][1].captured_ns) / NS_PER_MS


def rest_after(live: LiveReach, since: int) -> float:
    """Milliseconds from the arrival of the last command to the first state of an arm at rest."""
    commands, states = live.decoded(COMMAND), live.decoded(ARM_STATE)
    moving = [k for k, (_, m) in enumerate(states) if is_moving(m.twist)]
    if not commands or not moving or states[moving[-1]][1].captured_ns < since:
        raise InvalidTrialError("the arm was not moving when the signal came")
    if moving[-1] + 1 == len(states):
        raise RuntimeError(f"the arm moved on for {WATCH_S} s after the signal")
    return float(states[moving[-1] + 1][1].captured_ns - commands[-1][0]) / NS_PER_MS
