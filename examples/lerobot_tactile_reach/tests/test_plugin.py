"""The plugin as LeRobot finds, makes and uses it; needs LeRobot and this package installed."""

from __future__ import annotations

import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

pytest.importorskip("lerobot", reason="needs lerobot")
pytest.importorskip("lerobot_robot_tactile_reach", reason="needs pip install of this package")

from lerobot.robots import Robot, RobotConfig
from lerobot.robots.utils import make_robot_from_config
from lerobot.utils.import_utils import register_third_party_plugins
from lerobot_robot_tactile_reach import TactileReach, TactileReachConfig

from tactile_core.bus.messages import MSG, codec, header
from tactile_core.bus.session import BusConfig, close_session, open_session
from tactile_core.bus.streams import declare_alive, declare_publisher
from tactile_core.bus.topics import FEATURES, FORCES


class Skin:
    """A tactiled with one board ``left`` of two taxels, 100 messages a second."""

    def __init__(self) -> None:
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self.endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
        self.force = 1.5
        self.valid = True
        self.session = open_session(BusConfig(role="tactiled", listen=(self.endpoint,), connect=()))
        self._alive = declare_alive(self.session, "left")
        self._publishers = [declare_publisher(self.session, t, "left") for t in (FEATURES, FORCES)]
        self.stopping = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def close(self) -> None:
        self.stopping.set()
        self._thread.join()
        close_session(self.session)

    def _run(self) -> None:
        while not self.stopping.wait(0.01):
            vector = MSG.Vector3(0.0, 0.0, -self.force)
            features = MSG.ContactFeatures(
                header=header(0, "ee"), captured_ns=0, received_ns=0, uncertainty=0.0, sequence=0,
                valid=self.valid, reasons=[], calibrated=True, peak_force=self.force, peak_side=3,
                peak_position=MSG.Point(0.0, 0.0, 0.0), normal_force=2 * self.force,
                wrench=MSG.Wrench(vector, MSG.Vector3(0.0, 0.0, 0.0)), tip_force=0.0,
                tip_contact_time=0.0, taxels_in_contact=1, taxels_masked=0, patches=[],
                reason_codes=[], peak_force_bound=0.1, normal_force_bound=0.1, tip_force_bound=0.1,
            )  # fmt: skip
            forces = MSG.TaxelForces(
                header=header(0, "ee"), captured_ns=0, received_ns=0, uncertainty=0.0, sequence=0,
                array_taxels=np.array([2], np.uint16),
                force=np.array([0, 0, -self.force, 0, np.nan, -self.force], np.float32),
                status=np.zeros(2, np.uint8), compensated=True, calibrated=True,
                normal_bound=np.zeros(2, np.float32),
            )  # fmt: skip
            for publisher, topic, message in zip(
                self._publishers, (FEATURES, FORCES), (features, forces), strict=True
            ):
                publisher.put(codec().encode(topic, message), 0)


@RobotConfig.register_subclass("still_arm")
@dataclass(kw_only=True)
class StillArmConfig(RobotConfig):
    """An arm of one joint."""


class StillArm(Robot):
    config_class = StillArmConfig
    name = "still_arm"
    observation_features = {"joint.pos": float}
    action_features = {"joint.pos": float}
    is_calibrated = True
    is_connected = False

    def __init__(self, config: StillArmConfig) -> None:
        super().__init__(config)
        self.joint = 0.25

    def connect(self, calibrate: bool = True) -> None:
        self.is_connected = True

    def calibrate(self) -> None: ...

    def configure(self) -> None: ...

    def get_observation(self) -> dict[str, Any]:
        return {"joint.pos": self.joint}

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        self.joint = action["joint.pos"]
        return action

    def disconnect(self) -> None:
        self.is_connected = False


@pytest.fixture
def skin(tmp_path: Any) -> Iterator[Skin]:
    made = Skin()
    yield made
    made.close()


def config(skin: Skin, **options: Any) -> TactileReachConfig:
    return TactileReachConfig(boards={"left": 2}, connect=[skin.endpoint], **options)


def test_lerobot_finds_it_by_the_name_of_its_distribution() -> None:
    code = (
        "from lerobot.utils.import_utils import register_third_party_plugins as r\n"
        "from lerobot.robots import RobotConfig\nr()\n"
        "print('tactile_reach' in RobotConfig.get_known_choices())"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "True"
    register_third_party_plugins()


def test_lerobots_factory_makes_it_and_its_observations_are_as_declared(skin: Skin) -> None:
    robot = make_robot_from_config(config(skin))
    assert isinstance(robot, TactileReach)
    declared = robot.observation_features
    robot.connect()
    observation = robot.get_observation()
    robot.disconnect()
    assert observation.keys() == declared.keys()
    assert all(isinstance(observation[key], kind) for key, kind in declared.items())
    assert observation["left.valid"] == 1.0
    assert observation["left.normal_force"] == 3.0
    assert observation["left.fz"] == -1.5
    assert observation["left.taxel0.z"] == -1.5
    assert observation["left.taxel1.y"] == 0.0  # NaN: masked
    assert not robot.is_connected


def test_touch_that_is_not_valid_or_old_reads_zero(skin: Skin) -> None:
    robot = TactileReach(config(skin, max_age_s=0.3))
    robot.connect()
    skin.valid = False
    while robot.get_observation()["left.valid"]:
        pass
    assert robot.get_observation()["left.normal_force"] == 0.0
    skin.valid = True
    while not robot.get_observation()["left.valid"]:
        pass
    skin.stopping.set()
    while robot.get_observation()["left.valid"]:
        pass
    assert robot.get_observation()["left.taxel0.z"] == 0.0
    robot.disconnect()


def test_another_robot_is_wrapped(skin: Skin) -> None:
    wrapped = config(skin)
    robot = TactileReach(wrapped)
    robot.robot = StillArm(StillArmConfig(id="arm"))
    assert {"joint.pos", "left.valid"} <= robot.observation_features.keys()
    assert robot.action_features == {"joint.pos": float}
    robot.connect()
    assert robot.is_connected
    robot.send_action({"joint.pos": 0.5})
    observation = robot.get_observation()
    assert (observation["joint.pos"], observation["left.valid"]) == (0.5, 1.0)
    robot.disconnect()
    assert not robot.robot.is_connected


def test_wrong_name_lists_the_boards_there_are(skin: Skin) -> None:
    wrong = TactileReachConfig(boards={"right": 0}, connect=[skin.endpoint], wait_s=0.5)
    with pytest.raises(ConnectionError, match=r"'right'.*boards on the bus: left"):
        TactileReach(wrong).connect()


def test_no_boards_are_refused() -> None:
    with pytest.raises(ValueError, match="boards is empty"):
        TactileReachConfig()


def test_wrong_number_of_taxels_is_told(skin: Skin) -> None:
    robot = TactileReach(TactileReachConfig(boards={"left": 5}, connect=[skin.endpoint]))
    robot.connect()

    def until_touched() -> None:
        while True:
            robot.get_observation()

    with pytest.raises(ValueError, match="has 2 taxels, not 5"):
        until_touched()
    robot.disconnect()
