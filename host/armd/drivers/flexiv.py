"""Flexiv Rizon (the paper's arm) through `flexivrdk` 2.1. **Unverified**: never run on a robot.

There is not a Cartesian velocity here without real time, so a velocity becomes a pose that lies
`LOOK_AHEAD` ahead of the present one, at that speed. When commands cease, whatever the controller
does, the arm travels v · `LOOK_AHEAD` at most. What a target with a speed limit of zero means is
not said: limits are always above zero, and rest is "the target is where it is".
"""

from __future__ import annotations

import contextlib
import time
from typing import Any, Final

import flexivrdk
import numpy as np

from armd.config import ArmConfig
from armd.driver import DriverError, Float, RobotFacts, RobotMode, RobotState
from armd.frames import (
    quaternion_of,
    rotation_matrix,
    rotation_of,
    rotation_vector,
)
from tactile_core.types import ArmLimits

LOOK_AHEAD: Final = 0.1
"""s that the target lies ahead."""

LEAST_SPEED: Final = 0.005
"""m/s and rad/s: the least limits that are sent."""

PATIENCE: Final = 0.02
POLL: Final = 0.002
SERVO_ON: Final = 10.0
"""s for brakes to be released."""


class FlexivDriver:
    """See `armd.driver.Driver`."""

    rate = 100.0
    holds = LOOK_AHEAD
    note = "UNVERIFIED: only its calls were compared with the vendor's library, see docs/arm.md"

    def __init__(self, config: ArmConfig) -> None:
        self._config = config.robot
        self.braking = config.robot.acceleration
        self._robot: Any = None
        self._group: Any = None
        self._stamp: Any = None
        self._began = time.monotonic()
        self._pose: tuple[Float, Float] | None = None
        self._resting = False

    def connect(self) -> RobotFacts:
        """Connect by serial number, release the brakes, take the Cartesian mode."""
        serial = self._config.address
        try:
            robot = self._robot = flexivrdk.Robot(serial)
            self._group = flexivrdk.JointGroup.ARM_1
            if robot.fault():
                raise DriverError("the robot has a fault: clear it at its pendant first")
            robot.ServoOn()
            deadline = time.monotonic() + SERVO_ON
            while not robot.operational():
                if time.monotonic() > deadline:
                    raise DriverError(
                        "the robot does not become operational: release its stop button and set "
                        "it to automatic (remote)"
                    )
                time.sleep(0.1)
            tool = flexivrdk.Tool(robot).params(self._group)
            robot.SwitchMode(flexivrdk.Mode.NRT_CARTESIAN_MOTION_FORCE)
        except (RuntimeError, ValueError) as error:
            raise DriverError(
                f"no robot of the serial number {serial!r} ({error}): look at [robot] address, "
                "network and its remote mode"
            ) from error
        location = np.asarray(tool.tcp_location, dtype=np.float64)
        return RobotFacts(
            f"Flexiv {serial}",
            tool_position=location[:3],
            tool_rotation=rotation_vector(rotation_of(location[3:])),
            payload=float(tool.mass),
            enforces=frozenset({"f_max", "m_max"}),
        )

    def read(self) -> RobotState | None:
        """The newest state."""
        deadline = time.monotonic() + PATIENCE
        states = self._robot.states()[self._group]
        while states.timestamp == self._stamp:
            if time.monotonic() > deadline:
                return None
            time.sleep(POLL)
            states = self._robot.states()[self._group]
        self._stamp = states.timestamp
        pose = np.asarray(states.tcp_pose, dtype=np.float64)
        rotation = rotation_of(pose[3:])
        if np.isfinite(pose).all():  # else it would be sent back as the target that means rest
            self._pose = pose[:3], rotation
        mode, detail = self._mode()
        return RobotState(
            _seconds(states.timestamp),
            pose[:3],
            rotation,
            np.asarray(states.tcp_twist, dtype=np.float64),
            np.asarray(states.tcp_wrench, dtype=np.float64),
            mode,
            detail,
        )

    def move(self, velocity: Float) -> None:
        """A target `LOOK_AHEAD` ahead, approached at the speed asked for."""
        self._resting = not velocity.any()
        if self._pose is None:
            return
        position, rotation = self._pose
        self._send(
            position + velocity[:3] * LOOK_AHEAD,
            rotation_matrix(velocity[3:] * LOOK_AHEAD) @ rotation,
            float(np.linalg.norm(velocity[:3])),
            float(np.linalg.norm(velocity[3:])),
        )

    def halt(self) -> None:
        """The target is where it is: `Stop` would wait."""
        if not self._resting:
            self.move(np.zeros(6))

    def limit(self, limits: ArmLimits) -> None:
        """The robot keeps its own contact wrench under the limits."""
        force, moment = limits.f_max, limits.m_max
        try:
            self._robot.SetMaxContactWrench(self._group, [force] * 3 + [moment] * 3)
        except (RuntimeError, ValueError) as error:
            raise DriverError(f"the robot refuses the contact wrench: {error}") from error

    def recover(self) -> None:
        """Clear a minor fault and take the Cartesian mode again."""
        robot = self._robot
        try:
            if robot.fault() and not robot.ClearFault(3):
                raise DriverError("the robot keeps its fault: look at its pendant")
            if not robot.operational():
                raise DriverError("the robot is not operational: release its stop button")
            robot.SwitchMode(flexivrdk.Mode.NRT_CARTESIAN_MOTION_FORCE)
        except (RuntimeError, ValueError) as error:
            raise DriverError(f"the robot does not recover: {error}") from error

    def zero_force(self) -> None:
        """The primitive that zeroes the estimate; the finger touches nothing meanwhile."""
        robot = self._robot
        try:
            robot.SwitchMode(flexivrdk.Mode.NRT_PRIMITIVE_EXECUTION)
            args = flexivrdk.PrimitiveArgs("ZeroFTSensor", {})
            robot.ExecutePrimitive({self._group: args})
            deadline = time.monotonic() + SERVO_ON
            while robot.busy() and time.monotonic() < deadline:
                time.sleep(0.05)
            robot.SwitchMode(flexivrdk.Mode.NRT_CARTESIAN_MOTION_FORCE)
        except (RuntimeError, ValueError) as error:
            raise DriverError(f"the force cannot be zeroed: {error}") from error

    def close(self) -> None:
        """Rest, and go idle."""
        if self._robot is not None:
            with contextlib.suppress(RuntimeError):
                self._robot.Stop()

    def _mode(self) -> tuple[RobotMode, str]:
        robot = self._robot
        if not robot.estop_released():
            return RobotMode.ESTOP, "emergency stop: release the button"
        if robot.fault():
            return RobotMode.FAULT, "the robot has a fault: look what it met"
        if not robot.operational() or robot.mode() != flexivrdk.Mode.NRT_CARTESIAN_MOTION_FORCE:
            return RobotMode.STOPPED, "the robot left the mode of Cartesian motion"
        return RobotMode.READY, ""

    def _send(self, position: Float, rotation: Float, speed: float, turn: float) -> None:
        pose = [*position.tolist(), *quaternion_of(rotation)]
        command = flexivrdk.NrtCartesianCmd(pose)
        command.max_linear_vel = max(speed, LEAST_SPEED)
        command.max_angular_vel = max(turn, LEAST_SPEED)
        try:
            self._robot.SendCartesianMotionForce({self._group: command})
        except (RuntimeError, ValueError) as error:
            raise DriverError(f"the robot takes no pose: {error}") from error


def _seconds(stamp: tuple[int, int]) -> float:
    """s of a time stamp, which is (s, ns)."""
    return float(stamp[0]) + float(stamp[1]) * 1e-9
