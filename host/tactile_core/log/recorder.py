"""Recorder of MCAP logs, which are written by a thread of its own from a bounded queue.

Every loss leaves a trace. Each message gets its channel's next sequence number when it is handed
over, so a number missing in the log is a dropped message. The next flush writes a metadata record
named ``gap`` with the reason, the number lost of each channel, and the times of the first and last.
The sum of ``messages`` over all gap records is the number of dropped messages. If a file cannot be
continued, its gap record is in the next file.

No input ends the log. A message that a log cannot hold is refused and counted. A stamp that it
cannot hold is replaced by the time of logging and counted as marked.
"""

from __future__ import annotations

import logging
import re
import threading
import time
import zlib
from collections import deque
from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

from tactile_core.bus.messages import MAX_PAYLOAD, message_class
from tactile_core.bus.topics import Topic, find_topic
from tactile_core.log.mcap_file import DiskStorage, Storage
from tactile_core.log.records import Message
from tactile_core.log.retention import LogSet
from tactile_core.log.writer import WRITER_FAILED, Channel, Gaps, Item, LogWriter, RecorderSettings
from tactile_core.types import WallClock, monotonic_now

# Latched topics, whose last message stays valid until the next, and its repetition in each file.


QOS = "offered_qos_profiles"
"""Key of a channel's metadata in which rosbag2 stores the QoS of its publishers, as YAML."""

LATCHED_QOS = (
    "- history: 1\n  depth: 1\n  reliability: 1\n  durability: 1\n"
    "  deadline: {sec: 0, nsec: 0}\n  lifespan: {sec: 0, nsec: 0}\n  liveliness: 0\n"
    "  liveliness_lease_duration: {sec: 0, nsec: 0}\n  avoid_ros_namespace_conventions: false\n"
)
"""QoS of a latched topic as rosbag2 writes it: keep the last one, reliable, transient local."""

TRANSIENT_LOCAL = re.compile(r"\bdurability['\"]?:\s*['\"]?(?:1\b|transient_local)")

STAYING = ("tf_static", "robot_description")
"""Topics of other programs that are latched regardless of their channel's metadata."""


def is_latched(topic: str, metadata: Mapping[str, str]) -> bool:
    """Whether a channel is latched, judged by its QoS or a known topic."""
    if TRANSIENT_LOCAL.search(metadata.get(QOS, "")) or topic.rpartition("/")[2] in STAYING:
        return True
    found = find_topic(topic)
    return found is not None and found[0].latched


class Repeats:
    """Recognises latched messages repeated at the start of a log's later files.

    A repetition is the first message of a latched channel in a file if it equals the last one of
    the earlier files: same number, same sender's stamp, same bytes.
    """

    def __init__(self) -> None:
        self._last: dict[Hashable, tuple[int, int, int]] = {}
        self._begun: set[Hashable] = set()

    def next_file(self) -> None:
        """Start the next file of the log."""
        self._begun.clear()

    def is_repeat(self, channel: Hashable, message: Message) -> bool:
        """Whether a message of a latched channel repeats an earlier one."""
        identity = message.sequence, message.publish_ns, zlib.crc32(message.data)
        if channel in self._begun:
            self._last[channel] = identity
            return False
        self._begun.add(channel)
        before = self._last.get(channel)
        self._last[channel] = identity
        return before == identity


__all__ = ["Recorder", "RecorderError", "RecorderSettings", "RecorderStats"]

log = logging.getLogger(__name__)

BATCH = 512
"""Messages that the writer takes at once, about 1 ms of work, before other threads may run."""

POLL = 0.02
"""Polling period of the queue in s: waking the writer for every message would cost both threads."""

MAX_CHANNELS = 1024
"""Most streams of one log: a dozen per board, for more boards than one host has. The limit of MCAP
is 65,535."""

TIME_END_NS = 1 << 64
"""First time, in ns since 1970, that does not fit into an MCAP file."""

REFUSALS = ("too_large", "not_bytes", "bad_name", "unknown_type", "too_many_channels", "unwritable")
"""Reasons to refuse a message for itself, regardless of the disk."""


class RecorderError(Exception):
    """The log cannot be started; the message names the remedy."""


@dataclass(frozen=True, slots=True)
class RecorderStats:
    """State of a log.

    ``state``: recording, disk_full, io_error, low_space, writer_failed or closed. ``written``:
    messages in the files. ``dropped``: lost messages by reason; their sum equals that of the gap
    records once the log is closed. ``queued``: messages not yet written. ``marked``: messages whose
    stamp a log cannot hold; they have the time of logging.
    """

    state: str
    path: str
    files: int
    written: int
    dropped: dict[str, int]
    queued: int
    bytes_written: int
    errors: int
    last_error: str
    marked: int = 0


