"""One cycle of control: supervisor, then gate, then the twist to send. Pure."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

from reachd.outcome import Outcome
from reachd.safety import Decision, Intervention, SafetyGate
from reachd.safety_settings import Check, SafetySettings
from reachd.seam import ArmState, Goal, Touch, Twist
from reachd.strategies import StrategyEvent
from reachd.supervisor import Status, Supervisor
from tactile_bus.instant import Instant, seconds_between

MAX_FINISHED = 16
"""Outcomes that wait to be taken; somebody does so several times a second."""


@dataclass(frozen=True, slots=True)
class Inputs:
    """Newest inputs, None where none ever came; whether a second publisher was seen on one.

    ``rivalled``: somebody else was seen to send commands to the arm.
    """

    touch: Touch | None
    arm: ArmState | None
    duplicate: bool = False
    rivalled: bool = False


@dataclass(frozen=True, slots=True)
class Cycle:
    """All that one cycle saw and decided. ``onsets``: interventions that have just set in.

    ``lateness`` in s.
    """

    now: Instant
    lateness: float
    inputs: Inputs
    wanted: Twist | None
    decision: Decision
    status: Status
    onsets: tuple[Intervention, ...]
    events: tuple[StrategyEvent, ...]

    @property
    def touch_age(self) -> float:
        """Age of the features in s, NaN before the first."""
        touch = self.inputs.touch
        return math.nan if touch is None else seconds_between(touch.captured, self.now)

    @property
    def arm_age(self) -> float:
        """Age of the arm's state in s, NaN before the first."""
        arm = self.inputs.arm
        return math.nan if arm is None else seconds_between(arm.captured, self.now)


class Controller:
    """What the control loop runs. ``gate`` and ``supervisor`` are one arm's.

    Everything here belongs to the loop's thread, but for ``finished``: outcomes with their goals,
    oldest first, for whoever takes them.
    """

    def __init__(self, supervisor: Supervisor, gate: SafetyGate, settings: SafetySettings) -> None:
        self.supervisor = supervisor
        self.gate = gate
        self._settings = settings
        self.inputs = Inputs(None, None)
        self.finished: deque[tuple[Outcome, Goal]] = deque(maxlen=MAX_FINISHED)
        self._goal: Goal | None = None
        self._troubles: tuple[str, ...] = ()

    def cycle(self, inputs: Inputs, now: Instant, lateness: float) -> Cycle:
        """Decide what is sent now."""
        self.inputs = inputs
        if lateness > self._settings.arm_latch:
            # Stopped and continued, or the machine slept: nobody has watched since.
            self.gate.disarm(now, f"the control loop stood still for {lateness:.1f} s")
        command = self.supervisor.step(inputs.touch, inputs.arm, now)
        decision = self.gate.step(
            command.wanted,
            inputs.touch,
            inputs.arm,
            command.goal,
            now,
            lateness=lateness,
            duplicate=inputs.duplicate,
            rivalled=inputs.rivalled,
            failure=command.failure,
        )
        self._troubles = tuple(
            i.text for i in decision.interventions if i.code is not Check.NOT_ARMED
        )
        onsets = self.supervisor.observe(decision, now)
        status = self.supervisor.status(now)
        if self._goal is not None and status.outcome is not None:
            self.finished.append((status.outcome, self._goal))
            self._goal = None
        return Cycle(
            now,
            lateness,
            inputs,
            command.wanted,
            decision,
            status,
            onsets,
            command.events,
        )

    def arm(
        self, requested: Instant, since: Instant, now: Instant, *, free_air: bool
    ) -> tuple[str, ...]:
        """Arm at an operator's request; returns why not.

        ``since``: when the operator acted; ``requested``: when what had to come before (limits)
        was done. Whatever latched in between was not known to the operator.
        """
        if self.gate.armed:
            return ()
        if any(
            at > since
            for code, at in self.gate.latched_at.items()
            if code is not Check.ARM_LIMITS  # which the request itself is about to set right
        ):
            return self._troubles or ("something failed after the request to arm: ask again",)
        refusals = self.gate.arm(
            requested,
            self.inputs.touch,
            self.inputs.arm,
            now,
            duplicate=self.inputs.duplicate,
            free_air=free_air,
        )
        # A fault that goes on makes every request too old: it is the fault that matters.
        causes = [r.text for r in refusals if r.code is not Check.REQUEST_STALE]
        return tuple(dict.fromkeys(causes or [r.text for r in refusals]))

    def reach(self, goal: Goal, now: Instant) -> str | None:
        """Begin a trial; returns why not."""
        held = self.gate.held
        if held is not None:
            return f"the arm is not armed: {held.text}"
        refusal = self.supervisor.request_goal(goal, now)
        if refusal is None:
            self._goal = goal
        return refusal
