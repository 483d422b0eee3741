"""Unframed boards: the boundary is found, kept, and found again; bad readings are flagged."""

from __future__ import annotations

import struct
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sensor_proto.anyskin import MAX_BUFFER, AnySkinDecoder, encode_anyskin
from sensor_proto.packets import Decoder, FloatSamples, Received, TaxelStatus

RELOCK = 3  # frames held back until the boundary is certain again


def frame(index: int, n: int, rng: np.random.Generator, celsius: float = 27.0) -> bytes:
    """One frame as in sensors.md: n × (t, x, y, z), CR LF; x of the first chip is the index."""
    out = b""
    for chip in range(n):
        x, y = rng.normal(0, 300, 2)
        z = rng.normal(9000, 500)
        t = celsius + rng.normal(0, 0.2)
        out += struct.pack("<4f", t, float(index) if chip == 0 else x, y, z)
    return out + b"\r\n"


def stream(count: int, n: int, seed: int = 0) -> list[bytes]:
    rng = np.random.default_rng(seed)
    return [frame(i, n, rng) for i in range(count)]


def indices(received: list[Received]) -> list[int]:
    return [int(r.message.field_ut[0, 0]) for r in received]


def feed_in(decoder: AnySkinDecoder, data: bytes, sizes: list[int]) -> list[Received]:
    out, at, i = [], 0, 0
    while at < len(data):
        size = sizes[i % len(sizes)]
        out += decoder.feed(data[at : at + size])
        at, i = at + size, i + 1
    return out


def held(decoder: AnySkinDecoder) -> int:
    return len(decoder._buffer)


def test_decoder_satisfies_the_protocol() -> None:
    decoder: Decoder[bytes] = AnySkinDecoder()
    assert decoder.feed(b"") == []


@pytest.mark.parametrize("n", range(1, 21))
def test_magnetometer_count_is_found_from_mid_frame(n: int) -> None:
    frames = stream(12, n)
    decoder = AnySkinDecoder()
    assert decoder.magnetometers is None
    got = decoder.feed(b"".join(frames)[5:])
    assert decoder.magnetometers == n
    assert indices(got) == list(range(1, 12))
    assert got[0].message.field_ut.shape == (n, 3)
    assert got[0].message.temperature_c.shape == got[0].message.status.shape == (n,)
    assert not got[0].message.status.any()
    assert decoder.counters == {
        "accepted": 11,
        "lost_lock": 0,
        "discarded_bytes": len(frames[0]) - 5,
    }


@pytest.mark.parametrize("n", [1, 5, 20])
def test_values_are_decoded_exactly(n: int) -> None:
    rng = np.random.default_rng(4)
    sent = [
        FloatSamples(
            rng.normal(0, 9000, (n, 3)).astype("f4"),
            rng.normal(25, 3, n).astype("f4"),
            np.zeros(n, np.uint8),
        )
        for _ in range(6)
    ]
    got = AnySkinDecoder().feed(b"".join(encode_anyskin(s) for s in sent))
    for received, samples in zip(got, sent, strict=True):
        assert np.array_equal(received.message.field_ut, samples.field_ut)
        assert np.array_equal(received.message.temperature_c, samples.temperature_c)
        with pytest.raises(ValueError, match="read-only"):
            received.message.field_ut[0, 0] = 1


@given(sizes=st.lists(st.integers(1, 9000), min_size=1, max_size=4), seed=st.integers(0, 999))
@settings(max_examples=30, deadline=None)
def test_bursts_decode_to_the_same_frames_as_arrays(sizes: list[int], seed: int) -> None:
    rng = np.random.default_rng(seed)
    wire = bytearray(b"".join(stream(150, 5)))
    for at in rng.integers(0, len(wire), 12):
        wire[at] ^= 1 << int(rng.integers(8))
    single, burst = AnySkinDecoder(), AnySkinDecoder()
    at = i = 0
    while at < len(wire):
        chunk = bytes(wire[at : at + sizes[i % len(sizes)]])
        at, i = at + len(chunk), i + 1
        frames = single.feed(chunk)
        bursts = burst.feed_bursts(chunk)
        assert [r.trailing for r in frames] == [t for b in bursts for t in b.trailing]
        values = [v for b in bursts for v in b.values]
        status = [s for b in bursts for s in b.status]
        for received, reading, bits in zip(frames, values, status, strict=True):
            np.testing.assert_array_equal(received.message.field_ut, reading[:, 1:])
            np.testing.assert_array_equal(received.message.temperature_c, reading[:, 0])
            np.testing.assert_array_equal(received.message.status, bits)
    assert single.counters == burst.counters


