"""A Universal Robots controller as a client sees it: dashboard, RTDE and script port.

It speaks the published RTDE protocol (version 2) and as much of the dashboard as a client of ours
asks. Of URScript it runs one program, the control loop that `ur_rtde` uploads: which registers
carry which command was seen on the wire, with that client as the judge. No line of URScript is
interpreted.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, Final

import numpy as np

from armd.driver import Float
from armd.frames import rotation_vector
from sim_device.robots.plant import STEP, Plant, Truth
from sim_device.robots.sockets import Servers
from tactile_core.types import Instant

DASHBOARD, PRIMARY, SCRIPT, RTDE = 29999, 30001, 30002, 30004
SCRIPT_PORTS: Final = (PRIMARY, SCRIPT, 30003)

RATE: Final = 500.0
"""Hz of an e-series controller."""

STOP_DECELERATION: Final = 2.5
"""m/s² of a program that is stopped, of a protective stop and of the watchdog's."""

UNLOCK_AFTER: Final = 5.0
"""s after a protective stop before it may be unlocked."""

UPLOAD: Final = 0.05
"""s from a script's arrival to its first cycle."""


class SafetyMode(IntEnum):
    """RTDE's ``safety_mode``."""

    NORMAL = 1
    PROTECTIVE_STOP = 3
    SAFEGUARD_STOP = 5
    ROBOT_EMERGENCY_STOP = 7


SAFETY_NAMES: Final = {
    SafetyMode.NORMAL: "NORMAL",
    SafetyMode.PROTECTIVE_STOP: "PROTECTIVE_STOP",
    SafetyMode.SAFEGUARD_STOP: "SAFEGUARD_STOP",
    SafetyMode.ROBOT_EMERGENCY_STOP: "ROBOT_EMERGENCY_STOP",
}

SAFETY_BITS: Final = {
    SafetyMode.NORMAL: 0b1,
    SafetyMode.PROTECTIVE_STOP: 0b100,
    SafetyMode.SAFEGUARD_STOP: 0b10000,
    SafetyMode.ROBOT_EMERGENCY_STOP: 0b11000000,
}

NO_COMMAND, ZERO_FT, SPEED_L, SPEED_STOP = 0, 8, 10, 15
SET_PAYLOAD, SET_TCP, PROTECTIVE_STOP, STOP_L, STOP_J = 17, 29, 31, 33, 34
SET_WATCHDOG, GET_TCP_OFFSET, STOP_SCRIPT = 35, 40, 255
REALTIME: Final = frozenset(
    {24, 11, 9, SPEED_L, 6, 25, 26, 27, 38, 58, 66, 67, 68, 69, 70, 71}
)  # of the uploaded program: done at once, with "ready"
READY, DONE = 1, 2

REST: Final = np.zeros(6)

