"""Rigid bodies in the plane with MuJoCo's law of contact: the kernels of the planar engine.

The bodies are discs, boxes, one convex finger on velocity motors, and three walls. They are those
of `mujoco_model`, without the height that MuJoCo needs, and so with 3 degrees of freedom a body
instead of 4.

**One step of h.** Forces f at contacts and under objects minimise, over their friction cones,

    ½ fᵀ(A + R) f + fᵀ(J a₀ − a*),     A = J M⁻¹ Jᵀ,

so that the acceleration along each row of J becomes a* − R f where the cone does not forbid it. a₀
is the acceleration without these forces (only the motors give one). For a contact with overlap
r < 0 and velocity v along its normal

    a* = −b v − k d r,   R = (1 − d)/d · (w₁ + w₂),   b = 2/(d₁ T),   k = 1/(d₁ T)²,

with d between d₀ and d₁, a sigmoid of r; along the tangent a* = −b v and R is a tenth. w is a
body's inverse weight. Where MuJoCo's bodies touch at an upper and a lower corner, R is halved:
two springs in parallel.

**Solver.** Block Gauss–Seidel on f: each contact's two forces are minimised exactly over the cone,
each object's friction with the shelf (fx, fy, torque over the mean lever) by a projected gradient
in a ball of radius μ m g. Accelerations are kept up to date, forces begin where the last step left
them, and sweeps end when no force changes by more than `TOLERANCE_N`.

**Rest.** What has been slower than `SLEEP_SPEED` for `SLEEP_STEPS` is skipped until something
that moves touches it; contacts are looked for from moving bodies outward.

**Motors.** Each axis of the finger is pushed by clamp(m/T (wanted − v) − last push of the
contacts), and its change of speed is divided by 1 + h/T unless it is clamped: the implicit
integration of the motor's damping.

The functions are compiled for the CPU by `compiled`, and as device functions when a CUDA kernel
calls them. All memory comes from the caller, one row of each array for a world:

``worlds`` (w,) `WORLD`; ``bodies`` (w, n + 2) `BODY`: the finger, the objects, and the ground,
which does not move and to which the walls belong; ``outlines`` (w, n + 2, 8, 4) corner x, y and
outward normal of the edge that begins there, in the body's frame; ``hulls`` the same in
``cupboard``; ``contacts`` (w, c) `CONTACT`; ``memory`` (w, c) `MEMORY`; ``queues`` (w, n + 2);
``felt`` (w, t, 8) and ``readout`` (w, 16) are what comes out, see `advance`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Final, TypeVar, cast

import numba
import numpy as np

from sim_device.world.base import MERGE_RADIUS, PHYSICS_STEP, WALL
from sim_device.world.mujoco_model import (
    CONTACT_SOLIMP,
    CONTACT_SOLREF,
    MOTOR_TIME,
    SUPPORT_SOLREF,
)

F = TypeVar("F", bound=Callable[..., Any])


def compiled(function: F) -> F:
    """``function`` compiled on its first call, kept on disk for the next process.

    Not ``fastmath``, and division as in numpy: the same bits whatever calls it. Those whose name
    begins with _ are called by compiled functions alone.
    """
    options: dict[str, Any] = {
        "cache": True,
        "nogil": True,
        "error_model": "numpy",
        "no_cfunc_wrapper": True,
        "no_cpython_wrapper": function.__name__.startswith("_"),
    }
    return cast("F", numba.njit(**options)(function))


REAL: Final = np.float64

BODY: Final = np.dtype(
    [
        ("kind", np.int64),  # DISC, POLYGON, GROUND or FALLEN
        ("corners", np.int64),
        ("queued", np.int64),  # 1: moves in this step; 2: and its contacts were looked for
        ("rest", np.int64),  # steps below SLEEP_SPEED
        *((name, REAL) for name in ("x", "y", "yaw", "cos", "sin", "vx", "vy", "omega")),
        *((name, REAL) for name in ("ax", "ay", "alpha")),
        *((name, REAL) for name in ("inv_mass", "inv_inertia", "inv_weight")),
        ("radius", REAL),  # of the disc, or of a circle round the polygon
        ("ahead", REAL),  # of that circle's centre before the origin, along the body's x
        # Friction with the shelf: mean lever, m; bound, N; R, 1/kg; forces, N.
        *((name, REAL) for name in ("lever", "grip", "softness", "fx", "fy", "ft")),
    ]
)

CONTACT: Final = np.dtype(
    [
        ("a", np.int64),
        ("b", np.int64),
        ("key", np.int64),  # names the contact from step to step
        # Unit normal from a to b; place; overlap as a negative gap.
        *((name, REAL) for name in ("nx", "ny", "x", "y", "gap")),
        # Levers of normal and tangent about each body's origin.
        *((name, REAL) for name in ("na", "ta", "nb", "tb")),
        *((name, REAL) for name in ("want_n", "want_t", "soft_n", "soft_t")),  # a* and R
        *((name, REAL) for name in ("inv_nn", "inv_nt", "inv_tt")),  # of A + R
        *((name, REAL) for name in ("friction", "fn", "ft")),
    ]
)

MEMORY: Final = np.dtype([("key", np.int64), ("fn", REAL), ("ft", REAL)])

WORLD: Final = np.dtype(
    [
        ("bodies", np.int64),  # finger and objects
        ("contacts", np.int64),
        ("remembered", np.int64),
        ("ejected", np.int64),
        ("failed", np.int64),  # OVERFLOW or DIVERGED
        *((name, REAL) for name in ("depth", "half_width", "front")),
        *((name, REAL) for name in ("object_object", "object_wall", "finger_object")),
        *((name, REAL) for name in ("finger_wall", "mass", "inertia", "f_max", "m_max")),
        *((name, REAL) for name in ("push_x", "push_y", "push_m", "work")),
    ]
)

DISC, POLYGON, GROUND, FALLEN = 0, 1, 2, 3
OVERFLOW, DIVERGED = 1, 2
"""Why a world failed: more contacts than there is memory for, or numbers that are not finite."""

CORNERS: Final = 8
"""Most corners of a body; the finger has as many."""

STEP: Final = PHYSICS_STEP
_GIVE: Final = 1.0 / (1.0 + STEP / MOTOR_TIME)  # of a motor that is not clamped
_D0, _D1, _WIDTH, _, _ = CONTACT_SOLIMP  # the sigmoid has its middle at a half, and is quadratic
_DAMPING: Final = 2.0 / (_D1 * CONTACT_SOLREF[0])
_STIFFNESS: Final = 1.0 / (_D1 * CONTACT_SOLREF[0]) ** 2
SUPPORT_SOLIMP: Final = (0.9, 0.95, 0.001)
"""MuJoCo's default, which supports have."""

