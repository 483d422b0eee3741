"""Streams over zenoh: publishers that never block, and readers that get only the newest sample."""

from __future__ import annotations

import struct
import threading
import time
import uuid
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import zenoh

from tactile_core.bus.messages import MAX_PAYLOAD
from tactile_core.bus.topics import Topic, alive_key

ATTACHMENT = struct.Struct("<qqB16s")
"""Sequence number, wall-clock ns, length of the id, id of the publisher; layout of rmw_zenoh."""

WALL_LIMIT_NS = (1 << 63) - 1

CLOSE_WAIT_S = 1.0
"""Longest wait in s for another thread that is in the middle of a call."""


class _Declared(Protocol):
    def undeclare(self) -> None: ...


def undeclare(declared: _Declared) -> None:
    """Undeclare a publisher or subscriber, after the calls of other threads that are under way.

    Zenoh raises RuntimeError during such a call, and does nothing. No new ones must begin.
    """
    deadline = time.monotonic() + CLOSE_WAIT_S
    while True:
        try:
            declared.undeclare()
        except RuntimeError:
            if time.monotonic() >= deadline:
                raise
            time.sleep(0.001)
        else:
            return


class Publisher:
    """Publisher of one stream, for use by one thread. Drops when a link is full; never waits.

    Any thread may close it; `put` does nothing afterwards.
    """

    def __init__(self, session: zenoh.Session, key: str, msgtype: str) -> None:
        encoding = zenoh.Encoding.APPLICATION_CDR.with_schema(msgtype)
        self._publisher = session.declare_publisher(
            key,
            encoding=encoding,
            congestion_control=zenoh.CongestionControl.DROP,
            express=False,
        )
        self.key = key
        self.source = uuid.uuid4().bytes
        self.sequence = 0
        self._closed = False

    def put(self, data: bytes, wall_ns: int) -> None:
        """Send CDR bytes with their wall-clock stamp. Raises ValueError above MAX_PAYLOAD.

        A time beyond the 64 bits of the attachment (ns) is clipped.
        """
        if len(data) > MAX_PAYLOAD:
            raise ValueError(f"{len(data)} bytes on {self.key}: {MAX_PAYLOAD} allowed")
        if self._closed:
            return
        self.sequence += 1
        wall_ns = min(max(wall_ns, -WALL_LIMIT_NS), WALL_LIMIT_NS)
        attachment = ATTACHMENT.pack(self.sequence, wall_ns, 16, self.source)
        try:
            self._publisher.put(data, attachment=attachment)
        except (zenoh.ZError, RuntimeError):
            if not self._closed:  # else another thread has just closed it
                raise

    def close(self) -> None:
        """Withdraw the stream; does nothing the second time."""
        if not self._closed:
            self._closed = True
            undeclare(self._publisher)


def declare_publisher(
    session: zenoh.Session, topic: Topic, name: str, prefix: str = ""
) -> Publisher:
    """Declare the publisher of ``topic`` for the board, arm or reach called ``name``."""
    return Publisher(session, topic.key(name, prefix), topic.msgtype)


@dataclass(frozen=True, slots=True)
class BusSample:
    """One received sample. The last three fields are None if the sender attached nothing.

    ``wall_ns``: the sender's stamp. ``source``: 16 bytes that identify the publisher.
    """

    key: str
    data: bytes
    sequence: int | None
    wall_ns: int | None
    source: bytes | None


def read_sample(sample: zenoh.Sample) -> BusSample:
    """Read a zenoh sample and its publisher's attachment."""
    sequence = wall_ns = source = None
    attachment = sample.attachment
    if attachment is not None and len(attachment) == ATTACHMENT.size:
        sequence, wall_ns, _, source = ATTACHMENT.unpack(attachment.to_bytes())
    key = str(sample.key_expr)
    return BusSample(key, sample.payload.to_bytes(), sequence, wall_ns, source)


