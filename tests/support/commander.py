"""A commander of an arm, as reachd is one: claims it, and sends a hundred commands a second."""

from __future__ import annotations

import math
import threading
import time
from typing import Any

import msgspec

from tactile_core.bus.commanding import ClaimRequest, Grant, Signer, clock_domain, limits_fields
from tactile_core.bus.messages import codec
from tactile_core.bus.services import ServiceError, call
from tactile_core.bus.session import BusConfig, close_session, open_session
from tactile_core.bus.streams import BusSample, Tap, declare_publisher
from tactile_core.bus.topics import ARM_STATE, COMMAND, service_key
from tactile_core.types import ArmLimits, Twist, WallClock, monotonic_now
from tests.support.waiting import PATIENCE_S, wait_until

SLOW = PATIENCE_S
LIMITS = ArmLimits(v_max=0.045, omega_max=0.1, f_max=10.0, m_max=4.5)

Row = tuple[float, float, float, float]
"""Robot's s, m, m and m/s."""


class Commander:
    """Commands the arm a hundred times a second, as reachd does."""

    def __init__(self, endpoint: str, name: str = "reach") -> None:
        self.session = open_session(BusConfig(connect=(endpoint,), listen=()))
        self.name = name
        self.state: Any = None
        self.heard = 0.0
        self.rows: list[Row] = []
        self.signer: Signer | None = None
        self.twist = Twist(0.0, 0.0, 0.0)
        self.silent = False
        self._wall = WallClock.take()
        self._codec = codec()
        self._publisher = declare_publisher(self.session, COMMAND, "arm")
        self._tap = Tap(self.session, ARM_STATE.key("arm"), self._hear)
        self._signing = threading.Lock()
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _hear(self, sample: BusSample) -> None:
        state = self._codec.decode(ARM_STATE, sample.data)
        self.state, self.heard = state, time.monotonic()
        linear = state.twist.linear
        speed = math.hypot(linear.x, linear.y) + 0.1 * abs(state.twist.angular.z)
        self.rows.append((state.captured_ns * 1e-9, state.x, state.y, speed))

    def _run(self) -> None:
        while not self._stopping.wait(0.01):
            with self._signing:
                signer = self.signer
                if signer is None or self.silent:
                    continue
                now = monotonic_now()
                wall_ns = self._wall.wall_ns(now)
                self._publisher.put(signer.command(self.twist, now, 0.06, wall_ns), wall_ns)

    def ask(self, service: str, **fields: object) -> Any:
        assert self.signer is not None
        with self._signing:
            request = self.signer.sign(service, **fields)
        return call(self.session, service_key("arm", service, "arm"), request, 2.0)

    def claim(self) -> None:
        request = ClaimRequest(self.name, clock_domain())
        reply = call(self.session, service_key("arm", "claim", "arm"), request, SLOW)
        self.signer = Signer(msgspec.convert(reply, Grant))

    def limit(self, limits: ArmLimits = LIMITS) -> ArmLimits:
        return msgspec.convert(self.ask("limits", **limits_fields(limits)), ArmLimits)

    def status(self) -> dict[str, Any]:
        found: dict[str, Any] = call(self.session, service_key("arm", "status", "arm"), None, SLOW)
        return found

    def clear(self) -> None:
        """As an operator does, again and again until the robot is ready."""

        def cleared() -> bool:
            try:
                return self.ask("clear")["mode"] in ("ready", "moving", "stopped")
            except ServiceError:
                return False

        wait_until(cleared, SLOW, lambda: "waited too long for clear")

    @property
    def mode(self) -> str:
        return "" if self.state is None else str(self.state.mode)

    def close(self) -> None:
        self._stopping.set()
        self._thread.join()
        close_session(self.session)
