"""As much of `flexivrdk` 2.1 as the driver calls, with an arm that goes to its target at once.

`test_flexiv.py` compares every name and argument with the vendor's wheel where that is installed.
"""

from __future__ import annotations

import math
from enum import Enum


class JointGroup(Enum):
    ARM_1 = 0


class Mode(Enum):
    IDLE = 0
    NRT_PRIMITIVE_EXECUTION = 1
    NRT_CARTESIAN_MOTION_FORCE = 2


class NrtCartesianCmd:
    def __init__(self, pose_d: list[float]) -> None:
        self.pose_d = pose_d
        self.max_linear_vel = 0.5
        self.max_angular_vel = 1.0


class PrimitiveArgs:
    def __init__(self, pt_name: str, input_params: dict[str, float]) -> None:
        self.pt_name, self.input_params = pt_name, input_params


class RobotStates:
    def __init__(self) -> None:
        self.timestamp = (0, 0)
        self.tcp_pose = [0.4, 0.0, 0.3, 1.0, 0.0, 0.0, 0.0]
        self.tcp_twist = [0.0] * 6
        self.tcp_wrench = [0.0] * 6


class ToolParams:
    mass = 0.8
    tcp_location = [0.0, 0.0, 0.1, 1.0, 0.0, 0.0, 0.0]  # noqa: RUF012


class Robot:
    last: Robot

    def __init__(self, robot_sn: str) -> None:
        if not robot_sn:
            raise RuntimeError("cannot connect")
        self.sent: list[NrtCartesianCmd] = []
        self.did: list[str] = []
        self.wrench: list[float] = []
        self._states = RobotStates()
        self._mode = Mode.IDLE
        self.faulty = self.pressed = False
        Robot.last = self

    def states(self) -> dict[JointGroup, RobotStates]:
        s, ns = self._states.timestamp
        self._states.timestamp = (s, ns + 1_000_000)
        return {JointGroup.ARM_1: self._states}

    def SendCartesianMotionForce(self, cmds: dict[JointGroup, NrtCartesianCmd]) -> None:  # noqa: N802
        command = cmds[JointGroup.ARM_1]
        assert command.max_linear_vel > 0
        assert command.max_angular_vel > 0
        assert math.isclose(math.hypot(*command.pose_d[3:]), 1.0)
        self.sent.append(command)

    def SetMaxContactWrench(self, group: JointGroup, max_wrench: list[float]) -> None:  # noqa: N802
        self.wrench = max_wrench

    def SwitchMode(self, mode: Mode) -> None:  # noqa: N802
        self._mode = mode

    def ExecutePrimitive(self, primitive_args: dict[JointGroup, PrimitiveArgs]) -> None:  # noqa: N802
        self.did += [args.pt_name for args in primitive_args.values()]

    def ClearFault(self, timeout_sec: int) -> bool:  # noqa: N802
        self.faulty = False
        return True

    def ServoOn(self) -> None:  # noqa: N802
        self.did.append("ServoOn")

    def Stop(self) -> None:  # noqa: N802
        self._mode = Mode.IDLE

    def mode(self) -> Mode:
        return self._mode

    def fault(self) -> bool:
        return self.faulty

    def operational(self) -> bool:
        return not self.faulty and not self.pressed

    def estop_released(self) -> bool:
        return not self.pressed

    def busy(self) -> bool:
        return False


class Tool:
    def __init__(self, robot: Robot) -> None:
        pass

    def params(self, group: JointGroup) -> ToolParams:
        return ToolParams()
