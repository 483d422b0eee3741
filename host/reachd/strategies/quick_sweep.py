"""Quick sweep: straight at the goal; a jam is answered at once by a short sweep off the contact.

Not of the paper. Its excavation takes 5 s and starts seconds after a jam. Here a jam is seen in
about a third of a second and answered by a sweep of about the same length, so a reach can try
some twenty openings in the time of three excavations.
"""

from __future__ import annotations

import math

from reachd.gate.limits import usable
from reachd.interfaces import ZERO, Touch, Twist
from reachd.strategies.builtin import Moment, ReachingStrategy, StrategyEvent
from reachd.strategies.primitives import pivot_velocity, slowing, straight
from tactile_core.geometry import Side
from tactile_core.types import NS_PER_S, Instant, seconds_between


class QuickSweep(ReachingStrategy):
    """Straight; when jammed, a short sweep to the side away from the peak contact.

    Jammed: the tip came less than `jam_progress` nearer to the goal in `jam_time` while the normal
    forces on the skin sum to at least `jam_force`. Sweep: for `sweep_time` at v_max in a direction
    `sweep_angle` off the goal's, turning the same way at `sweep_omega`.

    Events: "sweep_start" and "sweep_end", trigger "jam", direction "ccw" (to the left) or "cw".
    While touch is invalid a sweep goes on to its end, the time without progress stands still and
    no sweep starts; before the first valid touch the arm waits.
    """

    def _reset(self, now: Instant) -> None:
        super()._reset(now)
        self._previous = now
        self._felt = False
        self._best = math.inf  # distance (m) that the next progress counts from
        self._stuck_ns = 0  # since the last progress
        self._sweep: StrategyEvent | None = None

    def _choose(self, at: Moment) -> Twist | None:
        """Sweep until it has ended, start one when jammed, else straight."""
        p = self._parameters
        since_last = at.now - self._previous
        self._previous = at.now
        if self._sweep and seconds_between(self._sweep.at, at.now) >= p.sweep_time:
            self._report(StrategyEvent(at.now, "sweep_end", self._sweep.direction, "jam"))
            self._sweep = None
            self._best, self._stuck_ns = at.aim.distance, 0
        elif self._sweep is None and usable(at.touch):
            self._felt = True
            self._count(at, since_last)
            if self._stuck_ns >= p.jam_time * NS_PER_S and at.touch.total_force >= p.jam_force:
                direction = "ccw" if self._goes_left(at.touch) else "cw"
                self._sweep = StrategyEvent(at.now, "sweep_start", direction, "jam")
                self._report(self._sweep)
        if self._sweep:
            self._activity = f"sweep_{self._sweep.direction}"
            return self._swept(at, 1.0 if self._sweep.direction == "ccw" else -1.0)
        self._activity = "straight" if self._felt else "waiting"
        return straight(at.aim, at.arm.heading, p) if self._felt else ZERO

    def progress(self, now: Instant) -> tuple[float, float, float]:
        """Part of a sweep that is left, its side (1 left, −1 right, 0 none), and the part of
        `jam_time` that has passed without progress."""
        p = self._parameters
        stuck = self._stuck_ns / NS_PER_S / p.jam_time
        if self._sweep is None:
            return 0.0, 0.0, stuck
        left = 1.0 - seconds_between(self._sweep.at, now) / p.sweep_time
        return max(0.0, left), 1.0 if self._sweep.direction == "ccw" else -1.0, stuck

    def _count(self, at: Moment, elapsed_ns: int) -> None:
        """Count the time without progress."""
        if at.aim.distance <= self._best - self._parameters.jam_progress:
            self._best, self._stuck_ns = at.aim.distance, 0
        else:
            self._stuck_ns += elapsed_ns

    def _swept(self, at: Moment, side: float) -> Twist:
        """The motion of a sweep; ``side``: 1 to the left, −1 to the right."""
        p = self._parameters
        left = slowing(at.aim.distance, p, straight=False)
        angle = at.aim.angle + side * p.sweep_angle
        speed = left * p.v_max
        omega = side * left * p.sweep_omega
        return pivot_velocity(
            speed * math.cos(angle), speed * math.sin(angle), omega, at.arm.heading, p
        )

    def _goes_left(self, touch: Touch) -> bool:
        """Whether to sweep to the left: away from the peak contact, as often as the set says.

        A peak in the middle leaves it to chance. Draws exactly once a sweep.
        """
        draw = float(self._rng.random())
        if touch.peak_side == Side.LEFT:
            offset = 1.0
        elif touch.peak_side == Side.RIGHT:
            offset = -1.0
        else:
            offset = touch.peak_y
        if offset == 0.0:
            return draw < self._parameters.ccw_chance
        return (offset < 0.0) == (draw < self._parameters.sweep_obedience)
