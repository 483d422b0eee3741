"""Motion to the pose from which a reach starts."""

from __future__ import annotations

import math
from dataclasses import dataclass

from reachd.parameter_fields import Parameters
from reachd.primitives import wrapped
from reachd.seam import ArmState, Twist

NEAR = 0.002
"""m from the pose that counts as there: the noise of a robot arm's pose is a tenth of it."""

STRAIGHT = 0.02
"""rad from the heading that counts as there: 3 mm at the tip."""

APPROACH = 2.0
"""1/s: speed per distance left, so that the arm arrives without overshoot at 100 Hz."""

CLEAR = 0.01
"""m in front of the cupboard at which the tip is out of it."""


@dataclass(frozen=True, slots=True)
class Pose:
    """Pose of the pivot: m, m, rad in ``cupboard``."""

    x: float
    y: float
    heading: float


def home_twist(arm: ArmState, home: Pose, parameters: Parameters) -> Twist | None:
    """Twist towards ``home``, None when there.

    As long as the tip is inside the cupboard the arm only backs out along −x, so that it sweeps
    nothing aside; in front of it, it goes straight home, turning as it goes.
    """
    ex, ey = home.x - arm.x, home.y - arm.y
    turn = wrapped(home.heading - arm.heading)
    distance = math.hypot(ex, ey)
    if distance < NEAR and abs(turn) < STRAIGHT:
        return None
    v_max, omega_max = parameters.v_max, parameters.omega_max
    inside = arm.x + parameters.tip_length * math.cos(arm.heading) > -CLEAR
    if inside and (abs(ey) > NEAR or abs(turn) > STRAIGHT):
        return Twist(-v_max, 0.0, 0.0)
    part = min(v_max / distance, APPROACH) if distance > 0.0 else 0.0
    omega = max(-omega_max, min(omega_max, APPROACH * turn))
    return Twist(ex * part, ey * part, omega)
