"""Homing: out of the cupboard first, then straight to the pose."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest

from reachd.interfaces import Twist
from reachd.strategies.parameters import HARDWARE
from reachd.trial import Pose, home_twist

HOME = Pose(-0.2, 0.0, 0.0)


@pytest.mark.parametrize(
    ("pose", "backs_out"),
    [
        ((-0.3, 0.1, 0.5), False),
        ((0.1, 0.05, 0.0), True),
        ((0.1, 0.0, 0.3), True),
        ((0.1, 0.0015, 0.015), False),
        ((-0.169, 0.1, 0.0), False),
        ((-0.167, 0.1, 0.0), True),
    ],
)
def test_homing_leaves_the_cupboard_first(
    pose: tuple[float, float, float], backs_out: bool, make_arm: Callable
) -> None:
    x, y, heading = pose
    twist = home_twist(make_arm(x=x, y=y, heading=heading), HOME, HARDWARE)
    assert twist is not None
    if backs_out:
        assert twist == Twist(-0.045, 0.0, 0.0)
    else:
        assert twist.vx * (HOME.x - pose[0]) + twist.vy * (HOME.y - pose[1]) > 0.0
        assert math.hypot(twist.vx, twist.vy) <= 0.045 + 1e-12
        assert abs(twist.omega) <= 0.1
        assert twist.omega * (0.0 - pose[2]) >= 0.0


@pytest.mark.parametrize(
    ("pose", "there"),
    [
        ((-0.2, 0.0, 0.0), True),
        ((-0.2, 0.0019, 0.019), True),
        ((-0.2, 0.0021, 0.0), False),
        ((-0.2, 0.0, 0.021), False),
        ((-0.2, 0.0, math.tau), True),
    ],
)
def test_home_has_a_tolerance(
    pose: tuple[float, float, float], there: bool, make_arm: Callable
) -> None:
    x, y, heading = pose
    twist = home_twist(make_arm(x=x, y=y, heading=heading), HOME, HARDWARE)
    assert (twist is None) == there
