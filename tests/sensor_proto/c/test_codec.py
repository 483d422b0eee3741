"""tactile_proto.h writes the same bytes as the Python codec and refuses the same input."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sensor_proto
from sensor_proto.can_transfers import CanDecoder, CanFrame, identifier, segment
from sensor_proto.crc import crc32c
from sensor_proto.framing import SerialDecoder, encode_serial
from sensor_proto.packets import (
    ClockPoll,
    Identify,
    Message,
    SetGain,
    Start,
    Stop,
    message_type,
    pack,
)

Draw = Callable[[int, int], list[Message]]
DOCUMENT = (Path(sensor_proto.__file__).parent / "PROTOCOL.md").read_text("utf-8")


def test_crc_matches_published_values_in_c(codec: Any) -> None:
    assert codec.crc(b"123456789") == 0xE3069283
    assert codec.crc(pack(Start(7))) == 0x48674BC7


def test_serial_vectors_round_trip(codec: Any) -> None:
    vectors = re.findall(r"^```hex (\w+)\n(.*?)^```$", DOCUMENT, re.M | re.S)
    read = 0
    for name, body in vectors:
        if "= serial" not in body:
            continue
        packet_text, frame_text = body.split("= serial")
        packet = bytes.fromhex("".join(line[13:] for line in packet_text.splitlines()))
        frame = bytes.fromhex(frame_text)
        receiver = codec.receiver()
        got = receiver.serial(frame)
        if name == "newer_type":
            assert (got, receiver.counters["unknown_type"]) == ([], 1)
            continue
        assert got == [packet[:-4]], name
        (received,) = SerialDecoder().feed(frame)
        if not name.startswith("newer"):
            assert codec.encode(received.message, stuffed=True) == frame, name
        read += 1
    assert read == 15


@pytest.mark.parametrize("name", ["samples_classic", "samples_fd", "identify_fd"])
def test_can_vectors_round_trip(codec: Any, name: str) -> None:
    (body,) = re.findall(rf"^```can {name}\n(.*?)^```$", DOCUMENT, re.M | re.S)
    lines: list[tuple[str, bytes]] = []
    for line in body.splitlines():
        label, data = line[:13].strip(), bytes.fromhex(line[13:])
        lines = (
            [*lines, (label, data)] if label else [*lines[:-1], (lines[-1][0], lines[-1][1] + data)]
        )
    (_, packet), *frames = lines
    fd = name.endswith("_fd")
    transfer = frames[0][1][-1] & 31
    assert codec.segment(packet, fd, transfer) == [(int(i, 16), data) for i, data in frames]
    receiver = codec.receiver()
    assert [p for i, data in frames for p in receiver.can(int(i, 16), data, fd)] == [packet[:-4]]


def test_messages_are_byte_identical_in_c_and_python(
    codec: Any, draw: Draw, full: bool, notes: dict[str, Any]
) -> None:
    count = 100_000 if full else 1_300
    receiver = codec.receiver()
    transfers: dict[int, int] = {}
    for m in draw(count, 1):
        frame = encode_serial(m)
        assert codec.encode(m, stuffed=True) == frame
        (packet,) = receiver.serial(frame)
        kind, numbers, text = codec.fields(m)
        assert codec.decode(kind, packet[4:], m) == ("accepted", numbers, text)
        # The same on CAN, alternating both kinds of frames.
        transfer = transfers[kind] = (transfers.get(kind, 0) + 1) % 32
        fd = bool(transfer % 2)
        plain = codec.encode(m, stuffed=False, board=5)
        frames = segment(pack(m, 5), identifier(message_type(m), 5), transfer, fd)
        assert codec.segment(plain, fd, transfer) == [(f.identifier, f.data) for f in frames]
        got = [p for f in frames for p in receiver.can(f.identifier, f.data, fd)]
        assert got == [plain[:-4]]
    assert receiver.counters["accepted"] == sum(receiver.counters.values()) == 2 * count
    notes["messages"] = {"serial_each_way": count, "can_each_way": count, "differences": 0}


def corrupt(rng: np.random.Generator, frame: bytes) -> bytes:
    """Corrupt ``frame`` as a line may, or leave it intact."""
    at = int(rng.integers(0, len(frame) + 1))
    match int(rng.integers(0, 8)):
        case 0:
            return frame[:at] + rng.bytes(int(rng.integers(1, 5))) + frame[at:]
        case 1:
            return frame[:at] + frame[at + int(rng.integers(1, 5)) :]
        case 2:
            return frame[:at] + bytes([int(rng.integers(0, 256))]) + frame[at + 1 :]
        case 3:
            return frame[:at] + b"\0" * int(rng.integers(1, 4)) + frame[at:]
        case 4 if rng.random() < 0.1:
            return frame[:at] + b"\5" * int(rng.integers(1000, 1100)) + frame[at:]
        case _:
            return frame


def right_crc(body: bytes) -> bytes:
    return body + crc32c(body).to_bytes(4, "little")


def odd_packet(rng: np.random.Generator, m: Message) -> bytes:
    """A packet with a correct CRC and possibly invalid content."""
    body = bytearray(pack(m)[:-4])
    for _ in range(int(rng.integers(0, 4))):
        body[int(rng.integers(0, len(body)))] = int(rng.integers(0, 256))
    cut = int(rng.integers(4, len(body) + 1)) if rng.random() < 0.3 else len(body)
    body = body[:cut] + rng.bytes(int(rng.integers(0, 30)) if rng.random() < 0.3 else 0)
    if rng.random() < 0.9:
        body[2:4] = (len(body) - 4).to_bytes(2, "little")
    return right_crc(bytes(body))


def stuff(packet: bytes) -> bytes:
    from sensor_proto import cobs

    return cobs.encode(packet) + b"\0"


def test_receivers_agree_on_corrupted_serial_line(codec: Any, draw: Draw, full: bool) -> None:
    rng = np.random.default_rng(5)
    ours, theirs = codec.receiver(), SerialDecoder()
    for m in draw(30_000 if full else 2_000, 2):
        data = stuff(odd_packet(rng, m)) if rng.random() < 0.5 else encode_serial(m)
        data = corrupt(rng, data)
        packets, messages = ours.serial(data), theirs.feed(data)
        assert [p[0] for p in packets] == [message_type(r.message) for r in messages]
        assert {k: ours.counters[k] for k in theirs.counters} == theirs.counters
    assert min(theirs.counters.values()) > 0, theirs.counters


def test_receivers_agree_on_corrupted_can_bus(codec: Any, draw: Draw, full: bool) -> None:
    rng = np.random.default_rng(6)
    ours, theirs = codec.receiver(slots=60), CanDecoder()
    for number, m in enumerate(draw(30_000 if full else 2_000, 3)):
        board = int(rng.integers(3, 5))
        raw = odd_packet(rng, m) if rng.random() < 0.5 else pack(m, board)
        raw = raw[:1] + bytes([board]) + raw[2:-4] if rng.random() < 0.9 else raw[:-4]
        frames = list(
            segment(
                right_crc(raw), identifier(message_type(m), board), number % 32, rng.random() < 0.5
            )
        )
        for _ in range(int(rng.integers(0, 3))):
            at = int(rng.integers(0, len(frames)))
            f = frames[at]
            match int(rng.integers(0, 8)):
                case 0:
                    frames.insert(at, f)
                case 1 if len(frames) > 1:
                    del frames[at]
                case 2:
                    frames[at] = CanFrame(
                        f.identifier ^ (1 << int(rng.integers(0, 29))), f.data, f.fd
                    )
                case 3:
                    frames[at] = CanFrame(f.identifier, f.data[:-1], f.fd)
                case 4:
                    frames[at] = CanFrame(f.identifier, f.data, not f.fd)
                case 5:
                    tail = f.data[-1] ^ (1 << int(rng.integers(0, 8)))
                    frames[at] = CanFrame(f.identifier, f.data[:-1] + bytes([tail]), f.fd)
                case _:
                    pass
        # Identifiers of other boards must not take the slots of these.
        frames = [f for f in frames if f.identifier & 0x7F in (3, 4, 0x83, 0x84)]
        for f in frames:
            packets, messages = ours.can(f.identifier, f.data, f.fd), theirs.feed([f])
            assert [p[0] for p in packets] == [message_type(r.message) for r in messages]
        assert {k: ours.counters[k] for k in theirs.counters} == theirs.counters
    missing = {k for k, n in theirs.counters.items() if n == 0}
    assert missing <= {"error_frame", "oversized", "board"}, theirs.counters


def test_oversized_packet_is_refused_by_both(codec: Any) -> None:
    """Its bytes would fit a frame, as zeros of a packet cost no extra byte."""
    payload = b"\1\0" + b"\0" * 1024
    raw = right_crc(b"\x82\0" + len(payload).to_bytes(2, "little") + payload)
    ours, theirs = codec.receiver(), SerialDecoder()
    assert len(stuff(raw)) <= 1038
    assert ours.serial(stuff(raw)) == theirs.feed(stuff(raw)) == []
    assert ours.counters["oversized"] == theirs.counters["oversized"] == 1
    frames = segment(raw, identifier(message_type(Start(1)), 0), 0, True)
    bus = CanDecoder()
    assert [p for f in frames for p in ours.can(f.identifier, f.data, True)] == []
    assert bus.feed(frames) == []
    assert ours.counters["oversized"] == 2
    assert bus.counters["oversized"] == 1


def test_receiver_checks_bytes_it_cannot_hold(codec: Any) -> None:
    """With 16 bytes of memory, a newer host's longer command is obeyed unless corrupted."""
    payload = pack(SetGain(9, 255, 7, 0, 0, 3))[4:-4] + bytes(range(1, 201))
    raw = right_crc(b"\x85\0" + len(payload).to_bytes(2, "little") + payload)
    receiver = codec.receiver(hold=16)
    assert receiver.serial(stuff(raw)) == [raw[:16]]
    assert receiver.serial(stuff(raw[:100] + b"\x07" + raw[101:])) == []
    assert receiver.counters["crc"] == 1
    for fd in (False, True):
        frames = segment(
            raw[:1] + raw[1:], identifier(message_type(SetGain(0, 0, 0, 0, 0, 0)), 0), 1, fd
        )
        assert [p for f in frames for p in receiver.can(f.identifier, f.data, fd)] == [raw[:16]]


