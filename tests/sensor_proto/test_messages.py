"""Every message round-trips, invalid ones are refused by name, and versions mix as specified."""

from __future__ import annotations

import struct
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sensor_proto.can_transfers import CanDecoder, CanEncoder
from sensor_proto.framing import SerialDecoder, encode_serial
from sensor_proto.packets import (
    Ack,
    AckResult,
    ArrayDescriptor,
    ChipType,
    ClockPoll,
    ClockReply,
    Descriptor,
    FloatSamples,
    Identify,
    Log,
    Message,
    MessageType,
    Reboot,
    Samples,
    SetGain,
    SetRate,
    Start,
    Status,
    Stop,
)

Same = Callable[[object, object], bool]

u8 = st.integers(0, 0xFF)
u16 = st.integers(0, 0xFFFF)
u32 = st.integers(0, 0xFFFFFFFF)
above_0 = st.integers(1, 0xFFFFFFFF)
name = st.text(st.characters(min_codepoint=0x20, max_codepoint=0x7E), max_size=15)
shape = st.sampled_from([(1, 1), (4, 4), (4, 8), (1, 128), (128, 1), (16, 8)])
text = st.text(max_size=60).filter(lambda s: s.isprintable())


@st.composite
def descriptors(draw: st.DrawFn) -> Descriptor:
    numbers = draw(st.lists(u8, min_size=1, max_size=16, unique=True))
    arrays = tuple(
        ArrayDescriptor(
            number,
            draw(name),
            draw(st.sampled_from(ChipType)),
            *draw(shape),
            draw(above_0),
            draw(above_0),
            draw(above_0),
        )
        for number in numbers
    )
    unique_id = draw(st.binary(min_size=8, max_size=8))
    rates = (draw(above_0), draw(above_0))
    return Descriptor(1, draw(u8), unique_id, draw(name), draw(name), *rates, arrays)


@st.composite
def samples(draw: st.DrawFn) -> Samples:
    n = draw(st.integers(1, 128))
    rng = np.random.default_rng(draw(u32))
    field = rng.integers(-32768, 32768, (n, 3)).astype(np.int16)
    status = rng.integers(0, 8, n).astype(np.uint8)
    temperature = draw(st.integers(-32768, 32767))
    return Samples(draw(u8), draw(u32), draw(u32), temperature, field, status)


messages = st.one_of(
    descriptors(),
    samples(),
    st.builds(Status, st.integers(0, 2**64 - 1), u32, u32, u32, u32, u32, u8),
    st.builds(ClockReply, u32, u32, u32),
    st.builds(Log, u8, u32, text),
    st.builds(Ack, u8, u16, st.sampled_from(AckResult)),
    st.builds(Identify, u16, u8, u8),
    st.builds(Start, u16),
    st.builds(Stop, u16),
    st.builds(SetRate, u16, u32),
    st.builds(SetGain, u16, u8, u8, u8, u8, u8),
    st.builds(ClockPoll, u32),
    st.builds(Reboot, u16),
)


@given(messages)
@settings(max_examples=250, deadline=None)
def test_every_message_round_trips_over_serial(same: Same, message: Message) -> None:
    (received,) = SerialDecoder().feed(encode_serial(message))
    assert same(received.message, message)


@given(messages, st.integers(0, 127), st.booleans())
@settings(max_examples=150, deadline=None)
def test_every_message_round_trips_over_can(
    same: Same, message: Message, board: int, fd: bool
) -> None:
    (received,) = CanDecoder().feed(CanEncoder(board, fd).encode(message))
    assert same(received.message, message)
    assert received.board == board


@given(messages, st.binary(min_size=1, max_size=40))
@settings(max_examples=100, deadline=None)
def test_longer_message_of_a_known_type_is_read(
    same: Same, reference: SimpleNamespace, message: Message, more: bytes
) -> None:
    packet = _packet(message)
    longer = reference.packet(packet[0], packet[4:-4] + more)
    (received,) = SerialDecoder().feed(reference.serial(longer))
    assert same(received.message, message)


