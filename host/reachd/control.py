"""The control loop: absolute deadlines, newest inputs, one command per cycle."""

from __future__ import annotations

import logging
import math
import threading
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np

from reachd.arms.base import ArmError
from reachd.gate.gate import Decision, Intervention, SafetyGate
from reachd.gate.settings import Check, SafetySettings
from reachd.interfaces import ZERO, ArmState, Goal, Touch, Twist
from reachd.strategies import StrategyEvent
from reachd.trial import Outcome, Status, Supervisor
from tactile_core.daemon import request_real_time
from tactile_core.types import NS_PER_S, Instant, monotonic_now, seconds_between

# One cycle of control: supervisor, then gate, which gives the twist to send. Pure.


MAX_FINISHED = 16
"""Most outcomes kept until they are taken, which happens several times a second."""


@dataclass(frozen=True, slots=True)
class Inputs:
    """Newest inputs; None where none has come yet.

    ``duplicate``: a second publisher was seen on an input. ``rivalled``: another sender of commands
    to the arm was seen.
    """

    touch: Touch | None
    arm: ArmState | None
    duplicate: bool = False
    rivalled: bool = False


@dataclass(frozen=True, slots=True)
class Cycle:
    """Inputs and decisions of one cycle. ``wanted``: twist from the strategy.

    ``onsets``: interventions that began in this cycle. ``lateness``: s.
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
        """Age of the features, s; NaN before the first."""
        touch = self.inputs.touch
        return math.nan if touch is None else seconds_between(touch.captured, self.now)

    @property
    def arm_age(self) -> float:
        """Age of the arm's state, s; NaN before the first."""
        arm = self.inputs.arm
        return math.nan if arm is None else seconds_between(arm.captured, self.now)


