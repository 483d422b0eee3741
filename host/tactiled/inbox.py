"""Between a port's reader and the pipeline: bounded, the oldest dropped first and counted."""

from __future__ import annotations

import threading
from collections import deque
from dataclasses import dataclass

from tactile_bus.instant import seconds_between
from tactiled.blocks import Chunk

CHUNKS = 1024
"""Chunks that may wait for the pipeline: a second of a busy CAN bus."""

MAX_AGE = 0.5
"""s that a chunk may wait: features as old as that are of no use to anyone, and a pipeline that
cannot keep up must show what is now, with gaps, rather than everything, late."""


@dataclass(frozen=True, slots=True)
class PortOpened:
    """The port is open. ``usb_serial``: of its USB device; ``byte_time``: s per byte on a UART."""

    usb_serial: str = ""
    byte_time: float = 0.0


@dataclass(frozen=True, slots=True)
class PortLost:
    """The port is gone; ``reason`` for people."""

    reason: str


@dataclass(frozen=True, slots=True)
class PortEnded:
    """A replay is over."""


Item = Chunk | PortOpened | PortLost | PortEnded


class Wake:
    """Rouses the pipeline; shared by all ports."""

    def __init__(self) -> None:
        self._event = threading.Event()

    def ring(self) -> None:
        """There is something to do."""
        self._event.set()

    def wait(self, timeout: float) -> None:
        """Wait until rung, at most ``timeout`` s."""
        if self._event.wait(timeout):
            self._event.clear()


class Inbox:
    """What one port's reader hands over; drops chunks, never news of the port itself."""

    def __init__(self, wake: Wake, limit: int = CHUNKS, max_age: float | None = None) -> None:
        """``max_age``: s after which a chunk that waits is dropped; None: never, for recordings."""
        self._wake = wake
        self._limit = limit
        self._max_age = max_age
        self._items: deque[Item] = deque()
        self._lock = threading.Lock()
        self._chunks = 0
        self.dropped = 0
        """Chunks dropped since the start."""
        self.skipped = 0
        """Of these, the ones between the chunk taken last and the one before it."""
        self._told = 0

    @property
    def full(self) -> bool:
        """Whether the next chunk would push out the oldest."""
        return self._chunks >= self._limit

    @property
    def waiting(self) -> bool:
        """Whether there is anything to take."""
        return bool(self._items)

    def put(self, item: Item) -> None:
        """Hand over one item; never waits."""
        with self._lock:
            if isinstance(item, Chunk):
                if self._chunks >= self._limit:
                    self._drop_oldest()
                while self._chunks and self._is_stale(item):
                    self._drop_oldest()
                self._chunks += 1
            self._items.append(item)
        self._wake.ring()

    def take(self) -> Item | None:
        """Oldest item, None when there is none."""
        with self._lock:
            if not self._items:
                return None
            item = self._items.popleft()
            if isinstance(item, Chunk):
                self._chunks -= 1
                self.skipped, self._told = self.dropped - self._told, self.dropped
            return item

    def _oldest(self) -> tuple[int, Chunk]:
        """Place of the oldest chunk, and the chunk; there must be one."""
        return next((i, item) for i, item in enumerate(self._items) if isinstance(item, Chunk))

    def _is_stale(self, newest: Chunk) -> bool:
        if self._max_age is None:
            return False
        return seconds_between(self._oldest()[1].received, newest.received) > self._max_age

    def _drop_oldest(self) -> None:
        del self._items[self._oldest()[0]]
        self._chunks -= 1
        self.dropped += 1
