"""Run the links and pipelines again over a log, without threads and without a clock.

Where the log has, from its start, the journal of what each port acted on besides its bytes
(`journal`), every message is reproduced bit for bit. Otherwise the boards are only listened to, as
in a replay: the samples are the same, but their capture times are estimated anew.
"""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, Literal, Protocol

import msgspec

from sensor_proto.can_transfers import BusState, CanEncoder, CanFrame
from sensor_proto.framing import encode_serial
from sensor_proto.packets import SetRate
from tactile_core.calibration import BoardCalibration
from tactile_core.can_bus import CanSpec
from tactile_core.types import Instant
from tactiled import journal as kinds
from tactiled.blocks import Chunk
from tactiled.board_session import BoardSession
from tactiled.boards.board import BoardLink
from tactiled.boards.events import Identity, Refusal
from tactiled.boards.line import bus_names, make_line
from tactiled.calibration_store import CalibrationStore
from tactiled.journal import RecordedState
from tactiled.port import Port, Trouble
from tactiled.publisher import RAW_PART, Sink
from tactiled.reader import Inbox, PortLost, PortOpened, Wake
from tactiled.sensing.settings import PipelineSettings
from tactiled.settings import Settings
from tactiled.transports.base import Medium

# How the boards of a log were read; a log holds it so that its bytes can be processed the same way.


PIPELINE = "pipeline"
"""Name of the metadata record with the fields of `PipelineSettings`, in JSON."""

PORT_PREFIX = "port:"
"""Prefix of the names of ports' metadata records; the name of the port's raw chunks follows."""


class RecordedError(ValueError):
    """The log states how it was made in terms unknown to this version; the text says which."""


@dataclass(frozen=True, slots=True)
class RecordedPort:
    """How one port was read. ``nodes``: names of boards on a CAN bus; ``rate``: rate set, Hz.

    ``strict``: boards without a calibration file of their own were refused.
    """

    name: str
    spec: str = ""
    medium: Literal["serial", "can"] = "serial"
    kind: str = "auto"
    baud: int = 115_200
    fd: bool = False
    rate: float | None = None
    strict: bool = False
    nodes: Mapping[int, str] | None = None
    arrays: tuple[int, ...] | None = None


def describe(settings: Settings) -> dict[str, dict[str, str]]:
    """Metadata records of a daemon's log, by name; none for a replay, whose log has them."""
    if settings.replay:
        return {}
    pipeline = {key: json.dumps(value) for key, value in asdict(settings.pipeline).items()}
    tables = {PIPELINE: pipeline}
    for port in settings.ports:
        fd = port.medium == "can" and CanSpec.parse(port.spec).fd
        tables[PORT_PREFIX + port.name] = {
            "spec": port.spec,
            "medium": port.medium,
            "kind": port.kind,
            "baud": str(port.baud),
            "fd": json.dumps(fd),
            "rate": json.dumps(settings.rate),
            "strict": json.dumps(len(settings.calibrations) >= len(settings.ports)),
            "arrays": json.dumps(port.arrays),
            "nodes": json.dumps({str(node): name for node, name in port.nodes.items()}),
        }
    return tables


def recorded_pipeline(values: Mapping[str, str]) -> PipelineSettings:
    """Settings that a log was made with; `RecordedError` for one unknown to this version."""
    known = {field.name for field in fields(PipelineSettings)}
    if strange := set(values) - known:
        raise RecordedError(
            f"the log was made with settings this version does not know ({', '.join(strange)}): "
            "update tactile-reach"
        )
    try:
        table = {key: json.loads(text) for key, text in values.items()}
        return msgspec.convert(table, PipelineSettings)
    except ValueError as error:
        raise RecordedError(f"the log's settings cannot be used: {error}") from error


def recorded_port(name: str, values: Mapping[str, str]) -> RecordedPort:
    """Port ``name`` (without the prefix) of a log; `RecordedError` when its record is damaged."""
    try:
        nodes = {int(node): text for node, text in json.loads(values["nodes"]).items()}
        arrays = json.loads(values.get("arrays", "null"))  # missing in older logs
        return RecordedPort(
            name=name,
            spec=values["spec"],
            medium="can" if values["medium"] == "can" else "serial",
            kind=values["kind"],
            baud=int(values["baud"]),
            fd=bool(json.loads(values["fd"])),
            rate=json.loads(values["rate"]),
            strict=bool(json.loads(values["strict"])),
            nodes=nodes,
            arrays=None if arrays is None else tuple(int(n) for n in arrays),
        )
    except (KeyError, ValueError, AttributeError, TypeError) as error:
        raise RecordedError(f"the log's record of port {name!r} is damaged: {error}") from error


