"""What moves in a reach that is trained: quick sweep with a residual, the world, touch; compiled.

One decision holds for ten control cycles: quick sweep and the residual on it choose a twist, the
world moves, the skin feels. As in `planar_solver`, the functions are compiled for the CPU, and as
device functions where the kernel of `kernels_cuda` calls them.
"""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from reachd.strategies.learned import NEAR_GOAL_M, NEAR_GOAL_N
from reachd.strategies.memory import DECISION_S
from sim_device.world.base import substeps
from sim_device.world.planar_solver import advance, compiled
from tactile_core.geometry import TIP_X, Side, finger

CYCLE_S: Final = 0.01
CYCLES: Final = round(DECISION_S / CYCLE_S)
STEPS: Final = substeps(CYCLE_S)

RING: Final = 16
"""Cycles of touch that are kept, for its delay."""

REAL = np.float64

AGENT: Final = np.dtype(
    [
        *((name, REAL) for name in ("goal_x", "goal_y", "radius", "limit")),
        # The parameter set.
        *((name, REAL) for name in ("v_max", "omega_max", "slow_radius", "slow_fraction")),
        *((name, REAL) for name in ("turn_tolerance", "turn_within", "jam_time", "jam_progress")),
        *((name, REAL) for name in ("jam_force", "sweep_time", "sweep_angle", "sweep_omega")),
        ("slow_every", np.int64),
        ("at_tip", np.int64),  # whether the commanded point is the tip
        # What is decided: residual in v_max and ω_max.
        *((name, REAL) for name in ("ahead", "aside", "turn")),
        # How touch is spoilt.
        ("every", np.int64),  # cycles between samples
        ("delay", np.int64),  # cycles
        *((name, REAL) for name in ("gain", "bias", "noise", "lost")),
        ("random", np.uint64),
        # State of the reach.
        *((name, np.int64) for name in ("cycle", "done", "reached", "felt_any")),
        *((name, REAL) for name in ("distance", "closest", "best", "stuck", "sweep", "side")),
        # Touch now, and what was added up since the last decision.
        *((name, REAL) for name in ("total", "tip", "peak", "x", "y", "fx", "fy", "mz")),
        ("where", np.int64),
        *((name, REAL) for name in ("sum_total", "sum_tip", "max_peak", "sum_fx", "sum_fy")),
        *((name, REAL) for name in ("sum_mz", "touched", "last_x", "last_y", "true_force")),
    ]
)

_TIP, _LEFT, _RIGHT, _NONE = int(Side.TIP), int(Side.LEFT), int(Side.RIGHT), int(Side.NONE)


@compiled
def _draw(agent: Any) -> float:
    """Uniform in [0, 1) by xorshift64*; the state is the agent's own."""
    x = agent.random
    x ^= x >> np.uint64(12)
    x ^= x << np.uint64(25)
    x ^= x >> np.uint64(27)
    agent.random = x
    return float((x * np.uint64(2685821657736338717)) >> np.uint64(11)) * (1.0 / 9007199254740992.0)


@compiled
def _normal(agent: Any) -> float:
    """About normal with standard deviation 1: a sum of four uniforms."""
    total = _draw(agent) + _draw(agent) + _draw(agent) + _draw(agent) - 2.0
    return total * 1.7320508075688772


@compiled
def _aimed(agent: Any, pose: Any) -> tuple[float, float]:
    """Distance from tip to goal, m, and the direction to it, rad."""
    ex = agent.goal_x - pose[0] - TIP_X * math.cos(pose[2])
    ey = agent.goal_y - pose[1] - TIP_X * math.sin(pose[2])
    return math.sqrt(ex * ex + ey * ey), math.atan2(ey, ex)


@compiled
def _jammed(agent: Any, distance: float) -> None:
    """Time of the sweep and of the jam, as in `reachd.strategies.quick_sweep`."""
    if agent.sweep > 0.0:
        agent.sweep -= CYCLE_S
        if agent.sweep < CYCLE_S / 2:
            agent.sweep, agent.side = 0.0, 0.0
            agent.best, agent.stuck = distance, 0.0
    elif agent.felt_any:
        if distance <= agent.best - agent.jam_progress:
            agent.best, agent.stuck = distance, 0.0
        else:
            agent.stuck += CYCLE_S
        if agent.stuck >= agent.jam_time - CYCLE_S / 2 and agent.total >= agent.jam_force:
            offset = agent.y
            if agent.where == _LEFT:
                offset = 1.0
            elif agent.where == _RIGHT:
                offset = -1.0
            if offset == 0.0:
                offset = _draw(agent) - 0.5
            agent.side = 1.0 if offset < 0.0 else -1.0
            agent.sweep = agent.sweep_time


@compiled
def choose(agent: Any, wanted: Any, pose: Any) -> None:
    """The twist of quick sweep with the residual on it, into ``wanted``."""
    distance, angle = _aimed(agent, pose)
    heading = pose[2]
    _jammed(agent, distance)
    if not agent.felt_any:
        wanted[0], wanted[1], wanted[2] = 0.0, 0.0, 0.0
        return
    slow = agent.slow_fraction if distance < agent.slow_radius else 1.0
    if agent.sweep > 0.0:
        left = slow if agent.slow_every else 1.0
        angle += agent.side * agent.sweep_angle
        omega = agent.side * left * agent.sweep_omega
    else:
        left = slow
        error = math.atan2(math.sin(angle - heading), math.cos(angle - heading))
        omega = agent.turn_within if abs(error) < agent.turn_tolerance else agent.omega_max
        omega = math.copysign(omega, error)
        if agent.slow_every:
            omega *= left
    vx, vy = left * agent.v_max * math.cos(angle), left * agent.v_max * math.sin(angle)
    if distance >= NEAR_GOAL_M or agent.total >= NEAR_GOAL_N:
        c, s = math.cos(heading), math.sin(heading)
        vx += agent.v_max * (c * agent.ahead - s * agent.aside)
        vy += agent.v_max * (s * agent.ahead + c * agent.aside)
        omega += agent.omega_max * agent.turn
        speed = math.sqrt(vx * vx + vy * vy)
        if speed > agent.v_max:
            vx, vy = vx * agent.v_max / speed, vy * agent.v_max / speed
        omega = min(max(omega, -agent.omega_max), agent.omega_max)
    if agent.at_tip:
        vx += TIP_X * omega * math.sin(heading)
        vy -= TIP_X * omega * math.cos(heading)
    wanted[0], wanted[1], wanted[2] = vx, vy, omega


