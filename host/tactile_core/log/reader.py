"""Reads any MCAP log, finished, cut off or damaged, of any writer. Constant memory.

A sound file is read record by record, as the format says: records of unknown types and appended
fields are ignored. If a record is invalid, reading continues at the next chunk, found by its
header, or in a file without chunks at the next records that follow one another; everything skipped
is reported as `Damage`, never silently.

The ``mcap`` package parses the records of the summary. Its readers are not used for the rest: they
stop at the first damage, decompress a chunk whatever its size, and take five times as long.
"""

from __future__ import annotations

import contextlib
import io
import struct
import zlib
from array import array
from collections.abc import Callable, Collection, Container, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import TracebackType
from typing import TypeVar

from mcap import records as mcap_records
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError

from tactile_core.log import mcap_file as op
from tactile_core.log.records import (
    ATTACHMENT_HEAD,
    COMPRESSIONS,
    RECORD_START,
    SMALL,
    U16,
    U32,
    U64,
    WINDOW,
    AttachmentRecord,
    BadRecordError,
    Block,
    ChannelRecord,
    ChunkHead,
    Cursor,
    Damage,
    Event,
    LogBytes,
    LogError,
    Message,
    Packed,
    Progress,
    ReadAt,
    SchemaRecord,
    parse_channel,
    parse_metadata,
    parse_schema,
    pieces,
    unpack,
    unpack_what_can_be,
    verify,
)

# Summary at the end of a finished log, read record by record whatever its length.


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
"""Record types allowed in a summary, besides unknown ones."""

LARGEST = 16 << 20
"""Largest record of a summary that is parsed, in bytes; a chunk index takes ten per channel."""

FOOTER_SIZE = 9 + 20

CHUNK_INDEX_HEAD = struct.Struct("<QQQQI")


@dataclass(slots=True)
class Chunks:
    """Chunk index of a summary, in its order; stamps in ns, places in bytes.

    ``length``: of a chunk with the message indexes after it.
    """

    first_ns: array[int] = field(default_factory=lambda: array("Q"))
    last_ns: array[int] = field(default_factory=lambda: array("Q"))
    offset: array[int] = field(default_factory=lambda: array("Q"))
    length: array[int] = field(default_factory=lambda: array("Q"))

    def __len__(self) -> int:
        return len(self.offset)


@dataclass(slots=True)
class Summary:
    """Summary between ``start`` and the footer at ``end``.

    ``checked``: its checksum is right. ``bad_crc``: its checksum is wrong, and the other fields are
    empty. ``unindexed``: number of chunks with messages but without message index. ``troubles``:
    unreadable records (position, length, reason).
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
        """Whether every channel of the file is defined here, so that chunks may be skipped."""
        statistics = self.statistics
        return statistics is not None and 0 < statistics.channel_count <= len(self.channels)


def parse(read: Callable[[ReadDataStream], R], body: bytes) -> R:
    """Parse a record with the ``mcap`` package. Raises `BadRecordError` if it is invalid."""
    try:
        return read(ReadDataStream(io.BytesIO(body)))
    except (McapError, EOFError, struct.error, UnicodeDecodeError):
        raise BadRecordError("a record is shorter than its fields") from None


def read_summary(read_at: ReadAt, start: int, end: int, crc: int | None) -> Summary | None:
    """Read the summary from ``start`` to the footer at ``end``; None if other records are there.

    ``crc``: from the footer, 0 if there is none; None to skip the check.
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
    """Position, type and length of each record.

    An incomplete header counts as a record beyond ``end``.
    """
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
        cursor.at += indexes  # ten bytes per channel, not needed here
        (index_length,) = cursor.take(struct.Struct("<Q"))
        chunks = summary.chunks
        chunks.first_ns.append(first)
        chunks.last_ns.append(last)
        chunks.offset.append(offset)
        chunks.length.append(min(length + index_length, (1 << 64) - 1))
        summary.unindexed += not indexes


MAX_CHUNK = 256 << 20
"""Largest chunk, or message outside chunks, in bytes. rosbag2 and Foxglove write chunks of 0.8 to 4
MB, this project of 1 MB. Bounds memory."""

MAX_SUSPECT = 64 << 20
"""Largest damaged chunk, in bytes, that is searched for whole messages; it is held in memory."""

MAX_RECORD = 16 << 20
"""Largest schema, channel or metadata record in bytes; real ones have a few kB."""

MAX_DEFINITIONS = 64 << 20
"""Most bytes of all schemas and channels of a file; three thousand topics have some MB."""

MAX_FILE = 1 << 50
"""Larger lengths in bytes are wrong, as no file is that large."""

MAX_DAMAGES = 1000
"""Most damages reported individually; further ones are only counted."""

FOOTER = struct.Struct("<QQI")

NO_MESSAGES = frozenset((op.HEADER, op.SCHEMA, op.CHANNEL, op.MESSAGE_INDEX, op.ATTACHMENT,
                         op.METADATA, op.DATA_END))  # fmt: skip
"""Record types whose loss costs no message."""

DATA_RECORDS = frozenset((op.HEADER, op.SCHEMA, op.CHANNEL, op.METADATA, op.MESSAGE))

FREQUENT = (op.MESSAGE, op.MESSAGE_INDEX)
"""Record types of which a log may have millions: not each is looked at as a disguised chunk."""

