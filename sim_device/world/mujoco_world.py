"""Cupboard in MuJoCo: the engine from which every published figure comes."""

from __future__ import annotations

import logging
import math
from dataclasses import replace
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from sim_device.world.base import (
    PHYSICS_STEP,
    WALL,
    FingerContact,
    FingerState,
    Touch,
    WorldError,
    merge_touches,
    substeps,
)
from sim_device.world.mujoco_model import FINGER_GEOM, MOTOR_TIME, cupboard_model, yaw_inertia
from sim_device.world.parameters import WorldParameters, world_parameters
from sim_device.world.scene_squeeze import settled
from sim_device.world.scenes import Scene
from tactile_core.arrays import FloatArray
from tactile_core.types import Twist

_FALLEN = -0.02
"""Height below the shelf at which an object counts as fallen, m; contacts sink less than 1 mm."""

# Otherwise MuJoCo prints, and writes MUJOCO_LOG.TXT to the working directory.
mujoco.set_mju_user_warning(logging.getLogger(__name__).debug)


class MujocoWorld:
    """`World` on a planar MuJoCo model of ``scene``.

    ``parameters``: None for the set that the scene names. Objects that overlap a wall are first
    moved out of it, see `settled`.
    """

    def __init__(self, scene: Scene, parameters: WorldParameters | None = None) -> None:
        parameters = parameters or world_parameters(scene.parameters)
        self._scene = scene
        self._parameters = parameters
        self._outline = parameters.outline
        start = replace(scene, objects=settled(scene, parameters))
        self._model = model = cupboard_model(start, parameters)
        self._data = data = mujoco.MjData(model)
        data.qpos[-1] = scene.start.heading
        mujoco.mj_forward(model, data)
        n = len(scene.objects)
        self._initial = np.array([[o.x, o.y, o.yaw] for o in start.objects]).reshape(n, 3)
        self._mass = parameters.inertia_scale * np.array(
            [[o.mass, o.mass, yaw_inertia(o)] for o in scene.objects]
        )
        self._finger_mass = (parameters.finger_mass,) * 2 + (parameters.finger_inertia,)
        self._finger_geom = model.geom(FINGER_GEOM).id
        self._body_of_geom = [WALL] * model.ngeom
        for index in range(n):
            self._body_of_geom[model.geom(f"object_{index}").id] = index
        # Views: MuJoCo never moves these arrays.
        self._qpos, self._qvel, self._ctrl = data.qpos, data.qvel, data.ctrl
        self._finger_qpos, self._finger_qvel = data.qpos[-3:], data.qvel[-3:]
        self._finger_push = data.qfrc_constraint[-3:]
        self._objects_qpos = data.qpos[: 4 * n].reshape(n, 4)
        self._objects_qvel = data.qvel[: 4 * n].reshape(n, 4)
        # Counts by kind of warning; every kind is serious, see mjtWarning.
        self._warnings = data.warning.number
        self._start = scene.start
        self._steps = 0
        self._work = 0.0
        self._count = 1
        self._wrench = (0.0, 0.0, 0.0)
        self._touches: list[Touch] = []
        self._contacts: tuple[FingerContact, ...] | None = ()
        self._state: FingerState | None = None

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
        return self._outline

    @property
    def time(self) -> float:
        """Simulated time since it was built, s."""
        return self._steps * PHYSICS_STEP

    @property
    def model(self) -> Any:
        """``mujoco.MjModel``, for viewers."""
        return self._model

    @property
    def data(self) -> Any:
        """``mujoco.MjData``, for viewers."""
        return self._data

    def step(self, dt: float, twist: Twist) -> None:
        """Advance ``dt`` s, see `World.step`."""
        count = substeps(dt)
        if not (math.isfinite(twist.vx) and math.isfinite(twist.vy) and math.isfinite(twist.omega)):
            raise ValueError(f"{twist} is not finite")
        model, data = self._model, self._data
        self._touches.clear()
        self._contacts = self._state = None
        mass, _, inertia = self._finger_mass
        total_x = total_y = total_m = work = 0.0
        u0, v0, w0 = self._finger_qvel.tolist()
        fx, fy, mz = self._finger_push.tolist()
        for _ in range(count):
            pose = self._finger_qpos.tolist()
            # A motor that answers to speed alone yields under load: compensate the last load.
            self._ctrl[:] = (
                twist.vx - fx * MOTOR_TIME / mass,
                twist.vy - fy * MOTOR_TIME / mass,
                twist.omega - mz * MOTOR_TIME / inertia,
            )
            mujoco.mj_step(model, data)
            u1, v1, w1 = self._finger_qvel.tolist()
            fx, fy, mz = self._finger_push.tolist()
            # By momentum balance, the motors gave the finger what contacts did not.
            work += (
                (mass * (u1 - u0) - PHYSICS_STEP * fx) * (u0 + u1)
                + (mass * (v1 - v0) - PHYSICS_STEP * fy) * (v0 + v1)
                + (inertia * (w1 - w0) - PHYSICS_STEP * mz) * (w0 + w1)
            )
            u0, v0, w0 = u1, v1, w1
            if fx or fy or mz:
                total_x, total_y, total_m = total_x + fx, total_y + fy, total_m + mz
                self._gather(pose)
        self._work += work / 2
        self._steps += count
        self._count = count
        self._wrench = (total_x / count, total_y / count, total_m / count)
        if any(self._warnings.tolist()):
            raise WorldError(
                f"physics gave up at {self.time:.3f} s of scene {self._scene.seed} "
                f"({self._scene.source})"
            )

    def _gather(self, pose: list[float]) -> None:
        """Keep what touched the finger in the last physics step; ``pose`` is from before it.

        Loops, because a finger touches few things: arrays cost more to make than they save.
        """
        contact, me = self._data.contact, self._finger_geom
        found = [
            (index, first, second)
            for index, (first, second) in enumerate(contact.geom.tolist())
            if first == me or second == me
        ]
        if not found:
            return
        position, frames, distance = contact.pos, contact.frame, contact.dist
        address, forces = contact.efc_address, self._data.efc_force
        px, py, heading = pose
        c, s = math.cos(heading), math.sin(heading)
        px, py = px + self._start.x, py + self._start.y
        for index, first, second in found:
            row = int(address[index])
            if row < 0:
                continue
            # Normals point from the first geom to the second, forces act on the second.
            sign = 1.0 if first == me else -1.0
            nx, ny, _, ax, ay, _, bx, by, _ = frames[index].tolist()
            fn, fa, fb = forces[row : row + 3].tolist()
            fx = -sign * (fn * nx + fa * ax + fb * bx)
            fy = -sign * (fn * ny + fa * ay + fb * by)
            x, y, _ = position[index].tolist()
            # Half of the depth from the middle of the overlap to the finger's own surface.
            depth = sign * float(distance[index]) / 2
            x, y = x - nx * depth - px, y - ny * depth - py
            nx, ny = sign * nx, sign * ny
            self._touches.append(
                (
                    self._body_of_geom[second if first == me else first],
                    c * x + s * y,
                    c * y - s * x,
                    c * nx + s * ny,
                    c * ny - s * nx,
                    c * fx + s * fy,
                    c * fy - s * fx,
                )
            )

    def limit_wrench(self, f_max: float, m_max: float) -> None:
        """Bound the motors, see `World.limit_wrench`."""
        if not (0 < f_max < math.inf and 0 < m_max < math.inf):
            raise ValueError(f"wrench limits {f_max} N and {m_max} N·m are not finite and positive")
        bound = np.array([f_max, f_max, m_max])
        self._model.actuator_forcerange[:] = np.stack([-bound, bound], axis=1)

    def contacts(self) -> tuple[FingerContact, ...]:
        """Contacts on the finger, forces averaged over the last step."""
        if self._contacts is None:
            self._contacts = merge_touches(self._touches, self._count)
        return self._contacts

    def finger(self) -> FingerState:
        """Pose, twist and wrench of the finger."""
        if self._state is None:
            x, y, heading = self._finger_qpos.tolist()
            fx, fy, mz = self._wrench
            self._state = FingerState(
                x=x + self._start.x,
                y=y + self._start.y,
                heading=heading,
                twist=Twist(*self._finger_qvel.tolist()),
                fx=fx,
                fy=fy,
                mz=mz,
            )
        return self._state

    def poses(self) -> FloatArray:
        """(n, 3) x, y m and yaw rad of each object."""
        poses: FloatArray = self._initial + self._objects_qpos[:, [0, 1, 3]]
        return poses

    def on_shelf(self) -> NDArray[np.bool_]:
        """(n,) whether each object still stands on the shelf."""
        standing: NDArray[np.bool_] = self._objects_qpos[:, 2] > _FALLEN
        return standing

    @property
    def ejected(self) -> int:
        """Objects that were pushed past the front edge and fell."""
        return int(np.count_nonzero(~self.on_shelf()))

    def kinetic_energy(self) -> float:
        """Kinetic energy of finger and objects in the plane, J."""
        doubled = float((self._mass * self._objects_qvel[:, [0, 1, 3]] ** 2).sum())
        doubled += float((np.array(self._finger_mass) * self._finger_qvel**2).sum())
        return doubled / 2

    @property
    def motor_work(self) -> float:
        """Work of the motors since it was built, J; braking counts negative."""
        return self._work
