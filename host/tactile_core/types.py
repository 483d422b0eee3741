"""Instants, wall-clock stamps, and the values that arms and controllers exchange.

An `Instant` is in nanoseconds of the host's monotonic clock. Durations are floats in seconds.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from types import MappingProxyType
from typing import Final, NewType, TypeVar, dataclass_transform

# Records that each control cycle creates by the dozen.


T = TypeVar("T")


@dataclass_transform(frozen_default=True)
def record(cls: type[T]) -> type[T]:
    """Return ``cls`` as a slotted dataclass that the type checker treats as frozen.

    Freezing it at run time would set each field through a function call, which costs more than all
    the arithmetic of a control cycle. Equal records have equal hashes.
    """
    return dataclass(slots=True, unsafe_hash=True)(cls)


Instant = NewType("Instant", int)
"""CLOCK_MONOTONIC in nanoseconds: the only clock that control code uses."""

NS_PER_S = 1_000_000_000


STAMP_END_NS = (1 << 31) * NS_PER_S
"""First wall-clock time that does not fit into a ROS 2 header: its int32 seconds end on
2038-01-19."""


def monotonic_now() -> Instant:
    """Current instant. Only shells call this; pure code receives ``now`` as an argument."""
    return Instant(time.monotonic_ns())


def seconds_between(start: Instant, end: Instant) -> float:
    """Duration from ``start`` to ``end`` in seconds; negative if ``end`` is earlier."""
    return (end - start) / NS_PER_S


def after(start: Instant, seconds: float) -> Instant:
    """Instant ``seconds`` after ``start``."""
    return Instant(start + round(seconds * NS_PER_S))


@dataclass(frozen=True, slots=True)
class WallClock:
    """Maps instants to wall-clock stamps with one fixed offset.

    As the offset never changes, a step of the system clock affects neither motion nor the order of
    a log. ``problem``: a warning about the stamps; empty if they are as usual.
    """

    offset_ns: int
    problem: str = ""

    @classmethod
    def take(cls) -> WallClock:
        """Read both clocks now.

        Monotonic reads before and after the wall-clock read bound the error.
        """
        before = time.monotonic_ns()
        wall = time.time_ns()
        return cls.reading(wall, (before + time.monotonic_ns()) // 2)

    @classmethod
    def reading(cls, wall_ns: int, monotonic_ns: int) -> WallClock:
        """Create the mapping from simultaneous readings of both clocks.

        A log cannot hold times before 1970. If the system clock reads one, stamps count from the
        start of the monotonic clock, as if that had been midnight of 1970-01-01.
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
        """Nanoseconds since the Unix epoch for ``instant``."""
        return instant + self.offset_ns


def utc_text(wall_ns: int, layout: str = "%Y-%m-%d %H:%M:%S") -> str:
    """Format a wall-clock time as UTC (`datetime.strftime` layout); accepts any integer in ns.

    Times before the year 1000 or after 9999 are shown as the nearest time within.
    """
    earliest, latest = datetime(1000, 1, 1, tzinfo=UTC), datetime(9999, 12, 31, tzinfo=UTC)
    epoch = datetime(1970, 1, 1, tzinfo=UTC)
    try:
        when = epoch + timedelta(microseconds=wall_ns // 1000)
    except OverflowError:
        when = latest if wall_ns > 0 else earliest
    return min(max(when, earliest), latest).strftime(layout)


# Values exchanged with every arm, simulated or real: twists, state and limits.
#
# Planar quantities are in the frame ``cupboard``: origin at the middle of its front edge, x into
# the cupboard, y left, angles counter-clockwise from x. (The paper's axes are x right, y forward,
# angles from y: x_here = y_paper, y_here = −x_paper.)


@record
class Twist:
    """Planar velocity of the wrist pivot. m/s in ``cupboard``, rad/s counter-clockwise."""

    vx: float
    vy: float
    omega: float


ZERO = Twist(0.0, 0.0, 0.0)


@record
class Echo:
    """Which commander an arm obeys, and its command in force or the last that was.

    ``commander``: name as granted, empty for none. ``decided``: when the command was decided, by
    the commander's clock; 0 before the first, as is ``sequence``. ``own``: whether the reader of
    the state is that commander.
    """

    commander: str
    sequence: int
    decided: Instant
    own: bool = True


@record
class ArmState:
    """State that an arm reports at its own rate.

    Pose of the wrist pivot (m, rad) and its twist; wrench that the environment exerts on the
    end-effector about the pivot (N, N, N·m), all in ``cupboard``. ``mode`` is "ready", "moving",
    "stopped", "fault" or "estop". The limits are those the arm confirms: m/s, rad/s, N, N·m.
    ``echo`` is None if commands reach the arm directly: in lockstep.
    """

    captured: Instant
    received: Instant
    x: float
    y: float
    heading: float
    twist: Twist
    fx: float
    fy: float
    mz: float
    mode: str
    v_max: float
    omega_max: float
    f_max: float
    m_max: float
    echo: Echo | None = None


@dataclass(frozen=True, slots=True)
class ArmLimits:
    """Limits requested of an arm: m/s, rad/s, N on each world axis, N·m about the pivot.

    Raises ValueError unless all are finite and positive.
    """

    v_max: float
    omega_max: float
    f_max: float
    m_max: float

    def __post_init__(self) -> None:
        """Reject limits without effect."""
        for name in ("v_max", "omega_max", "f_max", "m_max"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise ValueError(f"{name} is {value}; a limit is finite and above 0")


ARM_LIMITS: Final = MappingProxyType(
    {
        # Table I of the paper, as printed.
        "hardware": ArmLimits(v_max=0.045, omega_max=0.1, f_max=15.0, m_max=4.5),
        # Authors' simulator at true scale: 0.5 u/s and ±15 at a lever of ten times its length. Its
        # excavation turns at 0.25 rad/s of the allowed 0.35; that limit belongs to the primitive.
        "authors_sim": ArmLimits(v_max=0.05, omega_max=0.35, f_max=10.0, m_max=1.5),
    }
)
"""Limits of the two named parameter sets."""


# Time stamps of another machine's monotonic clock. Pure.


DRIFT = 2e-4
"""Largest relative drift between the clocks of two machines: twice that of poor quartz crystals."""


class RemoteClock:
    """Maps another machine's monotonic stamps to this machine's, taking the least delay seen as
    zero.

    A message delayed more than the fastest one is older by the difference, so a growing queue on
    the way shows as age. The minimum is relaxed only as fast as clocks may drift.
    """

    def __init__(self) -> None:
        self._offset: float | None = None
        self._at = Instant(0)

    def here(self, stamp: int, received: Instant) -> Instant:
        """Instant of this host for ``stamp``; never later than ``received``."""
        offset = received - stamp
        if self._offset is not None:
            offset = min(offset, round(self._offset + DRIFT * (received - self._at)))
        self._offset, self._at = offset, received
        return Instant(stamp + offset)
