"""Earth's field, gradient, temperature and the scripted turn."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim_device.skin.environment import (
    Environment,
    EnvironmentParameters,
    parse_rotation,
    rotation_about,
)

UNIFORM = EnvironmentParameters(gradient_ut_per_m=0.0)


@given(
    st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda v: np.linalg.norm(v) > 0.1),
    st.floats(-10, 10),
)
@settings(max_examples=40, deadline=None)
def test_turning_preserves_the_earth_field_magnitude(axis: tuple[float, ...], angle: float) -> None:
    turn = rotation_about(np.array(axis) / np.linalg.norm(axis), angle)
    field = Environment(UNIFORM).at(0.0, turn).field_ut(np.zeros((1, 3)))[0]
    assert np.linalg.norm(field) == pytest.approx(50.0)
    world = Environment(UNIFORM).at(0.0).field_ut(np.zeros((1, 3)))[0]
    assert turn @ field == pytest.approx(world, abs=1e-9)


def test_field_points_north_and_down() -> None:
    field = Environment(UNIFORM).at(0.0).field_ut(np.zeros((1, 3)))[0]
    assert field == pytest.approx([25.0, 0.0, -50 * math.sin(math.radians(60))])


def test_gradient_field_has_no_sources() -> None:
    surroundings = Environment(EnvironmentParameters(field_ut=0, gradient_ut_per_m=30)).at(0.0)
    gradient = surroundings.field_ut(np.eye(3)).T
    assert np.trace(gradient) == pytest.approx(0)
    assert gradient == pytest.approx(gradient.T)
    assert gradient[0, 0] == pytest.approx(30)


def test_gradient_stays_in_the_world_when_the_skin_turns() -> None:
    environment = Environment(EnvironmentParameters(field_ut=0, gradient_ut_per_m=30))
    quarter = rotation_about(np.array([0, 0, 1.0]), math.pi / 2)
    # The end-effector's x now points along world y, where the gradient is -15 µT/m.
    field = environment.at(0.0, quarter).field_ut(np.array([[1.0, 0, 0]]))[0]
    assert field == pytest.approx([-15, 0, 0])


def test_board_temperature_rises() -> None:
    environment = Environment()
    assert environment.at(0).temperature_c == pytest.approx(23)
    assert environment.at(300).temperature_c == pytest.approx(23 + 4 * (1 - math.exp(-1)))


def test_temperature_may_be_scripted() -> None:
    environment = Environment(temperature=lambda seconds: 20 + 2 * seconds)
    assert environment.at(10).temperature_c == 40


@pytest.mark.parametrize(
    ("text", "seconds", "axis", "degrees"),
    [
        ("90deg/10s", 10, (0, 0, 1), 90),
        ("90deg/10s", 5, (0, 0, 1), 45),
        ("90deg/s", 1, (0, 0, 1), 90),
        ("0.5rad/2s@y", 2, (0, 1, 0), math.degrees(0.5)),
        (" -90 deg / 10 s @ x ", 10, (1, 0, 0), -90),
        ("360deg/20s@1,1,0", 5, (math.sqrt(0.5), math.sqrt(0.5), 0), 90),
        ("1e1deg/1s", 1, (0, 0, 1), 10),
    ],
)
def test_rotation_script_is_followed(
    text: str, seconds: float, axis: tuple[float, ...], degrees: float
) -> None:
    expected = rotation_about(np.array(axis), math.radians(degrees))
    assert parse_rotation(text)(seconds) == pytest.approx(expected, abs=1e-12)
    assert parse_rotation(text)(0.0) == pytest.approx(np.eye(3))


@pytest.mark.parametrize(
    "text",
    [
        *("", "90", "90deg", "deg/10s", "90deg/0s", "90deg/-1s", "nandeg/1s", "90deg/10s@w"),
        *("90deg/10s@0,0,0", "90deg/10s@1,2", "1e999deg/1s", "90deg/1e999s", "90grad/10s"),
    ],
)
def test_bad_rotation_names_allowed_values(text: str) -> None:
    with pytest.raises(ValueError, match=r"rotation .*allowed.*90deg/10s"):
        parse_rotation(text)
