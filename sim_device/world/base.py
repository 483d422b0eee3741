"""Interface between the physics engines and their users."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from sim_device.world.parameters import WorldParameters
from sim_device.world.scenes import Scene
from tactile_core.arrays import FloatArray
from tactile_core.types import Twist, record

PHYSICS_STEP = 0.005
"""Time of one physics step, s. MuJoCo diverges at 10 ms; 5 ms is as accurate as 2.5 and twice as
fast."""

WALL = -1
"""Body id of back and side walls among contacts."""

MERGE_RADIUS = 0.003
"""Touches of one body closer than this, m, are one contact. Engines report the upper and lower
corner of an edge separately, and corners move by v_max × a control period = 0.5 mm."""


class WorldError(RuntimeError):
    """The physics diverged or overflowed: this trial is invalid."""


Touch = tuple[int, float, float, float, float, float, float]
"""Contact point of an engine: body; place x, y m, outward normal x, y, force x, y N, in ``ee``."""


@record
class FingerContact:
    """One place where a body presses on the finger.

    ``x``, ``y``: m in ``ee``, on the finger's surface. ``normal_x``, ``normal_y``: outward unit
    normal of the finger there. ``force_x``, ``force_y``: N in ``ee``, what the body exerts on the
    finger, friction included. ``body``: index into ``Scene.objects``, or `WALL`.
    """

    x: float
    y: float
    normal_x: float
    normal_y: float
    force_x: float
    force_y: float
    body: int

    @property
    def normal_force(self) -> float:
        """Normal force, N, positive when pressed."""
        return -(self.force_x * self.normal_x + self.force_y * self.normal_y)

    @property
    def shear_force(self) -> float:
        """Friction along the surface, N, positive 90° counter-clockwise of the outward normal."""
        return self.force_y * self.normal_x - self.force_x * self.normal_y


@record
class FingerState:
    """Pivot's pose (m, m, rad) and twist in ``cupboard``, wrench (N, N, N·m) on the finger.

    The wrench is what contacts exert, about the pivot, averaged over the last step.
    """

    x: float
    y: float
    heading: float
    twist: Twist
    fx: float
    fy: float
    mz: float


class World(Protocol):
    """Cupboard with a finger in it, in one plane. Deterministic: same calls, same bits."""

    @property
    def scene(self) -> Scene:
        """Scene it was built from."""
        ...

    @property
    def parameters(self) -> WorldParameters:
        """Physical parameters it was built with."""
        ...

    @property
    def outline(self) -> tuple[tuple[float, float], ...]:
        """Corners of the finger, x, y in ``ee``, m."""
        ...

    @property
    def time(self) -> float:
        """Simulated time since it was built, s."""
        ...

    def step(self, dt: float, twist: Twist) -> None:
        """Advance ``dt`` s while the pivot's motors aim at ``twist``.

        ValueError if ``dt`` is not a multiple of `PHYSICS_STEP` or ``twist`` is not finite;
        WorldError if the engine fails.
        """
        ...

    def limit_wrench(self, f_max: float, m_max: float) -> None:
        """Bound the motors: N on each axis of ``cupboard``, N·m about the pivot; ValueError."""
        ...

    def contacts(self) -> tuple[FingerContact, ...]:
        """Contacts on the finger, forces averaged over the last `step`."""
        ...

    def finger(self) -> FingerState:
        """Pose, twist and wrench of the finger."""
        ...

    def poses(self) -> FloatArray:
        """(n, 3) x, y m and yaw rad of each object in ``cupboard``, fallen ones included."""
        ...

    def on_shelf(self) -> NDArray[np.bool_]:
        """(n,) whether each object still stands on the shelf."""
        ...

    @property
    def ejected(self) -> int:
        """Objects that were pushed past the front edge and fell."""
        ...

    def kinetic_energy(self) -> float:
        """Kinetic energy of finger and objects in the plane, J."""
        ...

    @property
    def motor_work(self) -> float:
        """Work of the motors since it was built, J; braking counts negative."""
        ...


def substeps(dt: float) -> int:
    """Number of physics steps in ``dt`` s; ValueError if it is not a whole number."""
    count = round(dt / PHYSICS_STEP)
    if count < 1 or abs(count * PHYSICS_STEP - dt) > 1e-9:
        raise ValueError(f"a step of {dt} s is not a multiple of {PHYSICS_STEP} s")
    return count


def merge_touches(touches: Sequence[Touch], count: int) -> tuple[FingerContact, ...]:
    """Contacts from the touches of ``count`` physics steps.

    Touches of one body within `MERGE_RADIUS` of each other become one: forces summed and divided
    by ``count``, place and normal weighted by normal force. Touches that do not press are dropped.
    """
    if not touches:
        return ()
    groups: list[list[float]] = []  # weight; then weighted x, y, normal x, y; then force x, y
    owners: list[int] = []
    for body, x, y, nx, ny, fx, fy in touches:
        weight = -(fx * nx + fy * ny)
        if weight <= 0.0:
            continue
        for group, owner in zip(groups, owners, strict=True):
            dx, dy = x - group[1] / group[0], y - group[2] / group[0]
            if owner == body and dx * dx + dy * dy < MERGE_RADIUS**2:
                group[0] += weight
                group[1] += weight * x
                group[2] += weight * y
                group[3] += weight * nx
                group[4] += weight * ny
                group[5] += fx
                group[6] += fy
                break
        else:
            groups.append([weight, weight * x, weight * y, weight * nx, weight * ny, fx, fy])
            owners.append(body)
    return tuple([_contact(g, count, body) for g, body in zip(groups, owners, strict=True)])


def _contact(group: list[float], count: int, body: int) -> FingerContact:
    """Contact from the weighted sums of its touches in ``count`` physics steps."""
    weight, x, y, nx, ny, fx, fy = group
    length = math.hypot(nx, ny)
    return FingerContact(
        x / weight, y / weight, nx / length, ny / length, fx / count, fy / count, body
    )
