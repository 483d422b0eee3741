"""Cupboard in Chipmunk (pymunk): a second engine, to check the first.

Needs the optional extra ``crosscheck``. It differs from MuJoCo in kind: contacts solved by
impulses in true two dimensions, friction as the product of two surfaces, shelf friction as a
circle of force and a separate bound on torque.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_device.world.base import (
    PHYSICS_STEP,
    WALL,
    FingerContact,
    FingerState,
    Touch,
    merge_touches,
    substeps,
)
from sim_device.world.mujoco_model import GRAVITY, MOTOR_TIME, mean_lever, yaw_inertia
from sim_device.world.parameters import WorldParameters, world_parameters
from sim_device.world.scene_squeeze import settled
from sim_device.world.scenes import Scene, SceneObject, Shape
from tactile_core.arrays import FloatArray
from tactile_core.types import Twist

ITERATIONS = 30
"""Iterations of the impulse solver; with fewer, jams give way."""

SLOP = 1e-4
"""Overlap that is left alone, m, so that resting contacts persist."""


class PymunkWorld:
    """`World` on a pymunk model of ``scene``; ImportError if pymunk is not installed.

    Same calls give the same motion to within rounding, but not bit for bit, as pymunk numbers
    shapes over the life of the process.
    """

    def __init__(self, scene: Scene, parameters: WorldParameters | None = None) -> None:
        import pymunk

        parameters = parameters or world_parameters(scene.parameters)
        self._scene = scene
        self._parameters = parameters
        self._f_max, self._m_max = parameters.limits.f_max, parameters.limits.m_max
        self._space = space = pymunk.Space()
        space.iterations = ITERATIONS
        space.collision_slop = SLOP
        # Half of an overlap is removed in 4 steps, as fast as MuJoCo's 10 ms.
        space.collision_bias = 0.5 ** (1 / (4 * PHYSICS_STEP))
        friction = parameters.friction
        # Products of these give each pair's coefficient; finger on wall follows as their product.
        of_object = math.sqrt(friction.objects)
        of_wall = friction.object_wall / of_object
        self._bodies: dict[Any, int] = {space.static_body: WALL}
        depth, half = scene.depth, scene.width / 2
        thick = 0.05
        for a, b in (
            ((depth + thick, -half), (depth + thick, half)),
            ((-parameters.lip, half + thick), (depth, half + thick)),
            ((-parameters.lip, -half - thick), (depth, -half - thick)),
        ):
            wall = pymunk.Segment(space.static_body, a, b, thick)
            wall.friction = of_wall
            space.add(wall)
        objects = settled(scene, parameters)
        self._objects = [
            self._add_object(pymunk, item, of_object, friction.object_shelf) for item in objects
        ]
        self._shelf = np.ones(len(objects), dtype=np.bool_)
        self._finger = finger = pymunk.Body(parameters.finger_mass, parameters.finger_inertia)
        finger.position = (scene.start.x, scene.start.y)
        finger.angle = scene.start.heading
        skin = pymunk.Poly(finger, parameters.outline)
        skin.friction = friction.finger_object / of_object
        space.add(finger, skin)
        self._steps = 0
        self._work = 0.0
        self._push = [0.0, 0.0, 0.0]
        self._wrench = (0.0, 0.0, 0.0)
        self._contacts: tuple[FingerContact, ...] = ()

    def _add_object(self, pymunk: Any, item: SceneObject, friction: float, shelf: float) -> Any:
        """Add a body for ``item`` with the shelf's friction as bounded joints to the ground."""
        heavier = self._parameters.inertia_scale
        body = pymunk.Body(heavier * item.mass, heavier * yaw_inertia(item))
        body.position = (item.x, item.y)
        body.angle = item.yaw
        if item.shape is Shape.DISC:
            shape = pymunk.Circle(body, item.radius)
        else:
            shape = pymunk.Poly.create_box(body, (item.size_x, item.size_y))
        shape.friction = friction
        weight = item.mass * GRAVITY
        ground = self._space.static_body
        slide = pymunk.PivotJoint(ground, body, (0, 0), (0, 0))
        turn = pymunk.GearJoint(ground, body, 0.0, 1.0)
        for joint, bound in ((slide, shelf * weight), (turn, shelf * weight * mean_lever(item))):
            joint.max_bias = 0.0  # resists motion, does not pull back
            joint.max_force = bound
        self._space.add(body, shape, slide, turn)
        self._bodies[body] = len(self._bodies) - 1
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
        """Simulated time since it was built, s."""
        return self._steps * PHYSICS_STEP

    def step(self, dt: float, twist: Twist) -> None:
        """Advance ``dt`` s, see `World.step`."""
        count = substeps(dt)
        if not (math.isfinite(twist.vx) and math.isfinite(twist.vy) and math.isfinite(twist.omega)):
            raise ValueError(f"{twist} is not finite")
        finger, p = self._finger, self._parameters
        inertia = (p.finger_mass, p.finger_mass, p.finger_inertia)
        bounds = (self._f_max, self._f_max, self._m_max)
        wanted = (twist.vx, twist.vy, twist.omega)
        touches: list[Touch] = []
        wrench = [0.0, 0.0, 0.0]
        push, before = self._push, (*finger.velocity, finger.angular_velocity)
        for _ in range(count):
            # A motor that answers to speed alone yields under load: compensate the last load.
            motor = [
                min(max(m / MOTOR_TIME * (want - speed) - load, -bound), bound)
                for m, want, speed, load, bound in zip(
                    inertia, wanted, before, push, bounds, strict=True
                )
            ]
            finger.apply_force_at_world_point((motor[0], motor[1]), finger.position)
            finger.torque += motor[2]
            self._space.step(PHYSICS_STEP)
            after = (*finger.velocity, finger.angular_velocity)
            push = [
                m * (new - old) / PHYSICS_STEP - drive
                for m, new, old, drive in zip(inertia, after, before, motor, strict=True)
            ]
            for axis in range(3):
                wrench[axis] += push[axis]
                self._work += motor[axis] * (before[axis] + after[axis]) / 2 * PHYSICS_STEP
            before = after
            self._read(touches)
        self._push = push
        self._drop()
        self._steps += count
        self._wrench = (wrench[0] / count, wrench[1] / count, wrench[2] / count)
        self._contacts = merge_touches(touches, count)

    def _read(self, touches: list[Touch]) -> None:
        """Add the touches of one physics step. A pair's force is divided among its points."""
        finger = self._finger
        c, s = math.cos(finger.angle), math.sin(finger.angle)
        origin = finger.position

        def note(arbiter: Any) -> None:
            mine, other = arbiter.bodies
            points = arbiter.contact_point_set
            sign = 1.0 if mine is finger else -1.0
            body = self._bodies[other if mine is finger else mine]
            nx, ny = points.normal * sign
            fx, fy = arbiter.total_impulse * (sign / PHYSICS_STEP / max(1, len(points.points)))
            for point in points.points:
                place = point.point_a if mine is finger else point.point_b
                x, y = place - origin
                touches.append(
                    (
                        body,
                        c * x + s * y,
                        c * y - s * x,
                        c * nx + s * ny,
                        c * ny - s * nx,
                        c * fx + s * fy,
                        c * fy - s * fx,
                    )
                )

        finger.each_arbiter(note)

    def _drop(self) -> None:
        """Remove objects that have passed the shelf's front edge."""
        for index, body in enumerate(self._objects):
            if self._shelf[index] and body.position.x < -self._parameters.lip:
                self._shelf[index] = False
                self._space.remove(*body.shapes, *body.constraints, body)

    def limit_wrench(self, f_max: float, m_max: float) -> None:
        """Bound the motors, see `World.limit_wrench`."""
        if not (0 < f_max < math.inf and 0 < m_max < math.inf):
            raise ValueError(f"wrench limits {f_max} N and {m_max} N·m are not finite and positive")
        self._f_max, self._m_max = f_max, m_max

    def contacts(self) -> tuple[FingerContact, ...]:
        """Contacts on the finger, forces averaged over the last step."""
        return self._contacts

    def finger(self) -> FingerState:
        """Pose, twist and wrench of the finger."""
        body = self._finger
        fx, fy, mz = self._wrench
        return FingerState(
            x=body.position.x,
            y=body.position.y,
            heading=body.angle,
            twist=Twist(body.velocity.x, body.velocity.y, body.angular_velocity),
            fx=fx,
            fy=fy,
            mz=mz,
        )

    def poses(self) -> FloatArray:
        """(n, 3) x, y m and yaw rad of each object; for fallen ones, where they left the shelf."""
        rows = [[b.position.x, b.position.y, b.angle] for b in self._objects]
        return np.array(rows).reshape(len(rows), 3)

    def on_shelf(self) -> NDArray[np.bool_]:
        """(n,) whether each object still stands on the shelf."""
        return self._shelf.copy()

    @property
    def ejected(self) -> int:
        """Objects that were pushed past the front edge and fell."""
        return int(np.count_nonzero(~self._shelf))

    def kinetic_energy(self) -> float:
        """Kinetic energy of finger and objects on the shelf, J."""
        standing = [b for b, on in zip(self._objects, self._shelf, strict=True) if on]
        # pymunk's own figure lacks the half.
        return float(sum(b.kinetic_energy for b in (*standing, self._finger))) / 2

    @property
    def motor_work(self) -> float:
        """Work of the motors since it was built, J; braking counts negative."""
        return self._work
