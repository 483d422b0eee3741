"""Types between touch, arm, strategy and safety gate: what a strategy is given, what it returns.

Frames. ``cupboard``: origin at the middle of the cupboard's front edge, x into the cupboard, y to
the left, angles counter-clockwise from x. ``ee``: origin at the wrist pivot, x along the finger
towards its tip, y to the left. Everything is planar. (The paper's axes are x right, y forward,
angles from y: x_here = y_paper, y_here = −x_paper.)
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

from tactile_core.geometry import Side
from tactile_core.types import ZERO, ArmState, Instant, Twist, record

__all__ = [
    "ZERO",
    "ArmState",
    "Goal",
    "Patch",
    "Strategy",
    "Touch",
    "Twist",
    "Wrench",
    "arm_wrench",
]


@record
class Wrench:
    """Force (N, N) and moment about the wrist pivot (N·m) on the end-effector, in ``ee``."""

    fx: float
    fy: float
    mz: float


NO_WRENCH = Wrench(0.0, 0.0, 0.0)


@record
class Patch:
    """One place where something presses on the skin, in ``ee``.

    ``x``, ``y``: m, the centre of pressure. ``normal_x``, ``normal_y``: unit vector out of the skin
    there. ``normal_force``: N, positive when pressed. ``shear_force``: N along the skin, positive
    90° counter-clockwise of the normal. ``bound``: N; in 95 % of cycles the true normal force is
    within this of ``normal_force``: 0 where an engine's contacts are felt as they are, NaN for
    unknown.
    """

    x: float
    y: float
    normal_x: float
    normal_y: float
    normal_force: float
    shear_force: float
    side: Side
    bound: float = math.nan

    @property
    def force_x(self) -> float:
        """N along x of ``ee``: what presses exerts this on the finger, friction included."""
        return -self.normal_force * self.normal_x - self.shear_force * self.normal_y

    @property
    def force_y(self) -> float:
        """N along y of ``ee``."""
        return -self.normal_force * self.normal_y + self.shear_force * self.normal_x


def planar_patch(
    place: tuple[float, float],
    normal: tuple[float, float],
    normal_force: float,
    force: tuple[float, float],
    side: Side,
    bound: float,
) -> Patch:
    """`Patch` of a skin in space. x and y in ``ee`` of its place (m), normal and force (N).

    A normal may lean up or down: its direction in the plane counts. Where it has none the patch's
    normal and shear are 0.
    """
    nx, ny = normal
    length = math.hypot(nx, ny)
    nx, ny = (nx / length, ny / length) if length > 0.0 else (0.0, 0.0)
    x, y = place
    fx, fy = force
    return Patch(x, y, nx, ny, normal_force, fy * nx - fx * ny, side, bound)


@record
class Touch:
    """What is felt: the contact features of one cycle; see ``ContactFeatures.msg``.

    ``captured``, ``received``: when the skin was sampled and when this was received. While
    ``valid`` is false no other field means anything: it does not mean that nothing is touched.

    ``peak_force`` (N), ``peak_side``, ``peak_x``, ``peak_y`` (m, ``ee``): the strongest contact.
    ``total_force``: N, sum of normal forces over the skin. ``tip_force``: N, the same at the tip.
    Bounds: N by which the true force may differ, in 95 % of cycles, from ``peak_force``,
    ``total_force`` and ``tip_force``; NaN for unknown. ``tip_contact_time``: s that the tip has
    been in light contact without a break.

    ``patches``: the contacts, strongest first. ``wrench``: sum of all contacts as the skin feels
    it. What the arm feels at its wrist is in `ArmState`, with stamps of its own; `arm_wrench` turns
    it into the same frame.
    """

    captured: Instant
    received: Instant
    valid: bool
    peak_force: float
    peak_side: Side
    peak_x: float
    peak_y: float
    total_force: float
    tip_force: float
    peak_force_bound: float = math.nan
    normal_force_bound: float = math.nan
    tip_force_bound: float = math.nan
    tip_contact_time: float = 0.0
    wrench: Wrench = NO_WRENCH
    patches: tuple[Patch, ...] = ()


def arm_wrench(arm: ArmState) -> Wrench:
    """The wrench that the arm reports, turned from ``cupboard`` to ``ee``."""
    c, s = math.cos(arm.heading), math.sin(arm.heading)
    return Wrench(c * arm.fx + s * arm.fy, c * arm.fy - s * arm.fx, arm.mz)


@dataclass(frozen=True, slots=True)
class Goal:
    """Where the tip is to go (m, ``cupboard``), how near (m), and how long it may take (s)."""

    x: float
    y: float
    radius: float
    time_limit: float


class Strategy(Protocol):
    """A reaching strategy: pure, its randomness from the generator it was made with."""

    def start(self, goal: Goal, now: Instant) -> None:
        """Begin a reach; forget any earlier one."""
        ...

    def step(self, touch: Touch, arm: ArmState, goal: Goal, now: Instant) -> Twist:
        """Twist of the pivot wanted now, before the safety gate."""
        ...

    @property
    def activity(self) -> str:
        """What it is doing now: "straight", "burrow", "excavate_cw", … or a word of its own."""
        ...
