"""COBS against the paper's rules and a byte-by-byte implementation."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sensor_proto import cobs

RUN = bytes(range(1, 255))  # 254 bytes without a zero

# Worked out by hand from table I of Cheshire & Baker 1999.
BY_HAND = [
    (b"", "01"),
    (b"\x00", "01 01"),
    (b"\x00\x00", "01 01 01"),
    (b"\x11", "02 11"),
    (b"\x00\x11\x00", "01 02 11 01"),
    (b"\x11\x22\x00\x33", "03 11 22 02 33"),
    (b"\x11\x00\x00\x00", "02 11 01 01 01"),
]

FULL = [
    (RUN[:253], b"\xfe" + RUN[:253]),
    (RUN, b"\xff" + RUN),
    (RUN + b"\x00", b"\xff" + RUN + b"\x01\x01"),
    (RUN + b"\xaa", b"\xff" + RUN + b"\x02\xaa"),
    (b"\x00" + RUN, b"\x01\xff" + RUN),
    (RUN + RUN, b"\xff" + RUN + b"\xff" + RUN),
]


@pytest.mark.parametrize(("data", "stuffed"), [(d, bytes.fromhex(s)) for d, s in BY_HAND] + FULL)
def test_encoding_matches_hand_worked_examples(data: bytes, stuffed: bytes) -> None:
    assert cobs.encode(data) == stuffed
    assert cobs.decode(stuffed) == data


@pytest.mark.parametrize("data", [RUN, RUN + RUN])
def test_full_block_may_be_followed_by_an_empty_one(data: bytes) -> None:
    assert cobs.decode(cobs.encode(data) + b"\x01") == data


mixed = st.lists(
    st.one_of(
        st.binary(max_size=20),
        st.just(bytes(9)),
        st.just(b"\1" * 12),
        st.just(RUN),
        st.just(RUN[:253]),
    ),
    max_size=5,
).map(b"".join)


@given(mixed)
@settings(max_examples=150, deadline=None)
def test_decoding_matches_the_textbook(data: bytes) -> None:
    stuffed = cobs.encode(data)
    assert 0 not in stuffed
    assert len(stuffed) <= cobs.max_encoded(len(data))
    assert cobs.decode(stuffed) == data


@given(mixed)
@settings(max_examples=60, deadline=None)
def test_encoding_matches_the_textbook(reference: SimpleNamespace, data: bytes) -> None:
    assert cobs.encode(data) == reference.cobs(data)


@pytest.mark.parametrize("frame", [b"", b"\x02", b"\x05\x11\x22", b"\xff" + RUN[:100], b"\x01\x09"])
def test_blocks_that_overrun_the_frame_are_refused(frame: bytes) -> None:
    assert cobs.decode(frame) is None


@given(st.binary(max_size=600).map(lambda b: b.replace(b"\0", b"\1")))
@settings(max_examples=100, deadline=None)
def test_noise_never_raises(frame: bytes) -> None:
    data = cobs.decode(frame)
    assert data is None or len(data) < len(frame)