@given(sizes=st.lists(st.integers(1, 500), min_size=1, max_size=6), n=st.sampled_from([1, 5, 20]))
@settings(max_examples=40, deadline=None)
def test_chunking_does_not_change_the_frames(sizes: list[int], n: int) -> None:
    frames = stream(25, n)
    assert indices(feed_in(AnySkinDecoder(), b"".join(frames), sizes)) == list(range(25))


def test_trailing_counts_bytes_after_each_frame() -> None:
    frames = stream(10, 5)
    decoder = AnySkinDecoder()
    decoder.feed(b"".join(frames[:6]))
    first, second = decoder.feed(frames[6] + frames[7] + frames[8][:9])
    assert (first.trailing, second.trailing) == (82 + 9, 9)
    (third,) = decoder.feed(frames[8][9:])
    assert third.trailing == 0


# CR LF inside the data


@pytest.mark.parametrize("byte", [b for b in range(80) if b % 16 not in (2, 3, 15)])
def test_crlf_inside_every_frame_is_not_a_boundary(byte: int) -> None:
    """The worst field: CR LF stays at the same place while nothing moves."""
    frames = []
    for raw in stream(30, 5):
        damaged_frame = bytearray(raw)
        damaged_frame[byte : byte + 2] = b"\r\n"
        frames.append(bytes(damaged_frame))
    wire = b"".join(frames)
    for offset in (0, 1, 41, byte + 2):
        decoder = AnySkinDecoder()
        got = feed_in(decoder, wire[offset:], [37])
        assert decoder.magnetometers == 5
        whole = frames[1:] if offset else frames
        assert [bytes(r.message.field_ut.tobytes()) for r in got] == [
            np.frombuffer(f[:-2], "<f4").reshape(5, 4)[:, 1:].tobytes() for f in whole
        ]


def test_crlf_inside_a_third_of_the_frames_is_not_a_boundary() -> None:
    rng = np.random.default_rng(7)
    frames = []
    for raw in stream(400, 5):
        damaged_frame = bytearray(raw)
        if rng.random() < 0.31:
            at = int(rng.choice([8, 9, 12, 13, 24, 28, 40, 72, 76, 77]))
            damaged_frame[at : at + 2] = b"\r\n"
        frames.append(bytes(damaged_frame))
    decoder = AnySkinDecoder()
    assert indices(feed_in(decoder, b"".join(frames), [64, 200, 3])) == list(range(400))
    assert decoder.counters["lost_lock"] == 0


# Loss and recovery


def count_lost(wire: bytes, sent: int, n: int, sizes: list[int]) -> tuple[list[int], int]:
    decoder = AnySkinDecoder()
    got = [
        int(r.message.field_ut[0, 0])
        for r in feed_in(decoder, wire, sizes)
        if not r.message.status.any() and r.message.field_ut[0, 0].is_integer()
    ]
    assert decoder.magnetometers == n
    return got, sent - len(set(got) & set(range(sent)))


@given(seed=st.integers(0, 10**6), n=st.sampled_from([1, 2, 5, 10, 20]))
@settings(max_examples=150, deadline=None)
def test_damage_loses_at_most_one_frame_beyond_those_touched(seed: int, n: int) -> None:
    """One fault anywhere after the lock: bytes removed, inserted, or both."""
    rng = np.random.default_rng(seed)
    frames = stream(30, n, seed)
    size = len(frames[0])
    wire = b"".join(frames)
    start = int(rng.integers(6 * size, 18 * size))
    stop = start + int(rng.integers(1, 3 * size))
    patch = rng.bytes(int(rng.integers(0, 2 * size)))
    touched = (stop - 1) // size - start // size + 1
    got, lost = count_lost(wire[:start] + patch + wire[stop:], 30, n, [83, 7, 300])
    assert lost <= touched + 1
    # Removing a whole number of frames' lengths can join two readings into a plausible one.
    real = [i for i in got if i in range(30)]
    assert real == sorted(set(real))


