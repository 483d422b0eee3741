"""Limits that a robot did not take."""

from __future__ import annotations

import numpy as np

from armd.driver import RobotState
from armd.frames import Plane, Transform
from armd.guard import Guard
from tactile_core.bus.commanding import Order
from tactile_core.types import ArmLimits, Instant, Twist

HERE = Transform(np.zeros(3), np.eye(3))
LIMITS = ArmLimits(v_max=0.045, omega_max=0.1, f_max=10.0, m_max=4.5)
NOW = Instant(1_000_000_000)


def ask_to_move(guard: Guard) -> bool:
    """Whether a command of the commander "reach" would move the robot."""
    state = RobotState(1.0, np.zeros(3), np.eye(3), np.zeros(6), np.zeros(6))
    guard.see(state, NOW)
    until = Instant(NOW + 50_000_000)
    guard.obey(Order(Twist(0.03, 0.0, 0.0), "reach", 1, NOW, until), NOW)
    velocity, _ = guard.velocity(NOW)
    return velocity is not None and bool(velocity.any())


def test_nothing_moves_before_the_robot_has_taken_limits() -> None:
    guard = Guard(Plane(HERE, HERE))
    assert not ask_to_move(guard)
    guard.request_limits(LIMITS, "reach")
    assert ask_to_move(guard)
    guard.request_limits(LIMITS, "reach")
    guard.forget_limits()
    assert not ask_to_move(guard)
