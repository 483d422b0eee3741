"""What somebody should look at before it becomes a fault: a disk that fills, a skin that drifts."""

from __future__ import annotations

import math
from collections import deque
from pathlib import Path

from tactile_bus.disk_watch import DiskWatch
from tactile_bus.instant import Instant, seconds_between
from tactile_bus.recorder import Recorder
from tactiled.station import Station

DRIFT_N = 0.1
"""N below which nothing counts as touch anywhere in this project."""

WINDOW_S = 60.0
"""s of which the least force is kept."""

WINDOWS = 10
"""Windows that must all lie above `DRIFT_N`: a skin in use is let go of within ten minutes."""


class DriftWatch:
    """Tells a zero that wanders from touch: touch ends, now and then, and a wandered zero does not.

    Pure. Given the peak force once a second, it keeps the least of each minute; when the least of
    ten minutes is still above `DRIFT_N` the skin drifts, or something lies on it.
    """

    def __init__(self) -> None:
        self._least: deque[float] = deque(maxlen=WINDOWS)
        self._now = math.inf
        self._since: Instant | None = None

    def add(self, force_n: float, now: Instant) -> None:
        """Peak force (N) of valid features at ``now``."""
        if self._since is None:
            self._since = now
        if seconds_between(self._since, now) >= WINDOW_S:
            if math.isfinite(self._now):
                self._least.append(self._now)
            self._now, self._since = math.inf, now
        if math.isfinite(force_n):
            self._now = min(self._now, force_n)

    def forget(self) -> None:
        """Begin anew: the zero was taken again, or the board is another."""
        self._least.clear()
        self._now, self._since = math.inf, None

    def alarm(self) -> str | None:
        """What is wrong, None: nothing."""
        if len(self._least) < WINDOWS or min(self._least) <= DRIFT_N:
            return None
        if self._now <= DRIFT_N:
            return None
        minutes = WINDOWS * WINDOW_S / 60
        return (
            f"never below {min(self._least):.2f} N for {minutes:.0f} min: its zero has drifted, or "
            "something lies on it; let go of it and tare"
        )


class Alarms:
    """Alarms of all boards of a daemon; used from the pipeline's thread."""

    def __init__(self) -> None:
        self._disk: DiskWatch | None = None
        self._drift: dict[str, DriftWatch] = {}
        self._seen: dict[str, str] = {}

    def watch(self, recorder: Recorder) -> None:
        """Look after the disk of a log."""
        self._disk = DiskWatch(lambda: Path(recorder.stats.path).parent)
        self._disk.start()

    def stop(self) -> None:
        """End the looks at the disk."""
        if self._disk is not None:
            self._disk.stop()

    def each_second(self, station: Station, now: Instant) -> list[str]:
        """Alarms of a board, in words that say what to do."""
        watch = self._drift.setdefault(station.name, DriftWatch())
        board = "" if station.identity is None else str(station.identity.serial_number)
        taring = station.pipeline is not None and station.pipeline.taring
        if taring or self._seen.get(station.name) != board:
            watch.forget()
            self._seen[station.name] = board
        elif station.last is not None and station.last.features.valid:
            watch.add(station.last.features.peak_force, now)
        disk = None if self._disk is None else self._disk.alarm(now)
        return [alarm for alarm in (disk, watch.alarm()) if alarm is not None]
