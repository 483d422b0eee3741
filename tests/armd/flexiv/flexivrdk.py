"""`flexivrdk` for a whole armd: as `flexivrdk_fake`, with the robot in another process.

armd finds it by PYTHONPATH. What it says to `robot.py` is a line of JSON each way, and nothing of
the vendor's: only names, arguments and meanings are the vendor's here.
"""

from __future__ import annotations

import json
import os
import socket
import threading
import time
from collections.abc import Callable
from typing import Any

from flexivrdk_fake import (
    JointGroup,
    Mode,
    NrtCartesianCmd,
    PrimitiveArgs,
    RobotStates,
    ToolParams,
)

__all__ = [
    "JointGroup", "Mode", "NrtCartesianCmd", "PrimitiveArgs", "Robot", "RobotStates", "Tool",
    "ToolParams",
]  # fmt: skip

PATIENCE_S = 3.0


class Robot:
    def __init__(self, robot_sn: str) -> None:
        try:
            self._link = socket.create_connection(
                (robot_sn, int(os.environ["FLEXIV_ROBOT_PORT"])), PATIENCE_S
            )
        except OSError as error:
            raise RuntimeError(f"robot {robot_sn} was not found in the network") from error
        self._link.settimeout(None)
        self._link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._said: dict[str, Any] = {}
        self._first = threading.Event()
        threading.Thread(target=self._listen, daemon=True).start()
        if not self._first.wait(PATIENCE_S):
            raise RuntimeError(f"robot {robot_sn} sends nothing")

    def _listen(self) -> None:
        for line in self._link.makefile():
            self._said = json.loads(line)
            self._first.set()

    def _ask(self, **fields: object) -> None:
        try:
            self._link.sendall(json.dumps(fields).encode() + b"\n")
        except OSError as error:
            raise RuntimeError(f"the connection is gone: {error}") from error

    @staticmethod
    def _until(done: Callable[[], bool]) -> bool:
        end = time.monotonic() + PATIENCE_S
        while not done() and time.monotonic() < end:
            time.sleep(0.002)
        return done()

    def states(self) -> dict[JointGroup, RobotStates]:
        said, states = self._said, RobotStates()
        states.timestamp = (int(said["ns"]) // 10**9, int(said["ns"]) % 10**9)
        states.tcp_pose, states.tcp_twist = said["pose"], said["twist"]
        states.tcp_wrench = said["wrench"]
        return {JointGroup.ARM_1: states}

    def SendCartesianMotionForce(self, cmds: dict[JointGroup, NrtCartesianCmd]) -> None:  # noqa: N802
        command = cmds[JointGroup.ARM_1]
        if not (command.max_linear_vel > 0 and command.max_angular_vel > 0):
            raise ValueError("limits of velocity must be above zero")
        self._ask(
            pose=command.pose_d, linear=command.max_linear_vel, angular=command.max_angular_vel
        )

    def SetMaxContactWrench(self, group: JointGroup, max_wrench: list[float]) -> None:  # noqa: N802
        if self._said["refuses_limits"]:
            raise RuntimeError("the contact wrench is refused")

    def SwitchMode(self, mode: Mode) -> None:  # noqa: N802
        self._ask(mode=mode.name)
        self._until(lambda: self._said["mode"] == mode.name)

    def ExecutePrimitive(self, primitive_args: dict[JointGroup, PrimitiveArgs]) -> None:  # noqa: N802
        self._ask(zero=True)

    def ClearFault(self, timeout_sec: int) -> bool:  # noqa: N802
        self._ask(clear=True)
        return self._until(lambda: not self._said["fault"])

    def ServoOn(self) -> None:  # noqa: N802
        self._ask(servo=True)

    def Stop(self) -> None:  # noqa: N802
        self._ask(mode="IDLE")

    def mode(self) -> Mode:
        return Mode[self._said["mode"]]

    def fault(self) -> bool:
        return bool(self._said["fault"])

    def operational(self) -> bool:
        return bool(self._said["operational"])

    def estop_released(self) -> bool:
        return not self._said["pressed"]

    def busy(self) -> bool:
        return False


class Tool:
    def __init__(self, robot: Robot) -> None:
        self._robot = robot

    def params(self, group: JointGroup) -> ToolParams:
        params = ToolParams()
        params.mass = self._robot._said["payload"]
        return params
