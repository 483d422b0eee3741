"""Mechanics of every emulated robot: a tool that moves in the cupboard, and how it stops.

The tool centre follows a velocity in the robot's base with bounded acceleration. The robot is
stiff; the finger hangs on a mount that gives way. In the cupboard's plane it is the finger of a
simulated world; height, roll and pitch are free air. Time passes in steps of `STEP`; a process
that is stopped stops its robot. Pure.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np

from armd.driver import Float
from armd.frames import Transform, cross, rotation_matrix
from sim_device.skin.elastomer import Contact
from sim_device.world.base import PHYSICS_STEP, FingerState, World
from sim_device.world.mujoco_model import MOTOR_TIME
from sim_device.world.parameters import world_parameters
from sim_device.world.touch import on_skin
from tactile_core.types import NS_PER_S, Instant, Twist

STEP: Final = 0.002
"""Period of a robot's controller, s."""

STEP_NS: Final = round(STEP * NS_PER_S)

STIFFNESS: Final = (3000.0, 3000.0, 30.0)
"""N/m and N·m/rad between robot and finger. The robot is stiff; skin and mount of the finger are
not. The pose that the robot reports is its own, whatever presses on the finger."""

DAMPING: Final = (100.0, 100.0, 1.3)
"""N·s/m and N·m·s/rad of the same, a third of critical with the finger's mass in the world."""

MOTOR_FORCE: Final = 150.0
"""Strength of the robot, N: far more than a cupboard stands."""

MOTOR_MOMENT: Final = 30.0
"""Strength of the robot about the vertical, N·m."""

MAX_CATCH_UP_NS: Final = 20_000_000
"""Time that is made up for at once. A controller does not stand still, as a process on a busy
machine does. Steps made up for later would all obey the command before them, and trip watchdogs
that a controller would have fed; so the robot stood still for the rest, which its clock counts."""


@dataclass(frozen=True, slots=True, eq=False)
class Mount:
    """Where the cupboard stands before the robot, and how it holds the finger."""

    cupboard: Transform
    pivot: Transform


@dataclass(frozen=True, slots=True)
class Measured:
    """What the robot's sensors say: of the tool centre, in the base."""

    position: Float
    rotation: Float
    twist: Float
    wrench: Float


