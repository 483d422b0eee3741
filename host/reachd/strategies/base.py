"""What the built-in strategies share: the clock of a reach, excavations and their events."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from reachd.parameter_fields import Parameters
from reachd.primitives import Aim, aim, excavate, slowing
from reachd.seam import ArmState, Goal, Touch, Twist
from tactile_bus.instant import Instant, seconds_between
from tactile_bus.records import record

MAX_EVENTS = 64
"""Events kept until they are taken: a reach has at most a few excavations, so more means that
nobody takes them."""


@dataclass(frozen=True, slots=True)
class StrategyEvent:
    """Something a strategy decided. ``kind`` is "excavation_start" or "excavation_end".

    ``direction`` is "cw" or "ccw"; ``trigger`` is "clock", "stall", "push" or a plug-in's word.
    """

    at: Instant
    kind: str
    direction: str
    trigger: str


@record
class Moment:
    """What a strategy chooses by: newest touch and arm state, the aim, s since the reach began."""

    touch: Touch
    arm: ArmState
    aim: Aim
    elapsed: float
    now: Instant


class ReportsEvents(Protocol):
    """A strategy that tells what it decided."""

    def take_events(self) -> tuple[StrategyEvent, ...]:
        """Events since the last call, oldest first."""
        ...


class ReachingStrategy(ABC):
    """Base of the built-in strategies. ``rng`` is the only source of chance.

    A subclass writes ``_choose``; an excavation that it has begun runs to its end by itself.
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
        """What it is doing; see ``seam.Strategy``."""
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
        """Motion wanted outside an excavation, or None after ``_begin`` started one."""

    def _excavation_ended(self, at: Moment) -> None:
        """Take note that an excavation has just ended."""
        self._excavation_end = at.now

    def _has_time(self, at: Moment) -> bool:
        """Whether the set allows an excavation to start with the time that remains."""
        p = self._parameters
        remaining = self._time_limit - at.elapsed
        return not p.excavate_needs_time or remaining >= p.excavate_duration

    def _clock_trigger(self, at: Moment) -> bool:
        """Whether t_trig has passed since the start or the end of the last excavation."""
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
        """Equations (5) to (8) for the excavation under way."""
        running, p = self._excavating, self._parameters
        if running is None:
            raise RuntimeError("_choose() returned None without having begun an excavation")
        self._activity = f"excavate_{running.direction}"
        fraction = seconds_between(running.at, at.now) / p.excavate_duration
        heading = self._excavation_heading if p.excavate_heading == "start" else at.arm.heading
        left = slowing(at.aim.distance, p, straight=False)
        return excavate(fraction, heading, p, ccw=running.direction == "ccw", left=left)
