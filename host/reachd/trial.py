"""The states of a trial: idle → homing → reaching → resetting → idle. Pure.

In each cycle of the control loop `Supervisor.step` gives the wanted twist, the gate decides, and
`Supervisor.observe` receives the decision.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from enum import StrEnum

from reachd.gate.gate import Decision, Intervention
from reachd.gate.settings import Check
from reachd.interfaces import ZERO, ArmState, Goal, Strategy, Touch, Twist
from reachd.strategies.builtin import StrategyEvent
from reachd.strategies.parameter_fields import Parameters
from reachd.strategies.primitives import aim, wrapped
from reachd.strategies.runner import ask, begin
from tactile_core.types import Instant, record, seconds_between

# Motion to the home pose, from which a reach starts.


NEAR = 0.002
"""m from the pose that count as there; the noise of a robot arm's pose is a tenth of it."""

STRAIGHT = 0.02
"""rad from the heading that count as there: 3 mm at the tip."""

APPROACH = 2.0
"""1/s, speed per distance left, so that the arm arrives without overshoot at 100 Hz."""

CLEAR = 0.01
"""m in front of the cupboard from which the tip counts as outside."""


@dataclass(frozen=True, slots=True)
class Pose:
    """Pose of the pivot: m, m, rad in ``cupboard``."""

    x: float
    y: float
    heading: float


def home_twist(arm: ArmState, home: Pose, parameters: Parameters) -> Twist | None:
    """Twist towards ``home``; None when there.

    While the tip is inside the cupboard the arm only backs out along −x, so that it sweeps nothing
    aside; in front of the cupboard it moves straight home, turning on the way.
    """
    ex, ey = home.x - arm.x, home.y - arm.y
    turn = wrapped(home.heading - arm.heading)
    distance = math.hypot(ex, ey)
    if distance < NEAR and abs(turn) < STRAIGHT:
        return None
    v_max, omega_max = parameters.v_max, parameters.omega_max
    inside = arm.x + parameters.tip_length * math.cos(arm.heading) > -CLEAR
    if inside and (abs(ey) > NEAR or abs(turn) > STRAIGHT):
        return Twist(-v_max, 0.0, 0.0)
    part = min(v_max / distance, APPROACH) if distance > 0.0 else 0.0
    omega = max(-omega_max, min(omega_max, APPROACH * turn))
    return Twist(ex * part, ey * part, omega)


# The record of a reach, and its outcome.


class Reason(StrEnum):
    """Why a reach ended. Logs contain these words, so their meaning must never change."""

    REACHED = "reached"
    TIMEOUT = "timeout"
    STOPPED = "stopped"
    HELD = "held"


@dataclass(frozen=True, slots=True)
class Excavation:
    """An excavation: direction "cw" or "ccw", its trigger, and s since the reach began."""

    direction: str
    trigger: str
    at: float


@dataclass(frozen=True, slots=True)
class Outcome:
    """Outcome of a reach, in m, s and N.

    ``distance``: from tip to goal at the end; ``closest``: the smallest. ``peak_force``: largest
    normal force of a taxel; ``peak_load``: largest in-plane force that the arm reported.
    ``interventions``: how often each began, by code.
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
        """Number of excavations with this direction and trigger; None: any."""
        return sum(
            direction in (None, e.direction) and trigger in (None, e.trigger)
            for e in self.excavations
        )


@dataclass(slots=True)
class Onsets:
    """Finds interventions that begin, and counts them by code."""

    counts: dict[str, int] = field(default_factory=dict)
    _present: frozenset[Check] = frozenset()

    def update(self, interventions: Iterable[Intervention]) -> tuple[Intervention, ...]:
        """Interventions of this cycle that were not present in the one before."""
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
    """The running record of one reach towards ``goal``."""

    goal: Goal
    began: Instant
    distance: float = math.nan
    closest: float = math.inf
    peak_force: float = 0.0
    peak_load: float = 0.0
    excavations: list[Excavation] = field(default_factory=list)
    onsets: Onsets = field(default_factory=Onsets)

    def add_cycle(self, touch: Touch | None, arm: ArmState, distance: float) -> None:
        """Add one cycle; numbers that are not finite do not change the peaks."""
        self.distance = distance
        self.closest = min(self.closest, distance)
        load = math.hypot(arm.fx, arm.fy)
        if load > self.peak_load:
            self.peak_load = load
        if touch is not None and touch.valid and touch.peak_force > self.peak_force:
            self.peak_force = touch.peak_force

    def add_events(self, events: Iterable[StrategyEvent]) -> None:
        """Add events of the strategy."""
        for event in events:
            if event.kind == "excavation_start":
                at = seconds_between(self.began, event.at)
                self.excavations.append(Excavation(event.direction, event.trigger, at))

    def end(self, reason: Reason, text: str, now: Instant) -> Outcome:
        """Make the outcome."""
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


HOMING_LIMIT = 60.0
"""s for homing or resetting: half a turn at 0.1 rad/s and the path across the shelf."""


class State(StrEnum):
    """The paper's trial workflow."""

    IDLE = "idle"
    HOMING = "homing"
    REACHING = "reaching"
    RESETTING = "resetting"