_SHELF_DAMPING: Final = 2.0 / (SUPPORT_SOLIMP[1] * SUPPORT_SOLREF[0])
IMPRATIO: Final = 10.0
"""R of the normal over that of the tangent."""

SWEEPS: Final = 30
TOLERANCE_N: Final = 1e-4
SLEEP_SPEED: Final = 1e-3
SLEEP_STEPS: Final = 10
TURN_LENGTH: Final = 0.06  # m, by which turning is compared with that speed

_KEY_FEATURES: Final = 32
_MERGE: Final = MERGE_RADIUS**2
_WALL: Final = WALL


# Geometry: contacts of pairs


@compiled
def _place(body: Any, outline: Any, hull: Any) -> None:
    """Bring sine, cosine and corners up to date with the pose."""
    c, s = math.cos(body.yaw), math.sin(body.yaw)
    body.cos, body.sin = c, s
    for k in range(body.corners):
        hull[k, 0] = body.x + c * outline[k, 0] - s * outline[k, 1]
        hull[k, 1] = body.y + s * outline[k, 0] + c * outline[k, 1]
        hull[k, 2] = c * outline[k, 2] - s * outline[k, 3]
        hull[k, 3] = s * outline[k, 2] + c * outline[k, 3]


@compiled
def _overlap_of_discs(world: Any, bodies: Any, contacts: Any, a: int, b: int) -> None:
    first, second = bodies[a], bodies[b]
    dx, dy = second.x - first.x, second.y - first.y
    distance = math.sqrt(dx * dx + dy * dy)
    gap = distance - first.radius - second.radius
    if gap >= 0.0 or distance == 0.0:
        return
    nx, ny = dx / distance, dy / distance
    to_middle = first.radius + gap / 2
    x, y = first.x + nx * to_middle, first.y + ny * to_middle
    _add(world, bodies, contacts, a, b, 0, nx, ny, x, y, gap, 1.0)


