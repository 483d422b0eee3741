"""The daemon: threads and I/O around the pure core.

Threads: one reader per port (`reader`), the pipeline's (here), the log's writer (`recorder`),
zenoh's own for services, and the main thread, which watches. If one dies, the daemon ends with an
error.
"""

from __future__ import annotations

import logging
import platform
import sys
import threading
from collections import deque
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from dataclasses import replace
from pathlib import Path
from typing import Any

import zenoh

from tactile_core.bus.services import ServiceError
from tactile_core.bus.session import BusError, close_session, open_session
from tactile_core.bus.streams import declare_alive
from tactile_core.bus.topics import DIAGNOSTICS, alive_key
from tactile_core.calibration import CalibrationError
from tactile_core.daemon import Service, StartError
from tactile_core.log.recorder import Recorder, RecorderError
from tactile_core.types import Instant, WallClock, after, monotonic_now, seconds_between
from tactiled import diagnostics
from tactiled.board_session import BoardSession
from tactiled.boards.events import Identity, Refusal
from tactiled.boards.line import SerialLine, bus_names, make_line
from tactiled.calibration_store import CalibrationStore
from tactiled.diagnostics import Alarms
from tactiled.journal import Journal
from tactiled.memory import Collector, return_large_buffers
from tactiled.port import Port, Trouble
from tactiled.publisher import MessagePublisher
from tactiled.reader import MAX_AGE, Inbox, PortReader, Wake
from tactiled.recordings import Recordings
from tactiled.rerun import PORT_PREFIX, RecordedError, describe, recorded_port
from tactiled.services import BoardServices
from tactiled.settings import REPLAY_PREFIX, PortSettings, Settings
from tactiled.transports import Transport, TransportError
from tactiled.transports.can_bus import CanTransport
from tactiled.transports.recorded_log import McapTransport
from tactiled.transports.serial_port import SerialTransport

log = logging.getLogger(__name__)

TICK = 0.01
"""s between turns of the pipeline's thread when nothing arrives."""

SWITCH_INTERVAL = 0.0005
"""s after which Python switches threads: a reader must stamp its data soon after it came."""

READER_STUCK = 5.0
"""s after which a reader still inside its driver counts as stuck: one read takes a fraction of a
second. From then on the service manager's watchdog is no longer fed."""

CALLS = 64
"""Most requests that may wait for the pipeline's thread."""

NAME_TIMEOUT = 0.3
"""s to ask the bus whether a name is in use."""

JOIN_TIMEOUT = 1.0
"""s for the pipeline's thread to end before the log is closed."""

LEAVE_TIMEOUT = 5.0
"""Further s for it to end, for a very busy machine, before it is left behind."""

STOPPING = ServiceError("tactiled is stopping")
"""The answer to every request made while the daemon stops."""


