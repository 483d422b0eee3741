"""Connection of a program to running daemons: newest values, streams, services.

A client cannot slow a daemon: a stream holds a bounded number of messages, drops the oldest and
counts them. A `Bus` and everything made from it may be used from any thread; one stream belongs to
one thread at a time.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Generic, TypeVar

import zenoh

from tactile_core.bus.messages import MAX_PAYLOAD, DecodeError, codec
from tactile_core.bus.services import NoAnswerError, ServiceError
from tactile_core.bus.services import call as call_service
from tactile_core.bus.session import BusConfig, BusError, close_session, open_session
from tactile_core.bus.streams import ATTACHMENT, list_alive
from tactile_core.bus.topics import (
    AMBIENT,
    ARM_STATE,
    FEATURES,
    FIELD,
    FORCES,
    GEOMETRY,
    REACH_STATE,
    Topic,
    find_topic,
    service_key,
)
from tactile_reach import values
from tactile_reach.values import Ambient, Arm, Features, Field, Forces, Geometry, ReachState

T = TypeVar("T")

MAX_QUEUE = 100_000
"""Largest queue of a stream in messages: a quarter of an hour of one board at 100 Hz."""

FIND_S = 3.0
"""Time to find a daemon on the bus."""

GATHER_S = 0.2
"""Further time for other daemons, once one was found."""

STATUS_S = 10.0
"""Time for a daemon to answer simple requests, also on a busy machine."""

TARE_S = 120.0
"""Time for a tare: several times eight frames of a board at 0.5 Hz."""

RECORD_S = 30.0
"""Time to start a recording, or to finish it on the disk."""


class TactileError(Exception):
    """Request that cannot be fulfilled; the text is one sentence that names the remedy."""


class NotThereError(TactileError):
    """No daemon of that name, or none at all, was found on the bus."""


class RefusedError(TactileError):
    """The daemon refused the request or failed; the text is its reason."""


class SilentError(TactileError):
    """No message arrived in time."""


class Stream(Generic[T]):
    """Messages of one key, as an iterator that waits for the next; also a context manager.

    ``queue``: messages held for a reader slower than the sender. With 1, the default of every
    method that makes a stream, the reader always gets the newest. ``dropped`` counts messages not
    read in time, ``refused`` those that are undecodable or too large.
    """

    def __init__(
        self,
        session: zenoh.Session,
        key: str,
        read: Callable[[zenoh.Sample], T],
        *,
        queue: int = 1,
        timeout_s: float | None = None,
    ) -> None:
        """``timeout_s``: iteration raises `SilentError` after this time without a message."""
        if not 1 <= queue <= MAX_QUEUE:
            raise ValueError(f"queue is {queue}; allowed: 1 to {MAX_QUEUE}")
        self.key = key
        self.received = 0
        self.dropped = 0
        self.refused = 0
        self._read = read
        self._timeout_s = timeout_s
        self._closed = False
        self._last: T | None = None
        self._queue: deque[zenoh.Sample] = deque(maxlen=queue)
        self._arrived = threading.Condition()
        self._subscriber = session.declare_subscriber(key, self._on_sample)

    def __enter__(self) -> Stream[T]:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def __iter__(self) -> Stream[T]:
        return self

    def __next__(self) -> T:
        """Wait for the next message and return it."""
        message = self.get(self._timeout_s)
        if message is None:
            if self._closed:
                raise StopIteration
            raise SilentError(
                f"nothing came on {self.key} for {self._timeout_s:g} s: is its daemon running, "
                "and does `tactile status` show it streaming?"
            )
        return message

    def get(self, timeout_s: float | None = 0.0) -> T | None:
        """Return the next message; None if there is none within ``timeout_s`` (None: wait
        forever)."""
        deadline = None if timeout_s is None else time.monotonic() + timeout_s
        while True:
            with self._arrived:
                while not self._queue:
                    left = None if deadline is None else deadline - time.monotonic()
                    if self._closed or (left is not None and left <= 0):
                        return None
                    self._arrived.wait(left)
                sample = self._queue.popleft()
            try:
                self._last = self._read(sample)
            except DecodeError:
                self.refused += 1
            else:
                return self._last

    def newest(self) -> T | None:
        """The newest message, already read or not; None before the first."""
        while self.get(0.0) is not None:
            pass
        return self._last

    def close(self) -> None:
        """Close the stream; a reader waiting for the next message gets the end of the iteration."""
        with self._arrived:
            if self._closed:
                return
            self._closed = True
            self._arrived.notify_all()
        with contextlib.suppress(zenoh.ZError):  # the session is already closed
            self._subscriber.undeclare()

    def _on_sample(self, sample: zenoh.Sample) -> None:
        if len(sample.payload) > MAX_PAYLOAD:
            self.refused += 1
            return
        with self._arrived:
            self.received += 1
            self.dropped += len(self._queue) == self._queue.maxlen
            self._queue.append(sample)
            self._arrived.notify()


class Board:
    """A board of a running tactiled. Its streams are `Stream` objects."""

    def __init__(self, bus: Bus, name: str) -> None:
        self.name = name
        self._bus = bus

    def features(self, *, queue: int = 1, timeout_s: float | None = None) -> Stream[Features]:
        """Stream of contact features, one message per cycle of the board."""
        return self._bus.topic(FEATURES, self.name, values.features, queue, timeout_s)

    def forces(self, *, queue: int = 1, timeout_s: float | None = None) -> Stream[Forces]:
        """Stream of the forces on every taxel."""
        return self._bus.topic(FORCES, self.name, values.forces, queue, timeout_s)

    def field(self, *, queue: int = 1, timeout_s: float | None = None) -> Stream[Field]:
        """Stream of the field at every taxel, before the ambient field is removed."""
        return self._bus.topic(FIELD, self.name, values.field, queue, timeout_s)

    def ambient(self, *, queue: int = 1, timeout_s: float | None = None) -> Stream[Ambient]:
        """Stream of the ambient field that was removed."""
        return self._bus.topic(AMBIENT, self.name, values.ambient, queue, timeout_s)

    def newest(self, timeout_s: float = STATUS_S) -> Features:
        """Return the next contact features. Raises `SilentError` if none arrive in time."""
        with self.features(timeout_s=timeout_s) as stream:
            return next(stream)

    def geometry(self, timeout_s: float = STATUS_S) -> Geometry:
        """Return the places of the taxels, requested from tactiled."""
        with self._bus.topic(GEOMETRY, self.name, values.geometry, 1, timeout_s) as stream:
            self._ask("geometry", None, timeout_s)
            return next(stream)

    def status(self) -> dict[str, Any]:
        """Return tactiled's status of the board: state, rate, losses, clock, calibration, log."""
        return dict(self._ask("status", None, STATUS_S))

    def tare(self, *, force: bool = False) -> str:
        """Tare: take the current reading of the untouched skin as its rest field; returns
        tactiled's report.

        Raises `RefusedError` with the reason if the skin seems touched or unsteady, unless
        ``force``.
        """
        return str(self._ask("tare", {"force": force}, TARE_S)["message"])

    def set_rate(self, rate_hz: float) -> float:
        """Set the sample rate in Hz of a board that takes commands; returns the rate set."""
        return float(self._ask("set_rate", {"rate_hz": rate_hz}, STATUS_S + 2.0)["rate_hz"])

    def start_recording(self, name: str | None = None, *, limit_s: float = 3600.0) -> Path:
        """Start a log called ``name`` (default: dated) beside the daemon's own, and return its
        path.

        It holds all boards of this tactiled and ends by itself after ``limit_s``.
        """
        request = {"action": "start", "name": name, "limit_s": limit_s}
        return Path(self._ask("record", request, RECORD_S)["path"])

    def stop_recording(self) -> dict[str, Any]:
        """Stop recording; returns ``path``, ``messages``, ``bytes``, ``seconds`` and
        ``dropped``."""
        return dict(self._ask("record", {"action": "stop"}, RECORD_S))

    @contextlib.contextmanager
    def record(self, name: str | None = None, *, limit_s: float = 3600.0) -> Iterator[Path]:
        """Record while the block runs. The path is on tactiled's machine."""
        path = self.start_recording(name, limit_s=limit_s)
        try:
            yield path
        finally:
            self.stop_recording()

    def _ask(self, service: str, request: object, timeout_s: float) -> Any:
        return self._bus.call(service_key(self.name, service), request, timeout_s=timeout_s)


