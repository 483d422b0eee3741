"""Chunks unpacked: small ones at once, large or doubtful ones piece by piece. Bounded memory.

What a chunk says of its size is never believed: nothing beyond it is unpacked, and nothing is
allocated for it in advance.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterator
from typing import Any

import zstandard

from tactile_bus.log_records import BadRecordError, ChunkHead, Packed

COMPRESSIONS = ("", "zstd", "lz4")
"""Names of the compressions that are unpacked here: all that the format's specification lists."""

SMALL = 8 << 20
"""Bytes of a chunk that is unpacked at once: writers make chunks of 0.8 to 4 MB."""

PIECE = 1 << 16
"""Bytes handed over at a time."""

MAX_WINDOW = 1 << 27
"""Bytes that a zstd frame may look back, which the unpacker keeps: the most that zstd itself takes
without being told otherwise."""

ReadAt = Callable[[int, int], bytes]
"""Reads so many bytes at a place of the file."""


def _lz4() -> Any:
    import importlib

    try:
        return importlib.import_module("lz4.frame")
    except ImportError:
        raise BadRecordError("a chunk in lz4: install the lz4 package") from None


def pieces(read_at: ReadAt, packed: Packed) -> Iterator[bytes]:
    """A chunk's records, a piece at a time; `BadRecordError` where they cannot be unpacked.

    Ends without an error where the packed bytes end early: that is for the caller to notice.
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
    """The little of a file that zstandard's reader asks for."""

    def __init__(self, source: Iterator[bytes]) -> None:
        self._source = source

    def read(self, _: int = -1) -> bytes:
        """The next bytes, whatever was asked for; none at the end."""
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
    """`BadRecordError` unless a chunk unpacks to its size and its checksum."""
    crc = size = 0
    for piece in pieces(read_at, packed):
        crc = zlib.crc32(piece, crc)
        size += len(piece)
    _check(size, crc, packed.head)


def unpack(read_at: ReadAt, packed: Packed) -> bytes:
    """Records of a whole chunk of at most `SMALL` bytes, checked; `BadRecordError`."""
    head = packed.head
    raw = read_at(packed.place, packed.length)
    data: bytes | None = None
    if head.compression == "":
        data = raw
    elif head.compression == "zstd" and _told_size(raw) == head.size > 0:
        try:  # one frame that tells its size, as nearly every writer makes them: at once
            data = zstandard.ZstdDecompressor().decompress(raw, max_output_size=head.size)
        except (zstandard.ZstdError, MemoryError):
            raise BadRecordError("a chunk that does not decompress") from None
    if data is None:
        data = b"".join(pieces(read_at, packed))
    _check(len(data), zlib.crc32(data) if head.crc else 0, head)
    return data


def unpack_what_can_be(read_at: ReadAt, packed: Packed) -> bytes:
    """Records of a chunk up to where it cannot be unpacked any more, unchecked."""
    data = bytearray()
    try:
        for piece in pieces(read_at, packed):
            data += piece
    except BadRecordError:
        pass
    return bytes(data)


def _told_size(raw: bytes) -> int:
    try:
        return zstandard.frame_content_size(raw)
    except zstandard.ZstdError:
        return -1


def _check(size: int, crc: int, head: ChunkHead) -> None:
    if size != head.size:
        raise BadRecordError(f"a chunk that unpacks to {size} bytes and says {head.size}")
    if head.crc and crc != head.crc:
        raise BadRecordError("the checksum of a chunk is wrong")
