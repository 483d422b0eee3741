"""Inputs in good health, an armed gate, and a finger in free air."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from reachd.parameters import SETS
from reachd.safety import SafetyGate
from reachd.safety_settings import SafetySettings
from reachd.seam import ArmState, Goal, Strategy, Touch, Twist
from tactile_bus.geometry import Side
from tactile_bus.instant import Instant, after

T0 = Instant(5_000_000_000)


@pytest.fixture(scope="session")
def t0() -> Instant:
    """Where the tests' time begins."""
    return T0


@pytest.fixture(scope="session")
def make_touch() -> Callable[..., Touch]:
    """Valid touch of nothing at ``at``, values replaced as given."""

    def make(at: Instant = T0, **values: object) -> Touch:
        calm = Touch(at, at, True, 0.0, Side.NONE, 0.0, 0.0, 0.0, 0.0)
        return replace(calm, **values)  # type: ignore[arg-type]

    return make


@pytest.fixture(scope="session")
def make_arm() -> Callable[..., ArmState]:
    """Arm at rest in front of the cupboard at ``at``, as the hardware set wants it."""

    def make(at: Instant = T0, **values: object) -> ArmState:
        limits = SETS["hardware"].safety.arm_limits
        calm = ArmState(
            captured=at,
            received=at,
            x=-0.2,
            y=0.0,
            heading=0.0,
            twist=Twist(0.0, 0.0, 0.0),
            fx=0.0,
            fy=0.0,
            mz=0.0,
            mode="ready",
            v_max=limits.v_max,
            omega_max=limits.omega_max,
            f_max=limits.f_max,
            m_max=limits.m_max,
        )
        return replace(calm, **values)  # type: ignore[arg-type]

    return make


@pytest.fixture(scope="session")
def settings() -> SafetySettings:
    """The gate's settings of the hardware set."""
    return SETS["hardware"].safety


@pytest.fixture(scope="session")
def make_gate(
    make_touch: Callable[..., Touch], make_arm: Callable[..., ArmState]
) -> Callable[[SafetySettings], SafetyGate]:
    """Gate with these settings, armed at T0 and stepped once."""

    def make(settings: SafetySettings) -> SafetyGate:
        gate = SafetyGate(settings)
        assert gate.arm(T0, make_touch(), make_arm(), T0) == ()
        gate.step(Twist(0.0, 0.0, 0.0), make_touch(), make_arm(), None, T0)
        return gate

    return make


@pytest.fixture(scope="session")
def fly(make_touch: Callable[..., Touch], make_arm: Callable[..., ArmState]) -> Callable[..., dict]:
    """Move a finger in free air as a strategy wants, by small Euler steps."""

    def run(
        strategy: Strategy,
        goal: Goal,
        seconds: float,
        *,
        dt: float = 0.01,
        pose: tuple[float, float, float] = (-0.2, 0.0, 0.0),
        feel: Callable[[float], Touch] | None = None,
    ) -> dict[str, np.ndarray]:
        x, y, heading = pose
        rows, activities = [], []
        strategy.start(goal, T0)
        for k in range(round(seconds / dt)):
            now = after(T0, k * dt)
            arm = make_arm(now, x=x, y=y, heading=heading)
            touch = feel(k * dt) if feel else make_touch(now)
            twist = strategy.step(touch, arm, goal, now)
            rows.append((k * dt, x, y, heading, twist.vx, twist.vy, twist.omega))
            activities.append(strategy.activity)
            x, y = x + twist.vx * dt, y + twist.vy * dt
            heading += twist.omega * dt
        table = np.array(rows)
        length = 0.158
        return {
            "t": table[:, 0],
            "pivot": table[:, 1:3],
            "heading": table[:, 3],
            "twist": table[:, 4:],
            "tip": table[:, 1:3]
            + length * np.column_stack([np.cos(table[:, 3]), np.sin(table[:, 3])]),
            "activity": np.array(activities),
            "end": np.array([x + length * math.cos(heading), y + length * math.sin(heading)]),
        }

    return run