class Reach:
    """A running reachd: goals and its state."""

    def __init__(self, bus: Bus, name: str) -> None:
        self.name = name
        self._bus = bus

    def states(self, *, queue: int = 1, timeout_s: float | None = None) -> Stream[ReachState]:
        """Stream of its state, one message per control cycle."""
        return self._bus.topic(REACH_STATE, self.name, values.reach_state, queue, timeout_s)

    def arm(self, *, free_air: bool = True) -> None:
        """Let commands pass. ``free_air`` False: the finger already touches something."""
        self._ask("arm", {"free_air": free_air})

    def goal(
        self, x: float, y: float, *, radius: float | None = None, time_limit: float | None = None
    ) -> None:
        """Reach for a target in ``cupboard`` (m, s); radius and time limit default to its
        settings."""
        self._ask("goal", {"x": x, "y": y, "radius": radius, "time_limit": time_limit})

    def stop(self, reason: str = "stopped by a program") -> None:
        """Stop all motion."""
        self._ask("stop", {"reason": reason})

    def reset(self) -> None:
        """Go home after a reach."""
        self._ask("reset", None)

    def status(self) -> dict[str, Any]:
        """Return reachd's status."""
        return dict(self._ask("status", None))

    def _ask(self, service: str, request: object) -> Any:
        return self._bus.call(service_key(self.name, service, "reach"), request)


