"""One typed instant: nanoseconds of the host's monotonic clock. Durations are float seconds."""

from __future__ import annotations

import time
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import NewType

Instant = NewType("Instant", int)
"""CLOCK_MONOTONIC in nanoseconds: the only time the control path knows."""

NS_PER_S = 1_000_000_000


STAMP_END_NS = (1 << 31) * NS_PER_S
"""First wall-clock time that a ROS 2 header cannot hold: its seconds are an int32, which ends on
2038-01-19."""


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
    order of a log. ``problem``: what is to be said of the stamps, empty when they are as usual.
    """

    offset_ns: int
    problem: str = ""

    @classmethod
    def take(cls) -> WallClock:
        """Read both clocks now; the monotonic reads around the wall read bound the error."""
        before = time.monotonic_ns()
        wall = time.time_ns()
        return cls.reading(wall, (before + time.monotonic_ns()) // 2)

    @classmethod
    def reading(cls, wall_ns: int, monotonic_ns: int) -> WallClock:
        """Clock of a machine whose two clocks read these at once.

        A log holds no time before 1970. Where the system clock says one, stamps count from the
        start of the monotonic clock, as if that had been at midnight of 1970-01-01.
        """
        if wall_ns < 0:
            return cls(
                0,
                f"the system clock reads {utc_text(wall_ns)}, before 1970: stamps count from the "
                "start of this machine instead; set its clock",
            )
        if wall_ns >= STAMP_END_NS:
            return cls(
                wall_ns - monotonic_ns,
                f"the system clock reads {utc_text(wall_ns)}: the headers of ROS 2 messages end "
                "on 2038-01-19, so their stamps are 0 (no time); the times of the log are right",
            )
        return cls(wall_ns - monotonic_ns)

    def wall_ns(self, instant: Instant) -> int:
        """Nanoseconds since the Unix epoch that stand for ``instant``."""
        return instant + self.offset_ns


def utc_text(wall_ns: int, layout: str = "%Y-%m-%d %H:%M:%S") -> str:
    """A wall-clock time as UTC, by a layout of `datetime.strftime`; any number of ns will do.

    What lies before the year 1000 or after 9999 is shown as the nearest time within.
    """
    earliest, latest = datetime(1000, 1, 1, tzinfo=UTC), datetime(9999, 12, 31, tzinfo=UTC)
    epoch = datetime(1970, 1, 1, tzinfo=UTC)
    try:
        when = epoch + timedelta(microseconds=wall_ns // 1000)
    except OverflowError:
        when = latest if wall_ns > 0 else earliest
    return min(max(when, earliest), latest).strftime(layout)
