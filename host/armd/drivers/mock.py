"""A robot without hardware, inside armd itself: for trying out the bus, frames and configuration.

It moves as it is told, in free air, and dies with this process. What it says of safety counts for
nothing; `simdevice ur` is a robot of its own.
"""

from __future__ import annotations

import threading
import time

import numpy as np

from armd.config import ArmConfig
from armd.driver import Float, RobotFacts, RobotState
from armd.frames import Transform, frame_from_points, rotation_matrix
from tactile_core.types import ArmLimits

START_X = -0.158
"""m: pivot of a finger whose tip stands at the front edge."""


class MockDriver:
    """See `armd.driver.Driver`."""

    rate = 125.0
    holds = 0.05
    note = "a mock: there is not any robot"

    def __init__(self, config: ArmConfig) -> None:
        self.braking = config.robot.acceleration
        self._tool = config.tool
        frame = config.frame
        cupboard = Transform(np.zeros(3), np.eye(3))
        if frame is not None:
            points = (frame.origin, frame.inside, frame.left, frame.up)
            cupboard = frame_from_points(*(np.array(p, dtype=np.float64) for p in points))
        start = cupboard @ Transform(np.array([START_X, 0.0, 0.0]), np.eye(3))
        tool = start @ config.pivot.inverse()
        self._position, self._rotation = tool.position, tool.rotation
        self._twist = np.zeros(6)
        self._target = np.zeros(6)
        self._until = 0.0
        self._at = time.monotonic()
        self._lock = threading.Lock()

    def connect(self) -> RobotFacts:
        """It is there."""
        tool = self._tool
        return RobotFacts(
            "mock robot",
            tool_position=np.array(tool.position),
            tool_rotation=np.array(tool.rotation),
            payload=tool.payload,
        )

    def read(self) -> RobotState | None:
        """Its state, 125 times a second."""
        time.sleep(1 / self.rate)
        with self._lock:
            now = time.monotonic()
            self._advance(now)
            return RobotState(
                now, self._position.copy(), self._rotation.copy(), self._twist.copy(), np.zeros(6)
            )

    def move(self, velocity: Float) -> None:
        """Move so for `holds` s."""
        with self._lock:
            now = time.monotonic()
            self._advance(now)
            self._target, self._until = velocity, now + self.holds

    def halt(self) -> None:
        """Brake."""
        self.move(np.zeros(6))

    def limit(self, limits: ArmLimits) -> None:
        """Leave it to armd."""

    def recover(self) -> None:
        """There is nothing to recover."""

    def zero_force(self) -> None:
        """It feels nothing."""

    def close(self) -> None:
        """Nothing to let go of."""

    def _advance(self, now: float) -> None:
        while self._at < now:
            dt = min(now - self._at, 0.002)
            target = self._target if self._at < self._until else np.zeros(6)
            change = target - self._twist
            size = float(np.linalg.norm(change[:3]))
            step = self.braking * dt
            self._twist = self._twist + change * (1.0 if size <= step else step / size)
            self._position = self._position + self._twist[:3] * dt
            self._rotation = rotation_matrix(self._twist[3:] * dt) @ self._rotation
            self._at += dt