NEAR_NS = 3_600_000_000_000
"""A record of an unknown type is taken for a message if its times are this close, in ns."""

MAX_NS = (1 << 64) - 1

FLIPPED_MESSAGE = "a message whose record type is wrong"


class _Any:
    """Container of everything."""

    def __contains__(self, _: object) -> bool:
        return True


ANY: Container[int] = _Any()
"""All channels: `LogReader.messages` returns their messages without data."""


@dataclass(slots=True)
class LogReader:
    """One pass over a log, as a context manager. Raises `LogError` if the file is not a log.

    ``window``: first and last log time, ns, inclusive. Chunks wholly outside may be skipped;
    attachments and tables are skipped. ``keep_suspect``: also return blocks and attachments with a
    wrong checksum, as far as they are readable.

    After the pass: ``schemas`` and ``channels`` by number; ``closed`` (the file was finished in
    order); ``damages`` (the first MAX_DAMAGES), their ``damage_count`` and ``bytes_damaged``;
    ``messages_lost`` as far as indexes tell, ``lost_unknown`` places where they do not.
    ``data_crc``: of all bytes up to ``data_end``, 0 if the writer stored none. ``suspect``:
    messages returned from blocks with a wrong checksum; ``unchunked``: messages outside chunks.
    """

    path: Path
    progress: Progress | None = None
    window: tuple[int, int] | None = None
    keep_suspect: bool = False
    size: int = 0
    closed: bool = False
    profile: str = ""
    library: str = ""
    schemas: dict[int, SchemaRecord] = field(default_factory=dict)
    channels: dict[int, ChannelRecord] = field(default_factory=dict)
    damages: list[Damage] = field(default_factory=list)
    damage_count: int = 0
    bytes_damaged: int = 0
    messages_lost: int = 0
    lost_unknown: int = 0
    unchunked: int = 0
    chunk_count: int = 0
    suspect: int = 0
    summary: Summary | None = None
    data_crc: int = 0
    data_end: int = 0
    _bytes: LogBytes = field(init=False)
    _footer: tuple[int, int] | None = None  # summary's start as stated, and its checksum
    _lost_chunk: Damage | None = None
    _suspect_kept: int = 0  # messages of the lost chunk that were returned
    _unknown_at: int | None = None  # position of the last record, if its type is unknown
    _index_may_follow: bool = False  # a message index may be here: after a chunk, or after damage
    _near_ns: int = 0  # log time of the last message outside chunks
    _bad_crc: bool = False
    _ended: bool = False  # the end mark was read
    _definition_bytes: int = 0
    _redefined: set[tuple[int, int]] = field(default_factory=set)
    _skips: dict[int, int] | None = None  # starts of chunks outside the window, and their ends
    _blocks: int = 0  # blocks returned, and those read to their ends
    _read: int = 0
    _messages: int = 0

    def __post_init__(self) -> None:
        """Prepare reading; the file is opened on entering the context."""
        self._bytes = LogBytes(self.path, self.progress)

    def __enter__(self) -> LogReader:
        self._bytes.open()
        self.size = self._bytes.size
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        at: TracebackType | None,
    ) -> None:
        self._bytes.close()

    @property
    def indexed(self) -> bool:
        """After the pass: whether the summary indexes everything.

        That is, it lists all channels and types and indexes every chunk and its messages, so that
        programs that need an index find every message.
        """
        summary = self.summary
        if summary is None or self.unchunked or not summary.knows_all_channels:
            return False
        types = {schema.number for schema in summary.schemas} | {0}
        return (
            not summary.unindexed
            and len(summary.chunks) == self.chunk_count
            and all(channel.schema in types for channel in summary.channels)
        )

    @property
    def lossy(self) -> bool:
        """Whether known losses of messages occurred so far."""
        return bool(self.messages_lost or self.lost_unknown)

    def read_at(self, position: int, size: int) -> bytes:
        """Read bytes at ``position``; fewer at the end of the file.

        Raises `LogError` on a disk error.
        """
        return self._bytes.read_at(position, size)

    def pieces_at(self, position: int, size: int) -> Iterator[bytes]:
        """Yield ``size`` bytes of the file piece by piece, for data of any size."""
        for at in range(position, position + size, WINDOW):
            yield self.read_at(at, min(WINDOW, position + size - at))

    def summarize(self) -> Summary | None:
        """Read only the summary; None if there is none or it is unreliable."""
        self._start()
        summary = self.summary
        return None if summary is None or summary.troubles else summary

    def events(self) -> Iterator[Event]:
        """Yield everything readable, in file order."""
        position = self._start()
        self._plan_window()
        while position < self._bytes.end:
            if self.progress is not None:
                self.progress(position, self.size)
            if self._skips is not None and (after := self._skips.get(position)) is not None:
                if self._may_skip(position, after):
                    position, self._index_may_follow = after, True
                    continue
                self._skips = None
            try:
                after, event = self._record(position)
            except BadRecordError as error:
                after, event = self._skip(position, str(error)), None
            if event is not None:
                self._blocks += isinstance(event, Block)
                yield event
            if after <= position:
                break
            position = after
        self._report_lost_chunk()
        self._check_end()
        if self.progress is not None:
            self.progress(self.size, self.size)

    def messages(self, block: Block, without: Container[int] = ()) -> Iterator[Message]:
        """Yield the messages of a block; also collects the schemas and channels in it.

        ``without``: channels whose messages are returned without data, for counting.
        """
        if block.suspect:
            yield from self._suspect_messages(block)
            return
        if block.packed is not None:
            yield from self._streamed_messages(block, without)
            self._read += 1
            return
        data, at, end = block.data, 0, len(block.data)
        head, fixed = op.MESSAGE_HEAD, op.MESSAGE_FIXED
        count = 0
        while at + 9 <= end:
            opcode, length = op.RECORD.unpack_from(data, at)
            after = at + 9 + length
            if after > end:
                break
            if opcode == op.MESSAGE and length >= fixed:
                _, _, channel, sequence, log_ns, publish_ns = head.unpack_from(data, at)
                count += 1
                payload = b"" if channel in without else data[at + 31 : after]
                yield Message(channel, sequence, log_ns, publish_ns, payload)
            elif not self._handle_inner(block, data[at:after]):
                break
            at = after
        self._read += 1
        self._messages += count
        if at < end and not block.partial:
            self.note_damage(Damage(block.offset, 0, "a chunk whose records do not fit into it"))

    def index(self, block: Block, channels: Container[int]) -> dict[int, array[int]] | None:
        """Times and places of the messages of a block, for a copy of its bytes.

        Returns alternately log time and place within the block, by channel. None if the block
        holds anything but whole messages of ``channels``: `messages` reads it then.
        """
        data, at, end = block.data, 0, len(block.data)
        head, message, fixed = op.MESSAGE_HEAD.unpack_from, op.MESSAGE, op.MESSAGE_FIXED
        last = end - op.MESSAGE_HEAD.size
        found: dict[int, array[int]] = {}
        count = 0
        while at <= last:
            opcode, length, channel, _, log_ns, _ = head(data, at)
            if opcode != message or length < fixed:
                return None
            times = found.get(channel)
            if times is None:
                if channel not in channels:
                    return None
                times = found[channel] = array("Q")
            times.append(log_ns)
            times.append(at)
            at += 9 + length
            count += 1
        if at != end or not count:
            return None
        self._read += 1
        self._messages += count
        return found

    def check_structure(self) -> None:
        """Raise `LogError` unless the sequence of records is valid; does not decompress chunks."""
        position = self._start()
        while position < self._bytes.end and not self.damage_count:
            opcode, length = op.RECORD.unpack(self.read_at(position, 9).ljust(9, b"\0"))
            after = position + 9 + length
            if (opcode == op.CHUNK and not self._bytes.looks_like_chunk(position)) or (
                not 0 < opcode <= op.DATA_END and opcode < 0x80
            ):
                raise LogError(f"{self.path}: no record at byte {position}")
            if opcode == op.DATA_END or after > self._bytes.end:
                break
            position = after
        if self.damage_count:
            raise LogError(f"{self.path}: {self.damages[0].reason}")

    # Start and end of a file

    def _start(self) -> int:
        """Return the position of the first record; determines how the file ends."""
        if self.size == 0:
            raise LogError(f"{self.path} is empty: its writer ended before the first byte")
        self._bytes.end = self.size
        magic = self.read_at(0, 8)
        if magic != op.MAGIC:
            first = self._bytes.find_chunk(0)
            if op.MAGIC.startswith(magic):
                raise LogError(f"{self.path} is cut off after {self.size} bytes: nothing to read")
            if magic[:5] == op.MAGIC[:5] and magic[6:] == op.MAGIC[6:]:
                raise LogError(
                    f"{self.path} is in version {chr(magic[5])!r} of the MCAP format, this program "
                    "reads version '0': update it"
                )
            if first is None:
                raise LogError(f"{self.path} is not an MCAP file")
            self.note_damage(Damage(0, first, "the start of the file is overwritten"))
            self._read_end()
            return first
        self._read_end()
        return 8

    def _read_end(self) -> None:
        """Find the footer of a finished file, and the summary to which it points."""
        at = self.size - FOOTER_SIZE - 8
        tail = self.read_at(max(at, 0), FOOTER_SIZE + 8)
        if at < 8 or len(tail) != FOOTER_SIZE + 8 or tail[-8:] != op.MAGIC or tail[0] != op.FOOTER:
            return
        start, _, crc = FOOTER.unpack_from(tail, 9)
        self.closed = True
        self._footer = start, crc
        self._bytes.end = at
        if start == 0:
            return
        summary = read_summary(self.read_at, start, at, crc) if 8 < start <= at else None
        if summary is None:
            return  # the end mark will show where it is
        if summary.bad_crc:
            self.closed, self._bad_crc = False, True
            self._bytes.end = self.size
            length = self.size - 12 - start
            self.note_damage(Damage(start, length, "the checksum of the summary is wrong", 0))
            return
        self._bytes.end = start
        self._take_summary(summary)

    def _take_summary(self, summary: Summary) -> None:
        self.summary = summary
        for schema in summary.schemas:
            self._keep_schema(schema, 0)
        for channel in summary.channels:
            self._keep_channel(channel, 0)
        for position, length, reason in summary.troubles:
            self.note_damage(Damage(position, length, f"in the summary: {reason}", 0))

    def _end_mark(self, position: int, length: int) -> int:
        """Handle the end mark at ``position``; returns where reading ends."""
        after = position + 9 + length
        if length < 4:
            raise BadRecordError("an end mark that is too short")
        if self._footer is None:
            if self._bytes.find_chunk(after) is not None:
                raise BadRecordError("an end mark within the data")
            reason = "cut off within the summary"
            self.note_damage(Damage(position, self.size - position, reason, 0))
        elif self._bad_crc and after == self._footer[0]:
            pass  # already reported
        elif after != self._bytes.end:
            footer = self.size - FOOTER_SIZE - 8
            start, crc = self._footer
            summary = read_summary(self.read_at, after, footer, None)
            if summary is None:
                raise BadRecordError("an end mark within the data")
            stated = f"begins at byte {start}" if start else "is missing"
            reason = f"the footer says that the summary {stated}, but it begins at byte {after}"
            self.note_damage(Damage(footer, FOOTER_SIZE, reason, 0))
            if self.summary is None and not crc:
                self._take_summary(summary)
        elif self._footer[0] and self.summary is None:
            reason = f"the footer says that the summary begins at byte {self._footer[0]}: it is not"
            self.note_damage(Damage(self._bytes.end, FOOTER_SIZE, f"{reason} there", 0))
        (self.data_crc,) = U32.unpack(self.read_at(position + 9, 4).ljust(4, b"\0"))
        self.data_end = position
        self._ended = True
        return self._bytes.end

    def _check_end(self) -> None:
        """Compare the summary with what was found, after the pass."""
        if self.closed and not self._ended and self._footer is not None:
            reason = "the data have no end mark where the footer says that the summary begins"
            self.note_damage(Damage(self._bytes.end, 0, reason, 0))
        statistics = None if self.summary is None else self.summary.statistics
        if statistics is None or self.window is not None or self._read < self._blocks:
            return
        stated, found = statistics.message_count, self._messages + self.messages_lost
        if stated != found and not self.lost_unknown:
            lost = max(stated - found, 0)
            reason = f"the summary counts {stated} messages, but {found} are in the file"
            place = 0 if self.summary is None else self.summary.start
            self.note_damage(Damage(place, 0, reason, lost))

    def data_checksum_is_right(self) -> bool:
        """Whether the data matches its checksum, if there is one; reads all of it.

        Writers differ in where the data starts: with the file, after its first eight bytes, or
        after the header.
        """
        if not self.data_crc:
            return True
        header = 8 + 9 + op.RECORD.unpack(self.read_at(8, 9).ljust(9, b"\0"))[1]
        for start in (0, 8, header):
            crc = 0
            for piece in self.pieces_at(start, self.data_end - start):
                crc = zlib.crc32(piece, crc)
            if crc == self.data_crc:
                return True
        return False

    # Skipping data outside the window

    def _plan_window(self) -> None:
        """Plan which chunks to skip; needs an index of all chunks and all channels known."""
        summary = self.summary
        if self.window is None or summary is None or not summary.knows_all_channels:
            return
        first, last = self.window
        chunks = summary.chunks
        skips: dict[int, int] = {}
        spans = sorted(range(len(chunks)), key=chunks.offset.__getitem__)
        before = 8
        for k in spans:
            start, after = chunks.offset[k], chunks.offset[k] + chunks.length[k]
            if start < before or after > self._bytes.end:
                return  # an invalid index is ignored
            before = after
            if chunks.last_ns[k] < first or chunks.first_ns[k] > last:
                skips[start] = after
        self._skips = skips

    def _may_skip(self, position: int, after: int) -> bool:
        """Whether a chunk may be skipped as the index says; an index with a checksum is trusted."""
        if self.summary is None or self.summary.checked:
            return True
        found = self._bytes.chunk_head(position)
        if found is None or self.window is None:
            return False
        outside = found[0].end_ns < self.window[0] or found[0].start_ns > self.window[1]
        return outside and (after == self._bytes.end or self._bytes.plausible(after))

    # Records

    def _record(self, position: int) -> tuple[int, Event | None]:
        """Read the record at ``position``; returns the position of the next one and its event."""
        head = self.read_at(position, 9)
        if len(head) < 9:
            raise BadRecordError("cut off within a record")
        opcode, length = op.RECORD.unpack(head)
        after = position + 9 + length
        if opcode != op.MESSAGE_INDEX:
            self._report_lost_chunk()
        unknown_at, self._unknown_at = self._unknown_at, None
        if opcode == op.CHUNK:
            return self._chunk(position, length)
        if opcode not in FREQUENT and self._bytes.looks_like_chunk(position):
            return self._flipped_chunk(position, length)
        if after > self._bytes.end:
            raise BadRecordError("cut off within a record")
        if opcode == op.MESSAGE_INDEX:
            return self._message_index(position, length, unknown_at)
        if opcode != op.DATA_END and self._swallows(position, after, opcode):
            raise BadRecordError("a record that is longer than its place")
        if opcode > op.DATA_END:
            return self._unknown(position, length)
        self._index_may_follow = False
        if opcode == op.ATTACHMENT:
            return after, self._attachment(position, length)
        if opcode == op.DATA_END:
            return self._end_mark(position, length), None
        if opcode == op.MESSAGE:
            return after, self._unchunked_message(position, length)
        if opcode == 0:
            raise BadRecordError("record type 0, which does not exist")
        if opcode not in DATA_RECORDS or (opcode == op.HEADER and position != 8):
            raise BadRecordError(f"record type {opcode} within the data")
        if length > MAX_RECORD:
            raise BadRecordError(f"a record of {length} bytes")
        return after, self._small_record(opcode, self.read_at(position + 9, length))

    def _leads_on(self, after: int) -> bool:
        """Whether the data end at ``after``, or a record seems to begin there."""
        return after == self._bytes.end or self._bytes.plausible(after)

    def _swallows(self, position: int, after: int, opcode: int) -> bool:
        """Whether the length of a record is wrong, so that it would take in others."""
        if self._leads_on(after):
            return False
        following = self._find_next(position + 1, opcode)
        return following is not None and following < after

    def _flipped_chunk(self, position: int, length: int) -> tuple[int, Event | None]:
        """Read a chunk of which a bit of the record type was flipped; its checksum decides."""
        self.note_damage(Damage(position, 1, "a chunk whose record type is wrong", 0))
        return self._chunk(position, length)

    def _unknown(self, position: int, length: int) -> tuple[int, None]:
        """Skip a record of an unknown type (of a later version, or private).

        If it looks like a message in all but one bit of its type, it is reported as lost: its
        channel is known, and its times are near those of the message before.
        """
        self._unknown_at = position
        after = position + 9 + length
        head = self.read_at(position, op.MESSAGE_HEAD.size)
        if _one_bit_from_message(head[0]):
            near_ns = self._near_ns
            span = (near_ns - NEAR_NS, near_ns + NEAR_NS) if near_ns else (1, MAX_NS)
            if self._was_message(head, *span):
                self.note_damage(Damage(position, after - position, FLIPPED_MESSAGE, 1))
        return after, None

    def _was_message(self, head: bytes, first_ns: int, last_ns: int) -> bool:
        """Whether a record of a wrong type begins like a message between these times."""
        if len(head) < op.MESSAGE_HEAD.size:
            return False
        _, length, channel, _, log_ns, publish_ns = op.MESSAGE_HEAD.unpack_from(head)
        return (
            length >= op.MESSAGE_FIXED
            and channel in self.channels
            and first_ns <= log_ns <= last_ns
            and abs(publish_ns - log_ns) <= NEAR_NS
        )

    def _unchunked_message(self, position: int, length: int) -> Event | None:
        """Read a message outside chunks."""
        if length < op.MESSAGE_FIXED:
            raise BadRecordError("a message is shorter than its fields")
        self.unchunked += 1
        if length > MAX_CHUNK:
            self.note_damage(Damage(position, length + 9, f"a message of {length} bytes", 1))
            return None
        data = self.read_at(position, 9 + length)
        self._near_ns = op.MESSAGE_HEAD.unpack_from(data)[4]
        return Block(position, data, False)

    def _small_record(self, opcode: int, body: bytes) -> Event | None:
        if opcode == op.METADATA:
            return parse_metadata(body)
        if opcode == op.HEADER:
            cursor = Cursor(body)
            self.profile, self.library = cursor.string(), cursor.string()
            return None
        self._define(opcode, body)
        return None

    def _define(self, opcode: int, body: bytes) -> None:
        if opcode == op.SCHEMA:
            self._keep_schema(parse_schema(body), 1)
        else:
            self._keep_channel(parse_channel(body), 1)

    def _keep_schema(self, schema: SchemaRecord, from_data: int) -> None:
        """Store a schema; the first of a number is kept, and number 0 means none."""
        known = self.schemas.get(schema.number)
        if schema.number == 0 or known == schema:
            return
        if known is not None:
            self._report_redefinition(op.SCHEMA, schema.number, from_data)
            return
        self._definition_bytes += len(schema.data)
        if self._definition_bytes > MAX_DEFINITIONS:
            self.note_damage(Damage(0, 0, f"definitions of over {MAX_DEFINITIONS} bytes in all", 0))
            self._definition_bytes -= len(schema.data)
            schema = replace(schema, data=b"")
        self.schemas[schema.number] = schema

    def _keep_channel(self, channel: ChannelRecord, from_data: int) -> None:
        known = self.channels.get(channel.number)
        if known is None:
            texts = channel.metadata.items()
            self._definition_bytes += len(channel.topic) + sum(len(k) + len(v) for k, v in texts)
            if self._definition_bytes > MAX_DEFINITIONS:
                raise BadRecordError(f"definitions of over {MAX_DEFINITIONS} bytes in all")
            self.channels[channel.number] = channel
        elif known != channel:
            self._report_redefinition(op.CHANNEL, channel.number, from_data)

    def _report_redefinition(self, opcode: int, number: int, from_data: int) -> None:
        """Report once that definitions differ; a checked summary takes precedence."""
        if from_data and self.summary is not None and self.summary.checked:
            return
        if (opcode, number) not in self._redefined:
            self._redefined.add((opcode, number))
            what = "schema" if opcode == op.SCHEMA else "channel"
            self.note_damage(Damage(0, 0, f"{what} {number} is defined twice, and differently", 0))

    # Chunks

    def _chunk(self, position: int, length: int) -> tuple[int, Event | None]:
        found = self._bytes.chunk_head(position, any_length=True)
        if found is None:
            raise BadRecordError("a chunk whose sizes do not agree")
        head, place = found
        packed = Packed(head, place, head.data_length)
        after = position + 9 + length
        exact = place + head.data_length  # unless fields were appended
        if after != exact and not self._leads_on(after) and self._leads_on(exact):
            self.note_damage(Damage(position, 9, "a chunk whose length is wrong", 0))
            after, length = exact, exact - position - 9
        if after < exact:
            raise BadRecordError("a chunk whose sizes do not agree")
        self.chunk_count += 1
        self._index_may_follow = True
        if after > self._bytes.end:
            return self._bytes.end, self._cut_chunk(position, packed)
        if head.size > MAX_CHUNK or length > MAX_CHUNK:
            self._note_lost_chunk(position, after, head, f"a chunk of {head.size} bytes")
            return after, None
        if self.window is not None and self.summary is not None and self.summary.knows_all_channels:
            first, last = self.window
            if head.end_ns < first or head.start_ns > last:
                return after, None
        try:
            if head.compression not in COMPRESSIONS:
                raise BadRecordError(
                    f"a chunk compressed with {head.compression!r}, which is not read here"
                )
            if head.size <= SMALL and head.data_length <= SMALL:
                data, frame = unpack(self.read_at, packed)
                return after, Block(position, data, head.crc != 0, frame=frame, crc=head.crc)
            if head.crc:
                verify(self.read_at, packed)
            return after, Block(position, b"", head.crc != 0, packed)
        except BadRecordError as error:
            self._note_lost_chunk(position, after, head, str(error))
            if self.keep_suspect and head.compression in COMPRESSIONS and head.size <= MAX_SUSPECT:
                return after, Block(position, b"", False, packed, suspect=True)
            return after, None

    def _cut_chunk(self, position: int, packed: Packed) -> Event | None:
        """Read the start of a chunk at the end of the file: whole zstd blocks are exact."""
        if self._bytes.find_chunk(position + 1) is not None:
            raise BadRecordError("a chunk that is longer than the file")
        end, head = self._bytes.end, packed.head
        reason = "cut off within a chunk"
        if head.size > MAX_CHUNK or head.compression not in COMPRESSIONS:
            reason = f"cut off within a chunk of {head.size} bytes"
        self.note_damage(Damage(position, end - position, reason, None, head.start_ns, head.end_ns))
        if head.size > MAX_CHUNK or head.compression not in COMPRESSIONS:
            return None
        rest = Packed(head, packed.place, max(0, min(end - packed.place, packed.length)))
        return Block(position, b"", False, rest, partial=True)

    def _streamed_messages(self, block: Block, without: Container[int]) -> Iterator[Message]:
        """Yield messages while decompressing a chunk, with only the largest one in memory."""
        packed = block.packed
        if packed is None:
            return
        held = bytearray()
        at = done = 0  # position within held; bytes before it
        total = packed.head.size
        source = pieces(self.read_at, packed)
        skip = 0  # coming bytes to skip
        reason = ""
        while True:
            while not reason and len(held) - at >= 9:
                opcode, length = op.RECORD.unpack_from(held, at)
                size = 9 + length
                wrong = done + at + size > total or opcode == 0
                wrong |= opcode == op.MESSAGE and length < op.MESSAGE_FIXED
                if wrong:
                    reason = "a chunk whose records do not fit into it"
                    break
                if opcode == op.MESSAGE:
                    if len(held) - at < 31:
                        break
                    _, _, channel, *fields = op.MESSAGE_HEAD.unpack_from(held, at)
                    sequence, log_ns, publish_ns = fields
                    if channel in without:
                        self._messages += 1
                        yield Message(channel, sequence, log_ns, publish_ns, b"")
                        skip = max(0, at + size - len(held))
                        at = min(at + size, len(held))
                        if skip:
                            break
                        continue
                    if len(held) - at < size:
                        break
                    self._messages += 1
                    data = bytes(memoryview(held)[at + 31 : at + size])
                    yield Message(channel, sequence, log_ns, publish_ns, data)
                elif opcode in (op.SCHEMA, op.CHANNEL) and length <= MAX_RECORD:
                    if len(held) - at < size:
                        break
                    self._handle_inner(block, bytes(held[at : at + size]))
                else:
                    if len(held) - at < min(size, 31):
                        break
                    if not self._handle_inner(block, bytes(held[at : at + min(size, 31)])):
                        reason = "-"
                        break
                    skip = max(0, at + size - len(held))
                    at = min(at + size, len(held))
                    if skip:
                        break
                    continue
                at += size
            if reason:
                break
            done += at
            del held[:at]
            at = 0
            try:
                piece = next(source, b"")
            except BadRecordError as error:
                reason = str(error)
                break
            if not piece:
                break
            if skip:
                taken = min(skip, len(piece))
                skip -= taken
                done += taken
                piece = piece[taken:]
            held += piece
        if block.partial:
            return  # already reported
        if reason != "-" and (reason or len(held) > at or done + at != total):
            reason = reason or "a chunk whose records do not fit into it"
            self.note_damage(Damage(block.offset, 0, reason))

    def _suspect_messages(self, block: Block) -> Iterator[Message]:
        """Yield everything that looks like a message from a damaged chunk."""
        packed = block.packed
        if packed is None:
            return
        data, at = unpack_what_can_be(self.read_at, packed), 0
        while at + 9 <= len(data):
            opcode, length = op.RECORD.unpack_from(data, at)
            after = at + 9 + length
            if opcode == op.MESSAGE and self._likely_message(data, at, packed.head):
                if after < len(data) and not self._likely_message(data, after, packed.head):
                    following = self._find_message(data, at + 31, packed.head)
                    if following < after:  # its length is wrong: it would include others
                        at = following
                        continue
                _, _, channel, *fields = op.MESSAGE_HEAD.unpack_from(data, at)
                sequence, log_ns, publish_ns = fields
                self.suspect += 1
                self._suspect_kept += 1
                yield Message(channel, sequence, log_ns, publish_ns, data[at + 31 : after])
            elif opcode in (op.SCHEMA, op.CHANNEL) and after <= len(data):
                with contextlib.suppress(BadRecordError):
                    self._define(opcode, data[at + 9 : after])
            elif not self.channels or not opcode > op.DATA_END or after > len(data):
                at = self._find_message(data, at + 1, packed.head)
                continue
            at = after

    def _likely_message(self, data: bytes, at: int, head: ChunkHead) -> bool:
        """Whether a message can begin here: of a known channel, at a time within its chunk."""
        if at + 31 > len(data):
            return False
        _, length, channel, _, log_ns, _ = op.MESSAGE_HEAD.unpack_from(data, at)
        return (
            length >= op.MESSAGE_FIXED
            and at + 9 + length <= len(data)
            and channel in self.channels
            and head.start_ns <= log_ns <= head.end_ns
        )

    def _find_message(self, data: bytes, at: int, head: ChunkHead) -> int:
        """Position of the next likely message; the end if there is none."""
        while (at := data.find(op.MESSAGE, at)) >= 0:
            if self._likely_message(data, at, head):
                return at
            at += 1
        return len(data)

    def _handle_inner(self, block: Block, record: bytes) -> bool:
        """Handle a record within a chunk that is not a message; False if the rest is lost.

        ``record``: with its head; of one that is neither a schema nor a channel, as much as a
        message has before its payload is enough.
        """
        opcode, at = record[0], block.offset
        if opcode in (op.SCHEMA, op.CHANNEL):
            try:
                self._define(opcode, record[9:])
            except BadRecordError as error:
                self.note_damage(Damage(at, 0, str(error)))
        elif opcode == op.MESSAGE:
            self.note_damage(Damage(at, 0, "a message is shorter than its fields", 1))
        elif opcode == op.CHUNK:
            self.note_damage(Damage(at, 0, "a chunk within a chunk"))
        elif opcode == 0:
            self.note_damage(Damage(at, 0, "record type 0, which does not exist"))
            return False
        elif opcode <= op.DATA_END:
            self.note_damage(Damage(at, 0, f"record type {opcode} within a chunk"))
        elif not block.verified and _one_bit_from_message(opcode):
            found = self._bytes.chunk_head(at)
            if found and self._was_message(record, found[0].start_ns, found[0].end_ns):
                self.note_damage(Damage(at, 0, FLIPPED_MESSAGE, 1))
        return True

    def _note_lost_chunk(self, position: int, after: int, head: ChunkHead, reason: str) -> None:
        """Note a lost chunk; the indexes after it tell how many messages it had."""
        self._lost_chunk = Damage(position, after - position, reason, 0, head.start_ns, head.end_ns)

    def _report_lost_chunk(self) -> None:
        lost, self._lost_chunk = self._lost_chunk, None
        kept, self._suspect_kept = self._suspect_kept, 0
        if lost is not None:
            known = max(0, lost.messages - kept) if lost.messages else None
            self.note_damage(replace(lost, messages=known))  # unknown without an index

    def _message_index(
        self, position: int, length: int, unknown_at: int | None
    ) -> tuple[int, Event | None]:
        """Take the number of messages of a lost chunk from the indexes after it."""
        head = self.read_at(position + 9, 6)
        size = U32.unpack_from(head, 2)[0] if length >= 6 else 1
        if 6 + size != length and self._bytes.looks_like_chunk(position):
            self._report_lost_chunk()
            return self._flipped_chunk(position, length)
        if size % 16 or 6 + size > length:
            raise BadRecordError("a message index of impossible length")
        lost = self._lost_chunk
        if lost is not None:
            self._lost_chunk = replace(lost, messages=(lost.messages or 0) + size // 16)
        elif unknown_at is not None:  # indexes follow only chunks
            reason = "a chunk whose record type is wrong"
            self._lost_chunk = Damage(unknown_at, position - unknown_at, reason, size // 16)
        elif not self._index_may_follow:
            raise BadRecordError("a message index that follows no chunk")
        return position + 9 + length, None

    # Other records

    def _attachment(self, position: int, length: int) -> AttachmentRecord | None:
        if self.window is not None:
            return None
        head = Cursor(self.read_at(position + 9, min(length, 1 << 12)))
        try:
            log_ns, create_ns = head.take(ATTACHMENT_HEAD)
            name, media_type = head.string(), head.string()
            (size,) = head.take(U64)
        except BadRecordError:
            head = Cursor(self.read_at(position + 9, min(length, MAX_RECORD)))
            log_ns, create_ns = head.take(ATTACHMENT_HEAD)
            name, media_type = head.string(), head.string()
            (size,) = head.take(U64)
        if head.at + size + 4 > length:
            raise BadRecordError("an attachment whose sizes do not agree")
        start = position + 9 + head.at
        (stored,) = U32.unpack(self.read_at(start + size, 4))
        crc = stored
        if stored:
            crc = 0
            for piece in self.pieces_at(position + 9, head.at + size):
                crc = zlib.crc32(piece, crc)
        if stored != crc:
            reason = f"the checksum of attachment {name!r} is wrong"
            self.note_damage(Damage(position, length + 9, reason, 0))
            if not self.keep_suspect:
                return None
        return AttachmentRecord(name, media_type, log_ns, create_ns, start, size)

    def _skip(self, position: int, reason: str) -> int:
        """Skip an unreadable part; returns where reading continues.

        That is the next record if the length leads to one, otherwise the next that is found, or the
        end of the data.
        """
        self._report_lost_chunk()
        self._index_may_follow = True
        head = self.read_at(position, 11).ljust(11, b"\0")
        opcode, length = op.RECORD.unpack_from(head)
        after = position + 9 + int(length)
        believed = length <= (MAX_FILE if opcode in (op.ATTACHMENT, op.MESSAGE) else MAX_RECORD)
        messages = None
        if opcode in NO_MESSAGES and believed and not self._may_be_message(head):
            messages = 0
        if opcode == op.MESSAGE and believed and after > self.size and not self.closed:
            messages = 1
        if not self._bytes.plausible(after) and after != self._bytes.end:
            found = self._find_next(position + 1, opcode)
            if found is not None or after < self._bytes.end or self.closed:
                messages = None  # others may have been there, or inside
            after = self._bytes.end if found is None else found
        self.note_damage(Damage(position, after - position, reason, messages))
        return after

    def _may_be_message(self, head: bytes) -> bool:
        """Whether the record that begins so can be a message of which the type is wrong."""
        _, length = op.RECORD.unpack_from(head)
        return length >= op.MESSAGE_FIXED and U16.unpack_from(head, 9)[0] in self.channels

    def _find_next(self, position: int, opcode: int) -> int | None:
        """Where a chunk begins at or after ``position``, or in a file without chunks a record.

        ``opcode``: type of the damaged record. Messages within a chunk of which the head is damaged
        are not looked for, as its checksum is lost.
        """
        found = self._bytes.find_chunk(position)
        indexed = self.summary is not None and len(self.summary.chunks)
        if found is not None or self.chunk_count or indexed or opcode == op.CHUNK:
            return found
        return self._bytes.find(RECORD_START, position, self._records_from)

    def _records_from(self, position: int, more: int = 2) -> bool:
        """Whether a record and ``more`` after it follow one another here, or up to the end.

        The first must be a message of a known channel, a definition or the end mark.
        """
        head = self.read_at(position, 11)
        if len(head) < 11:
            return False
        opcode, length = op.RECORD.unpack_from(head)
        after, cut = position + 9 + int(length), more < 2 and not self.closed
        if opcode == op.MESSAGE:
            channel = U16.unpack_from(head, 9)[0]
            valid = length >= op.MESSAGE_FIXED and (more < 2 or channel in self.channels)
        elif opcode == op.DATA_END:
            valid = 4 <= length <= WINDOW
        elif opcode in (op.SCHEMA, op.CHANNEL):
            if length > MAX_RECORD:
                return False
            try:
                body = self.read_at(position + 9, length)
                parse_schema(body) if opcode == op.SCHEMA else parse_channel(body)
            except BadRecordError:
                return cut and after > self._bytes.end
            valid = True
        else:
            valid = more < 2 and self._bytes.plausible(position)
        if not valid or after > self._bytes.end:
            return valid and cut
        if not more or after == self._bytes.end:
            return True
        return self._records_from(after, more - 1)

    def note_damage(self, damage: Damage) -> None:
        """Count a damage; the first MAX_DAMAGES are kept."""
        self.damage_count += 1
        self.bytes_damaged += damage.length
        self.messages_lost += damage.messages or 0
        self.lost_unknown += damage.messages is None
        if len(self.damages) < MAX_DAMAGES:
            self.damages.append(damage)


def _one_bit_from_message(opcode: int) -> bool:
    return (opcode ^ op.MESSAGE).bit_count() == 1


def read_messages(
    path: Path, topics: Collection[str] | None = None
) -> Iterator[tuple[ChannelRecord, Message]]:
    """Yield the messages of a log in file order, whole or cut off; all, or those of ``topics``.

    Raises `LogError` if the file is not a log. Damaged parts are skipped.
    """
    with LogReader(path) as reader:
        for event in reader.events():
            if not isinstance(event, Block):
                continue
            for message in reader.messages(event):
                channel = reader.channels.get(message.channel)
                if channel is not None and (topics is None or channel.topic in topics):
                    yield channel, message


def check_readable(path: Path) -> None:
    """Raise `LogError` unless the records of a log form a valid sequence up to its end.

    Chunks are not decompressed: it is a cheap check before older files are deleted.
    """
    with LogReader(path) as reader:
        reader.check_structure()
