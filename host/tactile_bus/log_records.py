"""What a log consists of, and how its records are taken apart. Pure: bytes in, values out.

A record may be longer than its fields: later versions of the format append fields, which a reader
ignores.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import NamedTuple

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
class ChunkHead:
    """Fields of a chunk record before its data. ``size``, ``crc``: of the data unpacked."""

    start_ns: int
    end_ns: int
    size: int
    crc: int
    compression: str
    data_length: int


@dataclass(frozen=True, slots=True)
class Packed:
    """Where the compressed bytes of a chunk stand, for one that is unpacked piece by piece."""

    head: ChunkHead
    place: int
    length: int


@dataclass(frozen=True, slots=True)
class Block:
    """Messages, schemas and channels, as a run of records: ``data``, or ``packed`` for a large one.

    ``verified``: its checksum was right. ``partial``: its end is not there, which was reported.
    ``suspect``: its checksum is wrong, and it is read all the same.
    """

    offset: int
    data: bytes
    verified: bool
    packed: Packed | None = None
    partial: bool = False
    suspect: bool = False


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


def parse_schema(body: bytes) -> SchemaRecord:
    """Schema record; BadRecordError when it is none."""
    cursor = Cursor(body)
    (number,) = cursor.take(U16)
    name, encoding = cursor.string(), cursor.string()
    return SchemaRecord(number, name, encoding, cursor.bytes(*cursor.take(U32)))


def parse_channel(body: bytes) -> ChannelRecord:
    """Channel record; BadRecordError when it is none."""
    cursor = Cursor(body)
    number, schema = cursor.take(CHANNEL_HEAD)
    topic, encoding = cursor.string(), cursor.string()
    return ChannelRecord(number, schema, topic, encoding, cursor.map())


def parse_metadata(body: bytes) -> MetadataRecord:
    """Metadata record; BadRecordError when it is none."""
    cursor = Cursor(body)
    return MetadataRecord(cursor.string(), cursor.map())