@compiled
def _overlap_of_disc(
    world: Any, bodies: Any, contacts: Any, hull: Any, polygon: int, disc: int
) -> None:
    """Contact of a polygon with corners ``hull`` and a disc."""
    body, corners = bodies[disc], bodies[polygon].corners
    x, y, radius = body.x, body.y, body.radius
    best, edge = -math.inf, 0
    for k in range(corners):
        gap = hull[k, 2] * (x - hull[k, 0]) + hull[k, 3] * (y - hull[k, 1])
        if gap > radius:
            return
        if gap > best:
            best, edge = gap, k
    nx, ny = hull[edge, 2], hull[edge, 3]
    distance = best
    if best > 0.0:
        # The centre is outside: beyond an end of the edge, the corner is nearest.
        after = edge + 1 if edge + 1 < corners else 0
        corner = -1
        if (hull[after, 0] - x) * ny - (hull[after, 1] - y) * nx > 0.0:
            corner = after
        elif (hull[edge, 0] - x) * ny - (hull[edge, 1] - y) * nx < 0.0:
            corner = edge
        if corner >= 0:
            dx, dy = x - hull[corner, 0], y - hull[corner, 1]
            distance = math.sqrt(dx * dx + dy * dy)
            nx, ny = dx / distance, dy / distance
    gap = distance - radius
    if gap >= 0.0:
        return
    to_middle = radius + gap / 2
    px, py = x - nx * to_middle, y - ny * to_middle
    if polygon < disc:
        _add(world, bodies, contacts, polygon, disc, 0, nx, ny, px, py, gap, 1.0)
    else:
        _add(world, bodies, contacts, disc, polygon, 0, -nx, -ny, px, py, gap, 1.0)


@compiled
def _separation(hull: Any, corners: int, other: Any, others: int) -> tuple[float, int]:
    """Greatest gap between two polygons across an edge of the first, and that edge."""
    best, edge = -math.inf, 0
    for k in range(corners):
        x, y, nx, ny = hull[k, 0], hull[k, 1], hull[k, 2], hull[k, 3]
        least = math.inf
        for i in range(others):
            gap = nx * (other[i, 0] - x) + ny * (other[i, 1] - y)
            least = min(least, gap)
        if least > best:
            best, edge = least, k
            if best > 0.0:
                break
    return best, edge


@compiled
def _overlap_of_polygons(
    world: Any, bodies: Any, contacts: Any, hulls: Any, a: int, b: int
) -> None:
    """One or two contacts: the overlap is least across an edge of one, and the edge of the other
    that faces it is cut to its length."""
    corners_a, corners_b = bodies[a].corners, bodies[b].corners
    gap_a, edge_a = _separation(hulls[a], corners_a, hulls[b], corners_b)
    if gap_a >= 0.0:
        return
    gap_b, edge_b = _separation(hulls[b], corners_b, hulls[a], corners_a)
    if gap_b >= 0.0:
        return
    if gap_b > gap_a + 1e-9:
        mine, edge, corners, other, others = hulls[b], edge_b, corners_b, hulls[a], corners_a
        sign = -1.0
    else:
        mine, edge, corners, other, others = hulls[a], edge_a, corners_a, hulls[b], corners_b
        sign = 1.0
    nx, ny = mine[edge, 2], mine[edge, 3]
    x0, y0 = mine[edge, 0], mine[edge, 1]
    after = edge + 1 if edge + 1 < corners else 0
    length = (mine[after, 0] - x0) * -ny + (mine[after, 1] - y0) * nx
    facing, most = 0, math.inf
    for k in range(others):
        along = nx * other[k, 2] + ny * other[k, 3]
        if along < most:
            facing, most = k, along
    end = facing + 1 if facing + 1 < others else 0
    # Along the edge (corners run counter-clockwise) and outward of it.
    s0 = (other[facing, 0] - x0) * -ny + (other[facing, 1] - y0) * nx
    s1 = (other[end, 0] - x0) * -ny + (other[end, 1] - y0) * nx
    g0 = (other[facing, 0] - x0) * nx + (other[facing, 1] - y0) * ny
    g1 = (other[end, 0] - x0) * nx + (other[end, 1] - y0) * ny
    for k in range(2):
        s, g = (s0, g0) if k == 0 else (s1, g1)
        cut = min(max(s, 0.0), length)
        if cut != s:
            if s1 == s0:
                continue
            share = (cut - s0) / (s1 - s0)
            if not 0.0 <= share <= 1.0:
                continue
            s, g = cut, g0 + share * (g1 - g0)
        if g < 0.0:
            px = x0 - ny * s + nx * g / 2
            py = y0 + nx * s + ny * g / 2
            _add(world, bodies, contacts, a, b, k, sign * nx, sign * ny, px, py, g, 0.5)