TYPES: Final[dict[str, str]] = {
    "timestamp": "DOUBLE",
    "actual_TCP_pose": "VECTOR6D",
    "actual_TCP_speed": "VECTOR6D",
    "actual_TCP_force": "VECTOR6D",
    "target_TCP_pose": "VECTOR6D",
    "target_TCP_speed": "VECTOR6D",
    "actual_q": "VECTOR6D",
    "actual_qd": "VECTOR6D",
    "target_q": "VECTOR6D",
    "target_qd": "VECTOR6D",
    "target_qdd": "VECTOR6D",
    "target_current": "VECTOR6D",
    "target_moment": "VECTOR6D",
    "actual_current": "VECTOR6D",
    "joint_control_output": "VECTOR6D",
    "joint_temperatures": "VECTOR6D",
    "actual_joint_voltage": "VECTOR6D",
    "ft_raw_wrench": "VECTOR6D",
    "joint_mode": "VECTOR6INT32",
    "actual_tool_accelerometer": "VECTOR3D",
    "payload_cog": "VECTOR3D",
    "payload_inertia": "VECTOR6D",
    "payload": "DOUBLE",
    "actual_execution_time": "DOUBLE",
    "speed_scaling": "DOUBLE",
    "target_speed_fraction": "DOUBLE",
    "actual_momentum": "DOUBLE",
    "actual_main_voltage": "DOUBLE",
    "actual_robot_voltage": "DOUBLE",
    "actual_robot_current": "DOUBLE",
    "standard_analog_input0": "DOUBLE",
    "standard_analog_input1": "DOUBLE",
    "standard_analog_output0": "DOUBLE",
    "standard_analog_output1": "DOUBLE",
    "actual_digital_input_bits": "UINT64",
    "actual_digital_output_bits": "UINT64",
    "robot_mode": "INT32",
    "safety_mode": "INT32",
    "robot_status_bits": "UINT32",
    "safety_status_bits": "UINT32",
    "runtime_state": "UINT32",
    "speed_slider_mask": "UINT32",
    "speed_slider_fraction": "DOUBLE",
    "standard_digital_output_mask": "UINT8",
    "configurable_digital_output_mask": "UINT8",
    "standard_digital_output": "UINT8",
    "configurable_digital_output": "UINT8",
    "tool_digital_output_mask": "UINT8",
    "tool_digital_output": "UINT8",
    "standard_analog_output_mask": "UINT8",
    "standard_analog_output_type": "UINT8",
    "standard_analog_output_0": "DOUBLE",
    "standard_analog_output_1": "DOUBLE",
    "external_force_torque": "VECTOR6D",
}
REGISTERS: Final = {"int": "INT32", "double": "DOUBLE", "bit": "BOOL"}

FORMATS: Final[dict[str, str]] = {
    "DOUBLE": "d",
    "VECTOR6D": "6d",
    "VECTOR3D": "3d",
    "VECTOR6INT32": "6i",
    "INT32": "i",
    "UINT32": "I",
    "UINT64": "Q",
    "UINT8": "B",
    "BOOL": "?",
}


def variable_type(name: str) -> str:
    """RTDE's type of a variable; "NOT_FOUND" for one that this controller does not have."""
    if not name:
        return ""  # clients end their list with a comma
    parts = name.split("_")
    if len(parts) >= 4 and parts[-2] == "register" and parts[0] in ("input", "output"):
        return REGISTERS.get(parts[1], "NOT_FOUND")
    return TYPES.get(name, "NOT_FOUND")


@dataclass(slots=True)
class Setup:
    """How the robot was set up: payload kg, tool centre (m, rotation vector), remote control."""

    payload: float = 0.8
    tool: tuple[float, float, float, float, float, float] = (0.0, 0.0, 0.1, 0.0, 0.0, 0.0)
    remote: bool = True
    stop_force: float = 100.0
    speed_scaling: float = 1.0