class Plant:
    """A robot's tool. Set `target` (6,) and `stop`; `step` moves it on by `STEP`."""

    def __init__(
        self,
        mount: Mount,
        start: tuple[float, float, float],
        world: World | None,
        acceleration: float,
    ) -> None:
        self.mount = mount
        self.world = world
        self.acceleration = acceleration
        self.time = 0.0
        self.slipped = 0.0
        """s of the host in which the robot stood still, which its clock counts all the same."""
        self.target = np.zeros(6)
        self.wrong: Float = np.eye(6)
        """Matrix that falsifies what it is told: the identity but for a fault."""
        self._x, self._y, self._heading = start
        self._insists = list(start)
        self._height = 0.0
        self._tilt = np.eye(3)
        self._measured: Measured | None = None
        self._velocity = [0.0] * 6  # of the pivot in the cupboard, as ramped
        self._moves = (0.0, 0.0, 0.0)
        self._moved = self._moves  # at the last step of the physics
        self._wrench = (0.0, 0.0, 0.0)
        self._owed = 0.0
        self._offset = (0.0, 0.0, 0.0)
        if world is not None:
            world.limit_wrench(MOTOR_FORCE, MOTOR_MOMENT)
            own = world_parameters(world.scene.parameters)
            self._mass = (own.finger_mass, own.finger_mass, own.finger_inertia)

    @property
    def force(self) -> float:
        """N on the finger."""
        return math.hypot(self._wrench[0], self._wrench[1])

    @property
    def speed(self) -> float:
        """m/s of the pivot, and rad/s at a lever of 0.1 m."""
        return math.hypot(self._moves[0], self._moves[1]) + 0.1 * abs(self._moves[2])

    @property
    def planar(self) -> tuple[float, float, float]:
        """m, m and rad of the pivot in the cupboard."""
        return self._x, self._y, self._heading

    @property
    def pushed(self) -> tuple[float, float, float]:
        """N, N and N·m on the finger in the cupboard, about the pivot."""
        return self._wrench

    def zero_force(self) -> None:
        """Take the present wrench for none."""
        self._offset = self._wrench

    def place(self, x: float, y: float, height: float) -> None:
        """Be somewhere else, as if led by hand; without a world only."""
        if self.world is None:
            self._x, self._y, self._height = x, y, height
            self._insists[:2] = [x, y]

    def contacts(self) -> list[Contact]:
        """What the skin feels now."""
        return [] if self.world is None else on_skin(self.world.contacts(), self.world.scene)

    def yaw(self) -> float:
        """Heading of the finger in rad."""
        return self._heading

    def step(self) -> None:
        """Move on by `STEP`."""
        self.time += STEP
        self._measured = None
        self._ramp(self._wanted())
        vx, vy, vz, roll, pitch, omega = self._velocity
        insists = self._insists
        insists[0] += vx * STEP
        insists[1] += vy * STEP
        insists[2] += omega * STEP
        self._height += vz * STEP
        if roll or pitch:
            self._tilt = rotation_matrix(np.array([roll, pitch, 0.0]) * STEP) @ self._tilt
        self._x, self._y, self._heading = insists
        self._moves = (vx, vy, omega)
        if self.world is None:
            return
        self._owed += STEP
        while self._owed >= PHYSICS_STEP - 1e-9:
            self._owed -= PHYSICS_STEP
            self._push(self.world)

    def measured(self) -> Measured:
        """What the sensors say now."""
        if self._measured is None:
            self._measured = self._measure()
        return self._measured

    def _measure(self) -> Measured:
        axes = self._axes()
        at = np.array([self._x, self._y, self._height])
        cupboard, pivot = self.mount.cupboard, self.mount.pivot
        tool = cupboard @ Transform(at, axes) @ pivot.inverse()
        out = cupboard.rotation
        lever = tool.rotation @ pivot.position  # from the tool centre to the pivot
        angular = out @ np.array([*self._velocity[3:5], self._moves[2]])
        linear = out @ np.array([*self._moves[:2], self._velocity[2]]) - cross(angular, lever)
        fx, fy, mz = (a - b for a, b in zip(self._wrench, self._offset, strict=True))
        force = out @ np.array([fx, fy, 0.0])
        moment = out @ np.array([0.0, 0.0, mz]) + cross(lever, force)
        return Measured(
            tool.position,
            tool.rotation,
            np.concatenate([linear, angular]),
            np.concatenate([force, moment]),
        )

    def _axes(self) -> Float:
        c, s = math.cos(self._heading), math.sin(self._heading)
        axes: Float = self._tilt @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        return axes

    def _wanted(self) -> list[float]:
        """(6,) of the pivot in the cupboard."""
        if not self.target.any():
            return [0.0] * 6
        asked = self.wrong @ self.target
        out = self.mount.cupboard.rotation
        tool = out @ self._axes() @ self.mount.pivot.rotation.T
        linear = asked[:3] + cross(asked[3:], tool @ self.mount.pivot.position)
        return [*(linear @ out).tolist(), *(asked[3:] @ out).tolist()]

    def _ramp(self, wanted: list[float]) -> None:
        velocity = self._velocity
        if wanted == velocity:
            return
        change = [a - b for a, b in zip(wanted, velocity, strict=True)]
        size = max(math.hypot(*change[:3]), 0.1 * math.hypot(*change[3:]))
        most = self.acceleration * STEP
        part = 1.0 if size <= most else most / size
        self._velocity = (
            wanted if part == 1.0 else [b + part * c for b, c in zip(velocity, change, strict=True)]
        )

    def _push(self, world: World) -> None:
        """Drive the finger through its mount for one step of the physics.

        The motors of a world keep a velocity and make up for the load: a finger driven by them
        alone would be as stiff as they are strong. What they make up for is therefore taken back,
        so that a finger which is held is pushed with the force of its mount and no more.
        """
        finger = world.finger()
        speed = (finger.twist.vx, finger.twist.vy, finger.twist.omega)
        load = (finger.fx, finger.fy, finger.mz)
        asks = []
        for axis, mount in enumerate(self._mount_force(finger, PHYSICS_STEP)):
            mass, moves = self._mass[axis], self._moves[axis]
            gain = mass / MOTOR_TIME
            # The motor holds back a change of speed within a step as if it were mass.
            inertia = (mass + gain * PHYSICS_STEP) * (moves - self._moved[axis]) / PHYSICS_STEP
            asks.append(speed[axis] + (mount + inertia + load[axis]) / gain)
        self._moved = self._moves
        world.step(PHYSICS_STEP, Twist(*asks))
        fx, fy, mz = self._mount_force(world.finger(), 0.0)
        self._wrench = (-fx, -fy, -mz)

    def _mount_force(self, finger: FingerState, ahead: float) -> tuple[float, float, float]:
        """N, N and N·m with which the mount pushes the finger, which the wrist's sensor feels.

        ``ahead``: s by which the robot is ahead of the world, which moves in longer steps.
        """
        speed = (finger.twist.vx, finger.twist.vy, finger.twist.omega)
        at = (finger.x, finger.y, finger.heading)
        force = []
        for axis, moves in enumerate(self._moves):
            own = self._insists[axis] - moves * self._owed
            gap = own - at[axis] - speed[axis] * ahead
            if axis == 2:
                gap = math.remainder(gap, math.tau)
            force.append(STIFFNESS[axis] * gap + DAMPING[axis] * (moves - speed[axis]))
        return force[0], force[1], force[2]


class Truth:
    """What really happened, a line a step: robot's s, then m, m, rad, m/s of the pivot, or an
    event's name after its time."""

    def __init__(self, write: Callable[[str], object] | None) -> None:
        self._write = write

    def step(self, plant: Plant) -> None:
        """Note where the tool is."""
        if self._write is not None:
            x, y, heading = plant.planar
            self._write(f"{plant.time:.3f} {x:.6f} {y:.6f} {heading:.6f} {plant.speed:.6f}\n")

    def event(self, plant: Plant, name: str) -> None:
        """Note that ``name`` befell the robot."""
        if self._write is not None:
            self._write(f"{plant.time:.3f} {name}\n")


class Pace:
    """How many steps are due: a robot keeps to the host's clock, unless it was stopped."""

    def __init__(self) -> None:
        self._at: Instant | None = None
        self.skipped_ns = 0

    def due(self, now: Instant) -> int:
        """Steps to make up to ``now``."""
        if self._at is None:
            self._at = now
        behind = now - self._at
        if behind > MAX_CATCH_UP_NS:
            excess = behind - MAX_CATCH_UP_NS
            self.skipped_ns += excess
            self._at = Instant(self._at + excess)
            behind = MAX_CATCH_UP_NS
        steps = behind // STEP_NS
        self._at = Instant(self._at + steps * STEP_NS)
        return steps