@compiled
def _overlap_of_wall(world: Any, bodies: Any, contacts: Any, hull: Any, a: int, wall: int) -> None:
    """Contacts of a body with one wall: 0 the back, 1 left, 2 right."""
    body, ground = bodies[a], world.bodies
    nx, ny = 0.0, 0.0
    at = world.half_width
    if wall == 0:
        nx, at = 1.0, world.depth
    elif wall == 1:
        ny = 1.0
    else:
        ny = -1.0
    if (
        at - nx * (body.x + body.cos * body.ahead) - ny * (body.y + body.sin * body.ahead)
        >= body.radius
    ):
        return
    if body.kind == DISC:
        gap = at - nx * body.x - ny * body.y - body.radius
        to_middle = body.radius + gap / 2
        x, y = body.x + nx * to_middle, body.y + ny * to_middle
        _add(world, bodies, contacts, a, ground, wall * CORNERS, nx, ny, x, y, gap, 1.0)
        return
    for k in range(body.corners):
        gap = at - nx * hull[k, 0] - ny * hull[k, 1]
        if gap < 0.0:
            x, y = hull[k, 0] + nx * gap / 2, hull[k, 1] + ny * gap / 2
            feature = wall * CORNERS + k
            _add(world, bodies, contacts, a, ground, feature, nx, ny, x, y, gap, 0.5)


@compiled
def _add(
    world: Any,
    bodies: Any,
    contacts: Any,
    a: int,
    b: int,
    feature: int,
    nx: float,
    ny: float,
    x: float,
    y: float,
    gap: float,
    share: float,
) -> None:
    """Add a contact of ``a`` < ``b`` at x, y with what the sweeps need of it.

    ``feature``: tells contacts of the same bodies apart. ``share``: of R.
    """
    if world.contacts == contacts.shape[0]:
        world.failed = OVERFLOW
        return
    contact, first, second = contacts[world.contacts], bodies[a], bodies[b]
    world.contacts += 1
    contact.a, contact.b = a, b
    contact.key = (a * 256 + b) * _KEY_FEATURES + feature
    contact.nx, contact.ny, contact.x, contact.y, contact.gap = nx, ny, x, y, gap
    # The tangent is (−ny, nx); levers are cross products r × n and r × t.
    rx, ry = x - first.x, y - first.y
    na, ta = rx * ny - ry * nx, rx * nx + ry * ny
    rx, ry = x - second.x, y - second.y
    nb, tb = rx * ny - ry * nx, rx * nx + ry * ny
    contact.na, contact.ta, contact.nb, contact.tb = na, ta, nb, tb
    share_of_width = min(-gap / _WIDTH, 1.0)
    if share_of_width <= 0.5:
        rise = 2.0 * share_of_width * share_of_width
    else:
        rise = 1.0 - 2.0 * (1.0 - share_of_width) * (1.0 - share_of_width)
    d = _D0 + rise * (_D1 - _D0)
    soft = share * (1.0 - d) / d * (first.inv_weight + second.inv_weight)
    contact.soft_n, contact.soft_t = soft, soft / IMPRATIO
    dx, dy = second.vx - first.vx, second.vy - first.vy
    speed_n = dx * nx + dy * ny + second.omega * nb - first.omega * na
    speed_t = dy * nx - dx * ny + second.omega * tb - first.omega * ta
    contact.want_n = -_DAMPING * speed_n - _STIFFNESS * d * gap
    contact.want_t = -_DAMPING * speed_t
    mass = first.inv_mass + second.inv_mass
    ia, ib = first.inv_inertia, second.inv_inertia
    contact.inv_nn = mass + ia * na * na + ib * nb * nb + soft
    contact.inv_nt = ia * na * ta + ib * nb * tb
    contact.inv_tt = mass + ia * ta * ta + ib * tb * tb + soft / IMPRATIO
    if a == 0:
        contact.friction = world.finger_wall if b == world.bodies else world.finger_object
    else:
        contact.friction = world.object_wall if b == world.bodies else world.object_object
    contact.fn = contact.ft = 0.0


