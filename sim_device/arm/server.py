"""Simulated arm and cupboard on the bus, with the interface of a real arm's driver."""

from __future__ import annotations

import logging
import math
import re
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final

import msgspec

from armd.port import ArmPort, Nothing
from sim_device.arm.arm import ArmFault, ArmSettings
from sim_device.arm.cupboard import Cupboard, NotNow, ScheduledFault
from sim_device.faults import Window
from sim_device.world.base import PHYSICS_STEP, World, WorldError
from sim_device.world.scene_markers import scene_markers
from sim_device.world.scenes import Scene, SceneError
from tactile_core.bus.messages import codec
from tactile_core.bus.services import Service, ServiceError, declare_service
from tactile_core.bus.session import BusConfig
from tactile_core.bus.streams import Publisher, declare_publisher
from tactile_core.bus.topics import WORLD, service_key
from tactile_core.types import ArmLimits, Echo, Instant, WallClock, after, seconds_between

# Faults, noise and latency of the simulated arm as a user writes them.


PRESS_S: Final = 0.2
"""Seconds that the button is pressed, or the drives report a fault, when no time is given."""

MOMENTARY = (ArmFault.ESTOP, ArmFault.FAULT)
"""Faults that latch, so that a moment of them is enough."""

NOISES: Final = {
    "position": ("position_noise", "m"),
    "heading": ("heading_noise", "rad"),
    "speed": ("speed_noise", "m/s"),
    "turn": ("turn_noise", "rad/s"),
    "force": ("force_noise", "N"),
    "moment": ("moment_noise", "N·m"),
}
"""Noise by name: field of `ArmSettings`, and unit."""

MAX_LATENCY_S: Final = 0.04
"""Longest latency each way, s. Commands expire 0.05 s after their receipt, so a longer one would
leave them without effect."""

_FAULT = re.compile(r"(?P<kind>[a-z_]+)(?:@(?P<at>\d+(?:\.\d*)?)s(?:\+(?P<for>\d+(?:\.\d*)?)s)?)?")


def parse_arm_faults(text: str) -> tuple[ScheduledFault, ...]:
    """Faults such as ``silent@5s+1s,estop@8s,biased``; ValueError says what is allowed."""
    return tuple(_fault(item) for item in text.split(",")) if text else ()


def _fault(text: str) -> ScheduledFault:
    match = _FAULT.fullmatch(text)
    kinds = ", ".join(ArmFault)
    allowed = f"allowed: KIND, KIND@Ts or KIND@Ts+Ds, separated by commas; KIND one of {kinds}"
    if match is None or match["kind"] not in tuple(ArmFault):
        raise ValueError(f"arm fault {text!r} is not understood; {allowed}")
    kind = ArmFault(match["kind"])
    lasting = PRESS_S if kind in MOMENTARY else math.inf
    duration = float(match["for"]) if match["for"] else lasting
    if duration == 0:
        raise ValueError(f"arm fault {text!r} lasts 0 s; {allowed}")
    return ScheduledFault(kind, Window(float(match["at"] or 0), duration))


def parse_noise(text: str) -> dict[str, Any]:
    """Fields of `ArmSettings` from text such as ``force=0.1,position=1e-4``; ValueError."""
    fields: dict[str, Any] = {}
    units = ", ".join(f"{name} ({unit})" for name, (_, unit) in NOISES.items())
    allowed = f"allowed: NAME=STD, separated by commas; NAME one of {units}"
    for item in text.split(",") if text else ():
        name, _, figure = item.partition("=")
        try:
            value = float(figure)
        except ValueError:
            value = math.nan
        if name not in NOISES or not 0 <= value < math.inf:
            raise ValueError(f"arm noise {item!r} is not understood; {allowed}")
        fields[NOISES[name][0]] = value
    return fields


def arm_settings(rate: float, latency: float, noise: str) -> ArmSettings:
    """Settings for ``latency`` s each way and noise as `parse_noise` takes it; ValueError."""
    if not 0 <= latency <= MAX_LATENCY_S:
        raise ValueError(
            f"arm latency {latency:g} s given; allowed: 0 to {MAX_LATENCY_S:g} s, as commands die "
            "0.05 s after their receipt"
        )
    return ArmSettings(
        state_rate=rate, command_latency=latency, state_latency=latency, **parse_noise(noise)
    )


log = logging.getLogger(__name__)

MARKER_PERIOD_S: Final = 1 / WORLD.rate
"""Seconds between two messages of the world's markers."""