def test_missing_slot_drops_least_recent_transfer_and_counts_it(codec: Any) -> None:
    receiver = codec.receiver(slots=2, hold=32)
    begun = [
        segment(pack(m, 4), identifier(message_type(m), 4), 0, False)
        for m in (Identify(1), SetGain(2, 0, 0, 0, 0, 0), ClockPoll(3))
    ]
    for first, *_ in begun:
        assert receiver.can(first.identifier, first.data, False) == []
    got = [
        p for frames in begun for f in frames[1:] for p in receiver.can(f.identifier, f.data, False)
    ]
    assert [p[0] for p in got] == [0x85, 0x86]
    assert receiver.counters["interrupted"] == 1
    assert receiver.counters["no_start"] == 1


def test_writer_never_exceeds_its_buffer(codec: Any, draw: Draw) -> None:
    for m in draw(130, 4):
        for stuffed in (True, False):
            size = len(codec.encode(m, stuffed))
            assert codec.encode(m, stuffed, room=size - 1) == b""
            assert len(codec.encode(m, stuffed, room=size)) == size


def test_answer_is_independent_of_chunking(codec: Any) -> None:
    receiver = codec.receiver()
    data = encode_serial(Start(1)) + b"\0\0" + encode_serial(Stop(2))
    packets = [p for byte in data for p in receiver.serial(bytes([byte]))]
    assert [p[0] for p in packets] == [0x82, 0x83]
    assert receiver.counters["empty"] == 2
