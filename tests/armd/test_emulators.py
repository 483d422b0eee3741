"""The robots of `make arms` start wherever the whole suite runs; what they do takes real time."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest


@pytest.mark.parametrize("driver", ["ur", "xarm", "flexiv"])
def test_emulated_robot_starts_and_answers(robot: Callable[[str], Any], driver: str) -> None:
    made = robot(driver)
    assert made.fault("mark") >= 0.0
    assert all(row[3] == 0.0 for row in made.truth())
