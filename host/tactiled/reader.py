"""The thread that reads one port: stamps, hands over and logs chunks, and reopens a lost port."""

from __future__ import annotations

import logging
import os
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from tactile_core.types import monotonic_now, seconds_between
from tactiled.blocks import Chunk
from tactiled.publisher import MessagePublisher
from tactiled.transports import EndOfLog, PortClosed, PortGone, Transport, TransportError
from tactiled.transports.serial_port import SerialTransport

# The queue between a port's reader and the pipeline: bounded; drops the oldest first, and counts.


CHUNKS = 1024
"""Most chunks that may wait for the pipeline: a second of a busy CAN bus."""

MAX_AGE = 0.5
"""s that a chunk may wait. Older features are useless, and a pipeline that cannot keep up must show
the present with gaps rather than everything late."""


@dataclass(frozen=True, slots=True)
class PortOpened:
    """The port is open. ``usb_serial``: serial number of its USB device; ``byte_time``: s per byte
    on a UART, else 0."""

    usb_serial: str = ""
    byte_time: float = 0.0


@dataclass(frozen=True, slots=True)
class PortLost:
    """The port is gone. ``reason``: text for people."""

    reason: str


@dataclass(frozen=True, slots=True)
class PortEnded:
    """A replay is over."""


Item = Chunk | PortOpened | PortLost | PortEnded


class Wake:
    """Wakes the pipeline's thread; shared by all ports."""

    def __init__(self) -> None:
        self._event = threading.Event()

    def ring(self) -> None:
        """Wake the thread: there is something to do."""
        self._event.set()

    def wait(self, timeout: float) -> None:
        """Wait until rung, at most ``timeout`` s."""
        if self._event.wait(timeout):
            self._event.clear()


class Inbox:
    """Queue from one port's reader. Drops chunks when full, never opened, lost or ended."""

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
        """How many of these lay between the chunk taken last and the one before it."""
        self._told = 0

    @property
    def full(self) -> bool:
        """Whether the next chunk would displace the oldest."""
        return self._chunks >= self._limit

    @property
    def waiting(self) -> bool:
        """Whether there is anything to take."""
        return bool(self._items)

    def put(self, item: Item) -> None:
        """Add one item; never waits."""
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
        """Remove and return the oldest item; None when empty."""
        with self._lock:
            if not self._items:
                return None
            item = self._items.popleft()
            if isinstance(item, Chunk):
                self._chunks -= 1
                self.skipped, self._told = self.dropped - self._told, self.dropped
            return item

    def _oldest(self) -> tuple[int, Chunk]:
        """Index of the oldest chunk, and the chunk; there must be one."""
        return next((i, item) for i, item in enumerate(self._items) if isinstance(item, Chunk))

    def _is_stale(self, newest: Chunk) -> bool:
        if self._max_age is None:
            return False
        return seconds_between(self._oldest()[1].received, newest.received) > self._max_age

    def _drop_oldest(self) -> None:
        del self._items[self._oldest()[0]]
        self._chunks -= 1
        self.dropped += 1


log = logging.getLogger(__name__)

READ_TIMEOUT = 0.2
"""s that a read waits; `Transport.close` ends it sooner."""

REOPEN_FIRST = 0.05
"""s before the first attempt to reopen a lost port; doubles up to `REOPEN_SLOWEST`."""

REOPEN_SLOWEST = 0.5
"""s between attempts: data must be back 2 s after a replug."""

LOG_DELAY = 0.003
"""s by which a chunk is logged late, so that the pipeline can process it first, undisturbed."""

LOG_BATCH = 32
"""Most chunks that wait to be logged, when they come faster than that."""

RESOLVE_EVERY = 0.5
"""s between checks of where a port's path leads, while no board has been found on it."""

PACE = 0.002
"""s between checks whether the pipeline has caught up with a recording."""

JOIN_TIMEOUT = 0.5
"""s for the thread to end; closing the port wakes it."""

BITS_PER_BYTE = 10
"""Bits per byte on a UART: start bit, eight data bits, stop bit."""

NO_UART = ("/dev/ttyACM", "/dev/pts/", "/dev/ttys")
"""Beginnings of devices whose baud rate means nothing: USB CDC and pseudo-terminals."""