class Latest:
    """Newest sample of a key. Older ones that were not fetched are dropped and counted.

    zenoh keeps one sample (RingChannel) on its own threads, so samples do not age however slow the
    reader is. ``skipped`` is exact for publishers of this project. Read by one thread; any may
    close it, and there is no sample afterwards.
    """

    def __init__(self, session: zenoh.Session, key: str) -> None:
        ring: zenoh.handlers.RingChannel[zenoh.Sample] = zenoh.handlers.RingChannel(1)
        self._subscriber = session.declare_subscriber(key, ring)
        self._last: tuple[bytes, int] | None = None
        self.key = key
        self.received = 0
        self.skipped = 0
        self.refused = 0  # above MAX_PAYLOAD
        self._closed = False

    def newest(self) -> BusSample | None:
        """The newest sample not yet fetched, or None. Never blocks."""
        if self._closed:
            return None
        try:
            sample = self._subscriber.try_recv()
        except (zenoh.ZError, RuntimeError):
            if not self._closed:  # else another thread has just closed it
                raise
            return None
        if sample is None:
            return None
        if len(sample.payload) > MAX_PAYLOAD:
            self.refused += 1
            return None
        self.received += 1
        found = read_sample(sample)
        if found.source is not None and found.sequence is not None:
            if self._last is not None and self._last[0] == found.source:
                self.skipped += max(found.sequence - self._last[1] - 1, 0)
            self._last = (found.source, found.sequence)
        return found

    def wait(self, timeout: float, period: float = 0.001) -> BusSample | None:
        """The newest sample, waiting up to ``timeout`` s for one; None on timeout."""
        deadline = time.monotonic() + timeout
        while (sample := self.newest()) is None:
            if time.monotonic() >= deadline:
                return None
            time.sleep(period)
        return sample

    def close(self) -> None:
        """Unsubscribe; does nothing the second time."""
        if not self._closed:
            self._closed = True
            undeclare(self._subscriber)


class Tap:
    """Passes every sample of a key expression to ``take``, on zenoh's thread: for logs and
    monitors.

    ``take`` must be quick, or samples pile up; control loops use `Latest` instead. It is called for
    one sample at a time, and not once `close` has returned: a log closed after its tap loses
    nothing. ``remote_only``: ignore samples that this session publishes.
    """

    def __init__(
        self,
        session: zenoh.Session,
        key: str,
        take: Callable[[BusSample], None],
        *,
        remote_only: bool = False,
    ) -> None:
        self._take = take
        self.key = key
        self.refused = 0  # above MAX_PAYLOAD
        self._lock = threading.RLock()  # re-entrant: ``take`` may close its own tap
        self._closed = False
        origin = zenoh.Locality.REMOTE if remote_only else zenoh.Locality.ANY
        self._subscriber = session.declare_subscriber(key, self._on_sample, allowed_origin=origin)

    def close(self) -> None:
        """Unsubscribe, after the sample that is being taken.

        Zenoh may deliver one more while its subscriber ends; it is passed over.
        """
        with self._lock:
            self._closed = True
        self._subscriber.undeclare()

    def _on_sample(self, sample: zenoh.Sample) -> None:
        with self._lock:
            if self._closed:
                return
            if len(sample.payload) > MAX_PAYLOAD:
                self.refused += 1
            else:
                self._take(read_sample(sample))


def latest(session: zenoh.Session, key: str) -> Latest:
    """Subscribe for control or display: only the newest sample of ``key``."""
    return Latest(session, key)


def declare_alive(session: zenoh.Session, name: str) -> zenoh.LivelinessToken:
    """Announce a publisher for ``name``. For information only: safety relies on the age of data."""
    return session.liveliness().declare_token(alive_key(name))


def list_alive(session: zenoh.Session, timeout: float = 1.0) -> list[str]:
    """Sorted names with a liveliness token; asks until ``timeout`` s passed or one answered."""
    deadline = time.monotonic() + timeout
    names: set[str] = set()
    while not names:
        remaining = deadline - time.monotonic()
        if remaining <= 0:
            break
        for reply in session.liveliness().get("tactile/*/alive", timeout=remaining):
            if reply.ok is not None:
                names.add(str(reply.ok.key_expr).split("/")[-2])
        time.sleep(0.02)
    return sorted(names)
