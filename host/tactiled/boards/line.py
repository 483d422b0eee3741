"""Lines: connect the bytes or CAN frames of one port to the links of the boards behind it.

Pure: chunks and instants in; events, and payloads to write, out.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

from sensor_proto.anyskin import AnySkinDecoder
from sensor_proto.can_transfers import BROADCAST, CanDecoder, CanEncoder, CanFrame
from sensor_proto.framing import SerialDecoder, encode_serial
from sensor_proto.layouts import FORM, Framing, Kind, Layout, LayoutDecoder, TextDecoder
from sensor_proto.packets import FloatSamples, HostMessage, Identify, Message, Received, Reject
from sensor_proto.survey import Finding, Survey
from tactile_core.cli import KINDS
from tactile_core.types import NS_PER_S, Instant, after
from tactiled.blocks import Chunk
from tactiled.boards.board import BoardLink, State
from tactiled.boards.diagnosis import NOTHING_AFTER, Diagnosis
from tactiled.boards.events import Diagnosed, Event, Found, Identity, Refusal
from tactiled.boards.float_board import FloatLink
from tactiled.transports.base import Medium

FLOAT_MODEL = "anyskin"
"""Model name, in calibrations, of boards that send floats."""

JUDGE_FIRST, JUDGE_SLOWEST = 0.25, 2.0
"""s between surveys of bytes that no decoder understands; the time doubles while nothing is found,
because a survey takes some milliseconds."""

PATIENCE = 30.0
"""s to wait for frames of a layout that was found; the slowest board sends ten."""

REPEAT_DIAGNOSIS = 30.0
"""s between repetitions of a diagnosis that still holds."""

Admit = Callable[[int, Identity], Refusal | None]
"""Judges the board with a node number (0 on a serial line)."""

Link = BoardLink | FloatLink
Unframed = AnySkinDecoder | LayoutDecoder | TextDecoder
Payload = bytes | tuple[CanFrame, ...]


@dataclass(frozen=True, slots=True)
class LineEvent:
    """An event of the board ``node``, or, if None, of the whole port."""

    node: int | None
    event: Event


class Line(Protocol):
    """The interface of a port for the daemon, whatever the medium."""

    @property
    def links(self) -> dict[int, Link]:
        """Boards found so far, by node."""

    @property
    def rejects(self) -> dict[str, int]:
        """Counts of what the decoders refused, by reason."""

    def connect(self, now: Instant, usb_serial: str = "", byte_time: float = 0.0) -> None:
        """Start: the port is open. ``byte_time``: s per byte on the wire, 0 over USB."""

    def disconnect(self) -> list[LineEvent]:
        """Stop: the port is closed or gone. Gives up waiting commands."""

    def receive(self, chunk: Chunk) -> list[LineEvent]:
        """Process a chunk."""

    def tick(self, now: Instant) -> list[LineEvent]:
        """Do what is due."""

    def outgoing(self) -> list[Payload]:
        """Remove and return the payloads to write."""


class SerialLine:
    """A serial line with one board, whose kind is detected unless ``kind`` gives it.

    ``kind``: one of `KINDS`, or a layout. ``arrays``: magnetometers of each array of a controller
    that does not report it.
    """

    def __init__(
        self,
        port: str,
        admit: Admit,
        kind: str = "auto",
        rate: float | None = None,
        baud: int = 115_200,
        listen_only: bool = False,
        arrays: tuple[int, ...] | None = None,
    ) -> None:
        self._declared = board_kind(kind)
        self._kind = kind if self._declared is None else "declared"
        self._own = SerialDecoder()
        self._floats: Unframed | None = AnySkinDecoder()
        self._survey = Survey(self._declared)
        self._settled = False  # whether the unframed decoder has found a frame since the opening
        self._former: Counter[str] = Counter()  # counts of unframed decoders that were replaced
        self._layout: Layout | None = None  # read by the unframed decoder; None: the usual floats
        self._finding: Finding | None = None
        self._judge_due, self._judge_wait = Instant(0), JUDGE_FIRST
        self._patient_until = Instant(0)
        self._board = BoardLink(lambda identity: admit(0, identity), rate, listen_only)
        self._float = FloatLink(lambda identity: admit(0, identity), FLOAT_MODEL, "", arrays)
        self._link: Link | None = None
        self._diagnosis = Diagnosis(port, baud, kind)
        if self._declared is not None:
            self._use_layout(self._declared)
        self._diagnose_from = Instant(0)
        self._byte_ns = 0.0
        self._up = False

    @property
    def links(self) -> dict[int, Link]:
        """The board, once its kind is known."""
        return {} if self._link is None else {0: self._link}

    @property
    def rejects(self) -> dict[str, int]:
        """Refusals of the decoder in use; of our protocol's while the kind is unknown."""
        counts = Counter(self._own.counters)
        if isinstance(self._link, FloatLink):
            counts = self._former + Counter({} if self._floats is None else self._floats.counters)
        return {reason: n for reason, n in counts.items() if reason != "accepted"}

    def connect(self, now: Instant, usb_serial: str = "", byte_time: float = 0.0) -> None:
        """Start; see `Line.connect`."""
        self._up = True
        self._byte_ns = byte_time * NS_PER_S
        self._float.serial_number = usb_serial
        self._own.reset()
        if self._floats is not None:
            self._floats.reset()
        self._survey.reset()
        self._settled, self._finding = False, None
        self._patient_until = after(now, PATIENCE)
        self._judge_due, self._judge_wait = after(now, JUDGE_FIRST), JUDGE_FIRST
        self._diagnosis.begin(now, uart=byte_time > 0)
        self._diagnose_from = now
        if self._kind in ("auto", "tactile") and not isinstance(self._link, FloatLink):
            self._board.connect(now)
        self._float.connect()

    def disconnect(self) -> list[LineEvent]:
        """Stop; see `Line.disconnect`."""
        self._up = False
        self._float.disconnect()
        return [LineEvent(0, event) for event in self._board.disconnect()]

    def receive(self, chunk: Chunk) -> list[LineEvent]:
        """Process bytes; TypeError for CAN frames."""
        data = chunk.payload
        if not isinstance(data, bytes):
            raise TypeError("a serial line takes bytes")
        if not self._served:
            self._diagnosis.feed(data, chunk.received)
        events: list[Event] = []
        found = list(self._decode(data, chunk.received))
        arrivals = [
            Instant(chunk.received - round(each.trailing * self._byte_ns)) for each in found
        ]
        for place, (received, arrival) in enumerate(zip(found, arrivals, strict=True), start=1):
            message = received.message
            if isinstance(message, FloatSamples):
                behind = len(found) - place
                events += self._float.receive(message, arrival, behind, arrivals[-1])
            else:
                events += self._board.receive(message, arrival)
        return [LineEvent(0, event) for event in events]

    def tick(self, now: Instant) -> list[LineEvent]:
        """Drive the link; while no board is found, diagnose why."""
        if not self._up:
            return []
        link = self._link or self._board
        was_served = self._served
        out = [LineEvent(0, event) for event in link.tick(now)]
        if was_served:
            # If the board goes out of service, the diagnosis uses only bytes from now on.
            self._diagnosis.begin(now)
        elif self._about_to_read and now < self._patient_until:
            pass
        elif link.state is not State.REFUSED and now >= self._diagnose_from:
            waiting = self._diagnosis.waiting(now)
            if waiting is not None:
                out.append(LineEvent(None, waiting))
            answered = isinstance(self._link, BoardLink)
            diagnosed = self._diagnosis.judge(now, answered, self._finding)
            if diagnosed is not None:
                self._diagnose_from = after(now, REPEAT_DIAGNOSIS)
                out.append(LineEvent(None, diagnosed))
        return out

    def outgoing(self) -> list[Payload]:
        """Remove and return the frames to write."""
        return [encode_serial(message) for message in self._board.outgoing()]

    @property
    def _served(self) -> bool:
        """Whether a board has been found and is in service."""
        return self._link is not None and self._link.state in (State.CONFIGURING, State.STREAMING)

    @property
    def _about_to_read(self) -> bool:
        """Whether a layout has been found whose frames are awaited."""
        return self._finding is not None and self._finding.layout is not None

    def _decode(self, data: bytes, now: Instant) -> list[Received]:
        """Decode with every decoder that may fit; the first to find a message is kept."""
        if isinstance(self._link, BoardLink):
            return self._own.feed(data)
        if self._link is None and self._kind in ("auto", "tactile"):
            found = self._own.feed(data)
            if found:
                self._link = self._board
                return found
        if self._kind == "tactile":
            return []
        if self._floats is None:
            self._former[Reject.DISCARDED_BYTES] += len(data)
            found = []
        else:
            found = self._floats.feed(data)
        if found:
            self._settled = True
            if self._link is None:
                self._link = self._float
                self._board.disconnect()
        elif not self._settled:
            self._survey_bytes(data, now)
        return found

    def _survey_bytes(self, data: bytes, now: Instant) -> None:
        """Survey the bytes for a layout; it is adopted when two surveys agree."""
        self._survey.feed(data)
        if now < self._judge_due:
            return
        before, self._finding = self._finding, self._survey.judge()
        layout = None if self._finding is None else self._finding.layout
        if layout is not None:
            self._judge_wait = JUDGE_FIRST
            if before is not None and before.layout == layout:
                self._use_layout(layout)
        elif self._survey.full:
            self._judge_wait = min(2 * self._judge_wait, JUDGE_SLOWEST)
        self._judge_due = after(now, self._judge_wait)

    def _use_layout(self, layout: Layout) -> None:
        """Read frames of ``layout`` from now on, if its framing is known."""
        if layout == self._layout:
            return  # in use already; its frames will come
        self._layout = layout
        usual = layout == replace(USUAL, chips=layout.chips, framing=layout.framing)
        usual &= layout.framing in (None, USUAL.framing)
        if usual and self._declared is None and isinstance(self._floats, AnySkinDecoder):
            return  # the present decoder reads this layout
        if self._floats is not None:
            self._former.update(self._floats.counters)
        if layout.kind is Kind.TEXT:
            self._floats = TextDecoder(layout)
        elif usual:
            chips = None if self._declared is None else layout.chips
            self._floats = AnySkinDecoder(chips)
        else:
            self._floats = None if layout.framing is None else LayoutDecoder(layout)
        self._float.thermometer = "t" in layout.fields
        self._float.layout = "" if isinstance(self._floats, AnySkinDecoder) else str(layout)


