"""Reads MCAP logs as they are: finished, cut off, or damaged. Constant memory on any length.

A sound file is read record by record. Where a record cannot be right, reading goes on at the next
chunk, found by its header; everything passed over is reported as `Damage`, never silently.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType

from tactile_bus import mcap_file as op
from tactile_bus.log_bytes import CHUNK_FIXED, WINDOW, LogBytes, Progress
from tactile_bus.log_records import (
    ATTACHMENT_HEAD,
    U32,
    U64,
    AttachmentRecord,
    BadRecordError,
    Block,
    ChannelRecord,
    ChunkHead,
    Cursor,
    Damage,
    Event,
    LogError,
    Message,
    SchemaRecord,
    parse_channel,
    parse_metadata,
    parse_schema,
    unpack,
    unpack_start,
)

MAX_CHUNK = 256 << 20
"""Bytes of one chunk: rosbag2 and Foxglove write 0.8 to 4 MB, this project 1 MB; bounds memory."""

MAX_RECORD = 16 << 20
"""Bytes of a schema, channel or metadata record: real ones are a few kB."""

MAX_DAMAGES = 1000
"""Places reported one by one; beyond that they are only counted."""

FOOTER_SIZE = 9 + 20


@dataclass(slots=True)
class LogReader:
    """One pass over a log, as a context manager. `LogError` when the file is none.

    ``window``: log times, ns, first and last included; chunks wholly outside may be passed over.

    After the pass: ``schemas`` and ``channels`` by number, ``closed`` (the file was finished in
    order), ``damages`` (the first MAX_DAMAGES) and their ``damage_count``, ``bytes_damaged``,
    ``messages_lost`` as far as indexes tell, ``lost_unknown`` places where they do not.
    """

    path: Path
    progress: Progress | None = None
    window: tuple[int, int] | None = None
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
    _bytes: LogBytes = field(init=False)
    _lost_chunk: Damage | None = None
    _summary_checked: bool = False  # its definitions hold: those amid the data have no checksum

    def __post_init__(self) -> None:
        """Prepare; the file is opened on entering the context."""
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

    def read_at(self, position: int, size: int) -> bytes:
        """Bytes of the file; fewer at its end. `LogError` when the disk fails."""
        return self._bytes.read_at(position, size)

    def events(self) -> Iterator[Event]:
        """Everything readable, in the order of the file."""
        position = self._start()
        while position < self._bytes.end:
            if self.progress is not None:
                self.progress(position, self.size)
            try:
                after, event = self._record(position)
            except BadRecordError as error:
                after, event = self._skip(position, str(error)), None
            if event is not None:
                yield event
            if after <= position:
                break
            position = after
        self._settle_lost_chunk()
        if self.progress is not None:
            self.progress(self.size, self.size)

    def messages(self, block: Block) -> Iterator[Message]:
        """Messages of a block; schemas and channels in it are taken up on the way."""
        data, at, end = block.data, 0, len(block.data)
        head, fixed = op.MESSAGE_HEAD, op.MESSAGE_FIXED
        while at + 9 <= end:
            opcode, length = op.RECORD.unpack_from(data, at)
            after = at + 9 + length
            if after > end:
                break  # the last record of a chunk that was cut off
            if opcode == op.MESSAGE and length >= fixed:
                _, _, channel, sequence, log_ns, publish_ns = head.unpack_from(data, at)
                yield Message(channel, sequence, log_ns, publish_ns, data[at + 31 : after])
            elif opcode in (op.SCHEMA, op.CHANNEL):
                try:
                    self._define(opcode, data[at + 9 : after])
                except BadRecordError as error:
                    self._damaged(Damage(block.offset, 0, str(error)))
            at = after

    def check_structure(self) -> None:
        """`LogError` unless the records follow one another soundly; chunks are not unpacked."""
        position = self._start()
        while position < self._bytes.end and not self.damage_count:
            opcode, length = op.RECORD.unpack(self.read_at(position, 9).ljust(9, b"\0"))
            after = position + 9 + length
            if (opcode == op.CHUNK and self._bytes.chunk_head(position) is None) or (
                not 0 < opcode <= op.DATA_END and opcode < 0x80
            ):
                raise LogError(f"{self.path}: no record at byte {position}")
            if opcode == op.DATA_END or after > self._bytes.end:
                break
            position = after
        if self.damage_count:
            raise LogError(f"{self.path}: {self.damages[0].reason}")

    def _start(self) -> int:
        """Where the first record is; finds out whether the file was finished, and how it ends."""
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
                raise LogError(f"{self.path} is no MCAP file")
            self._damaged(Damage(0, first, "the start of the file is overwritten"))
            self._read_summary()
            return first
        self._read_summary()
        return 8

    def _read_summary(self) -> None:
        """Take schemas and channels from the summary of a finished file, and note where it is."""
        tail = self.read_at(max(self.size - FOOTER_SIZE - 8, 0), FOOTER_SIZE + 8)
        if len(tail) != FOOTER_SIZE + 8 or tail[-8:] != op.MAGIC or tail[0] != op.FOOTER:
            return
        start, _, crc = struct.unpack_from("<QQI", tail, 9)
        length = self.size - 12 - start  # all that its checksum covers
        if start == 0:
            self.closed = True
            self._bytes.end = self.size - FOOTER_SIZE - 8
            return
        if not 8 <= start <= self.size - FOOTER_SIZE - 8 or length > MAX_CHUNK:
            return
        summary = self.read_at(start, length)
        if crc != 0 and zlib.crc32(summary) != crc:
            self._damaged(Damage(start, length, "the checksum of the summary is wrong"))
            return
        self.closed = True
        self._bytes.end = start
        self._take_definitions(start, summary)
        self._summary_checked = crc != 0

    def _take_definitions(self, start: int, summary: bytes) -> None:
        at = 0
        while at + 9 <= len(summary):
            opcode, size = op.RECORD.unpack_from(summary, at)
            if opcode in (op.SCHEMA, op.CHANNEL):
                try:
                    self._define(opcode, summary[at + 9 : at + 9 + size])
                except BadRecordError as error:
                    self._damaged(Damage(start + at, size, f"in the summary: {error}"))
            at += 9 + size

    def _record(self, position: int) -> tuple[int, Event | None]:
        """The record at ``position`` and where the next one is."""
        head = self.read_at(position, 9)
        if len(head) < 9:
            raise BadRecordError("cut off within a record")
        opcode, length = op.RECORD.unpack(head)
        after = position + 9 + length
        if opcode != op.MESSAGE_INDEX:
            self._settle_lost_chunk()
        if opcode == op.CHUNK:
            return self._chunk(position, length)
        if after > self._bytes.end:
            raise BadRecordError("cut off within a record")
        if opcode == op.MESSAGE_INDEX:
            self._message_index(length)
        elif opcode == op.ATTACHMENT:
            return after, self._attachment(position, length)
        elif opcode == op.DATA_END:
            if length != 4 or (self.closed and after != self._bytes.end):
                raise BadRecordError("an end mark amid the data")
            return self._after_end_mark(position, after), None
        elif opcode in (op.HEADER, op.SCHEMA, op.CHANNEL, op.METADATA, op.MESSAGE):
            if length > MAX_RECORD:
                raise BadRecordError(f"a record of {length} bytes")
            return after, self._small(opcode, position, self.read_at(position + 9, length))
        elif opcode < 0x80:  # 0x80 and up are anyone's own records
            raise BadRecordError(f"record type {opcode} amid the data")
        return after, None

    def _after_end_mark(self, position: int, after: int) -> int:
        """An end mark without a summary that fits: the file was cut off while being finished."""
        if not self.closed and self._bytes.find_chunk(after) is not None:
            raise BadRecordError("an end mark amid the data")
        if not self.closed:
            self._damaged(Damage(position, self.size - position, "cut off within the summary", 0))
        return self._bytes.end

    def _small(self, opcode: int, position: int, body: bytes) -> Event | None:
        if opcode == op.MESSAGE:
            if len(body) < op.MESSAGE_FIXED:
                raise BadRecordError("a message is shorter than its fields")
            return Block(position, op.RECORD.pack(opcode, len(body)) + body, False)
        if opcode == op.METADATA:
            return parse_metadata(body)
        if opcode == op.HEADER:
            cursor = Cursor(body)
            self.profile, self.library = cursor.string(), cursor.string()
            return None
        self._define(opcode, body)
        return None

    def _define(self, opcode: int, body: bytes) -> None:
        """Take up a schema or a channel, unless the summary has it already."""
        if opcode == op.SCHEMA:
            schema = parse_schema(body)
            if not (self._summary_checked and schema.number in self.schemas):
                self.schemas[schema.number] = schema
        else:
            channel = parse_channel(body)
            if not (self._summary_checked and channel.number in self.channels):
                self.channels[channel.number] = channel

    def _chunk(self, position: int, length: int) -> tuple[int, Event | None]:
        head = self._bytes.chunk_head(position)
        if head is None:
            raise BadRecordError("a chunk whose sizes do not agree")
        after = position + 9 + length
        place = position + 9 + CHUNK_FIXED + len(head.compression)
        if after > self._bytes.end:
            if self._bytes.find_chunk(position + 1) is not None:
                raise BadRecordError("a chunk that is longer than the file")
            rest = self.read_at(place, self._bytes.end - place)
            self._damaged(
                Damage(
                    position,
                    self._bytes.end - position,
                    "cut off within a chunk",
                    None,
                    head.start_ns,
                    head.end_ns,
                )
            )
            return self._bytes.end, Block(position, unpack_start(rest, head), False)
        if head.size > MAX_CHUNK or length > MAX_CHUNK:
            self._lose_chunk(position, after, head, f"a chunk of {head.size} bytes")
            return after, None
        if self.window is not None and self._summary_checked:  # else it may define channels
            first, last = self.window
            if head.end_ns < first or head.start_ns > last:
                return after, None
        try:
            data = unpack(self.read_at(place, head.data_length), head)
        except BadRecordError as error:
            self._lose_chunk(position, after, head, str(error))
            return after, None
        return after, Block(position, data, head.crc != 0)

    def _lose_chunk(self, position: int, after: int, head: ChunkHead, reason: str) -> None:
        """Note a chunk that is lost; the indexes behind it will say how many messages it had."""
        self._lost_chunk = Damage(position, after - position, reason, 0, head.start_ns, head.end_ns)

    def _settle_lost_chunk(self) -> None:
        lost, self._lost_chunk = self._lost_chunk, None
        if lost is not None:
            known = lost.messages or None  # no index followed: nobody knows
            self._damaged(
                Damage(lost.offset, lost.length, lost.reason, known, lost.first_ns, lost.last_ns)
            )

    def _message_index(self, length: int) -> None:
        if length < 6 or (length - 6) % 16:
            raise BadRecordError("a message index of impossible length")
        lost = self._lost_chunk
        if lost is not None:
            entries = (lost.messages or 0) + (length - 6) // 16
            self._lost_chunk = Damage(
                lost.offset, lost.length, lost.reason, entries, lost.first_ns, lost.last_ns
            )

    def _attachment(self, position: int, length: int) -> AttachmentRecord | None:
        head = Cursor(self.read_at(position + 9, min(length, MAX_RECORD)))
        log_ns, create_ns = head.take(ATTACHMENT_HEAD)
        name, media_type = head.string(), head.string()
        (size,) = head.take(U64)
        if head.at + size + 4 != length:
            raise BadRecordError("an attachment whose sizes do not agree")
        start = position + 9 + head.at
        crc, at = 0, position + 9
        while at < start + size:
            piece = self.read_at(at, min(WINDOW, start + size - at))
            crc = zlib.crc32(piece, crc)
            at += len(piece)
        (stored,) = U32.unpack(self.read_at(start + size, 4))
        if stored not in (0, crc):
            reason = f"the checksum of attachment {name!r} is wrong"
            self._damaged(Damage(position, length + 9, reason, 0))
            return None
        return AttachmentRecord(name, media_type, log_ns, create_ns, start, size)

    def _skip(self, position: int, reason: str) -> int:
        """Pass over what cannot be read: one record where its length leads to another, or else
        all up to the next chunk or the end of the data."""
        self._settle_lost_chunk()
        head = self.read_at(position, 9)
        after = position + 9 + op.RECORD.unpack(head)[1] if len(head) == 9 else self._bytes.end
        if not self._bytes.plausible(after):
            found = self._bytes.find_chunk(position + 1)
            after = self._bytes.end if found is None else found
        self._damaged(Damage(position, after - position, reason))
        return after

    def _damaged(self, damage: Damage) -> None:
        self.damage_count += 1
        self.bytes_damaged += damage.length
        self.messages_lost += damage.messages or 0
        self.lost_unknown += damage.messages is None
        if len(self.damages) < MAX_DAMAGES:
            self.damages.append(damage)


def read_messages(
    path: Path, topics: Collection[str] | None = None
) -> Iterator[tuple[ChannelRecord, Message]]:
    """Messages of a log in the order of the file, whole or cut off; all, or those of ``topics``.

    `LogError` when the file is no log. Damaged stretches are passed over.
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
    """`LogError` unless the records of a log follow one another soundly to its end.

    Chunks are not decompressed: meant to be cheap, before older files are deleted.
    """
    with LogReader(path) as reader:
        reader.check_structure()
