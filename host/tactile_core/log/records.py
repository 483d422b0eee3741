"""Records and chunks of a log: parsing, searching, decompressing. Bounded memory.

Small chunks are decompressed at once, large or doubtful ones piece by piece. The size stated in a
chunk is never trusted: nothing beyond it is decompressed, and no memory is allocated in advance.
"""

from __future__ import annotations

import os
import re
import stat
import struct
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import zstandard

from tactile_core.log import mcap_file as op

# Elements of a log and the parsing of their records. Pure: bytes in, values out.
#
# A record may be longer than its fields: later versions of the format append fields, which readers
# ignore.


U16 = struct.Struct("<H")
U32 = struct.Struct("<I")
U64 = struct.Struct("<Q")
CHANNEL_HEAD = struct.Struct("<HH")
ATTACHMENT_HEAD = struct.Struct("<QQ")


class LogError(Exception):
    """The file is not a log or cannot be read; the message says which."""


@dataclass(frozen=True, slots=True)
class SchemaRecord:
    """Definition of a message type."""

    number: int
    name: str
    encoding: str
    data: bytes


@dataclass(frozen=True, slots=True)
class ChannelRecord:
    """One stream. ``schema``: number of its schema, 0 if none."""

    number: int
    schema: int
    topic: str
    encoding: str
    metadata: dict[str, str]


@dataclass(frozen=True, slots=True)
class MetadataRecord:
    """A metadata table."""

    name: str
    values: dict[str, str]


@dataclass(frozen=True, slots=True)
class AttachmentRecord:
    """An attachment; its ``size`` bytes start at ``position``."""

    name: str
    media_type: str
    log_ns: int
    create_ns: int
    position: int
    size: int


@dataclass(frozen=True, slots=True)
class ChunkHead:
    """Fields of a chunk record before its data. ``size``, ``crc``: of the decompressed data."""

    start_ns: int
    end_ns: int
    size: int
    crc: int
    compression: str
    data_length: int


@dataclass(frozen=True, slots=True)
class Packed:
    """Place of a chunk's compressed bytes, for decompression piece by piece."""

    head: ChunkHead
    place: int
    length: int


@dataclass(frozen=True, slots=True)
class Block:
    """A run of message, schema and channel records: ``data``, or ``packed`` if large.

    ``verified``: its checksum was right. ``partial``: its end is missing, which was reported.
    ``suspect``: its checksum is wrong, but it is read nevertheless. ``frame``: ``data``
    as it is in the file, if that is one zstd frame and nothing else, so that it can be copied as it
    is; else empty. ``crc``: checksum of ``data``, 0 if none.
    """

    offset: int
    data: bytes
    verified: bool
    packed: Packed | None = None
    partial: bool = False
    suspect: bool = False
    frame: bytes = b""
    crc: int = 0


@dataclass(frozen=True, slots=True)
class Damage:
    """Unreadable bytes. ``messages``: number of messages lost there, None if unknown."""

    offset: int
    length: int
    reason: str
    messages: int | None = None
    first_ns: int | None = None
    last_ns: int | None = None


class Message(NamedTuple):
    """One message of a log; stamps in wall-clock ns."""

    channel: int
    sequence: int
    log_ns: int
    publish_ns: int
    data: bytes


Event = Block | MetadataRecord | AttachmentRecord


class BadRecordError(Exception):
    """An invalid record; caught within the reader."""


@dataclass(slots=True)
class Cursor:
    """Reads the fields of a record one after another."""

    data: bytes
    at: int = 0

    def take(self, layout: struct.Struct) -> tuple[int, ...]:
        """Read numbers of a fixed layout."""
        try:
            values = layout.unpack_from(self.data, self.at)
        except struct.error:
            raise BadRecordError("a record is shorter than its fields") from None
        self.at += layout.size
        return values

    def bytes(self, size: int) -> bytes:
        """Read the next ``size`` bytes."""
        if size > len(self.data) - self.at:
            raise BadRecordError("a record is shorter than its fields")
        self.at += size
        return self.data[self.at - size : self.at]

    def string(self) -> str:
        """Read a text preceded by its length."""
        try:
            return self.bytes(*self.take(U32)).decode()
        except UnicodeDecodeError:
            raise BadRecordError("a text is not UTF-8") from None

    def map(self) -> dict[str, str]:
        """Read a table of texts preceded by its length."""
        (size,) = self.take(U32)
        end = self.at + size
        found = {}
        while self.at < end:
            key = self.string()
            found[key] = self.string()
        if self.at != end:
            raise BadRecordError("a table is longer than it says")
        return found