@given(messages, st.data())
@settings(max_examples=100, deadline=None)
def test_shortened_payload_is_refused(
    reference: SimpleNamespace, message: Message, data: st.DataObject
) -> None:
    packet = _packet(message)
    payload = packet[4:-4]
    cut = data.draw(st.integers(0, len(payload) - 1))
    decoder = SerialDecoder()
    assert decoder.feed(reference.serial(reference.packet(packet[0], payload[:cut]))) == []
    assert decoder.counters["short_payload"] == sum(decoder.counters.values()) == 1


def _packet(message: Message) -> bytes:
    """Packet as sent on CAN, joined from its long frames."""
    frames = CanEncoder(0, fd=True).encode(message)
    raw = b"".join(f.data[:-1] for f in frames)
    return raw[: 8 + raw[2] + (raw[3] << 8)]


def _descriptor_payload(**changes: Any) -> bytes:
    """Payload composed field by field from section 4 of PROTOCOL.md."""
    f = {
        "major": 1,
        "model": b"pad",
        "firmware": b"1",
        "tick_hz": 1_000_000,
        "max_rate": 100_000,
        "count": 1,
        "stride": 32,
        "array": 0,
        "chip": 1,
        "rows": 2,
        "columns": 2,
        "pitch": 8000,
        "lsb_xy": 150,
        "lsb_z": 242,
        "name": b"left",
    } | changes
    head = bytes([f["major"], 0]) + bytes(8) + f["model"].ljust(16, b"\0")
    head += f["firmware"].ljust(16, b"\0") + struct.pack("<II", f["tick_hz"], f["max_rate"])
    entry = bytes([f["array"], f["chip"], f["rows"], f["columns"]])
    entry += struct.pack("<III", f["pitch"], f["lsb_xy"], f["lsb_z"]) + f["name"].ljust(16, b"\0")
    entry = entry.ljust(f["stride"], b"\xee")
    return head + bytes([f["count"], f["stride"]]) + entry * f["count"]


BAD_DESCRIPTORS = [
    {"tick_hz": 0},
    {"max_rate": 0},
    {"count": 0},
    {"count": 17},
    {"count": 2},  # the same array number twice
    {"stride": 31},
    {"rows": 0},
    {"columns": 0},
    {"rows": 129, "columns": 1},
    {"rows": 16, "columns": 9},
    {"pitch": 0},
    {"lsb_xy": 0},
    {"lsb_z": 0},
    {"model": b"sixteen letters!"},
    {"model": b"a\0b"},
    {"firmware": b"\x1b[2J"},
    {"name": b"\xe9"},
]


@pytest.mark.parametrize("changes", BAD_DESCRIPTORS, ids=str)
def test_invalid_descriptor_is_refused(changes: dict[str, Any], reference: SimpleNamespace) -> None:
    decoder = SerialDecoder()
    packet = reference.packet(0x01, _descriptor_payload(**changes))
    assert decoder.feed(reference.serial(packet)) == []
    assert decoder.counters["bad_value"] == 1


def test_descriptors_of_newer_minor_versions_are_read(reference: SimpleNamespace) -> None:
    payload = _descriptor_payload(stride=40, chip=77) + b"more"
    (received,) = SerialDecoder().feed(reference.serial(reference.packet(0x01, payload)))
    (array,) = received.message.arrays
    assert array == ArrayDescriptor(0, "left", ChipType.UNKNOWN, 2, 2, 8000, 150, 242)


@pytest.mark.parametrize("major", [0, 2, 255])
def test_other_major_version_is_recognised(major: int, reference: SimpleNamespace) -> None:
    for payload in (
        _descriptor_payload(major=major, tick_hz=0, count=0, firmware=b"\xff"),
        _descriptor_payload(major=major)[:26],
    ):
        (received,) = SerialDecoder().feed(reference.serial(reference.packet(0x01, payload)))
        message = received.message
        assert (message.major, message.model, message.arrays) == (major, "pad", ())
        assert message.serial_number == "0" * 16


def test_identify_of_other_major_version_reaches_the_board(reference: SimpleNamespace) -> None:
    packet = reference.packet(0x81, bytes([9, 0, 3, 1]) + b"newer")
    (received,) = SerialDecoder().feed(reference.serial(packet))
    assert received.message == Identify(9, 3, 1)


