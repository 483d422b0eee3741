"""A complete driver for armd: a robot of your own that takes velocities over UDP.

Copy it to ``armd/drivers``, add a line to ``catalogue.DRIVERS``, and run the tests in
``tests/armd`` with it. This robot answers each datagram ``v vx vy vz wx wy wz`` (m/s, rad/s, base
frame) with its state, and comes to rest by itself 50 ms after the last one. A robot that does not
do that by itself needs a watchdog first.
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
NUMBERS = 20  # time s; position, rotation vector; twist; wrench; 1 if it may move


class ExampleDriver:
    """Implements `armd.driver.Driver`, which describes its methods."""

    rate = 125.0
    holds = 0.05
    note = "an example: no such robot exists"

    def __init__(self, config: ArmConfig) -> None:
        self.braking = config.robot.acceleration
        self._address = (config.robot.address, config.robot.port or PORT)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.settimeout(0.02)

    def connect(self) -> RobotFacts:
        """Check that the robot answers.

        It says nothing about its tool, so those facts stay None.
        """
        self.move(np.zeros(6))
        if self.read() is None:
            raise DriverError(
                "no robot at {}:{}: check [robot] address and the cable".format(*self._address)
            )
        return RobotFacts(f"example at {self._address[0]}")

    def read(self) -> RobotState | None:
        """Return the newest state; None if no new one comes within 20 ms."""
        try:
            data, _ = self._socket.recvfrom(1024)
            numbers = np.array(data.split(), dtype=np.float64)
        except (TimeoutError, ValueError):
            return None
        except OSError as error:
            raise DriverError(f"the robot cannot be read: {error}") from error
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
            "" if ready else "it stopped: see what it met",
        )

    def move(self, velocity: Float) -> None:
        """Send a velocity without waiting for an answer."""
        words = " ".join(f"{v:.6f}" for v in velocity)
        try:
            self._socket.sendto(f"v {words}".encode(), self._address)
        except OSError as error:
            raise DriverError(f"the robot cannot be commanded: {error}") from error

    def halt(self) -> None:
        """Come to rest at once."""
        self.move(np.zeros(6))

    def limit(self, limits: ArmLimits) -> None:
        """Nothing to do: the robot has no limits of its own, and armd keeps them."""

    def recover(self) -> None:
        """Clear a stop, because an operator asked for it."""
        self._socket.sendto(b"recover", self._address)
        time.sleep(0.1)

    def zero_force(self) -> None:
        """Take the present wrench as zero."""
        self._socket.sendto(b"zero", self._address)

    def close(self) -> None:
        """Come to rest and close the socket."""
        self.halt()
        self._socket.close()
