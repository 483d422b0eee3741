"""What an operator may ask for, from the command line or over the bus, in whole steps."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from concurrent.futures import TimeoutError as FutureTimeoutError
from typing import TypeVar

from reachd.arms.base import Arm, ArmError
from reachd.goals import make_goal
from reachd.loop import ControlLoop
from reachd.parameter_fields import Parameters
from reachd.publish import Reporter
from reachd.safety import CONFIRMED_WITHIN
from reachd.safety_settings import Check
from reachd.seam import Goal
from tactile_bus.arm_types import ArmLimits, ArmState
from tactile_bus.instant import Instant, monotonic_now

LOOP_TIMEOUT = 1.0
"""s the control loop may take to look at a request: it does so every 10 ms."""

CONFIRM_TIMEOUT = 0.5
"""s until the arm's state must show the limits that it confirmed."""

POLL = 0.005
"""s between looks at the arm's state meanwhile."""

R = TypeVar("R")


class RefusedError(Exception):
    """A request that is not granted; the message says why."""


class OperatorRequests:
    """Arm, reach, stop, reset and clear; from any thread but the control loop's.

    All raise `RefusedError`.
    """

    def __init__(
        self,
        loop: ControlLoop,
        arm: Arm,
        parameters: Parameters,
        reporter: Reporter,
        log_trouble: Callable[[], str | None] = lambda: None,
    ) -> None:
        """``log_trouble``: why the log that was asked for is not being written, None if it is."""
        self._loop = loop
        self._arm = arm
        self._parameters = parameters
        self._reporter = reporter
        self._log_trouble = log_trouble
        self._arming = threading.Lock()

    def arm(self, *, free_air: bool = True) -> None:
        """Set the arm's limits, have them confirmed, and let commands pass.

        ``free_air=False``: the finger touches something, so its force sensor cannot be judged.
        """
        with self._arming:
            since = monotonic_now()
            if Check.ARM_LIMITS not in self._parameters.safety.disabled:
                self._set_limits(self._parameters.safety.arm_limits)
            requested = monotonic_now()
            controller = self._loop.controller
            refusals = self._do(
                lambda now: controller.arm(requested, since, now, free_air=free_air)
            )
            if refusals:
                raise RefusedError("; ".join(refusals))
            self._reporter.event("operator", "arm", "armed")

    def reach(
        self, x: float, y: float, radius: float | None = None, time_limit: float | None = None
    ) -> Goal:
        """Begin a trial. `SettingError` for a goal that cannot be.

        Without the log that was asked for none begins; one that is under way when the log fails
        goes on.
        """
        trouble = self._log_trouble()
        if trouble is not None:
            raise RefusedError(trouble)
        goal = make_goal(x, y, self._parameters, radius=radius, time_limit=time_limit)
        text = f"{x:g}, {y:g} m, radius {goal.radius:g} m, {goal.time_limit:g} s"
        self._granted(lambda now: self._loop.controller.reach(goal, now))
        self._reporter.event("operator", "goal", text)
        return goal

    def stop(self, text: str = "stopped by the operator") -> None:
        """End whatever moves."""
        self._granted(lambda now: self._loop.controller.supervisor.request_stop(now, text))
        self._reporter.event("operator", "stop", text)

    def reset(self) -> None:
        """Go home after a reach."""
        self._granted(lambda now: self._loop.controller.supervisor.request_reset(now))
        self._reporter.event("operator", "reset", "")

    def clear(self) -> str:
        """Have the arm clear a fault or stop; it stays disarmed here. Returns the arm's mode."""
        try:
            mode = self._arm.request_clear()
        except ArmError as error:
            raise RefusedError(str(error)) from error
        self._reporter.event("operator", "clear", f"the arm is {mode!r}")
        return mode

    def _set_limits(self, limits: ArmLimits) -> None:
        if self._confirmed(limits):
            return
        try:
            said = self._arm.request_limits(limits)
        except ArmError as error:
            raise RefusedError(str(error)) from error
        self._reporter.event("operator", "limits", f"asked {limits}, confirmed {said}")
        deadline = time.monotonic() + CONFIRM_TIMEOUT
        while not self._confirmed(limits) and time.monotonic() < deadline:
            time.sleep(POLL)

    def _confirmed(self, limits: ArmLimits) -> bool:
        """Whether the gate has seen a state that confirms ``limits``."""
        last = self._loop.last
        state = None if last is None else last.inputs.arm
        return state is not None and same_limits(state, limits)

    def _granted(self, work: Callable[[Instant], str | None]) -> None:
        refusal = self._do(work)
        if refusal is not None:
            raise RefusedError(refusal)

    def _do(self, work: Callable[[Instant], R]) -> R:
        future: Future[R] = self._loop.call(work)
        try:
            return future.result(LOOP_TIMEOUT)
        except FutureTimeoutError:
            raise RefusedError("the control loop does not answer") from None


def same_limits(state: ArmState, limits: ArmLimits) -> bool:
    """Whether an arm's state confirms ``limits``, to within its rounding."""
    pairs = (
        (state.v_max, limits.v_max),
        (state.omega_max, limits.omega_max),
        (state.f_max, limits.f_max),
        (state.m_max, limits.m_max),
    )
    return all(abs(has - asked) <= CONFIRMED_WITHIN * asked for has, asked in pairs)
