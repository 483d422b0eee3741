"""The driver of the paper's arm, against a fake module; and the fake against the vendor's wheel."""

from __future__ import annotations

import importlib.util
import inspect
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from armd.config import ArmConfig, RobotTable, ToolTable, check_facts
from armd.driver import RobotMode
from tactile_core.types import ArmLimits

FAKE = Path(__file__).with_name("flexiv") / "flexivrdk_fake.py"


def fake_module() -> ModuleType:
    spec = importlib.util.spec_from_file_location("flexivrdk_fake", FAKE)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


CONFIG = ArmConfig(
    robot=RobotTable(address="Rizon4-123456"), tool=ToolTable(payload=0.8, position=(0, 0, 0.1))
)


@pytest.fixture
def driver(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    monkeypatch.setitem(sys.modules, "flexivrdk", fake_module())
    monkeypatch.delitem(sys.modules, "armd.drivers.flexiv", raising=False)
    from armd.drivers.flexiv import FlexivDriver

    made = FlexivDriver(CONFIG)
    assert check_facts(CONFIG, made.connect()) == []
    yield made
    made.close()
    sys.modules.pop("armd.drivers.flexiv", None)


def test_a_velocity_is_a_pose_at_most_a_tenth_of_a_second_ahead(driver: Any) -> None:
    state = driver.read()
    driver.move(np.array([0.03, 0.0, -0.04, 0.0, 0.0, 0.2]))
    sent = driver._robot.sent[-1]
    assert np.array(sent.pose_d[:3]) - state.position == pytest.approx([0.003, 0.0, -0.004])
    assert sent.max_linear_vel == pytest.approx(0.05)
    assert 2 * np.arcsin(sent.pose_d[6]) == pytest.approx(0.02)


def test_rest_is_the_present_pose_with_limits_above_zero(driver: Any) -> None:
    state = driver.read()
    driver.move(np.array([0.03, 0.0, 0.0, 0.0, 0.0, 0.0]))
    driver.halt()
    driver.halt()
    assert len(driver._robot.sent) == 2, "once is enough"
    assert driver._robot.sent[-1].pose_d[:3] == pytest.approx(state.position.tolist())


def test_rest_is_the_last_pose_that_was_finite(driver: Any) -> None:
    state = driver.read()
    driver._robot._states.tcp_pose = [float("nan")] * 7
    driver.read()
    driver.move(np.array([0.03, 0.0, 0.0, 0.0, 0.0, 0.0]))
    driver.halt()
    assert driver._robot.sent[-1].pose_d[:3] == pytest.approx(state.position.tolist())


def test_force_is_zeroed_and_bounded_at_the_robot(driver: Any) -> None:
    driver.zero_force()
    driver.limit(ArmLimits(0.045, 0.1, 10.0, 4.5))
    assert driver._robot.did == ["ServoOn", "ZeroFTSensor"]
    assert driver._robot.wrench == [10.0] * 3 + [4.5] * 3


def test_modes(driver: Any) -> None:
    robot = driver._robot
    assert driver.read().mode is RobotMode.READY
    robot.faulty = True
    assert driver.read().mode is RobotMode.FAULT
    robot.pressed = True
    assert driver.read().mode is RobotMode.ESTOP
    robot.pressed = False
    driver.recover()
    assert driver.read().mode is RobotMode.READY
    robot.Stop()
    assert driver.read().mode is RobotMode.STOPPED


def test_the_fake_is_like_the_vendors_wheel() -> None:
    real = pytest.importorskip("flexivrdk", reason="flexivrdk (Python 3.12) is not installed")
    fake = fake_module()
    for name, kind in inspect.getmembers(fake, inspect.isclass):
        if kind.__module__ != fake.__name__:
            continue
        theirs = getattr(real, name)
        for method, function in inspect.getmembers(kind, inspect.isfunction):
            if method.startswith("_") and method != "__init__":
                continue
            said = getattr(theirs, method).__doc__ or ""
            for argument in list(inspect.signature(function).parameters)[1:]:
                assert f"{argument}:" in said or method == "__init__", (name, method, argument)
    for group in fake.RobotStates().__dict__:
        assert hasattr(real.RobotStates, group)
