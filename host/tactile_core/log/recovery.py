"""Recovers a complete log from one that was cut off or damaged."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import zstandard

from tactile_core.log.mcap_file import (
    ZSTD_LEVEL,
    ChunkBuffer,
    DiskStorage,
    McapFile,
    SealedChunk,
)
from tactile_core.log.reader import LogReader
from tactile_core.log.records import (
    AttachmentRecord,
    Block,
    ChannelRecord,
    Damage,
    LogError,
    MetadataRecord,
    Progress,
)

CHUNK_BYTES = 1 << 18
"""Size in bytes of chunks made from small blocks and from messages outside chunks.

Larger blocks with a right checksum are copied as they are.
"""

SUSPECT = "suspect"
"""Metadata table of a recovered log that marks a kept block with a wrong checksum."""


class RecoveryError(Exception):
    """The recovered log cannot be written; the message names the remedy."""


@dataclass(slots=True)
class RecoveryReport:
    """What was copied from ``source`` to ``target`` and what was not.

    ``messages_lost``: those known from indexes; ``lost_unknown``: damaged places with an unknown
    number of messages. ``orphans``: messages left out because their channel is not defined.
    ``suspect``: messages kept although the checksum of their block is wrong.
    """

    source: Path
    target: Path
    size: int
    was_closed: bool = False
    messages: int = 0
    attachments: int = 0
    metadata: int = 0
    orphans: int = 0
    suspect: int = 0
    messages_lost: int = 0
    lost_unknown: int = 0
    bytes_lost: int = 0
    damage_count: int = 0
    damages: list[Damage] = field(default_factory=list)
    start_ns: int | None = None
    end_ns: int | None = None


def recover(
    source: Path,
    target: Path,
    progress: Progress | None = None,
    *,
    keep_suspect: bool = False,
    mend: Callable[[ChannelRecord], Mapping[str, str]] | None = None,
) -> RecoveryReport:
    """Write everything readable of ``source`` to the new file ``target``. Constant memory.

    ``keep_suspect``: also keep what looks readable in blocks and attachments with a wrong checksum;
    a table ``suspect`` in the target marks these messages. ``mend``: returns the metadata of a
    channel in the target; None keeps it. Raises `LogError` if the source is not a log or holds
    nothing, `RecoveryError` if the target exists or cannot be written; no target is left behind
    then. The source is only read.
    """
    report = RecoveryReport(source, target, 0)
    with LogReader(source, progress, keep_suspect=keep_suspect) as reader:
        report.size = reader.size
        out = _Copy(reader, target, report, mend)
        try:
            for event in reader.events():
                out.take(event)
            out.finish()
        except FileExistsError as error:
            raise RecoveryError(f"{target} exists and is not overwritten: name another") from error
        except OSError as error:
            out.discard()
            raise RecoveryError(
                f"cannot write {target}: {error.strerror}; name a place with room to write to"
            ) from error
        except BaseException:
            out.discard()
            raise
        report.was_closed = reader.closed
        report.damages, report.damage_count = reader.damages, reader.damage_count
        report.bytes_lost = reader.bytes_damaged
        report.messages_lost = reader.messages_lost
        report.lost_unknown = reader.lost_unknown
        report.suspect = reader.suspect
    return report


class _Copy:
    """The target of a recovery, created with the first thing worth keeping."""

    def __init__(
        self,
        reader: LogReader,
        target: Path,
        report: RecoveryReport,
        mend: Callable[[ChannelRecord], Mapping[str, str]] | None,
    ) -> None:
        self._mend = mend
        self._reader = reader
        self._target = target
        self._report = report
        self._file: McapFile | None = None
        self._compressor = zstandard.ZstdCompressor(level=ZSTD_LEVEL)
        self._channels: set[int] = set()
        self._schemas: set[int] = set()
        self._chunk = ChunkBuffer()

    def take(self, event: Block | MetadataRecord | AttachmentRecord) -> None:
        """Copy one event."""
        file = self._file or self._open()
        report = self._report
        if not isinstance(event, Block):
            self._flush(file)
        if isinstance(event, MetadataRecord):
            file.add_metadata(event.name, event.values)
            report.metadata += 1
        elif isinstance(event, AttachmentRecord):
            self._attachment(file, event)
        else:
            self._block(file, event)
            return
        file.commit()

    def _open(self) -> McapFile:
        reader = self._reader
        try:
            file = McapFile(self._target, DiskStorage(), reader.library, reader.profile)
        except FileExistsError:
            raise
        except OSError:
            with contextlib.suppress(OSError):
                os.unlink(self._target)  # created, but its start could not be written
            raise
        self._file = file
        return file

    def finish(self) -> None:
        """Close the target. Raises `LogError` if it is empty."""
        if self._file is None:
            reader = self._reader
            hint = ""
            if not reader.keep_suspect and any("checksum" in d.reason for d in reader.damages):
                hint = " and whose checksum is right; --keep-suspect takes what looks readable"
            raise LogError(f"{self._report.source} holds nothing that can be read{hint}")
        self._flush(self._file)
        self._file.finish()
        self._file = None

    def discard(self) -> None:
        """Remove a target that could not be completed."""
        if self._file is not None:
            self._file.abandon()
            os.unlink(self._target)
            self._file = None

    def _attachment(self, file: McapFile, event: AttachmentRecord) -> None:
        pieces = self._reader.pieces_at(event.position, event.size)
        file.copy_attachment(
            event.name, event.media_type, event.size, pieces, event.log_ns, event.create_ns
        )
        self._report.attachments += 1

    def _block(self, file: McapFile, event: Block) -> None:
        reader, report, channels = self._reader, self._report, self._channels
        if event.suspect:
            self._flush(file)
        if self._copy_block(file, event):
            return
        for message in reader.messages(event):
            if message.channel not in channels:
                channel = reader.channels.get(message.channel)
                if channel is None:
                    report.orphans += 1
                    continue
                self._define(file, channel)
            self._chunk.add(
                message.channel,
                message.sequence,
                message.log_ns,
                message.publish_ns,
                message.data,
            )
            if len(self._chunk.data) >= CHUNK_BYTES:
                self._flush(file, event.suspect)
        if event.suspect:
            self._flush(file, suspect=True)

    def _copy_block(self, file: McapFile, event: Block) -> bool:
        """Copy the compressed bytes of a block; False if its messages must be copied one by one.

        The bytes are those whose checksum was right, and the index is made anew from them. A block
        that defines channels, or holds messages of unknown ones, would not be the same afterwards.
        """
        if not event.frame or not event.verified or len(event.data) < CHUNK_BYTES:
            return False
        index = self._reader.index(event, self._channels)
        if index is None:
            return False
        self._flush(file)
        self._add(file, ChunkBuffer.copy(event.frame, len(event.data), event.crc, index))
        return True

    def _flush(self, file: McapFile, suspect: bool = False) -> None:
        """Write the collected messages as one chunk."""
        chunk, report = self._chunk, self._report
        if not chunk.messages:
            return
        self._chunk = ChunkBuffer()
        if suspect:
            span = {"first_ns": str(chunk.start_ns), "last_ns": str(chunk.end_ns)}
            file.add_metadata(SUSPECT, span | {"messages": str(chunk.messages)})
            report.metadata += 1
        self._add(file, chunk.seal(self._compressor))

    def _add(self, file: McapFile, chunk: SealedChunk) -> None:
        report = self._report
        file.add_chunk(chunk)
        report.messages += chunk.messages
        if report.start_ns is None or report.end_ns is None:
            report.start_ns, report.end_ns = chunk.start_ns, chunk.end_ns
        report.start_ns = min(report.start_ns, chunk.start_ns)
        report.end_ns = max(report.end_ns, chunk.end_ns)
        file.commit()

    def _define(self, file: McapFile, channel: ChannelRecord) -> None:
        """Define the channel in the target, without a type if its schema is lost."""
        if channel.number in self._channels:
            return
        schema = self._reader.schemas.get(channel.schema)
        if schema is not None and schema.number not in self._schemas:
            file.add_schema(schema.number, schema.name, schema.encoding, schema.data)
            self._schemas.add(schema.number)
        number = 0 if schema is None else schema.number
        metadata = channel.metadata if self._mend is None else self._mend(channel)
        file.add_channel(channel.number, number, channel.topic, channel.encoding, metadata)
        self._channels.add(channel.number)
