"""From cupboard to base and back, and what no frame can be made of."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from armd.driver import RobotState
from armd.frames import (
    FrameError,
    Plane,
    Transform,
    frame_from_points,
    rotation_matrix,
    rotation_vector,
)
from tactile_core.types import Twist

UP = np.array([0.0, 0.0, 1.0])
ORIGIN = np.array([0.4, -0.2, 0.3])
IN = np.array([0.4, -0.5, 0.3])
LEFT = np.array([0.6, -0.2, 0.3])

numbers = st.floats(-1.0, 1.0)
vectors = st.tuples(numbers, numbers, numbers).map(np.array)


def plane(pivot: Transform | None = None) -> Plane:
    own = Transform(np.array([0.0, 0.03, 0.02]), rotation_matrix(np.array([0.0, -np.pi / 2, 0.0])))
    return Plane(frame_from_points(ORIGIN, IN, LEFT, UP), pivot or own)


def state(where: Plane, x: float, y: float, heading: float, **more: np.ndarray) -> RobotState:
    ee = Transform(np.array([x, y, 0.0]), rotation_matrix(np.array([0.0, 0.0, heading])))
    tool = where.cupboard @ ee @ where.pivot.inverse()
    zero = np.zeros(6)
    twist, wrench = more.get("twist", zero), more.get("wrench", zero)
    return RobotState(0.0, tool.position, tool.rotation, twist, wrench)


@given(vectors)
def test_rotation_vectors_return(vector: np.ndarray) -> None:
    assert rotation_vector(rotation_matrix(vector * 3)) == pytest.approx(vector * 3, abs=1e-6) or (
        np.linalg.norm(vector) * 3 > np.pi
    )


@given(numbers, numbers, numbers)
def test_poses_return(x: float, y: float, heading: float) -> None:
    where = plane()
    found = where.planar(state(where, x, y, heading))
    assert (found.x, found.y, found.heading) == pytest.approx((x, y, heading), abs=1e-9)
    assert found.height == pytest.approx(0, abs=1e-9)
    assert found.tilt == pytest.approx(0, abs=1e-6)


@given(numbers, numbers, numbers, numbers)
def test_a_commanded_twist_is_the_one_that_is_measured(
    heading: float, vx: float, vy: float, omega: float
) -> None:
    where = plane()
    at = state(where, -0.1, 0.05, heading)
    velocity = where.velocity(Twist(vx, vy, omega), at)
    found = where.planar(state(where, -0.1, 0.05, heading, twist=velocity)).twist
    assert (found.vx, found.vy, found.omega) == pytest.approx((vx, vy, omega), abs=1e-9)


def test_a_force_at_the_tool_turns_about_the_pivot() -> None:
    where = plane(Transform(np.array([0.1, 0.0, 0.0]), np.eye(3)))
    push = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    push[:3] = where.cupboard.rotation @ np.array([0.0, 2.0, 0.0])
    found = where.planar(state(where, 0.0, 0.0, 0.0, wrench=push))
    # The tool centre is 0.1 m behind the pivot: a push to the left there turns clockwise.
    assert (found.fx, found.fy, found.mz) == pytest.approx((0.0, 2.0, -0.2))


def test_height_and_tilt_return_slowly() -> None:
    where = plane()
    high = state(where, 0.0, 0.0, 0.0)
    lifted = RobotState(0.0, high.position + 0.002 * UP, high.rotation, high.twist, high.wrench)
    velocity = where.velocity(Twist(0.0, 0.0, 0.0), lifted)
    assert velocity[:3] == pytest.approx([0.0, 0.0, -0.002], abs=1e-9)


@pytest.mark.parametrize(
    ("points", "says"),
    [
        ((ORIGIN, LEFT, IN), "mirrored"),
        ((ORIGIN, IN, 2 * ORIGIN - LEFT), "mirrored"),
        ((ORIGIN, ORIGIN + 0.01, LEFT), "mm apart"),
        ((ORIGIN, IN, IN + 0.1 * UP), "not 90"),
        ((ORIGIN, IN, ORIGIN + np.array([0.2, 0.0, 0.3])), "lean"),
    ],
)
def test_points_that_make_no_frame(points: tuple[np.ndarray, ...], says: str) -> None:
    with pytest.raises(FrameError, match=says):
        frame_from_points(*points, UP)