def parse_schema(body: bytes) -> SchemaRecord:
    """Parse a schema record. Raises BadRecordError if it is invalid."""
    cursor = Cursor(body)
    (number,) = cursor.take(U16)
    name, encoding = cursor.string(), cursor.string()
    return SchemaRecord(number, name, encoding, cursor.bytes(*cursor.take(U32)))


def parse_channel(body: bytes) -> ChannelRecord:
    """Parse a channel record. Raises BadRecordError if it is invalid."""
    cursor = Cursor(body)
    number, schema = cursor.take(CHANNEL_HEAD)
    topic, encoding = cursor.string(), cursor.string()
    return ChannelRecord(number, schema, topic, encoding, cursor.map())


def parse_metadata(body: bytes) -> MetadataRecord:
    """Parse a metadata record. Raises BadRecordError if it is invalid."""
    cursor = Cursor(body)
    return MetadataRecord(cursor.string(), cursor.map())


# Random access to the bytes of a log, and the search for chunks.


Progress = Callable[[int, int], None]
"""Called with the bytes done and the total."""

WINDOW = 1 << 20
"""Bytes read at once in the search for the next chunk."""

CHUNK_START = re.compile(rb"(?=\x06.{4}\x00{4})", re.DOTALL)
RECORD_START = re.compile(rb"(?=[\x03-\x05\x0f].{4}\x00{4})", re.DOTALL)
"""Of a schema, a channel, a message or the end mark."""
CHUNK_FIXED = 40  # bytes of a chunk record without the name of its compression and its data
MAX_NAME = 40  # bytes read of that name and the size after it

FRAME_STARTS = {"zstd": b"\x28\xb5\x2f\xfd", "lz4": b"\x04\x22\x4d\x18"}


class LogBytes:
    """Random access to a log. ``end``: end of its data, for searches."""

    def __init__(self, path: Path, progress: Progress | None) -> None:
        self.path = path
        self.size = 0
        self.end = 0
        self._progress = progress
        self._file: BinaryIO | None = None
        self._no_chunk_from = 1 << 64

    def open(self) -> None:
        """Open the file. Raises `LogError` if it is not a file or cannot be read."""
        try:
            if not stat.S_ISREG(os.stat(self.path).st_mode) and not self.path.is_dir():
                raise LogError(f"{self.path} is a device or a pipe, not a file")
            self._file = open(self.path, "rb")  # noqa: SIM115 - closed by close()
            self.size = self.end = os.fstat(self._file.fileno()).st_size
        except OSError as error:
            raise LogError(f"{self.path}: {error.strerror}") from error

    def close(self) -> None:
        """Close the file."""
        if self._file is not None:
            self._file.close()

    def read_at(self, position: int, size: int) -> bytes:
        """Read bytes at ``position``; fewer at the end of the file.

        Raises `LogError` on a disk error.
        """
        if self._file is None:
            raise ValueError("the log is not open")
        try:
            self._file.seek(position)
            return self._file.read(size)
        except OSError as error:
            raise LogError(f"{self.path}: {error.strerror} at byte {position}") from error

    def chunk_head(
        self, position: int, *, any_length: bool = False
    ) -> tuple[ChunkHead, int] | None:
        """Header of a chunk at ``position`` and start of its data; None if there is no chunk.

        The record type is ignored, and with ``any_length`` the length of the record.
        """
        raw = self.read_at(position, 9 + CHUNK_FIXED + MAX_NAME)
        if len(raw) < 9 + CHUNK_FIXED:
            return None
        return _chunk_head(raw, position, any_length)

    def looks_like_chunk(self, position: int) -> bool:
        """Whether a chunk seems to begin here, for searches in arbitrary bytes.

        Its sizes must agree exactly, or (as fields may have been appended) its data must begin as
        chunk data does. The record type is ignored.
        """
        raw = self.read_at(position, 9 + CHUNK_FIXED + MAX_NAME)
        if len(raw) < 9 + CHUNK_FIXED:
            return False
        found = _chunk_head(raw, position)
        if found is None or found[0].compression not in ("", "lz4", "zstd"):
            return False
        head, place = found
        (length,) = U64.unpack_from(raw, 1)
        if head.data_length + CHUNK_FIXED + len(head.compression) == length:
            return True
        if head.compression:
            return self.read_at(place, 4) == FRAME_STARTS[head.compression]
        start = self.read_at(place, 9)
        if len(start) < 9:
            return False
        opcode, size = op.RECORD.unpack(start)
        known = opcode in (op.SCHEMA, op.CHANNEL, op.MESSAGE)
        return bool(known and 9 + size <= head.data_length == head.size)

    def find_chunk(self, position: int) -> int | None:
        """Offset of the first whole, plausible chunk at or after ``position``."""
        if position >= self._no_chunk_from:
            return None
        found = self.find(CHUNK_START, position, self._whole_chunk)
        if found is None:
            self._no_chunk_from = position
        return found

    def _whole_chunk(self, position: int) -> bool:
        (length,) = U64.unpack(self.read_at(position + 1, 8).ljust(8, b"\xff"))
        return position + 9 + int(length) <= self.end and self.looks_like_chunk(position)

    def find(
        self, start: re.Pattern[bytes], position: int, check: Callable[[int], bool]
    ) -> int | None:
        """First offset at or after ``position`` at which ``start`` matches and ``check`` agrees.

        ``start`` matches at most 17 bytes.
        """
        while position < self.end:
            window = self.read_at(position, WINDOW + 16)
            for match in start.finditer(window):
                at = position + match.start()
                if at < position + WINDOW and check(at):
                    return at
            if self._progress is not None:
                self._progress(position, self.size)
            position += WINDOW
        return None

    def plausible(self, position: int, steps: int = 4) -> bool:
        """Whether a record seems to begin here; the chance of a false match is one in 10^10.

        A record of an unknown type must be followed by one of a known type.
        """
        if position >= self.end:
            return False
        head = self.read_at(position, 9)
        if len(head) < 9:
            return False
        opcode, length = op.RECORD.unpack(head)
        after = position + 9 + int(length)
        if opcode == op.CHUNK:
            return self.looks_like_chunk(position)
        if opcode > op.DATA_END:
            return after <= self.end and steps > 0 and self.plausible(after, steps - 1)
        return opcode > 0 and after <= self.size


