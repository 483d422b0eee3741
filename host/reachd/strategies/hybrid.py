"""The paper's hybrid strategies: excavate by the clock or by what is felt, and burrow otherwise.

Touch that is invalid or not finite is never taken for "no contact". While it lasts, the event
strategy goes on with what it did, the time of a tip contact stands still, and no excavation is
triggered; before the first valid touch it waits. The safety gate ends motion after 0.2 s of it.
"""

from __future__ import annotations

import math

from reachd.finite import usable
from reachd.primitives import burrow, straight
from reachd.seam import ZERO, Touch, Twist
from reachd.strategies.base import Moment, ReachingStrategy
from reachd.strategies.isolated import Excavate
from tactile_bus.geometry import Side
from tactile_bus.instant import NS_PER_S, Instant, seconds_between


class HybridClock(Excavate):
    """Burrow, and every t_trig an excavation in a random direction."""

    def _travel(self, at: Moment) -> Twist:
        self._activity = "burrow"
        return burrow(at.aim, at.arm.heading, at.elapsed, self._parameters)


class HybridEvent(ReachingStrategy):
    """Straight when free, burrow when resisted, excavate when stalled or pushing at the tip."""

    def _reset(self, now: Instant) -> None:
        super()._reset(now)
        self._previous = now
        self._mode = ""  # nothing felt yet
        self._light_ns: int | None = None  # of light tip contact, None when there is none
        self._dark_ns = 0  # since it was last felt
        self._reference: float | None = None  # distance (m) from which progress counts
        self._reference_at = now

    def _choose(self, at: Moment) -> Twist | None:
        """Excavate on either trigger, burrow above F_bur, else straight."""
        p = self._parameters
        if self._reference is None:
            self._reference = at.aim.distance
        since_last = at.now - self._previous
        self._previous = at.now
        if usable(at.touch):
            self._feel(at.touch, since_last)
            trigger = self._trigger(at)
            if trigger and self._has_time(at):
                self._begin(at, ccw=self._direction(at), trigger=trigger)
                if p.progress_reference == "excavation_start":
                    self._reference = at.aim.distance
                return None
            self._mode = "burrow" if self._force(at.touch) > p.burrow_force else "straight"
        self._activity = self._mode or "waiting"
        if self._mode == "burrow":
            return burrow(at.aim, at.arm.heading, at.elapsed, p)
        if self._mode == "straight":
            return straight(at.aim, at.arm.heading, p)
        return ZERO

    def _excavation_ended(self, at: Moment) -> None:
        super()._excavation_ended(at)
        self._light_ns = None
        self._reference_at = at.now
        self._previous = at.now
        if self._parameters.progress_reference == "excavation_end":
            self._reference = at.aim.distance

    def _force(self, touch: Touch) -> float:
        """The force that F_bur and F_excv are compared with."""
        return touch.peak_force if self._parameters.force_measure == "peak" else touch.total_force

    def _feel(self, touch: Touch, elapsed_ns: int) -> None:
        """Count how long the tip has been in light contact, short gaps overlooked."""
        p = self._parameters
        if p.push_force_min <= touch.tip_force <= p.push_force_max:
            self._light_ns = 0 if self._light_ns is None else self._light_ns + elapsed_ns
            self._dark_ns = 0
        elif self._light_ns is not None:
            self._light_ns += elapsed_ns
            self._dark_ns += elapsed_ns
            if self._dark_ns >= p.push_dropout * NS_PER_S:
                self._light_ns = None

    def _trigger(self, at: Moment) -> str:
        """Which of the paper's two cases holds: (2) "stall", (1) "push", or neither, ""."""
        p = self._parameters
        late = seconds_between(self._reference_at, at.now) - p.progress_time
        gained = (self._reference or 0.0) - at.aim.distance
        if gained <= p.v_max * late and self._force(at.touch) >= p.excavate_force:
            return "stall"
        if self._light_ns is not None and self._light_ns >= p.push_time * NS_PER_S:
            return "push"
        return ""

    def _direction(self, at: Moment) -> bool:
        """Whether to excavate CCW: peak contact on the left, with the set's obedience.

        A peak that is on neither side leaves it to chance. One draw an excavation, always.
        """
        p, touch, arm = self._parameters, at.touch, at.arm
        draw = float(self._rng.random())
        if touch.peak_side == Side.NONE:
            offset = 0.0
        elif p.direction_from == "cupboard_y":
            c, s = math.cos(arm.heading), math.sin(arm.heading)
            offset = arm.y + s * touch.peak_x + c * touch.peak_y - at.aim.tip_y
        elif touch.peak_side == Side.TIP:
            offset = touch.peak_y
        else:
            offset = 1.0 if touch.peak_side == Side.LEFT else -1.0
        if offset == 0.0:
            return draw < p.ccw_chance
        return (offset > 0.0) == (draw < p.direction_obedience)