USUAL = Layout(Kind.FLOATS, 1, "txyz", framing=Framing(end=b"\r\n"))
"""The layout that `AnySkinDecoder` reads, better than the general decoder."""


def board_kind(text: str) -> Layout | None:
    """Layout that ``--kind`` declares, None for one of `KINDS`; ValueError for anything else."""
    if text in KINDS:
        return None
    if ":" not in text:
        raise ValueError(f"board kind {text!r}; allowed: {', '.join(KINDS)}, or a layout: {FORM}")
    return Layout.parse(text)


def kind_text(text: str) -> str:
    """Return ``text`` if it is a valid kind of board, see `board_kind`; else ValueError."""
    board_kind(text)
    return text


# A CAN bus as a line: boards are found by a broadcast Identify, and have one link each. Pure.


DISCOVER_EVERY = 0.2
"""s between broadcast questions until the boards are known. Boards plugged in later are noticed by
their status message, once a second."""

GATHER = 0.5
"""s from the first board's message until the boards of a bus count as known: two more questions, in
case an answer was lost. Their names depend on their number."""

EARLY = 4096
"""Most messages kept while boards are gathered: sixteen boards at 493 Hz for half a second."""

MAX_NODES = 16
"""Most boards used on one bus; with more, CAN 2.0B has no room for 25 Hz of samples each."""


