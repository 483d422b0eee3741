"""A UFACTORY xArm controller as the vendor's SDK sees it: command port and "real" report.

Layouts are those of the SDK's source (1.18): requests of a private Modbus TCP, and a report of 135
bytes whose last 48 are external and raw force and torque of the sensor in the wrist. Lengths are in
mm. A velocity holds for the duration that came with it, in the controller.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from armd.config import ToolTable
from armd.driver import Float
from sim_device.robots.plant import Plant, Truth
from sim_device.robots.sockets import Servers
from tactile_core.types import Instant

CONTROL, REPORT = 502, 30003

REPORT_PERIOD: Final = 0.01
"""s between two reports."""

HEAD: Final = struct.Struct(">HHHB")

GET_VERSION, MOTION_EN, SET_STATE, GET_STATE, GET_CMDNUM, GET_ERROR = 1, 11, 12, 13, 14, 15
CLEAN_ERR, CLEAN_WAR, SET_MODE, SET_CARTESIAN_VELOCITY, SET_FORCE_ZERO = 16, 17, 19, 82, 206

VERSION: Final = b"6,6,XI120000000001,AC120000000001,v1.12.10"

VELOCITY_MODE: Final = 5
READY, MOVING, STOPPED = 2, 1, 4
EMERGENCY, COLLISION, JOINT = 1, 31, 10
"""Error codes: button at the control box, abnormal current by a collision, a joint's fault."""

NEEDS_CLEARING: Final = 0x40
REST: Final = np.zeros(6)


@dataclass(slots=True)
class Setup:
    """N at which it takes a load for a collision."""

    stop_force: float

    @classmethod
    def of(cls, _: ToolTable, stop_force: float) -> Setup:
        """Of a finger as it is configured; the report says nothing of tools."""
        return cls(stop_force)


class EmulatedXarm:
    """Modes, states and errors of one robot; driven by a `RobotServer`."""

    faults = ("protective_stop", "estop", "release", "stop_program", "nan", "numbers")

    def __init__(self, plant: Plant, setup: Setup, truth: Truth) -> None:
        self.plant = plant
        self.setup = setup
        self.truth = truth
        self.error = 0
        self.enabled = False
        self.mode = 0
        self.stopped = True
        self._pressed = False
        self._poisoned = False
        self._speed: Float = REST
        self._until = 0.0
        self._next = 0.0

    @property
    def state(self) -> int:
        """1 in motion, 2 ready, 4 stopped."""
        if self.stopped:
            return STOPPED
        return MOVING if self._speed.any() else READY

    def cycle(self) -> None:
        """One step of robot time."""
        plant = self.plant
        if plant.time >= self._until:
            self._speed = REST
        plant.target = REST if self.stopped else self._speed
        plant.step()
        if plant.force > self.setup.stop_force and not self.error:
            self.trip(COLLISION)
        self.truth.step(plant)

    def trip(self, error: int) -> None:
        """Stop until the error is cleared."""
        self.error, self.stopped, self._speed = error, True, REST
        self.truth.event(self.plant, f"error_{error}")

    def spontaneous(self, servers: Servers, now: Instant) -> None:
        """The report, a hundred times a second."""
        if self.plant.time < self._next:
            return
        self._next = max(self._next + REPORT_PERIOD, self.plant.time)
        report = self.report()
        for client in servers.of(Report):
            servers.say(client, report, now)

    def report(self) -> bytes:
        """135 bytes: length, state and mode, commands, joints, pose, torques, forces."""
        m = self.plant.measured()
        pose = [*(m.position * 1e3).tolist(), *roll_pitch_yaw(m.rotation)]
        if self._poisoned:
            pose = [math.nan] * 6
        back = m.rotation.T
        force = [*(back @ m.wrench[:3]).tolist(), *(back @ m.wrench[3:]).tolist()]
        head = struct.pack(">IBH", 135, self.state | self.mode << 4, 0)
        joints = [0.0] * 7
        return head + struct.pack("<7f6f7f12f", *joints, *pose, *joints, *force, *force)

    def befall(self, fault: str, _: float | None) -> bool:
        """Let it happen."""
        if fault == "protective_stop":
            self.trip(COLLISION)
        elif fault == "estop":
            self._pressed = True
            self.trip(EMERGENCY)
        elif fault == "release":
            self._pressed = False
        elif fault == "stop_program":
            self.stopped, self._speed = True, REST
        elif fault in ("nan", "numbers"):
            self._poisoned = fault == "nan"
        else:
            return False
        return True

    def do(self, function: int, data: bytes) -> bytes:
        """Answer a request: what comes after the status byte."""
        if function == GET_VERSION:
            return VERSION.ljust(40, b"\0")
        if function == GET_STATE:
            return bytes([self.state])
        if function == GET_CMDNUM:
            return b"\0\0"
        if function == GET_ERROR:
            return bytes([self.error, 0])
        if function == CLEAN_ERR and not self._pressed:
            self.error = 0
        elif function == MOTION_EN and len(data) >= 2:
            self.enabled = bool(data[1])
        elif function == SET_MODE and data:
            self.mode, self.stopped = data[0], True
        elif function == SET_STATE and data:
            self.stopped = data[0] != 0 or bool(self.error) or not self.enabled
        elif function == SET_FORCE_ZERO:
            self.plant.zero_force()
        elif function == SET_CARTESIAN_VELOCITY and len(data) >= 25:
            self._move(data)
        return b"" if function == SET_CARTESIAN_VELOCITY else b"\0" * 40

    def _move(self, data: bytes) -> None:
        if self.stopped or self.error or self.mode != VELOCITY_MODE or data[24]:
            return
        speed = np.array(struct.unpack("<6f", data[:24]))
        duration = struct.unpack("<f", data[25:29])[0] if len(data) >= 29 else 0.0
        self._speed = np.concatenate([speed[:3] * 1e-3, speed[3:]])
        # 0 and no duration at all: until the next command.
        self._until = self.plant.time + duration if duration > 0 else math.inf


