"""The checks of the safety gate, by stable code, and its limits."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from types import MappingProxyType
from typing import Annotated

from msgspec import Meta

from reachd.gate.workspace import Region
from tactile_core.config import (
    ConfigError,
    Metres,
    MetresPerSecond,
    MetresPerSecond2,
    NewtonMetres,
    Newtons,
    RadiansPerSecond,
    RadiansPerSecond2,
    Seconds,
    check_fields,
)
from tactile_core.types import ArmLimits


class Check(StrEnum):
    """Reason codes of interventions. Logs contain them, so their meaning must never change."""

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
"""Checks that cannot be disabled: without them the gate could not judge, or would arm itself."""

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
always with a warning. 0.25 m/s is the reduced speed of ISO 10218-1; the others are twice the values
of the hardware set, in round figures."""

MOVING_MODES = frozenset({"ready", "moving"})
"""Arm modes in which motion may be commanded."""

PAUSED_MODE = "stopped"
"""The driver stopped by itself because commands ceased; new zero commands resume it. An operator's
stop is "estop" or "fault", which latch."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SafetySettings:
    """Limits of the safety gate, in SI units. Speeds are those of the pivot."""

    speed: Annotated[MetresPerSecond, Meta(gt=0, description="greatest speed of the pivot")]
    turn_rate: Annotated[RadiansPerSecond, Meta(gt=0, description="greatest turn rate")]
    acceleration: Annotated[
        MetresPerSecond2, Meta(gt=0, description="greatest acceleration of the pivot")
    ]
    turn_acceleration: Annotated[
        RadiansPerSecond2, Meta(gt=0, description="greatest angular acceleration")
    ]
    slow_radius: Annotated[
        Metres, Meta(gt=0, description="distance of tip and goal within which motion is slowed")
    ]
    slow_fraction: Annotated[
        float, Meta(gt=0, le=1, description="part of speed and turn rate left within it")
    ]
    force: Annotated[
        Newtons, Meta(gt=0, description="in-plane force at which motion against it ends")
    ]
    torque: Annotated[
        NewtonMetres,
        Meta(gt=0, description="torque about the pivot at which motion against it ends"),
    ]
    soft_fraction: Annotated[
        float,
        Meta(gt=0, lt=1, description="part of force or torque from which such motion is slowed"),
    ]
    free_air_force: Annotated[
        Newtons, Meta(gt=0, description="force at arming that shows a bias or a wrong tool")
    ]
    free_air_torque: Annotated[
        NewtonMetres, Meta(gt=0, description="torque at arming that shows a bias or a wrong tool")
    ]
    overload: Annotated[
        float, Meta(gt=1, description="part of force or torque at which it latches")
    ]
    overload_passes: Annotated[
        float, Meta(ge=1, description="passes of force or torque that latch it")
    ]
    overload_within: Annotated[
        Seconds, Meta(gt=0, description="time within which so many passes count")
    ]
    skin_force: Annotated[
        Newtons, Meta(gt=0, description="sum of normal forces on the skin at which motion ends")
    ]
    touch_light: Annotated[
        Newtons, Meta(gt=0, description="force on the skin from which the finger touches something")
    ]
    touch_speed: Annotated[
        MetresPerSecond, Meta(gt=0, description="greatest speed against what it touches")
    ]
    touch_soft: Annotated[
        Newtons, Meta(gt=0, description="force foreseen from which motion against it is slowed")
    ]
    touch_hard: Annotated[
        Newtons, Meta(gt=0, description="force foreseen at which such motion ends")
    ]
    touch_lead: Annotated[
        Seconds, Meta(ge=0, description="how far ahead a rising force is foreseen")
    ]
    features_age: Annotated[
        Seconds, Meta(gt=0, description="age of the last valid features at which motion ends")
    ]
    features_latch: Annotated[
        Seconds, Meta(gt=0, description="age of the last valid features at which the gate latches")
    ]
    arm_age: Annotated[
        Seconds, Meta(gt=0, description="age of the arm's state at which motion ends")
    ]
    arm_latch: Annotated[
        Seconds, Meta(gt=0, description="age of the arm's state at which the gate latches")
    ]
    echo_age: Annotated[
        Seconds, Meta(gt=0, description="age at which a command must be in force at the arm")
    ]
    frozen_after: Annotated[
        Seconds, Meta(gt=0, description="motion commanded but none reported, at which it latches")
    ]
    future: Annotated[
        Seconds, Meta(ge=0, le=1, description="how far ahead of now an input may be stamped")
    ]
    lateness: Annotated[
        Seconds, Meta(gt=0, description="lateness of the control loop at which motion ends")
    ]
    period: Annotated[Seconds, Meta(gt=0, le=0.1, description="period of the control loop")]
    command_expiry: Annotated[
        Seconds, Meta(gt=0, le=0.1, description="how long the arm may follow a command")
    ]
    request_age: Annotated[
        Seconds, Meta(gt=0, description="how old an operator's request to arm may be")
    ]
    arm_v_max: Annotated[
        MetresPerSecond, Meta(gt=0, description="speed limit the arm must confirm")
    ]
    arm_omega_max: Annotated[
        RadiansPerSecond, Meta(gt=0, description="turn rate limit the arm must confirm")
    ]
    arm_f_max: Annotated[Newtons, Meta(gt=0, description="force limit the arm must confirm")]
    arm_m_max: Annotated[NewtonMetres, Meta(gt=0, description="torque limit the arm must confirm")]
    tip_length: Annotated[Metres, Meta(gt=0, description="from the pivot to the tip")]
    tip_region: Annotated[Region, Meta(description="where the tip may go, in `cupboard`")]
    pivot_region: Annotated[Region, Meta(description="where the pivot may go, in `cupboard`")]
    disabled: Annotated[
        frozenset[Check], Meta(description="checks that are switched off, by reason code")
    ] = frozenset()

    def __post_init__(self) -> None:
        """Check ranges, contradicting limits, and checks that must stay on; `ConfigError`."""
        check_fields(self)
        for soon, late in (("features_age", "features_latch"), ("arm_age", "arm_latch")):
            age = getattr(self, soon)
            if getattr(self, late) < age:
                raise ConfigError(f"{late} must be at least {soon} ({age:g} s)", (soon,))
            if age <= self.period:
                raise ConfigError(
                    f"{soon} must exceed the loop's period ({self.period:g} s)", (soon,)
                )
        if self.touch_hard <= self.touch_soft:
            raise ConfigError(
                f"touch_hard must exceed touch_soft ({self.touch_soft:g} N)", ("touch_hard",)
            )
        kept = sorted(self.disabled & ALWAYS_ON)
        if kept:
            raise ConfigError(f"the check {kept[0]!s} cannot be switched off", ("disabled",))

    @property
    def cautions(self) -> tuple[str, ...]:
        """Warnings for the operator: checks that are off, and limits beyond `HARD_CAPS`."""
        off = [f"the check {check} is off" for check in sorted(self.disabled)]
        wide = [
            f"{name} is {getattr(self, name):g}, beyond the cap of {cap:g}"
            for name, cap in HARD_CAPS.items()
            if getattr(self, name) > cap
        ]
        return (*off, *wide)

    @property
    def arm_limits(self) -> ArmLimits:
        """Limits to set at the arm before it is armed."""
        return ArmLimits(self.arm_v_max, self.arm_omega_max, self.arm_f_max, self.arm_m_max)
