"""The arithmetic of the safety gate: each function takes a twist and returns one that is no faster.

Nothing here ever adds motion in a direction that was not asked for.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from reachd.safety_settings import SafetySettings
from reachd.seam import ArmState, Twist
from reachd.workspace import Region

ROUNDING = 1e-12
"""m/s, rad/s: what floating point leaves of a component that was taken away."""

PASSES = 3
"""Rounds over the constraints before the whole twist is scaled instead: neighbouring borders of a
region need two."""


@dataclass(frozen=True, slots=True)
class Constraint:
    """``nx·vx + ny·vy + nw·ω ≤ bound``, with ``bound`` ≥ 0 so that standing still always obeys."""

    nx: float
    ny: float
    nw: float
    bound: float

    def along(self, twist: Twist) -> float:
        """Left side of the inequality."""
        return self.nx * twist.vx + self.ny * twist.vy + self.nw * twist.omega

    def broken_by(self, twist: Twist) -> bool:
        """Whether the inequality fails by more than rounding."""
        return self.along(twist) > self.bound + ROUNDING


def scaled(twist: Twist, factor: float) -> Twist:
    """The same path, slower."""
    return Twist(twist.vx * factor, twist.vy * factor, twist.omega * factor)


def within_speed(twist: Twist, speed: float, turn: float) -> Twist:
    """``twist`` scaled as a whole to at most ``speed`` (m/s) and ``turn`` (rad/s): same path."""
    v, w = math.hypot(twist.vx, twist.vy), abs(twist.omega)
    factor = min(1.0, speed / v if v > speed else 1.0, turn / w if w > turn else 1.0)
    return twist if factor == 1.0 else scaled(twist, factor)


def within_acceleration(twist: Twist, last: Twist, dv: float, dw: float) -> Twist:
    """``twist``, at most ``dv`` (m/s) and ``dw`` (rad/s) away from the ``last`` command.

    A stop is never delayed: the zero twist passes as it is.
    """
    if twist.vx == 0.0 and twist.vy == 0.0 and twist.omega == 0.0:
        return twist
    ax, ay, aw = twist.vx - last.vx, twist.vy - last.vy, twist.omega - last.omega
    step = math.hypot(ax, ay)
    if step <= dv and abs(aw) <= dw:
        return twist
    part = dv / step if step > dv else 1.0
    turn = math.copysign(dw, aw) if abs(aw) > dw else aw
    return Twist(last.vx + ax * part, last.vy + ay * part, last.omega + turn)


def workspace_constraints(arm: ArmState, settings: SafetySettings) -> list[Constraint]:
    """What keeps tip and pivot inside their regions.

    The speed towards a border is at most the distance left over the time for which the arm may go
    on with this command, its state having been as old as it may be: so the point ends on the border
    at worst. Outside, only the way back is open.
    """
    horizon = settings.arm_age + settings.command_expiry
    c = settings.tip_length * math.cos(arm.heading)
    s = settings.tip_length * math.sin(arm.heading)
    found = []
    points: tuple[tuple[Region, float, float], ...] = (
        (settings.tip_region, c, s),
        (settings.pivot_region, 0.0, 0.0),
    )
    for region, rx, ry in points:
        x, y = arm.x + rx, arm.y + ry
        for b in region.borders:
            depth = b.offset - b.nx * x - b.ny * y
            # The point's velocity is that of the pivot plus ω ẑ × r = ω·(−r_y, r_x).
            bound = max(0.0, depth) / horizon
            found.append(Constraint(b.nx, b.ny, b.ny * rx - b.nx * ry, bound))
    return found


def load(arm: ArmState, settings: SafetySettings) -> float:
    """Greater of force and torque as parts of their limits."""
    return max(math.hypot(arm.fx, arm.fy) / settings.force, abs(arm.mz) / settings.torque)


def approach_left(part: float, soft: float) -> float:
    """Part of an approach that is left at the load ``part``: all to ``soft``, none from 1 on."""
    return min(1.0, max(0.0, (1.0 - part) / (1.0 - soft)))


def wrench_constraints(twist: Twist, arm: ArmState, left: float) -> list[Constraint]:
    """What leaves only the part ``left`` of the motion in ``twist`` that increases the load.

    That is the velocity against the force, and the turning against the torque: the environment's
    wrench does negative work on both. Turning and moving are both held, whichever limit is near,
    for a force at the tip grows by either.
    """
    found = []
    force = math.hypot(arm.fx, arm.fy)
    if force > 0.0:
        nx, ny = -arm.fx / force, -arm.fy / force
        found.append(
            Constraint(nx, ny, 0.0, left * max(0.0, nx * twist.vx + ny * twist.vy)),
        )
    if arm.mz != 0.0:
        nw = -math.copysign(1.0, arm.mz)
        found.append(Constraint(0.0, 0.0, nw, left * max(0.0, nw * twist.omega)))
    return found


def constrained(twist: Twist, constraints: list[Constraint]) -> Twist:
    """``twist`` reduced until every constraint holds.

    First only what offends is taken away, so that the arm may slide along a border; if the
    constraints contradict one another, the whole twist is scaled.
    """
    for _ in range(PASSES):
        broken = [rule for rule in constraints if rule.broken_by(twist)]
        if not broken:
            return twist
        for rule in broken:
            twist = _reduced(twist, rule)
    for rule in constraints:
        if rule.broken_by(twist):
            twist = scaled(twist, rule.bound / rule.along(twist))
    return twist


def _reduced(twist: Twist, rule: Constraint) -> Twist:
    """Take away from the velocity, then from the turning, what breaks ``rule``."""
    moving = rule.nx * twist.vx + rule.ny * twist.vy
    turning = rule.nw * twist.omega
    if moving > 0.0:
        kept = min(moving, max(0.0, rule.bound - turning))
        away = moving - kept
        twist = Twist(twist.vx - rule.nx * away, twist.vy - rule.ny * away, twist.omega)
        moving = kept
    if moving + turning > rule.bound and turning > 0.0:
        omega = twist.omega * max(0.0, rule.bound - moving) / turning
        twist = Twist(twist.vx, twist.vy, omega)
    return twist
