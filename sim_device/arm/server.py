"""The simulated arm and its cupboard on the bus, as a real arm's driver would be there."""

from __future__ import annotations

import logging
import math
import re
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final

import msgspec
import zenoh

from sim_device.arm.arm import ArmFault, ArmSettings
from sim_device.arm.cupboard import Cupboard, NotNow, ScheduledFault
from sim_device.faults import Window
from sim_device.world.base import PHYSICS_STEP, World, WorldError
from sim_device.world.scene_markers import FRAME, scene_markers
from sim_device.world.scenes import Scene, SceneError
from tactile_core.bus.commanding import (
    CommandDesk,
    LimitsRequest,
    NotGrantedError,
    Signed,
    limits_fields,
    serve_desk,
)
from tactile_core.bus.markers import frame_transform
from tactile_core.bus.messages import MSG, codec, header
from tactile_core.bus.services import Service, ServiceError, declare_service
from tactile_core.bus.session import BusConfig, BusError, close_session, open_session
from tactile_core.bus.streams import BusSample, Publisher, Tap, declare_publisher
from tactile_core.bus.topics import ARM_STATE, COMMAND, TF, WORLD, alive_key, service_key
from tactile_core.types import (
    ArmLimits,
    ArmState,
    Echo,
    Instant,
    WallClock,
    after,
    monotonic_now,
    seconds_between,
)

# Faults, noise and latency of the simulated arm as a user writes them.


PRESS: Final = 0.2
"""s that a button is pressed, and drives report a fault, when no time is given."""

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
"""What may be noisy: field of `ArmSettings`, and unit."""

MAX_LATENCY: Final = 0.04
"""s each way; commands die 0.05 s after their receipt, so later ones would never take effect."""

_FAULT = re.compile(r"(?P<kind>[a-z_]+)(?:@(?P<at>\d+(?:\.\d*)?)s(?:\+(?P<for>\d+(?:\.\d*)?)s)?)?")


def parse_arm_faults(text: str) -> tuple[ScheduledFault, ...]:
    """Faults such as ``silent@5s+1s,estop@8s,biased``; ValueError says what is allowed."""
    return tuple(_fault(item) for item in text.split(",")) if text else ()


def _fault(text: str) -> ScheduledFault:
    match = _FAULT.fullmatch(text)
    kinds = ", ".join(ArmFault)
    allowed = f"allowed: KIND, KIND@Ts or KIND@Ts+Ds, parted by commas; KIND one of {kinds}"
    if match is None or match["kind"] not in tuple(ArmFault):
        raise ValueError(f"arm fault {text!r} is not understood; {allowed}")
    kind = ArmFault(match["kind"])
    lasting = PRESS if kind in MOMENTARY else math.inf
    duration = float(match["for"]) if match["for"] else lasting
    if duration == 0:
        raise ValueError(f"arm fault {text!r} lasts 0 s; {allowed}")
    return ScheduledFault(kind, Window(float(match["at"] or 0), duration))


def parse_noise(text: str) -> dict[str, Any]:
    """Fields of `ArmSettings` from such as ``force=0.1,position=1e-4``; ValueError."""
    fields: dict[str, Any] = {}
    units = ", ".join(f"{name} ({unit})" for name, (_, unit) in NOISES.items())
    allowed = f"allowed: NAME=STD, parted by commas; NAME one of {units}"
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
    """Arm with ``latency`` s each way and noise as `parse_noise` takes it; ValueError."""
    if not 0 <= latency <= MAX_LATENCY:
        raise ValueError(
            f"arm latency {latency:g} s given; allowed: 0 to {MAX_LATENCY:g} s, as commands die "
            "0.05 s after their receipt"
        )
    return ArmSettings(
        state_rate=rate, command_latency=latency, state_latency=latency, **parse_noise(noise)
    )


log = logging.getLogger(__name__)

NAME_TIMEOUT = 0.5
"""s to ask the bus whether an arm of this name is there; links take some of it to come about."""

NAME_RETRY = 0.02
"""s between two such questions."""

MARKER_PERIOD: Final = 1 / WORLD.rate
FRAME_PERIOD: Final = 1 / TF.rate

FINGER_FRAME: Final = "ee"
"""Frame of the finger, in which contacts are told."""

SEQUENCES = 2**32
"""Sequence numbers of states begin again after so many."""