class CanLine:
    """A CAN bus with up to `MAX_NODES` boards, each found by its answer to a broadcast question."""

    def __init__(
        self,
        port: str,
        admit: Admit,
        fd: bool = False,
        rate: float | None = None,
        nodes: frozenset[int] | None = None,
        listen_only: bool = False,
    ) -> None:
        self._port = port
        self._admit = admit
        self._fd = fd
        self._rate = rate
        self._nodes = nodes
        self._listen_only = listen_only
        self._decoder = CanDecoder()
        self._everyone = CanEncoder(BROADCAST, fd)
        self._encoders: dict[int, CanEncoder] = {}
        self._links: dict[int, BoardLink] = {}
        self._up = False
        self._frames = self._errors = 0
        self._since = self._discover_due = self._diagnose_from = Instant(0)
        self._known_at: Instant | None = None  # when gathering boards ends
        self._known = False
        self._early: deque[tuple[int, Message, Instant]] = deque(maxlen=EARLY)
        self._questions: list[Payload] = []
        self.strangers = 0
        """Messages of boards beyond `MAX_NODES` or not wanted."""

    @property
    def links(self) -> dict[int, Link]:
        """Boards found so far, by node."""
        return dict(self._links)

    @property
    def rejects(self) -> dict[str, int]:
        """Refusals of the decoder, for the whole bus."""
        counts = {reason: n for reason, n in self._decoder.counters.items() if reason != "accepted"}
        return counts | {"strangers": self.strangers}

    def connect(self, now: Instant, usb_serial: str = "", byte_time: float = 0.0) -> None:  # noqa: ARG002 - properties of a serial line
        """Start; see `Line.connect`."""
        self._up = True
        self._decoder.reset()
        self._frames = self._errors = 0
        self._since = self._discover_due = self._diagnose_from = now
        if self._known:
            for link in self._links.values():
                link.connect(now)

    def disconnect(self) -> list[LineEvent]:
        """Stop; see `Line.disconnect`."""
        self._up = False
        self._questions.clear()
        return [
            LineEvent(node, event)
            for node, link in self._links.items()
            for event in link.disconnect()
        ]

    def receive(self, chunk: Chunk) -> list[LineEvent]:
        """Process frames; TypeError for bytes."""
        if isinstance(chunk.payload, bytes):
            raise TypeError("a CAN bus brings frames, not bytes")
        self._frames += len(chunk.payload)
        self._errors += sum(frame.error for frame in chunk.payload)
        heard: list[LineEvent] = []
        out: list[LineEvent] = []
        for received in self._decoder.feed(chunk.payload):
            message, node = received.message, received.board
            if isinstance(message, FloatSamples | HostMessage):
                continue  # another host's question
            if node not in self._links:
                if not self._wanted(node):
                    self.strangers += 1
                    continue
                out += self._add_board(node, chunk.received)
            if self._known and not out and not self._early:
                heard += self._receive_message(node, message, chunk.received)
            else:
                # The caller must first learn of the board, from the events that this returns.
                self._early.append((node, message, chunk.received))
        return heard + out

    def tick(self, now: Instant) -> list[LineEvent]:
        """Look for boards and drive their links."""
        if not self._up:
            return []
        if not self._known and now >= self._discover_due:
            self._discover_due = after(now, DISCOVER_EVERY)
            self._questions = [self._everyone.encode(Identify(0))]
        out: list[LineEvent] = []
        if not self._known and self._known_at is not None and now >= self._known_at:
            out += self._put_into_service(now)
        elif self._known:
            while self._early:
                out += self._receive_message(*self._early.popleft())
            for node, link in self._links.items():
                out += [LineEvent(node, event) for event in link.tick(now)]
        if not self._links and now >= max(after(self._since, NOTHING_AFTER), self._diagnose_from):
            self._diagnose_from = after(now, REPEAT_DIAGNOSIS)
            out.append(LineEvent(None, self._diagnose()))
        return out

    def outgoing(self) -> list[Payload]:
        """Remove and return the transfers to write."""
        out, self._questions = self._questions, []
        for node, link in self._links.items():
            out += [self._encoders[node].encode(message) for message in link.outgoing()]
        return out

    def _wanted(self, node: int) -> bool:
        if self._nodes is not None:
            return node in self._nodes
        return len(self._links) < MAX_NODES

    def _add_board(self, node: int, now: Instant) -> list[LineEvent]:
        def admit(identity: Identity) -> Refusal | None:
            return self._admit(node, identity)

        link = BoardLink(admit, self._rate, self._listen_only)
        self._encoders[node] = CanEncoder(node, self._fd)
        self._links[node] = link
        if self._known:
            link.connect(now)
            return [LineEvent(None, Found((node,), late=True))]
        if self._known_at is None:
            self._known_at = after(now, GATHER)
        return []

    def _put_into_service(self, now: Instant) -> list[LineEvent]:
        """Put the boards found so far into service; their kept messages are processed next."""
        self._known = True
        for link in self._links.values():
            link.connect(now)
        return [LineEvent(None, Found(tuple(sorted(self._links)), late=False))]

    def _receive_message(self, node: int, message: Message, arrival: Instant) -> list[LineEvent]:
        return [LineEvent(node, event) for event in self._links[node].receive(message, arrival)]

    def _diagnose(self) -> Diagnosed:
        if not self._frames:
            return Diagnosed(
                f"{self._port} is silent: no frame at all, and no answer to Identify",
                "check the bit rate (…@1000000), termination (60 Ω across the bus), power and "
                "that the adapter is the right one",
            )
        if self._errors == self._frames:
            return Diagnosed(
                f"{self._port} carries nothing but error frames ({self._errors})",
                "the bit rate is wrong (…@1000000), the bus is not terminated, or nobody else is "
                "on it to acknowledge",
            )
        return Diagnosed(
            f"{self._port} carries {self._frames} frames, but no taxel board answers Identify",
            "check the board's firmware and, for CAN FD, that the bus was given with +fd",
        )


# Make the line of a port, and name the boards behind it.


def make_line(
    port: str,
    admit: Admit,
    medium: Medium,
    *,
    kind: str,
    rate: float | None,
    baud: int,
    fd: bool,
    nodes: frozenset[int] | None,
    listen_only: bool,
    arrays: tuple[int, ...] | None = None,
) -> Line:
    """Make the line of ``port``. ``nodes``: boards wanted on a CAN bus; None: all.

    ``arrays``: magnetometers of each array of a controller that does not report it.
    """
    if medium is Medium.CAN:
        return CanLine(port, admit, fd, rate, nodes, listen_only)
    return SerialLine(port, admit, kind, rate, baud, listen_only, arrays)


def bus_names(
    stem: str, given: dict[int, str], nodes: tuple[int, ...], late: bool
) -> dict[int, str]:
    """Names of boards on a CAN bus: as given by node; else the stem for a single board, else
    stem-node."""
    if given:
        return {node: given[node] for node in nodes if node in given}
    if len(nodes) == 1 and not late:
        return {nodes[0]: stem}
    return {node: f"{stem}-{node}" for node in nodes}
