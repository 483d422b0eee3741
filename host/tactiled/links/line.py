"""One port: bytes or CAN frames on one side, the links of the boards behind it on the other.

Pure: chunks and instants in; events, and payloads to write, out.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from sensor_proto.anyskin import AnySkinDecoder
from sensor_proto.canseg import CanFrame
from sensor_proto.framing import SerialDecoder, encode_serial
from sensor_proto.packets import FloatSamples, Received
from tactile_bus.instant import NS_PER_S, Instant, after
from tactiled.blocks import Chunk
from tactiled.links.diagnosis import Diagnosis
from tactiled.links.events import Event, Identity, Refusal
from tactiled.links.float_link import FloatLink
from tactiled.links.link import BoardLink, State

KINDS = ("auto", "tactile", "anyskin", "reskin", "eflesh")
"""What --board takes; the last three speak the same floats."""

FLOAT_MODEL = "anyskin"
"""What calibrations call boards that send floats."""

REPEAT_DIAGNOSIS = 30.0
"""s between repetitions of a diagnosis that still holds."""

Admit = Callable[[int, Identity], Refusal | None]
"""Judges the board with a node number (0 on a serial line)."""

Link = BoardLink | FloatLink
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
    """A serial line: one board, whose kind is found out unless ``kind`` says it."""

    def __init__(
        self,
        port: str,
        admit: Admit,
        kind: str = "auto",
        rate: float | None = None,
        baud: int = 115_200,
        listen_only: bool = False,
    ) -> None:
        if kind not in KINDS:
            raise ValueError(f"board kind {kind!r}; allowed: {', '.join(KINDS)}")
        self._kind = kind
        self._own = SerialDecoder()
        self._floats = AnySkinDecoder()
        self._board = BoardLink(lambda identity: admit(0, identity), rate, listen_only)
        self._float = FloatLink(lambda identity: admit(0, identity), FLOAT_MODEL)
        self._link: Link | None = None
        self._diagnosis = Diagnosis(port, baud, kind)
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
        decoder = self._floats if isinstance(self._link, FloatLink) else self._own
        return {reason: n for reason, n in decoder.counters.items() if reason != "accepted"}

    def connect(self, now: Instant, usb_serial: str = "", byte_time: float = 0.0) -> None:
        """The port is open; see `Line.connect`."""
        self._up = True
        self._byte_ns = byte_time * NS_PER_S
        self._float.serial_number = usb_serial
        self._own.reset()
        self._floats.reset()
        self._diagnosis.begin(now)
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
        found = self._decode(data)
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
        elif link.state is not State.REFUSED and now >= self._diagnose_from:
            waiting = self._diagnosis.waiting(now)
            if waiting is not None:
                out.append(LineEvent(None, waiting))
            diagnosed = self._diagnosis.judge(now, answered=self._link is not None)
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

    def _decode(self, data: bytes) -> list[Received]:
        """Messages by whichever decoder fits; the first to find one is kept."""
        if isinstance(self._link, BoardLink):
            return self._own.feed(data)
        if isinstance(self._link, FloatLink):
            return self._floats.feed(data)
        if self._kind in ("auto", "tactile"):
            found = self._own.feed(data)
            if found:
                self._link = self._board
                return found
        if self._kind != "tactile":
            found = self._floats.feed(data)
            if found:
                self._link = self._float
                self._board.disconnect()
                return found
        return []
