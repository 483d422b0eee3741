"""Serial decoder on corrupted lines: nothing wrong accepted, losses counted, memory bounded."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sensor_proto.framing import MAX_FRAME, SerialDecoder, encode_serial
from sensor_proto.packets import ClockPoll, Decoder, Log, Received, Samples, Start

MakeSamples = Callable[..., Samples]


def sequences(received: list[Received]) -> list[int]:
    return [r.message.sequence for r in received if isinstance(r.message, Samples)]


def refused(decoder: SerialDecoder) -> int:
    return sum(n for reason, n in decoder.counters.items() if reason not in ("accepted", "empty"))


def feed_in(decoder: SerialDecoder, data: bytes, sizes: list[int]) -> list[Received]:
    out, at, i = [], 0, 0
    while at < len(data):
        size = sizes[i % len(sizes)]
        out += decoder.feed(data[at : at + size])
        at, i = at + size, i + 1
    return out


def held(decoder: SerialDecoder) -> int:
    return len(decoder._partial)


@pytest.fixture(scope="session")
def line(make_samples: MakeSamples) -> list[bytes]:
    return [encode_serial(make_samples(i, taxels=(i % 40) + 1)) for i in range(40)]


def test_decoder_satisfies_the_protocol() -> None:
    decoder: Decoder[bytes] = SerialDecoder()
    assert decoder.feed(b"") == []


@given(sizes=st.lists(st.integers(1, 700), min_size=1, max_size=8))
@settings(max_examples=40, deadline=None)
def test_chunking_does_not_change_the_frames(line: list[bytes], sizes: list[int]) -> None:
    decoder = SerialDecoder()
    assert sequences(feed_in(decoder, b"".join(line), sizes)) == list(range(40))
    assert refused(decoder) == 0


@given(garbage=st.binary(max_size=3000), sizes=st.lists(st.integers(1, 900), min_size=1))
@settings(max_examples=80, deadline=None)
def test_good_frame_after_garbage_is_found(
    line: list[bytes], garbage: bytes, sizes: list[int]
) -> None:
    decoder = SerialDecoder()
    assert sequences(feed_in(decoder, garbage + b"\0" + line[7], sizes)) == [7]


@given(chunks=st.lists(st.binary(max_size=2500), max_size=12))
@settings(max_examples=60, deadline=None)
def test_memory_is_bounded_for_any_input(chunks: list[bytes]) -> None:
    decoder = SerialDecoder()
    for chunk in chunks:
        decoder.feed(chunk)
        assert held(decoder) <= MAX_FRAME


@given(st.data())
@settings(max_examples=60, deadline=None)
def test_chunking_does_not_change_the_counters(line: list[bytes], data: st.DataObject) -> None:
    rng = np.random.default_rng(data.draw(st.integers(0, 999)))
    wire = bytearray(b"".join(line))
    for at in rng.integers(0, len(wire), 25):
        wire[at] ^= 1 << int(rng.integers(8))
    whole, pieces = SerialDecoder(), SerialDecoder()
    sizes = data.draw(st.lists(st.integers(1, 1500), min_size=1, max_size=6))
    assert sequences(whole.feed(bytes(wire))) == sequences(feed_in(pieces, bytes(wire), sizes))
    assert whole.counters == pieces.counters


def test_trailing_counts_bytes_after_each_frame(line: list[bytes]) -> None:
    decoder = SerialDecoder()
    chunk = line[0] + line[1] + line[2][:10]
    first, second = decoder.feed(chunk)
    assert (first.trailing, second.trailing) == (len(line[1]) + 10, 10)
    (third,) = decoder.feed(line[2][10:])
    assert third.trailing == 0
    (fourth,) = decoder.feed(line[3] + b"\0" * 5)
    assert fourth.trailing == 5


def test_flood_of_zeros_takes_no_memory_and_loses_no_frame(line: list[bytes]) -> None:
    decoder = SerialDecoder()
    for _ in range(200):
        assert decoder.feed(bytes(4096)) == []
    assert held(decoder) == 0
    assert decoder.counters["empty"] == 200 * 4096
    assert sequences(decoder.feed(line[3] + bytes(1_000_000) + line[4])) == [3, 4]
    assert refused(decoder) == 0


@pytest.mark.parametrize("chunk", [1, 100, 5000])
def test_endless_frame_is_dropped_up_to_the_next_delimiter(line: list[bytes], chunk: int) -> None:
    decoder = SerialDecoder()
    endless = b"\x55" * 20_000 + b"\0"
    assert sequences(feed_in(decoder, endless + line[1], [chunk])) == [1]
    assert decoder.counters["oversized"] == refused(decoder) == 1


def test_longest_frame_is_accepted(make_samples: MakeSamples) -> None:
    longest = encode_serial(Log(20, 1, "x" * 255))
    decoder = SerialDecoder()
    assert sequences(decoder.feed(encode_serial(make_samples(9, taxels=128)) + longest)) == [9]
    assert decoder.counters["accepted"] == 2


def test_largest_payload_is_accepted_and_one_more_byte_refused(
    reference: SimpleNamespace,
) -> None:
    for size, accepted in ((1024, 1), (1025, 0), (1040, 0)):
        decoder = SerialDecoder()
        packet = reference.packet(0x82, b"\1\0" + b"\x77" * (size - 2))
        assert len(decoder.feed(reference.serial(packet))) == accepted, size
        assert sum(decoder.counters.values()) == 1


REJECTS = [
    ("runt", lambda ref: ref.serial(b"\x82\x00\x02")),
    ("runt", lambda ref: b"\x01\x00"),
    ("cobs", lambda ref: b"\x09\x01\x00"),
    ("length", lambda ref: ref.serial(ref.packet(0x82, b"\1\0")[:2] + b"\x09" + bytes(7))),
    ("crc", lambda ref: ref.serial(ref.packet(0x82, b"\1\0")[:-1] + b"\x00")),
    ("board", lambda ref: ref.serial(ref.packet(0x82, b"\1\0", board=4))),
    ("unknown_type", lambda ref: ref.serial(ref.packet(0x44, b"\1\0"))),
    ("short_payload", lambda ref: ref.serial(ref.packet(0x82, b"\1"))),
]


@pytest.mark.parametrize(("reason", "make"), REJECTS)
def test_each_reason_has_its_counter(
    reason: str, make: Callable[[SimpleNamespace], bytes], reference: SimpleNamespace
) -> None:
    decoder = SerialDecoder()
    (received,) = decoder.feed(make(reference) + encode_serial(Start(8)))
    assert received.message == Start(8)
    assert decoder.counters[reason] == refused(decoder) == 1


def test_all_zero_packets_are_refused(reference: SimpleNamespace) -> None:
    for size in range(8, 300, 7):
        decoder = SerialDecoder()
        assert decoder.feed(reference.serial(bytes(size))) == []
        assert refused(decoder) == 1


def test_reset_drops_the_partial_frame_but_keeps_the_counters(line: list[bytes]) -> None:
    decoder = SerialDecoder()
    decoder.feed(line[0] + line[1][:20])
    decoder.reset()
    assert sequences(decoder.feed(line[2])) == [2]
    assert decoder.counters["accepted"] == 2
    assert refused(decoder) == 0


def test_unknown_commands_can_be_answered_by_number(reference: SimpleNamespace) -> None:
    decoder = SerialDecoder()
    decoder.feed(reference.serial(reference.packet(0xF0, b"\x34\x12zzz")))
    assert decoder.take_unknown() == [(0xF0, 0x1234)]
    assert decoder.take_unknown() == []


# Corruptions: name, and effect on frame i.

EVIL = ["whole", "bytewise", "lost", "flipped", "duplicated", "reordered", "spliced", "noisy"]


def corrupt(kind: str, frames: list[bytes], rng: np.random.Generator) -> tuple[bytes, int]:
    """Corrupt ``frames``; returns the bytes and the number of damaged frames."""
    wire, damaged = [], 0
    skip = False
    for i, frame in enumerate(frames):
        hit = rng.random() < 0.25
        if skip:
            skip = False
            continue
        if not hit or kind in ("whole", "bytewise"):
            wire.append(frame)
        elif kind == "duplicated":
            wire += [frame, frame]
        elif kind == "reordered" and i + 1 < len(frames):
            wire += [frames[i + 1], frame]
            skip = True
        elif kind == "flipped":
            at, bit = int(rng.integers(len(frame) - 1)), int(rng.integers(8))
            damaged_frame = bytearray(frame)
            damaged_frame[at] ^= 1 << bit
            wire.append(bytes(damaged_frame))
            damaged += 1
        elif kind == "spliced" and i + 1 < len(frames):
            wire.append(frame[: rng.integers(len(frame))] + frames[i + 1][rng.integers(1, 9) :])
            damaged += 2
            skip = True
        elif kind == "noisy":
            wire += [rng.bytes(20) + b"\0", frame]
        else:
            damaged += 1
    return b"".join(wire), damaged


@pytest.mark.parametrize("kind", EVIL)
@pytest.mark.parametrize("seed", range(3))
def test_corrupted_streams_never_yield_wrong_frames(
    kind: str, seed: int, line: list[bytes]
) -> None:
    rng = np.random.default_rng(seed)
    wire, damaged = corrupt(kind, line, rng)
    decoder = SerialDecoder()
    sizes = [1] if kind == "bytewise" else rng.integers(1, 800, 20).tolist()
    got = sequences(feed_in(decoder, wire, sizes))
    assert set(got) <= set(range(40))
    assert 40 - len(set(got)) == damaged
    if kind not in ("reordered", "duplicated"):
        assert got == sorted(set(got))


def test_delayed_frame_is_counted_once_on_arrival(line: list[bytes]) -> None:
    decoder = SerialDecoder()
    late = [*line[:3], *line[4:9], line[3], *line[9:]]
    assert sequences(feed_in(decoder, b"".join(late), [333])) == [
        0,
        1,
        2,
        4,
        5,
        6,
        7,
        8,
        3,
        *range(9, 40),
    ]


@given(st.integers(0, 10**6))
@settings(max_examples=120, deadline=None)
def test_damage_loses_at_most_one_frame_beyond_those_touched(line: list[bytes], seed: int) -> None:
    """One fault anywhere: bytes removed, inserted or changed, over any number of frames."""
    rng = np.random.default_rng(seed)
    wire = b"".join(line)
    ends = np.cumsum([len(f) for f in line])
    start = int(rng.integers(len(wire)))
    stop = min(len(wire), start + int(rng.integers(1, 400)))
    patch = rng.bytes(int(rng.integers(0, 60)))
    touched = 1 + int(np.searchsorted(ends, stop, "left") - np.searchsorted(ends, start, "right"))
    decoder = SerialDecoder()
    got = sequences(feed_in(decoder, wire[:start] + patch + wire[stop:], [97, 1, 400]))
    assert set(got) <= set(range(40))
    assert len(got) == len(set(got))
    assert 40 - len(got) <= touched + 1


def test_interleaved_kinds_come_in_order(make_samples: MakeSamples) -> None:
    decoder = SerialDecoder()
    received = decoder.feed(
        encode_serial(make_samples(1)) + encode_serial(ClockPoll(5)) + encode_serial(Start(6))
    )
    assert [type(r.message) for r in received] == [Samples, ClockPoll, Start]
