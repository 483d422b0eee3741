"""Logs cut off or damaged, and files that are not logs: a clear result, all readable data."""

from __future__ import annotations

import io
import random
import struct
import tracemalloc
from pathlib import Path
from typing import Any

import pytest
import zstandard
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from tactile_core.bus import topics
from tactile_core.bus.messages import codec
from tactile_core.log.info import info
from tactile_core.log.mcap_file import CHUNK, MAGIC, ChunkBuffer, DiskStorage, McapFile
from tactile_core.log.reader import read_messages
from tactile_core.log.records import LogError
from tactile_core.log.recovery import RecoveryError, recover

BASE_NS = 1_700_000_000_000_000_000
CHUNKS, PER_CHUNK = 6, 20


def write_log(path: Path, payload: bytes, chunks: int = CHUNKS, finish: bool = True) -> list[int]:
    """Write a log of ``chunks`` chunks; returns the offset of each and of the end of the data."""
    file = McapFile(path, DiskStorage(), "test 1")
    schema = codec().schema(topics.RAW)
    file.add_schema(1, schema.name, schema.encoding, schema.data)
    file.add_channel(1, 1, "/tactile/b0/raw", "cdr", {})
    file.add_metadata("software", {"version": "1.2.3"})
    file.add_attachment("cal.toml", "application/toml", b"x = 1\n" * 50, BASE_NS, BASE_NS)
    offsets = []
    file.commit()
    for number in range(chunks):
        offsets.append(file.size)
        chunk = ChunkBuffer()
        for i in range(PER_CHUNK):
            sequence = number * PER_CHUNK + i
            chunk.add(1, sequence, BASE_NS + sequence * 10_000_000, BASE_NS, payload)
        file.add_chunk(chunk.seal(zstandard.ZstdCompressor()))
        file.commit()
    offsets.append(file.size)
    if finish:
        file.finish()
    else:
        file.abandon()
    return offsets


@pytest.fixture
def payload(payloads: Any) -> bytes:
    data: bytes = payloads[topics.RAW]
    return data


@pytest.fixture
def log(tmp_path: Path, payload: bytes) -> tuple[Path, list[int]]:
    path = tmp_path / "log.mcap"
    return path, write_log(path, payload)


def recovered(path: Path) -> Any:
    """Recover a log, check that other readers accept the result, and return the report."""
    target = path.with_name("out.mcap")
    target.unlink(missing_ok=True)
    report = recover(path, target)
    assert info(target).whole
    with target.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        assert sum(1 for _ in reader.iter_messages()) == report.messages
    return report


def test_intact_log_is_copied_completely(log: Any) -> None:
    path, _ = log
    found = info(path)
    assert found.whole
    assert found.messages == CHUNKS * PER_CHUNK
    assert found.metadata == {"software": {"version": "1.2.3"}}
    assert found.attachments == {"cal.toml": ("application/toml", 300)}
    assert found.channels[0].rate == pytest.approx(100.0)
    report = recovered(path)
    assert report.was_closed
    assert (report.messages, report.attachments, report.metadata) == (CHUNKS * PER_CHUNK, 1, 1)
    assert (report.damage_count, report.bytes_lost, report.messages_lost) == (0, 0, 0)


def test_log_cut_anywhere_is_reported_and_keeps_everything_before(log: Any, tmp_path: Path) -> None:
    path, offsets = log
    data = path.read_bytes()
    rng = random.Random(5)
    places = {0, 1, 7, 8, 9, 20, len(data) - 1, len(data) - 8, len(data) - 9, *offsets}
    places |= {offset + d for offset in offsets for d in (-1, 1, 9, 40, 60)}
    places |= {rng.randrange(len(data)) for _ in range(80)}
    cut = tmp_path / "cut.mcap"
    for size in sorted(places):
        cut.write_bytes(data[:size])
        complete = sum(1 for end in offsets[1:] if end <= size)
        if size < offsets[0]:
            if size < 8:
                with pytest.raises(LogError, match=r"empty|cut off"):
                    info(cut)
            else:
                assert info(cut).messages == 0
            continue
        found = info(cut)
        assert not found.closed, size
        assert not found.whole
        # The chunk record may be complete although its index is not.
        assert found.messages - complete * PER_CHUNK in range(PER_CHUNK + 1), size
        assert recovered(cut).messages == found.messages
    assert len(places) > 100


def test_complete_blocks_of_a_truncated_chunk_are_kept(tmp_path: Path) -> None:
    path = tmp_path / "big.mcap"
    rng = random.Random(1)
    sent = [rng.randbytes(20_000) for _ in range(PER_CHUNK)]  # 400 kB: several zstd blocks
    chunk = ChunkBuffer()
    for i, data in enumerate(sent):
        chunk.add(1, i, BASE_NS + i, BASE_NS, data)
    file = McapFile(path, DiskStorage(), "test")
    file.add_channel(1, 0, "/raw", "", {})
    file.add_chunk(chunk.seal(zstandard.ZstdCompressor()))
    file.commit()
    file.abandon()
    path.write_bytes(path.read_bytes()[:300_000])
    report = recovered(path)
    assert 5 <= report.messages < PER_CHUNK
    kept = [m.data for _, m in read_messages(path.with_name("out.mcap"))]
    assert kept == sent[: len(kept)]


