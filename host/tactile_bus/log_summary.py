"""The summary at the end of a finished log: read a record at a time, whatever its length."""

from __future__ import annotations

import io
import struct
import zlib
from array import array
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import TypeVar

from mcap import records as mcap_records
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError

from tactile_bus import mcap_file as op
from tactile_bus.log_chunks import ReadAt
from tactile_bus.log_records import (
    BadRecordError,
    ChannelRecord,
    Cursor,
    SchemaRecord,
    parse_channel,
    parse_schema,
)

R = TypeVar("R")

ALLOWED = frozenset(
    (
        op.SCHEMA,
        op.CHANNEL,
        op.CHUNK_INDEX,
        op.ATTACHMENT_INDEX,
        op.STATISTICS,
        op.METADATA_INDEX,
        op.SUMMARY_OFFSET,
    )
)
"""Records of a summary, beside those of types that this version does not know."""

WINDOW = 1 << 20

LARGEST = 16 << 20
"""Bytes of a summary's record that is looked into; a chunk's index has ten for each channel."""

FOOTER_SIZE = 9 + 20

CHUNK_INDEX_HEAD = struct.Struct("<QQQQI")


@dataclass(slots=True)
class Chunks:
    """What a summary says of the chunks, in its order; stamps in ns, places in bytes.

    ``length``: of a chunk with the message indexes behind it.
    """

    first_ns: array[int] = field(default_factory=lambda: array("Q"))
    last_ns: array[int] = field(default_factory=lambda: array("Q"))
    offset: array[int] = field(default_factory=lambda: array("Q"))
    length: array[int] = field(default_factory=lambda: array("Q"))

    def __len__(self) -> int:
        return len(self.offset)


@dataclass(slots=True)
class Summary:
    """What stands between ``start`` and the footer at ``end``. ``checked``: its checksum is right.

    ``bad_crc``: it is wrong; then the rest says nothing. ``unindexed``: chunks with messages of
    which no message index is named. ``troubles``: records that cannot be read, with their places.
    """

    start: int
    end: int
    checked: bool = False
    bad_crc: bool = False
    schemas: list[SchemaRecord] = field(default_factory=list)
    channels: list[ChannelRecord] = field(default_factory=list)
    statistics: mcap_records.Statistics | None = None
    chunks: Chunks = field(default_factory=Chunks)
    unindexed: int = 0
    attachments: list[mcap_records.AttachmentIndex] = field(default_factory=list)
    metadata: list[mcap_records.MetadataIndex] = field(default_factory=list)
    troubles: list[tuple[int, int, str]] = field(default_factory=list)

    @property
    def knows_all_channels(self) -> bool:
        """Whether every channel of the file is defined here, so that chunks may be passed over."""
        statistics = self.statistics
        return statistics is not None and 0 < statistics.channel_count <= len(self.channels)


def parse(read: Callable[[ReadDataStream], R], body: bytes) -> R:
    """A record taken apart by the ``mcap`` package; `BadRecordError` when it is none."""
    try:
        return read(ReadDataStream(io.BytesIO(body)))
    except (McapError, EOFError, struct.error, UnicodeDecodeError):
        raise BadRecordError("a record is shorter than its fields") from None


def read_summary(read_at: ReadAt, start: int, end: int, crc: int | None) -> Summary | None:
    """The summary from ``start`` to the footer at ``end``; None when other records stand there.

    ``crc``: of the footer, 0 for none; None when it is not to be checked.
    """
    summary = Summary(start, end)
    for position, opcode, length in _records(read_at, start, end):
        if opcode == 0 or (opcode <= op.DATA_END and opcode not in ALLOWED):
            return None
        if position + 9 + length > end:
            return None
    if crc:
        summary.checked = _crc(read_at, start, end + FOOTER_SIZE - 4) == crc
        summary.bad_crc = not summary.checked
        if summary.bad_crc:
            return summary
    for position, opcode, length in _records(read_at, start, end):
        if opcode not in ALLOWED or opcode == op.SUMMARY_OFFSET:
            continue
        if length > LARGEST:
            summary.troubles.append((position, length + 9, f"a record of {length} bytes"))
            continue
        try:
            _take(summary, opcode, read_at(position + 9, length))
        except BadRecordError as error:
            summary.troubles.append((position, length + 9, str(error)))
    return summary


def _records(read_at: ReadAt, start: int, end: int) -> Iterator[tuple[int, int, int]]:
    """Place, type and length of each record; one that ends beyond ``end`` for what is none."""
    position = start
    window, begin = b"", start
    while position < end:
        if not begin <= position <= begin + len(window) - 9:
            window, begin = read_at(position, min(WINDOW, end - position)), position
            if len(window) < 9:
                yield position, 1, end
                return
        opcode, length = op.RECORD.unpack_from(window, position - begin)
        yield position, opcode, length
        position += 9 + length


def _crc(read_at: ReadAt, start: int, end: int) -> int:
    crc = 0
    for at in range(start, end, WINDOW):
        crc = zlib.crc32(read_at(at, min(WINDOW, end - at)), crc)
    return crc


def _take(summary: Summary, opcode: int, body: bytes) -> None:
    if opcode == op.SCHEMA:
        summary.schemas.append(parse_schema(body))
    elif opcode == op.CHANNEL:
        summary.channels.append(parse_channel(body))
    elif opcode == op.STATISTICS:
        summary.statistics = parse(mcap_records.Statistics.read, body)
    elif opcode == op.ATTACHMENT_INDEX:
        summary.attachments.append(parse(mcap_records.AttachmentIndex.read, body))
    elif opcode == op.METADATA_INDEX:
        summary.metadata.append(parse(mcap_records.MetadataIndex.read, body))
    elif opcode == op.CHUNK_INDEX:
        cursor = Cursor(body)
        first, last, offset, length, indexes = cursor.take(CHUNK_INDEX_HEAD)
        cursor.at += indexes  # ten bytes a channel, of no use here
        (index_length,) = cursor.take(struct.Struct("<Q"))
        chunks = summary.chunks
        chunks.first_ns.append(first)
        chunks.last_ns.append(last)
        chunks.offset.append(offset)
        chunks.length.append(min(length + index_length, (1 << 64) - 1))
        summary.unindexed += not indexes