@compiled
def _find_contacts(world: Any, bodies: Any, hulls: Any, contacts: Any, queue: Any) -> int:
    """Queue what moves and what it touches, with all their contacts; the number queued."""
    count, queued = world.bodies, 0
    world.contacts = 0
    for i in range(count):
        body = bodies[i]
        body.queued = 0
        if body.kind != FALLEN and (i == 0 or body.rest < SLEEP_STEPS):
            body.queued = 1
            queue[queued] = i
            queued += 1
    done = 0
    while done < queued:
        i = queue[done]
        body = bodies[i]
        x, y = body.x + body.cos * body.ahead, body.y + body.sin * body.ahead
        for j in range(count):
            other = bodies[j]
            if other.queued == 2 or j == i or other.kind == FALLEN:
                continue
            dx = other.x + other.cos * other.ahead - x
            dy = other.y + other.sin * other.ahead - y
            reach = body.radius + other.radius
            if dx * dx + dy * dy >= reach * reach:
                continue
            a, b = min(i, j), max(i, j)
            before = world.contacts
            if bodies[a].kind == DISC:
                if bodies[b].kind == DISC:
                    _overlap_of_discs(world, bodies, contacts, a, b)
                else:
                    _overlap_of_disc(world, bodies, contacts, hulls[b], b, a)
            elif bodies[b].kind == DISC:
                _overlap_of_disc(world, bodies, contacts, hulls[a], a, b)
            else:
                _overlap_of_polygons(world, bodies, contacts, hulls, a, b)
            if world.contacts > before and other.queued == 0:
                other.queued = 1
                queue[queued] = j
                queued += 1
        for wall in range(3):
            _overlap_of_wall(world, bodies, contacts, hulls[i], i, wall)
        body.queued = 2
        done += 1
    return queued


# Forces


@compiled
def _push(first: Any, second: Any, contact: Any, fn: float, ft: float) -> None:
    """Let fn, ft of ``contact`` act on the accelerations of its bodies."""
    fx = contact.nx * fn - contact.ny * ft
    fy = contact.ny * fn + contact.nx * ft
    first.ax -= first.inv_mass * fx
    first.ay -= first.inv_mass * fy
    first.alpha -= first.inv_inertia * (contact.na * fn + contact.ta * ft)
    second.ax += second.inv_mass * fx
    second.ay += second.inv_mass * fy
    second.alpha += second.inv_inertia * (contact.nb * fn + contact.tb * ft)


