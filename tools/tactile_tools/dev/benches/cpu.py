"""Processor time of tactiled at the finger's usual rate."""

from __future__ import annotations

import contextlib
import tempfile
import time
from pathlib import Path

import psutil

from tactile_tools.processes import command, running, socket_at, wait_for

RATE_HZ = 100
FINGERS = (1, 4)
WARM_UP_S = 6.0  # imports, identification, tare


def bench_cpu(*, quick: bool = False) -> dict[str, float]:
    """Return ``tactiled_cpu_pct_1`` and ``_4``: percent of one processor for 1 and 4 fingers.

    Real tactileds with logs, on simulated fingers of four arrays and 64 taxels each, at 100 Hz.
    """
    seconds = 8.0 if quick else 60.0
    return {f"tactiled_cpu_pct_{n}": _percent(n, seconds) for n in FINGERS}


def _percent(fingers: int, seconds: float) -> float:
    with (
        tempfile.TemporaryDirectory(prefix="tactile-cpu-") as name,
        contextlib.ExitStack() as stack,
    ):
        folder = Path(name)
        simulator = [command("simdevice"), "boards", "--seed", "1", "--rate", str(RATE_HZ)]
        daemon = [command("tactiled"), "--log", str(folder / "cpu.mcap")]
        daemon += ["--listen", socket_at(folder, "tactiled")]
        for index in range(fingers):
            simulator += ["--pty", str(folder / f"b{index}")]
            daemon += ["--port", str(folder / f"b{index}"), "--name", f"b{index}"]
        board = stack.enter_context(running(simulator, folder / "simulator.txt"))
        for index in range(fingers):
            wait_for(folder / f"b{index}", board, folder / "simulator.txt")
        process = stack.enter_context(running(daemon, folder / "tactiled.txt"))
        time.sleep(WARM_UP_S)
        if process.poll() is not None:
            output = (folder / "tactiled.txt").read_text(errors="replace")
            raise RuntimeError(f"tactiled ended: {output[-2000:]}")
        watched = psutil.Process(process.pid)
        before, started = watched.cpu_times(), time.monotonic()
        time.sleep(seconds)
        after = watched.cpu_times()
        spent = (after.user + after.system) - (before.user + before.system)
        return 100.0 * spent / (time.monotonic() - started)
