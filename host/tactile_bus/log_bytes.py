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
MAX_NAME = 40  # bytes read of that name and the size behind it

FRAME_STARTS = {"zstd": b"\x28\xb5\x2f\xfd", "lz4": b"\x04\x22\x4d\x18"}


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

    def chunk_head(self, position: int) -> tuple[ChunkHead, int] | None:
        """Header of a chunk at ``position`` and where its data begins; None when it is none.

        The record type is not looked at.
        """
        raw = self.read_at(position, 9 + CHUNK_FIXED + MAX_NAME)
        if len(raw) < 9 + CHUNK_FIXED:
            return None
        return _chunk_head(raw, position)

    def looks_like_chunk(self, position: int) -> bool:
        """Whether a chunk begins here for all that can be told: for searching amid other bytes.

        Its sizes agree to the byte, or (fields may have been appended) its data begin as such do.
        The record type is not looked at.
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
        while position < self.end:
            window = self.read_at(position, WINDOW + 16)
            for match in CHUNK_START.finditer(window):
                at = position + match.start()
                (length,) = U64.unpack_from(window, match.start() + 1)
                if at + 9 + length <= self.end and self.looks_like_chunk(at):
                    return at
            if self._progress is not None:
                self._progress(position, self.size)
            position += WINDOW
        return None

    def plausible(self, position: int, steps: int = 4) -> bool:
        """Whether a record seems to begin here; a chance hit is one in 10^10.

        A record of a type that is not known must be followed by one that is.
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


def _chunk_head(raw: bytes, position: int) -> tuple[ChunkHead, int] | None:
    (length,) = U64.unpack_from(raw, 1)
    start, end, size, crc = op.CHUNK_HEAD.unpack_from(raw, 9)
    (name_length,) = U32.unpack_from(raw, 37)
    if name_length > MAX_NAME - 8 or len(raw) < 41 + name_length + 8:
        return None
    (data_length,) = U64.unpack_from(raw, 41 + name_length)
    if data_length + CHUNK_FIXED + name_length > length:
        return None
    try:
        name = raw[41 : 41 + name_length].decode()
    except UnicodeDecodeError:
        return None
    place = position + 9 + CHUNK_FIXED + name_length
    return ChunkHead(start, end, size, crc, name, data_length), place
