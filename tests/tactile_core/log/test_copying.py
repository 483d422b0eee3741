"""How a log is copied and closed: blocks as they are, an index that does not fill the memory."""

from __future__ import annotations

import random
import tempfile
import tracemalloc
import zlib
from pathlib import Path
from typing import Any

import pytest
import zstandard
from mcap.reader import make_reader

from tactile_core.log.mcap_file import (
    INDEX_BYTES,
    ChunkBuffer,
    DiskStorage,
    McapFile,
    SealedChunk,
)
from tactile_core.log.reader import LogReader, read_messages
from tactile_core.log.recovery import CHUNK_BYTES, recover

BASE_NS = 1_700_000_000_000_000_000


def chunk_of(first: int, channels: int = 1, size: int = 1000, count: int = 400) -> ChunkBuffer:
    """Messages of bytes that do not compress, in turn on channels 1 and up; times go back once."""
    chunk, chance = ChunkBuffer(), random.Random(first)
    for i in range(first, first + count):
        at = BASE_NS + (i ^ 1) * 1000
        chunk.add(1 + i % channels, i, at, at, chance.randbytes(size))
    return chunk


def write(path: Path, chunks: list[SealedChunk], channels: int = 1) -> None:
    file = McapFile(path, DiskStorage(), "t")
    for number in range(1, channels + 1):
        file.add_channel(number, 0, f"/t{number}", "json", {})
    for chunk in chunks:
        file.add_chunk(chunk)
    file.finish()


def test_large_blocks_are_copied_as_they_are(tmp_path: Path) -> None:
    source, target = tmp_path / "a.mcap", tmp_path / "b.mcap"
    packer = zstandard.ZstdCompressor(level=19)
    chunks = [chunk_of(first, 3) for first in (0, 400, 800)]
    assert len(chunks[0].data) > CHUNK_BYTES
    write(source, [chunk.seal(packer) for chunk in chunks], 3)
    report = recover(source, target)
    assert (report.messages, report.start_ns) == (1200, BASE_NS)
    assert list(read_messages(target)) == list(read_messages(source))
    # The first defines the channels in the copy, so its messages are copied one by one.
    copied = target.read_bytes()
    assert [packer.compress(chunk.data) in copied for chunk in chunks] == [False, True, True]
    with target.open("rb") as file:
        found = list(make_reader(file, validate_crcs=True).iter_messages(["/t2"]))
    assert [message.sequence for _, _, message in found] == sorted(
        range(1, 1200, 3), key=lambda i: i ^ 1
    )
    with LogReader(target) as reader:
        for event in reader.events():
            list(reader.messages(event))  # type: ignore[arg-type]  # only blocks are in there
        assert reader.indexed
        assert not reader.damages


def test_bytes_after_the_compressed_messages_are_not_copied(tmp_path: Path) -> None:
    source, target = tmp_path / "a.mcap", tmp_path / "b.mcap"
    packer = zstandard.ZstdCompressor()
    chunks = [chunk_of(first) for first in (0, 400)]
    sealed = [
        ChunkBuffer.copy(packer.compress(c.data) + b"what is this", len(c.data), crc_of(c), c.index)
        for c in chunks
    ]
    write(source, sealed)
    report = recover(source, target)
    assert (report.messages, report.damage_count) == (800, 0)
    assert b"what is this" in source.read_bytes()
    assert b"what is this" not in target.read_bytes()


def crc_of(chunk: ChunkBuffer) -> int:
    return zlib.crc32(chunk.data)


def long_log(path: Path, chunks: int) -> int:
    """Write a log of many chunks of 300 channels. Returns the most memory that it took, bytes."""
    chunk = chunk_of(0, 300, 1, 300).seal(zstandard.ZstdCompressor())
    tracemalloc.start()
    try:
        file = McapFile(path, DiskStorage(), "t")
        for number in range(1, 301):
            file.add_channel(number, 0, f"/t{number}", "json", {})
        for _ in range(chunks):
            file.add_chunk(chunk)
            file.commit()
        file.finish()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def test_the_index_of_a_long_log_waits_on_the_disk(tmp_path: Path) -> None:
    most = [long_log(tmp_path / f"{count}.mcap", count) for count in (1000, 2000)]
    assert max(most) < 2 * INDEX_BYTES  # the index has 3 and 6 MB
    assert sorted(path.name for path in tmp_path.iterdir()) == ["1000.mcap", "2000.mcap"]
    with (tmp_path / "2000.mcap").open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    assert len(summary.chunk_indexes) == 2000
    assert len({index.chunk_start_offset for index in summary.chunk_indexes}) == 2000


def test_an_index_that_the_disk_does_not_take_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(**_: Any) -> Any:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(tempfile, "TemporaryFile", full)
    long_log(tmp_path / "a.mcap", 500)
    with LogReader(tmp_path / "a.mcap") as reader:
        summary = reader.summarize()
    assert summary is not None
    assert len(summary.chunks) == 500
    assert summary.checked