def test_messages_with_lost_schema_are_kept_untyped(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    write_log(path, b"data", finish=False)
    data = bytearray(path.read_bytes())
    at = data.index(b"tactile_msgs/msg/RawChunk")
    data[at] = 0xFF  # invalid UTF-8: the schema is unreadable
    path.write_bytes(data)
    report = recovered(path)
    assert report.messages == CHUNKS * PER_CHUNK
    assert info(path.with_name("out.mcap")).channels[0].msgtype == ""


def test_chunk_with_bad_checksum_is_dropped_and_counted(log: Any) -> None:
    path, offsets = log
    data = bytearray(path.read_bytes())
    data[offsets[2] + 9 + 24] ^= 1  # the stored checksum
    path.write_bytes(data)
    found = info(path)
    assert found.closed
    assert not found.whole
    assert found.channels[0].missing == PER_CHUNK
    report = recovered(path)
    assert report.messages == (CHUNKS - 1) * PER_CHUNK
    assert report.messages_lost == PER_CHUNK
    assert report.lost_unknown == 0
    (damage,) = report.damages
    assert damage.offset == offsets[2]
    assert damage.reason == "the checksum of a chunk is wrong"
    assert damage.first_ns == BASE_NS + 2 * PER_CHUNK * 10_000_000
    assert damage.last_ns == BASE_NS + (3 * PER_CHUNK - 1) * 10_000_000


def test_damaged_byte_costs_at_most_its_chunk(log: Any) -> None:
    path, offsets = log
    data = path.read_bytes()
    good = {m.sequence: m.data for _, m in read_messages(path)}
    rng = random.Random(7)
    places = [rng.randrange(8, len(data)) for _ in range(150)]
    places += [offsets[3] + i for i in range(60)]
    for place in places:
        broken = bytearray(data)
        broken[place] ^= 1 << rng.randrange(8)
        path.write_bytes(broken)
        found = info(path)
        kept = {m.sequence: m.data for _, m in read_messages(path)}
        assert all(good[sequence] == value for sequence, value in kept.items())
        assert len(kept) >= (CHUNKS - 1) * PER_CHUNK, place
        if len(kept) < len(good):
            assert found.damage_count >= 1, place
        assert recovered(path).messages == found.messages


def test_run_of_zeros_is_skipped(log: Any) -> None:
    path, offsets = log
    data = bytearray(path.read_bytes())
    data[offsets[1] - 30 : offsets[3] - 5] = bytes(offsets[3] - 5 - offsets[1] + 30)
    path.write_bytes(data)
    report = recovered(path)
    assert report.messages >= 3 * PER_CHUNK
    assert report.lost_unknown >= 1
    assert report.bytes_lost >= offsets[3] - offsets[1]


def test_overwritten_start_does_not_lose_the_rest(log: Any) -> None:
    path, _ = log
    data = bytearray(path.read_bytes())
    data[:100] = bytes(100)
    path.write_bytes(data)
    # Schemas and channels come from the summary.
    assert recovered(path).messages == CHUNKS * PER_CHUNK


def test_messages_on_undefined_channels_are_counted(tmp_path: Path, payload: bytes) -> None:
    path = tmp_path / "log.mcap"
    offsets = write_log(path, payload, finish=False)
    data = path.read_bytes()
    path.write_bytes(data[:8] + data[offsets[0] :])
    report = recovered(path)
    assert report.messages == 0
    assert report.orphans == CHUNKS * PER_CHUNK
    assert info(path).orphans == CHUNKS * PER_CHUNK


def test_damaged_attachment_is_dropped_and_reported(log: Any) -> None:
    path, _ = log
    data = bytearray(path.read_bytes())
    data[data.index(b"x = 1\n") + 3] ^= 1
    path.write_bytes(data)
    report = recovered(path)
    assert report.attachments == 0
    assert "attachment 'cal.toml'" in report.damages[0].reason
    assert report.messages == CHUNKS * PER_CHUNK


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b"", "is empty"),
        (MAGIC[:5], "cut off after 5 bytes"),
        (b"GIF89a" + bytes(5000), "is not an MCAP file"),
        (bytes(100_000), "is not an MCAP file"),
        (random.Random(3).randbytes(3_000_000), "is not an MCAP file"),
        (b"time,x,y,z\n1,2,3,4\n", "is not an MCAP file"),
    ],
)
def test_non_log_file_is_refused(tmp_path: Path, content: bytes, reason: str) -> None:
    path = tmp_path / "x.mcap"
    path.write_bytes(content)
    with pytest.raises(LogError, match=reason):
        info(path)
    with pytest.raises(LogError, match=reason):
        recover(path, tmp_path / "out.mcap")
    assert not (tmp_path / "out.mcap").exists()