class Control:
    """One client of the command port."""

    def __init__(self, robot: EmulatedXarm) -> None:
        self._robot = robot
        self._buffer = b""

    def greet(self) -> bytes:
        """The client speaks first."""
        return b""

    def hear(self, data: bytes) -> bytes:
        """Answer every whole request."""
        self._buffer += data
        answers = b""
        while len(self._buffer) >= HEAD.size:
            number, protocol, length, function = HEAD.unpack_from(self._buffer)
            end = 6 + length
            if len(self._buffer) < end:
                break
            body, self._buffer = self._buffer[HEAD.size : end], self._buffer[end:]
            if function == 0:
                continue  # a heartbeat
            answer = self._robot.do(function, body)
            status = NEEDS_CLEARING if self._robot.error else 0
            head = HEAD.pack(number, protocol, len(answer) + 2, function)
            answers += head + bytes([status]) + answer
        return answers


class Report:
    """One client of the report."""

    def greet(self) -> bytes:
        """It comes by itself."""
        return b""

    def hear(self, _: bytes) -> bytes:
        """Nothing is asked here."""
        return b""


def roll_pitch_yaw(rotation: Float) -> tuple[float, float, float]:
    """rad about the fixed x, y and z of the base, in this order."""
    pitch = math.asin(min(1.0, max(-1.0, -float(rotation[2, 0]))))
    if abs(math.cos(pitch)) < 1e-6:
        return math.atan2(-float(rotation[1, 2]), float(rotation[1, 1])), pitch, 0.0
    roll = math.atan2(float(rotation[2, 1]), float(rotation[2, 2]))
    return roll, pitch, math.atan2(float(rotation[1, 0]), float(rotation[0, 0]))


def ports(robot: EmulatedXarm, control: int | None) -> dict[int, Callable[[], Any]]:
    """What is served at which port."""
    return {control or CONTROL: lambda: Control(robot), REPORT: Report}
