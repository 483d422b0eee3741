"""Writer of one MCAP file; each record is written completely or not at all.

Layout: https://mcap.dev/spec. The writer of the ``mcap`` package is not used because its index
consists of objects that grow with the log, it takes four times as long per message while holding
the interpreter lock, and it leaves a partial record when the disk is full.
"""

from __future__ import annotations

import errno
import fcntl
import os
import struct
import tempfile
import zlib
from array import array
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Protocol

import zstandard

MAGIC = b"\x89MCAP0\r\n"

HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, CHUNK_INDEX = range(1, 9)
ATTACHMENT, ATTACHMENT_INDEX, STATISTICS, METADATA, METADATA_INDEX = range(9, 14)
SUMMARY_OFFSET, DATA_END = 14, 15

RECORD = struct.Struct("<BQ")
MESSAGE_HEAD = struct.Struct("<BQHIQQ")
MESSAGE_FIXED = 22  # bytes of a message record before its payload
CHUNK_HEAD = struct.Struct("<QQQI")

ZSTD_LEVEL = 1
"""Takes little more than half the time of level 3 and compresses taxel data as well."""

INDEX_BYTES = 1 << 20
"""Bytes of the chunk index that are held in memory; two thousand chunks of forty channels."""

PIECE = 1 << 16
"""Bytes of the index that are read back at once."""


class Storage(Protocol):
    """File-system calls of a log; tests replace them to simulate a full disk."""

    def open(self, path: Path) -> int:
        """Create ``path`` for writing and lock it. Raises FileExistsError if it exists."""

    def write(self, fd: int, data: bytes | memoryview) -> int:
        """Append data and return how many bytes were written."""

    def sync(self, fd: int) -> None:
        """Ensure that everything written so far survives a power cut."""

    def truncate(self, fd: int, size: int) -> None:
        """Truncate the file to ``size`` bytes and continue writing there."""

    def close(self, fd: int) -> None:
        """Release the file and its lock."""

    def free(self, directory: Path) -> int:
        """Bytes available on the file system of ``directory``."""


class DiskStorage:
    """`Storage` on the real file system."""

    def open(self, path: Path) -> int:
        """Create ``path``; its lock tells others (retention) that it is being written."""
        fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
        try:
            fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            if error.errno not in (errno.ENOLCK, errno.EOPNOTSUPP):  # some network mounts
                os.close(fd)
                raise
        return fd

    def write(self, fd: int, data: bytes | memoryview) -> int:
        """Write to the file; other threads can run meanwhile."""
        return os.write(fd, data)

    def sync(self, fd: int) -> None:
        """Write the data, and the metadata needed to read it, to the disk."""
        os.fdatasync(fd)

    def truncate(self, fd: int, size: int) -> None:
        """Truncate the file and set the position."""
        os.ftruncate(fd, size)
        os.lseek(fd, size, os.SEEK_SET)

    def close(self, fd: int) -> None:
        """Close the descriptor."""
        os.close(fd)

    def free(self, directory: Path) -> int:
        """Bytes free to unprivileged users."""
        status = os.statvfs(directory)
        return status.f_bavail * status.f_frsize


def _string(text: str) -> bytes:
    # A file name may contain characters that UTF-8 cannot encode.
    data = text.encode("utf-8", "backslashreplace")
    return struct.pack("<I", len(data)) + data


def _map(values: Mapping[str, str]) -> bytes:
    data = b"".join(_string(key) + _string(value) for key, value in values.items())
    return struct.pack("<I", len(data)) + data


def _record(opcode: int, body: bytes) -> bytes:
    return RECORD.pack(opcode, len(body)) + body