def test_missing_file_and_directory_are_named(tmp_path: Path) -> None:
    with pytest.raises(LogError, match="No such file"):
        info(tmp_path / "none.mcap")
    with pytest.raises(LogError, match="Is a directory"):
        info(tmp_path)


def test_target_is_never_overwritten(log: Any, tmp_path: Path) -> None:
    path, _ = log
    for target in (path, tmp_path / "there.mcap"):
        before = path.read_bytes()
        if target != path:
            target.write_bytes(b"precious")
        with pytest.raises(RecoveryError, match="exists and is not overwritten"):
            recover(path, target)
        assert path.read_bytes() == before
    assert (tmp_path / "there.mcap").read_bytes() == b"precious"


def test_unwritable_target_leaves_no_file(log: Any, tmp_path: Path) -> None:
    path, _ = log
    with pytest.raises(RecoveryError, match="name a place with room to write to"):
        recover(path, tmp_path / "no" / "such" / "place.mcap")


@pytest.mark.parametrize("compression", list(CompressionType))
@pytest.mark.parametrize("chunked", [True, False])
def test_logs_of_other_writers_are_read_and_recovered(
    tmp_path: Path, compression: CompressionType, chunked: bool
) -> None:
    path = tmp_path / "other.mcap"
    stream = io.BytesIO()
    writer = Writer(stream, chunk_size=2000, compression=compression, use_chunking=chunked)
    writer.start(profile="", library="someone else")
    schema = writer.register_schema("Thing", "jsonschema", b"{}")
    channel = writer.register_channel("/things", "json", schema)
    for i in range(100):
        writer.add_message(channel, BASE_NS + i * 1_000_000, b"{}" * 50, BASE_NS, i)
    writer.finish()
    path.write_bytes(stream.getvalue())
    found = info(path)
    assert found.whole
    assert (found.library, found.messages) == ("someone else", 100)
    assert (found.channels[0].topic, found.channels[0].msgtype) == ("/things", "Thing")
    path.write_bytes(stream.getvalue()[: len(stream.getvalue()) // 2])
    assert 10 < recovered(path).messages < 90


def test_chunk_claiming_a_huge_size_takes_no_memory(tmp_path: Path) -> None:
    bomb = zstandard.ZstdCompressor().compress(bytes(400 << 20))
    head = struct.pack("<QQQI", 1, 2, 400 << 20, 0) + struct.pack("<I", 4) + b"zstd"
    body = head + struct.pack("<Q", len(bomb)) + bomb
    path = tmp_path / "bomb.mcap"
    path.write_bytes(MAGIC + struct.pack("<BQ", CHUNK, len(body)) + body)
    tracemalloc.start()
    found = info(path)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert found.damage_count == 1
    assert "419430400 bytes" in found.damages[0].reason
    assert peak < 20 << 20


def test_memory_use_is_independent_of_log_size(tmp_path: Path) -> None:
    payload = random.Random(1).randbytes(2000)
    peaks = []
    for chunks in (20, 200):
        path = tmp_path / f"{chunks}.mcap"
        write_log(path, payload, chunks)
        target = path.with_name(f"{chunks}_out.mcap")
        tracemalloc.start()
        info(path)
        recover(path, target)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < peaks[0] + 200_000  # the summary's index: 80 bytes per chunk


def test_progress_runs_from_start_to_end(log: Any) -> None:
    path, _ = log
    steps: list[tuple[int, int]] = []
    info(path, lambda done, size: steps.append((done, size)))
    size = path.stat().st_size
    assert steps[-1] == (size, size)
    assert [done for done, _ in steps] == sorted(done for done, _ in steps)


def test_silent_intervals_are_located(tmp_path: Path, payload: bytes) -> None:
    path = tmp_path / "log.mcap"
    file = McapFile(path, DiskStorage(), "test")
    schema = codec().schema(topics.RAW)
    file.add_schema(1, schema.name, schema.encoding, schema.data)
    file.add_channel(1, 1, "/tactile/b0/raw", "cdr", {})
    chunk = ChunkBuffer()
    at = BASE_NS
    for i in range(300):
        at += 2_000_000_000 if i == 150 else 10_000_000
        chunk.add(1, i, at, at, payload)
    file.add_chunk(chunk.seal(zstandard.ZstdCompressor()))
    file.finish()
    channel = info(path).channels[0]
    assert channel.silence_count == 1
    assert channel.silences[0].last_ns - channel.silences[0].first_ns == 2_000_000_000
    assert channel.longest_ns == 2_000_000_000
