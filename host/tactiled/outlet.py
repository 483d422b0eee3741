"""Where messages leave the daemon: encoded once, the same bytes to the bus and into the log."""

from __future__ import annotations

import logging
import threading
from contextlib import suppress
from typing import Any, Protocol

import zenoh

from tactile_bus.instant import Instant, WallClock, monotonic_now
from tactile_bus.messages import codec, log_message
from tactile_bus.recorder import Recorder
from tactile_bus.streams import Publisher, declare_publisher
from tactile_bus.throttle import Throttle
from tactile_bus.topics import LOG, RAW, Topic
from tactiled.blocks import Chunk
from tactiled.outgoing import split
from tactiled.transports.raw_chunk import to_raw

log = logging.getLogger(__name__)

NODE = "tactiled"
"""Name of this program in ``rcl_interfaces/Log``."""


class Sink(Protocol):
    """Where a board's messages go: bus and log, or the log of a run over recorded bytes."""

    wall: WallClock
    recorder: Recorder | None

    def now(self) -> Instant:
        """Present instant of whatever clock the messages live by."""

    def send(self, topic: Topic, name: str, message: Any, stamp_ns: int) -> None:
        """Encode and send; ``stamp_ns``: wall-clock time that the message stands for."""

    def announce(self, name: str, level: int, text: str, at: Instant | None = None) -> None:
        """Say something of a board: to people, on the bus and into the log."""

    def firmware_text(
        self, name: str, level: int, speaker: str, text: str, at: Instant | None = None
    ) -> None:
        """``rcl_interfaces/Log`` on the bus and into the log alone."""


class Outlet:
    """Bus and log behind one call. ``recorder`` None: nothing is logged.

    After `end` nothing is published any more, whichever thread asks for it. ``late`` counts what
    came after it, ``refused`` what the bus did not take.
    """

    def __init__(
        self,
        session: zenoh.Session,
        recorder: Recorder | None,
        wall: WallClock,
        prefix: str = "",
    ) -> None:
        self.wall = wall
        self.recorder = recorder
        self.late = 0
        self.refused = 0
        self._ended = False
        self._publishing = threading.Lock()
        self._complaints = Throttle(rate=0.1, burst=1)
        self._session = session
        self._prefix = prefix
        self._codec = codec()
        self._publishers: dict[tuple[str, str], Publisher] = {}

    def now(self) -> Instant:
        """Present instant."""
        return monotonic_now()

    def send(self, topic: Topic, name: str, message: Any, stamp_ns: int) -> None:
        """Encode and send; ``stamp_ns``: wall-clock time that the message stands for.

        ValueError or TypeError for a message that cannot be encoded, and for nothing else.
        """
        data = self._codec.encode(topic, message)
        if topic.published:
            self._publish(topic, name, data, stamp_ns)
        if self.recorder is not None and topic.logged:
            now_ns = self.wall.wall_ns(monotonic_now())
            self.recorder.write(topic, name, data, now_ns, stamp_ns)

    def raw(self, name: str, port: str, chunk: Chunk) -> None:
        """Log what one read returned; called from the reader's thread."""
        if self.recorder is None:
            return
        stamp_ns = self.wall.wall_ns(chunk.received)
        for part in split(chunk):
            data = self._codec.encode(RAW, to_raw(part, port, self.wall))
            self.recorder.write(RAW, name, data, stamp_ns, stamp_ns)

    def announce(self, name: str, level: int, text: str, at: Instant | None = None) -> None:
        """Say something of a board: to people, on the bus and into the log."""
        log.log(level, "%s: %s", name, text)
        self.firmware_text(name, level, NODE, text, at)

    def firmware_text(
        self, name: str, level: int, speaker: str, text: str, at: Instant | None = None
    ) -> None:
        """``rcl_interfaces/Log`` on the bus and into the log alone."""
        stamp_ns = self.wall.wall_ns(monotonic_now() if at is None else at)
        self.send(LOG, name, log_message(stamp_ns, level, speaker, text), stamp_ns)

    def end(self) -> None:
        """Publish nothing from now on; what is being published is published first."""
        with self._publishing:
            self._ended = True

    def close(self) -> None:
        """Take all streams back."""
        self.end()
        for publisher in self._publishers.values():
            with suppress(zenoh.ZError):  # the session has closed by itself
                publisher.close()
        self._publishers.clear()

    def _publish(self, topic: Topic, name: str, data: bytes, stamp_ns: int) -> None:
        with self._publishing:
            if self._ended:
                self.late += 1
                return
            try:
                publisher = self._publishers.get((topic.template, name))
                if publisher is None:
                    publisher = declare_publisher(self._session, topic, name, self._prefix)
                    self._publishers[topic.template, name] = publisher
                publisher.put(data, stamp_ns)
            except zenoh.ZError as error:
                self.refused += 1
                if self._complaints.allow(self.now()):
                    log.error(
                        "the bus refused %d messages; the log has them: %s", self.refused, error
                    )