@compiled
def _sample(rows: Any, count: int, skin: Any, into: Any) -> None:
    """Features of the contacts on the finger: total, tip, peak, its place, wrench, its side."""
    for i in range(9):
        into[i] = 0.0
    into[8] = _NONE
    for k in range(count):
        x, y, fx, fy = rows[k, 1], rows[k, 2], rows[k, 5], rows[k, 6]
        force = -(fx * rows[k, 3] + fy * rows[k, 4])
        nearest, side = 1e9, 0.0
        for i in range(skin.shape[0]):
            away = (skin[i, 0] - x) ** 2 + (skin[i, 1] - y) ** 2
            if away < nearest:
                nearest, side = away, skin[i, 2]
        into[0] += force
        if side == _TIP:
            into[1] += force
        if force > into[2]:
            into[2], into[3], into[4], into[8] = force, x, y, side
        into[5] += fx
        into[6] += fy
        into[7] += x * fy - y * fx


@compiled
def feel(agent: Any, rows: Any, count: int, skin: Any, ring: Any) -> None:
    """Sample the skin, and bring touch up to date where a sample is due."""
    now = agent.cycle % RING
    _sample(rows, count, skin, ring[now])
    agent.true_force = max(agent.true_force, ring[now, 0])
    # The skin is sampled by a clock of its own: a touch is at least ``delay`` and less than
    # ``delay`` + ``every`` cycles old.
    due = agent.cycle >= agent.delay and (agent.cycle - agent.delay) % agent.every == 0
    if due and _draw(agent) >= agent.lost:
        seen = ring[(agent.cycle - agent.delay) % RING]
        spread = agent.noise
        agent.total = max(0.0, agent.gain * seen[0] + agent.bias + 1.5 * spread * _normal(agent))
        agent.tip = max(0.0, agent.gain * seen[1] + spread * _normal(agent))
        agent.peak = max(0.0, agent.gain * seen[2] + spread * _normal(agent))
        agent.total = max(agent.total, agent.peak, agent.tip)
        shift = spread * 0.01  # 1 mm at 0.1 N
        agent.x, agent.y, agent.where = seen[3], seen[4], int(seen[8])
        if agent.where != _NONE:
            agent.x += shift * _normal(agent)
            agent.y += shift * _normal(agent)
        agent.fx = agent.gain * seen[5] + spread * _normal(agent)
        agent.fy = agent.gain * seen[6] + spread * _normal(agent)
        agent.mz = agent.gain * seen[7] + 0.1 * spread * _normal(agent)
        agent.felt_any = 1
    agent.cycle += 1
    agent.sum_total += agent.total
    agent.sum_tip += agent.tip
    agent.max_peak = max(agent.max_peak, agent.peak)
    agent.sum_fx += agent.fx
    agent.sum_fy += agent.fy
    agent.sum_mz += agent.mz
    if agent.where != _NONE:
        agent.touched += 1.0
        agent.last_x, agent.last_y = agent.x, agent.y


@compiled
def decide(
    w: int,
    cycles: int,
    agents: Any,
    rings: Any,
    skin: Any,
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
    """Carry out what was decided in world ``w`` for ``cycles`` control cycles, or to the end."""
    agent = agents[w]
    agent.sum_total, agent.sum_tip, agent.max_peak, agent.touched = 0.0, 0.0, 0.0, 0.0
    agent.sum_fx, agent.sum_fy, agent.sum_mz, agent.true_force = 0.0, 0.0, 0.0, 0.0
    for _ in range(cycles):
        if agent.done:
            break
        choose(agent, wanted[w], readout[w])
        advance(
            w, STEPS, wanted, worlds, bodies, outlines, hulls, contacts, memory, queues, felt,
            readout,
        )  # fmt: skip
        feel(agent, felt[w], int(readout[w, 9]), skin, rings[w])
        agent.distance, _ = _aimed(agent, readout[w])
        agent.closest = min(agent.closest, agent.distance)
        if agent.distance <= agent.radius:
            agent.reached = 1
            agent.done = 1
        if worlds[w].failed or agent.cycle * CYCLE_S >= agent.limit - CYCLE_S / 2:
            agent.done = 1


@compiled
def decide_some(first: int, end: int, cycles: int, agents: Any, rings: Any, skin: Any,
                wanted: Any, worlds: Any, bodies: Any, outlines: Any, hulls: Any, contacts: Any,
                memory: Any, queues: Any, felt: Any, readout: Any) -> None:  # fmt: skip
    """`decide` for the worlds from ``first`` to before ``end``."""
    for w in range(first, end):
        decide(
            w, cycles, agents, rings, skin, wanted, worlds, bodies, outlines, hulls, contacts,
            memory, queues, felt, readout,
        )  # fmt: skip


def skin_places() -> NDArray[Any]:
    """(t, 3) x, y m in ``ee`` of each taxel, and its `Side`."""
    return np.array(
        [
            (*place[:2], float(int(array.side)))
            for array in finger().arrays
            for place in array.position
        ]
    )