def _chunk_head(
    raw: bytes, position: int, any_length: bool = False
) -> tuple[ChunkHead, int] | None:
    (length,) = U64.unpack_from(raw, 1)
    start, end, size, crc = op.CHUNK_HEAD.unpack_from(raw, 9)
    (name_length,) = U32.unpack_from(raw, 37)
    if name_length > MAX_NAME - 8 or len(raw) < 41 + name_length + 8:
        return None
    (data_length,) = U64.unpack_from(raw, 41 + name_length)
    if data_length + CHUNK_FIXED + name_length > length and not any_length:
        return None
    try:
        name = raw[41 : 41 + name_length].decode()
    except UnicodeDecodeError:
        return None
    place = position + 9 + CHUNK_FIXED + name_length
    return ChunkHead(start, end, size, crc, name, data_length), place


COMPRESSIONS = ("", "zstd", "lz4")
"""Supported compressions: all that the format's specification lists."""

SMALL = 8 << 20
"""Largest chunk, in bytes, that is decompressed at once; writers make chunks of 0.8 to 4 MB."""

PIECE = 1 << 16
"""Bytes processed at a time."""

MAX_WINDOW = 1 << 27
"""Largest window of a zstd frame in bytes, held in memory: the most that zstd accepts by
default."""

ReadAt = Callable[[int, int], bytes]
"""Reads bytes: position, size."""


def _lz4() -> Any:
    import importlib

    try:
        return importlib.import_module("lz4.frame")
    except ImportError:
        raise BadRecordError("a chunk in lz4: install the lz4 package") from None


def pieces(read_at: ReadAt, packed: Packed) -> Iterator[bytes]:
    """Yield a chunk's records piece by piece. Raises `BadRecordError` if they cannot be
    decompressed.

    Ends without an error if the packed bytes end early; the caller must notice that.
    """
    head = packed.head
    left = head.size
    for piece in _unpacked(read_at, packed):
        if len(piece) > left:
            yield piece[:left]
            raise BadRecordError("a chunk that unpacks to more than it says")
        left -= len(piece)
        yield piece