class PortReader:
    """Reads ``transport`` into ``inbox`` on a thread of its own until `stop`.

    ``name``: raw chunks are logged under it. ``paced``: wait for the pipeline rather than drop,
    for recordings. ``failed``: called with the error that ended the thread.
    """

    def __init__(
        self,
        transport: Transport,
        inbox: Inbox,
        publisher: MessagePublisher,
        name: str,
        failed: Callable[[BaseException], None],
        paced: bool = False,
    ) -> None:
        self.transport = transport
        self.reopened = 0
        self.identified: Callable[[], bool] = lambda: True
        """Whether a board has identified itself on this port. Until then the port's path is
        resolved again now and then: it may be a symbolic link that is moved to another device."""
        self.unlogged = 0
        """Chunks that could not be logged."""
        self._resolve_at = 0.0
        self.beat = monotonic_now()  # when its thread last made progress
        self._inbox = inbox
        self._publisher = publisher
        self.name = name
        self._failed = failed
        self._paced = paced
        self._waiting: deque[Chunk] = deque()
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"read-{name}", daemon=True)

    def open(self, wait: bool) -> None:
        """Open the port. `TransportError` when that fails, unless ``wait``: the thread retries."""
        try:
            self.transport.open()
        except TransportError as error:
            if not wait:
                raise
            log.warning("%s; waiting for it", error)
        else:
            self._put_opened()

    def start(self) -> None:
        """Begin to read."""
        self._thread.start()

    def stop(self) -> bool:
        """Close the port and end the thread; False when it does not end."""
        self._stopping.set()
        self.transport.close()
        if self._thread.is_alive():
            self._thread.join(JOIN_TIMEOUT)
        return not self._thread.is_alive()

    def _run(self) -> None:
        try:
            while not self._stopping.is_set():
                try:
                    self._read_until_lost()
                except EndOfLog:
                    raise
                except Exception as error:  # of any kind: a failing driver counts as a lost port
                    log.error("%s failed", self.transport.name, exc_info=error)
                    self._inbox.put(PortLost(f"{self.transport.name} failed: {error}"))
                self._reopen()
        except EndOfLog:
            self._inbox.put(PortEnded())
        except BaseException as error:  # noqa: BLE001 - thread boundary: the daemon must end loudly
            self._failed(error)

    def _read_until_lost(self) -> None:
        transport, inbox, waiting = self.transport, self._inbox, self._waiting
        try:
            while True:
                self.beat = monotonic_now()
                chunk = transport.read(LOG_DELAY if waiting else READ_TIMEOUT)
                if chunk is not None:
                    while self._paced and inbox.full and not self._stopping.wait(PACE):
                        pass
                    inbox.put(chunk)
                    waiting.append(chunk)
                if chunk is None or len(waiting) >= LOG_BATCH:
                    self._log_waiting()
                self._check_path()
        except EndOfLog:
            raise
        except PortClosed:
            return
        except TransportError as error:
            if not self._stopping.is_set():
                inbox.put(PortLost(str(error)))
        finally:
            self._log_waiting()

    def _check_path(self) -> None:
        """Raise `PortGone` when no board was found yet and the path now leads to another device."""
        now = time.monotonic()
        if now < self._resolve_at:
            return
        self._resolve_at = now + RESOLVE_EVERY
        transport = self.transport
        if not isinstance(transport, SerialTransport) or self.identified():
            return
        if transport.leads_elsewhere:
            transport.forget_device()
            raise PortGone(f"{transport.name} leads to another device now", "taking that one")

    def _log_waiting(self) -> None:
        while self._waiting:
            try:
                self._publisher.raw(self.name, self.transport.name, self._waiting.popleft())
            except (ValueError, TypeError) as error:  # the log goes on without this chunk
                self.unlogged += 1
                log.debug("%s: a chunk cannot be logged: %s", self.name, error)

    def _reopen(self) -> None:
        wait, said = REOPEN_FIRST, ""
        while not self._stopping.wait(wait):
            self.beat = monotonic_now()
            try:
                self.transport.open()
            except TransportError as error:
                if str(error) != said:
                    said = str(error)
                    log.info("%s", error)
                wait = min(2 * wait, REOPEN_SLOWEST)
            else:
                self.reopened += 1
                self._put_opened()
                return

    def _put_opened(self) -> None:
        transport = self.transport
        if isinstance(transport, SerialTransport):
            serial = transport.usb_serial or ""
            self._inbox.put(PortOpened(serial, byte_time(transport.device, transport.baud)))
        else:
            self._inbox.put(PortOpened())


def byte_time(device: str | None, baud: int) -> float:
    """s that a byte takes on the wire of ``device``; 0 where there is no UART."""
    if device is None or os.path.realpath(device).startswith(NO_UART):
        return 0.0
    return BITS_PER_BYTE / baud
