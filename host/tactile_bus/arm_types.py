"""What every arm, simulated or real, is told and says: twists, state and limits.

Planar quantities are in the cupboard's frame ``cupboard``: origin at the middle of its front
edge, x into the cupboard, y left, angles counter-clockwise from x. (The paper's axes are x right,
y forward, angles from y: x_here = y_paper, y_here = −x_paper.)
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final

from tactile_bus.instant import Instant
from tactile_bus.records import record


@record
class Twist:
    """Planar velocity of the wrist pivot. m/s in ``cupboard``, rad/s counter-clockwise."""

    vx: float
    vy: float
    omega: float


ZERO = Twist(0.0, 0.0, 0.0)


@record
class Echo:
    """What an arm says of whom it obeys, and of the command in force or the last that was.

    ``commander``: as granted, empty for nobody. ``decided``: instant of the decision, by the
    commander's clock; 0, as is ``sequence``, before the first. ``own``: for whoever reads the
    state, whether that commander is himself.
    """

    commander: str
    sequence: int
    decided: Instant
    own: bool = True


@record
class ArmState:
    """What the arm reports of itself at its own rate.

    Pose of the wrist pivot (m, rad) and its twist; wrench that the environment exerts on the
    end-effector about the pivot (N, N, N·m), all in ``cupboard``. ``mode`` is "ready", "moving",
    "stopped", "fault" or "estop". The limits are those the arm confirms: m/s, rad/s, N, N·m.
    ``echo`` is None where commands reach the arm without a way between: in lockstep.
    """

    captured: Instant
    received: Instant
    x: float
    y: float
    heading: float
    twist: Twist
    fx: float
    fy: float
    mz: float
    mode: str
    v_max: float
    omega_max: float
    f_max: float
    m_max: float
    echo: Echo | None = None


@dataclass(frozen=True, slots=True)
class ArmLimits:
    """Limits an arm is asked to keep: m/s, rad/s, N on each world axis, N·m about the pivot.

    ValueError unless all are finite and positive.
    """

    v_max: float
    omega_max: float
    f_max: float
    m_max: float

    def __post_init__(self) -> None:
        """Refuse limits that would not limit."""
        for name in ("v_max", "omega_max", "f_max", "m_max"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise ValueError(f"{name} is {value}; a limit is finite and above 0")


ARM_LIMITS: Final = MappingProxyType(
    {
        # Table I of the paper, as printed.
        "hardware": ArmLimits(v_max=0.045, omega_max=0.1, f_max=15.0, m_max=4.5),
        # Authors' simulator at true scale: 0.5 u/s and ±15 at a lever of ten times its length.
        # Its excavation turns at 0.25 rad/s of the 0.35 allowed; that belongs to the primitive.
        "authors_sim": ArmLimits(v_max=0.05, omega_max=0.35, f_max=10.0, m_max=1.5),
    }
)
"""Limits of the two named parameter sets."""
