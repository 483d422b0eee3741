"""One typed instant: nanoseconds of the host's monotonic clock. Durations are float seconds."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import NewType

Instant = NewType("Instant", int)
"""CLOCK_MONOTONIC in nanoseconds: the only time the control path knows."""

NS_PER_S = 1_000_000_000


def monotonic_now() -> Instant:
    """Present instant. Only the thin shells call this; pure code is handed its ``now``."""
    return Instant(time.monotonic_ns())


def seconds_between(start: Instant, end: Instant) -> float:
    """Duration from ``start`` to ``end`` in seconds (negative when ``end`` is earlier)."""
    return (end - start) / NS_PER_S


def after(start: Instant, seconds: float) -> Instant:
    """Instant ``seconds`` after ``start``."""
    return Instant(start + round(seconds * NS_PER_S))


@dataclass(frozen=True, slots=True)
class WallClock:
    """Maps instants to wall-clock stamps by one offset, taken once.

    Because the offset never changes, a step of the system clock moves neither motion nor the
    order of a log.
    """

    offset_ns: int

    @classmethod
    def take(cls) -> WallClock:
        """Read both clocks now; the monotonic reads around the wall read bound the error."""
        before = time.monotonic_ns()
        wall = time.time_ns()
        return cls(wall - (before + time.monotonic_ns()) // 2)

    def wall_ns(self, instant: Instant) -> int:
        """Nanoseconds since the Unix epoch that stand for ``instant``."""
        return instant + self.offset_ns