def _unpacked(read_at: ReadAt, packed: Packed) -> Iterator[bytes]:
    source = _source(read_at, packed)
    match packed.head.compression:
        case "":
            yield from source
        case "zstd":
            yield from _unzstd(source)
        case "lz4":
            yield from _unlz4(source)
        case name:
            raise BadRecordError(f"a chunk compressed with {name!r}, which is not read here")


def _source(read_at: ReadAt, packed: Packed) -> Iterator[bytes]:
    for at in range(packed.place, packed.place + packed.length, PIECE):
        piece = read_at(at, min(PIECE, packed.place + packed.length - at))
        if not piece:
            return
        yield piece


class _Stream:
    """The file interface that zstandard's reader needs."""

    def __init__(self, source: Iterator[bytes]) -> None:
        self._source = source

    def read(self, _: int = -1) -> bytes:
        """Return the next piece, of any size; empty at the end."""
        return next(self._source, b"")


def _unzstd(source: Iterator[bytes]) -> Iterator[bytes]:
    unpacker = zstandard.ZstdDecompressor(max_window_size=MAX_WINDOW)
    reader: Any = unpacker.stream_reader(
        _Stream(source),  # type: ignore[arg-type]  # asks for no more than read()
        read_size=PIECE,
        read_across_frames=True,
    )
    try:
        while piece := reader.read(PIECE):
            yield piece
    except (zstandard.ZstdError, MemoryError):
        raise BadRecordError("a chunk that does not decompress") from None


def _unlz4(source: Iterator[bytes]) -> Iterator[bytes]:
    frame = _lz4()
    unpacker: Any = None
    held = b""
    try:
        while True:
            if not held and (unpacker is None or unpacker.needs_input or unpacker.eof):
                held = next(source, b"")
                if not held:
                    return
            if unpacker is None or unpacker.eof:
                unpacker = frame.LZ4FrameDecompressor()
            piece = unpacker.decompress(held, max_length=PIECE)
            held = unpacker.unused_data or b"" if unpacker.eof else b""
            if piece:
                yield piece
    except (RuntimeError, MemoryError, EOFError):
        raise BadRecordError("a chunk that does not decompress") from None


def verify(read_at: ReadAt, packed: Packed) -> None:
    """Raise `BadRecordError` unless a chunk decompresses to its stated size and checksum."""
    crc = size = 0
    for piece in pieces(read_at, packed):
        crc = zlib.crc32(piece, crc)
        size += len(piece)
    _check(size, crc, packed.head)


def unpack(read_at: ReadAt, packed: Packed) -> tuple[bytes, bytes]:
    """Decompress and check a whole chunk of at most `SMALL` bytes. Raises `BadRecordError`.

    Returns also the compressed bytes if they are one zstd frame and nothing else, else none.
    """
    head = packed.head
    raw = read_at(packed.place, packed.length)
    data: bytes | None = None
    frame = b""
    if head.compression == "":
        data = raw
    elif head.compression == "zstd" and _stated_size(raw) == head.size > 0:
        # One frame that states its size, as from nearly every writer: decompress at once.
        unpacker = zstandard.ZstdDecompressor()
        try:
            data = unpacker.decompress(raw, max_output_size=head.size, allow_extra_data=False)
            frame = raw
        except (zstandard.ZstdError, MemoryError):
            try:  # perhaps with something after it
                data = unpacker.decompress(raw, max_output_size=head.size)
            except (zstandard.ZstdError, MemoryError):
                raise BadRecordError("a chunk that does not decompress") from None
    if data is None:
        data = b"".join(pieces(read_at, packed))
    _check(len(data), zlib.crc32(data) if head.crc else 0, head)
    return data, frame


def unpack_what_can_be(read_at: ReadAt, packed: Packed) -> bytes:
    """Decompress a chunk as far as possible, unchecked."""
    data = bytearray()
    try:
        for piece in pieces(read_at, packed):
            data += piece
    except BadRecordError:
        pass
    return bytes(data)


def _stated_size(raw: bytes) -> int:
    try:
        return zstandard.frame_content_size(raw)
    except zstandard.ZstdError:
        return -1


def _check(size: int, crc: int, head: ChunkHead) -> None:
    if size != head.size:
        raise BadRecordError(f"a chunk that unpacks to {size} bytes and says {head.size}")
    if head.crc and crc != head.crc:
        raise BadRecordError("the checksum of a chunk is wrong")
