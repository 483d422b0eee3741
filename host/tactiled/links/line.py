"""One port: bytes or CAN frames on one side, the links of the boards behind it on the other.

Pure: chunks and instants in; events, and payloads to write, out.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

from sensor_proto.anyskin import AnySkinDecoder
from sensor_proto.canseg import CanFrame
from sensor_proto.decoder import Reject
from sensor_proto.framing import SerialDecoder, encode_serial
from sensor_proto.layout import FORM, Framing, Kind, Layout
from sensor_proto.layout_decoder import LayoutDecoder
from sensor_proto.packets import FloatSamples, Received
from sensor_proto.survey import Finding, Survey
from sensor_proto.text_frames import TextDecoder
from tactile_bus.instant import NS_PER_S, Instant, after
from tactiled.blocks import Chunk
from tactiled.links.diagnosis import Diagnosis
from tactiled.links.events import Event, Identity, Refusal
from tactiled.links.float_link import FloatLink
from tactiled.links.link import BoardLink, State

KINDS = ("auto", "tactile", "anyskin", "reskin", "eflesh")
"""What --board takes besides a layout; the last three are the same boards."""

FLOAT_MODEL = "anyskin"
"""What calibrations call boards that send floats."""

JUDGE_FIRST, JUDGE_SLOWEST = 0.25, 2.0
"""s between looks at bytes of which no decoder makes a frame; the time doubles while nothing is
found, as a look takes some milliseconds."""

PATIENCE = 30.0
"""s for which the frames of a layout that was found are awaited; the slowest board sends ten."""

REPEAT_DIAGNOSIS = 30.0
"""s between repetitions of a diagnosis that still holds."""

Admit = Callable[[int, Identity], Refusal | None]
"""Judges the board with a node number (0 on a serial line)."""

Link = BoardLink | FloatLink
Unframed = AnySkinDecoder | LayoutDecoder | TextDecoder
Payload = bytes | tuple[CanFrame, ...]


@dataclass(frozen=True, slots=True)
class LineEvent:
    """Something that happened to the board ``node``, or (None) to the port as a whole."""

    node: int | None
    event: Event


class Line(Protocol):
    """What the daemon sees of a port, whatever the medium."""

    @property
    def links(self) -> dict[int, Link]:
        """Boards found so far, by node."""

    @property
    def rejects(self) -> dict[str, int]:
        """What the decoders refused, by reason."""

    def connect(self, now: Instant, usb_serial: str = "", byte_time: float = 0.0) -> None:
        """The port is open. ``byte_time``: s that each byte takes on the wire, 0 over USB."""

    def disconnect(self) -> list[LineEvent]:
        """The port is closed or gone; commands that waited are given up."""

    def receive(self, chunk: Chunk) -> list[LineEvent]:
        """Take what one read returned."""

    def tick(self, now: Instant) -> list[LineEvent]:
        """Do what time demands."""

    def outgoing(self) -> list[Payload]:
        """What to write now, taken out."""


class SerialLine:
    """A serial line: one board, whose kind is found out unless ``kind`` says it.

    ``kind``: one of `KINDS`, or a layout. ``arrays``: magnetometers of each board of a controller.
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
        self._settled = False  # whether the unframed decoder has given a frame since the opening
        self._former: Counter[str] = Counter()  # counts of unframed decoders that were given up
        self._layout: Layout | None = None  # what the unframed decoder reads; None: usual floats
        self._finding: Finding | None = None
        self._judge_due, self._judge_wait = Instant(0), JUDGE_FIRST
        self._patient_until = Instant(0)
        self._board = BoardLink(lambda identity: admit(0, identity), rate, listen_only)
        self._float = FloatLink(lambda identity: admit(0, identity), FLOAT_MODEL, "", arrays)
        self._link: Link | None = None
        self._diagnosis = Diagnosis(port, baud, kind)
        if self._declared is not None:
            self._adopt(self._declared)
        self._diagnose_from = Instant(0)
        self._byte_ns = 0.0
        self._up = False

    @property
    def links(self) -> dict[int, Link]:
        """The board, once its kind is known."""
        return {} if self._link is None else {0: self._link}

    @property
    def rejects(self) -> dict[str, int]:
        """Refusals of the decoder in use (of ours while the kind is not known)."""
        counts = Counter(self._own.counters)
        if isinstance(self._link, FloatLink):
            counts = self._former + Counter({} if self._floats is None else self._floats.counters)
        return {reason: n for reason, n in counts.items() if reason != "accepted"}

    def connect(self, now: Instant, usb_serial: str = "", byte_time: float = 0.0) -> None:
        """The port is open; see `Line.connect`."""
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
        """The port is closed or gone; commands that waited are given up."""
        self._up = False
        self._float.disconnect()
        return [LineEvent(0, event) for event in self._board.disconnect()]

    def receive(self, chunk: Chunk) -> list[LineEvent]:
        """Take bytes; TypeError for CAN frames."""
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
        """Drive the link; say what is wrong while no board is found."""
        if not self._up:
            return []
        link = self._link or self._board
        was_served = self._served
        out = [LineEvent(0, event) for event in link.tick(now)]
        if was_served:
            # Should it go out of service, what is wrong is judged from here on.
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
        """Frames to write now."""
        return [encode_serial(message) for message in self._board.outgoing()]

    @property
    def _served(self) -> bool:
        """Whether a board has been found since the port was opened."""
        return self._link is not None and self._link.state in (State.CONFIGURING, State.STREAMING)

    @property
    def _about_to_read(self) -> bool:
        """Whether it is known how the board writes, and its next frames are awaited."""
        return self._finding is not None and self._finding.layout is not None

    def _decode(self, data: bytes, now: Instant) -> list[Received]:
        """Messages by whichever decoder fits; the first to find one is kept."""
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
            self._look(data, now)
        return found

    def _look(self, data: bytes, now: Instant) -> None:
        """Find out how the board writes, where it is plain: two looks must say the same."""
        self._survey.feed(data)
        if now < self._judge_due:
            return
        before, self._finding = self._finding, self._survey.judge()
        layout = None if self._finding is None else self._finding.layout
        if layout is not None:
            self._judge_wait = JUDGE_FIRST
            if before is not None and before.layout == layout:
                self._adopt(layout)
        elif self._survey.full:
            self._judge_wait = min(2 * self._judge_wait, JUDGE_SLOWEST)
        self._judge_due = after(now, self._judge_wait)

    def _adopt(self, layout: Layout) -> None:
        """Read frames of ``layout`` from now on, once it is known what stands round its numbers."""
        if layout == self._layout:
            return  # give it time
        self._layout = layout
        usual = layout == replace(USUAL, chips=layout.chips, framing=layout.framing)
        usual &= layout.framing in (None, USUAL.framing)
        if usual and self._declared is None and isinstance(self._floats, AnySkinDecoder):
            return  # it will come to see it
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
"""What `AnySkinDecoder` reads: it knows that layout best."""


def board_kind(text: str) -> Layout | None:
    """Layout that ``--board`` declares, None for one of `KINDS`; ValueError for anything else."""
    if text in KINDS:
        return None
    if ":" not in text:
        raise ValueError(f"board kind {text!r}; allowed: {', '.join(KINDS)}, or a layout: {FORM}")
    return Layout.parse(text)