class Daemon(Service):
    """tactiled between `start` and `stop`; used from the main thread."""

    prog = "tactiled"
    refusals = (BusError, RecorderError, TransportError, CalibrationError)

    def __init__(self, settings: Settings) -> None:
        super().__init__()
        self.settings = settings
        self.ports: list[Port] = []
        self._wall = WallClock.take()
        self._prefix = REPLAY_PREFIX if settings.replay else ""
        self._wake = Wake()
        self._calls: deque[tuple[Callable[[], Any], Future[Any]]] = deque()
        self._session: zenoh.Session | None = None
        self._publisher: MessagePublisher | None = None
        self._recordings: Recordings | None = None
        self._readers: list[PortReader] = []
        self._services: list[BoardServices] = []
        self._tokens: list[zenoh.LivelinessToken] = []
        self._stopping = threading.Event()
        self._collector = Collector()
        self._log_state = "recording"
        self._alarms = Alarms()
        self._thread = threading.Thread(target=self._run, name="pipeline", daemon=True)
        ports = len(settings.ports)
        self._store = CalibrationStore(
            settings.calibrations, strict=len(settings.calibrations) >= ports
        )

    @property
    def boards(self) -> list[BoardSession]:
        """Boards known so far, in the order of their ports."""
        return [board for port in self.ports for board in list(port.boards.values())]

    def _start(self) -> None:
        sys.setswitchinterval(SWITCH_INTERVAL)
        return_large_buffers()
        if self._wall.problem:
            log.warning("%s", self._wall.problem)
        try:
            self._open()
        except zenoh.ZError as error:
            raise BusError(f"the bus has closed by itself: {error}") from error

    def _open(self) -> None:
        settings = self.settings
        transports = [_make_transport(port, settings.speed) for port in settings.ports]
        self._session = session = open_session(settings.bus)
        self._publisher = publisher = MessagePublisher(session, None, self._wall, self._prefix)
        self._recordings = Recordings(
            publisher, settings.recorder, settings.log, self._call, lambda: self.boards
        )
        for wanted, transport in zip(settings.ports, transports, strict=True):
            self.ports.append(self._make_port(wanted, transport, publisher))
        if settings.log is not None:
            self.recorder = publisher.recorder = self._open_log(settings.log)
            self._alarms.watch(self.recorder)
        self._thread.start()
        for reader in self._readers:
            reader.start()

    def _make_port(
        self, wanted: PortSettings, transport: Transport, publisher: MessagePublisher
    ) -> Port:
        settings = self.settings
        replay = wanted.medium == "log"
        inbox = Inbox(self._wake, max_age=None if replay else MAX_AGE)
        reader = PortReader(transport, inbox, publisher, wanted.name, self.fail, paced=replay)
        self._readers.append(reader)
        reader.open(settings.wait and not replay)
        name = wanted.name
        if isinstance(transport, McapTransport):
            name = reader.name = transport.board or "board0"
            self._store.adopt_from_log(Path(wanted.spec), name)
            wanted = _as_recorded(wanted, name, transport.metadata)

        def admit(node: int, identity: Identity) -> Refusal | None:
            return port.admit(node, identity)

        line = make_line(
            transport.name,
            admit,
            transport.medium,
            kind=wanted.kind,
            rate=settings.rate,
            baud=wanted.baud,
            fd=isinstance(transport, CanTransport) and transport.spec.fd,
            nodes=frozenset(wanted.nodes) or None,
            listen_only=replay,
            arrays=wanted.arrays,
        )

        def names(nodes: tuple[int, ...], late: bool) -> dict[int, str]:
            return bus_names(name, wanted.nodes, nodes, late)

        journal = None if replay else Journal(publisher, name, transport.name)
        port = Port(name, line, reader, inbox, names, self._open_board, not replay, journal)
        reader.identified = lambda: port.identified
        if isinstance(line, SerialLine):
            port.add_board(0, name)
            if port.trouble is not None:
                raise StartError(str(port.trouble))
        return port

    def _open_board(self, port: Port, node: int, name: str) -> BoardSession | Trouble:
        """Take a name on the bus; called from the pipeline's thread for boards on a CAN bus."""
        session, publisher, recordings = self._session, self._publisher, self._recordings
        assert session is not None
        assert publisher is not None
        assert recordings is not None
        board = BoardSession(name, publisher, self._store, self.settings.pipeline)
        if self._prefix:
            # Replays offer no services.
            return board
        if _name_in_use(session, name):
            return Trouble(
                f"another tactiled publishes for the name {name!r} already",
                "stop that one, or give this board another --name",
            )
        self._tokens.append(declare_alive(session, name))
        self._services.append(
            BoardServices(session, self._call, self._store, port, node, board, recordings)
        )
        return board

    def _open_log(self, destination: Path) -> Recorder:
        settings = self.settings
        recorder = Recorder(
            destination, settings.recorder, prefix=self.ports[0].name, clock=self._wall
        )
        recorder.metadata(
            "tactiled",
            {
                "ports": ", ".join(port.spec for port in settings.ports),
                "python": platform.python_version(),
                "host": platform.platform(),
            },
        )
        for key, values in describe(settings).items():
            recorder.metadata(key, values)
        if settings.config_path is not None:
            text = settings.config_path.read_bytes()
            recorder.attach(settings.config_path.name, "application/toml", text)
        return recorder

    def stop(self) -> bool:
        """End in order: boards, pipeline, readers, services, log (at most 1 s), bus.

        Producers end before what they produce into, and the session last: after
        `MessagePublisher.end` nothing is published, so no thread uses a closed session. False when
        a thread is still inside a driver, the disk or zenoh: it must be left behind.
        """
        self._stopping.set()
        self._alarms.stop()
        self._wake.ring()
        if self._thread.is_alive():
            self._thread.join(JOIN_TIMEOUT)
        clean = True
        self._abandon_calls()
        for reader in self._readers:
            clean &= reader.stop()
        for service in self._services:
            service.close()
        self._services.clear()
        if self._publisher is not None:
            self._publisher.end()
        if self._recordings is not None and not self._recordings.close():
            log.error("the recording was not closed in time; see `tactile log recover`")
            clean = False
        if self.recorder is not None and not self.recorder.close():
            log.error("the log was not closed in time; see `tactile log recover`")
            clean = False
        if self._thread.is_alive():  # the log could not wait for it; nothing it says goes out now
            self._thread.join(LEAVE_TIMEOUT)
            clean &= not self._thread.is_alive()
        if self._publisher is not None:
            self._publisher.close()
        if self._session is not None:
            clean &= close_session(self._session)
            self._session = None
        return clean

    def trouble(self) -> str | None:
        """Why a port is not in service and will not be without help; None: no trouble so far."""
        for port in self.ports:
            if port.served:
                continue
            if port.trouble is not None:
                return str(port.trouble)
            refusals = [board.refusal for board in list(port.boards.values())]
            first = refusals[0] if refusals else None
            if first is not None and None not in refusals:
                return f"{first.problem}; {first.remedy}"
        return None

    # The pipeline's thread

    def _run(self) -> None:
        try:
            next_second = after(monotonic_now(), 1.0)
            while not self._stopping.is_set():
                if not any(port.behind for port in self.ports):
                    self._wake.wait(TICK)
                now = monotonic_now()
                for port in self.ports:
                    port.pump(now, self._stopping.is_set)
                self._serve_calls()
                if all(seconds_between(r.beat, now) < READER_STUCK for r in self._readers):
                    self.watchdog.beat(now)
                if now >= next_second:
                    next_second = after(now, 1.0)
                    self._each_second(now)
                if all(port.ended for port in self.ports):
                    self.done.set()
            for port in self.ports:
                self._stop_boards(port)
            self._abandon_requests()
        except BaseException as error:  # noqa: BLE001 - thread boundary: the daemon must end loudly
            self.fail(error)

    def _stop_boards(self, port: Port) -> None:
        """Stop a port's boards; an error at one port must not keep the others running."""
        try:
            port.stop_streaming(monotonic_now())
        except Exception as error:  # of any kind: the other ports must still be stopped
            log.error("%s: its boards could not be stopped", port.name, exc_info=error)

    def _call(self, work: Callable[[], Any]) -> Future[Any]:
        """Have the pipeline's thread run ``work``."""
        future: Future[Any] = Future()
        if self._stopping.is_set():
            future.set_exception(STOPPING)
        elif len(self._calls) >= CALLS:
            future.set_exception(ValueError(f"{CALLS} requests are waiting already"))
        else:
            self._calls.append((work, future))
            self._wake.ring()
        return future

    def _serve_calls(self) -> None:
        while (call := self._next_call()) is not None:
            work, future = call
            try:
                future.set_result(work())
            except (ValueError, ServiceError, CalibrationError) as error:
                future.set_exception(error)
            except Exception as error:  # of any kind: the pipeline must go on
                log.error("a request failed", exc_info=error)
                future.set_exception(ServiceError(f"{type(error).__name__}: {error}"))

    def _abandon_requests(self) -> None:
        """Answer every request under way, so that zenoh can close at once."""
        self._abandon_calls()
        for board in self.boards:
            board.abandon_requests(STOPPING)

    def _abandon_calls(self) -> None:
        """Answer the requests that the pipeline's thread has not taken yet; from any thread."""
        while (call := self._next_call()) is not None:
            call[1].set_exception(STOPPING)

    def _next_call(self) -> tuple[Callable[[], Any], Future[Any]] | None:
        try:
            return self._calls.popleft()
        except IndexError:
            return None

    def _each_second(self, now: Instant) -> None:
        publisher = self._publisher
        if publisher is None:
            return
        if self._recordings is not None:
            self._recordings.each_second(now)
        for port in self.ports:
            for node, board in port.boards.items():
                try:
                    self._publish_diagnostics(publisher, port, node, board, now)
                except Exception as error:  # noqa: BLE001 - an account of the data, not the data
                    board.event_failed(error)
        self._watch_log()
        self._collector.each_second()

    def _publish_diagnostics(
        self, publisher: MessagePublisher, port: Port, node: int, board: BoardSession, now: Instant
    ) -> None:
        board.each_second(now)
        wall_ns = self._wall.wall_ns(now)
        values = diagnostics.summary(port, node, board, now)
        values["alarms"] = self._alarms.each_second(board, now)
        if self._recordings is not None:
            values["recording"] = self._recordings.summary()
        board.summary = values
        message = diagnostics.message(board.name, values, self.recorder, wall_ns)
        publisher.send(DIAGNOSTICS, board.name, message, wall_ns)

    def _watch_log(self) -> None:
        if self.recorder is None:
            return
        stats = self.recorder.stats
        if stats.state == self._log_state or self._stopping.is_set():
            return
        self._log_state = stats.state
        good = stats.state == "recording"
        text = f"log {stats.path}: {stats.state}" + (f" ({stats.last_error})" if not good else "")
        for board in self.boards:
            board.announce_log_state(logging.INFO if good else logging.ERROR, text)


def _as_recorded(
    wanted: PortSettings, name: str, metadata: Mapping[str, Mapping[str, str]]
) -> PortSettings:
    """Settings of a replay, with kind and arrays of the board as its log states them."""
    table = metadata.get(PORT_PREFIX + name)
    if table is None:
        return wanted
    try:
        then = recorded_port(name, table)
    except RecordedError as error:
        log.warning("%s: %s", wanted.spec, error)
        return wanted
    return replace(wanted, kind=then.kind, arrays=then.arrays)


def _make_transport(port: PortSettings, speed: float) -> Transport:
    if port.medium == "log":
        return McapTransport(port.spec, board=port.name or None, speed=speed)
    if port.medium == "can":
        return CanTransport(port.spec)
    return SerialTransport(port.spec, port.baud)


def _name_in_use(session: zenoh.Session, name: str) -> bool:
    replies = session.liveliness().get(alive_key(name), timeout=NAME_TIMEOUT)
    return any(reply.ok is not None for reply in replies)
