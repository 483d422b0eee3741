"""What a strategy sees and says: the seam between touch, arm, strategy and safety gate.

Planar quantities are in the cupboard's frame ``cupboard``: origin at the middle of its front
edge, x into the cupboard, y left, angles counter-clockwise from x. (The paper's axes are x right,
y forward, angles from y: x_here = y_paper, y_here = −x_paper.)
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

from tactile_core.geometry import Side
from tactile_core.types import ZERO, ArmState, Instant, Twist, record

__all__ = ["ZERO", "ArmState", "Goal", "Strategy", "Touch", "Twist"]


@record
class Touch:
    """The contact features a strategy may use; see ``ContactFeatures.msg``.

    Forces in N, ``peak_x``/``peak_y`` in m in ``ee``. ``total_force``: sum of normal forces over
    the skin. ``tip_force``: sum of normal forces at the tip. Bounds: N by which the true force may
    differ, in 95 % of cycles, from ``peak_force`` and from ``total_force``; NaN for unknown.
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
        """What it does: "straight", "burrow", "excavate_cw", "excavate_ccw" or its own word."""
        ...
