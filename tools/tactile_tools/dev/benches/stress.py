"""Reaching for an hour on an overloaded machine."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from tactile_core.bus.topics import REACH_STATE
from tactile_tools.reach.process_rig import LiveReach, WatchError, is_moving

SECONDS = 3600.0
SECONDS_QUICK = 45.0
"""Length of the whole bench and of a quick one."""

TOO_LATE_S = 0.05  # of a control cycle: from there on it must command zero
REACH_S = 25.0  # a reach ends by itself within 20 s

BURNER = """
import random
heap = []
while True:
    heap = [[random.random() for _ in range(50)] for _ in range(20_000)]
    sum(sum(row) for row in heap)
"""
"""Keeps a processor busy and disturbs its caches and memory."""


def bench_stress(*, quick: bool = False) -> dict[str, float]:
    """Return the lateness of every control cycle of an hour, ms, with a busy process per processor.

    Meanwhile reaches in three real processes follow one another. ``stress_late_moving``: cycles
    more than 50 ms late that commanded anything but zero. ``stress_real_time``: 1 if reachd was
    granted a real-time priority.
    """
    seconds = SECONDS_QUICK if quick else SECONDS
    late: list[float] = []
    moving = reaches = reached = 0
    with tempfile.TemporaryDirectory(prefix="tactile-stress-") as name, _burners():
        scene = ("--scene", "authors_sim", "--seed", "0")
        with LiveReach(Path(name), scene, strategy="hybrid_event") as live:
            real_time = live.ask("status")["real_time"]
            end = time.monotonic() + seconds
            while time.monotonic() < end:
                live.clear()
                # On a loaded machine sensing or the arm may stop for a second: then arm it again.
                with contextlib.suppress(WatchError):
                    live.begin(reaches)
                    reaches += 1
                    live.until(live.ended, "the outcome", REACH_S)
                states = [m for _, m in live.decoded(REACH_STATE)]
                reached += bool(states) and 0.0 <= states[-1].distance <= states[-1].goal_radius
                late += [m.lateness * 1e3 for m in states]
                moving += sum(
                    m.lateness > TOO_LATE_S and is_moving(m.commanded, 0.0) for m in states
                )
    if len(late) < seconds * 20:
        raise RuntimeError(f"only {len(late)} control cycles were heard of in {seconds:g} s")
    return {
        "stress_late_ms_p99": float(np.percentile(late, 99)),
        "stress_late_ms_p99.9": float(np.percentile(late, 99.9)),
        "stress_late_ms_max": float(np.max(late)),
        "stress_late_moving": float(moving),
        "stress_cycles": float(len(late)),
        "stress_reaches": float(reaches),
        "stress_reached": float(reached),
        "stress_real_time": float(real_time),
    }


@contextlib.contextmanager
def _burners() -> Iterator[None]:
    """Run a busy process for every processor while the block runs."""
    burners = [subprocess.Popen([sys.executable, "-c", BURNER]) for _ in range(os.cpu_count() or 1)]
    try:
        yield
    finally:
        for burner in burners:
            burner.kill()
            burner.wait()