class Bus:
    """A session on the bus; made by `connect`, a context manager."""

    def __init__(self, config: BusConfig, find_s: float = FIND_S) -> None:
        try:
            self.session = open_session(config)
        except BusError as error:
            raise TactileError(str(error)) from error
        self._config = config
        self._find_s = find_s
        self._codec = codec()

    def __enter__(self) -> Bus:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Leave the bus."""
        close_session(self.session)

    def boards(self) -> list[str]:
        """Names of the boards of all running tactiled processes; empty if there are none."""
        names = set(list_alive(self.session, self._find_s))
        if names:
            time.sleep(GATHER_S)
            names |= set(list_alive(self.session, GATHER_S))
        return sorted(names)

    def board(self, name: str | None = None) -> Board:
        """Return the board called ``name``, or the only one if no name is given.

        Raises `NotThereError`, which lists the boards, if there is no such board or several.
        """
        there = self.boards()
        if not there:
            raise NotThereError(
                f"no tactiled answers{self._config.where()}: start it, or name its endpoint with "
                "connect(to=...)"
            )
        if name is None and len(there) == 1:
            return Board(self, there[0])
        if name is None:
            raise NotThereError(f"several boards are there, name one: {', '.join(there)}")
        if name not in there:
            raise NotThereError(f"no such board: {name!r} (available: {', '.join(there)})")
        return Board(self, name)

    def reach(self, name: str = "reach") -> Reach:
        """Return the reachd called ``name``. Raises `NotThereError` if it does not answer."""
        found = Reach(self, name)
        found.status()
        return found

    def arm_states(
        self, name: str = "arm", *, queue: int = 1, timeout_s: float | None = None
    ) -> Stream[Arm]:
        """Stream of an arm's state."""
        return self.topic(ARM_STATE, name, values.arm, queue, timeout_s)

    def stream(
        self,
        key: str,
        msgtype: str | None = None,
        *,
        queue: int = 1,
        timeout_s: float | None = None,
    ) -> Stream[Any]:
        """Stream of any key, as plain message classes.

        ``msgtype``: ``package/msg/Name``; by default the type given by the sender or the table of
        topics.
        """

        def read(sample: zenoh.Sample) -> Any:
            return self._codec.decode(msgtype or type_of(sample), sample.payload.to_bytes())

        return Stream(self.session, key, read, queue=queue, timeout_s=timeout_s)

    def call(self, key: str, request: object = None, *, timeout_s: float = STATUS_S) -> Any:
        """Call any service and return its reply."""
        try:
            return call_service(self.session, key, request, timeout=timeout_s)
        except NoAnswerError as error:
            raise NotThereError(str(error)) from error
        except ServiceError as error:
            raise RefusedError(str(error)) from error

    def topic(
        self,
        topic: Topic,
        name: str,
        make: Callable[[Any], T],
        queue: int,
        timeout_s: float | None,
    ) -> Stream[T]:
        """Stream of a topic, with messages converted by ``make``."""

        def read(sample: zenoh.Sample) -> T:
            return make(self._codec.decode(topic, sample.payload.to_bytes()))

        key = topic.key(name)
        return Stream(self.session, key, read, queue=queue, timeout_s=timeout_s)


def type_of(sample: zenoh.Sample) -> str:
    """Message type of a sample.

    Raises `DecodeError` if neither sender nor table of topics gives one.
    """
    _, _, schema = str(sample.encoding).partition(";")
    if schema:
        return schema
    found = find_topic(str(sample.key_expr))
    if found is None:
        raise DecodeError(f"{sample.key_expr} does not say which type of message it carries")
    return found[0].msgtype


def stamp_of(sample: zenoh.Sample) -> tuple[int, int] | None:
    """Sequence number and Unix time (ns) attached by the publisher; None without them."""
    attachment = sample.attachment
    if attachment is None or len(attachment) != ATTACHMENT.size:
        return None
    sequence, wall_ns, _, _ = ATTACHMENT.unpack(attachment.to_bytes())
    return sequence, wall_ns


def connect(
    to: str | Sequence[str] | None = None,
    *,
    keys: str | Path | None = None,
    insecure: bool = False,
    find_s: float = FIND_S,
) -> Bus:
    """Join the bus of this machine's daemons, or of those at ``to`` (zenoh endpoints).

    ``keys``: folder of keys for TLS. ``insecure``: as the daemons' ``--insecure``. Returns at once,
    whether or not a daemon is running. Raises `TactileError` if the bus cannot be joined.
    """
    endpoints = None if to is None else (to,) if isinstance(to, str) else tuple(to)
    config = BusConfig(
        connect=endpoints, keys=None if keys is None else str(keys), insecure=insecure
    )
    return Bus(config, find_s)
