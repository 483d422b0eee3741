"""The privileged planner as a strategy: plans anew several times a second from the true state."""

from __future__ import annotations

import numpy as np

from reachd.interfaces import ArmState, Goal, Touch, Twist
from reachd.strategies.parameter_fields import Parameters
from sim_device.world.planar_worlds import Snapshot
from sim_device.world.view import WorldView
from tactile_core.arrays import FloatArray
from tactile_core.types import NS_PER_S, Instant
from tactile_tools.oracle.planner import Search, Settings, shifted, wanted


class PrivilegedPlanner:
    """Sees all objects of ``view`` and carries out the best of many motions tried in copies of it.

    No arm can give it what it needs; see `reachd.strategies.load_strategy`.
    """

    privileged = True

    def __init__(
        self,
        parameters: Parameters,
        rng: np.random.Generator,
        view: WorldView,
        settings: Settings | None = None,
    ) -> None:
        self._p, self._rng, self._view = parameters, rng, view
        self._settings = settings
        self._search: Search | None = None
        self.activity = "plan"

    def start(self, goal: Goal, now: Instant) -> None:
        """Begin a reach; forget any earlier one."""
        del goal
        view = self._view
        self._search = Search(view.scene, view.parameters, self._p, self._rng, self._settings)
        self._began = now
        self._plan: FloatArray | None = None
        self._follow_s = 0.0
        self._before = view.poses()
        self._before_at = now

    def step(self, touch: Touch, arm: ArmState, goal: Goal, now: Instant) -> Twist:
        """Twist of the plan that is being carried out; a new plan where it is time for one."""
        del touch
        if self._search is None:
            raise RuntimeError("a reach was not begun: call start first")
        period_s = self._p.safety.period
        at_s = (now - self._began) / NS_PER_S
        if self._plan is None or at_s >= self._follow_s - 1e-9:
            rest = None if self._plan is None else shifted(self._plan, at_s)
            self._plan, self._follow_s = self._search.plan(self._state(now), rest)
            self._began, at_s = now, 0.0
        elif at_s >= self._follow_s - 1.5 * period_s:
            self._before, self._before_at = self._view.poses(), now
        finger = np.array([[arm.x, arm.y, arm.heading]])
        twist = wanted(self._plan[np.newaxis], at_s, finger, (goal.x, goal.y), period_s, self._p)[0]
        return Twist(*twist.tolist())

    def _state(self, now: Instant) -> Snapshot:
        """The true state; the objects' speeds from their last two poses."""
        passed_s = (now - self._before_at) / NS_PER_S
        moved = self._view.poses() - self._before
        return snapshot(self._view, moved / passed_s if passed_s > 0 else np.zeros_like(moved))


def snapshot(view: WorldView, speeds: FloatArray) -> Snapshot:
    """State of the world behind ``view``, its objects moving at ``speeds`` (n, 3), m/s and
    rad/s."""
    finger = view.finger()
    twist = finger.twist
    return Snapshot(
        finger=np.array([finger.x, finger.y, finger.heading, twist.vx, twist.vy, twist.omega]),
        wrench=np.array([finger.fx, finger.fy, finger.mz]),
        poses=view.poses(),
        speeds=speeds,
        standing=view.on_shelf(),
    )
