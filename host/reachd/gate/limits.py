"""The arithmetic of the safety gate: limits reduce a twist and never make it faster.

Nothing here adds motion in a direction that was not commanded.
"""

from __future__ import annotations

import math

from reachd.gate.settings import SafetySettings
from reachd.interfaces import ArmState, Touch, Twist
from tactile_core.geometry import Side
from tactile_core.types import record

# Sanity of numbers.


def finite(*values: float) -> bool:
    """Whether all values and their sum are finite; values that overflow it are not measurements.

    Checking the sum is several times faster than checking each, and this runs in every cycle.
    """
    return math.isfinite(sum(values))


def usable(touch: Touch) -> bool:
    """Whether ``touch`` may be acted on: it is valid, and all its numbers are finite."""
    return touch.valid and finite(
        touch.peak_force, touch.peak_x, touch.peak_y, touch.total_force, touch.tip_force
    )


ROUNDING = 1e-12
"""m/s, rad/s that rounding leaves of a component that was removed."""

NO_OVERSHOOT = math.e
"""Ratio of time constant to delay from which a motion that slows in proportion to the distance
left, observed with that delay, never overshoots."""

PARALLEL = 1e-6
"""Sine of the angle below which two borders have no usable corner, and two velocities count as
parallel."""


@record
class Constraint:
    """``nx·vx + ny·vy + nw·ω ≤ bound``, with ``bound`` ≥ 0 so that standing still always obeys it.

    (nx, ny) is a unit vector, or zero if only turning is limited.
    """

    nx: float
    ny: float
    nw: float
    bound: float

    def along(self, twist: Twist) -> float:
        """Left side of the inequality."""
        return self.nx * twist.vx + self.ny * twist.vy + self.nw * twist.omega

    def broken_by(self, twist: Twist) -> bool:
        """Whether ``twist`` violates the inequality by more than rounding."""
        return self.along(twist) > self.bound + ROUNDING


def scaled(twist: Twist, factor: float) -> Twist:
    """Multiply ``twist`` by ``factor``, which keeps the path."""
    return Twist(twist.vx * factor, twist.vy * factor, twist.omega * factor)


def within_speed(twist: Twist, speed: float, turn: float) -> Twist:
    """Scale ``twist`` to at most ``speed`` (m/s) and ``turn`` (rad/s), which keeps the path."""
    v, w = math.hypot(twist.vx, twist.vy), abs(twist.omega)
    factor = min(speed / v if v > speed else 1.0, turn / w if w > turn else 1.0)
    return twist if factor == 1.0 else scaled(twist, factor)


def within_acceleration(twist: Twist, last: Twist, dv: float, dw: float) -> Twist:
    """Limit the change from the ``last`` command to ``dv`` (m/s) and ``dw`` (rad/s).

    Braking is never delayed: a velocity along the last one that is not faster passes unchanged, and
    so does a turn rate; for a reversal, zero comes first, at once.
    """
    vx, vy = _velocity_step(twist, last, dv)
    omega = _turning_step(twist.omega, last.omega, dw)
    if vx == twist.vx and vy == twist.vy and omega == twist.omega:
        return twist
    return Twist(vx, vy, omega)


def _velocity_step(twist: Twist, last: Twist, dv: float) -> tuple[float, float]:
    ax, ay = twist.vx - last.vx, twist.vy - last.vy
    step = math.hypot(ax, ay)
    if step <= dv:
        return twist.vx, twist.vy
    before = math.hypot(last.vx, last.vy)
    across = abs(twist.vx * last.vy - twist.vy * last.vx)
    if across <= PARALLEL * before * math.hypot(twist.vx, twist.vy):
        along = twist.vx * last.vx + twist.vy * last.vy
        if along >= 0.0 and math.hypot(twist.vx, twist.vy) <= before:
            return twist.vx, twist.vy
        if along < 0.0 and before > dv:
            return 0.0, 0.0
    return last.vx + ax * dv / step, last.vy + ay * dv / step