@compiled
def _sweep_contact(first: Any, second: Any, contact: Any) -> Any:
    """Minimise over the two forces of ``contact`` alone; by how much they changed, N."""
    nx, ny, mu = contact.nx, contact.ny, contact.friction
    nn, nt, tt = contact.inv_nn, contact.inv_nt, contact.inv_tt
    fn, ft = contact.fn, contact.ft
    dx, dy = second.ax - first.ax, second.ay - first.ay
    turn_n = second.alpha * contact.nb - first.alpha * contact.na
    turn_t = second.alpha * contact.tb - first.alpha * contact.ta
    # The linear term of ½ fᵀBf + bᵀf with B = A + R: what there is without these two forces.
    bn = dx * nx + dy * ny + turn_n - contact.want_n + contact.soft_n * fn - nn * fn - nt * ft
    bt = dy * nx - dx * ny + turn_t - contact.want_t + contact.soft_t * ft - nt * fn - tt * ft
    determinant = nn * tt - nt * nt
    best_n = (nt * bt - tt * bn) / determinant
    best_t = (nt * bn - nn * bt) / determinant
    if best_n < 0.0 or abs(best_t) > mu * best_n:
        # The least value is on the border: along f (1, ±μ), or nothing.
        left, right = bn + mu * bt, bn - mu * bt
        left_q = nn + 2.0 * mu * nt + mu * mu * tt
        right_q = nn - 2.0 * mu * nt + mu * mu * tt
        left_f = max(-left / left_q, 0.0)
        right_f = max(-right / right_q, 0.0)
        if left_f * left_f * left_q >= right_f * right_f * right_q:
            best_n, best_t = left_f, mu * left_f
        else:
            best_n, best_t = right_f, -mu * right_f
    change_n, change_t = best_n - fn, best_t - ft
    contact.fn, contact.ft = best_n, best_t
    _push(first, second, contact, change_n, change_t)
    return max(abs(change_n), abs(change_t))


@compiled
def _sweep_shelf(body: Any) -> Any:
    """One projected gradient step of an object's friction with the shelf; its change, N."""
    lever = body.lever
    gx = body.ax + _SHELF_DAMPING * body.vx + body.softness * body.fx
    gy = body.ay + _SHELF_DAMPING * body.vy + body.softness * body.fy
    gt = lever * (body.alpha + _SHELF_DAMPING * body.omega) + body.softness * body.ft
    # Turning has nearly the inverse mass of sliding at this lever, and never a greater one.
    rate = 1.0 / (body.inv_mass + body.softness)
    fx, fy, ft = body.fx - rate * gx, body.fy - rate * gy, body.ft - rate * gt
    size = math.sqrt(fx * fx + fy * fy + ft * ft)
    if size > body.grip:
        scale = body.grip / size
        fx, fy, ft = fx * scale, fy * scale, ft * scale
    dx, dy, dt = fx - body.fx, fy - body.fy, ft - body.ft
    body.fx, body.fy, body.ft = fx, fy, ft
    body.ax += body.inv_mass * dx
    body.ay += body.inv_mass * dy
    body.alpha += body.inv_inertia * lever * dt
    return max(abs(dx), abs(dy), abs(dt))


@compiled
def _recall(world: Any, contacts: Any, memory: Any) -> None:
    """Begin with the forces of the last step; contacts mostly come in the same order again."""
    remembered, at = world.remembered, 0
    for i in range(world.contacts):
        contact = contacts[i]
        for _ in range(remembered):
            old = memory[at]
            at = at + 1 if at + 1 < remembered else 0
            if old.key == contact.key:
                contact.fn, contact.ft = old.fn, old.ft
                break


@compiled
def _solve(world: Any, bodies: Any, contacts: Any, memory: Any, queue: Any, queued: int) -> None:
    """Forces of all contacts and of the shelf, and the accelerations that they give."""
    _recall(world, contacts, memory)
    for q in range(1, queued):
        body = bodies[queue[q]]
        body.ax, body.ay = body.inv_mass * body.fx, body.inv_mass * body.fy
        body.alpha = body.inv_inertia * body.lever * body.ft
    for i in range(world.contacts):
        contact = contacts[i]
        _push(bodies[contact.a], bodies[contact.b], contact, contact.fn, contact.ft)
    for _ in range(SWEEPS):
        change = 0.0
        for i in range(world.contacts):
            contact = contacts[i]
            change = max(change, _sweep_contact(bodies[contact.a], bodies[contact.b], contact))
        for q in range(1, queued):
            change = max(change, _sweep_shelf(bodies[queue[q]]))
        if change < TOLERANCE_N:
            break
    world.remembered = world.contacts
    for i in range(world.contacts):
        contact, kept = contacts[i], memory[i]
        kept.key, kept.fn, kept.ft = contact.key, contact.fn, contact.ft


# A step, and what is felt of it


@compiled
def _clamp(value: float, bound: float) -> float:
    return min(max(value, -bound), bound)


