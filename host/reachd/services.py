"""What can be asked of reachd over the bus: goal, stop, reset, arm, clear, status.

Errors are replies.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import msgspec
import zenoh

from reachd.fields import SettingError
from reachd.operator_requests import OperatorRequests, RefusedError
from tactile_bus.services import Service, ServiceError, declare_service
from tactile_bus.toml_text import printable
from tactile_bus.topics import service_key

MAX_REASON = 200
"""Characters of a reason that are kept: it is shown to people and logged."""


class Nothing(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """A request without parameters."""


class GoalRequest(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """Target in m in ``cupboard``; radius in m and time limit in s, the parameter set's if None."""

    x: float
    y: float
    radius: float | None = None
    time_limit: float | None = None


class ArmRequest(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """``free_air`` false: the finger touches something, the force sensor cannot be checked."""

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
        """Take the services back."""
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
        except (RefusedError, SettingError) as error:
            raise ServiceError(str(error)) from error