HELD = 32_768
"""Most chunks held back until the journal has caught up with them: twice the recorder's queue, so
that only a damaged log reaches it."""

LOG = Path("the log")
"""Source of a calibration that was taken from the log."""


class RecordedSource:
    """Transport of a recorded port: discards writes and loses nothing."""

    def __init__(self, name: str, medium: Medium) -> None:
        self.name = name
        self.medium = medium
        self.state = BusState.ACTIVE
        self.losses: dict[str, int] = {}
        self.reopened = 0

    @property
    def transport(self) -> RecordedSource:
        """This object, which is its own transport."""
        return self

    def open(self) -> None:
        """Nothing to open."""

    def read(self, timeout: float) -> Chunk | None:
        """Always None: `Rerun` hands the chunks over."""
        del timeout
        return None

    def write(self, data: bytes | tuple[CanFrame, ...]) -> None:
        """Discard: there is no board."""

    def close(self) -> None:
        """Nothing to close."""


class Rerun:
    """Reprocesses one port of a log. ``journal``: whether the log has its events. ``versions``:
    calibrations by hash. ``states``: states of boards by name at the beginning of a log that begins
    in the middle of a run.

    Hand over chunks and events, each in the order of the log, then call `end`. ``chunks``: number
    of chunks processed.
    """

    def __init__(
        self,
        recorded: RecordedPort,
        store: CalibrationStore,
        settings: PipelineSettings,
        sink: ClockedSink,
        *,
        journal: bool,
        versions: Mapping[str, BoardCalibration],
        states: Mapping[str, RecordedState] | None = None,
    ) -> None:
        self.chunks = 0
        # Whether to follow the journal's instants; None: not known before its first event.
        self._follow: bool | None = None if journal else False
        self._spoilt = False
        self._recorded = recorded
        self._store = store
        self._settings = settings
        self._sink = sink
        self._versions = versions
        self._states = dict(states or {})
        self._port: Port | None = None
        self._held: deque[Chunk] = deque()
        self._events: deque[Any] = deque()
        self._newest = 0  # received_ns of the newest chunk seen
        self._part: Chunk | None = None
        self._over = False

    @property
    def exact(self) -> bool:
        """Whether every message so far is, with the same settings, the recorded one bit for bit."""
        return bool(self._follow) and not self._spoilt

    @property
    def boards(self) -> list[BoardSession]:
        """Boards found so far."""
        return [] if self._port is None else list(self._port.boards.values())

    def chunk(self, chunk: Chunk) -> None:
        """Take the next chunk; joins the parts of one that was too long for a message."""
        part, self._part = self._part, None
        if part is not None and isinstance(chunk.payload, bytes):
            if part.received == chunk.received and isinstance(part.payload, bytes):
                chunk = Chunk(chunk.received, part.payload + chunk.payload)
            else:
                self._take(part)
        if isinstance(chunk.payload, bytes) and chunk.payload and not len(chunk.payload) % RAW_PART:
            self._part = chunk
        else:
            self._take(chunk)

    def event(self, message: Any) -> None:
        """Take the next ``PortEvent``."""
        if self._follow is None:
            self._follow = message.kind == kinds.OPENED and not message.after_ns
        self._events.append(message)
        self._settle()

    def lost(self) -> None:
        """Note that chunks or events are missing here: the rest cannot be exact."""
        self._spoilt = True

    def end(self) -> None:
        """Process what is held back: the log has ended."""
        if self._part is not None:
            self._take(self._part)
            self._part = None
        self._settle()
        while self._events:
            event = self._events.popleft()
            if event.after_ns > self._newest:
                break  # the bytes before this event were cut off
            self._act(event)
        while self._held and not self._over:
            self._work(self._held.popleft())

    def _take(self, chunk: Chunk) -> None:
        self._held.append(chunk)
        self._newest = chunk.received
        if self._follow is False and not self._events:
            self._work(self._held.popleft())
        elif len(self._held) > HELD:
            self._spoilt = True
            self._work(self._held.popleft())
        self._settle()

    def _settle(self) -> None:
        """Act on every event whose place among the chunks is settled."""
        while self._events and _place(self._events[0]) <= self._newest:
            self._act(self._events.popleft())

    def _act(self, event: Any) -> None:
        while self._held and self._held[0].received <= event.after_ns:
            self._work(self._held.popleft())
        port, now = self._port, Instant(int(event.now_ns))
        self._sink.set(now)
        match event.kind:
            case kinds.OPENED:
                port = port or self._open()
                port.process(PortOpened(event.text, event.value), now)
            case kinds.SKIPPED:
                while self._held and self._held[0].received < event.until_ns:
                    self._held.popleft()
            case kinds.ENDED:
                self._held.clear()
                self._over = True
                if port is not None:
                    port.stop_streaming(now)
            case _ if port is not None:
                self._act_on_board(port, event, now)

    def _act_on_board(self, port: Port, event: Any, now: Instant) -> None:
        board = port.boards.get(event.node)
        match event.kind:
            case kinds.LOST:
                port.process(PortLost(event.text), now)
            case kinds.TICK if self._follow:
                port.tick(now)
            case kinds.TARE if board is not None:
                board.tare(bool(event.value))
            case kinds.SET_RATE:
                link = port.line.links.get(event.node)
                if isinstance(link, BoardLink) and self._follow:
                    mhz = round(event.value * 1000)
                    link.request(lambda number: SetRate(number, mhz), now)
            case kinds.RECALIBRATE if board is not None:
                calibration = self._versions.get(event.text)
                if calibration is not None:
                    self._store.add(LOG, calibration)
                port.retry(event.node, now)
                board.recalibrate()

    def _work(self, chunk: Chunk) -> None:
        self._sink.set(chunk.received)
        port = self._port
        if port is None:
            # The log does not say how the port was opened, only that bytes came.
            self._follow = False
            port = self._open(chunk)
            self._introduce(port, chunk)
        self.chunks += 1
        port.process(chunk, chunk.received)
        if not self._follow:
            port.tick(chunk.received)

    def _introduce(self, port: Port, first: Chunk) -> None:
        """Open the port with the boards' recorded descriptors: the boards do not repeat them."""
        floats = [s.serial_number for s in self._states.values() if s.descriptor is None]
        port.process(PortOpened(floats[0] if len(floats) == 1 else ""), first.received)
        for state in self._states.values():
            if state.descriptor is None:
                continue
            payload: bytes | tuple[CanFrame, ...]
            if isinstance(first.payload, bytes):
                payload = encode_serial(state.descriptor)
            else:
                payload = CanEncoder(state.node, self._recorded.fd).encode(state.descriptor)
            port.process(Chunk(first.received, payload), first.received)

    def _open(self, first: Chunk | None = None) -> Port:
        recorded, listen_only = self._recorded, not self._follow
        can = recorded.medium == "can"
        if first is not None:
            can = not isinstance(first.payload, bytes)
        medium = Medium.CAN if can else Medium.SERIAL
        source = RecordedSource(recorded.spec or recorded.name, medium)

        def admit(node: int, identity: Identity) -> Refusal | None:
            return port.admit(node, identity)

        def names(nodes: tuple[int, ...], late: bool) -> dict[int, str]:
            return bus_names(recorded.name, dict(recorded.nodes or {}), nodes, late)

        def open_board(_: Port, node: int, name: str) -> BoardSession | Trouble:
            del node
            board = BoardSession(name, self._sink, self._store, self._settings)
            if first is not None and name in self._states:
                board.rest_seed = self._states[name].rest
            return board

        line = make_line(
            source.name, admit, medium, kind=recorded.kind, rate=recorded.rate, baud=recorded.baud,
            fd=recorded.fd, nodes=frozenset(recorded.nodes or ()) or None, listen_only=listen_only,
            arrays=recorded.arrays,
        )  # fmt: skip
        port = self._port = Port(recorded.name, line, source, Inbox(Wake()), names, open_board)
        if medium is Medium.SERIAL:
            port.add_board(0, recorded.name)
        return port


def _place(event: Any) -> int:
    """Instant of the last chunk whose fate an event settles."""
    return max(int(event.after_ns), int(event.until_ns))


class ClockedSink(Sink, Protocol):
    """A `Sink` whose clock is set to the time of what is being processed."""

    def set(self, now: Instant) -> None:
        """Set the clock to ``now``."""
