"""What the safety gate checks, by stable code, and the limits it checks against."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from types import MappingProxyType

from reachd.fields import SettingError, check_fields, number
from reachd.gate.workspace import Region
from tactile_core.types import ArmLimits


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
    COMMANDER = "commander"
    RIVAL_COMMANDS = "rival_commands"
    ECHO_LATE = "echo_late"
    ECHO_LOST = "echo_lost"
    ARM_SPEED = "arm_speed"
    ARM_TRACKING = "arm_tracking"
    ARM_PATH = "arm_path"
    OVERLOAD = "overload"
    OVERLOAD_REPEATED = "overload_repeated"
    FEATURES_SPARSE = "features_sparse"
    TOUCH_RISING = "touch_rising"
    SKIN_FORCE = "skin_force"
    SKIN_OVERLOAD = "skin_overload"
    REQUEST_STALE = "request_stale"


ALWAYS_ON = frozenset(
    {
        Check.NOT_ARMED,
        Check.COMMAND_NOT_FINITE,
        Check.STRATEGY_FAILED,
        Check.ARM_NOT_FINITE,
        Check.REQUEST_STALE,
        Check.COMMANDER,
    }
)
"""Checks without which the gate has nothing to judge by, or would arm itself."""

HARD_CAPS: Mapping[str, float] = MappingProxyType(
    {
        "speed": 0.25,
        "turn_rate": 1.0,
        "acceleration": 10.0,
        "force": 30.0,
        "torque": 6.0,
        "overload": 2.0,
        "skin_force": 60.0,
        "features_age": 0.3,
        "arm_age": 0.1,
        "echo_age": 0.1,
        "frozen_after": 0.5,
        "arm_v_max": 0.25,
        "arm_omega_max": 1.0,
        "arm_f_max": 30.0,
        "arm_m_max": 6.0,
    }
)
"""Limits beyond which somebody may be hurt or a cupboard broken before the gate acts: allowed, but
never without a word. 0.25 m/s is what ISO 10218-1 calls reduced speed; the others are twice what
the hardware set has, in round figures."""

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
    overload: float = number("", "part of force or torque at which it latches", 1.0)
    overload_passes: float = number("", "passes of force or torque that latch it", 1.0, above=False)
    overload_within: float = number("s", "time within which so many passes count")
    skin_force: float = number("N", "sum of normal forces on the skin at which motion ends")
    touch_light: float = number("N", "force on the skin from which the finger touches something")
    touch_speed: float = number("m/s", "greatest speed against what it touches")
    touch_soft: float = number("N", "force foreseen from which motion against it is slowed")
    touch_hard: float = number("N", "force foreseen at which such motion ends")
    touch_lead: float = number("s", "how far ahead a rising force is foreseen", above=False)
    features_age: float = number("s", "age of the last valid features at which motion ends")
    features_latch: float = number("s", "age of the last valid features at which the gate latches")
    arm_age: float = number("s", "age of the arm's state at which motion ends")
    arm_latch: float = number("s", "age of the arm's state at which the gate latches")
    echo_age: float = number("s", "age at which a command must be in force at the arm")
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
        if self.touch_hard <= self.touch_soft:
            raise SettingError(f"touch_hard must exceed touch_soft ({self.touch_soft:g} N)")
        kept = sorted(self.disabled & ALWAYS_ON)
        if kept:
            raise SettingError(f"the check {kept[0]!s} cannot be switched off")

    @property
    def cautions(self) -> tuple[str, ...]:
        """What an operator must know of these settings: checks that are off, limits too wide."""
        off = [f"the check {check} is off" for check in sorted(self.disabled)]
        wide = [
            f"{name} is {getattr(self, name):g}, beyond the cap of {cap:g}"
            for name, cap in HARD_CAPS.items()
            if getattr(self, name) > cap
        ]
        return (*off, *wide)

    @property
    def arm_limits(self) -> ArmLimits:
        """What to tell the arm before it is armed."""
        return ArmLimits(self.arm_v_max, self.arm_omega_max, self.arm_f_max, self.arm_m_max)