class Controller:
    """One arm's supervisor and gate, run cycle by cycle. Pure.

    Owned by the loop's thread, except ``finished``: outcomes with their goals, oldest first, which
    the main thread takes.
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
        """Run one cycle and return its decision."""
        self.inputs = inputs
        if lateness > self._settings.arm_latch:
            # The process or the machine was suspended: nobody has watched the arm since.
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
        """Arm at an operator's request; returns why not, empty when armed.

        ``since``: when the operator acted. ``requested``: when the preparations (limits) were done.
        A fault that latched in between is refused: the operator did not know of it.
        """
        if self.gate.armed:
            return ()
        if any(
            at > since
            for code, at in self.gate.latched_at.items()
            if code is not Check.ARM_LIMITS  # the request itself corrects the limits
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
        # A lasting fault also makes every request too old; report the fault.
        causes = [r.text for r in refusals if r.code is not Check.REQUEST_STALE]
        return tuple(dict.fromkeys(causes or [r.text for r in refusals]))

    def reach(self, goal: Goal, now: Instant) -> str | None:
        """Begin a trial; returns why not, or None."""
        held = self.gate.held
        if held is not None:
            return f"the arm is not armed: {held.text}"
        refusal = self.supervisor.request_goal(goal, now)
        if refusal is None:
            self._goal = goal
        return refusal


log = logging.getLogger(__name__)

CALLS = 32
"""Most requests that may wait for the control loop, which serves them in every cycle."""

LATENESS_KEPT = 60_000
"""Cycles whose lateness is kept for the status: ten minutes."""

LAST_ZEROS = 3
"""Zero twists sent at the end, because one may be lost."""

R = TypeVar("R")


class Schedule:
    """Absolute deadlines ``period`` s apart. Pure.

    Missed deadlines are skipped and counted in ``missed``.
    """

    def __init__(self, period: float, start: Instant) -> None:
        self._period_ns = round(period * NS_PER_S)
        self.deadline = Instant(start + self._period_ns)
        self.missed = 0

    def begin(self, now: Instant) -> float:
        """Begin a cycle at ``now``: set the next deadline and return the lateness, s."""
        late_ns = max(0, now - self.deadline)
        skipped = late_ns // self._period_ns
        self.missed += skipped
        self.deadline = Instant(self.deadline + (skipped + 1) * self._period_ns)
        return late_ns / NS_PER_S


class Lateness:
    """Distribution of the lateness of cycles, in s."""

    def __init__(self) -> None:
        self._kept: deque[float] = deque(maxlen=LATENESS_KEPT)
        self.cycles = 0

    def add(self, lateness: float) -> None:
        """Add the lateness of one cycle, s."""
        self._kept.append(lateness)
        self.cycles += 1

    def summary(self) -> dict[str, float]:
        """Percentiles over the cycles kept, s; empty before the first."""
        kept = np.array(list(self._kept))
        if not kept.size:
            return {}
        p50, p99, p999 = np.percentile(kept, [50, 99, 99.9]).tolist()
        return {"p50": p50, "p99": p99, "p99.9": p999, "max": float(kept.max())}


class ControlLoop:
    """Runs a controller at its period, on a thread of its own, until `stop`.

    ``sense`` returns the newest inputs. ``act`` sends a twist with its expiry in s and returns the
    bytes sent. ``report`` receives every cycle and those bytes. None of them may block. ``failed``
    receives the error that ended the thread. ``priority``: real-time priority to use when
    ``real_time`` is set.
    """

    def __init__(
        self,
        controller: Controller,
        period: float,
        expiry: float,
        sense: Callable[[Instant], Inputs],
        act: Callable[[Twist, float, Instant], bytes],
        report: Callable[[Cycle, bytes], None],
        failed: Callable[[BaseException], None],
        priority: int = 0,
    ) -> None:
        self.controller = controller
        self.lateness = Lateness()
        self.missed = 0
        self.beat = monotonic_now()
        self.last: Cycle | None = None
        self.real_time = False
        self._period = period
        self._expiry = expiry
        self._sense = sense
        self._act = act
        self._report = report
        self._failed = failed
        self._priority = priority
        self._stopping = False
        self._calls: deque[tuple[Callable[[Instant], Any], Future[Any]]] = deque()
        self._thread = threading.Thread(target=self._run, name="control", daemon=True)

    def start(self) -> None:
        """Start the thread; while disarmed, it sends zero twists."""
        self.beat = monotonic_now()
        self._thread.start()

    def stop(self, timeout: float) -> bool:
        """Send zero twists and end; False when the thread does not end within ``timeout`` s.

        In that case it is stuck in other code, such as the strategy's, and the zero twists are sent
        from here.
        """
        self._stopping = True
        if self._thread.ident is None:
            return True
        self._thread.join(timeout)
        if self._thread.is_alive():
            self._halt()
            return False
        return True

    def call(self, work: Callable[[Instant], R]) -> Future[R]:
        """Run ``work`` on the loop's thread between two cycles, with the present instant."""
        future: Future[R] = Future()
        if len(self._calls) >= CALLS:
            future.set_exception(ValueError(f"{CALLS} requests are waiting already"))
        else:
            self._calls.append((work, future))
        return future

    def _run(self) -> None:
        try:
            if self.real_time:
                request_real_time(self._priority)
            schedule = Schedule(self._period, monotonic_now())
            while not self._stopping:
                remaining = seconds_between(monotonic_now(), schedule.deadline)
                if remaining > 0:
                    time.sleep(remaining)
                now = monotonic_now()
                lateness = schedule.begin(now)
                self.missed = schedule.missed
                self._cycle(now, lateness)
        except BaseException as error:  # noqa: BLE001 - thread boundary: the daemon must end loudly
            self._failed(error)
        finally:
            self._halt()

    def _cycle(self, now: Instant, lateness: float) -> None:
        inputs = self._sense(now)
        # Read the clock again, or an input captured since then would seem to be in the future.
        now = monotonic_now()
        cycle = self.controller.cycle(inputs, now, lateness)
        sent = self._act(cycle.decision.twist, cycle.decision.expiry, now)
        self.last = cycle
        self.beat = now
        self.lateness.add(lateness)
        self._report(cycle, sent)
        while self._calls:
            work, future = self._calls.popleft()
            try:
                future.set_result(work(monotonic_now()))
            except Exception as error:  # noqa: BLE001 - the caller gets it; the loop goes on
                future.set_exception(error)

    def _halt(self) -> None:
        for _ in range(LAST_ZEROS):
            with suppress(ArmError):  # the arm then stops by itself
                self._act(ZERO, self._expiry, monotonic_now())
