"""UFACTORY xArm 5, 6, 7 and 850 through the vendor's SDK.

Every command of the SDK is a round trip (p99 16 ms), so states come from the "real" report, which
the controller sends by itself: pose, state and mode, and from byte 87 on the force of the sensor in
the wrist, an accessory. It has no time stamp and no velocity: states are stamped on arrival, and
the twist is taken from the last poses. A velocity holds for `duration`, in the controller; after
that the arm brakes by itself, whatever becomes of this process.
"""

from __future__ import annotations

import contextlib
import logging
import math
import queue
import socket
import time
from collections import deque
from typing import Any, Final

import numpy as np
from xarm.core.config.x_config import XCONF
from xarm.wrapper import XArmAPI

from armd.config import ArmConfig
from armd.driver import DriverError, Float, RobotFacts, RobotMode, RobotState
from armd.frames import rotation_matrix, rotation_vector
from tactile_core.types import ArmLimits

REPORT_PORT: Final = 30003
PROBE: Final = 2.0
HOLD: Final = 0.05
"""s that a velocity holds: commands come every 10 ms, and rest is due after 0.1 s."""

PATIENCE: Final = 0.02
VELOCITY_MODE: Final = 5
SAME: Final = 0.04
"""s of one pose, to the last bit, in motion. The SDK puts the last pose in place of NaN."""

SLOW: Final = 0.005
"""m/s below which a pose may stay the same."""

STOPPED: Final = (3, 4, 5)
"""States in which the controller takes no velocities: paused, stopped, stopping."""

OVER: Final = 4
"""Poses over which the twist is taken."""

EMERGENCY: Final = frozenset({1, 2})
"""Error codes of the button at the control box and of the three-state switch."""


