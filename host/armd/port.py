"""An arm on the bus: what the simulated arm and every robot have there, once."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any, Final

import msgspec
import zenoh

from tactile_core.bus.commanding import (
    LONGEST_EXPIRY,
    ClaimRequest,
    CommandArbiter,
    LimitsRequest,
    NotGrantedError,
    Signed,
    Signer,
    clock_domain,
    limits_fields,
    serve_claims,
)
from tactile_core.bus.markers import frame_transform
from tactile_core.bus.messages import MSG, codec, header
from tactile_core.bus.services import Service, ServiceError, declare_service
from tactile_core.bus.session import BusConfig, BusError, close_session, open_session
from tactile_core.bus.streams import BusSample, Publisher, Tap, declare_publisher
from tactile_core.bus.topics import ARM_STATE, COMMAND, TF, alive_key, service_key
from tactile_core.types import (
    ZERO,
    ArmLimits,
    ArmState,
    Echo,
    Instant,
    WallClock,
    after,
    monotonic_now,
    seconds_between,
)

log = logging.getLogger(__name__)

NAME_TIMEOUT: Final = 0.5
"""s to ask the bus whether an arm of this name is there; links take some of it to come about."""

NAME_RETRY: Final = 0.02
"""s between two such questions."""

FRAME: Final = "cupboard"
"""Frame of all that is said here."""

FINGER_FRAME: Final = "ee"
"""Frame of the finger, in which contacts are told."""

FRAME_PERIOD: Final = 1 / TF.rate

SEQUENCES: Final = 2**32
"""Sequence numbers of states begin again after so many."""


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


class ArmPort:
    """The arm called ``name`` on the bus. `open` it, `begin` when it may be seen.

    ``set_limits``: keeps limits and returns those in force; ``clear``: undoes a stop and returns
    the mode; ``status``: more of it for people. All may raise `ServiceError`, and run on zenoh's
    threads. ``heard``: called there, too, after a command has come. `publish` is for one thread.
    """

    def __init__(
        self,
        name: str,
        bus: BusConfig,
        *,
        set_limits: Callable[[ArmLimits], ArmLimits],
        clear: Callable[[], str],
        status: Callable[[], Mapping[str, object]],
        heard: Callable[[], None] | None = None,
    ) -> None:
        self.name = name
        self.arbiter = CommandArbiter()
        self.sent = 0
        self._bus = bus
        self._set_limits = set_limits
        self._clear = clear
        self._status = status
        self._heard = heard
        self._wall = WallClock.take()
        self._codec = codec()
        self._next_frame = Instant(0)
        self._session: zenoh.Session | None = None
        self._states: Publisher | None = None
        self._frames: Publisher | None = None
        self._commands: Tap | None = None
        self._services: list[Service] = []
        self._token: zenoh.LivelinessToken | None = None

    @property
    def session(self) -> zenoh.Session:
        """The session; RuntimeError unless it is open."""
        if self._session is None:
            raise RuntimeError("the arm is not open")
        return self._session

    @property
    def begun(self) -> bool:
        """Whether others can see the arm."""
        return self._token is not None

    @property
    def refused(self) -> dict[str, int]:
        """Commands not obeyed so far, by reason."""
        oversized = 0 if self._commands is None else self._commands.refused
        return {**self.arbiter.refused, "oversized": oversized}

    def open(self) -> None:
        """Join the bus; BusError when that cannot be, or an arm of this name is there."""
        session = self._session = open_session(self._bus)
        try:
            self._refuse_namesake(session)
        except BaseException:
            self.close()
            raise

    def begin(self) -> None:
        """Be there for others."""
        self._warm_up()
        session, name = self.session, self.name
        self._states = declare_publisher(session, ARM_STATE, name)
        self._frames = declare_publisher(session, TF, "tf")
        # Each is judged as it comes: the newest of all could be a stranger's.
        self._commands = Tap(session, COMMAND.key(name), self._hear)
        self._services = [
            declare_service(
                session, service_key(name, "limits", "arm"), self._limits, LimitsRequest
            ),
            declare_service(session, service_key(name, "clear", "arm"), self._cleared, Signed),
            declare_service(session, service_key(name, "status", "arm"), self._said, Nothing),
            *serve_claims(session, name, self.arbiter),
        ]
        self._token = session.liveliness().declare_token(alive_key(name, "arm"))

    def close(self) -> None:
        """Leave the bus."""
        session, self._session = self._session, None
        self._token = None
        if session is not None and not close_session(session):
            log.debug("the bus still waits for a stopped peer")

    def publish(self, state: ArmState) -> None:
        """Send ``state``, and now and then where the finger is."""
        if self._states is None or self._frames is None:
            raise RuntimeError("the arm has not begun")
        self.sent += 1
        wall_ns = self._wall.wall_ns(state.captured)
        message = state_message(state, self.sent % SEQUENCES, wall_ns, self.arbiter.commander)
        self._states.put(self._codec.encode(ARM_STATE, message), wall_ns)
        if state.captured >= self._next_frame:
            self._next_frame = after(state.captured, FRAME_PERIOD)
            pose = (state.x, state.y, 0.0, state.heading)
            frame = frame_transform(wall_ns, FRAME, FINGER_FRAME, pose)
            self._frames.put(self._codec.encode(TF, frame), wall_ns)

    def _warm_up(self) -> None:
        """Have the codec made that is made at first use: it would hold everything up for 70 ms,
        and a robot's watchdog does not wait."""
        pose = (0.0, 0.0, 0.0, 0.0)
        self._codec.encode(TF, frame_transform(0, FRAME, FINGER_FRAME, pose))
        none = ArmState(Instant(0), Instant(0), *pose[:3], ZERO, *pose[:3], "ready", *pose)
        self._codec.encode(ARM_STATE, state_message(none, 0, 0))
        owner = CommandArbiter()
        signer = Signer(owner.claim(ClaimRequest("warm", clock_domain()), Instant(0)))
        owner.receive(signer.command(ZERO, Instant(0), LONGEST_EXPIRY, 0), Instant(0))

    def _hear(self, sample: BusSample) -> None:
        self.arbiter.receive(sample.data, monotonic_now())
        if self._heard is not None:
            self._heard()

    def _refuse_namesake(self, session: zenoh.Session) -> None:
        key = alive_key(self.name, "arm")
        deadline = after(monotonic_now(), NAME_TIMEOUT)
        while (left := seconds_between(monotonic_now(), deadline)) > 0:
            if any(reply.ok is not None for reply in session.liveliness().get(key, timeout=left)):
                raise BusError(
                    f"an arm called {self.name!r} is on this bus: end it, or give --arm NAME"
                )
            time.sleep(NAME_RETRY)

    def _authorise(self, service: str, request: Signed, **fields: object) -> None:
        try:
            self.arbiter.authorise(service, request, monotonic_now(), **fields)
        except NotGrantedError as error:
            raise ServiceError(str(error)) from error

    def _limits(self, request: LimitsRequest) -> ArmLimits:
        self._authorise("limits", request, **limits_fields(request.limits))
        return self._set_limits(request.limits)

    def _cleared(self, request: Signed) -> dict[str, str]:
        self._authorise("clear", request)
        return {"mode": self._clear()}

    def _said(self, _: Nothing) -> dict[str, object]:
        return {
            "states": self.sent,
            "commander": self.arbiter.commander or None,
            **self._status(),
        }


class Job:
    """Something that one thread does for another: asked for once, waited for by whoever asks."""

    def __init__(self, work: Callable[[], None]) -> None:
        self._work = work
        self._done = threading.Event()
        self.error: Exception | None = None

    def run(self) -> None:
        """Do it; what it raises is kept for who asked."""
        try:
            self._work()
        except Exception as error:  # noqa: BLE001 - handed to the thread that asked
            self.error = error
        self._done.set()

    @property
    def finished(self) -> bool:
        """Whether it was done, or failed."""
        return self._done.is_set()

    def wait(self, seconds: float) -> bool:
        """Whether it ended within ``seconds``."""
        return self._done.wait(seconds)