class Recorder:
    """Writes messages to a set of MCAP files. `write`, `attach` and `metadata` never block.

    ``destination``: a ``.mcap`` file, which must not exist, or a directory, created if missing, for
    files named ``<prefix>_<UTC time>_<number>.mcap``. Raises `RecorderError` if it cannot be
    written.
    """

    def __init__(
        self,
        destination: Path | str,
        settings: RecorderSettings | None = None,
        *,
        prefix: str = "tactile",
        clock: WallClock | None = None,
        storage: Storage | None = None,
    ) -> None:
        self._settings = settings or RecorderSettings()
        self._clock = clock or WallClock.take()
        self._lock = threading.Lock()
        self._wake = threading.Event()
        self._queue: deque[Item] = deque()
        self._queued_bytes = 0
        self._closing = False
        self._channels: dict[tuple[str, str], Channel] = {}
        self._gaps = Gaps()
        self._dropped: dict[str, int] = {}
        self._marked = 0
        self._extras: list[Callable[[], None]] = []
        log_set = LogSet.at(Path(destination), prefix, self._now_ns())
        self._writer = LogWriter(log_set, self._settings, storage or DiskStorage(), self._now_ns)
        self._open(log_set, storage or DiskStorage())
        self._thread = threading.Thread(target=self._run, name="log-writer", daemon=True)
        self._thread.start()

    @property
    def stats(self) -> RecorderStats:
        """Snapshot of the counters."""
        writer = self._writer
        with self._lock:
            dropped = dict(self._dropped)
            if writer.lost:
                dropped[WRITER_FAILED] = dropped.get(WRITER_FAILED, 0) + writer.lost
            return RecorderStats(
                state=writer.state,
                path=writer.path,
                files=writer.files,
                written=writer.written,
                dropped=dropped,
                queued=len(self._queue) + writer.waiting,
                bytes_written=writer.bytes_written,
                errors=writer.errors,
                last_error=writer.last_error,
                marked=self._marked,
            )

    @property
    def trouble(self) -> str | None:
        """Why the log is incomplete; None if nothing went wrong.

        After `close` it also reports an unfinished file. Messages refused for themselves, and those
        for which a slow disk had no time, are only counted in `stats`.
        """
        stats = self.stats
        if stats.errors:
            lost = sum(
                n for why, n in stats.dropped.items() if why not in (*REFUSALS, "queue_full")
            )
            return (
                f"the log failed {stats.errors} times and misses {lost} messages, as its gap "
                f"records say; last: {stats.last_error}"
            )
        if self._closing and stats.state != "closed":
            return f"the log {stats.path} was not finished; `tactile log recover` makes it whole"
        return None

    def write(self, topic: Topic, name: str, data: bytes, log_ns: int, publish_ns: int) -> None:
        """Queue CDR bytes of ``topic``; stamps in wall-clock ns. Drops the oldest when the queue is
        full.

        An invalid message is only counted; nothing is raised.
        """
        with self._lock:
            good_ns = log_ns if _is_time(log_ns) else self._now_ns()
            channel = self._channel(topic, name)
            if not isinstance(channel, Channel):
                self._refuse(channel, topic.template, good_ns)
                return
            sequence, channel.sequence = channel.sequence, (channel.sequence + 1) & 0xFFFFFFFF
            if not isinstance(data, bytes | bytearray | memoryview):
                self._refuse("not_bytes", channel.path, good_ns)
                return
            data = bytes(data)
            if len(data) > MAX_PAYLOAD:
                self._refuse("too_large", channel.path, good_ns)
                return
            # In MCAP, a sender without a time uses that of logging.
            good_publish_ns = publish_ns if _is_time(publish_ns) else good_ns
            self._marked += good_ns != log_ns or good_publish_ns != publish_ns
            item = Item(channel, sequence, good_ns, good_publish_ns, data)
            if self._closing:
                self._drop(item, "closed")
                return
            self._queue.append(item)
            self._queued_bytes += len(data)
            while (
                len(self._queue) > self._settings.queue_messages
                or self._queued_bytes > self._settings.queue_bytes
            ):
                oldest = self._queue.popleft()
                self._queued_bytes -= len(oldest.data)
                state = self._writer.state
                self._drop(oldest, "queue_full" if state == "recording" else state)

    def _channel(self, topic: Topic, name: str) -> Channel | str:
        """Channel of a stream, or the reason why there is none; needs the lock."""
        channel = self._channels.get((topic.template, name))
        if channel is not None:
            return channel
        if len(self._channels) >= MAX_CHANNELS:
            return "too_many_channels"
        try:
            path = topic.channel(name)
        except (ValueError, TypeError):
            return "bad_name"
        try:
            message_class(topic.msgtype)
        except ValueError:
            return "unknown_type"
        channel = Channel(len(self._channels) + 1, topic, name, path)
        self._channels[topic.template, name] = channel
        return channel

    def attach(self, name: str, media_type: str, data: bytes) -> None:
        """Attach a file (calibration, configuration) to this and every later file of the log."""
        with self._lock:
            self._extras.append(lambda: self._writer.attach(name, media_type, data))

    def metadata(self, name: str, values: dict[str, str]) -> None:
        """Write a metadata table to this and every later file of the log."""
        table = dict(values)
        with self._lock:
            self._extras.append(lambda: self._writer.set_metadata(name, table))

    def close(self, timeout: float = 1.0) -> bool:
        """Write everything queued and finish the file; False if that takes longer than ``timeout``
        s.

        In that case, or on a disk error, the file may lack its summary: ``tactile log recover``
        makes it whole.
        """
        with self._lock:
            self._closing = True
        self._wake.set()
        self._thread.join(timeout)
        if self._thread.is_alive():
            log.error("log %s: still writing after %g s, not closed", self._writer.path, timeout)
        return not self._thread.is_alive() and self._writer.state == "closed"

    def _now_ns(self) -> int:
        return min(max(self._clock.wall_ns(monotonic_now()), 0), TIME_END_NS - 1)

    def _open(self, log_set: LogSet, storage: Storage) -> None:
        """Open the first file on the caller's thread, so that its errors reach the user."""
        software = {
            "name": "tactile-reach",
            "version": version("tactile-reach"),
            "clock_offset_ns": str(self._clock.offset_ns),
        }
        if self._clock.problem:
            software["clock_problem"] = self._clock.problem
        self._writer.set_metadata("software", software)
        directory = log_set.directory
        try:
            directory.mkdir(parents=True, exist_ok=True)
            free, least = storage.free(directory), self._settings.min_free_bytes
            if free < least:
                raise RecorderError(
                    f"{free / 1e9:.2f} GB free in {directory}, logs stop at {least / 1e9:.2f}: "
                    "make room, name another directory, or lower min_free_bytes"
                )
            self._writer.open_first()
        except FileExistsError as error:
            raise RecorderError(
                f"{self._writer.path} exists and is not overwritten: move it or name another file"
            ) from error
        except OSError as error:
            raise RecorderError(
                f"cannot write a log to {directory}: {error.strerror}; name a directory that this "
                "user may write to"
            ) from error

    def _drop(self, item: Item, reason: str) -> None:
        """Count a lost message; needs the lock."""
        self._refuse(reason, item.channel.path, item.log_ns)

    def _refuse(self, reason: str, path: str, log_ns: int) -> None:
        """Count a message missing from the log; needs the lock."""
        if reason in REFUSALS and reason not in self._dropped:
            log.error("log: messages of %s are refused: %s; they are counted", path, reason)
        self._dropped[reason] = self._dropped.get(reason, 0) + 1
        self._gaps.count(reason, path, log_ns)

    # The rest runs on the writer's thread.

    def _run(self) -> None:
        period = self._settings.flush_period
        next_flush = time.monotonic() + period - POLL
        while not self._closing:
            self._wake.wait(POLL)
            self._guarded(self._take)
            if time.monotonic() >= next_flush:
                self._guarded(self._writer.flush)
                next_flush = time.monotonic() + period - POLL
        self._guarded(self._drain)
        if self._marked:
            self._writer.set_metadata("stamps", {"marked": str(self._marked)})
            self._guarded(lambda: self._writer.flush(last=True))
        self._guarded(self._writer.finish)
        self._count_unwritten()

    def _guarded(self, work: Callable[[], None]) -> None:
        """Do one step; an error in it costs the data in hand, never the log."""
        try:
            work()
        except Exception as error:  # noqa: BLE001 - thread boundary: the log goes on
            self._writer.give_up(error)

    def _take(self) -> None:
        """Move the queue into the writer, in batches so that other threads can run."""
        with self._lock:
            extras, self._extras = self._extras, []
            gaps, self._gaps = self._gaps, Gaps()
        for hand_over in extras:
            hand_over()
        self._writer.gaps.merge(gaps)
        while not self._writer.blocked:
            with self._lock:
                batch = [self._queue.popleft() for _ in range(min(BATCH, len(self._queue)))]
                self._queued_bytes -= sum(len(item.data) for item in batch)
            if not batch:
                return
            for at, item in enumerate(batch):
                if self._writer.blocked:  # the next chunk must not outgrow the disk's limit
                    with self._lock:
                        self._queue.extendleft(reversed(batch[at:]))
                        self._queued_bytes += sum(len(each.data) for each in batch[at:])
                    return
                if not self._writer.add(item):
                    with self._lock:
                        self._drop(item, "unwritable")
            time.sleep(0)

    def _drain(self) -> None:
        """Write everything queued.

        A failing file gets one successor; after that the rest is lost.
        """
        failures = 0
        while failures < 2:
            self._take()
            self._writer.flush(last=True)
            if self._writer.blocked or self._writer.gaps:  # gap records still to be written
                failures += 1
                continue
            failures = 0
            with self._lock:
                if not self._queue and not self._writer.waiting:
                    return

    def _count_unwritten(self) -> None:
        """Count at the end what could not be written."""
        with self._lock:
            reason = self._writer.state
            lost = len(self._queue) + self._writer.waiting
            self._queue.clear()
            if lost:
                self._dropped[reason] = self._dropped.get(reason, 0) + lost
                log.error("log: %d messages could not be written before the end", lost)


def _is_time(value: object) -> bool:
    """Whether a time in ns fits into an MCAP record."""
    return isinstance(value, int) and 0 <= value < TIME_END_NS