class UrController:
    """Modes, registers and the running program of one robot."""

    def __init__(self, plant: Plant, setup: Setup, truth: Truth) -> None:
        self.plant = plant
        self.setup = setup
        self.truth = truth
        self.safety = SafetyMode.NORMAL
        self.powered = True
        self.running = False
        self.ints: dict[str, int] = {}
        self.doubles: dict[str, float] = {}
        self.poisoned = False
        self._stopped_at = 0.0
        self._starts_at: float | None = None
        self._executing = False
        self._speed: Float = np.zeros(6)
        self._watchdog: float | None = None
        self._kicked = 0.0
        self._braking = False

    def cycle(self) -> None:
        """One step of 2 ms of robot time."""
        plant = self.plant
        if self._starts_at is not None and plant.time >= self._starts_at:
            self._starts_at = None
            self.running = True
            self._executing = False
            self._watchdog = None
            self._speed = np.zeros(6)
        if self.running:
            self._program()
        watched = self.running and self._watchdog is not None
        if watched and plant.time - self._kicked > (self._watchdog or 0.0):
            self.truth.event(plant, "watchdog")
            self.end_program()
        stopped = not self.running or self.safety is not SafetyMode.NORMAL
        plant.target = REST if stopped else self._speed * self.setup.speed_scaling
        plant.step()
        if plant.force > self.setup.stop_force and self.safety is SafetyMode.NORMAL:
            self.trip(SafetyMode.PROTECTIVE_STOP)
        self.truth.step(plant)

    def trip(self, mode: SafetyMode) -> None:
        """Stop for safety's sake: the program is gone."""
        self.safety = mode
        self._stopped_at = self.plant.time
        self.truth.event(self.plant, mode.name.lower())
        self.end_program()
        self.powered = mode is not SafetyMode.ROBOT_EMERGENCY_STOP

    def end_program(self) -> None:
        """The uploaded program is gone, whoever ended it."""
        self.running = False
        self._starts_at = None
        self._watchdog = None
        self._speed = np.zeros(6)
        self.plant.acceleration = STOP_DECELERATION

    def upload(self) -> None:
        """A script has come whole."""
        if self.setup.remote and self.powered and self.safety is SafetyMode.NORMAL:
            self.end_program()
            self._starts_at = self.plant.time + UPLOAD

    def heard_command(self) -> None:
        """The register that the watchdog looks at was written."""
        self._kicked = self.plant.time

    def unlock(self) -> bool:
        """Undo a protective stop; False where it is too early or there is none."""
        if self.safety is not SafetyMode.PROTECTIVE_STOP:
            return self.safety is SafetyMode.NORMAL
        if self.plant.time - self._stopped_at < UNLOCK_AFTER * self._hurry:
            return False
        self.safety = SafetyMode.NORMAL
        return True

    _hurry = 1.0
    """Part of `UNLOCK_AFTER` that has to pass; tests need not wait."""

    def hurry(self, part: float) -> None:
        """Shorten the wait for unlocking."""
        self._hurry = part

    def release(self) -> None:
        """The button is pulled out, the door is closed: as if power and brakes were on again."""
        self.safety = SafetyMode.NORMAL
        self.powered = True

    def value(self, name: str) -> Any:
        """Value of an output variable now."""
        m = self.plant.measured()
        if name == "timestamp":
            return self.plant.time + self.plant.slipped
        if name == "actual_TCP_pose" or name == "target_TCP_pose":
            pose = [*m.position.tolist(), *rotation_vector(m.rotation).tolist()]
            return [float("nan")] * 6 if self.poisoned else pose
        if name in ("actual_TCP_speed", "target_TCP_speed"):
            return m.twist.tolist()
        if name in ("actual_TCP_force", "ft_raw_wrench"):
            return m.wrench.tolist()
        if name == "robot_mode":
            return 7 if self.powered else 3
        if name == "safety_mode":
            return int(self.safety)
        if name == "safety_status_bits":
            return SAFETY_BITS[self.safety]
        if name == "robot_status_bits":
            return int(self.powered) | int(self.running) << 1
        if name == "runtime_state":
            return 2 if self.running else 1
        if name == "payload":
            return self.setup.payload
        if name in ("speed_scaling", "target_speed_fraction"):
            return self.setup.speed_scaling
        if name.startswith("output_int_register"):
            return self.ints.get(name, 0)
        if name.startswith("output_double_register"):
            return self.doubles.get(name, 0.0)
        kind = variable_type(name)
        if kind in ("VECTOR6D", "VECTOR6INT32"):
            return [0] * 6
        return [0.0] * 3 if kind == "VECTOR3D" else 0

    def _program(self) -> None:
        """One turn of the uploaded program's main loop."""
        command = self.ints.get("input_int_register_0", 0)
        out = "output_int_register_0"
        if command in REALTIME:
            if command == SPEED_L:
                self._speed = np.array(self._read(6))
                self.plant.acceleration = max(1e-3, self._read(7)[6])
            self.ints[out] = READY
        elif command == NO_COMMAND:
            self._executing = False
            self.ints[out] = READY
        elif not self._executing:
            self._executing = True
            self._do(command)
            if self.running:
                self.ints[out] = DONE

    def _do(self, command: int) -> None:
        if command in (SPEED_STOP, STOP_L, STOP_J):
            self._speed = np.zeros(6)
            self.plant.acceleration = max(0.1, min(self._read(1)[0], 10.0))
        elif command == ZERO_FT:
            self.plant.zero_force()
        elif command == SET_WATCHDOG:
            frequency = self._read(1)[0]
            self._watchdog = 1 / frequency if frequency > 0 else None
            self._kicked = self.plant.time
        elif command == GET_TCP_OFFSET:
            for index, part in enumerate(self.setup.tool):
                self.doubles[f"output_double_register_{index}"] = part
        elif command == SET_PAYLOAD:
            self.setup.payload = self._read(1)[0]
        elif command == PROTECTIVE_STOP:
            self.trip(SafetyMode.PROTECTIVE_STOP)
        elif command == STOP_SCRIPT:
            self.end_program()

    def _read(self, count: int) -> list[float]:
        return [self.doubles.get(f"input_double_register_{k}", 0.0) for k in range(count)]