class ResetRequest(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """``seed``: of the next scene, None for the same scene again."""

    seed: int | None = None


class Nothing(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A request that says nothing."""


def state_message(state: ArmState, sequence: int, wall_ns: int, commander: str = "") -> Any:
    """``ArmState.msg`` of a state captured at ``wall_ns``, while ``commander`` is obeyed."""
    twist, echo = state.twist, state.echo
    if echo is None or echo.commander != commander:
        echo = Echo(commander, 0, Instant(0))  # the command in force is an earlier commander's
    return MSG.ArmState(
        header=header(wall_ns, FRAME),
        captured_ns=state.captured,
        sequence=sequence,
        x=state.x,
        y=state.y,
        heading=state.heading,
        twist=MSG.Twist(MSG.Vector3(twist.vx, twist.vy, 0.0), MSG.Vector3(0.0, 0.0, twist.omega)),
        wrench=MSG.Wrench(MSG.Vector3(state.fx, state.fy, 0.0), MSG.Vector3(0.0, 0.0, state.mz)),
        mode=state.mode,
        v_max=state.v_max,
        omega_max=state.omega_max,
        f_max=state.f_max,
        m_max=state.m_max,
        commander=echo.commander,
        command_sequence=echo.sequence,
        command_ns=echo.decided,
    )


def describe_scene(scene: Scene) -> dict[str, object]:
    """What machines are told of a scene; m and rad in ``cupboard``."""
    return {
        "scene": scene.source,
        "parameters": scene.parameters,
        "seed": scene.seed,
        "objects": len(scene.objects),
        "start": [scene.start.x, scene.start.y, scene.start.heading],
        "goal": list(scene.goal),
    }


@dataclass(frozen=True, slots=True)
class _Ends:
    """What an arm has on the bus."""

    states: Publisher
    markers: Publisher
    frames: Publisher
    commands: Tap
    services: list[Service]
    token: zenoh.LivelinessToken


class ArmServer:
    """A `sim_device.runner.Station`: `service` it every millisecond. BusError from `open`.

    ``load``: scene for another seed, SceneError when there is none. ``make_world``: builds it.
    Services run on zenoh's threads and share the cupboard by a lock.
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
        self.sent = 0
        self.desk = CommandDesk()
        self._bus = bus
        self._load = load
        self._make_world = make_world
        self._wall = WallClock.take()
        self._codec = codec()
        self._lock = threading.Lock()
        self._session: zenoh.Session | None = None
        self._ends: _Ends | None = None
        self._next_markers = self._next_frame = Instant(0)
        self._polled = Instant(0)
        self._obeyed: Instant | None = None

    @property
    def finished(self) -> bool:
        """Never."""
        return False

    @property
    def losses(self) -> dict[str, int]:
        """Commands not obeyed, by reason, and what came late."""
        arm = self.cupboard.counters
        kept = {k: v for k, v in arm.items() if k not in ("accepted", "clamped", "expired")}
        return {**self.desk.refused, "oversized": self._oversized, **kept}

    def note(self) -> str:
        """How the arm is and how far from the goal, for a status line."""
        text = f"{self.cupboard.arm.mode}  {self.cupboard.distance * 100:.1f} cm to goal"
        refused = sum(self.desk.refused.values()) + self._oversized
        late = self.cupboard.counters["late_steps"] * round(PHYSICS_STEP * 1000)
        text += f"  refused {refused}" if refused else ""
        return text + (f"  late {late} ms" if late else "")

    @property
    def _oversized(self) -> int:
        return 0 if self._ends is None else self._ends.commands.refused

    def fileno(self) -> int:
        """There is nothing to wait on: commands are fetched every tick."""
        return -1

    def open(self) -> None:
        """Join the bus; the world begins with the first `service`."""
        session = self._session = open_session(self._bus)
        try:
            self._refuse_namesake(session)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Leave the bus; an arm that was moving has its power cut with the process."""
        session, self._session = self._session, None
        if session is not None and not close_session(session):
            log.debug("the bus still waits for a stopped peer")

    def service(self, now: Instant) -> None:
        """Move the world on, obey the newest command, publish what is due."""
        ends = self._ends
        if ends is None:
            if self._session is None:
                raise RuntimeError("the arm is not open")
            ends = self._ends = self._begin(self._session, now)
        with self._lock:
            states = self.cupboard.advance(now)
            order = self.desk.newest(now)
            if order is not None:
                # It came since the last look, nobody knows when: taken as having come right then.
                waited = seconds_between(self._polled, now)
                left = seconds_between(now, order.expires)
                echo = Echo(order.commander, order.sequence, order.decided)
                if self.cupboard.command(order.twist, now, waited, left, echo):
                    self._obeyed = self._polled
            self._polled = now
            commander = self.desk.commander
        for state in states:
            self.sent += 1
            wall_ns = self._wall.wall_ns(state.captured)
            message = state_message(state, self.sent % SEQUENCES, wall_ns, commander)
            ends.states.put(self._codec.encode(ARM_STATE, message), wall_ns)
            if state.captured >= self._next_frame:
                self._next_frame = after(state.captured, FRAME_PERIOD)
                pose = (state.x, state.y, 0.0, state.heading)
                frame = frame_transform(wall_ns, FRAME, FINGER_FRAME, pose)
                ends.frames.put(self._codec.encode(TF, frame), wall_ns)
        if now >= self._next_markers:
            self._next_markers = max(now, after(self._next_markers, MARKER_PERIOD))
            wall_ns = self._wall.wall_ns(now)
            markers = scene_markers(self.cupboard.world, wall_ns)
            ends.markers.put(self._codec.encode(WORLD, markers), wall_ns)

    def _begin(self, session: zenoh.Session, now: Instant) -> _Ends:
        """Let time run, and be there for others."""
        self._polled = self._next_markers = now
        self.cupboard.begin(now)
        command_key = COMMAND.key(self.name)
        return _Ends(
            states=declare_publisher(session, ARM_STATE, self.name),
            markers=declare_publisher(session, WORLD, self.world_name),
            frames=declare_publisher(session, TF, "tf"),
            # Each is judged as it comes: the newest of all could be a stranger's.
            commands=Tap(session, command_key, self._hear),
            services=[
                declare_service(session, key, handler, request)
                for key, handler, request in self._handlers()
            ]
            + serve_desk(session, self.name, self.desk),
            token=session.liveliness().declare_token(alive_key(self.name, "arm")),
        )

    def _hear(self, sample: BusSample) -> None:
        self.desk.hear(sample.data, monotonic_now())

    def _refuse_namesake(self, session: zenoh.Session) -> None:
        key = alive_key(self.name, "arm")
        deadline = after(monotonic_now(), NAME_TIMEOUT)
        while (left := seconds_between(monotonic_now(), deadline)) > 0:
            if any(reply.ok is not None for reply in session.liveliness().get(key, timeout=left)):
                raise BusError(
                    f"an arm called {self.name!r} is on this bus: end it, or give --arm NAME"
                )
            time.sleep(NAME_RETRY)

    def _handlers(self) -> Sequence[tuple[str, Callable[[Any], object], Any]]:
        arm, world = self.name, self.world_name
        return (
            (service_key(arm, "limits", "arm"), self._set_limits, LimitsRequest),
            (service_key(arm, "clear", "arm"), self._clear, Signed),
            (service_key(arm, "status", "arm"), self._arm_status, Nothing),
            (service_key(world, "reset", "world"), self._reset, ResetRequest),
            (service_key(world, "status", "world"), self._world_status, Nothing),
        )

    def _authorise(self, service: str, request: Signed, **fields: object) -> None:
        try:
            self.desk.authorise(service, request, monotonic_now(), **fields)
        except NotGrantedError as error:
            raise ServiceError(str(error)) from error

    def _set_limits(self, request: LimitsRequest) -> ArmLimits:
        self._authorise("limits", request, **limits_fields(request.limits))
        with self._lock:
            return self.cupboard.request_limits(request.limits)

    def _clear(self, request: Signed) -> dict[str, str]:
        self._authorise("clear", request)
        try:
            with self._lock:
                return {"mode": self.cupboard.clear()}
        except NotNow as error:
            raise ServiceError(str(error)) from error

    def _arm_status(self, _: Nothing) -> dict[str, object]:
        with self._lock:
            arm = self.cupboard.arm
            return {
                "mode": arm.mode,
                "limits": arm.limits,
                "states": self.sent,
                "commander": self.desk.commander or None,
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
