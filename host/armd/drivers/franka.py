"""Franka Robotics' FR3 and Panda through `franky-control` (libfranka at 1 kHz beneath it).

Velocities are preempting motions: each call replaces the one before. When this process dies, the
packets cease and the robot's reflex stops it. What is felt is estimated from the joints' torques
(``O_F_ext_hat_K``), without a sensor in the wrist.
"""

from __future__ import annotations

import contextlib
import socket
import time
from typing import Any, Final

import franky
import numpy as np

from armd.config import ArmConfig
from armd.driver import DriverError, Float, RobotFacts, RobotMode, RobotState
from armd.frames import Transform, rotation_vector
from tactile_core.types import ArmLimits

FCI_PORT: Final = 1337
PROBE: Final = 2.0
POLL: Final = 0.002
PATIENCE: Final = 0.02
HOLD_MS: Final = 50
"""Duration of each motion: it ends by itself when no other follows."""


class FrankaDriver:
    """See `armd.driver.Driver`."""

    rate = 125.0
    holds = 0.02
    note = (
        "tried against somebody else's simulator of the controller; never moved on a real robot, "
        "see docs/arm.md"
    )

    def __init__(self, config: ArmConfig) -> None:
        self._config = config.robot
        self.braking = config.robot.acceleration
        self._robot: Any = None
        self._time = -1.0
        self._resting = True
        self._offset: Float = np.zeros(6)
        self._wrench: Float = np.zeros(6)

    def connect(self) -> RobotFacts:
        """Take control; the collision thresholds are franky's own."""
        address = self._config.address
        try:
            socket.create_connection((address, FCI_PORT), PROBE).close()
        except OSError as error:
            raise DriverError(
                f"no robot at {address}:{FCI_PORT} ({error.strerror or error}): look at [robot] "
                "address and cable, and activate FCI in its desk"
            ) from error
        simulated = self._config.simulated
        realtime = franky.RealtimeConfig.Ignore if simulated else franky.RealtimeConfig.Enforce
        try:
            robot = self._robot = franky.Robot(address, realtime_config=realtime)
            if robot.has_errors:
                raise DriverError("the robot has errors: recover it in its desk first")
            state = robot.state
        except franky.Exception as error:
            remedy = "activate FCI, unlock the joints, end other programs"
            if "realtime" in str(error):
                remedy = "boot a kernel with PREEMPT_RT, which Franka's interface needs"
            raise DriverError(
                f"the robot at {address} gives no control ({error}): {remedy}"
            ) from error
        tool = _transform(state.F_T_EE)
        return RobotFacts(
            f"Franka at {address}",
            tool_position=tool.position,
            tool_rotation=rotation_vector(tool.rotation),
            payload=float(state.m_ee) + float(state.m_load),
        )

    def read(self) -> RobotState | None:
        """The newest state, by the robot's time."""
        deadline = time.monotonic() + PATIENCE
        try:
            state = self._robot.state
            while (now := state.time.to_sec()) == self._time:
                if time.monotonic() > deadline:
                    return None
                time.sleep(POLL)
                state = self._robot.state
        except franky.Exception as error:
            raise DriverError(f"the robot sends no states: {error}") from error
        self._time = now
        pose = _transform(state.O_T_EE)
        self._wrench = np.asarray(state.O_F_ext_hat_K, dtype=np.float64)
        mode, detail = _mode(state)
        return RobotState(
            now,
            pose.position,
            pose.rotation,
            _twist(state.O_dP_EE_est),
            self._wrench - self._offset,
            mode,
            detail,
        )

    def move(self, velocity: Float) -> None:
        """Replace the motion under way."""
        self._resting = False
        self._send(velocity)

    def halt(self) -> None:
        """A stop replaces the motion under way."""
        if self._resting:
            return
        self._resting = True
        with contextlib.suppress(franky.Exception):
            self._robot.move(franky.CartesianVelocityStopMotion(), asynchronous=True)

    def limit(self, limits: ArmLimits) -> None:
        """Kept by armd; the reflex at the collision thresholds remains."""

    def recover(self) -> None:
        """Recover from a reflex."""
        try:
            self._robot.recover_from_errors()
        except franky.Exception as error:
            raise DriverError(
                f"the robot does not recover ({error}): look at its desk and its stop button"
            ) from error
        if self._robot.has_errors:
            raise DriverError("the robot keeps its errors: look at its desk")

    def zero_force(self) -> None:
        """The estimate cannot be zeroed at the robot: its present value is taken off here."""
        if self.read() is not None:
            self._offset = self._wrench.copy()

    def close(self) -> None:
        """Rest, and let go."""
        if self._robot is not None:
            with contextlib.suppress(franky.Exception):
                self._robot.stop()
            self._robot = None

    def _send(self, velocity: Float) -> None:
        twist = franky.Twist(velocity[:3], velocity[3:])
        motion = franky.CartesianVelocityMotion(
            franky.RobotVelocity(twist), franky.Duration(HOLD_MS)
        )
        try:
            self._robot.move(motion, asynchronous=True)
        except franky.Exception as error:
            raise DriverError(f"the robot takes no velocity: {error}") from error


def _transform(affine: Any) -> Transform:
    matrix = np.asarray(affine.matrix, dtype=np.float64)
    return Transform(matrix[:3, 3], matrix[:3, :3])


def _twist(velocity: Any) -> Float:
    twist = getattr(velocity, "end_effector_twist", velocity)
    if twist is None:
        return np.zeros(6)  # not estimated before the first motion
    both = [np.asarray(twist.linear), np.asarray(twist.angular)]
    return np.concatenate(both, dtype=np.float64)


def _mode(state: Any) -> tuple[RobotMode, str]:
    modes = franky.RobotMode
    if state.robot_mode in (modes.Move, modes.Idle):
        return RobotMode.READY, ""
    if state.robot_mode == modes.UserStopped:
        return RobotMode.ESTOP, "stopped by its button: release it, unlock the joints"
    if state.robot_mode == modes.Reflex:
        return RobotMode.FAULT, f"reflex ({state.last_motion_errors}): look what it met"
    return RobotMode.STOPPED, f"the robot is in mode {state.robot_mode}: no program moves it"
