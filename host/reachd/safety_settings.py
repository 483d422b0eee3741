"""What the safety gate checks, by stable code, and the limits it checks against."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from reachd.fields import SettingError, check_fields, number
from reachd.workspace import Region
from tactile_bus.arm_types import ArmLimits


class Check(StrEnum):
    """Reason codes of interventions. They are written to logs: never change their meaning."""

    NOT_ARMED = "not_armed"
    COMMAND_NOT_FINITE = "command_not_finite"
    STRATEGY_FAILED = "strategy_failed"
    CLOCK_BACKWARDS = "clock_backwards"
    LOOP_LATE = "loop_late"
    FEATURES_STALE = "features_stale"
    FEATURES_LOST = "features_lost"
    FEATURES_FUTURE = "features_future"
    ARM_STALE = "arm_stale"
    ARM_LOST = "arm_lost"
    ARM_FUTURE = "arm_future"
    ARM_NOT_FINITE = "arm_not_finite"
    ARM_FROZEN = "arm_frozen"
    ARM_MODE = "arm_mode"
    ARM_STOPPED = "arm_stopped"
    ARM_LIMITS = "arm_limits"
    DUPLICATE_PUBLISHER = "duplicate_publisher"
    SPEED = "speed"
    TURN_RATE = "turn_rate"
    ACCELERATION = "acceleration"
    SLOW_DOWN = "slow_down"
    WORKSPACE = "workspace"
    WRENCH = "wrench"
    FREE_AIR = "free_air"
    REQUEST_STALE = "request_stale"


ALWAYS_ON = frozenset(
    {
        Check.NOT_ARMED,
        Check.COMMAND_NOT_FINITE,
        Check.STRATEGY_FAILED,
        Check.ARM_NOT_FINITE,
        Check.REQUEST_STALE,
    }
)
"""Checks without which the gate has nothing to judge by, or would arm itself."""

MOVING_MODES = frozenset({"ready", "moving"})
"""Arm modes in which motion may be commanded."""

PAUSED_MODE = "stopped"
"""The driver stopped by itself because commands ceased; fresh zero commands revive it. An
operator's stop is "estop" or "fault", which latch."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SafetySettings:
    """Limits of the safety gate. Speeds are those of the pivot, SI units."""

    speed: float = number("m/s", "greatest speed of the pivot")
    turn_rate: float = number("rad/s", "greatest turn rate")
    acceleration: float = number("m/s²", "greatest acceleration of the pivot")
    turn_acceleration: float = number("rad/s²", "greatest angular acceleration")
    slow_radius: float = number("m", "distance of tip and goal within which motion is slowed")
    slow_fraction: float = number("", "part of speed and turn rate left within it", 0.0, 1.0)
    force: float = number("N", "in-plane force at which motion against it ends")
    torque: float = number("N·m", "torque about the pivot at which motion against it ends")
    soft_fraction: float = number(
        "", "part of force or torque from which such motion is slowed", 0.0, 1.0, below=True
    )
    free_air_force: float = number("N", "force at arming that shows a bias or a wrong tool")
    free_air_torque: float = number("N·m", "torque at arming that shows a bias or a wrong tool")
    features_age: float = number("s", "age of the last valid features at which motion ends")
    features_latch: float = number("s", "age of the last valid features at which the gate latches")
    arm_age: float = number("s", "age of the arm's state at which motion ends")
    arm_latch: float = number("s", "age of the arm's state at which the gate latches")
    frozen_after: float = number("s", "motion commanded but none reported, at which it latches")
    future: float = number("s", "how far ahead of now an input may be stamped", 0, 1, above=False)
    lateness: float = number("s", "lateness of the control loop at which motion ends")
    period: float = number("s", "period of the control loop", 0.0, 0.1)
    command_expiry: float = number("s", "how long the arm may follow a command", 0.0, 0.1)
    request_age: float = number("s", "how old an operator's request to arm may be")
    arm_v_max: float = number("m/s", "speed limit the arm must confirm")
    arm_omega_max: float = number("rad/s", "turn rate limit the arm must confirm")
    arm_f_max: float = number("N", "force limit the arm must confirm")
    arm_m_max: float = number("N·m", "torque limit the arm must confirm")
    tip_length: float = number("m", "from the pivot to the tip")
    tip_region: Region
    pivot_region: Region
    disabled: frozenset[Check] = frozenset()

    def __post_init__(self) -> None:
        """Refuse values out of range, limits that contradict one another, checks that must stay."""
        check_fields(self)
        for name, region in (("tip_region", self.tip_region), ("pivot_region", self.pivot_region)):
            if not isinstance(region, Region):
                raise SettingError(f"{name} is a list of corners [x, y] in m, not {region!r}")
        for soon, late in (("features_age", "features_latch"), ("arm_age", "arm_latch")):
            if getattr(self, late) < getattr(self, soon):
                raise SettingError(f"{late} must be at least {soon} ({getattr(self, soon):g} s)")
            if getattr(self, soon) <= self.period:
                raise SettingError(f"{soon} must exceed the loop's period ({self.period:g} s)")
        kept = sorted(self.disabled & ALWAYS_ON)
        if kept:
            raise SettingError(f"the check {kept[0]!s} cannot be switched off")

    @property
    def arm_limits(self) -> ArmLimits:
        """What to tell the arm before it is armed."""
        return ArmLimits(self.arm_v_max, self.arm_omega_max, self.arm_f_max, self.arm_m_max)
