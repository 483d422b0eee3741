"""An arm that follows twists without inertia, on its own bus."""

from __future__ import annotations

import math
import threading
import time
from dataclasses import dataclass, replace
from typing import Any

import zenoh

from tactile_core.bus.commanding import (
    CommandArbiter,
    LimitsRequest,
    NotGrantedError,
    Order,
    limits_fields,
    serve_claims,
)
from tactile_core.bus.messages import MSG, codec, header
from tactile_core.bus.services import ServiceError, declare_service
from tactile_core.bus.session import BusConfig, close_session, open_session
from tactile_core.bus.streams import declare_publisher
from tactile_core.bus.topics import ARM_STATE, COMMAND, service_key
from tactile_core.types import NS_PER_S, ZERO, ArmLimits, Instant, WallClock, monotonic_now


@dataclass(frozen=True)
class Heard:
    """A command and when it arrived, in s of the monotonic clock."""

    at: float
    vx: float
    vy: float
    omega: float
    order: Order

    @property
    def still(self) -> bool:
        return self.vx == self.vy == self.omega == 0.0


class FakeArm:
    """Obeys twists without inertia, each until it expires; its tip starts at the shelf's edge.

    How far it goes depends on when commands come and expire alone, never on when its own threads
    get the processor.
    """

    def __init__(self, endpoint: str, name: str = "arm") -> None:
        self.name = name
        self.x, self.y, self.heading = -0.158, 0.0, 0.0
        self.force = (0.0, 0.0, 0.0)
        self.mode = "ready"
        self.paused = False
        self.does = lambda speed: speed  # how it changes the commanded speed
        self.frozen: Any = None  # a state repeated under fresh stamps
        self.deaf_to_limits = False
        self.limits = ArmLimits(0.5, 1.0, 100.0, 20.0)
        self.limited_for: str | None = None  # commander that asked; as armd, it obeys no other
        self.heard: list[Heard] = []
        self.travelled = 0.0
        self._moved_at = monotonic_now()
        self._moving = threading.Lock()
        self.session = open_session(BusConfig(listen=(endpoint,), connect=()))
        self._wall = WallClock.take()
        self._stopping = threading.Event()
        self._key = COMMAND.key(name)
        self.arbiter = CommandArbiter()
        self._subscriber = self.session.declare_subscriber(self._key, self._hear)
        key = service_key(name, "limits", "arm")
        self._services = serve_claims(self.session, name, self.arbiter)
        self._services.append(declare_service(self.session, key, self._limit, LimitsRequest))
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    @property
    def moving(self) -> bool:
        return self.speed != (0.0, 0.0, 0.0)

    @property
    def speed(self) -> tuple[float, float, float]:
        last = self.heard[-1] if self.heard else None
        if last is None or monotonic_now() >= last.order.expires:
            return (0.0, 0.0, 0.0)
        return self._obeyed(last)

    def _obeyed(self, command: Heard) -> tuple[float, float, float]:
        if self.mode in ("estop", "fault"):
            return (0.0, 0.0, 0.0)
        vx, vy, omega = self.does((command.vx, command.vy, command.omega))
        return (vx, vy, omega)

    def _move(self, now: Instant, then: Heard | None = None) -> None:
        """Go where the command in force leads until ``now``, from when on it is ``then``."""
        with self._moving:
            if self.heard:
                last = self.heard[-1]
                passed = max(0, min(now, last.order.expires) - self._moved_at) / NS_PER_S
                vx, vy, omega = self._obeyed(last)
                self.x += vx * passed
                self.y += vy * passed
                self.heading += omega * passed
                self.travelled += math.hypot(vx, vy) * passed
            self._moved_at = max(now, self._moved_at)
            if then is not None:
                self.heard.append(then)

    def close(self) -> None:
        self._stopping.set()
        self._thread.join()
        close_session(self.session)

    def _hear(self, sample: zenoh.Sample) -> None:
        now = monotonic_now()
        if self.arbiter.receive(sample.payload.to_bytes(), now) is not None:
            return
        order = self.arbiter.newest(now)
        if order is None:  # it expired while this thread was not scheduled
            return
        twist = order.twist if self.limited_for == order.commander else ZERO
        heard = Heard(time.monotonic(), twist.vx, twist.vy, twist.omega, order)
        assert all(math.isfinite(v) for v in (heard.vx, heard.vy, heard.omega))
        self._move(now, heard)

    def _limit(self, request: LimitsRequest) -> ArmLimits:
        try:
            self.arbiter.authorise(
                "limits", request, monotonic_now(), **limits_fields(request.limits)
            )
        except NotGrantedError as error:
            raise ServiceError(str(error)) from error
        self.limited_for = self.arbiter.commander
        if not self.deaf_to_limits:
            self.limits = request.limits
        return self.limits

    def _run(self) -> None:
        publisher = declare_publisher(self.session, ARM_STATE, self.name)
        sequence = 0
        while not self._stopping.wait(0.005):
            self._move(monotonic_now())
            if not self.paused:
                sequence += 1
                data = codec().encode(ARM_STATE, self._state(sequence))
                publisher.put(data, self._wall.wall_ns(monotonic_now()))

    def freeze(self) -> None:
        """Keep reporting the current state, whatever happens."""
        self.frozen = self._state(0)

    def _state(self, sequence: int) -> Any:
        now, limits = monotonic_now(), self.limits
        if self.frozen is not None:
            stamp = header(self._wall.wall_ns(now), "cupboard")
            return replace(
                self.frozen, header=stamp, captured_ns=now, sequence=sequence, **self._echo()
            )
        vx, vy, omega = self.speed
        fx, fy, mz = self.force
        return MSG.ArmState(
            header=header(self._wall.wall_ns(now), "cupboard"),
            captured_ns=now,
            sequence=sequence,
            x=self.x,
            y=self.y,
            heading=self.heading,
            twist=MSG.Twist(MSG.Vector3(vx, vy, 0.0), MSG.Vector3(0.0, 0.0, omega)),
            wrench=MSG.Wrench(MSG.Vector3(fx, fy, 0.0), MSG.Vector3(0.0, 0.0, mz)),
            mode=self.mode,
            v_max=limits.v_max,
            omega_max=limits.omega_max,
            f_max=limits.f_max,
            m_max=limits.m_max,
            **self._echo(),
        )

    def _echo(self) -> dict[str, Any]:
        last, commander = (self.heard[-1].order if self.heard else None), self.arbiter.commander
        mine = last is not None and last.commander == commander
        return {
            "commander": commander,
            "command_sequence": last.sequence if mine else 0,
            "command_ns": last.decided if mine else 0,
        }
