"""Requests of an operator, from the command line or over the bus."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from concurrent.futures import TimeoutError as FutureTimeoutError
from typing import Any, TypeVar

import msgspec
import zenoh

from reachd.arms.base import Arm, ArmError
from reachd.control import ControlLoop
from reachd.gate.gate import CONFIRMED_WITHIN
from reachd.gate.settings import Check
from reachd.interfaces import Goal
from reachd.publish import Reporter
from reachd.strategies.parameter_fields import Parameters
from tactile_core.bus.services import Service, ServiceError, declare_service
from tactile_core.bus.topics import service_key
from tactile_core.config import ConfigError, printable
from tactile_core.types import ArmLimits, ArmState, Instant, monotonic_now

# Targets, checked before anything moves.


def parse_target(text: str) -> tuple[float, float]:
    """Parse ``X,Y``, m in ``cupboard``; ConfigError names the form."""
    parts = text.split(",")
    try:
        x, y = (float(part) for part in parts)
    except ValueError as error:
        raise ConfigError(
            f"target {text!r} is not X,Y in metres from the middle of the cupboard's front edge, "
            "such as 0.358,0.03 (x into the cupboard, y left)"
        ) from error
    return x, y


def make_goal(
    x: float,
    y: float,
    parameters: Parameters,
    *,
    radius: float | None = None,
    time_limit: float | None = None,
) -> Goal:
    """Make the goal of a reach: target, m in ``cupboard``; radius, m; time limit, s.

    Radius and time limit default to those of the set. ConfigError for a target outside the tip's
    region, or a radius or time that is not positive and finite.
    """
    goal = Goal(
        x,
        y,
        parameters.goal_radius if radius is None else radius,
        parameters.time_limit if time_limit is None else time_limit,
    )
    for name, value, unit in (("radius", goal.radius, "m"), ("time limit", goal.time_limit, "s")):
        if not (math.isfinite(value) and value > 0.0):
            raise ConfigError(f"{name} {value} {unit} is not a finite number above 0")
    if not (math.isfinite(x) and math.isfinite(y)):
        raise ConfigError(f"target {x}, {y} is not finite")
    region = parameters.safety.tip_region
    if region.depth(x, y) < 0.0:
        corners = ", ".join(f"({cx:g}, {cy:g})" for cx, cy in region.corners)
        raise ConfigError(
            f"target {x:g}, {y:g} m lies outside the region where the tip may go, with corners "
            f"{corners}; change the target or safety.tip_region"
        )
    return goal


LOOP_TIMEOUT = 3.0
"""s for the control loop to serve a request; it does so every 10 ms. A stuck loop ends the daemon
sooner."""

CONFIRM_TIMEOUT = 0.5
"""s until the arm's state must show the limits that it confirmed."""

POLL = 0.005
"""s between checks of the arm's state meanwhile."""

R = TypeVar("R")


class RefusedError(Exception):
    """A request was refused; the text says why."""