@compiled
def _integrate(world: Any, bodies: Any, outlines: Any, hulls: Any, queue: Any, queued: int) -> None:
    """Speeds, poses, rest and what falls, of all objects that move."""
    for i in range(1, world.bodies):
        body = bodies[i]
        if body.queued == 0:
            body.vx = body.vy = body.omega = 0.0
    for q in range(1, queued):
        i = queue[q]
        body = bodies[i]
        body.vx += STEP * body.ax
        body.vy += STEP * body.ay
        body.omega += STEP * body.alpha
        speed = max(abs(body.vx), abs(body.vy), TURN_LENGTH * abs(body.omega))
        body.rest = body.rest + 1 if speed < SLEEP_SPEED else 0
        body.x += STEP * body.vx
        body.y += STEP * body.vy
        body.yaw += STEP * body.omega
        if not math.isfinite(body.x + body.y + body.yaw):
            world.failed = DIVERGED
        if body.x < world.front:
            body.kind = FALLEN
            body.vx = body.vy = body.omega = 0.0
            world.ejected += 1
        _place(body, outlines[i], hulls[i])


@compiled
def _push_on_finger(world: Any, contacts: Any) -> tuple[float, float, float]:
    """Force in ``cupboard`` and moment about the pivot that contacts exert on the finger."""
    x, y, m = 0.0, 0.0, 0.0
    for i in range(world.contacts):
        contact = contacts[i]
        if contact.a == 0:
            x += contact.ny * contact.ft - contact.nx * contact.fn
            y -= contact.ny * contact.fn + contact.nx * contact.ft
            m -= contact.na * contact.fn + contact.ta * contact.ft
    return x, y, m


@compiled
def _feel(world: Any, finger: Any, contacts: Any, felt: Any, count: int) -> int:
    """Add this step's forces on the finger to the rows of ``felt``; how many rows there are.

    A row sums weight, weighted place and normal, force; touches of a body within `MERGE_RADIUS`
    of a row's place share it, as in `merge_touches`.
    """
    c, s = finger.cos, finger.sin
    for i in range(world.contacts):
        contact = contacts[i]
        if contact.a != 0 or contact.fn <= 0.0:
            continue
        # From the middle of the overlap to the finger's own surface.
        x = contact.x - contact.nx * contact.gap / 2 - finger.x
        y = contact.y - contact.ny * contact.gap / 2 - finger.y
        fx = contact.ny * contact.ft - contact.nx * contact.fn
        fy = -contact.ny * contact.fn - contact.nx * contact.ft
        weight = contact.fn
        x, y = c * x + s * y, c * y - s * x
        owner = _WALL if contact.b == world.bodies else contact.b - 1
        row = 0
        while row < count:
            total = felt[row, 0]
            dx, dy = x - felt[row, 1] / total, y - felt[row, 2] / total
            if felt[row, 7] == owner and dx * dx + dy * dy < _MERGE:
                break
            row += 1
        if row == count:
            if row == felt.shape[0]:
                world.failed = OVERFLOW
                return count
            felt[row, :7] = 0.0
            felt[row, 7] = owner
            count += 1
        felt[row, 0] += weight
        felt[row, 1] += weight * x
        felt[row, 2] += weight * y
        felt[row, 3] += weight * (c * contact.nx + s * contact.ny)
        felt[row, 4] += weight * (c * contact.ny - s * contact.nx)
        felt[row, 5] += c * fx + s * fy
        felt[row, 6] += c * fy - s * fx
    return count


