"""Cupboard in Bullet (pybullet): the engine of the authors' simulator, at its scale and step.

Needs the optional extra ``reference``. It separates effects of the engine from effects of our
model, and lets us measure our cost beside its cost in one run. As in the authors' simulator,
objects are free bodies in three dimensions, and settings they left at Bullet's defaults stay there.
"""

from __future__ import annotations

import math
import weakref
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_device.world.base import (
    WALL,
    FingerContact,
    FingerState,
    Touch,
    WorldError,
    merge_touches,
    substeps,
)
from sim_device.world.mujoco_model import GRAVITY, yaw_inertia
from sim_device.world.parameters import WorldParameters, world_parameters
from sim_device.world.scenes import Scene, SceneObject, Shape
from tactile_core.arrays import FloatArray
from tactile_core.geometry import FINGER_HEIGHT
from tactile_core.types import Twist

BULLET_STEP = 1 / 240
"""Time of one engine step, s: the authors' and Bullet's own."""

UNITS = 10.0
"""The authors' length units per metre. Bullet's margins are made for bodies of about one unit."""

CLEARANCE = 0.011
"""Distance between shelf and finger, m."""

_THICK = 0.5
"""Half the thickness of shelf and walls, units: thick enough that nothing tunnels."""
_TALL = 2.0
"""Half the height of the walls, units; the authors' walls keep objects in under all conditions."""
_FALLEN = -0.5
"""Units below the shelf at which an object counts as fallen."""


Motion = list[tuple[float, float, float]]
"""For each of x, y and heading: position (m or rad), speed (m/s or rad/s), motor force (N or
N·m)."""