@record
class Command:
    """The twist wanted now, for the gate, and ``events`` for the log.

    ``wanted``: None, with the reason in ``failure``, when the strategy failed. ``goal``: set while
    reaching.
    """

    wanted: Twist | None
    goal: Goal | None = None
    failure: str | None = None
    events: tuple[StrategyEvent, ...] = ()


@dataclass(frozen=True, slots=True)
class Status:
    """State of the supervisor. ``elapsed``: s since the state began; ``distance``: m."""

    state: State
    activity: str
    elapsed: float
    goal: Goal | None
    distance: float
    text: str
    outcome: Outcome | None


class Supervisor:
    """Runs trials one after another with one strategy.

    ``home``: pose from which every reach starts; None: start wherever the arm is, and stay there on
    a reset. ``auto_reset``: go home after a reach without a request.
    """

    def __init__(
        self,
        strategy: Strategy,
        parameters: Parameters,
        home: Pose | None = None,
        *,
        auto_reset: bool = False,
    ) -> None:
        self._strategy = strategy
        self._parameters = parameters
        self._home = home
        self._auto_reset = auto_reset
        self._state = State.IDLE
        self._since: Instant | None = None  # until the first cycle
        self._activity = "idle"
        self._text = ""
        self._returning = False
        self._trial: Trial | None = None
        self._outcome: Outcome | None = None
        self._onsets = Onsets()

    @property
    def state(self) -> State:
        """State of the trial."""
        return self._state

    @property
    def outcome(self) -> Outcome | None:
        """Outcome of the last reach; None before the first and once another goal is accepted."""
        return self._outcome

    def request_goal(self, goal: Goal, now: Instant) -> str | None:
        """Begin a trial towards ``goal`` (see `services.make_goal`); returns why not, or None."""
        if self._state is not State.IDLE:
            return f"a goal is accepted when idle, not when {self._state}: stop and reset first"
        self._trial = Trial(goal, now)
        self._outcome = None
        self._enter(State.HOMING, "homing", now)
        return None

    def request_stop(self, now: Instant, text: str = "stopped by the operator") -> str | None:
        """End any motion; returns why there is nothing to stop, or None."""
        if self._state is State.IDLE:
            return "nothing to stop: idle"
        self._abort(Reason.STOPPED, text, now)
        return None

    def request_reset(self, now: Instant) -> str | None:
        """After a reach, go home and accept another goal; returns why not, or None."""
        if self._state is not State.RESETTING:
            return f"a reset follows a reach; the state is {self._state}"
        self._enter(State.RESETTING, "returning", now)
        self._returning = True
        return None

    def status(self, now: Instant) -> Status:
        """State of the trial for status and publishing."""
        trial = self._trial
        return Status(
            state=self._state,
            activity=self._activity,
            elapsed=self._elapsed(now),
            goal=None if trial is None or self._state is State.IDLE else trial.goal,
            distance=math.nan if trial is None else trial.distance,
            text=self._text,
            outcome=self._outcome,
        )

    def step(self, touch: Touch | None, arm: ArmState | None, now: Instant) -> Command:
        """Decide the wanted twist of this cycle; zero until every input has come once."""
        if self._since is None:
            self._since = now
        trial = self._trial
        if trial is None or self._state is State.IDLE:
            return Command(ZERO)
        if self._state is State.HOMING and arm is not None:
            twist = self._towards_home(arm)
            if twist is not None:
                return self._in_time(twist, now)
            self._trial = trial = Trial(trial.goal, now)
            self._enter(State.REACHING, "starting", now)
            failure = begin(self._strategy, trial.goal, now)
            if failure is not None:
                return Command(None, failure=failure)
        if self._state is State.REACHING:
            return self._reach(trial, touch, arm, now)
        if self._returning and arm is not None:
            twist = self._towards_home(arm)
            if twist is not None:
                return self._in_time(twist, now)
            self._idle("ready for another goal", now)
        return Command(ZERO)

    def observe(self, decision: Decision, now: Instant) -> tuple[Intervention, ...]:
        """Process the gate's decision; returns the interventions that have just begun.

        A latch ends a reach, with its reason, and stops homing and resetting.
        """
        found = decision.interventions
        if self._trial is not None:
            self._trial.onsets.update(found)
        if decision.held is not None:
            why = [i.text for i in found if i.code is decision.held]
            self._abort(Reason.HELD, "; ".join(why), now)
        return self._onsets.update(found)

    def _abort(self, reason: Reason, text: str, now: Instant) -> None:
        """End any motion, without going home."""
        if self._state is State.REACHING and self._trial is not None:
            self._finish(self._trial, reason, text, now)
        elif self._state is State.HOMING:
            self._idle(text, now)
        self._returning = False

    def _enter(self, state: State, activity: str, now: Instant) -> None:
        self._state, self._activity, self._since = state, activity, now

    def _idle(self, text: str, now: Instant) -> None:
        self._enter(State.IDLE, "idle", now)
        self._text = text
        self._returning = False

    def _finish(self, trial: Trial, reason: Reason, text: str, now: Instant) -> None:
        """End the trial, and stand still until reset."""
        self._outcome = trial.end(reason, text, now)
        self._text = text
        self._enter(State.RESETTING, "waiting for a reset", now)
        self._returning = self._auto_reset

    def _towards_home(self, arm: ArmState) -> Twist | None:
        return None if self._home is None else home_twist(arm, self._home, self._parameters)

    def _elapsed(self, now: Instant) -> float:
        """s since the state began."""
        return 0.0 if self._since is None else seconds_between(self._since, now)

    def _in_time(self, twist: Twist, now: Instant) -> Command:
        """``twist``, or zero when going home takes too long."""
        if self._elapsed(now) < HOMING_LIMIT:
            return Command(twist)
        text = f"not home after {HOMING_LIMIT:g} s: free the arm and bring it home by hand"
        if self._state is State.HOMING:
            self._idle(text, now)
        self._text = text
        self._returning = False
        return Command(ZERO)

    def _reach(
        self, trial: Trial, touch: Touch | None, arm: ArmState | None, now: Instant
    ) -> Command:
        goal, p = trial.goal, self._parameters
        elapsed = seconds_between(trial.began, now)
        if arm is not None:
            distance = aim(arm, goal, p.tip_length).distance
            trial.add_cycle(touch, arm, distance)
            judged = p.success_during_excavation or not self._activity.startswith("excavate")
            if distance <= goal.radius and judged:
                text = f"reached within {distance * 1e3:.1f} mm after {elapsed:.2f} s"
                self._finish(trial, Reason.REACHED, text, now)
                return Command(ZERO)
        if elapsed >= goal.time_limit:
            text = f"not reached within {goal.time_limit:g} s, {trial.distance * 1e3:.1f} mm short"
            self._finish(trial, Reason.TIMEOUT, text, now)
            return Command(ZERO)
        if arm is None or touch is None:
            return Command(ZERO, goal)
        answer = ask(self._strategy, touch, arm, goal, now)
        self._activity = answer.activity
        trial.add_events(answer.events)
        return Command(answer.twist, goal, answer.failure, answer.events)