class Rtde:
    """One RTDE client: recipes of outputs and inputs, and the stream of states."""

    def __init__(self, controller: UrController) -> None:
        self._controller = controller
        self._buffer = b""
        self._outputs: list[str] = []
        self._rate = 0.0
        self._inputs: dict[int, list[str]] = {}
        self._streaming = False
        self._next = 0.0

    def greet(self) -> bytes:
        """The client speaks first."""
        return b""

    def hear(self, data: bytes) -> bytes:
        """Answer every whole packet."""
        self._buffer += data
        answers = []
        while len(self._buffer) >= 3:
            size, kind = struct.unpack(">HB", self._buffer[:3])
            if size < 3 or len(self._buffer) < size:
                break
            payload, self._buffer = self._buffer[3:size], self._buffer[size:]
            answers.append(self._answer(chr(kind), payload))
        return b"".join(answers)

    def due(self) -> bytes:
        """The state, when it is time for it by the robot's clock."""
        time = self._controller.plant.time
        if not self._streaming or time + STEP / 2 < self._next:
            return b""
        self._next = max(self._next + 1 / self._rate, time)
        values = bytearray([1])
        for name in self._outputs:
            kind = variable_type(name)
            if kind not in FORMATS:
                continue
            value = self._controller.value(name)
            layout = ">" + FORMATS[kind]
            values += (
                struct.pack(layout, *value)
                if isinstance(value, list)
                else struct.pack(layout, value)
            )
        return _packet("U", bytes(values))

    def _answer(self, kind: str, payload: bytes) -> bytes:
        if kind == "V":
            (wanted,) = struct.unpack(">H", payload[:2])
            return _packet("V", bytes([wanted <= 2]))
        if kind == "v":
            return _packet("v", struct.pack(">4I", 5, 12, 0, 0))
        if kind == "O":
            (rate,) = struct.unpack(">d", payload[:8])
            self._rate = min(max(rate, 1.0), RATE)
            self._outputs = payload[8:].decode("ascii", "replace").split(",")
            kinds = ",".join(variable_type(name) for name in self._outputs)
            return _packet("O", bytes([1]) + kinds.encode())
        if kind == "I":
            names = payload.decode("ascii", "replace").split(",")
            number = len(self._inputs) + 1
            self._inputs[number] = names
            return _packet(
                "I", bytes([number]) + ",".join(variable_type(name) for name in names).encode()
            )
        if kind in ("S", "P"):
            self._streaming = kind == "S" and self._rate > 0
            self._next = self._controller.plant.time
            return _packet(kind, b"\x01")
        if kind == "U":
            self._write(payload)
        return b""

    def _write(self, payload: bytes) -> None:
        names = self._inputs.get(payload[0] if payload else 0)
        if names is None:
            return
        layout = ">" + "".join(FORMATS.get(variable_type(name), "") for name in names)
        if len(payload) - 1 < struct.calcsize(layout):
            return
        values = struct.unpack(layout, payload[1 : 1 + struct.calcsize(layout)])
        for name, value in zip(names, values, strict=False):
            if "_int_register_" in name:
                self._controller.ints[name] = value
                if name == "input_int_register_0":
                    self._controller.heard_command()
            elif "_double_register_" in name:
                self._controller.doubles[name] = value


def _packet(kind: str, payload: bytes) -> bytes:
    return struct.pack(">HB", len(payload) + 3, ord(kind)) + payload