def _turning_step(omega: float, last: float, dw: float) -> float:
    step = omega - last
    if abs(step) <= dw:
        return omega
    if omega * last >= 0.0 and abs(omega) <= abs(last):
        return omega
    if omega * last < 0.0 and abs(last) > dw:
        return 0.0
    return last + math.copysign(dw, step)


def braked(last: Twist, rules: list[Constraint], speed: float, turn: float) -> Twist:
    """Scale the last command until it obeys ``rules`` and both speeds."""
    twist = within_speed(last, speed, turn)
    for rule in rules:
        if rule.broken_by(twist):
            twist = scaled(twist, rule.bound / rule.along(twist))
    return twist


def workspace_constraints(
    arm: ArmState, settings: SafetySettings, fastest: float = math.inf
) -> list[Constraint]:
    """Constraints that keep tip and pivot inside their regions, if they matter at ``fastest`` m/s.

    The speed towards a border is at most the distance left divided by a time constant, chosen so
    that the point comes to rest inside even with the oldest state and a command followed until it
    expires. Outside, only motion back inside is allowed.
    """
    horizon = NO_OVERSHOOT * (settings.arm_age + settings.command_expiry)
    matters = fastest * horizon
    found = []
    for region, rx, ry in (
        (
            settings.tip_region,
            settings.tip_length * math.cos(arm.heading),
            settings.tip_length * math.sin(arm.heading),
        ),
        (settings.pivot_region, 0.0, 0.0),
    ):
        x, y = arm.x + rx, arm.y + ry
        for b in region.borders:
            depth = b.offset - b.nx * x - b.ny * y
            if depth < matters:
                # The point's velocity is that of the pivot plus ω ẑ × r = ω·(−r_y, r_x).
                bound = max(0.0, depth) / horizon
                found.append(Constraint(b.nx, b.ny, b.ny * rx - b.nx * ry, bound))
    return found


def fastest_point(twist: Twist, settings: SafetySettings) -> float:
    """Upper bound of the speeds of tip and pivot, m/s."""
    return math.hypot(twist.vx, twist.vy) + settings.tip_length * abs(twist.omega)


def load(arm: ArmState, settings: SafetySettings) -> float:
    """Larger of force and torque, each relative to its limit."""
    return max(math.hypot(arm.fx, arm.fy) / settings.force, abs(arm.mz) / settings.torque)


def approach_left(part: float, soft: float) -> float:
    """Fraction of an approach allowed at the relative load ``part``: 1 up to ``soft``, 0 from 1."""
    return min(1.0, max(0.0, (1.0 - part) / (1.0 - soft)))


def largest_skin_force(touch: Touch) -> float:
    """Largest force that may be on the skin, N: touch plus its bound.

    An unknown bound counts as large as the force: nominal forces of uncalibrated boards are
    accurate to within a factor of two.
    """
    return max(
        _at_most(touch.total_force, touch.normal_force_bound),
        _at_most(touch.peak_force, touch.peak_force_bound),
    )


def _at_most(force: float, bound: float) -> float:
    force = max(force, 0.0)
    return force + (bound if 0.0 <= bound < math.inf else force)


NORMALS = {Side.TIP: (1.0, 0.0), Side.LEFT: (0.0, 1.0), Side.RIGHT: (0.0, -1.0)}
"""Outward normal of each part of the skin, in ``ee``."""


def touch_constraints(touch: Touch, arm: ArmState, speed: float) -> list[Constraint]:
    """Constraint on pressing further at the peak contact, to at most ``speed`` (m/s)."""
    normal = NORMALS.get(touch.peak_side)
    if normal is None:
        return []
    c, s = math.cos(arm.heading), math.sin(arm.heading)
    nx, ny = c * normal[0] - s * normal[1], s * normal[0] + c * normal[1]
    rx, ry = c * touch.peak_x - s * touch.peak_y, s * touch.peak_x + c * touch.peak_y
    return [Constraint(nx, ny, rx * ny - ry * nx, speed)]


