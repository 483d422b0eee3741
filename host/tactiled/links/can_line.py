"""A CAN bus as a line: boards found by a broadcast question, one link each. Pure."""

from __future__ import annotations

from collections import deque

from sensor_proto.canseg import BROADCAST, CanDecoder, CanEncoder
from sensor_proto.packets import FloatSamples, HostMessage, Identify, Message
from tactile_bus.instant import Instant, after
from tactiled.blocks import Chunk
from tactiled.links.diagnosis import NOTHING_AFTER
from tactiled.links.events import Diagnosed, Found, Identity, Refusal
from tactiled.links.line import REPEAT_DIAGNOSIS, Admit, LineEvent, Link, Payload
from tactiled.links.link import BoardLink

DISCOVER_EVERY = 0.2
"""s between broadcast questions until boards are known. Boards plugged in later show themselves by
their status, once a second."""

GATHER = 0.5
"""s from the first board's word until the boards of a bus are taken as known: two questions more,
should an answer have been lost. Their names depend on how many they are."""

EARLY = 4096
"""Messages kept while boards are gathered: sixteen of them at 493 Hz for half a second."""

MAX_NODES = 16
"""Boards used on one bus; more would not leave 25 Hz of samples each on CAN 2.0B."""


class CanLine:
    """A CAN bus: any number of boards, each found by its answer to a broadcast question."""

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
        self._known_at: Instant | None = None  # when the boards met until then are enough
        self._known = False
        self._early: deque[tuple[int, Message, Instant]] = deque(maxlen=EARLY)
        self._questions: list[Payload] = []
        self.strangers = 0
        """Messages of boards beyond `MAX_NODES` or not asked for."""

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
        """The bus is open."""
        self._up = True
        self._decoder.reset()
        self._frames = self._errors = 0
        self._since = self._discover_due = self._diagnose_from = now
        if self._known:
            for link in self._links.values():
                link.connect(now)

    def disconnect(self) -> list[LineEvent]:
        """The bus is closed or gone; see `Line.disconnect`."""
        self._up = False
        self._questions.clear()
        return [
            LineEvent(node, event)
            for node, link in self._links.items()
            for event in link.disconnect()
        ]

    def receive(self, chunk: Chunk) -> list[LineEvent]:
        """Take frames; TypeError for bytes."""
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
                out += self._meet(node, chunk.received)
            if self._known and not out and not self._early:
                heard += self._hear(node, message, chunk.received)
            else:
                # Whoever listens must first be told of the board, which it is when this returns.
                self._early.append((node, message, chunk.received))
        return heard + out

    def tick(self, now: Instant) -> list[LineEvent]:
        """Look for boards, drive their links."""
        if not self._up:
            return []
        if not self._known and now >= self._discover_due:
            self._discover_due = after(now, DISCOVER_EVERY)
            self._questions = [self._everyone.encode(Identify(0))]
        out: list[LineEvent] = []
        if not self._known and self._known_at is not None and now >= self._known_at:
            out += self._take_up(now)
        elif self._known:
            while self._early:
                out += self._hear(*self._early.popleft())
            for node, link in self._links.items():
                out += [LineEvent(node, event) for event in link.tick(now)]
        if not self._links and now >= max(after(self._since, NOTHING_AFTER), self._diagnose_from):
            self._diagnose_from = after(now, REPEAT_DIAGNOSIS)
            out.append(LineEvent(None, self._diagnose()))
        return out

    def outgoing(self) -> list[Payload]:
        """Transfers to write now."""
        out, self._questions = self._questions, []
        for node, link in self._links.items():
            out += [self._encoders[node].encode(message) for message in link.outgoing()]
        return out

    def _wanted(self, node: int) -> bool:
        if self._nodes is not None:
            return node in self._nodes
        return len(self._links) < MAX_NODES

    def _meet(self, node: int, now: Instant) -> list[LineEvent]:
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

    def _take_up(self, now: Instant) -> list[LineEvent]:
        """Put the boards met so far into service; what they said meanwhile is heard next."""
        self._known = True
        for link in self._links.values():
            link.connect(now)
        return [LineEvent(None, Found(tuple(sorted(self._links)), late=False))]

    def _hear(self, node: int, message: Message, arrival: Instant) -> list[LineEvent]:
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
