"""A robot for `flexivrdk.py` beside this file, in a process of its own, with faults on demand.

It goes to the pose it was told last, at the speed that came with it, and stays there: what the
vendor documents of NRT_CARTESIAN_MOTION_FORCE. Whether a real one does so was never seen.
"""

from __future__ import annotations

import argparse
import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from armd.config import load_config, plane_of
from armd.frames import quaternion_of, rotation_of, rotation_vector
from sim_device.robots.plant import Mount, Plant, Truth
from sim_device.robots.robot_server import RobotServer, TruthFile
from sim_device.robots.sockets import Network, Servers
from sim_device.runner import Runner
from tactile_core.geometry import TIP_X
from tactile_core.types import Instant

STATE_PERIOD_S = 0.005


class EmulatedFlexiv:
    faults = (
        "protective_stop", "estop", "release", "stop_program", "nan", "numbers", "payload KG",
        "refuse_limits", "accept_limits",
    )  # fmt: skip

    def __init__(self, plant: Plant, truth: Truth) -> None:
        self.plant = plant
        self.truth = truth
        self.mode = "IDLE"
        self.fault = self.pressed = self.refuses = self.poisoned = False
        self.payload = 0.8
        self._target: tuple[np.ndarray, np.ndarray, float, float] | None = None
        self._next = 0.0

    def cycle(self) -> None:
        plant = self.plant
        moves = self.mode == "NRT_CARTESIAN_MOTION_FORCE" and not (self.fault or self.pressed)
        if not moves:
            self._target = None
        plant.target = np.zeros(6) if self._target is None else self._velocity(*self._target)
        wrong, plant.wrong = plant.wrong, np.eye(6)  # of what it is told, not of its own control
        plant.step()
        plant.wrong = wrong
        self.truth.step(plant)

    def _velocity(
        self, position: np.ndarray, turn: np.ndarray, linear: float, angular: float
    ) -> np.ndarray:
        now = self.plant.measured()
        way = position - now.position
        around = rotation_vector(turn @ now.rotation.T)
        return np.concatenate([_toward(way, linear), _toward(around, angular)])

    def spontaneous(self, servers: Servers, now: Instant) -> None:
        if self.plant.time < self._next:
            return
        self._next = max(self._next + STATE_PERIOD_S, self.plant.time)
        m = self.plant.measured()
        pose = [*m.position.tolist(), *quaternion_of(m.rotation)]
        said = {
            "ns": round((self.plant.time + self.plant.slipped) * 1e9),
            "pose": [math.nan] * 7 if self.poisoned else pose,
            "twist": m.twist.tolist(),
            "wrench": m.wrench.tolist(),
            "mode": self.mode,
            "fault": self.fault,
            "pressed": self.pressed,
            "operational": not (self.fault or self.pressed),
            "refuses_limits": self.refuses,
            "payload": self.payload,
        }
        line = json.dumps(said).encode() + b"\n"
        for client in servers.of(Link):
            servers.say(client, line, now)

    def befall(self, fault: str, number: float | None) -> bool:
        if fault == "protective_stop":
            self.fault = True
        elif fault == "estop":
            self.pressed = True
        elif fault == "release":
            self.pressed = False
        elif fault == "stop_program":
            self.mode = "IDLE"
        elif fault in ("nan", "numbers"):
            self.poisoned = fault == "nan"
        elif fault == "payload" and number is not None:
            self.payload = number
        elif fault in ("refuse_limits", "accept_limits"):
            self.refuses = fault == "refuse_limits"
        else:
            return False
        return True

    def do(self, asked: dict[str, Any]) -> None:
        if "pose" in asked:
            pose, now = np.array(asked["pose"]), self.plant.measured()
            way = self.plant.wrong[:3, :3] @ (pose[:3] - now.position)
            turn = rotation_of(pose[3:])
            self._target = now.position + way, turn, asked["linear"], asked["angular"]
        if "mode" in asked:
            self.mode, self._target = asked["mode"], None
        if asked.get("clear"):
            self.fault = False
        if asked.get("zero"):
            self.plant.zero_force()


def _toward(way: np.ndarray, speed: float) -> np.ndarray:
    """At ``speed`` at most, and no faster than comes to rest at the end of ``way``."""
    length = float(np.linalg.norm(way))
    if length < 1e-6:
        return np.zeros(3)
    return way / length * min(speed, math.sqrt(length), length / 0.01)


class Link:
    """One client."""

    def __init__(self, robot: EmulatedFlexiv) -> None:
        self._robot = robot
        self._buffer = b""

    def greet(self) -> bytes:
        return b""

    def hear(self, data: bytes) -> bytes:
        *lines, self._buffer = (self._buffer + data).split(b"\n")
        for line in lines:
            self._robot.do(json.loads(line))
        return b""


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--config", type=Path, required=True)
    parser.add_argument("--address", required=True)
    parser.add_argument("--port", type=int, required=True)
    parser.add_argument("--truth", type=Path, required=True)
    options = parser.parse_args()
    config = load_config(options.config)
    plane = plane_of(config, str(options.config))
    mount = Mount(plane.cupboard, plane.pivot)
    plant = Plant(mount, (-TIP_X, 0.0, 0.0), None, config.robot.acceleration)
    truth = TruthFile(options.truth)
    robot = EmulatedFlexiv(plant, truth.truth)
    servers = Servers(
        options.address, {options.port: lambda: Link(robot)}, Network(), np.random.default_rng(0)
    )
    server = RobotServer(robot, servers, truth, None, control=True)
    runner = Runner([server])
    server.open()
    print("emulated", flush=True)
    runner.run(lambda: False)


if __name__ == "__main__":
    main()