class XarmDriver:
    """See `armd.driver.Driver`."""

    holds = HOLD
    note = (
        "proven against a fake of the controller with the vendor's own SDK; never moved on a real "
        "robot, see docs/arm.md"
    )

    def __init__(self, config: ArmConfig) -> None:
        self._robot = config.robot
        self.rate = 100.0
        self.braking = config.robot.acceleration
        self._arm: Any = None
        self._reports: queue.Queue[tuple[float, list[float], int, list[float]]] = queue.Queue(64)
        self._recent: deque[tuple[float, Float, Float]] = deque(maxlen=OVER)
        self._state = 0
        self._error: int | None = None
        self._pose: list[float] = []
        self._changed = 0.0
        self._told = math.inf  # since when it is told to move
        self._resting = False

    def connect(self) -> RobotFacts:
        """Connect, set the mode of Cartesian velocities, and ask for nothing else."""
        address = self._robot.address
        if self._robot.port is not None:
            XCONF.SocketConf.TCP_CONTROL_PORT = self._robot.port
        control = XCONF.SocketConf.TCP_CONTROL_PORT
        for port in (control, REPORT_PORT):
            _probe(address, port)
        logging.getLogger("xarm").setLevel(logging.ERROR)
        try:
            self._arm = XArmAPI(
                address, is_radian=True, report_type="real", check_joint_limit=False
            )
            self._arm.register_report_callback(self._take, report_cartesian=True)
            code, found = self._arm.get_err_warn_code()
            if code != 0 or found[0] != 0:
                raise DriverError(
                    f"the robot at {address} has error {found[0]}: clear it in its own studio first"
                )
            self._enable()
        except DriverError:
            raise
        except Exception as error:  # its SDK raises bare exceptions
            raise DriverError(
                f"the controller at {address} does not answer as an xArm ({error}): look at "
                "[robot] address, and that no other program commands it"
            ) from error
        return RobotFacts(f"xArm {self._arm.axis} at {address}, {self._arm.version}")

    def read(self) -> RobotState | None:
        """The next report."""
        try:
            at, pose, state, force = self._reports.get(timeout=PATIENCE)
        except queue.Empty:
            return None
        while True:  # only the newest counts
            try:
                at, pose, state, force = self._reports.get_nowait()
            except queue.Empty:
                break
        self._state = state
        position = np.array(pose[:3]) * 1e-3
        roll, pitch, yaw = pose[3:6]
        rotation = (
            rotation_matrix(np.array([0.0, 0.0, yaw]))
            @ rotation_matrix(np.array([0.0, pitch, 0.0]))
            @ rotation_matrix(np.array([roll, 0.0, 0.0]))
            if all(map(math.isfinite, pose))
            else np.full((3, 3), math.nan)
        )
        mode, detail = self._mode(state)
        if pose != self._pose or time.monotonic() - self._told < SAME:
            self._pose, self._changed = pose, at
        elif at - self._changed > SAME:
            self._changed = at
            raise DriverError("the robot is told to move and reports one pose over and over")
        local = np.array(force)
        wrench = np.concatenate([rotation @ local[:3], rotation @ local[3:]])
        return RobotState(
            at, position, rotation, self._twist(at, position, rotation), wrench, mode, detail
        )

    def move(self, velocity: Float) -> None:
        """A velocity in mm/s and rad/s that dies after `HOLD`."""
        self._resting = False
        self._send(velocity)

    def halt(self) -> None:
        """Velocity zero, once: what was told before dies by itself."""
        if not self._resting:
            self._send(np.zeros(6))
            self._resting = True

    def limit(self, limits: ArmLimits) -> None:
        """Kept by armd: the controller's reduced mode asks for a stop to change it."""

    def recover(self) -> None:
        """Clear the error and enable motion again."""
        arm = self._arm
        arm.clean_error()
        arm.clean_warn()
        code, found = arm.get_err_warn_code()
        if code != 0 or found[0] != 0:
            raise DriverError(
                f"the robot keeps error {found[0]}: release its button, look what it met"
            )
        self._enable()

    def zero_force(self) -> None:
        """Zero the sensor in the wrist; without the accessory nothing is felt."""
        self._arm.ft_sensor_enable(1)
        self._arm.ft_sensor_set_zero()

    def close(self) -> None:
        """Rest, and disconnect."""
        if self._arm is not None:
            with contextlib.suppress(Exception):
                self._arm.set_state(4)
            self._arm.disconnect()

    def _enable(self) -> None:
        arm = self._arm
        arm.motion_enable(enable=True)
        for what, code in (
            ("the mode of Cartesian velocities", arm.set_mode(VELOCITY_MODE)),
            ("motion", arm.set_state(0)),
        ):
            if code != 0:
                raise DriverError(f"the robot refuses {what} (code {code}): look at its studio")
        self._state = 2
        time.sleep(0.02)

    def _take(self, report: dict[str, Any]) -> None:
        """In the SDK's thread: keep the report, the oldest goes when nobody reads."""
        item = (
            time.monotonic(),
            list(report["cartesian"]),
            int(self._arm.state),
            list(self._arm.ft_ext_force),
        )
        while True:
            try:
                self._reports.put_nowait(item)
                return
            except queue.Full:
                with contextlib.suppress(queue.Empty):
                    self._reports.get_nowait()

    def _mode(self, state: int) -> tuple[RobotMode, str]:
        if state not in STOPPED:
            self._error = None
            return RobotMode.READY, ""
        if self._error is None:  # the report does not say it
            code, found = self._arm.get_err_warn_code()
            self._error = int(found[0]) if code >= 0 and found else 0
        error = self._error
        if error in EMERGENCY:
            return RobotMode.ESTOP, f"emergency stop (error {error}): release the button"
        if error:
            return RobotMode.FAULT, f"the robot stopped with error {error}: look what it met"
        return RobotMode.STOPPED, "the robot was stopped: another program, or its studio"

    def _twist(self, at: float, position: Float, rotation: Float) -> Float:
        recent = self._recent
        recent.append((at, position, rotation))
        begin, old, turned = recent[0]
        passed = at - begin
        if passed <= 0 or not np.isfinite(rotation).all():
            return np.zeros(6)
        angular = rotation_vector(rotation @ turned.T) / passed
        return np.concatenate([(position - old) / passed, angular])

    def _send(self, velocity: Float) -> None:
        fast = float(np.linalg.norm(velocity[:3])) > SLOW and self._state not in STOPPED
        self._told = min(self._told, time.monotonic()) if fast else math.inf
        if self._state in STOPPED:
            return
        told = [*(velocity[:3] * 1e3).tolist(), *velocity[3:].tolist()]
        code = self._arm.vc_set_cartesian_velocity(told, is_radian=True, duration=HOLD)
        if code < 0 or code == 3:
            raise DriverError(f"the controller does not answer (code {code}): look at its network")


def _probe(address: str, port: int) -> None:
    try:
        socket.create_connection((address, port), PROBE).close()
    except OSError as error:
        raise DriverError(
            f"no robot at {address}:{port} ({error.strerror or error}): look at [robot] address, "
            "cable and whether it is switched on"
        ) from error
