"""Writes chunks to files: opening, splitting, disk errors. Starts no thread; used by one thread."""

from __future__ import annotations

import errno
import logging
import struct
import time
import uuid
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from importlib.metadata import version
from typing import Annotated

import msgspec
import zstandard
from msgspec import Meta

from tactile_core.bus.messages import codec
from tactile_core.bus.topics import Topic
from tactile_core.config import Bytes, Count, Duration, Seconds
from tactile_core.log.mcap_file import ZSTD_LEVEL, ChunkBuffer, McapFile, SealedChunk, Storage
from tactile_core.log.retention import LogSet, enforce

# Losses as reported in a log: one metadata record ``gap`` per reason and flush.


GAP = "gap"
"""Name of these metadata records."""

DROPPED = "dropped:"
"""Prefix of the keys of a gap record that count the messages lost per channel."""


MAX_CHANNELS = 64
"""Most channels named in one gap record; losses of further ones are counted under `OTHERS`."""

OTHERS = "others"


@dataclass(slots=True)
class Gap:
    """Losses for one reason. ``first_ns`` to ``last_ns``: wall-clock span, inclusive.

    ``messages`` is 0 if writing failed but nothing was lost.
    """

    first_ns: int
    last_ns: int
    messages: int = 0
    detail: str = ""
    channels: dict[str, int] = field(default_factory=dict)

    def count(self, channel: str, messages: int) -> None:
        """Add the losses of one channel."""
        self.messages += messages
        if channel not in self.channels and len(self.channels) >= MAX_CHANNELS:
            channel = OTHERS
        self.channels[channel] = self.channels.get(channel, 0) + messages

    def cover(self, first_ns: int, last_ns: int) -> None:
        """Extend to cover another span."""
        self.first_ns = min(self.first_ns, first_ns)
        self.last_ns = max(self.last_ns, last_ns)

    def metadata(self, reason: str) -> dict[str, str]:
        """Content of the metadata record."""
        head = {
            "reason": reason,
            "first_ns": str(self.first_ns),
            "last_ns": str(self.last_ns),
            "messages": str(self.messages),
            "detail": self.detail,
        }
        return head | {f"{DROPPED}{name}": str(n) for name, n in sorted(self.channels.items())}


class Gaps:
    """Losses not yet written, one `Gap` per reason."""

    def __init__(self) -> None:
        self._gaps: dict[str, Gap] = {}

    def __len__(self) -> int:
        return len(self._gaps)

    def __iter__(self) -> Iterator[str]:
        return iter(tuple(self._gaps))

    def __getitem__(self, reason: str) -> Gap:
        return self._gaps[reason]

    def __delitem__(self, reason: str) -> None:
        del self._gaps[reason]

    def count(self, reason: str, channel: str, log_ns: int, messages: int = 1) -> None:
        """Count one or more lost messages of ``channel`` at about ``log_ns``."""
        gap = self._gaps.setdefault(reason, Gap(log_ns, log_ns))
        gap.cover(log_ns, log_ns)
        gap.count(channel, messages)

    def note(self, reason: str, detail: str, now_ns: int) -> None:
        """Note a failure at ``now_ns``, whether or not messages were lost."""
        gap = self._gaps.setdefault(reason, Gap(now_ns, now_ns))
        gap.cover(now_ns, now_ns)
        gap.detail = detail

    def merge(self, other: Gaps) -> None:
        """Add the losses of another `Gaps`."""
        for reason, gap in other._gaps.items():
            mine = self._gaps.setdefault(reason, Gap(gap.first_ns, gap.last_ns))
            mine.cover(gap.first_ns, gap.last_ns)
            mine.detail = gap.detail or mine.detail
            for channel, count in gap.channels.items():
                mine.count(channel, count)


log = logging.getLogger(__name__)

WRITER_FAILED = "writer_failed"
"""Reason of losses when writing fails for causes other than the disk."""

RETRY_MAX = 10.0
"""Longest pause in s between attempts to reopen a file."""

SYNC_PERIOD = 0.5
"""Longest time in s until data is on the disk, not only in the kernel. A `kill -9` spares what the
kernel holds; a power cut does not."""

SPACE_PERIOD = 1.0
"""Interval in s of checks of the free space: a dozen boards log some 10 MB in that time."""

LATCHED_MAX = 64
"""Most latched messages repeated in each file: one geometry per board, for more boards than one
host has."""


class RecorderSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """``[log.recorder]``: how logs are cut, kept and bounded."""

    split_bytes: Annotated[
        Bytes, Meta(gt=0, description="a new file begins when the current one is larger")
    ] = 1 << 30
    split_seconds: Annotated[
        Duration, Meta(description="a new file begins when the current one is older")
    ] = 3600.0
    min_free_bytes: Annotated[
        Bytes, Meta(ge=0, description="logging stops with an error when less is free on the disk")
    ] = 1 << 30
    max_files: Annotated[
        Count | None,
        Meta(description="most files of a name, the oldest are deleted; default: all are kept"),
    ] = None
    max_bytes: Annotated[
        Annotated[Bytes, Meta(gt=0)] | None,
        Meta(description="most bytes of all files of a name, the oldest are deleted"),
    ] = None
    flush_period: Annotated[
        Seconds,
        Meta(
            gt=0, le=0.5, description="longest time lost to `kill -9`, plus the time of one write"
        ),
    ] = 0.25
    chunk_bytes: Annotated[
        Bytes, Meta(gt=0, description="a larger chunk is written before the flush period ends")
    ] = 1 << 20
    queue_messages: Annotated[
        Count,
        Meta(description="messages that may be queued; default: 27 s of one board at 100 Hz"),
    ] = 16384
    queue_bytes: Annotated[Bytes, Meta(gt=0, description="bytes that may be queued")] = 64 << 20
    retry_seconds: Annotated[
        Duration, Meta(description="first pause before a failed file is opened again")
    ] = 1.0


@dataclass(slots=True, eq=False)
class Channel:
    """One stream of a log. ``sequence``: number of the next message."""

    number: int
    topic: Topic
    name: str
    path: str
    sequence: int = 0


@dataclass(frozen=True, slots=True)
class Item:
    """One message to be logged; stamps in wall-clock ns."""

    channel: Channel
    sequence: int
    log_ns: int
    publish_ns: int
    data: bytes


