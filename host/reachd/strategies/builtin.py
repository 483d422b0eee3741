"""The paper's five strategies, and the base class of the built-in ones."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from reachd.gate.limits import usable
from reachd.interfaces import ZERO, ArmState, Goal, Touch, Twist
from reachd.strategies.parameter_fields import Parameters
from reachd.strategies.primitives import Aim, aim, burrow, excavate, slowing, straight
from tactile_core.geometry import Side
from tactile_core.types import NS_PER_S, Instant, record, seconds_between

MAX_EVENTS = 64
"""Events kept until they are taken. They are taken once a cycle, so more means that nobody does."""


@dataclass(frozen=True, slots=True)
class StrategyEvent:
    """Something a strategy decided.

    ``kind``: "excavation_start", "excavation_end", "sweep_start", "sweep_end", or a word of the
    strategy's own. ``direction``: "cw" or "ccw". ``trigger``: "clock", "stall", "push", "jam", or a
    word of the strategy's own.
    """

    at: Instant
    kind: str
    direction: str
    trigger: str

    @property
    def family(self) -> str:
        """What it belongs to, ``ReachEvent.kind``: "excavation", "sweep"."""
        return self.kind.partition("_")[0]


@record
class Moment:
    """Inputs of one choice; ``elapsed``: s since the reach began."""

    touch: Touch
    arm: ArmState
    aim: Aim
    elapsed: float
    now: Instant


class ReportsEvents(Protocol):
    """A strategy that reports its decisions."""

    def take_events(self) -> tuple[StrategyEvent, ...]:
        """Events since the last call, oldest first."""
        ...


class ReachingStrategy(ABC):
    """Base of the built-in strategies. ``rng`` is the only source of randomness.

    A subclass implements ``_choose``. An excavation that it began runs to its end without it.
    """

    def __init__(self, parameters: Parameters, rng: np.random.Generator) -> None:
        self._parameters = parameters
        self._rng = rng
        self._events: list[StrategyEvent] = []
        self._activity = "straight"
        self._time_limit = 0.0
        self._reset(Instant(0))

    def _reset(self, now: Instant) -> None:
        self._started = now
        self._excavating: StrategyEvent | None = None
        self._excavation_heading = 0.0
        self._excavation_end = now

    @property
    def activity(self) -> str:
        """What it is doing now; see `interfaces.Strategy`."""
        return self._activity

    def start(self, goal: Goal, now: Instant) -> None:
        """Begin a reach towards ``goal``; forget any earlier one."""
        self._events.clear()
        self._activity = "straight"
        self._time_limit = goal.time_limit
        self._reset(now)

    def take_events(self) -> tuple[StrategyEvent, ...]:
        """Events since the last call, oldest first."""
        events = tuple(self._events)
        self._events.clear()
        return events

    def step(self, touch: Touch, arm: ArmState, goal: Goal, now: Instant) -> Twist:
        """Twist of the pivot wanted now."""
        p = self._parameters
        at = Moment(
            touch, arm, aim(arm, goal, p.tip_length), seconds_between(self._started, now), now
        )
        running = self._excavating
        if running and seconds_between(running.at, now) >= p.excavate_duration:
            self._excavating = None
            self._report(StrategyEvent(now, "excavation_end", running.direction, running.trigger))
            self._excavation_ended(at)
        if self._excavating is None:
            twist = self._choose(at)
            if twist is not None:
                return twist
        return self._excavate(at)

    @abstractmethod
    def _choose(self, at: Moment) -> Twist | None:
        """Motion wanted outside an excavation; None after ``_begin`` started one."""

    def _excavation_ended(self, at: Moment) -> None:
        """Called when an excavation has just ended."""
        self._excavation_end = at.now

    def _has_time(self, at: Moment) -> bool:
        """Whether enough time remains for an excavation, where the set asks for that."""
        p = self._parameters
        remaining = self._time_limit - at.elapsed
        return not p.excavate_needs_time or remaining >= p.excavate_duration

    def _clock_trigger(self, at: Moment) -> bool:
        """Whether t_trig has passed since the reach began or the last excavation ended."""
        passed = seconds_between(self._excavation_end, at.now) > self._parameters.trigger_interval
        return passed and self._has_time(at)

    def _begin(self, at: Moment, *, ccw: bool, trigger: str) -> None:
        """Begin an excavation."""
        direction = "ccw" if ccw else "cw"
        self._excavating = StrategyEvent(at.now, "excavation_start", direction, trigger)
        self._excavation_heading = at.arm.heading
        self._report(self._excavating)

    def _report(self, event: StrategyEvent) -> None:
        if len(self._events) < MAX_EVENTS:
            self._events.append(event)

    def _excavate(self, at: Moment) -> Twist:
        """Equations (5) to (8) for the running excavation."""
        running, p = self._excavating, self._parameters
        if running is None:
            raise RuntimeError("_choose() returned None without having begun an excavation")
        self._activity = f"excavate_{running.direction}"
        fraction = seconds_between(running.at, at.now) / p.excavate_duration
        heading = self._excavation_heading if p.excavate_heading == "start" else at.arm.heading
        left = slowing(at.aim.distance, p, straight=False)
        return excavate(fraction, heading, p, ccw=running.direction == "ccw", left=left)


# The paper's primitives in isolation: straight, burrow, and excavate by the clock.


class Straight(ReachingStrategy):
    """Straight at the goal, always."""

    def _choose(self, at: Moment) -> Twist | None:
        """Equations (1) and (2)."""
        return straight(at.aim, at.arm.heading, self._parameters)


class Burrow(ReachingStrategy):
    """Burrow, always."""

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


# The paper's hybrid strategies: excavate by the clock or by what is felt, and burrow otherwise.
#
# Touch that is invalid or not finite does not mean "no contact". While it lasts, the event strategy
# continues what it did, does not count the time of a tip contact and starts no excavation; before
# the first valid touch it waits. After 0.2 s the safety gate stops the arm.


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
        self._light_ns: int | None = None  # duration of the light tip contact, None without one
        self._dark_ns = 0  # since that contact was last felt
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
        """The force (N) that is compared with F_bur and F_excv."""
        return touch.peak_force if self._parameters.force_measure == "peak" else touch.total_force

    def _feel(self, touch: Touch, elapsed_ns: int) -> None:
        """Count how long the tip has been in light contact, ignoring short gaps."""
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
        """Which of the paper's two cases holds: "stall" (2), "push" (1), or "" for neither."""
        p = self._parameters
        late = seconds_between(self._reference_at, at.now) - p.progress_time
        gained = (self._reference or 0.0) - at.aim.distance
        if gained <= p.v_max * late and self._force(at.touch) >= p.excavate_force:
            return "stall"
        if self._light_ns is not None and self._light_ns >= p.push_time * NS_PER_S:
            return "push"
        return ""

    def _direction(self, at: Moment) -> bool:
        """Whether to excavate CCW: when the peak contact is on the left, as often as the set says.

        A peak on neither side leaves it to chance. Draws exactly once an excavation.
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