class Dashboard:
    """One client of the dashboard: a line in, a line out."""

    def __init__(self, controller: UrController) -> None:
        self._controller = controller
        self._buffer = b""

    def greet(self) -> bytes:
        """Say who is there."""
        return b"Connected: Universal Robots Dashboard Server\n"

    def hear(self, data: bytes) -> bytes:
        """Answer every whole line."""
        self._buffer += data
        answers = b""
        while b"\n" in self._buffer:
            line, _, self._buffer = self._buffer.partition(b"\n")
            answers += self._answer(line.decode("ascii", "replace").strip()).encode() + b"\n"
        return answers

    def _answer(self, line: str) -> str:
        robot = self._controller
        word = line.lower()
        if word == "polyscopeversion":
            return "URSoftware 5.12.0.1101319 (Feb 01 2022)"
        if word == "get serial number":
            return "20220000001"
        if word == "get robot model":
            return "UR5"
        if word == "is in remote control":
            return "true" if robot.setup.remote else "false"
        if word == "robotmode":
            return "Robotmode: RUNNING" if robot.powered else "Robotmode: POWER_OFF"
        if word in ("safetymode", "safetystatus"):
            return f"{line.capitalize()}: {SAFETY_NAMES[robot.safety]}"
        if word == "running":
            return f"Program running: {str(robot.running).lower()}"
        if word == "unlock protective stop":
            if robot.unlock():
                return "Protective stop releasing"
            return "Cannot unlock protective stop until 5s after occurrence. Always inspect cause"
        if word == "close safety popup":
            return "closing safety popup"
        if word == "stop":
            robot.end_program()
            return "Stopped"
        if word == "quit":
            return "Disconnected"
        return f"could not understand: '{line[:60]}'"


class ScriptPort:
    """Where the program is uploaded."""

    def __init__(self, controller: UrController) -> None:
        self._controller = controller
        self._text = b""

    def greet(self) -> bytes:
        """Real ones stream states here, which clients of scripts do not read."""
        return b""

    def hear(self, data: bytes) -> bytes:
        """A program ends with ``end`` at the beginning of a line."""
        self._text = (self._text + data)[-1_000_000:]
        if self._text.rstrip().endswith(b"end"):
            self._controller.upload()
            self._text = b""
        return b""


def ports(controller: UrController) -> dict[int, Callable[[], Any]]:
    """What is served at which port."""
    return {
        DASHBOARD: lambda: Dashboard(controller),
        RTDE: lambda: Rtde(controller),
        **{port: lambda: ScriptPort(controller) for port in SCRIPT_PORTS},
    }


class EmulatedUr(UrController):
    """What a `sim_device.robots.robot_server.RobotServer` drives."""

    faults = (
        "protective_stop", "estop", "safeguard", "release", "unlock_after S", "stop_program",
        "nan", "numbers", "local", "remote", "payload KG", "slider PART",
    )  # fmt: skip

    def spontaneous(self, servers: Servers, now: Instant) -> None:
        """States to every RTDE client."""
        for client in servers.of(Rtde):
            peer = client.peer
            if isinstance(peer, Rtde):
                servers.say(client, peer.due(), now)

    def befall(self, fault: str, number: float | None) -> bool:
        """Let it happen."""
        stops = {
            "protective_stop": SafetyMode.PROTECTIVE_STOP,
            "estop": SafetyMode.ROBOT_EMERGENCY_STOP,
            "safeguard": SafetyMode.SAFEGUARD_STOP,
        }
        if fault in stops:
            self.trip(stops[fault])
        elif fault == "release":
            self.release()
        elif fault == "unlock_after" and number is not None:
            self.hurry(number / UNLOCK_AFTER)
        elif fault == "stop_program":
            self.end_program()
        elif fault in ("nan", "numbers"):
            self.poisoned = fault == "nan"
        elif fault in ("local", "remote"):
            self.setup.remote = fault == "remote"
        elif fault == "payload" and number is not None:
            self.setup.payload = number
        elif fault == "slider" and number is not None:
            self.setup.speed_scaling = number
        else:
            return False
        return True
