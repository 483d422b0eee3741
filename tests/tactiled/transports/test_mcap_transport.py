"""Logs as transports: the same chunks at the same pace, also from truncated files."""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import Any

import pytest
from mcap.writer import CompressionType, Writer

from sensor_proto.can_transfers import CanFrame
from tactile_core.bus.messages import DecodeError, codec
from tactile_core.bus.topics import RAW
from tactile_core.types import Instant, WallClock
from tactiled.blocks import Chunk
from tactiled.transports import (
    EndOfLog,
    Medium,
    PortClosed,
    PortMissing,
    PortUnsuitable,
)
from tactiled.transports.recorded_log import McapTransport, from_raw, to_raw

WALL = WallClock(10**18)
SERIAL_CHUNKS = [Chunk(Instant(5_000_000_000 + k * 20_000_000), bytes([k] * 40)) for k in range(50)]
FAR_APART = [SERIAL_CHUNKS[0], Chunk(Instant(10**12), b"much later")]
CAN_CHUNK = Chunk(
    Instant(1),
    (
        CanFrame(0x1FFFFFFF, b"ab"),
        CanFrame(2, bytes(64), fd=True),
        CanFrame(0x40, bytes(8), error=True),
    ),
)


def write_log(path: Path, *boards: tuple[str, list[Chunk]]) -> Path:
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=512, compression=CompressionType.ZSTD)
        writer.start("ros2")
        schema = codec().schema(RAW)
        number = writer.register_schema(schema.name, schema.encoding, schema.data)
        for board, chunks in boards:
            channel = writer.register_channel(RAW.key(board), "cdr", number)
            for chunk in chunks:
                at = WALL.wall_ns(chunk.received)
                data = codec().encode(RAW, to_raw(chunk, "board0", WALL))
                writer.add_message(channel, at, data, at)
        writer.finish()
    return path


def play(transport: McapTransport) -> list[Chunk]:
    chunks: list[Chunk] = []
    try:
        while True:
            chunk = transport.read(60)
            assert chunk is not None
            chunks.append(chunk)
    except EndOfLog:
        return chunks


@pytest.mark.parametrize("chunk", [SERIAL_CHUNKS[3], CAN_CHUNK, Chunk(Instant(9), ())])
def test_chunk_round_trips_through_its_message(chunk: Chunk) -> None:
    message = codec().decode(RAW, codec().encode(RAW, to_raw(chunk, "/dev/ttyACM0", WALL)))
    assert from_raw(message) == chunk
    assert message.header.frame_id == "/dev/ttyACM0"


@pytest.mark.parametrize("change", [{"medium": 2}, {"can_length": b"\x03"}, {"data": b"toolong"}])
def test_inconsistent_message_is_refused(change: dict[str, Any]) -> None:
    import numpy as np

    message = to_raw(CAN_CHUNK, "can0", WALL)
    for name, value in change.items():
        setattr(message, name, np.frombuffer(value, "u1") if isinstance(value, bytes) else value)
    with pytest.raises(DecodeError, match="RawChunk"):
        from_raw(message)


def test_log_is_replayed_completely_with_original_spacing(tmp_path: Path) -> None:
    path = write_log(tmp_path / "run.mcap", ("board0", SERIAL_CHUNKS))
    transport = McapTransport(path, speed=math.inf)
    transport.open()
    assert transport.medium is Medium.SERIAL
    chunks = play(transport)
    assert [c.payload for c in chunks] == [c.payload for c in SERIAL_CHUNKS]
    first = chunks[0].received
    assert [c.received - first for c in chunks] == [k * 20_000_000 for k in range(50)]
    with pytest.raises(EndOfLog):
        transport.read(0)
    transport.write(b"abc")
    assert transport.losses == {"write_to_recording": 3}
    transport.close()