def force_constraints(arm: ArmState, speed: float) -> list[Constraint]:
    """Constraint on moving the pivot against the force on it, to at most ``speed`` (m/s)."""
    force = math.hypot(arm.fx, arm.fy)
    return [Constraint(-arm.fx / force, -arm.fy / force, 0.0, speed)] if force > 0.0 else []


def squeeze_constraints(twist: Twist, arm: ArmState, left: float) -> list[Constraint]:
    """Constraints that allow the fraction ``left`` of every motion except straight back out.

    The skin shows how hard it is squeezed, but not which motion would relieve it.
    """
    c, s = math.cos(arm.heading), math.sin(arm.heading)
    found = []
    for nx, ny in ((c, s), (-s, c), (s, -c)):
        found.append(Constraint(nx, ny, 0.0, left * max(0.0, nx * twist.vx + ny * twist.vy)))
    for nw in (1.0, -1.0):
        found.append(Constraint(0.0, 0.0, nw, left * max(0.0, nw * twist.omega)))
    return found


def wrench_constraints(twist: Twist, arm: ArmState, left: float) -> list[Constraint]:
    """Constraints that allow the fraction ``left`` of the motion in ``twist`` that adds load.

    That motion is the velocity against the force and the turning against the torque, on which the
    environment's wrench does negative work. Both are limited whichever limit is near, because a
    force at the tip grows with either.
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
    """Reduce ``twist`` until it obeys every constraint.

    First the velocity is replaced by the nearest one that obeys, so that the arm can slide along a
    border; then turning is reduced; if that is not enough without reversing the velocity, the whole
    twist is scaled.
    """
    if not any(rule.broken_by(twist) for rule in constraints):
        return twist
    omega = twist.omega
    room = [(rule, max(0.0, rule.bound - rule.nw * omega)) for rule in constraints]
    vx, vy = _nearest(twist.vx, twist.vy, [(rule.nx, rule.ny, most) for rule, most in room])
    part = 1.0
    for rule, most in room:
        if most == 0.0 and rule.nw * omega > rule.bound:
            moving = rule.nx * vx + rule.ny * vy
            part = min(part, max(0.0, rule.bound - moving) / (rule.nw * omega))
    twist = Twist(vx, vy, omega * part)
    for rule in constraints:
        if rule.broken_by(twist):
            twist = scaled(twist, rule.bound / rule.along(twist))
    return twist


def _nearest(vx: float, vy: float, rules: list[tuple[float, float, float]]) -> tuple[float, float]:
    """Velocity nearest to (vx, vy) with ``nx·vx + ny·vy ≤ most`` for every (nx, ny, most ≥ 0).

    The nearest point of a convex region lies on a border or in a corner. Standing still is always
    inside, so the result is never faster and never in the opposite direction.
    """
    broken = [rule for rule in rules if _beyond(vx, vy, rule)]
    if not broken:
        return vx, vy
    for nx, ny, most in broken:
        away = nx * vx + ny * vy - most
        x, y = vx - nx * away, vy - ny * away
        if not any(_beyond(x, y, rule) for rule in rules):
            return x, y
    best, least = (0.0, 0.0), math.hypot(vx, vy)
    for index, (ax, ay, a) in enumerate(rules):
        for bx, by, b in rules[index + 1 :]:
            across = ax * by - ay * bx
            if abs(across) < PARALLEL:
                continue
            x, y = (a * by - b * ay) / across, (b * ax - a * bx) / across
            distance = math.hypot(vx - x, vy - y)
            if distance < least and not any(_beyond(x, y, rule) for rule in rules):
                best, least = (x, y), distance
    return best


def _beyond(x: float, y: float, rule: tuple[float, float, float]) -> bool:
    return rule[0] * x + rule[1] * y > rule[2] + ROUNDING