@pytest.mark.parametrize("n", [2, 5, 20])
def test_every_second_frame_damaged_leaves_the_others(n: int) -> None:
    rng = np.random.default_rng(n)
    frames = stream(60, n)
    wire, touched = b"".join(frames[:10]), 0
    for i, raw in enumerate(frames[10:50]):
        cut = int(rng.integers(1, len(raw) - 3))
        wire += raw[:cut] + raw[cut + 1 :] if i % 2 else raw
        touched += i % 2
    got, lost = count_lost(wire + b"".join(frames[50:]), 60, n, [100])
    assert lost <= touched + 1
    assert set(got) <= set(range(60))


def test_lost_line_end_costs_only_that_frame() -> None:
    frames = stream(30, 5)
    frames[12] = frames[12][:-2] + b"\x00\x00"
    decoder = AnySkinDecoder()
    got = indices(feed_in(decoder, b"".join(frames), [82]))
    assert got == [i for i in range(30) if i != 12]
    assert decoder.counters["lost_lock"] == 1
    assert decoder.counters["discarded_bytes"] == 82


def test_board_with_another_count_is_found_without_reset() -> None:
    decoder = AnySkinDecoder()
    decoder.feed(b"".join(stream(10, 5))[:-30])
    got = decoder.feed(b"".join(stream(40, 3)))
    assert decoder.magnetometers == 3
    assert indices(got)[-30:] == list(range(10, 40))


def test_reset_clears_framing_but_keeps_the_counters() -> None:
    decoder = AnySkinDecoder()
    decoder.feed(b"".join(stream(10, 5)) + b"\x01\x02")
    decoder.reset()
    assert decoder.magnetometers is None
    assert len(decoder.feed(b"".join(stream(10, 15)))) == 10
    assert decoder.magnetometers == 15
    assert decoder.counters["accepted"] == 20


def test_configured_count_is_the_only_one_accepted() -> None:
    wire = b"".join(stream(20, 5))
    assert AnySkinDecoder(4).feed(wire) == []
    assert len(AnySkinDecoder(5).feed(wire)) == 20


@pytest.mark.parametrize("n", [0, 21, -1])
def test_impossible_count_is_refused_locally(n: int) -> None:
    with pytest.raises(ValueError, match="1 to 20"):
        AnySkinDecoder(n)


# Bad readings


def with_reading(raw: bytes, chip: int, **values: float) -> bytes:
    t, x, y, z = struct.unpack_from("<4f", raw, 16 * chip)
    new = {"t": t, "x": x, "y": y, "z": z} | values
    out = bytearray(raw)
    struct.pack_into("<4f", out, 16 * chip, *new.values())
    return bytes(out)


@pytest.mark.parametrize(
    "reading",
    [
        {"t": -998.1},
        {"t": 451.8},
        {"t": -400.0},
        {"t": float("nan")},
        {"t": float("inf")},
        {"x": float("nan")},
        {"y": float("-inf")},
        {"z": 3e38},
    ],
    ids=str,
)
@pytest.mark.parametrize("n", [1, 5])
def test_failed_reading_is_flagged_and_its_frame_kept(reading: dict[str, float], n: int) -> None:
    frames = stream(20, n)
    frames[9] = with_reading(frames[9], n - 1, **reading)
    got = feed_in(AnySkinDecoder(), b"".join(frames), [50])
    assert len(got) == 20
    flags = np.array([r.message.status for r in got])
    assert flags[9, n - 1] == TaxelStatus.READ_FAILED
    assert np.count_nonzero(flags) == 1


