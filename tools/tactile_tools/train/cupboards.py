"""Many reaches at once in the planar engine: what a strategy is trained in.

One decision holds for ten control cycles, which are compiled with the physics: quick sweep and the
residual on it choose a twist, the world moves, the skin feels.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from reachd.strategies.learned import NEAR_GOAL_M, NEAR_GOAL_N
from reachd.strategies.memory import DECISION_S, Memory, Rows
from reachd.strategies.parameter_fields import Parameters
from reachd.strategies.parameters import SETS
from sim_device.world.base import substeps
from sim_device.world.parameters import world_parameters
from sim_device.world.planar_arrays import Arrays, empty, put
from sim_device.world.planar_solver import FALLEN, advance, compiled
from sim_device.world.scenes import Scene
from tactile_core.geometry import TIP_X, Side, finger
from tactile_tools.train.settings import Reward, Variety

CYCLE_S: Final = 0.01
CYCLES: Final = round(DECISION_S / CYCLE_S)
STEPS: Final = substeps(CYCLE_S)

RING: Final = 16
"""Cycles of touch that are kept, for its delay."""

NEAREST: Final = 10
"""Objects nearest to the tip that the critic sees."""

PRIVILEGED: Final = 5 * NEAREST + 4
"""Numbers that the critic sees besides the observation."""

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


def mirrored(scene: Scene) -> Scene:
    """``scene`` with left and right exchanged."""
    start = scene.start
    return replace(
        scene,
        start=replace(start, y=-start.y, heading=-start.heading),
        goal=(scene.goal[0], -scene.goal[1]),
        objects=tuple([replace(item, y=-item.y, yaw=-item.yaw) for item in scene.objects]),
    )


class Bank:
    """Scenes as rows of arrays, from which worlds are begun; each also mirrored."""

    def __init__(self, scenes: Sequence[Scene]) -> None:
        if not scenes:
            raise ValueError("no scenes to train on")
        both = [*scenes, *(mirrored(scene) for scene in scenes)]
        self.scenes = both
        self.originals = len(scenes)
        self.room = max(len(scene.objects) for scene in both)
        self.arrays = empty(len(both), self.room)
        self.agents = np.zeros(len(both), AGENT)
        for row, scene in enumerate(both):
            figures = world_parameters(scene.parameters)
            put(self.arrays, row, scene, figures)
            self.agents[row] = _agent(scene, SETS[scene.parameters], figures.time_limit)

    def __len__(self) -> int:
        return len(self.scenes)


def _agent(scene: Scene, p: Parameters, limit: float) -> NDArray[Any]:
    """A reach in ``scene`` before it begins, felt exactly."""
    agent = np.zeros((), AGENT)
    agent["goal_x"], agent["goal_y"] = scene.goal
    agent["radius"], agent["limit"] = p.goal_radius, limit
    for name in (
        "v_max", "omega_max", "slow_radius", "slow_fraction", "turn_tolerance", "jam_time",
        "jam_progress", "jam_force", "sweep_time", "sweep_angle", "sweep_omega",
    ):  # fmt: skip
        agent[name] = getattr(p, name)
    agent["turn_within"] = p.straight_turn_within
    agent["slow_every"] = p.slow_for == "every"
    agent["at_tip"] = p.commanded_point == "tip"
    agent["every"], agent["gain"], agent["where"] = 1, 1.0, _NONE
    x, y = scene.start.x, scene.start.y
    heading = scene.start.heading
    ex = scene.goal[0] - x - TIP_X * math.cos(heading)
    ey = scene.goal[1] - y - TIP_X * math.sin(heading)
    agent["distance"] = agent["closest"] = math.hypot(ex, ey)
    agent["best"] = math.inf
    return agent


@dataclass(frozen=True, slots=True)
class Turn:
    """What a decision led to; arrays have a row for each reach.

    ``observations``: (n, `WIDTH`), after finished reaches were begun anew. ``privileged``: (n,
    `PRIVILEGED`). ``rewards``: (n,). ``ended``: (n,) whether the reach ended with this decision.
    ``arrived``: (n,) whether it ended at the goal. ``seconds``: (n,) s that it has taken so far.
    ``force_n``: (n,) N, greatest summed force since the last decision.
    """

    observations: Rows
    privileged: Rows
    rewards: Rows
    ended: NDArray[np.bool_]
    arrived: NDArray[np.bool_]
    seconds: NDArray[Any]
    force_n: NDArray[Any]


class Cupboards:
    """``n`` reaches that go on side by side; one that ends begins anew in another scene.

    ``rng``: what is drawn: scenes and how they vary. ``threads``: None for one a core. Close it, or
    use it in ``with``.
    """

    def __init__(
        self,
        bank: Bank,
        n: int,
        rng: np.random.Generator,
        *,
        variety: Variety | None = None,
        reward: Reward | None = None,
        threads: int = 1,
        rows: Sequence[int] | None = None,
    ) -> None:
        self._bank, self._rng = bank, rng
        self._variety, self._reward = variety or Variety(), reward or Reward()
        self._host: Arrays = empty(n, bank.room)
        self._agents = np.zeros(n, AGENT)
        self._rings = np.zeros((n, RING, 9), REAL)
        self._skin = skin_places()
        self._memory = Memory(n)
        self._rows = np.zeros(n, np.int64)
        self._action = np.zeros((n, 3))
        self._ejected = np.zeros(n)
        self._threads = threads
        self._pool = ThreadPoolExecutor(threads)
        chosen = self._draw(n) if rows is None else np.asarray(rows, np.int64)
        self._begin(np.arange(n), chosen)

    def __len__(self) -> int:
        return len(self._agents)

    def __enter__(self) -> Cupboards:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End its threads."""
        self._pool.shutdown()

    def observe(self) -> tuple[Rows, Rows]:
        """Observations and privileged numbers before the first decision."""
        return self._observations(), self._privileged()

    def step(self, actions: NDArray[Any]) -> Turn:
        """Carry out ``actions`` (n, 3): residuals ahead, aside and in turning; see `Policy`."""
        agents, reward = self._agents, self._reward
        before, ejected = agents["distance"].copy(), self._ejected.copy()
        self._action = np.asarray(actions, REAL)
        agents["ahead"], agents["aside"], agents["turn"] = self._action.T
        self._run()
        self._ejected = self._host.readout[:, 10].copy()
        force = agents["true_force"].copy()
        arrived = agents["reached"] != 0
        ended = agents["done"] != 0
        seconds = agents["cycle"] * CYCLE_S
        gains = (
            reward.progress * (before - agents["distance"])
            + arrived * reward.arrival * (2.0 - seconds / agents["limit"])
            - reward.decision
            - reward.force * np.maximum(force - reward.free, 0.0)
            - reward.ejected * (self._ejected - ejected)
            - reward.action * (self._action**2).sum(axis=1)
        )
        broken = self._host.readout[:, 11] != 0
        gains[broken | ~np.isfinite(gains)] = 0.0
        if ended.any():
            which = np.flatnonzero(ended)
            rows = self._draw(len(which))
            again = ~arrived[which] & (self._rng.random(len(which)) < self._variety.again)
            rows[again] = self._rows[which][again]
            self._begin(which, rows)
        return Turn(
            self._observations(),
            self._privileged(),
            gains.astype(np.float32),
            ended,
            arrived & ended,
            seconds,
            force,
        )

    def _run(self) -> None:
        n = len(self)
        size = max(1, math.ceil(n / (self._threads * 4)))
        arrays = (self._agents, self._rings, self._skin, *self._host.all)
        parts = [
            self._pool.submit(decide_some, first, min(first + size, n), CYCLES, *arrays)
            for first in range(0, n, size)
        ]
        for part in parts:
            part.result()

    def _draw(self, count: int) -> NDArray[np.int64]:
        rows = self._rng.integers(0, self._bank.originals, count)
        other = self._rng.random(count) < self._variety.mirrored
        return np.asarray(rows + other * self._bank.originals, np.int64)

    def _begin(self, which: NDArray[np.int64], rows: NDArray[np.int64]) -> None:
        """Begin the reaches ``which`` in the scenes ``rows`` of the bank, varied."""
        bank, host, rng, variety = self._bank.arrays, self._host, self._rng, self._variety
        count = len(which)
        for name in ("worlds", "bodies", "outlines", "hulls", "readout"):
            getattr(host, name)[which] = getattr(bank, name)[rows]
        host.wanted[which] = 0.0
        friction = np.exp(rng.uniform(-1, 1, count) * variety.friction)
        mass = np.exp(rng.uniform(-1, 1, count) * variety.mass)
        worlds, bodies = host.worlds, host.bodies
        for name in ("object_object", "object_wall", "finger_object", "finger_wall"):
            worlds[name][which] *= friction
        objects = bodies[which]
        heavier = np.ones((count, objects.shape[1]))
        heavier[:, 1:] = mass[:, np.newaxis]  # not the finger
        for name in ("inv_mass", "inv_inertia", "inv_weight", "softness"):
            objects[name] /= heavier
        objects["grip"] *= heavier * friction[:, np.newaxis]
        bodies[which] = objects
        agents = self._bank.agents[rows]
        taxels = rng.random(count) < variety.taxels
        agents["every"] = np.where(taxels, 4, 1)
        agents["delay"] = np.where(taxels, rng.integers(3, 7, count), 0)
        agents["gain"] = 1.0 + rng.uniform(-1, 1, count) * variety.gain
        agents["bias"] = taxels * rng.random(count) * variety.bias
        agents["noise"] = np.where(taxels, rng.random(count) * variety.noise, 0.0)
        agents["lost"] = taxels * rng.random(count) * variety.lost
        agents["random"] = rng.integers(1, 2**63, count, dtype=np.uint64)
        self._agents[which] = agents
        self._rings[which] = 0.0
        self._rows[which] = rows
        self._action[which] = 0.0
        self._ejected[which] = 0.0
        self._memory.forget(which, host.readout[which, :3])

    def _observations(self) -> Rows:
        agents = self._agents
        # Counted per cycle of the last decision; none before the first.
        names = ("sum_total", "sum_tip", "max_peak", "last_x", "last_y", "sum_fx", "sum_fy")
        felt = np.stack([agents[name] for name in (*names, "sum_mz", "touched")], axis=1)
        felt[:, [0, 1, 5, 6, 7, 8]] /= CYCLES
        state = np.stack(
            [
                agents["limit"] - agents["cycle"] * CYCLE_S,
                agents["closest"],
                agents["sweep"] / agents["sweep_time"],
                agents["side"],
                agents["stuck"] / agents["jam_time"],
            ],
            axis=1,
        )
        return self._memory.observe(
            felt,
            self._host.readout[:, :3],
            self._action,
            np.stack([agents["goal_x"], agents["goal_y"]], axis=1),
            state,
            np.stack([agents["v_max"], agents["omega_max"]], axis=1),
        )

    def _privileged(self) -> Rows:
        """Nearest objects seen from the tip, and what nobody can feel: for the critic alone."""
        host, n = self._host, len(self)
        x, y, heading = host.readout[:, :3].T
        c, s = np.cos(heading), np.sin(heading)
        objects = host.bodies[:, 1:-1]
        dx = objects["x"] - (x + TIP_X / 2 * c)[:, np.newaxis]
        dy = objects["y"] - (y + TIP_X / 2 * s)[:, np.newaxis]
        # Those that are not there or have fallen are far away.
        slots = np.arange(1, host.bodies.shape[1] - 1)
        absent = slots >= host.worlds["bodies"][:, np.newaxis]
        away = dx**2 + dy**2 + 100.0 * (absent | (objects["kind"] == FALLEN))
        nearest = np.argpartition(away, NEAREST, axis=1)[:, :NEAREST]
        each = np.arange(n)[:, np.newaxis]
        order = np.argsort(away[each, nearest], axis=1)
        nearest = nearest[each, order]
        dx, dy = dx[each, nearest], dy[each, nearest]
        found = np.zeros((n, PRIVILEGED), np.float32)
        table = found[:, : 5 * NEAREST].reshape(n, NEAREST, 5)
        c, s = c[:, np.newaxis], s[:, np.newaxis]
        table[:, :, 0] = (c * dx + s * dy) / 0.1
        table[:, :, 1] = (c * dy - s * dx) / 0.1
        chosen = objects[each, nearest]
        table[:, :, 2] = chosen["radius"] / 0.03
        table[:, :, 3] = chosen["vx"] / 0.05
        table[:, :, 4] = chosen["vy"] / 0.05
        found[:, -4] = np.log(host.worlds["finger_object"] / 0.34)
        found[:, -3] = np.log(np.maximum(chosen["grip"][:, 0], 1e-3))
        found[:, -2] = self._agents["every"] / 4
        found[:, -1] = self._agents["delay"] / 4
        np.clip(found, -5.0, 5.0, out=found)
        return found
