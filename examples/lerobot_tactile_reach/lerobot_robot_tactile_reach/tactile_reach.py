"""A robot that adds touch to the observations of another."""

from __future__ import annotations

import math
import time
from functools import cached_property
from typing import Any

from lerobot.robots import Robot
from lerobot.robots.utils import make_robot_from_config

from tactile_core.bus.messages import DecodeError, codec
from tactile_core.bus.session import BusConfig, close_session, open_session
from tactile_core.bus.streams import Latest, latest, list_alive
from tactile_core.bus.topics import FEATURES, FORCES

from .config_tactile_reach import TactileReachConfig

SUMS = ("valid", "normal_force", "peak_force", "tip_force", "fx", "fy", "fz", "mx", "my", "mz")


class Board:
    """Newest touch of one board by name of the observation; never waits."""

    def __init__(self, session: Any, name: str, taxels: int, max_age_s: float) -> None:
        self.keys = [f"{name}.{field}" for field in SUMS]
        self._taxel_keys = [f"{name}.taxel{i}.{axis}" for i in range(taxels) for axis in "xyz"]
        self._max_age_s = max_age_s
        self._features = _Newest(latest(session, FEATURES.key(name)), FEATURES)
        self._forces = _Newest(latest(session, FORCES.key(name)), FORCES) if taxels else None

    def read(self) -> dict[str, float]:
        """Return all observations; zeros where touch is missing, too old or not valid."""
        found = dict.fromkeys([*self.keys, *self._taxel_keys], 0.0)
        message = self._features.read(self._max_age_s)
        if message is None or not message.valid:
            return found
        force, torque = message.wrench.force, message.wrench.torque
        values = (
            1.0, message.normal_force, message.peak_force, message.tip_force,
            force.x, force.y, force.z, torque.x, torque.y, torque.z,
        )  # fmt: skip
        found.update(zip(self.keys, map(_finite, values), strict=True))
        taxels = None if self._forces is None else self._forces.read(self._max_age_s)
        if taxels is not None:
            if len(taxels.force) != len(self._taxel_keys):
                raise ValueError(
                    f"the board has {len(taxels.force) // 3} taxels, not "
                    f"{len(self._taxel_keys) // 3}: set boards accordingly"
                )
            found.update(zip(self._taxel_keys, map(_finite, taxels.force), strict=True))
        return found

    @property
    def heard(self) -> bool:
        """Whether a message has come on every stream that is read."""
        streams = [s for s in (self._features, self._forces) if s is not None]
        return all(stream.read(math.inf) is not None for stream in streams)


class _Newest:
    def __init__(self, stream: Latest, topic: Any) -> None:
        self.message: Any = None
        self._stream, self._topic = stream, topic
        self._came_s = -math.inf

    def read(self, max_age_s: float) -> Any:
        """Return the newest message; None when it came more than ``max_age_s`` ago."""
        sample = self._stream.newest()
        if sample is not None:
            try:
                self.message = codec().decode(self._topic, sample.data)
                self._came_s = time.monotonic()
            except DecodeError:  # from another version: treat it as missing
                pass
        return self.message if time.monotonic() - self._came_s <= max_age_s else None


def _finite(value: Any) -> float:
    number = float(value)
    return number if math.isfinite(number) else 0.0


class TactileReach(Robot):
    """Robot that wraps another: its observations and touch; its actions.

    Either may be used alone.
    """

    config_class = TactileReachConfig
    name = "tactile_reach"

    def __init__(self, config: TactileReachConfig) -> None:
        super().__init__(config)
        self.config = config
        self.robot = None if config.robot is None else make_robot_from_config(config.robot)
        self.cameras = {} if self.robot is None else getattr(self.robot, "cameras", {})
        self._session: Any = None
        self._boards: list[Board] = []

    @cached_property
    def observation_features(self) -> dict[str, Any]:
        """Type of each observation; touch is float."""
        features = {} if self.robot is None else dict(self.robot.observation_features)
        for name, taxels in self.config.boards.items():
            features |= {f"{name}.{field}": float for field in SUMS}
            features |= {f"{name}.taxel{i}.{a}": float for i in range(taxels) for a in "xyz"}
        return features

    @cached_property
    def action_features(self) -> dict[str, Any]:
        """Actions of the wrapped robot."""
        return {} if self.robot is None else self.robot.action_features

    @property
    def is_connected(self) -> bool:
        """Whether the bus is open, and the wrapped robot connected."""
        return self._session is not None and (self.robot is None or self.robot.is_connected)

    def connect(self, calibrate: bool = True) -> None:
        """Connect bus and robot.

        ConnectionError when a board does not come; it names the boards there are.
        """
        config = self.config
        self._session = open_session(
            BusConfig(listen=(), connect=tuple(config.connect) or None, keys=config.keys)
        )
        try:
            self._boards = [
                Board(self._session, name, taxels, config.max_age_s)
                for name, taxels in config.boards.items()
            ]
            for name, board in zip(config.boards, self._boards, strict=True):
                self._wait(name, board)
            if self.robot is not None:
                self.robot.connect(calibrate)
        except BaseException:  # also on Ctrl-C, the bus must be left
            self._leave()
            raise

    @property
    def is_calibrated(self) -> bool:
        """Whether the wrapped robot is calibrated.

        Boards are calibrated with `tactile calibrate`.
        """
        return self.robot is None or self.robot.is_calibrated

    def calibrate(self) -> None:
        """Calibrate the wrapped robot."""
        if self.robot is not None:
            self.robot.calibrate()

    def configure(self) -> None:
        """Configure the wrapped robot."""
        if self.robot is not None:
            self.robot.configure()

    def get_observation(self) -> dict[str, Any]:
        """Return the newest observations, without waiting for touch."""
        if self._session is None:
            raise ConnectionError(f"{self} is not connected: call connect() first")
        observation = {} if self.robot is None else dict(self.robot.get_observation())
        for board in self._boards:
            observation |= board.read()
        return observation

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        """Pass the action to the wrapped robot."""
        return {} if self.robot is None else self.robot.send_action(action)

    def disconnect(self) -> None:
        """Disconnect bus and robot."""
        if self.robot is not None and self.robot.is_connected:
            self.robot.disconnect()
        self._leave()

    def _wait(self, name: str, board: Board) -> None:
        deadline = time.monotonic() + self.config.wait_s
        while not board.heard:
            if time.monotonic() > deadline:
                there = ", ".join(list_alive(self._session, 0.5)) or "none"
                raise ConnectionError(
                    f"no features of board {name!r} came within {self.config.wait_s:g} s (boards "
                    f"on the bus: {there}): is tactiled running, and is this its --name?"
                )
            time.sleep(0.01)

    def _leave(self) -> None:
        self._boards = []
        if self._session is not None:
            close_session(self._session)
            self._session = None
