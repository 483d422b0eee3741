"""The vectors of PROTOCOL.md match the reference codecs, our encoder and our decoder."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import sensor_proto
from sensor_proto.anyskin import encode_anyskin
from sensor_proto.can_transfers import CanDecoder, CanEncoder, CanFrame
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
    Reboot,
    Samples,
    SetGain,
    SetRate,
    Start,
    Status,
    Stop,
)

DOCUMENT = (Path(sensor_proto.__file__).parent / "PROTOCOL.md").read_text("utf-8")
UNIQUE_ID = bytes.fromhex("0011223344556677")

MESSAGES: dict[str, Message] = {
    "identify": Identify(request=1, major=1, minor=0),
    "descriptor": Descriptor(
        major=1,
        minor=0,
        unique_id=UNIQUE_ID,
        model="pad",
        firmware="1.4",
        tick_hz=1_000_000,
        max_rate_mhz=377_032,
        arrays=(ArrayDescriptor(0, "left", ChipType.MLX90393, 1, 2, 8000, 150, 242),),
    ),
    "start": Start(request=2),
    "ack": Ack(command=0x82, request=2, result=AckResult.OK),
    "samples": Samples(
        array=0,
        sequence=7,
        ticks=1000,
        temperature_cc=2550,
        field=np.array([[1, -2, 300], [32767, -32768, 0]], np.int16),
        status=np.array([0, 1], np.uint8),
    ),
    "set_rate": SetRate(request=3, rate_mhz=100_000),
    "set_gain": SetGain(4, array=255, gain=7, resolution=0, oversampling=0, filter=3),
    "clock_poll": ClockPoll(token=0x11223344),
    "clock_reply": ClockReply(0x11223344, ticks_received=0xFFFFFFF0, ticks_sent=0x10),
    "status": Status(61_000, 6000, 2, 1, 3, rate_mhz=100_000, reset_cause=0),
    "log": Log(level=30, ticks=1000, text="9 µT"),
    "stop": Stop(request=5),
    "reboot": Reboot(request=6),
}
NEWER = {
    "newer_ack": MESSAGES["ack"],
    "newer_major": Descriptor(2, 5, UNIQUE_ID, "pad", "", 0, 0, ()),
}


def blocks(kind: str) -> dict[str, list[tuple[str, bytes]]]:
    """Vectors of the document: name → lines of (label, bytes), with continued lines joined."""
    found = {}
    for name, body in re.findall(rf"^```{kind} (\w+)\n(.*?)^```$", DOCUMENT, re.M | re.S):
        lines: list[tuple[str, bytes]] = []
        for line in body.splitlines():
            label, data = line[:13].strip(), bytes.fromhex(line[13:])
            if label:
                lines.append((label, data))
            else:
                lines[-1] = (lines[-1][0], lines[-1][1] + data)
        found[name] = lines
    return found


SERIAL = {name: lines for name, lines in blocks("hex").items() if lines[-1][0] == "= serial"}
CAN = blocks("can")


def frame_of(name: str) -> bytes:
    return SERIAL[name][-1][1]


def test_protocol_document_has_a_vector_for_every_message() -> None:
    assert set(SERIAL) == {*MESSAGES, *NEWER, "newer_type"}
    assert {type(m).__name__ for m in MESSAGES.values()} == {
        c.__name__
        for c in (
            *sensor_proto.packets.BoardMessage.__args__,
            *sensor_proto.packets.HostMessage.__args__,
        )
    }


@pytest.mark.parametrize("name", SERIAL)
def test_protocol_document_matches_the_reference(name: str, reference: SimpleNamespace) -> None:
    *fields, (label, crc), (_, frame) = SERIAL[name]
    assert label == "crc"
    body = b"".join(data for _, data in fields)
    assert reference.crc(body).to_bytes(4, "little") == crc
    assert int.from_bytes(body[2:4], "little") == len(body) - 4
    assert reference.serial(body + crc) == frame


@pytest.mark.parametrize("name", MESSAGES)
def test_encoder_writes_the_vector(name: str) -> None:
    assert encode_serial(MESSAGES[name]) == frame_of(name)


@pytest.mark.parametrize("name", [*MESSAGES, *NEWER])
def test_decoder_reads_the_vector(name: str, same: Callable[[object, object], bool]) -> None:
    decoder = SerialDecoder()
    (received,) = decoder.feed(frame_of(name))
    assert same(received.message, (MESSAGES | NEWER)[name])
    assert (received.board, received.trailing) == (0, 0)
    assert decoder.counters["accepted"] == sum(decoder.counters.values()) == 1


def test_unknown_type_is_skipped_and_counted() -> None:
    decoder = SerialDecoder()
    (received,) = decoder.feed(frame_of("newer_type") + frame_of("start"))
    assert received.message == Start(2)
    assert decoder.counters["unknown_type"] == 1
    assert sum(decoder.counters.values()) == 2


def can_frames(name: str) -> tuple[bytes, tuple[CanFrame, ...]]:
    (_, packet), *lines = CAN[name]
    fd = name.endswith("_fd")
    return packet, tuple(CanFrame(int(label, 16), data, fd) for label, data in lines)


CAN_VECTORS = [
    ("samples_classic", MESSAGES["samples"], 5, 9),
    ("samples_fd", MESSAGES["samples"], 5, 31),
    ("identify_fd", MESSAGES["identify"], 127, 0),
]


def test_every_can_vector_is_used() -> None:
    assert [name for name, *_ in CAN_VECTORS] == list(CAN)


@pytest.mark.parametrize(("name", "message", "board", "transfer"), CAN_VECTORS)
def test_can_vectors_are_read_and_written(
    name: str,
    message: Message,
    board: int,
    transfer: int,
    reference: SimpleNamespace,
    same: Callable[[object, object], bool],
) -> None:
    packet, frames = can_frames(name)
    size = 64 if name.endswith("_fd") else 8
    assert packet[:-4] + reference.crc(packet[:-4]).to_bytes(4, "little") == packet
    assert [f.data for f in frames] == reference.can(packet, transfer, size)

    encoder = CanEncoder(board, fd=size == 64)
    for _ in range(transfer):
        encoder.encode(message)
    assert encoder.encode(message) == frames

    decoder = CanDecoder()
    (received,) = decoder.feed(frames)
    assert same(received.message, message)
    assert received.board == board


def test_unframed_vector_is_read_and_written() -> None:
    frame = b"".join(data for _, data in blocks("hex")["anyskin"])
    samples = FloatSamples(
        np.array([[1, -2, 300.5]], np.float32), np.array([25], np.float32), np.zeros(1, np.uint8)
    )
    assert encode_anyskin(samples) == frame
