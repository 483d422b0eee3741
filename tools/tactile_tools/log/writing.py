"""Write a new log of messages from others: channels and types are renumbered; all or nothing."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from types import TracebackType

import zstandard

from tactile_core.log.mcap_file import ZSTD_LEVEL, ChunkBuffer, DiskStorage, McapFile
from tactile_tools.log.stream import Attachment, Record, Stream
from tactile_tools.log.terminal import cannot_write

CHUNK_BYTES = 1 << 20
"""The same as the recorder's."""


class LogOutput:
    """Writes ``path``, which appears when it is complete; a context manager.

    `ToolError` with the remedy where the system refuses; nothing is left behind.
    """

    def __init__(self, path: Path, profile: str = "ros2") -> None:
        self.path = path
        self.messages = 0
        self._part = path.with_name(f".{path.name}.{os.getpid()}.part")
        self._streams: dict[Stream, int] = {}
        self._schemas: dict[tuple[str, str, bytes], int] = {}
        self._sequences: dict[Stream, int] = {}
        self._chunk = ChunkBuffer()
        self._compressor = zstandard.ZstdCompressor(level=ZSTD_LEVEL)
        try:
            self._part.unlink(missing_ok=True)
            library = f"tactile-reach {version('tactile-reach')}"
            self._file = McapFile(self._part, DiskStorage(), library, profile)
        except OSError as error:
            self._drop()
            raise cannot_write(path, error) from error

    def __enter__(self) -> LogOutput:
        """Open the temporary file."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Finish the file and rename it to its place; after an error, delete it."""
        if error is not None:
            self._file.abandon()
            self._drop()
            if isinstance(error, OSError) and not isinstance(error, BrokenPipeError):
                raise cannot_write(self.path, error) from error
            return
        try:
            self._flush()
            self._file.finish()
            self._part.replace(self.path)
        except OSError as failure:
            self._drop()
            raise cannot_write(self.path, failure) from failure

    @property
    def size(self) -> int:
        """Size so far with bytes that wait to be compressed."""
        return self._file.size + len(self._chunk.data)

    def write(self, record: Record, *, renumber: bool = False) -> None:
        """Add a message. ``renumber``: give it the next number of its stream instead of its own."""
        number = self._streams.get(record.stream)
        if number is None:
            number = self._define(record.stream)
        sequence = record.sequence
        if renumber:
            sequence = self._sequences.get(record.stream, 0)
            self._sequences[record.stream] = (sequence + 1) & 0xFFFFFFFF
        self._chunk.add(number, sequence, record.log_ns, record.publish_ns, record.data)
        self.messages += 1
        if len(self._chunk.data) >= CHUNK_BYTES:
            self._flush()

    def declare(self, stream: Stream) -> None:
        """Add a stream, whether or not messages follow."""
        if stream not in self._streams:
            self._define(stream)

    def metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Add a metadata table."""
        self._file.add_metadata(name, values)

    def attach(self, item: Attachment) -> None:
        """Attach a file, piece by piece."""
        self._flush()
        self._file.copy_attachment(
            item.name, item.media_type, item.size, item.pieces(), item.log_ns, item.create_ns
        )

    def _define(self, stream: Stream) -> int:
        schema = 0
        if stream.msgtype:
            key = stream.msgtype, stream.schema_encoding, stream.definition
            schema = self._schemas.get(key, 0)
            if not schema:
                schema = self._schemas[key] = len(self._schemas) + 1
                self._file.add_schema(schema, *key)
        number = self._streams[stream] = len(self._streams) + 1
        metadata = dict(stream.metadata)
        self._file.add_channel(number, schema, stream.topic, stream.encoding, metadata)
        return number

    def _flush(self) -> None:
        if self._chunk.messages:
            self._file.add_chunk(self._chunk.seal(self._compressor))
            self._chunk = ChunkBuffer()
        self._file.commit()

    def _drop(self) -> None:
        with contextlib.suppress(OSError):
            self._part.unlink(missing_ok=True)