@compiled
def advance(
    w: int,
    steps: int,
    wanted: Any,
    worlds: Any,
    bodies: Any,
    outlines: Any,
    hulls: Any,
    contacts: Any,
    memory: Any,
    queues: Any,
    felt: Any,
    readout: Any,
) -> None:
    """Advance world ``w`` by ``steps`` steps with motors asking for ``wanted`` (w, 3).

    ``felt[w]``: a row for each contact: weight; x, y m and outward normal in ``ee``; mean force x,
    y N; body. ``readout[w]``: pivot's x, y, heading, vx, vy, omega; mean fx, fy, mz; contacts;
    ejected; failed; motor work J. A world that failed stays as it is.
    """
    if worlds[w].failed:
        return
    world, mine, queue = worlds[w], bodies[w], queues[w]
    outline, hull, found, kept, rows = outlines[w], hulls[w], contacts[w], memory[w], felt[w]
    finger = mine[0]
    mass, inertia = world.mass, world.inertia
    felt_rows = 0
    total_x, total_y, total_m, work = 0.0, 0.0, 0.0, 0.0
    for _ in range(steps):
        queued = _find_contacts(world, mine, hull, found, queue)
        if world.failed:
            break
        # A motor that answers to speed alone gives way under load: make up for the last one.
        drive_x = mass / MOTOR_TIME * (wanted[w, 0] - finger.vx) - world.push_x
        drive_y = mass / MOTOR_TIME * (wanted[w, 1] - finger.vy) - world.push_y
        drive_m = inertia / MOTOR_TIME * (wanted[w, 2] - finger.omega) - world.push_m
        motor_x, motor_y = _clamp(drive_x, world.f_max), _clamp(drive_y, world.f_max)
        motor_m = _clamp(drive_m, world.m_max)
        finger.ax, finger.ay = motor_x / mass, motor_y / mass
        finger.alpha = motor_m / inertia
        _solve(world, mine, found, kept, queue, queued)
        push_x, push_y, push_m = _push_on_finger(world, found)
        felt_rows = _feel(world, finger, found, rows, felt_rows)
        u, v, omega = finger.vx, finger.vy, finger.omega
        finger.vx += STEP * finger.ax * (_GIVE if motor_x == drive_x else 1.0)
        finger.vy += STEP * finger.ay * (_GIVE if motor_y == drive_y else 1.0)
        finger.omega += STEP * finger.alpha * (_GIVE if motor_m == drive_m else 1.0)
        # By momentum, what contacts did not give the finger, its motors did.
        work += (mass * (finger.vx - u) - STEP * push_x) * (u + finger.vx) / 2
        work += (mass * (finger.vy - v) - STEP * push_y) * (v + finger.vy) / 2
        work += (inertia * (finger.omega - omega) - STEP * push_m) * (omega + finger.omega) / 2
        world.push_x, world.push_y, world.push_m = push_x, push_y, push_m
        total_x, total_y, total_m = total_x + push_x, total_y + push_y, total_m + push_m
        finger.x += STEP * finger.vx
        finger.y += STEP * finger.vy
        finger.yaw += STEP * finger.omega
        if not math.isfinite(finger.x + finger.y + finger.yaw):
            world.failed = DIVERGED
        _place(finger, outline[0], hull[0])
        _integrate(world, mine, outline, hull, queue, queued)
    world.work += work
    for row in range(felt_rows):
        weight = rows[row, 0]
        length = math.sqrt(rows[row, 3] * rows[row, 3] + rows[row, 4] * rows[row, 4])
        rows[row, 1] /= weight
        rows[row, 2] /= weight
        rows[row, 3] /= length
        rows[row, 4] /= length
        rows[row, 5] /= steps
        rows[row, 6] /= steps
    out = readout[w]
    out[0], out[1], out[2] = finger.x, finger.y, finger.yaw
    out[3], out[4], out[5] = finger.vx, finger.vy, finger.omega
    out[6], out[7], out[8] = total_x / steps, total_y / steps, total_m / steps
    out[9], out[10], out[11], out[12] = felt_rows, world.ejected, world.failed, world.work


@compiled
def place_all(w: int, bodies: Any, outlines: Any, hulls: Any) -> None:
    """Bring sines, cosines and corners of world ``w`` up to date with its poses."""
    for i in range(bodies.shape[1]):
        _place(bodies[w, i], outlines[w, i], hulls[w, i])


@compiled
def advance_some(
    first: int,
    end: int,
    steps: int,
    wanted: Any,
    worlds: Any,
    bodies: Any,
    outlines: Any,
    hulls: Any,
    contacts: Any,
    memory: Any,
    queues: Any,
    felt: Any,
    readout: Any,
) -> None:
    """`advance` the worlds from ``first`` to before ``end``, without the interpreter's lock."""
    for w in range(first, end):
        advance(
            w,
            steps,
            wanted,
            worlds,
            bodies,
            outlines,
            hulls,
            contacts,
            memory,
            queues,
            felt,
            readout,
        )