class ChunkBuffer:
    """Messages of the next chunk, in final form except for compression."""

    __slots__ = ("data", "end_ns", "index", "messages", "start_ns")

    def __init__(self) -> None:
        self.data = bytearray()
        self.index: dict[int, array[int]] = {}
        self.messages = 0
        self.start_ns = 0
        self.end_ns = 0

    def add(self, channel: int, sequence: int, log_ns: int, publish_ns: int, data: bytes) -> None:
        """Append one message; channel ids and sequence numbers as in the MCAP records.

        Raises struct.error, and appends nothing, for numbers that do not fit into a record.
        """
        size = MESSAGE_FIXED + len(data)
        head = MESSAGE_HEAD.pack(MESSAGE, size, channel, sequence, log_ns, publish_ns)
        times = self.index.get(channel)
        if times is None:
            times = self.index[channel] = array("Q")
        times.append(log_ns)
        times.append(len(self.data))
        if not self.messages:
            self.start_ns = self.end_ns = log_ns
        elif log_ns > self.end_ns:
            self.end_ns = log_ns
        elif log_ns < self.start_ns:
            self.start_ns = log_ns
        self.messages += 1
        self.data += head
        self.data += data

    def seal(self, compressor: zstandard.ZstdCompressor) -> SealedChunk:
        """Compress (other threads can run meanwhile) and add the message indexes."""
        return self._sealed(compressor.compress(self.data), len(self.data), zlib.crc32(self.data))

    @classmethod
    def copy(
        cls, compressed: bytes, size: int, crc: int, index: dict[int, array[int]]
    ) -> SealedChunk:
        """Make a chunk of messages that are compressed already, as one zstd frame.

        ``size``, ``crc``: of the messages. ``index``: by channel, alternately the log time of a
        message and its place; not empty.
        """
        chunk = cls()
        chunk.index = index
        chunk.messages = sum(len(times) for times in index.values()) // 2
        chunk.start_ns = min(min(times[::2]) for times in index.values())
        chunk.end_ns = max(max(times[::2]) for times in index.values())
        return chunk._sealed(compressed, size, crc)

    def _sealed(self, compressed: bytes, size: int, crc: int) -> SealedChunk:
        body = (
            CHUNK_HEAD.pack(self.start_ns, self.end_ns, size, crc)
            + _string("zstd")
            + struct.pack("<Q", len(compressed))
        )
        head = RECORD.pack(CHUNK, len(body) + len(compressed)) + body
        parts = [head, compressed]
        length = len(head) + len(compressed)
        offsets, at = {}, length
        for channel, times in self.index.items():
            raw = times.tobytes()
            index = struct.pack("<HI", channel, len(raw)) + raw
            record = _record(MESSAGE_INDEX, index)
            offsets[channel] = at
            at += len(record)
            parts.append(record)
        return SealedChunk(
            data=b"".join(parts),
            chunk_length=length,
            index_offsets=offsets,
            counts={channel: len(times) // 2 for channel, times in self.index.items()},
            messages=self.messages,
            start_ns=self.start_ns,
            end_ns=self.end_ns,
            compression="zstd",
            compressed_size=len(compressed),
            uncompressed_size=size,
        )


@dataclass(frozen=True, slots=True)
class SealedChunk:
    """A chunk record with its message indexes, which may be written at any place in a file."""

    data: bytes
    chunk_length: int
    index_offsets: dict[int, int]
    counts: dict[int, int]
    messages: int
    start_ns: int
    end_ns: int
    compression: str
    compressed_size: int
    uncompressed_size: int


class ChunkIndex:
    """Chunk index records of a file, past INDEX_BYTES in an unnamed file in ``folder``.

    The index takes ten bytes per chunk and channel, so in memory it would grow with the log.
    """

    __slots__ = ("_file", "_folder", "_held", "_limit", "_stored", "size")

    def __init__(self, folder: Path) -> None:
        self.size = 0
        self._folder = folder
        self._held = bytearray()
        self._limit = INDEX_BYTES
        self._file: IO[bytes] | None = None
        self._stored = 0

    def add(self, record: bytes) -> None:
        """Append a record. Never fails: what the disk does not take stays in memory."""
        self._held += record
        self.size += len(record)
        if len(self._held) >= self._limit:
            self._store()

    def pieces(self) -> Iterator[bytes]:
        """Yield all records in order. Raises OSError where the disk cannot be read."""
        if self._file is not None:
            for at in range(0, self._stored, PIECE):
                self._file.seek(at)
                size = min(PIECE, self._stored - at)
                piece = self._file.read(size)
                if len(piece) < size:
                    raise OSError(errno.EIO, "the index of the chunks cannot be read again")
                yield piece
        for at in range(0, len(self._held), PIECE):
            yield bytes(self._held[at : at + PIECE])

    def close(self) -> None:
        """Remove the file, if there is one."""
        if self._file is not None:
            self._file.close()
            self._file = None

    def _store(self) -> None:
        try:
            if self._file is None:
                self._file = tempfile.TemporaryFile(  # noqa: SIM115 - closed by close()
                    dir=self._folder, buffering=0
                )
            self._file.seek(self._stored)
            left = memoryview(self._held)
            while left:
                left = left[self._file.write(left) :]
        except OSError:
            self._limit = 2 * len(self._held)  # not with every chunk
            return
        self._stored += len(self._held)
        self._held = bytearray()


class McapFile:
    """Writer of one file: ``add_*`` stage records; `commit` writes all of them or none."""

    def __init__(self, path: Path, storage: Storage, library: str, profile: str = "ros2") -> None:
        """Create the file and write its start. Raises OSError (FileExistsError) on failure."""
        self.path = path
        self.size = 0
        self.messages = 0
        self._storage = storage
        self._staged: list[tuple[bytes, Callable[[int], None]]] = []
        self._schemas: list[bytes] = []
        self._channels: list[bytes] = []
        self._chunk_index = ChunkIndex(path.parent)
        self._attachment_index: list[bytes] = []
        self._metadata_index: list[bytes] = []
        self._counts: dict[int, int] = {}
        self._chunks = 0
        self._start_ns = 0
        self._end_ns = 0
        self._dirty = True
        self._fd = storage.open(path)
        try:
            self._put(MAGIC + _record(HEADER, _string(profile) + _string(library)))
        except OSError:
            storage.close(self._fd)
            raise

    def add_schema(self, schema: int, name: str, encoding: str, data: bytes) -> None:
        """Stage a schema under the id ``schema`` (1 and up)."""
        body = struct.pack("<H", schema) + _string(name) + _string(encoding)
        record = _record(SCHEMA, body + struct.pack("<I", len(data)) + data)
        self._stage(record, lambda _: self._schemas.append(record))

    def add_channel(
        self, channel: int, schema: int, topic: str, encoding: str, metadata: Mapping[str, str]
    ) -> None:
        """Stage a channel under the id ``channel``; its schema must be staged before it."""
        body = struct.pack("<HH", channel, schema) + _string(topic) + _string(encoding)
        record = _record(CHANNEL, body + _map(metadata))
        self._stage(record, lambda _: self._channels.append(record))

    def add_metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Stage a metadata table."""
        record = _record(METADATA, _string(name) + _map(values))

        def note(offset: int) -> None:
            index = struct.pack("<QQ", offset, len(record)) + _string(name)
            self._metadata_index.append(_record(METADATA_INDEX, index))

        self._stage(record, note)

    def add_attachment(
        self, name: str, media_type: str, data: bytes, log_ns: int, create_ns: int
    ) -> None:
        """Stage an attachment."""
        body = struct.pack("<QQ", log_ns, create_ns) + _string(name) + _string(media_type)
        body += struct.pack("<Q", len(data)) + data
        record = _record(ATTACHMENT, body + struct.pack("<I", zlib.crc32(body)))
        times_and_size = log_ns, create_ns, len(data)

        def note(offset: int) -> None:
            index = struct.pack("<QQQQQ", offset, len(record), *times_and_size)
            index += _string(name) + _string(media_type)
            self._attachment_index.append(_record(ATTACHMENT_INDEX, index))

        self._stage(record, note)

    def copy_attachment(
        self,
        name: str,
        media_type: str,
        size: int,
        pieces: Iterable[bytes],
        log_ns: int,
        create_ns: int,
    ) -> None:
        """Write an attachment directly, piece by piece, after what is staged.

        After an OSError, or an error of ``pieces``, nothing of it remains in the file.
        """
        self.commit()
        start = self.size
        body = struct.pack("<QQ", log_ns, create_ns) + _string(name) + _string(media_type)
        body += struct.pack("<Q", size)
        length = len(body) + size + 4
        try:
            self._put(RECORD.pack(ATTACHMENT, length) + body)
            crc, left = zlib.crc32(body), size
            for piece in pieces:
                self._put(piece)
                crc, left = zlib.crc32(piece, crc), left - len(piece)
            if left:
                raise OSError(errno.EIO, f"{left} bytes of attachment {name!r} are missing")
            self._put(struct.pack("<I", crc))
        except BaseException:
            self._storage.truncate(self._fd, start)
            self.size = start
            raise
        index = struct.pack("<QQQQQ", start, 9 + length, log_ns, create_ns, size)
        index += _string(name) + _string(media_type)
        self._attachment_index.append(_record(ATTACHMENT_INDEX, index))

    def add_chunk(self, chunk: SealedChunk) -> None:
        """Stage a chunk and its indexes; its channels must be staged before it."""
        self._stage(chunk.data, lambda offset: self._note_chunk(chunk, offset))

    def commit(self) -> None:
        """Write everything staged at once. After an OSError nothing of it is in the file."""
        staged, self._staged = self._staged, []
        offset = self.size
        self._put(b"".join(record for record, _ in staged))
        for record, note in staged:
            note(offset)
            offset += len(record)

    def sync(self) -> None:
        """Ensure that everything written survives a power cut."""
        if self._dirty:
            self._storage.sync(self._fd)
            self._dirty = False

    def finish(self) -> None:
        """Commit, write the summary and close.

        After an OSError the file is closed without a summary.
        """
        try:
            self.commit()
            self._put_summary()
            self.sync()
        finally:
            self.abandon()

    def forget(self) -> None:
        """Discard everything staged but not committed."""
        self._staged = []

    def abandon(self) -> None:
        """Close without a summary: every record so far stays readable."""
        self._chunk_index.close()
        self._storage.close(self._fd)

    def _stage(self, record: bytes, note: Callable[[int], None]) -> None:
        """Stage a record; `commit` calls ``note`` with its offset once it is written."""
        self._staged.append((record, note))

    def _note_chunk(self, chunk: SealedChunk, offset: int) -> None:
        """Add a chunk written at ``offset`` to the summary."""
        if not self.messages:
            self._start_ns, self._end_ns = chunk.start_ns, chunk.end_ns
        self._start_ns = min(self._start_ns, chunk.start_ns)
        self._end_ns = max(self._end_ns, chunk.end_ns)
        self._chunks += 1
        self.messages += chunk.messages
        for channel, count in chunk.counts.items():
            self._counts[channel] = self._counts.get(channel, 0) + count
        head = (chunk.start_ns, chunk.end_ns, offset, chunk.chunk_length)
        offsets = b"".join(
            struct.pack("<HQ", channel, offset + at) for channel, at in chunk.index_offsets.items()
        )
        body = struct.pack("<QQQQI", *head, len(offsets)) + offsets
        body += struct.pack("<Q", len(chunk.data) - chunk.chunk_length)
        body += _string(chunk.compression)
        body += struct.pack("<QQ", chunk.compressed_size, chunk.uncompressed_size)
        self._chunk_index.add(_record(CHUNK_INDEX, body))

    def _put(self, data: bytes) -> None:
        """Append all of ``data``, or truncate the file back and raise OSError."""
        if not data:
            return
        left = memoryview(data)
        self._dirty = True
        try:
            while left:
                taken = self._storage.write(self._fd, left)
                if taken <= 0:
                    raise OSError(errno.EIO, "the file system takes no bytes")
                left = left[taken:]
        except OSError:
            if len(left) < len(data):
                self._storage.truncate(self._fd, self.size)
            raise
        self.size += len(data)

    def _put_summary(self) -> None:
        """Append the summary piece by piece, or truncate the file back and raise OSError."""
        start = self.size
        try:
            for piece in self._summary():
                self._put(piece)
        except OSError:
            if self.size > start:
                self._storage.truncate(self._fd, start)
                self.size = start
            raise

    def _summary(self) -> Iterator[bytes]:
        """Everything after the data: end mark, summary, its offsets, footer, magic."""
        end = _record(DATA_END, struct.pack("<I", 0))
        start = at = self.size + len(end)
        yield end
        counts = b"".join(struct.pack("<HQ", c, n) for c, n in sorted(self._counts.items()))
        statistics = struct.pack(
            "<QHIIIIQQI",
            self.messages,
            len(self._schemas),
            len(self._channels),
            len(self._attachment_index),
            len(self._metadata_index),
            self._chunks,
            self._start_ns,
            self._end_ns,
            len(counts),
        )
        groups: tuple[tuple[int, Iterable[bytes]], ...] = (
            (SCHEMA, self._schemas),
            (CHANNEL, self._channels),
            (STATISTICS, [_record(STATISTICS, statistics + counts)]),
            (CHUNK_INDEX, self._chunk_index.pieces()),
            (ATTACHMENT_INDEX, self._attachment_index),
            (METADATA_INDEX, self._metadata_index),
        )
        offsets, crc = bytearray(), 0
        for opcode, pieces in groups:
            size = 0
            for piece in pieces:
                crc, size = zlib.crc32(piece, crc), size + len(piece)
                yield piece
            if size:
                offsets += _record(SUMMARY_OFFSET, struct.pack("<BQQ", opcode, at, size))
                at += size
        footer = struct.pack("<QQ", start, at)
        rest = bytes(offsets) + RECORD.pack(FOOTER, len(footer) + 4) + footer
        yield rest + struct.pack("<I", zlib.crc32(rest, crc)) + MAGIC