class OperatorRequests:
    """Arm, reach, stop, reset and clear; call from any thread but the control loop's.

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
        """``log_trouble``: returns why a requested log is not being written, or None."""
        self._loop = loop
        self._arm = arm
        self._parameters = parameters
        self._reporter = reporter
        self._log_trouble = log_trouble
        self._arming = threading.Lock()

    def arm(self, *, free_air: bool = True) -> None:
        """Set the arm's limits, wait for their confirmation, and arm the gate.

        ``free_air=False``: the finger touches something, so the force sensor cannot be checked.
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
        """Begin a trial towards (x, y), m in ``cupboard``; see `make_goal` for errors.

        Refused while a requested log is not being written. A trial under way when the log fails
        continues.
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
        """End any motion."""
        self._granted(lambda now: self._loop.controller.supervisor.request_stop(now, text))
        self._reporter.event("operator", "stop", text)

    def reset(self) -> None:
        """Go home after a reach."""
        self._granted(lambda now: self._loop.controller.supervisor.request_reset(now))
        self._reporter.event("operator", "reset", "")

    def clear(self) -> str:
        """Make the arm clear a fault or stop, and return its mode. The gate stays disarmed."""
        try:
            mode = self._arm.request_clear()
        except ArmError as error:
            raise RefusedError(str(error)) from error
        self._reporter.event("operator", "clear", f"the arm is {mode!r}")
        return mode

    def _set_limits(self, limits: ArmLimits) -> None:
        # Also where the arm shows them already: it may have been asked by an earlier commander, and
        # armd lets nobody move who has not asked for himself.
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
            busy = f"reachd is busy and did not answer within {LOOP_TIMEOUT:g} s"
            raise RefusedError(f"{busy}; it may still do it") from None


def same_limits(state: ArmState, limits: ArmLimits) -> bool:
    """Whether an arm's state confirms ``limits``, to within rounding."""
    pairs = (
        (state.v_max, limits.v_max),
        (state.omega_max, limits.omega_max),
        (state.f_max, limits.f_max),
        (state.m_max, limits.m_max),
    )
    return all(abs(has - asked) <= CONFIRMED_WITHIN * asked for has, asked in pairs)


# Services on the bus: goal, stop, reset, arm, clear, status. Errors are sent as replies.


MAX_REASON = 200
"""Most characters kept of a reason, which is shown and logged."""


class Nothing(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """A request without parameters."""


class GoalRequest(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """Target, m in ``cupboard``; radius, m, and time limit, s; None: the parameter set's."""

    x: float
    y: float
    radius: float | None = None
    time_limit: float | None = None


class ArmRequest(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """``free_air`` False: the finger touches something, so the force sensor cannot be checked."""

    free_air: bool = True


class StopRequest(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """``reason`` is logged."""

    reason: str = "stopped by the operator"


class ReachServices:
    """The services of the reach called ``name``."""

    def __init__(
        self,
        session: zenoh.Session,
        name: str,
        requests: OperatorRequests,
        status: Callable[[], dict[str, Any]],
    ) -> None:
        self._requests = requests
        self._status = status
        handlers: dict[str, tuple[Callable[[Any], object], type]] = {
            "goal": (self._goal, GoalRequest),
            "stop": (self._stop, StopRequest),
            "reset": (self._reset, Nothing),
            "arm": (self._arm, ArmRequest),
            "clear": (self._clear, Nothing),
            "status": (lambda _: status(), Nothing),
        }
        self._services: list[Service] = [
            declare_service(session, service_key(name, key, "reach"), handler, request)
            for key, (handler, request) in handlers.items()
        ]

    def close(self) -> None:
        """Undeclare the services."""
        for service in self._services:
            service.close()

    def _goal(self, request: GoalRequest) -> dict[str, Any]:
        goal = self._granted(
            lambda: self._requests.reach(
                request.x, request.y, radius=request.radius, time_limit=request.time_limit
            )
        )
        return {"x": goal.x, "y": goal.y, "radius": goal.radius, "time_limit": goal.time_limit}

    def _stop(self, request: StopRequest) -> dict[str, Any]:
        reason = printable(request.reason, MAX_REASON)
        self._granted(lambda: self._requests.stop(reason))
        return self._status()

    def _reset(self, _: Nothing) -> dict[str, Any]:
        self._granted(self._requests.reset)
        return self._status()

    def _arm(self, request: ArmRequest) -> dict[str, Any]:
        self._granted(lambda: self._requests.arm(free_air=request.free_air))
        return self._status()

    def _clear(self, _: Nothing) -> dict[str, Any]:
        return {"mode": self._granted(self._requests.clear)}

    def _granted(self, work: Callable[[], Any]) -> Any:
        try:
            return work()
        except (RefusedError, ConfigError) as error:
            raise ServiceError(str(error)) from error
