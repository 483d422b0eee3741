"""The examples that bring their own world run as they stand."""

from __future__ import annotations

import importlib.util
import os
import signal
import socket
import subprocess
import sys
import threading
from pathlib import Path
from types import ModuleType

import msgspec
import numpy as np
import pytest

from armd.config import ArmConfig
from armd.driver import Driver, RobotMode
from tests.support.paths import ROOT

EXAMPLES = ROOT / "examples"
SLOW_S = 120.0
TACTILE = str(Path(sys.executable).with_name("tactile"))


def test_own_strategy_reaches_in_lockstep(tmp_path: Path) -> None:
    words = ["reach", "--strategy", "my_strategy:Wiggle", "--seed", "7", "--headless"]
    done = subprocess.run(
        [TACTILE, *words], cwd=EXAMPLES, capture_output=True, text=True, timeout=SLOW_S,
        env=os.environ | {"PYTHONDONTWRITEBYTECODE": "1"},
    )  # fmt: skip
    assert done.returncode in (0, 1), done.stderr
    assert "Traceback" not in done.stderr


def test_the_cup_is_held(tmp_path: Path) -> None:
    said = tmp_path / "said.txt"
    with said.open("wb") as file:
        example = subprocess.Popen(
            [sys.executable, EXAMPLES / "hold_cup.py", "10"], stdout=file, stderr=file,
            env=os.environ | {"TACTILE_RUNTIME_DIR": str(tmp_path / "r")}, start_new_session=True,
        )  # fmt: skip
    try:
        status = example.wait(2 * SLOW_S)
    except subprocess.TimeoutExpired:
        os.killpg(example.pid, signal.SIGKILL)  # its tactiled, too
        pytest.fail(said.read_text())
    # A busy machine may delay the gripper so much that the cup slips.
    assert status in (0, 1), said.read_text()
    assert "300 g" in said.read_text()


def load(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_example_driver_moves_a_robot_that_speaks_its_protocol() -> None:
    module = load("arm_driver")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as robot:
        robot.bind(("127.0.0.1", 0))
        robot.settimeout(SLOW_S)
        table = {"address": "127.0.0.1", "port": robot.getsockname()[1]}
        config = msgspec.convert({"robot": table, "tool": {"payload": 0.5}}, ArmConfig)
        heard: list[str] = []

        def answer() -> None:
            for number in range(3):
                data, sender = robot.recvfrom(1024)
                heard.append(data.decode())
                mode = 1 if number < 2 else 0
                state = [number / 125, 0.4, 0.1, 0.3, *[0.0] * 15, mode]
                robot.sendto(" ".join(map(str, state)).encode(), sender)

        thread = threading.Thread(target=answer)
        thread.start()
        driver: Driver = module.ExampleDriver(config)
        driver._socket.settimeout(SLOW_S)  # a busy machine answers late
        driver.connect()
        driver.move(np.array([0.01, 0, 0, 0, 0, 0]))
        ready = driver.read()
        driver.halt()
        fault = driver.read()
        thread.join()
        driver.close()
    assert heard[1].split()[:2] == ["v", "0.010000"]
    assert ready is not None
    assert ready.position.tolist() == [0.4, 0.1, 0.3]
    assert ready.mode is RobotMode.READY
    assert fault is not None
    assert fault.mode is RobotMode.FAULT


def test_the_grip_follows_the_shear() -> None:
    module = load("hold_cup")
    control = module.GripControl()
    grip = control.least
    for step in range(1000):
        shear = 0.3 + 1.2 * min(step / 600, 1.0)
        grip = control.step(normal=grip, shear=shear, bound=0.1, dt=0.01)
        assert step < 100 or shear <= module.FRICTION * grip
    assert grip == pytest.approx(1.3 * 1.6 / 0.45, rel=0.05)
