"""A log as bytes: reading at a place, and finding where chunks begin."""

from __future__ import annotations

import os
import re
import stat
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

from tactile_bus import mcap_file as op
from tactile_bus.log_records import U32, U64, ChunkHead, LogError

Progress = Callable[[int, int], None]
"""Called with the bytes done and those there are in all."""

WINDOW = 1 << 20
"""Bytes read at once while looking for the next chunk."""

CHUNK_START = re.compile(rb"(?=\x06.{4}\x00{4})", re.DOTALL)
CHUNK_FIXED = 40  # bytes of a chunk record but for its compression's name and its data


class LogBytes:
    """Random access to a log. ``end``: where its data ends, for all that searches."""

    def __init__(self, path: Path, progress: Progress | None) -> None:
        self.path = path
        self.size = 0
        self.end = 0
        self._progress = progress
        self._file: BinaryIO | None = None

    def open(self) -> None:
        """Open the file; `LogError` when it is none or cannot be read."""
        try:
            if not stat.S_ISREG(os.stat(self.path).st_mode) and not self.path.is_dir():
                raise LogError(f"{self.path} is no file but a device or a pipe")
            self._file = open(self.path, "rb")  # noqa: SIM115 - closed by close()
            self.size = self.end = os.fstat(self._file.fileno()).st_size
        except OSError as error:
            raise LogError(f"{self.path}: {error.strerror}") from error

    def close(self) -> None:
        """Let go of the file."""
        if self._file is not None:
            self._file.close()

    def read_at(self, position: int, size: int) -> bytes:
        """Bytes of the file; fewer at its end. `LogError` when the disk fails."""
        if self._file is None:
            raise ValueError("the log is not open")
        try:
            self._file.seek(position)
            return self._file.read(size)
        except OSError as error:
            raise LogError(f"{self.path}: {error.strerror} at byte {position}") from error

    def chunk_head(self, position: int) -> ChunkHead | None:
        """Header of a chunk at ``position``, or None when its sizes do not agree."""
        raw = self.read_at(position, 9 + CHUNK_FIXED + 4)
        if len(raw) < 9 + CHUNK_FIXED or raw[0] != op.CHUNK:
            return None
        (length,) = U64.unpack_from(raw, 1)
        start, end, size, crc = op.CHUNK_HEAD.unpack_from(raw, 9)
        (name_length,) = U32.unpack_from(raw, 37)
        name = raw[41 : 41 + name_length]
        if name_length > 4 or name not in (b"", b"lz4", b"zstd"):
            return None
        if len(raw) < 41 + name_length + 8:
            return None
        (data_length,) = U64.unpack_from(raw, 41 + name_length)
        if data_length + CHUNK_FIXED + name_length != length:
            return None
        return ChunkHead(start, end, size, crc, name.decode(), data_length)

    def find_chunk(self, position: int) -> int | None:
        """Offset of the first whole, plausible chunk at or after ``position``."""
        while position < self.end:
            window = self.read_at(position, WINDOW + 16)
            for match in CHUNK_START.finditer(window):
                at = position + match.start()
                head = self.chunk_head(at)
                if head is not None:
                    end = at + 9 + CHUNK_FIXED + len(head.compression) + head.data_length
                    if end <= self.end:
                        return at
            if self._progress is not None:
                self._progress(position, self.size)
            position += WINDOW
        return None

    def plausible(self, position: int) -> bool:
        """Whether a record seems to begin here; a chance hit is one in 10^10."""
        if position >= self.end:
            return False
        head = self.read_at(position, 9)
        if len(head) < 9:
            return False
        opcode, length = op.RECORD.unpack(head)
        if opcode == op.CHUNK:
            return self.chunk_head(position) is not None
        return 0 < opcode <= op.DATA_END and position + 9 + int(length) <= self.size
