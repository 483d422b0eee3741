"""Twists from ROS move a simulated arm through reachd and its gate: four real processes."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from reachd.strategies.parameters import parameters
from sim_device.world.scenes import Pose, Scene
from tactile_core.bus.messages import MSG, codec, header
from tactile_core.bus.services import NoAnswerError, ServiceError, call
from tactile_core.bus.session import BusConfig, close_session, open_session
from tactile_core.bus.streams import latest
from tactile_core.bus.topics import REACH_STATE, service_key
from tactile_tools.ros2.follow import WANTED, FollowTwist, planar_twist
from tactile_tools.ros2.names import dds_type
from tests.support.reachd_lab import patient_config
from tests.support.tactiled_lab import CALM_HZ


def start(folder: Path, name: str, *words: str) -> subprocess.Popen[bytes]:
    environment = os.environ | {"TACTILE_RUNTIME_DIR": str(folder)}
    with (folder / f"{name}.txt").open("wb") as output:
        return subprocess.Popen(
            [Path(sys.executable).with_name(name), *words],
            stdout=output, stderr=subprocess.STDOUT, cwd=folder, env=environment,
        )  # fmt: skip


@pytest.fixture
def rig(tmp_path: Path, router: Any) -> Iterator[Path]:
    scene = Scene("test", "authors_sim", 1, 0.375, 0.55, Pose(-0.2, 0.0, 0.0), (0.05, 0.0), ())
    (tmp_path / "empty.json").write_text(scene.to_json())
    board = ("--pty", "board0", "--rate", CALM_HZ, "--engine", "planar")
    running = [start(tmp_path, "simdevice", "cupboard", "--scene", "empty.json", *board)]
    done = start(tmp_path, "simdevice", "calibration", "--out", "board0.cal.toml")
    assert done.wait(120) == 0
    words = ("--port", "board0", "--name", "board0", "--calibration", "board0.cal.toml")
    running.append(start(tmp_path, "tactiled", *words, "--wait", "--no-log"))
    strategy = "tactile_tools.ros2.follow:FollowTwist"
    reachd = ("--strategy", strategy, "--no-log", "--wait", "60", *patient_config(tmp_path))
    running.append(start(tmp_path, "reachd", *reachd))
    bridge = ("--router", router.endpoint, "--accept", "twist", "--accept", "goals")
    running.append(start(tmp_path, "tactile", "ros2", "bridge", *bridge))
    yield tmp_path
    for process in running:
        process.terminate()
    for process in running:
        try:
            process.wait(120)
        except subprocess.TimeoutExpired:
            process.kill()


def said(folder: Path) -> str:
    return "\n".join(f"{p.name}: {p.read_text()[-600:]}" for p in sorted(folder.glob("*.txt")))


def test_a_ros_controller_reaches_the_goal(
    rig: Path, peer: Any, wait: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TACTILE_RUNTIME_DIR", str(rig))
    session = open_session(BusConfig())
    reach = latest(session, REACH_STATE.key("reach"))

    def ask(service: str, payload: object = None) -> Any:
        try:
            return call(session, service_key("reach", service, "reach"), payload, 2.0)
        except (NoAnswerError, ServiceError) as error:
            print(error)
            return None

    def put(topic: str, message: Any) -> None:
        msgtype = message.__msgtype__
        key = f"0/{topic}/{dds_type(msgtype)}/{codec().schema(msgtype).type_hash}"
        peer.session.put(key, codec().encode(msgtype, message))

    wait(lambda: ask("arm"), 120)
    pose = MSG.Pose(MSG.Point(0.05, 0.0, 0.0), MSG.Quaternion(0.0, 0.0, 0.0, 1.0))
    state: dict[str, Any] = {"seen": set(), "activity": set()}
    ahead = MSG.Twist(MSG.Vector3(0.2, 0.0, 0.0), MSG.Vector3(0.0, 0.0, 0.0))
    asked = 0

    def reached() -> Any:
        nonlocal asked
        asked += 1
        if asked % 100 == 1 and "reaching" not in state["seen"]:
            put("reach/reach/goal", MSG.PoseStamped(header(0, "cupboard"), pose))
        put("reference/reach/twist", MSG.TwistStamped(header(0, "cupboard"), ahead))
        sample = reach.newest()
        if sample is not None:
            message = codec().decode(REACH_STATE, sample.data)
            state["seen"].add(message.state)
            state["activity"].add(message.activity)
            speed = np.hypot(message.commanded.linear.x, message.commanded.linear.y)
            # Four times the limit was asked for.
            assert speed <= parameters("authors_sim").safety.speed + 1e-9
        status = ask("status") if asked % 50 == 0 else None
        return status and (status.get("outcome") or {}).get("success") is not None and status

    status = wait(reached, 120)
    close_session(session)
    assert status["outcome"]["success"], (status, said(rig))
    assert "follow" in state["activity"]


def test_without_reachd_it_says_what_it_needs() -> None:
    strategy = FollowTwist(parameters("authors_sim"), np.random.default_rng(0))
    monkey = pytest.MonkeyPatch()
    monkey.setattr("tactile_tools.ros2.follow.open_sessions", list)
    with pytest.raises(RuntimeError, match="needs the bus of reachd"):
        strategy.start(None, 0)  # type: ignore[arg-type]
    monkey.undo()


@pytest.mark.parametrize(
    ("frame", "z", "x"), [("map", 0.0, 0.1), ("", 0.1, 0.1), ("", 0.0, float("inf"))]
)
def test_twist_that_is_not_finite_or_planar_is_not_followed(frame: str, z: float, x: float) -> None:
    linear, angular = MSG.Vector3(x, 0.0, z), MSG.Vector3(0.0, 0.0, 0.0)
    message = MSG.TwistStamped(header(0, frame), MSG.Twist(linear, angular))
    assert codec().encode(WANTED, message)
    assert planar_twist(message) is None
