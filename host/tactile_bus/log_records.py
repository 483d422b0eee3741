"""What a log consists of, and how its records are taken apart. Pure: bytes in, values out."""

from __future__ import annotations

import importlib
import struct
import zlib
from dataclasses import dataclass
from typing import NamedTuple

import zstandard

U16 = struct.Struct("<H")
U32 = struct.Struct("<I")
U64 = struct.Struct("<Q")
CHANNEL_HEAD = struct.Struct("<HH")
ATTACHMENT_HEAD = struct.Struct("<QQ")


class LogError(Exception):
    """The file is no log, or cannot be read; the message says which."""


@dataclass(frozen=True, slots=True)
class SchemaRecord:
    """Definition of a message type."""

    number: int
    name: str
    encoding: str
    data: bytes


@dataclass(frozen=True, slots=True)
class ChannelRecord:
    """One stream. ``schema``: number of its schema, 0 for none."""

    number: int
    schema: int
    topic: str
    encoding: str
    metadata: dict[str, str]


@dataclass(frozen=True, slots=True)
class MetadataRecord:
    """A named table of texts."""

    name: str
    values: dict[str, str]


@dataclass(frozen=True, slots=True)
class AttachmentRecord:
    """A file within the file; its bytes are ``size`` long from ``position`` on."""

    name: str
    media_type: str
    log_ns: int
    create_ns: int
    position: int
    size: int


@dataclass(frozen=True, slots=True)
class Block:
    """Messages, schemas and channels, as a run of records. ``verified``: its checksum was right."""

    offset: int
    data: bytes
    verified: bool


@dataclass(frozen=True, slots=True)
class Damage:
    """Bytes that could not be read. ``messages`` lost there, None where that is not known."""

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
    """A record that cannot be right; caught within the reader."""


@dataclass(slots=True)
class Cursor:
    """Takes fields off a record's body."""

    data: bytes
    at: int = 0

    def take(self, layout: struct.Struct) -> tuple[int, ...]:
        """Numbers of a fixed layout."""
        try:
            values = layout.unpack_from(self.data, self.at)
        except struct.error:
            raise BadRecordError("a record is shorter than its fields") from None
        self.at += layout.size
        return values

    def bytes(self, size: int) -> bytes:
        """The next ``size`` bytes."""
        if size > len(self.data) - self.at:
            raise BadRecordError("a record is shorter than its fields")
        self.at += size
        return self.data[self.at - size : self.at]

    def string(self) -> str:
        """A text with its length before it."""
        try:
            return self.bytes(*self.take(U32)).decode()
        except UnicodeDecodeError:
            raise BadRecordError("a text is no UTF-8") from None

    def map(self) -> dict[str, str]:
        """A table of texts with its length before it."""
        (size,) = self.take(U32)
        end = self.at + size
        found = {}
        while self.at < end:
            key = self.string()
            found[key] = self.string()
        if self.at != end:
            raise BadRecordError("a table is longer than it says")
        return found

    def end(self) -> None:
        """Check that nothing is left."""
        if self.at != len(self.data):
            raise BadRecordError("a record is longer than its fields")


def parse_schema(body: bytes) -> SchemaRecord:
    """Schema record; BadRecordError when it is none."""
    cursor = Cursor(body)
    (number,) = cursor.take(U16)
    name, encoding = cursor.string(), cursor.string()
    record = SchemaRecord(number, name, encoding, cursor.bytes(*cursor.take(U32)))
    cursor.end()
    return record


def parse_channel(body: bytes) -> ChannelRecord:
    """Channel record; BadRecordError when it is none."""
    cursor = Cursor(body)
    number, schema = cursor.take(CHANNEL_HEAD)
    topic, encoding = cursor.string(), cursor.string()
    record = ChannelRecord(number, schema, topic, encoding, cursor.map())
    cursor.end()
    return record


def parse_metadata(body: bytes) -> MetadataRecord:
    """Metadata record; BadRecordError when it is none."""
    cursor = Cursor(body)
    record = MetadataRecord(cursor.string(), cursor.map())
    cursor.end()
    return record


@dataclass(frozen=True, slots=True)
class ChunkHead:
    """Fields of a chunk record before its data. ``size``, ``crc``: of the data unpacked."""

    start_ns: int
    end_ns: int
    size: int
    crc: int
    compression: str
    data_length: int


def unpack(data: bytes, head: ChunkHead) -> bytes:
    """Records of a whole chunk, checked."""
    try:
        if head.compression == "zstd":
            if zstandard.frame_content_size(data) not in (-1, head.size):
                raise BadRecordError("a chunk whose sizes do not agree")
            data = zstandard.ZstdDecompressor().decompress(data, max_output_size=head.size)
        elif head.compression == "lz4":
            data = importlib.import_module("lz4.frame").decompress(data)
    except (zstandard.ZstdError, RuntimeError, MemoryError):
        raise BadRecordError("a chunk that does not decompress") from None
    except ImportError:
        raise BadRecordError("a chunk in lz4: install the lz4 package") from None
    if len(data) != head.size or (head.crc and zlib.crc32(data) != head.crc):
        raise BadRecordError("the checksum of a chunk is wrong")
    return data


def unpack_start(data: bytes, head: ChunkHead) -> bytes:
    """What can be decompressed of a chunk that is cut off; whole zstd blocks are exact."""
    if head.compression == "":
        return data
    if head.compression != "zstd":
        return b""
    try:
        return zstandard.ZstdDecompressor().decompressobj().decompress(data)
    except zstandard.ZstdError:
        return b""
