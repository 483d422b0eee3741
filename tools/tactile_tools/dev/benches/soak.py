"""Memory of tactiled over an hour's worth of simulated frames."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

import numpy as np
import psutil

from tactile_tools.processes import command, running, socket_at, wait_for

HOUR_OF_CYCLES = 3600 * 100  # the finger's usual rate is 100 Hz
RATE_HZ = 300  # below what the simulated chips allow (349 Hz); three times faster than life
WARM_UP_S = 20.0  # imports, first log chunks, the bounded windows of clock and tare filling
SAMPLE_S = 1.0


def bench_soak(*, quick: bool = False) -> dict[str, float]:
    """Return ``rss_growth_mb``: resident memory at the end less that after the warm-up, MB.

    A real tactiled with its log, at three times the usual rate; ``quick`` runs half a minute.
    Start and end are medians of the first and last twentieth of the readings.
    """
    seconds = 30.0 if quick else HOUR_OF_CYCLES / RATE_HZ
    with tempfile.TemporaryDirectory(prefix="tactile-soak-") as folder_name:
        folder = Path(folder_name)
        port = folder / "board"
        simulator = [command("simdevice"), "boards", "--pty", str(port), "--seed", "1"]
        daemon = [
            *(command("tactiled"), "--port", str(port), "--name", "soak"),
            *("--rate", str(RATE_HZ), "--log", str(folder / "soak.mcap")),
            *("--listen", socket_at(folder, "tactiled")),
        ]
        with running([*simulator, "--rate", str(RATE_HZ)], folder / "simulator.txt") as board:
            wait_for(port, board, folder / "simulator.txt")
            with running(daemon, folder / "tactiled.txt") as process:
                readings = _readings(psutil.Process(process.pid), seconds)
                if process.poll() is not None:
                    output = (folder / "tactiled.txt").read_text(errors="replace")
                    raise RuntimeError(f"tactiled ended during the soak: {output[-2000:]}")
        log_mb = sum(p.stat().st_size for p in folder.glob("*.mcap")) / 1e6
    part = max(1, len(readings) // 20)
    first, last = np.median(readings[:part]), np.median(readings[-part:])
    return {
        "rss_growth_mb": float(last - first),
        "rss_mb": float(last),
        "soak_cycles": seconds * RATE_HZ,
        "soak_log_mb": log_mb,
    }


def _readings(process: psutil.Process, seconds: float) -> list[float]:
    """Resident memory in MB once a second, from the end of the warm-up on."""
    time.sleep(WARM_UP_S)
    readings = []
    end = time.monotonic() + seconds
    while time.monotonic() < end and process.is_running():
        readings.append(process.memory_info().rss / 1e6)
        time.sleep(SAMPLE_S)
    return readings
