"""What became of a reach, gathered while it runs."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from enum import StrEnum

from reachd.safety import Intervention
from reachd.safety_settings import Check
from reachd.seam import ArmState, Goal, Touch
from reachd.strategies.base import StrategyEvent
from tactile_bus.instant import Instant, seconds_between


class Reason(StrEnum):
    """Why a reach ended. Written to logs: never change the meaning of a word."""

    REACHED = "reached"
    TIMEOUT = "timeout"
    STOPPED = "stopped"
    HELD = "held"


@dataclass(frozen=True, slots=True)
class Excavation:
    """One excavation: direction "cw" or "ccw", what triggered it, s since the reach began."""

    direction: str
    trigger: str
    at: float


@dataclass(frozen=True, slots=True)
class Outcome:
    """A reach that has ended. m, s, N.

    ``distance`` is that of tip and goal at the end, ``closest`` the least there was.
    ``peak_force`` is the greatest normal force of a taxel, ``peak_load`` the greatest in-plane
    force that the arm reported. ``interventions``: how often each one set in.
    """

    success: bool
    reason: Reason
    text: str
    distance: float
    closest: float
    time: float
    peak_force: float
    peak_load: float
    excavations: tuple[Excavation, ...]
    interventions: dict[str, int]

    def count(self, direction: str | None = None, trigger: str | None = None) -> int:
        """Excavations with this direction and trigger, None for any."""
        return sum(
            direction in (None, e.direction) and trigger in (None, e.trigger)
            for e in self.excavations
        )


@dataclass(slots=True)
class Onsets:
    """Tells interventions that set in from those that go on, and counts them by code."""

    counts: dict[str, int] = field(default_factory=dict)
    _present: frozenset[Check] = frozenset()

    def update(self, interventions: Iterable[Intervention]) -> tuple[Intervention, ...]:
        """Interventions of this cycle that were not there in the one before."""
        found = tuple(interventions)
        if not found and not self._present:
            return ()
        new = tuple(i for i in found if i.code not in self._present)
        self._present = frozenset(i.code for i in found)
        for one in new:
            self.counts[one.code] = self.counts.get(one.code, 0) + 1
        return new


@dataclass(slots=True)
class Trial:
    """The running account of one reach towards ``goal``."""

    goal: Goal
    began: Instant
    distance: float = math.nan
    closest: float = math.inf
    peak_force: float = 0.0
    peak_load: float = 0.0
    excavations: list[Excavation] = field(default_factory=list)
    onsets: Onsets = field(default_factory=Onsets)

    def see(self, touch: Touch | None, arm: ArmState, distance: float) -> None:
        """Take in one cycle; numbers that are not finite leave the record as it is."""
        self.distance = distance
        self.closest = min(self.closest, distance)
        load = math.hypot(arm.fx, arm.fy)
        if load > self.peak_load:
            self.peak_load = load
        if touch is not None and touch.valid and touch.peak_force > self.peak_force:
            self.peak_force = touch.peak_force

    def hear(self, events: Iterable[StrategyEvent]) -> None:
        """Take in what the strategy decided."""
        for event in events:
            if event.kind == "excavation_start":
                at = seconds_between(self.began, event.at)
                self.excavations.append(Excavation(event.direction, event.trigger, at))

    def end(self, reason: Reason, text: str, now: Instant) -> Outcome:
        """Close the account."""
        return Outcome(
            success=reason is Reason.REACHED,
            reason=reason,
            text=text,
            distance=self.distance,
            closest=self.closest,
            time=seconds_between(self.began, now),
            peak_force=self.peak_force,
            peak_load=self.peak_load,
            excavations=tuple(self.excavations),
            interventions=dict(self.onsets.counts),
        )
