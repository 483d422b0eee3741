"""Search for the next motion in copies of the cupboard, in the planar engine. Pure.

A plan is two strokes and a travel: stroke = a direction off the goal's, a turn rate, a duration;
travel = straight at the goal, weaving to both sides and with the finger's heading off the line by
as much as the plan says, so that its shoulder is a wedge. `Search.plan` rolls a generation of plans
out from the present state, lets the best of them vary (an evolution strategy: the best are kept,
their children differ from them by less in each generation), and begins with the rest of the last
plan, so that work of earlier searches is not lost.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from reachd.strategies.parameter_fields import Parameters
from sim_device.world.parameters import WorldParameters
from sim_device.world.planar_worlds import Snapshot, Worlds
from sim_device.world.scenes import Scene
from tactile_core.arrays import FloatArray

ANGLE_1, TURN_1, TIME_1, ANGLE_2, TURN_2, TIME_2, WEAVE, PHASE, LEAN = range(9)
"""Columns of a plan: strokes (rad off the goal's direction, part of omega_max, s); travel: sideways
over forward speed, rad, and rad by which the heading is off the line to the goal."""

GENES: Final = 9

WEAVE_RATE: Final = 5.0
"""rad/s of the weaving, as in the recipe of quick sweeps."""

TURN_GAIN: Final = 1 / 0.15
"""1/s, turn rate per error of the heading in travel, up to omega_max."""

SPREAD: Final = np.array([0.5, 0.5, 0.25, 0.5, 0.5, 0.25, 0.4, 1.0, 0.25])
"""Standard deviation by which a child of the first generation differs from its parent."""

LONGEST_S: Final = 1.0
"""s that a stroke may take."""

NEAR_M: Final = 0.006
"""m to the goal within which a travelling finger turns and weaves less and less."""

EJECTED_S: Final = 10.0
"""s that an object pushed out costs."""


@dataclass(frozen=True, slots=True)
class Settings:
    """How hard to search, and what counts.

    ``candidates`` plans in each of ``generations``, of which ``parents`` are kept, are rolled out
    for ``horizon_s`` with a new twist each ``step_s``. Where none of the first makes more than
    ``stuck`` of the progress at v_max, other plans are tried for ``escape_s``. A plan is followed
    for ``follow_s`` or ``follow_escape_s``. If straight makes ``free`` of the progress at v_max,
    there is nothing to search.

    Cost, s: time of arrival; for those that do not arrive the horizon, ``ahead`` × the time for
    what is left at v_max, and ``clutter`` × the time for the sum of what objects reach into the
    way; ``lost`` × the mean distance at v_max; ``force_s`` a N·s above ``force_n`` (sum of normal
    forces); `EJECTED_S` an object pushed out.
    """

    candidates: int = 40
    generations: int = 3
    parents: int = 6
    horizon_s: float = 2.4
    step_s: float = 0.05
    ahead: float = 1.2
    clutter: float = 0.5
    lost: float = 0.1
    force_n: float = 20.0
    force_s: float = 0.01
    free: float = 0.93
    stuck: float = 0.3
    escape_s: float = 4.0
    follow_s: float = 0.4
    follow_escape_s: float = 0.8


def wanted(
    plans: FloatArray,
    at_s: float,
    finger: FloatArray,
    goal: tuple[float, float],
    dt: float,
    p: Parameters,
) -> FloatArray:
    """(k, 3) twist of the pivot, in ``cupboard``, that each plan wants ``at_s`` s after it began.

    ``plans`` (k, 9); ``finger`` (k, 3 or more): x, y m and heading rad of the pivots. No plan asks
    for more than v_max and omega_max of ``p``. Travel goes no farther than to the goal in the
    ``dt`` s ahead, and turns and weaves less within `NEAR_M`.
    """
    heading = finger[:, 2]
    cos, sin = np.cos(heading), np.sin(heading)
    ex = goal[0] - finger[:, 0] - p.tip_length * cos
    ey = goal[1] - finger[:, 1] - p.tip_length * sin
    left, bearing = np.hypot(ex, ey), np.arctan2(ey, ex)
    near = np.minimum(left / NEAR_M, 1.0)
    first = at_s < plans[:, TIME_1]
    second = ~first & (at_s < plans[:, TIME_1] + plans[:, TIME_2])
    travels = ~(first | second)
    weave = np.arctan(near * plans[:, WEAVE] * np.sin(WEAVE_RATE * at_s + plans[:, PHASE]))
    angle = bearing + np.where(first, plans[:, ANGLE_1], np.where(second, plans[:, ANGLE_2], weave))
    error = bearing + plans[:, LEAN] - heading
    error = np.arctan2(np.sin(error), np.cos(error))
    stroke = p.omega_max * np.where(first, plans[:, TURN_1], plans[:, TURN_2])
    omega = np.where(travels, np.clip(TURN_GAIN * error, -p.omega_max, p.omega_max) * near, stroke)
    speed = np.where(travels, np.minimum(p.v_max, left / dt), p.v_max)
    vx, vy = speed * np.cos(angle), speed * np.sin(angle)
    if p.commanded_point == "tip":
        lever = p.tip_length * omega
        vx, vy = vx + lever * sin, vy - lever * cos
    return np.stack([vx, vy, omega], axis=1)


def distance(finger: FloatArray, goal: tuple[float, float], p: Parameters) -> FloatArray:
    """(k,) m from each tip to the goal."""
    x = finger[:, 0] + p.tip_length * np.cos(finger[:, 2])
    y = finger[:, 1] + p.tip_length * np.sin(finger[:, 2])
    return np.asarray(np.hypot(goal[0] - x, goal[1] - y), np.float64)


def shifted(plan: FloatArray, by_s: float) -> FloatArray:
    """What is left of ``plan`` (…, 9) after ``by_s`` s."""
    rest = plan.copy()
    first = np.maximum(plan[..., TIME_1] - by_s, 0.0)
    over = np.maximum(by_s - plan[..., TIME_1], 0.0)
    rest[..., TIME_1] = first
    rest[..., TIME_2] = np.maximum(plan[..., TIME_2] - over, 0.0)
    rest[..., PHASE] += WEAVE_RATE * by_s
    return rest


class Search:
    """Finds plans in one cupboard. ``p``: what limits the motion; ``rng``: the only chance."""

    def __init__(
        self,
        scene: Scene,
        world: WorldParameters,
        p: Parameters,
        rng: np.random.Generator,
        settings: Settings | None = None,
    ) -> None:
        self.settings = settings or Settings()
        self._p, self._rng, self._goal = p, rng, scene.goal
        self.worlds = Worlds([scene] * self.settings.candidates, world, threads=1)
        self._half_width = world.finger_width / 2
        self._radii = np.array([(each.size_x + each.size_y) / 4 for each in scene.objects])
        limits = p.safety.arm_limits
        self._one = Worlds([scene], world, threads=1)
        for worlds in (self.worlds, self._one):
            worlds.limit_wrench(limits.f_max, limits.m_max)

    def plan(self, state: Snapshot, last: FloatArray | None) -> tuple[FloatArray, float]:
        """(9,) the plan to follow from ``state`` on, and for how long, s.

        ``last``: what is left of the one before.
        """
        s = self.settings
        straight = np.zeros((1, GENES))
        _, free = self.rollout(straight, state, s.horizon_s)
        if free[0] >= s.free:
            return np.zeros(GENES), s.follow_s
        plans = self._first(last)
        costs, gained = self.rollout(plans, state, s.horizon_s)
        if gained[np.argmin(costs)] >= s.stuck:
            plans = self._evolved(plans, costs, state, s.horizon_s)
            return np.array(plans[0]), s.follow_s
        best = np.argsort(costs, kind="stable")[:4]
        plans = np.concatenate([plans[best], self._escapes(len(plans) - len(best))])
        costs, _ = self.rollout(plans, state, s.escape_s)
        plans = self._evolved(plans, costs, state, s.escape_s)
        return np.array(plans[0]), s.follow_escape_s

    def _evolved(
        self, plans: FloatArray, costs: FloatArray, state: Snapshot, horizon_s: float
    ) -> FloatArray:
        """The last of the further generations, cheapest first."""
        s = self.settings
        for generation in range(1, s.generations):
            best = np.argsort(costs, kind="stable")[: s.parents]
            children = self._children(plans[best], SPREAD / generation)
            found, _ = self.rollout(children, state, horizon_s)
            plans = np.concatenate([plans[best], children])
            costs = np.concatenate([costs[best], found])
        return np.asarray(plans[np.argsort(costs, kind="stable")], np.float64)

    def _escapes(self, k: int) -> FloatArray:
        """Plans for a finger that is stuck: long strokes in all directions, then again the goal."""
        rng = self._rng
        plans = np.zeros((k, GENES))
        plans[:, ANGLE_1] = rng.uniform(-math.pi, math.pi, k)
        plans[:, TIME_1] = rng.uniform(0.3, LONGEST_S, k)
        plans[:, ANGLE_2] = rng.uniform(-1.8, 1.8, k)
        plans[:, TIME_2] = rng.uniform(0.3, LONGEST_S, k)
        plans[:, [TURN_1, TURN_2]] = rng.uniform(-1.3, 1.3, (k, 2))
        plans[:, LEAN] = np.where(rng.random(k) < 0.5, rng.uniform(-0.6, 0.6, k), 0.0)
        return self._within(plans)

    def _first(self, last: FloatArray | None) -> FloatArray:
        """The first generation: straight, the last plan's rest and its like, and others."""
        k, rng = self.settings.candidates, self._rng
        plans = np.zeros((k, GENES))
        plans[:, ANGLE_1] = rng.uniform(-1.6, 1.6, k)
        far = rng.random(k) < 0.25
        plans[far, ANGLE_1] = rng.uniform(-math.pi, math.pi, int(far.sum()))
        plans[:, TURN_1] = rng.uniform(-1.3, 1.3, k)
        plans[:, TIME_1] = rng.uniform(0.15, 0.8, k)
        plans[:, ANGLE_2] = rng.normal(0.0, 0.8, k)
        plans[:, TURN_2] = rng.uniform(-1.3, 1.3, k)
        plans[:, TIME_2] = rng.uniform(0.0, 0.8, k)
        plans[:, WEAVE] = np.where(rng.random(k) < 0.5, rng.uniform(0.0, 1.2, k), 0.0)
        plans[:, PHASE] = rng.uniform(0.0, 2 * math.pi, k)
        plans[:, LEAN] = np.where(rng.random(k) < 0.5, rng.uniform(-0.6, 0.6, k), 0.0)
        travel = slice(1, 5)
        plans[: travel.stop, [TIME_1, TIME_2]] = 0.0
        plans[0, :] = 0.0
        plans[travel, WEAVE] = (0.0, 0.0, 1.0, 1.0)
        plans[travel, LEAN] = (0.45, -0.45, 0.3, -0.3)
        if last is not None:
            like = 5
            plans[travel.stop] = last
            plans[travel.stop + 1 : travel.stop + like] = self._varied(
                np.repeat(last[np.newaxis], like - 1, axis=0), SPREAD / 2
            )
        return self._within(plans)

    def _children(self, parents: FloatArray, spread: FloatArray) -> FloatArray:
        k = self.settings.candidates
        return self._varied(parents[np.arange(k) % len(parents)], spread)

    def _varied(self, plans: FloatArray, spread: FloatArray) -> FloatArray:
        changed = self._rng.normal(0.0, 1.0, plans.shape) * spread
        some = self._rng.random(plans.shape) < 0.6
        return self._within(plans + np.where(some, changed, 0.0))

    @staticmethod
    def _within(plans: FloatArray) -> FloatArray:
        plans[:, [TURN_1, TURN_2]] = np.clip(plans[:, [TURN_1, TURN_2]], -1.0, 1.0)
        plans[:, [TIME_1, TIME_2]] = np.clip(plans[:, [TIME_1, TIME_2]], 0.0, LONGEST_S)
        plans[:, WEAVE] = np.clip(plans[:, WEAVE], 0.0, 2.0)
        plans[:, LEAN] = np.clip(plans[:, LEAN], -1.0, 1.0)
        return plans

    def rollout(
        self, plans: FloatArray, state: Snapshot, horizon_s: float
    ) -> tuple[FloatArray, FloatArray]:
        """Costs (k,) of ``plans`` from ``state``, s; and progress (k,) over that at v_max."""
        s, p, goal = self.settings, self._p, self._goal
        worlds = self._one if len(plans) == 1 else self.worlds
        worlds.place(state)
        start = worlds.distance
        ejected = worlds.ejected
        steps = round(horizon_s / s.step_s)
        arrived = np.full(len(plans), np.inf)
        pressed, lost = np.zeros(len(plans)), np.zeros(len(plans))
        for index in range(steps):
            at = index * s.step_s
            asked = wanted(plans, at, worlds.finger, goal, s.step_s, p)
            asked[np.isfinite(arrived)] = 0.0
            worlds.step(s.step_s, asked)
            rows, counts = worlds.contacts()
            force = -(rows[:, :, 2] * rows[:, :, 4] + rows[:, :, 3] * rows[:, :, 5])
            used = np.arange(rows.shape[1]) < counts[:, np.newaxis]
            total = np.where(used, force, 0.0).sum(axis=1)
            going = ~np.isfinite(arrived)
            pressed += np.where(going, np.maximum(total - s.force_n, 0.0), 0.0) * s.step_s
            lost += np.where(going, worlds.distance, 0.0) * s.step_s
            arrived[going & worlds.reached] = at + s.step_s
            if np.isfinite(arrived).all():
                break
        left = worlds.distance
        cost = np.where(
            np.isfinite(arrived),
            arrived,
            horizon_s + (s.ahead * left + s.clutter * self._in_the_way(worlds)) / p.v_max,
        )
        cost = (
            cost
            + s.lost / p.v_max / horizon_s * lost
            + s.force_s * pressed
            + EJECTED_S * (worlds.ejected - ejected)
        )
        cost[worlds.failed] = np.inf
        gained = (start - left) / p.v_max / np.minimum(arrived, horizon_s)
        gained[(worlds.ejected > ejected) | worlds.failed] = -np.inf
        return cost, gained

    def _in_the_way(self, worlds: Worlds) -> FloatArray:
        """(k,) m by which objects reach into the finger's way to the goal, summed over them."""
        finger, poses, on = worlds.finger, worlds.poses(), worlds.on_shelf()
        p, goal = self._p, np.array(self._goal)
        heading = finger[:, 2]
        tip = finger[:, :2] + p.tip_length * np.stack([np.cos(heading), np.sin(heading)], axis=1)
        way = goal - tip
        length = np.maximum(np.hypot(way[:, 0], way[:, 1]), 1e-9)
        along = (way / length[:, np.newaxis])[:, np.newaxis]
        off = poses[:, :, :2] - tip[:, np.newaxis]
        reach = np.clip((off * along).sum(axis=2), 0.0, length[:, np.newaxis])
        gap = np.linalg.norm(off - reach[:, :, np.newaxis] * along, axis=2)
        into = np.maximum(self._half_width + self._radii - gap, 0.0)
        return np.asarray(np.where(on, into, 0.0).sum(axis=1), np.float64)