@pytest.mark.parametrize("dead", [-998.1, 451.8])
@pytest.mark.parametrize("n", [1, 5])
def test_board_with_all_chips_dead_is_still_framed(dead: float, n: int) -> None:
    frames = [with_reading(f, c, t=dead, x=0.0) for f in stream(1, n) for c in range(n)]
    raw = frames[0]
    for chip in range(n):
        raw = with_reading(raw, chip, t=dead)
    decoder = AnySkinDecoder()
    got = decoder.feed(raw * 20)
    assert len(got) == 20
    assert all((r.message.status == TaxelStatus.READ_FAILED).all() for r in got)


def test_impossible_readings_neither_stop_the_stream_nor_lose_frames() -> None:
    """Permanently invalid values of three of five chips: the boundary is checked and kept."""
    rng = np.random.default_rng(3)
    frames = stream(60, 5)
    for i in range(10, 60):
        for chip in (0, 2, 4):
            frames[i] = with_reading(frames[i], chip, t=float(rng.uniform(-900, -100)))
    decoder = AnySkinDecoder()
    got = indices(feed_in(decoder, b"".join(frames), [82]))
    assert got == list(range(len(got)))
    assert len(got) >= 60 - RELOCK
    assert decoder.counters["discarded_bytes"] == 0


# Arbitrary bytes


@given(chunks=st.lists(st.binary(max_size=3000), max_size=6))
@settings(max_examples=60, deadline=None)
def test_noise_never_raises_and_memory_is_bounded(chunks: list[bytes]) -> None:
    decoder = AnySkinDecoder()
    for chunk in chunks:
        decoder.feed(chunk)
        assert held(decoder) <= MAX_BUFFER


@pytest.mark.parametrize("noise", [b"\r\n", b"\0", b"\xff", b"\r", b"\n\0\xc8\x41\r"])
def test_stream_is_found_after_floods_of_noise(noise: bytes) -> None:
    decoder = AnySkinDecoder()
    for _ in range(20):
        assert decoder.feed(noise * 1000) == []
        assert held(decoder) <= MAX_BUFFER
    got = indices(decoder.feed(b"".join(stream(40, 5))))
    assert got[-30:] == list(range(10, 40))
    assert decoder.magnetometers == 5


@pytest.mark.parametrize(
    ("field", "temperature"),
    [
        (np.zeros((0, 3)), np.zeros(0)),
        (np.zeros((21, 3)), np.zeros(21)),
        (np.zeros((3, 2)), np.zeros(3)),
    ],
)
def test_samples_that_fit_no_board_are_refused_locally(
    field: np.ndarray, temperature: np.ndarray
) -> None:
    with pytest.raises(ValueError, match="n 1 to 20"):
        encode_anyskin(FloatSamples(field, temperature, np.zeros(len(temperature), np.uint8)))


@pytest.fixture
def corrupt() -> Callable[[list[bytes], str, np.random.Generator], bytes]:
    def make(frames: list[bytes], kind: str, rng: np.random.Generator) -> bytes:
        wire = list(frames)
        for i in range(12, 60, 6):
            if kind == "lost":
                wire[i] = b""
            elif kind == "duplicated":
                wire[i] *= 2
            elif kind == "reordered":
                wire[i], wire[i + 1] = wire[i + 1], wire[i]
            elif kind == "truncated":
                wire[i] = wire[i][: int(rng.integers(1, 80))]
            elif kind == "noisy":
                wire[i] = rng.bytes(9) + wire[i]
        return b"".join(wire)

    return make


@pytest.mark.parametrize(
    ("kind", "damaged"),
    [
        ("whole", 0),
        ("lost", 8),
        ("duplicated", 0),
        ("reordered", 0),
        ("truncated", 8),
        ("noisy", 0),
    ],
)
def test_corrupted_streams_never_yield_wrong_frames(
    kind: str, damaged: int, corrupt: Callable[[list[bytes], str, np.random.Generator], bytes]
) -> None:
    rng = np.random.default_rng(2)
    wire = corrupt(stream(80, 5), kind, rng)
    for sizes in ([1], [500], rng.integers(1, 200, 9).tolist()):
        got = indices(feed_in(AnySkinDecoder(), wire, sizes))
        assert set(got) <= set(range(80))
        assert 80 - len(set(got)) == damaged
