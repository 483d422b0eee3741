"""A driver for armd, whole: a robot of one's own that takes velocities over UDP.

Copy it to ``armd/drivers``, add a line to ``catalogue.DRIVERS``, and run the tests of ``arms``
with it. The robot here answers each datagram ``v vx vy vz wx wy wz`` (m/s, rad/s, base) with its
state, and rests by itself 50 ms after the last one: whatever does not do that by itself needs a
watchdog first.
"""

from __future__ import annotations

import socket
import time

import numpy as np

from armd.config import ArmConfig
from armd.driver import DriverError, Float, RobotFacts, RobotMode, RobotState
from armd.frames import rotation_matrix
from tactile_core.types import ArmLimits

PORT = 4711
NUMBERS = 20  # s; position, rotation vector; twist; wrench; 1 while it may move


class ExampleDriver:
    """See `armd.driver.Driver`."""

    rate = 125.0
    holds = 0.05
    note = "an example: there is not any robot"

    def __init__(self, config: ArmConfig) -> None:
        self.braking = config.robot.acceleration
        self._address = (config.robot.address, PORT)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.settimeout(0.02)

    def connect(self) -> RobotFacts:
        """Look whether it answers; say what it says of itself, None for what it does not."""
        self.move(np.zeros(6))
        if self.read() is None:
            raise DriverError(
                f"no robot at {self._address[0]}:{PORT}: look at [robot] address and its cable"
            )
        return RobotFacts(f"example at {self._address[0]}")

    def read(self) -> RobotState | None:
        """The newest state, None when there is not a newer one within 20 ms."""
        try:
            data, _ = self._socket.recvfrom(1024)
            numbers = np.array(data.split(), dtype=np.float64)
        except (TimeoutError, ValueError):
            return None
        except OSError as error:
            raise DriverError(f"the robot cannot be heard: {error}") from error
        if numbers.size != NUMBERS:
            return None
        ready = numbers[19] == 1.0
        return RobotState(
            float(numbers[0]),
            numbers[1:4],
            rotation_matrix(numbers[4:7]),
            numbers[7:13],
            numbers[13:19],
            RobotMode.READY if ready else RobotMode.FAULT,
            "" if ready else "it stopped: look what it met",
        )

    def move(self, velocity: Float) -> None:
        """Without waiting for an answer."""
        words = " ".join(f"{v:.6f}" for v in velocity)
        try:
            self._socket.sendto(f"v {words}".encode(), self._address)
        except OSError as error:
            raise DriverError(f"the robot cannot be told: {error}") from error

    def halt(self) -> None:
        """Rest at once."""
        self.move(np.zeros(6))

    def limit(self, limits: ArmLimits) -> None:
        """It has none of its own: armd keeps them."""

    def recover(self) -> None:
        """Because an operator asked for it."""
        self._socket.sendto(b"recover", self._address)
        time.sleep(0.1)

    def zero_force(self) -> None:
        """Take the present wrench for none."""
        self._socket.sendto(b"zero", self._address)

    def close(self) -> None:
        """Rest and let go."""
        self.halt()
        self._socket.close()
