"""Equations (1) to (8) of the paper as pure functions.

The paper's axes are x right, y forward, angles from y; ours (``cupboard``, see `interfaces`) are x
forward, y left, angles from x. One is the other turned by 90° about z, so x_here = y_paper,
y_here = −x_paper, angles and cross products stay as they are, and R_θ of equation (5) turns
(forward, left) = (y_paper, −x_paper) of the finger into the cupboard.
"""

from __future__ import annotations

import math

from reachd.interfaces import ArmState, Goal, Twist
from reachd.strategies.parameter_fields import Parameters
from tactile_core.types import record

TURN = 2.0 * math.pi


@record
class Aim:
    """Tip and goal: position of the tip (m), distance (m), unit vector d̂ and its angle φ (rad).

    At distance zero d̂ is the zero vector and φ the heading: nowhere to go, nothing to turn to.
    """

    tip_x: float
    tip_y: float
    distance: float
    dx: float
    dy: float
    angle: float


def aim(arm: ArmState, goal: Goal, tip_length: float) -> Aim:
    """Where the goal lies from the tip of the finger."""
    x = arm.x + tip_length * math.cos(arm.heading)
    y = arm.y + tip_length * math.sin(arm.heading)
    ex, ey = goal.x - x, goal.y - y
    distance = math.hypot(ex, ey)
    if distance == 0.0:
        return Aim(x, y, 0.0, 0.0, 0.0, arm.heading)
    return Aim(x, y, distance, ex / distance, ey / distance, math.atan2(ey, ex))


def wrapped(angle: float) -> float:
    """``angle`` (rad) brought to [−π, π]."""
    return math.remainder(angle, TURN)


def turn_rate(aimed: Aim, heading: float, fastest: float, tolerance: float, within: float) -> float:
    """Equation (2): sign(φ − θ)·ω_max, and ``within`` (rad/s) where |φ − θ| < ``tolerance``."""
    error = wrapped(aimed.angle - heading)
    if error == 0.0:
        return 0.0
    return math.copysign(within if abs(error) < tolerance else fastest, error)


def pivot_velocity(
    vx: float, vy: float, omega: float, heading: float, parameters: Parameters
) -> Twist:
    """Twist of the pivot that gives the commanded point the velocity (vx, vy).

    The tip's velocity is the pivot's plus ω ẑ × L·(cos θ, sin θ).
    """
    if parameters.commanded_point == "pivot":
        return Twist(vx, vy, omega)
    lever = parameters.tip_length * omega
    return Twist(vx + lever * math.sin(heading), vy - lever * math.cos(heading), omega)


def slowing(distance: float, parameters: Parameters, *, straight: bool) -> float:
    """Part of the greatest speeds that is left at ``distance`` (m) from the goal."""
    if distance >= parameters.slow_radius or (parameters.slow_for == "straight" and not straight):
        return 1.0
    return parameters.slow_fraction


def straight(aimed: Aim, heading: float, parameters: Parameters) -> Twist:
    """Equations (1) and (2)."""
    p = parameters
    left = slowing(aimed.distance, p, straight=True)
    omega = turn_rate(aimed, heading, p.omega_max, p.turn_tolerance, p.straight_turn_within)
    if p.slow_for == "every":
        omega *= left
    speed = left * p.v_max
    return pivot_velocity(speed * aimed.dx, speed * aimed.dy, omega, heading, p)


def burrow(aimed: Aim, heading: float, elapsed: float, parameters: Parameters) -> Twist:
    """Equations (2) to (4), ``elapsed`` s after the reach began.

    "unit": v_max·(d̂ + (d̂ × ẑ)·A/(1−A)·sin(f t)) over its norm. "literal" adds v_max·d̂ instead
    of d̂, as equation (3) is printed.
    """
    p = parameters
    ahead = 1.0 if p.burrow_law == "unit" else p.v_max
    aside = p.burrow_ratio * math.sin(p.burrow_frequency * elapsed)
    left = slowing(aimed.distance, p, straight=False)
    speed = left * p.v_max / math.hypot(ahead, aside)
    # d̂ × ẑ = (d_y, −d_x): to the right of d̂.
    vx = speed * (ahead * aimed.dx + aside * aimed.dy)
    vy = speed * (ahead * aimed.dy - aside * aimed.dx)
    omega = left * turn_rate(aimed, heading, p.omega_max, p.turn_tolerance, p.burrow_turn_within)
    return pivot_velocity(vx, vy, omega, heading, p)


def growth(fraction: float, s: float) -> float:
    """K of equation (6) at the fraction t_frac of an excavation, ``s`` being s_excv."""
    return (1.0 + (s - 1.0) * fraction) / s


def excavate(
    fraction: float, heading: float, parameters: Parameters, *, ccw: bool, left: float = 1.0
) -> Twist:
    """Equations (5) to (8) at t_frac = ``fraction``; ``heading`` (rad) is what turns the spiral.

    "tip_spiral": L·ω stands outside K·v_max with the sign that makes the tip trace the spiral.
    "literal": −L·ω stands inside, as printed. ``left`` is the part of the speeds left near the
    goal.
    """
    p = parameters
    k = left * growth(fraction, p.spiral_growth)
    angle = 1.5 * math.pi * fraction
    omega = -k * p.excavate_omega_max * math.sin(TURN * fraction)
    lever = p.tip_length * omega
    if p.excavate_law == "tip_spiral":
        right = k * p.v_max * math.sin(angle) + lever
    else:
        right = k * p.v_max * (math.sin(angle) - lever)
    forward = -k * p.v_max * math.cos(angle)
    if not ccw:
        right, omega = -right, -omega
    c, s = math.cos(heading), math.sin(heading)
    return Twist(c * forward + s * right, s * forward - c * right, omega)