class LogWriter:
    """Writer of the files of one log.

    If a file cannot be continued, the chunk in hand is kept for the next file, which begins with a
    gap record; `blocked` tells so, and the caller must hold back the rest. Any other error costs
    the data in hand, which is counted, and the next file begins.
    """

    def __init__(
        self,
        log_set: LogSet,
        settings: RecorderSettings,
        storage: Storage,
        now_ns: Callable[[], int],
    ) -> None:
        codec()  # takes 0.2 s once: do it now rather than at the first flush
        self.state = "recording"
        self.last_error = ""
        self.errors = 0
        self.written = 0
        self.files = 0
        self.lost = 0
        """Messages counted in ``gaps`` by this class, for `WRITER_FAILED`."""
        self.gaps = Gaps()
        self._set = log_set
        self._settings = settings
        self._storage = storage
        self._now_ns = now_ns
        self._identity = uuid.uuid4().hex
        self._bytes = 0
        self._compressor = zstandard.ZstdCompressor(level=ZSTD_LEVEL)
        self._chunk = ChunkBuffer()
        self._pending: SealedChunk | None = None
        self._latched: dict[int, Item] = {}
        self._new_latched: dict[int, Item] = {}
        self._channels: dict[int, Channel] = {}
        self._extras: dict[tuple[str, str], Callable[[McapFile], None]] = {}
        self._unwritten: dict[tuple[str, str], None] = {}  # in order of arrival
        self._schemas: dict[str, int] = {}
        self._in_file: set[int] = set()
        self._file: McapFile | None = None
        self._opened = 0.0
        self._synced = 0.0
        self._space_checked = 0.0
        self._retry_at = 0.0
        self._retry_pause = settings.retry_seconds

    @property
    def blocked(self) -> bool:
        """Whether a chunk waits for a writable file."""
        return self._pending is not None

    @property
    def waiting(self) -> int:
        """Messages accepted but not yet on the disk."""
        return self._chunk.messages + (self._pending.messages if self._pending else 0)

    @property
    def path(self) -> str:
        """Current file, or the next one if none is open."""
        return str(self._set.current)

    @property
    def bytes_written(self) -> int:
        """Bytes of all files so far, without the summaries of finished ones."""
        return self._bytes + (self._file.size if self._file else 0)

    def set_metadata(self, name: str, values: dict[str, str]) -> None:
        """Set a metadata table for this and every later file."""
        self._extras["metadata", name] = lambda file: file.add_metadata(name, values)
        self._unwritten["metadata", name] = None

    def attach(self, name: str, media_type: str, data: bytes) -> None:
        """Attach a file to this and every later file."""
        now_ns = self._now_ns()
        self._extras["attachment", name] = lambda file: file.add_attachment(
            name, media_type, data, now_ns, now_ns
        )
        self._unwritten["attachment", name] = None

    def open_first(self) -> None:
        """Open the first file. Raises OSError on failure.

        FileExistsError means that the user named an existing file; files in a directory get the
        next free number, as another daemon may have started in the same second.
        """
        while True:
            try:
                self._open()
                break
            except FileExistsError:
                if self._set.named:
                    raise
                self._set.advance()
        enforce(self._set, self._settings.max_files, self._settings.max_bytes)

    def add(self, item: Item) -> bool:
        """Add one message to the next chunk; flushes when that is full.

        Returns False, and does nothing else, for a message that does not fit into a record.
        """
        channel = item.channel
        try:
            self._chunk.add(channel.number, item.sequence, item.log_ns, item.publish_ns, item.data)
        except (struct.error, OverflowError, TypeError, ValueError):
            return False
        self._channels[channel.number] = channel
        if channel.topic.latched and (
            channel.number in self._latched or len(self._latched) < LATCHED_MAX
        ):
            self._new_latched[channel.number] = item
        if len(self._chunk.data) >= self._settings.chunk_bytes:
            self.flush()
        return True

    def flush(self, last: bool = False) -> None:
        """Write everything pending. ``last``: try at once, without the pause after a failure."""
        try:
            if self._pending is None and self._chunk.messages:
                self._pending = self._chunk.seal(self._compressor)
                self._chunk = ChunkBuffer()
            if self._ready(last):
                self._write_pending()
        except OSError as error:
            self._fail(error)
        except Exception as error:  # noqa: BLE001 - any error: the log continues without this
            self.give_up(error)

    def give_up(self, error: Exception) -> None:
        """Count the data in hand as lost, leave the file, and continue with the next one."""
        now_ns = self._now_ns()
        counts = {c: len(times) // 2 for c, times in self._chunk.index.items()}
        for held in (counts, self._pending.counts if self._pending else {}):
            for number, messages in held.items():
                channel = self._channels.get(number)
                name = "unknown" if channel is None else channel.path
                self.gaps.count(WRITER_FAILED, name, now_ns, messages)
                self.lost += messages
        self._pending, self._chunk, self._new_latched = None, ChunkBuffer(), {}
        if self._file is not None:
            self._file.forget()
        log.error("log: the writer failed", exc_info=error)
        self._leave_file(
            WRITER_FAILED, f"{type(error).__name__}: {error}", "going on in another file"
        )

    def finish(self) -> None:
        """Finish the file after the last flush; ``state`` becomes closed unless this fails."""
        try:
            self._end_file()
        except OSError as error:
            self._fail(error)
        except Exception as error:  # noqa: BLE001 - any error must be reported
            self.give_up(error)
        if not self.waiting and self.state == "recording":
            self.state = "closed"

    def _ready(self, last: bool) -> bool:
        """Whether there is a file with room for the pending data; ends and opens files."""
        now = time.monotonic()
        if self._file is None and now < self._retry_at and not last:
            return False
        if now - self._space_checked >= SPACE_PERIOD or self._file is None:
            self._space_checked = now
            if self._file is not None and not self._file.path.exists():
                raise OSError(errno.ENOENT, "it was deleted or moved while it was written")
            if self._storage.free(self._set.directory) < self._settings.min_free_bytes:
                self._stop_for_space()
                return False
        size = len(self._pending.data) if self._pending else 0
        file = self._file
        if file is not None and (
            now - self._opened >= self._settings.split_seconds
            or (file.messages and file.size + size > self._settings.split_bytes)
        ):
            self._end_file()
            self._set.advance()
        if self._file is None and (self._pending is not None or self.gaps):
            self._open_next()
        return self._file is not None

    def _open_next(self) -> None:
        self._set.directory.mkdir(parents=True, exist_ok=True)  # it may have been deleted as well
        while True:
            try:
                self._open()
                break
            except FileExistsError:
                self._set.advance()
        if self.state != "recording":
            log.warning("log: writing again, to %s", self.path)
        self.state = "recording"
        self._retry_pause = self._settings.retry_seconds
        self._repeat_latched()
        enforce(self._set, self._settings.max_files, self._settings.max_bytes)

    def _open(self) -> None:
        """Open the current file of the set and write the start that every file has."""
        file = McapFile(
            self._set.current, self._storage, f"tactile-reach {version('tactile-reach')}"
        )
        try:
            started_ns = str(self._now_ns())
            place = {"set": self._identity, "file": str(self.files), "started_ns": started_ns}
            file.add_metadata("file", place)
            for extra in tuple(self._extras):
                self._write_extra(extra, file)
            self._in_file = set()
            self._define(file, self._channels)
            file.commit()
            file.sync()
        except Exception:  # of any kind: a file begun must not stay open
            file.abandon()
            raise
        self._in_file = set(self._channels)
        self._unwritten.clear()
        self._file = file
        self._opened = time.monotonic()
        self.files += 1

    def _write_pending(self) -> None:
        """Write everything pending at once: fewer calls keep other threads waiting less."""
        file, pending = self._file, self._pending
        if file is None:
            return
        for extra in tuple(self._unwritten):
            self._write_extra(extra, file)
        for reason in self.gaps:
            file.add_metadata(GAP, self.gaps[reason].metadata(reason))
        if pending is not None:
            self._define(file, pending.counts)
            file.add_chunk(pending)
        file.commit()
        self._unwritten.clear()
        self.gaps = Gaps()
        if pending is not None:
            self._in_file |= pending.counts.keys()
            self.written += pending.messages
            self._pending = None
            self._latched |= self._new_latched
            self._new_latched = {}
        now = time.monotonic()
        if now + self._settings.flush_period - self._synced > SYNC_PERIOD:
            file.sync()
            self._synced = now

    def _write_extra(self, extra: tuple[str, str], file: McapFile) -> None:
        """Stage a table or an attachment; one that fails is never tried again."""
        write = self._extras.get(extra)
        if write is None:
            return
        try:
            write(file)
        except Exception as error:  # noqa: BLE001 - one table must not keep every file from opening
            del self._extras[extra]
            self.errors += 1
            self.last_error = f"the {extra[0]} {extra[1]!r} cannot be written: {error}"
            log.error("log: %s", self.last_error)

    def _define(self, file: McapFile, numbers: Iterable[int]) -> None:
        """Stage the schemas and channels that this file lacks."""
        types = {self._channels[number].topic.msgtype for number in self._in_file}
        for number in numbers:
            if number in self._in_file:
                continue
            channel = self._channels[number]
            schema = codec().schema(channel.topic)
            identity = self._schemas.setdefault(schema.name, len(self._schemas) + 1)
            if schema.name not in types:
                file.add_schema(identity, schema.name, schema.encoding, schema.data)
                types.add(schema.name)
            # rosbag2 writes both keys.
            metadata = {"offered_qos_profiles": "", "topic_type_hash": schema.type_hash}
            file.add_channel(number, identity, channel.path, "cdr", metadata)

    def _repeat_latched(self) -> None:
        """Repeat the latched messages in a new file, with their old numbers so as to show no
        gap."""
        if self._file is None or self._pending is None or not self._latched:
            return
        chunk = ChunkBuffer()
        for number, item in self._latched.items():
            chunk.add(number, item.sequence, self._pending.start_ns, item.publish_ns, item.data)
        self._file.add_chunk(chunk.seal(self._compressor))
        self._file.commit()

    def _end_file(self) -> None:
        file, self._file = self._file, None
        if file is not None:
            self._bytes += file.size
            file.finish()

    def _fail(self, error: OSError) -> None:
        """Leave a file that cannot be continued, and try another one later."""
        full = error.errno in (errno.ENOSPC, errno.EDQUOT)
        remedy = "make room" if full else "check the disk; trying another file"
        self._leave_file(
            "disk_full" if full else "io_error", f"{self.path}: {error.strerror or error}", remedy
        )

    def _stop_for_space(self) -> None:
        """Close the file while there is room to close it in order."""
        free = self._storage.free(self._set.directory) / 1e9
        kept = self._settings.min_free_bytes / 1e9
        text = f"{free:.2f} GB free in {self._set.directory}, logs stop at {kept:.2f}"
        self._leave_file("low_space", text, "make room")

    def _leave_file(self, reason: str, text: str, remedy: str) -> None:
        if self.state != reason:
            log.error("log: %s; %s", text, remedy)
        self.state, self.last_error = reason, text
        self.errors += 1
        self.gaps.note(reason, text, self._now_ns())
        try:
            if self._file is not None:
                self._end_file()
        except OSError as error:
            log.error("log: %s is left without a summary: %s", self.path, error.strerror)
        except Exception as error:  # noqa: BLE001 - the file is closed; the next one must begin
            log.error("log: %s is left without a summary: %s", self.path, error)
        self._set.advance()
        self._retry_at = time.monotonic() + self._retry_pause
        self._retry_pause = min(self._retry_pause * 2, RETRY_MAX)
