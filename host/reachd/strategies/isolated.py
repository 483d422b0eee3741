"""The paper's primitives in isolation: straight, burrow, and excavate by the clock."""

from __future__ import annotations

from reachd.primitives import burrow, straight
from reachd.seam import Twist
from reachd.strategies.base import Moment, ReachingStrategy


class Straight(ReachingStrategy):
    """Straight at the goal without end."""

    def _choose(self, at: Moment) -> Twist | None:
        """Equations (1) and (2)."""
        return straight(at.aim, at.arm.heading, self._parameters)


class Burrow(ReachingStrategy):
    """Burrow without end."""

    def _choose(self, at: Moment) -> Twist | None:
        """Equations (2) to (4)."""
        self._activity = "burrow"
        return burrow(at.aim, at.arm.heading, at.elapsed, self._parameters)


class Excavate(ReachingStrategy):
    """Straight, and every t_trig an excavation in a random direction."""

    def _choose(self, at: Moment) -> Twist | None:
        """Straight until the clock says excavate."""
        if self._clock_trigger(at):
            ccw = self._rng.random() < self._parameters.ccw_chance
            self._begin(at, ccw=ccw, trigger="clock")
            return None
        return self._travel(at)

    def _travel(self, at: Moment) -> Twist:
        """Motion between excavations."""
        self._activity = "straight"
        return straight(at.aim, at.arm.heading, self._parameters)