def test_log_is_replayed_at_original_or_higher_speed(tmp_path: Path) -> None:
    path = write_log(tmp_path / "run.mcap", ("board0", SERIAL_CHUNKS))
    transport = McapTransport(path, speed=5)
    transport.open()
    start = time.monotonic()
    play(transport)
    assert time.monotonic() - start > 0.9 * 49 * 0.02 / 5
    transport.close()
    transport = McapTransport(write_log(tmp_path / "far.mcap", ("b", FAR_APART)), speed=5)
    transport.open()
    assert transport.read(60) is not None
    assert transport.read(0) is None
    transport.close()


def test_can_logs_give_frames(tmp_path: Path) -> None:
    transport = McapTransport(write_log(tmp_path / "c.mcap", ("b", [CAN_CHUNK])))
    transport.open()
    assert transport.medium is Medium.CAN
    assert [c.payload for c in play(transport)] == [CAN_CHUNK.payload]
    transport.close()


def test_one_board_of_several_is_replayed(tmp_path: Path) -> None:
    path = write_log(tmp_path / "r.mcap", ("a", SERIAL_CHUNKS[:3]), ("b", SERIAL_CHUNKS[3:8]))
    for board, count in (("a", 3), ("b", 5), (None, 3)):
        transport = McapTransport(path, board=board, speed=math.inf)
        transport.open()
        assert len(play(transport)) == count
        transport.close()
    with pytest.raises(PortUnsuitable, match="no raw chunks of board 'c'"):
        McapTransport(path, board="c").open()


@pytest.mark.parametrize("share", [0.3, 0.6, 0.95])
def test_truncated_log_is_replayed_up_to_the_cut(tmp_path: Path, share: float) -> None:
    path = write_log(tmp_path / "run.mcap", ("board0", SERIAL_CHUNKS))
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    transport = McapTransport(path, speed=math.inf)
    transport.open()
    got = [c.payload for c in play(transport)]
    assert 0 < len(got) <= len(SERIAL_CHUNKS)
    assert got == [c.payload for c in SERIAL_CHUNKS[: len(got)]]
    transport.close()


def test_non_log_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(PortMissing, match="no log"):
        McapTransport(tmp_path / "none.mcap").open()
    path = tmp_path / "text.mcap"
    path.write_text("not a log, but long enough to look at")
    with pytest.raises(PortUnsuitable, match="not an MCAP file"):
        McapTransport(path).open()
    with pytest.raises(PortUnsuitable, match="no raw chunks"):
        McapTransport(write_log(tmp_path / "empty.mcap")).open()
    with pytest.raises(PortUnsuitable):
        McapTransport(tmp_path).open()
    for speed in (0, -1, math.nan):
        with pytest.raises(ValueError, match="speed"):
            McapTransport(path, speed=speed)


def test_closing_wakes_a_waiting_reader(tmp_path: Path, run_in_background: Any) -> None:
    transport = McapTransport(write_log(tmp_path / "run.mcap", ("b", FAR_APART)))
    transport.open()
    assert transport.read(60) is not None
    outcome = run_in_background(lambda: transport.read(600))
    time.sleep(0.05)
    transport.close()
    outcome.join()
    assert isinstance(outcome.error, PortClosed)


def test_non_chunk_message_is_counted_and_skipped(tmp_path: Path) -> None:
    path = tmp_path / "odd.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start("ros2")
        schema = codec().schema(RAW)
        number = writer.register_schema(schema.name, schema.encoding, schema.data)
        channel = writer.register_channel(RAW.key("b"), "cdr", number)
        writer.add_message(channel, 1, b"\0\1\0\0rubbish", 1)
        good = codec().encode(RAW, to_raw(SERIAL_CHUNKS[0], "p", WALL))
        writer.add_message(channel, 2, good, 2)
        writer.finish()
    transport = McapTransport(path)
    transport.open()
    assert len(play(transport)) == 1
    assert transport.losses == {"broken_message": 1}
    transport.close()