@pytest.mark.parametrize("taxels", [0, 129, 255])
def test_samples_with_no_or_too_many_taxels_are_refused(
    taxels: int, reference: SimpleNamespace
) -> None:
    payload = bytes([0, taxels]) + bytes(10) + bytes(7 * min(taxels, 140))
    decoder = SerialDecoder()
    assert decoder.feed(reference.serial(reference.packet(0x02, payload))) == []
    assert decoder.counters["bad_value"] == 1


def test_samples_are_read_only_little_endian_views(
    make_samples: Callable[..., Samples], same: Same
) -> None:
    (received,) = SerialDecoder().feed(encode_serial(make_samples(3)))
    message = received.message
    assert isinstance(message, Samples)
    assert message.field.dtype == np.dtype("<i2")
    assert message.field.shape == (32, 3)
    assert not message.field.flags.owndata
    for array in (message.field, message.status):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1
    assert same(message, make_samples(3))


def test_board_text_cannot_control_the_terminal(reference: SimpleNamespace) -> None:
    raw = b"\x1b[2Jok\r\n\xff"
    payload = bytes([20, len(raw)]) + bytes(4) + raw
    (received,) = SerialDecoder().feed(reference.serial(reference.packet(0x05, payload)))
    assert received.message.text == "�[2Jok���"


def test_unknown_ack_results_are_failures(reference: SimpleNamespace) -> None:
    packet = reference.packet(0x06, bytes([0x82, 99, 1, 0]))
    (received,) = SerialDecoder().feed(reference.serial(packet))
    assert received.message == Ack(0x82, 1, AckResult.FAILED)


@given(st.one_of(u8, st.sampled_from(MessageType).map(int)), st.binary(max_size=300))
@settings(max_examples=300, deadline=None)
def test_payload_with_good_crc_is_decoded_or_counted(
    reference: SimpleNamespace, kind: int, payload: bytes
) -> None:
    decoder = SerialDecoder()
    received = decoder.feed(reference.serial(reference.packet(kind, payload)))
    assert len(received) == decoder.counters["accepted"]
    assert sum(decoder.counters.values()) == 1
    for item in received:
        if isinstance(item.message, Log):
            continue  # its text may have grown by replacement characters
        # Decoded messages can be encoded again: no field exceeds its layout.
        (again,) = SerialDecoder().feed(encode_serial(item.message))
        assert type(again.message) is type(item.message)


GOOD = ArrayDescriptor(0, "a", ChipType.MLX90393, 1, 1, 1, 1, 1)
COUNTS = np.zeros((2, 3), np.int16)
BITS = np.zeros(2, np.uint8)


@pytest.mark.parametrize(
    "message",
    [
        Start(0x10000),
        Start(-1),
        SetRate(1, 2**32),
        ClockPoll(-1),
        Log(20, 0, "x" * 256),
        Log(20, 0, "two\nlines"),
        Descriptor(1, 0, bytes(7), "m", "f", 1, 1, (GOOD,)),
        Descriptor(1, 0, bytes(8), "sixteen letters!", "f", 1, 1, (GOOD,)),
        Descriptor(1, 0, bytes(8), "µ", "f", 1, 1, (GOOD,)),
        Descriptor(1, 0, bytes(8), "m", "f", 1, 1, (GOOD,) * 17),
        Samples(0, 0, 0, 0, COUNTS, BITS[:1]),
        Samples(0, 0, 0, 0, COUNTS.T, BITS),
        Samples(0, 0, 0, 0, COUNTS[:0], BITS[:0]),
        Samples(0, 0, 0, 40_000, COUNTS, BITS),
    ],
    ids=lambda m: type(m).__name__,
)
def test_values_out_of_range_are_refused_locally(message: Message) -> None:
    with pytest.raises(ValueError, match=r"."):
        encode_serial(message)


@pytest.mark.parametrize(
    "thing",
    [
        Samples(0, 0, 0, 0, COUNTS.astype(np.int32), BITS),
        Samples(0, 0, 0, 0, COUNTS, BITS.astype(np.int64)),
        FloatSamples(COUNTS.astype("f4"), BITS.astype("f4"), BITS),
        "start",
    ],
)
def test_wrong_types_are_refused_locally(thing: Any) -> None:
    with pytest.raises(TypeError):
        encode_serial(thing)
