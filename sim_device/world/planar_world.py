"""The cupboard in the project's own planar engine: MuJoCo's law of contact, several times faster.

Needs the optional extra ``train`` (Numba, which compiles the kernels of `planar_solver` when they
are first used and keeps them on disk).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from sim_device.world.base import PHYSICS_STEP, FingerContact, FingerState, WorldError, substeps
from sim_device.world.parameters import WorldParameters, world_parameters
from sim_device.world.planar_arrays import Arrays, arrays_of, poses_of, standing
from sim_device.world.planar_solver import OVERFLOW, advance
from sim_device.world.scenes import Scene
from tactile_core.arrays import FloatArray
from tactile_core.types import Twist


class PlanarWorld:
    """`World` in the plane.

    ``parameters``: None for the set that the scene names. Objects that overlap a wall are first
    moved out of it, see `settled`. What is pushed past the front edge is gone at once, where in
    MuJoCo it still falls for a moment.
    """

    def __init__(self, scene: Scene, parameters: WorldParameters | None = None) -> None:
        parameters = parameters or world_parameters(scene.parameters)
        self._scene = scene
        self._parameters = parameters
        self._outline = parameters.outline
        self._arrays = arrays = arrays_of([scene], [parameters])
        # Views, which the kernel writes.
        self._all = arrays.all
        self._wanted, self._felt = arrays.wanted[0], arrays.felt[0]
        self._readout = arrays.readout[0]
        self._steps = 0
        self._contacts: tuple[FingerContact, ...] | None = ()
        self._state: FingerState | None = None
        self._out = self._readout.tolist()

    @property
    def scene(self) -> Scene:
        """What it was built from."""
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
    def arrays(self) -> Arrays:
        """Its memory, one row, for tests and whoever looks at the objects' velocities."""
        return self._arrays

    @property
    def time(self) -> float:
        """Simulated s since it was built."""
        return self._steps * PHYSICS_STEP

    def step(self, dt: float, twist: Twist) -> None:
        """Advance ``dt`` s, see `World.step`."""
        count = substeps(dt)
        if not (math.isfinite(twist.vx) and math.isfinite(twist.vy) and math.isfinite(twist.omega)):
            raise ValueError(f"{twist} is not finite")
        self._wanted[:] = twist.vx, twist.vy, twist.omega
        advance(0, count, *self._all)
        self._steps += count
        self._out = out = self._readout.tolist()
        self._contacts = self._state = None
        if out[11]:
            why = "has too many contacts" if out[11] == OVERFLOW else "diverged"
            raise WorldError(
                f"physics {why} at {self.time:.3f} s of scene {self._scene.seed} "
                f"({self._scene.source})"
            )

    def limit_wrench(self, f_max: float, m_max: float) -> None:
        """Bound the motors, see `World.limit_wrench`."""
        if not (0 < f_max < math.inf and 0 < m_max < math.inf):
            raise ValueError(f"wrench limits {f_max} N and {m_max} N·m are not finite and positive")
        world = self._arrays.worlds[0]
        world["f_max"], world["m_max"] = f_max, m_max

    def contacts(self) -> tuple[FingerContact, ...]:
        """Contacts on the finger, forces averaged over the last step."""
        if self._contacts is None:
            count = int(self._out[9])
            self._contacts = tuple(
                [
                    FingerContact(x, y, nx, ny, fx, fy, int(body))
                    for _, x, y, nx, ny, fx, fy, body in self._felt[:count].tolist()
                ]
            )
        return self._contacts

    def finger(self) -> FingerState:
        """Where the finger is, how it moves and what pushes it."""
        if self._state is None:
            x, y, heading, vx, vy, omega, fx, fy, mz = self._out[:9]
            self._state = FingerState(
                x=x, y=y, heading=heading, twist=Twist(vx, vy, omega), fx=fx, fy=fy, mz=mz
            )
        return self._state

    def poses(self) -> FloatArray:
        """(n, 3) x, y m and yaw rad of each object, where it left the shelf if it fell."""
        return poses_of(self._arrays.bodies[0], len(self._scene.objects))

    def on_shelf(self) -> NDArray[np.bool_]:
        """(n,) whether each object still stands on the shelf."""
        return standing(self._arrays.bodies[0], len(self._scene.objects))

    @property
    def ejected(self) -> int:
        """Objects that were pushed past the front edge and fell."""
        return int(self._out[10])

    def kinetic_energy(self) -> float:
        """J, of finger and objects in the plane."""
        bodies = self._arrays.bodies[0, : len(self._scene.objects) + 1]
        speed = bodies["vx"] ** 2 + bodies["vy"] ** 2
        doubled = speed / bodies["inv_mass"] + bodies["omega"] ** 2 / bodies["inv_inertia"]
        return float(doubled.sum()) / 2

    @property
    def motor_work(self) -> float:
        """J that the motors have put in since it was built."""
        return float(self._out[12])