class PybulletWorld:
    """`World` on a Bullet model of ``scene``; ImportError if pybullet is not installed.

    ``parameters``: None for the set that the scene names. Objects that overlap a wall are left to
    the engine, as the authors leave theirs. Each call makes the whole number of Bullet steps next
    below the time asked for; the next call makes up for the rest.
    """

    def __init__(self, scene: Scene, parameters: WorldParameters | None = None) -> None:
        import pybullet

        parameters = parameters or world_parameters(scene.parameters)
        self._scene, self._parameters = scene, parameters
        self._bullet = bullet = pybullet
        self._client = client = bullet.connect(bullet.DIRECT)
        weakref.finalize(self, _disconnect, bullet, client)
        # Forces and times are in SI, so masses scale with lengths; weights stay.
        self._mass_units = parameters.inertia_scale / UNITS
        bullet.setGravity(0, 0, -GRAVITY / self._mass_units, physicsClientId=client)
        bullet.setPhysicsEngineParameter(
            fixedTimeStep=BULLET_STEP, deterministicOverlappingPairs=1, physicsClientId=client
        )
        friction = parameters.friction
        # Bullet multiplies two surfaces: finger on wall follows from the others.
        self._of_object = math.sqrt(friction.objects)
        self._add_cupboard()
        self._objects = [self._add_object(item) for item in scene.objects]
        self._body_of = {body: index for index, body in enumerate(self._objects)}
        self._finger = self._add_finger()
        self.limit_wrench(parameters.limits.f_max, parameters.limits.m_max)
        self._asked = 0.0
        self._steps = 0
        self._work = 0.0
        self._contacts: tuple[FingerContact, ...] = ()
        self._state = self._finger_state(self._motion(), [0.0] * 3, 1)

    def _body(self, mass: float, shape: int, place: FloatArray, yaw: float, friction: float) -> int:
        """Add a body of ``mass`` (0: fixed) at ``place``, units."""
        bullet, client = self._bullet, self._client
        turn = bullet.getQuaternionFromEuler((0, 0, yaw))
        body: int = bullet.createMultiBody(
            mass, shape, -1, place.tolist(), turn, physicsClientId=client
        )
        bullet.changeDynamics(body, -1, lateralFriction=friction, physicsClientId=client)
        return body

    def _block(
        self, low: tuple[float, float, float], high: tuple[float, float, float], friction: float
    ) -> None:
        """Add a fixed box between two corners, units; ``friction``: that of objects on it."""
        a, b = np.array(low), np.array(high)
        bullet = self._bullet
        shape = bullet.createCollisionShape(
            bullet.GEOM_BOX, halfExtents=((b - a) / 2).tolist(), physicsClientId=self._client
        )
        self._body(0.0, shape, (a + b) / 2, 0.0, friction / self._of_object)

    def _add_cupboard(self) -> None:
        """Add the shelf, with its upper face at 0, and three walls."""
        depth, half = self._scene.depth * UNITS, self._scene.width / 2 * UNITS
        lip, far = -self._parameters.lip * UNITS, depth + _THICK
        wide = half + 2 * _THICK
        shelf, wall = self._parameters.friction.object_shelf, self._parameters.friction.object_wall
        self._block((lip, -wide, -2 * _THICK), (far, wide, 0.0), shelf)
        self._block((depth, -wide, 0.0), (depth + 2 * _THICK, wide, 2 * _TALL), wall)
        self._block((lip, half, 0.0), (far, half + 2 * _THICK, 2 * _TALL), wall)
        self._block((lip, -half - 2 * _THICK, 0.0), (far, -half, 2 * _TALL), wall)

    def _add_object(self, item: SceneObject) -> int:
        bullet, height = self._bullet, item.height * UNITS
        if item.shape is Shape.DISC:
            shape = bullet.createCollisionShape(
                bullet.GEOM_CYLINDER,
                radius=item.radius * UNITS,
                height=height,
                physicsClientId=self._client,
            )
        else:
            half = [item.size_x * UNITS / 2, item.size_y * UNITS / 2, height / 2]
            shape = bullet.createCollisionShape(
                bullet.GEOM_BOX, halfExtents=half, physicsClientId=self._client
            )
        place = np.array([item.x * UNITS, item.y * UNITS, height / 2])
        return self._body(item.mass * self._mass_units, shape, place, item.yaw, self._of_object)

    def _add_finger(self) -> int:
        """Add the finger: two slides and a hinge at the pivot; only the last link has a shape."""
        bullet, p, start = self._bullet, self._parameters, self._scene.start
        low = CLEARANCE * UNITS
        high = low + FINGER_HEIGHT * UNITS
        middle = (low + high) / 2
        corners = [
            [x * UNITS, y * UNITS, z] for x, y in p.outline for z in (low - middle, high - middle)
        ]
        shape = bullet.createCollisionShape(
            bullet.GEOM_MESH, vertices=corners, physicsClientId=self._client
        )
        slide, hinge, zero = bullet.JOINT_PRISMATIC, bullet.JOINT_REVOLUTE, [0.0, 0.0, 0.0]
        mass = p.finger_mass / UNITS
        body: int = bullet.createMultiBody(
            basePosition=[start.x * UNITS, start.y * UNITS, middle],
            # Bullet requires every link to have mass.
            linkMasses=[mass / 1000, mass / 1000, mass],
            linkCollisionShapeIndices=[-1, -1, shape],
            linkVisualShapeIndices=[-1, -1, -1],
            linkPositions=[zero] * 3,
            linkOrientations=[[0.0, 0.0, 0.0, 1.0]] * 3,
            linkInertialFramePositions=[zero] * 3,
            linkInertialFrameOrientations=[[0.0, 0.0, 0.0, 1.0]] * 3,
            linkParentIndices=[0, 1, 2],
            linkJointTypes=[slide, slide, hinge],
            linkJointAxis=[[1, 0, 0], [0, 1, 0], [0, 0, 1]],
            physicsClientId=self._client,
        )
        bullet.changeDynamics(
            body,
            2,
            lateralFriction=p.friction.finger_object / self._of_object,
            localInertiaDiagonal=[p.finger_inertia * UNITS] * 3,
            physicsClientId=self._client,
        )
        bullet.resetJointState(body, 2, start.heading, physicsClientId=self._client)
        return body

    @property
    def scene(self) -> Scene:
        """Scene it was built from."""
        return self._scene

    @property
    def parameters(self) -> WorldParameters:
        """Physical parameters it was built with."""
        return self._parameters

    @property
    def outline(self) -> tuple[tuple[float, float], ...]:
        """Corners of the finger, x, y in ``ee``, m."""
        return self._parameters.outline

    @property
    def time(self) -> float:
        """Simulated time since it was built, s: the time asked for."""
        return self._asked

    def step(self, dt: float, twist: Twist) -> None:
        """Advance ``dt`` s, see `World.step`."""
        substeps(dt)
        if not (math.isfinite(twist.vx) and math.isfinite(twist.vy) and math.isfinite(twist.omega)):
            raise ValueError(f"{twist} is not finite")
        bullet, client, finger = self._bullet, self._client, self._finger
        bullet.setJointMotorControlArray(
            finger,
            (0, 1, 2),
            bullet.VELOCITY_CONTROL,
            targetVelocities=(twist.vx * UNITS, twist.vy * UNITS, twist.omega),
            forces=self._bounds,
            physicsClientId=client,
        )
        self._asked += dt
        count = math.floor(self._asked / BULLET_STEP + 1e-6) - self._steps
        touches: list[Touch] = []
        wrench = [0.0, 0.0, 0.0]
        before = self._motion()
        for _ in range(count):
            bullet.stepSimulation(physicsClientId=client)
            after = self._motion()
            self._read(touches, wrench, before)
            for (_, v0, _), (_, v1, motor) in zip(before, after, strict=True):
                self._work += motor * (v0 + v1) / 2 * BULLET_STEP
            before = after
        self._steps += count
        self._contacts = merge_touches(touches, count)
        self._state = self._finger_state(before, wrench, count)

    def _motion(self) -> Motion:
        states = self._bullet.getJointStates(self._finger, (0, 1, 2), physicsClientId=self._client)
        (x, u, _, fx), (y, v, _, fy), (heading, omega, _, moment) = states
        if not (math.isfinite(x) and math.isfinite(y) and math.isfinite(heading)):
            raise WorldError(f"physics gave up at {self.time:.3f} s of scene {self._scene.seed}")
        return [
            (x / UNITS, u / UNITS, fx),
            (y / UNITS, v / UNITS, fy),
            (heading, omega, moment / UNITS),
        ]

    def _finger_state(self, motion: Motion, wrench: list[float], count: int) -> FingerState:
        (x, vx, _), (y, vy, _), (heading, omega, _) = motion
        start = self._scene.start
        fx, fy, mz = (value / count for value in wrench)
        return FingerState(x + start.x, y + start.y, heading, Twist(vx, vy, omega), fx, fy, mz)

    def _read(self, touches: list[Touch], wrench: list[float], motion: Motion) -> None:
        """Add the touches of the last step.

        ``motion`` is from before it, as Bullet's contact places are. ``wrench``: N, N, N·m about
        the pivot in ``cupboard``, summed.
        """
        (px, _, _), (py, _, _), (heading, _, _) = motion
        px, py = px + self._scene.start.x, py + self._scene.start.y
        c, s = math.cos(heading), math.sin(heading)
        points = self._bullet.getContactPoints(self._finger, physicsClientId=self._client)
        for _, _, other, _, _, place, _, normal, _, push, first, along, second, across in points:
            # The normal points at the first body, the finger, and the push acts on it; friction is
            # given as it acts on the other.
            nx, ny, _ = normal
            fx = push * nx - first * along[0] - second * across[0]
            fy = push * ny - first * along[1] - second * across[1]
            x, y = place[0] / UNITS - px, place[1] / UNITS - py
            wrench[0] += fx
            wrench[1] += fy
            wrench[2] += x * fy - y * fx
            flat = math.hypot(nx, ny)
            if push <= 0.0 or flat < 0.5:
                continue  # taxels do not feel what presses on the finger from above or below
            nx, ny = nx / flat, ny / flat
            touches.append(
                (
                    self._body_of.get(other, WALL),
                    c * x + s * y,
                    c * y - s * x,
                    # The finger's outward normal is opposite to the push.
                    -c * nx - s * ny,
                    -c * ny + s * nx,
                    c * fx + s * fy,
                    c * fy - s * fx,
                )
            )

    def limit_wrench(self, f_max: float, m_max: float) -> None:
        """Bound the motors, see `World.limit_wrench`."""
        if not (0 < f_max < math.inf and 0 < m_max < math.inf):
            raise ValueError(f"wrench limits {f_max} N and {m_max} N·m are not finite and positive")
        self._bounds = (f_max, f_max, m_max * UNITS)

    def contacts(self) -> tuple[FingerContact, ...]:
        """Contacts on the finger, forces averaged over the last step."""
        return self._contacts

    def finger(self) -> FingerState:
        """Pose, twist and wrench of the finger."""
        return self._state

    def poses(self) -> FloatArray:
        """(n, 3) x, y m and yaw rad of each object, wherever it fell."""
        rows = []
        for body in self._objects:
            (x, y, _), turn = self._place(body)
            yaw = self._bullet.getEulerFromQuaternion(turn)[2]
            rows.append([x / UNITS, y / UNITS, yaw])
        return np.array(rows, np.float64).reshape(len(rows), 3)

    def _place(self, body: int) -> tuple[tuple[float, float, float], tuple[float, ...]]:
        found: tuple[tuple[float, float, float], tuple[float, ...]] = (
            self._bullet.getBasePositionAndOrientation(body, physicsClientId=self._client)
        )
        return found

    def on_shelf(self) -> NDArray[np.bool_]:
        """(n,) whether each object still stands on the shelf."""
        return np.array([self._place(body)[0][2] > _FALLEN for body in self._objects], np.bool_)

    @property
    def ejected(self) -> int:
        """Objects that were pushed past the front edge and fell."""
        return int(np.count_nonzero(~self.on_shelf()))

    def kinetic_energy(self) -> float:
        """Kinetic energy of finger and objects in the plane, J."""
        p, twist = self._parameters, self._state.twist
        doubled = p.finger_mass * (twist.vx**2 + twist.vy**2) + p.finger_inertia * twist.omega**2
        for item, body in zip(self._scene.objects, self._objects, strict=True):
            (vx, vy, _), (_, _, omega) = self._bullet.getBaseVelocity(
                body, physicsClientId=self._client
            )
            flat = item.mass * (vx**2 + vy**2) / UNITS**2 + yaw_inertia(item) * omega**2
            doubled += p.inertia_scale * flat
        return float(doubled / 2)

    @property
    def motor_work(self) -> float:
        """Work of the motors since it was built, J; braking counts negative."""
        return self._work


def _disconnect(bullet: Any, client: int) -> None:
    """Free the engine's memory: one process has room for a thousand worlds."""
    if bullet.isConnected(client):
        bullet.disconnect(client)