class ResetRequest(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """``seed``: seed of the next scene; None for the same scene again."""

    seed: int | None = None


def describe_scene(scene: Scene) -> dict[str, object]:
    """Scene as services report it; m and rad in the frame ``cupboard``."""
    return {
        "scene": scene.source,
        "parameters": scene.parameters,
        "seed": scene.seed,
        "objects": len(scene.objects),
        "start": [scene.start.x, scene.start.y, scene.start.heading],
        "goal": list(scene.goal),
    }


@dataclass(frozen=True, slots=True)
class _World:
    """What the cupboard itself publishes and serves on the bus."""

    markers: Publisher
    services: list[Service]


class ArmServer:
    """`sim_device.runner.PortServer`: call `service` every millisecond. BusError from `open`.

    ``load``: scene for another seed, SceneError if there is none. ``make_world``: builds its world.
    Services run on zenoh's threads; a lock guards the cupboard.
    """

    def __init__(
        self,
        cupboard: Cupboard,
        name: str,
        world_name: str,
        bus: BusConfig,
        load: Callable[[int], Scene],
        make_world: Callable[[Scene], World],
    ) -> None:
        self.cupboard = cupboard
        self.name = name
        self.world_name = world_name
        self.port = ArmPort(
            name,
            bus,
            set_limits=self._set_limits,
            clear=self._clear,
            status=self._arm_status,
        )
        self._load = load
        self._make_world = make_world
        self._wall = WallClock.take()
        self._codec = codec()
        self._lock = threading.Lock()
        self._on_bus: _World | None = None
        self._next_markers = Instant(0)
        self._polled = Instant(0)
        self._obeyed: Instant | None = None

    @property
    def sent(self) -> int:
        """States sent."""
        return self.port.sent

    @property
    def finished(self) -> bool:
        """False: the arm runs until it is stopped."""
        return False

    @property
    def losses(self) -> dict[str, int]:
        """Commands not obeyed, by reason, and late steps and commands."""
        arm = self.cupboard.counters
        kept = {k: v for k, v in arm.items() if k not in ("accepted", "clamped", "expired")}
        return {**self.port.refused, **kept}

    def note(self) -> str:
        """Mode and distance to the goal, for a status line."""
        text = f"{self.cupboard.arm.mode}  {self.cupboard.distance * 100:.1f} cm to goal"
        refused = sum(self.port.refused.values())
        late = self.cupboard.counters["late_steps"] * round(PHYSICS_STEP * 1000)
        text += f"  refused {refused}" if refused else ""
        return text + (f"  late {late} ms" if late else "")

    def fileno(self) -> int:
        """−1: there is nothing to wait on, commands are fetched every tick."""
        return -1

    def open(self) -> None:
        """Join the bus; the world begins with the first `service`."""
        self.port.open()

    def close(self) -> None:
        """Leave the bus. An arm that was moving loses power with the process."""
        self.port.close()

    def service(self, now: Instant) -> None:
        """Advance the world, obey the newest command, publish what is due."""
        world = self._on_bus
        if world is None:
            world = self._on_bus = self._begin(now)
        with self._lock:
            states = self.cupboard.advance(now)
            order = self.port.arbiter.newest(now)
            if order is not None:
                # It arrived at an unknown moment since the last poll: assume the earliest.
                waited = seconds_between(self._polled, now)
                left = seconds_between(now, order.expires)
                echo = Echo(order.commander, order.sequence, order.decided)
                if self.cupboard.command(order.twist, now, waited, left, echo):
                    self._obeyed = self._polled
            self._polled = now
        for state in states:
            self.port.publish(state)
        if now >= self._next_markers:
            self._next_markers = max(now, after(self._next_markers, MARKER_PERIOD_S))
            wall_ns = self._wall.wall_ns(now)
            markers = scene_markers(self.cupboard.world, wall_ns)
            world.markers.put(self._codec.encode(WORLD, markers), wall_ns)

    def _begin(self, now: Instant) -> _World:
        """Start the clock and declare the topics and services."""
        self._polled = self._next_markers = now
        self.cupboard.begin(now)
        self.port.begin()
        session = self.port.session
        return _World(
            markers=declare_publisher(session, WORLD, self.world_name),
            services=[
                declare_service(session, key, handler, request)
                for key, handler, request in self._handlers()
            ],
        )

    def _handlers(self) -> Sequence[tuple[str, Callable[[Any], object], Any]]:
        world = self.world_name
        return (
            (service_key(world, "reset", "world"), self._reset, ResetRequest),
            (service_key(world, "status", "world"), self._world_status, Nothing),
        )

    def _set_limits(self, limits: ArmLimits) -> ArmLimits:
        with self._lock:
            return self.cupboard.request_limits(limits)

    def _clear(self) -> str:
        try:
            with self._lock:
                return self.cupboard.clear()
        except NotNow as error:
            raise ServiceError(str(error)) from error

    def _arm_status(self) -> dict[str, object]:
        with self._lock:
            arm = self.cupboard.arm
            return {
                "mode": arm.mode,
                "limits": arm.limits,
                "last_command_ns": self._obeyed,
                "counters": self.cupboard.counters | self.losses,
            }

    def _world_status(self, _: Nothing) -> dict[str, object]:
        with self._lock:
            world, distance = self.cupboard.world, self.cupboard.distance
            resets = self.cupboard.resets
            return describe_scene(world.scene) | {
                "time": world.time,
                "ejected": world.ejected,
                "distance": distance if math.isfinite(distance) else None,
                "resets": resets,
            }

    def _reset(self, request: ResetRequest) -> dict[str, object]:
        scene = self.cupboard.world.scene
        try:
            scene = scene if request.seed is None else self._load(request.seed)
            world = self._make_world(scene)
        except (SceneError, WorldError, ValueError) as error:
            raise ServiceError(str(error)) from error
        try:
            with self._lock:
                self.cupboard.reset(world)
        except NotNow as error:
            raise ServiceError(str(error)) from error
        return describe_scene(scene)
