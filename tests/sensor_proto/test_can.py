"""CAN transfers: interleaved boards are decoded, corrupted transfers are not."""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sensor_proto.can_transfers import BROADCAST, MARK, CanDecoder, CanEncoder, CanFrame
from sensor_proto.packets import (
    Ack,
    AckResult,
    ClockPoll,
    Decoder,
    MessageType,
    Received,
    Samples,
    Start,
    Status,
)

MakeSamples = Callable[..., Samples]
Frames = list[CanFrame]
u7 = st.integers(0, 127)


def numbers(received: list[Received]) -> list[tuple[int, int]]:
    """Board and sequence of every samples message."""
    return [(r.board, r.message.sequence) for r in received if isinstance(r.message, Samples)]


def refused(decoder: CanDecoder) -> dict[str, int]:
    return {k: n for k, n in decoder.counters.items() if n and k != "accepted"}


def start_id(board: int = 3) -> int:
    return 2 << 26 | 0x2A5 << 16 | 0x82 << 8 | board


@pytest.fixture(params=[False, True], ids=["classic", "fd"])
def fd(request: pytest.FixtureRequest) -> bool:
    return bool(request.param)


@pytest.fixture
def transfers(make_samples: MakeSamples, fd: bool) -> list[Frames]:
    encoder = CanEncoder(3, fd)
    return [list(encoder.encode(make_samples(i, taxels=16))) for i in range(8)]


def flat(transfers: list[Frames]) -> Frames:
    return [frame for transfer in transfers for frame in transfer]


def test_decoder_satisfies_the_protocol() -> None:
    decoder: Decoder[list[CanFrame]] = CanDecoder()
    assert decoder.feed([]) == []


def test_identifiers_carry_priority_mark_type_and_board(make_samples: MakeSamples) -> None:
    encoder = CanEncoder(77, fd=True)
    for message, kind in (
        (ClockPoll(1), 0x86),
        (Start(1), 0x82),
        (make_samples(1), 0x02),
        (Status(1, 2, 3, 4, 5, 6, 0), 0x03),
    ):
        can_id = encoder.encode(message)[0].identifier
        assert (can_id >> 16 & 0x3FF, can_id >> 8 & 0xFF, can_id & 0xFF) == (MARK, kind, 77)
    order = [encoder.encode(m)[0].identifier for m in (ClockPoll(1), Start(1), make_samples(1))]
    assert order == sorted(order)


@pytest.mark.parametrize("board", [-1, 128])
def test_board_number_out_of_range_is_refused_locally(board: int) -> None:
    with pytest.raises(ValueError, match="0 to 127"):
        CanEncoder(board, fd=False)


def test_frame_lengths_are_valid_for_the_medium(make_samples: MakeSamples, fd: bool) -> None:
    lengths = {*range(9), 12, 16, 20, 24, 32, 48, 64} if fd else set(range(1, 9))
    for taxels in range(1, 129):
        frames = CanEncoder(0, fd).encode(make_samples(1, taxels=taxels))
        assert {len(f.data) for f in frames} <= lengths
        assert {len(f.data) for f in frames[:-1]} <= {64 if fd else 8}
        assert all(f.fd == fd for f in frames)
        assert numbers(CanDecoder().feed(frames)) == [(0, 1)]


@given(order=st.randoms(use_true_random=False), chunk=st.integers(1, 50))
@settings(max_examples=40, deadline=None)
def test_boards_and_types_may_interleave(
    make_samples: MakeSamples, order: object, chunk: int
) -> None:
    streams: list[Frames] = []
    sent = []
    for board in (0, 5, 126, 127):
        encoder = CanEncoder(board, fd=board % 2 == 1)
        streams.append(flat([list(encoder.encode(make_samples(i, taxels=7))) for i in range(4)]))
        streams.append(flat([list(encoder.encode(Start(i))) for i in range(3)]))
        sent += [(board, i) for i in range(4)]
    wire = []
    while any(streams):
        stream = order.choice([s for s in streams if s])
        wire.append(stream.pop(0))
    decoder = CanDecoder()
    got = [r for at in range(0, len(wire), chunk) for r in decoder.feed(wire[at : at + chunk])]
    assert sorted(numbers(got)) == sorted(sent)
    assert sum(isinstance(r.message, Start) for r in got) == 12
    assert refused(decoder) == {}


def test_lost_frame_drops_only_its_transfer(transfers: list[Frames]) -> None:
    for at in range(len(transfers[2])):
        decoder = CanDecoder()
        damaged = transfers[2][:at] + transfers[2][at + 1 :]
        got = numbers(decoder.feed(flat([*transfers[:2], damaged, *transfers[3:]])))
        assert got == [(3, i) for i in range(8) if i != 2]
        assert refused(decoder)


def test_swapped_frames_drop_only_their_transfer(transfers: list[Frames]) -> None:
    frames = transfers[2]
    for a in range(len(frames)):
        for b in range(a + 1, len(frames)):
            damaged = list(frames)
            damaged[a], damaged[b] = damaged[b], damaged[a]
            decoder = CanDecoder()
            got = numbers(decoder.feed(flat([*transfers[:2], damaged, *transfers[3:]])))
            assert got == [(3, i) for i in range(8) if i != 2]
            assert refused(decoder)


def test_repeated_frame_is_used_once_and_counted(transfers: list[Frames]) -> None:
    for at in range(len(transfers[2])):
        decoder = CanDecoder()
        damaged = list(transfers[2])
        damaged.insert(at, damaged[at])
        got = numbers(decoder.feed(flat([*transfers[:2], damaged, *transfers[3:]])))
        assert got == [(3, i) for i in range(8)]
        assert refused(decoder) == {"duplicate": 1}


def test_repeated_single_frame_transfer_is_used_once() -> None:
    decoder = CanDecoder()
    (frame,) = CanEncoder(1, fd=True).encode(Start(4))
    assert len(decoder.feed([frame, frame])) == 1
    assert refused(decoder) == {"duplicate": 1}


def test_consecutive_equal_messages_are_all_used() -> None:
    decoder, encoder = CanDecoder(), CanEncoder(1, fd=True)
    got = decoder.feed([f for _ in range(100) for f in encoder.encode(Ack(1, 2, AckResult.OK))])
    assert len(got) == 100


def test_losing_a_whole_round_of_transfer_ids_mixes_nothing(make_samples: MakeSamples) -> None:
    """The end of a transfer follows the start of one 32 earlier, so all tails fit."""
    encoder = CanEncoder(1, fd=False)
    sent = [encoder.encode(make_samples(i, taxels=16)) for i in range(33)]
    assert sent[0][0].data[-1] == sent[32][0].data[-1]
    # The first frames are equal: they hold only header, array, taxels and temperature.
    for cut in range(2, len(sent[0])):
        decoder = CanDecoder()
        assert decoder.feed(sent[0][:cut] + sent[32][cut:]) == []
        assert refused(decoder) == {"crc": 1}


def test_reset_board_restarts_its_transfer_ids(make_samples: MakeSamples) -> None:
    before, after = CanEncoder(2, fd=False), CanEncoder(2, fd=False)
    first = before.encode(make_samples(1))
    again = after.encode(make_samples(2))
    decoder = CanDecoder()
    assert numbers(decoder.feed(first[:5] + again)) == [(2, 2)]
    assert refused(decoder) == {"interrupted": 1}


def test_classic_and_fd_frames_do_not_mix(make_samples: MakeSamples) -> None:
    frames = CanEncoder(2, fd=True).encode(make_samples(1))
    odd = [frames[0], replace(frames[1], fd=False), *frames[2:]]
    decoder = CanDecoder()
    assert decoder.feed(odd) == []


@pytest.mark.parametrize(
    ("reason", "frame"),
    [
        ("error_frame", CanFrame(0x20, bytes(8), error=True)),
        ("foreign", CanFrame(0x12345678, b"\x01\xe0")),
        ("foreign", CanFrame(start_id() | 0x80, b"\x01\xe0")),
        ("foreign", CanFrame(start_id() | 1 << 29, b"\x01\xe0")),
        ("bad_frame", CanFrame(start_id(), b"")),
        ("bad_frame", CanFrame(start_id(), b"\x01\xa0")),  # neither full nor the last
        ("bad_frame", CanFrame(start_id(), bytes(8) + b"\xe0")),  # nine bytes on CAN 2.0B
        ("unknown_type", CanFrame(start_id() ^ 0x7000, b"\x01\xe0")),
        ("no_start", CanFrame(start_id(), bytes(7) + b"\x20")),
        ("out_of_order", CanFrame(start_id(), bytes(7) + b"\x80")),  # start with toggle 0
        ("runt", CanFrame(start_id(), b"\x82\x03\xe0")),
    ],
)
def test_each_reason_has_its_counter(reason: str, frame: CanFrame) -> None:
    decoder = CanDecoder()
    assert decoder.feed([frame]) == []
    assert refused(decoder) == {reason: 1}


@pytest.mark.parametrize(
    ("reason", "kind", "board", "payload"),
    [
        ("type_mismatch", 0x83, 3, b"\1\0"),
        ("board", 0x82, 4, b"\1\0"),
        ("short_payload", 0x82, 3, b"\1"),
    ],
)
def test_header_and_identifier_must_match(
    reason: str, kind: int, board: int, payload: bytes, reference: SimpleNamespace
) -> None:
    packet = reference.packet(kind, payload, board)
    decoder = CanDecoder()
    frames = [CanFrame(start_id(3), d) for d in reference.can(packet, 4, 8)]
    assert decoder.feed(frames) == []
    assert refused(decoder) == {reason: 1}


def test_length_and_bytes_must_match(reference: SimpleNamespace) -> None:
    packet = reference.packet(0x82, b"\1\0", 3)
    for wrong in (packet + b"\0", packet + bytes(60), packet[:2] + b"\x09\0" + packet[4:]):
        for size in (8, 64):
            frames = [CanFrame(start_id(3), d, size == 64) for d in reference.can(wrong, 0, size)]
            decoder = CanDecoder()
            got = decoder.feed(frames)
            padded = size == 64 and wrong == packet + b"\0"  # indistinguishable from padding
            assert len(got) == padded
            assert padded or refused(decoder) == {"length": 1}


def test_endless_transfer_is_dropped(fd: bool) -> None:
    decoder = CanDecoder()
    full = 63 if fd else 7
    body = b"\x82\x03\xff\xff".ljust(full, b"\1")
    assert decoder.feed([CanFrame(start_id(), body + b"\xa0", fd)]) == []
    for i in range(500):
        tail = bytes([0x20 if i % 2 else 0])
        assert decoder.feed([CanFrame(start_id(), body + tail, fd)]) == []
    assert decoder.counters["oversized"] == 1
    assert decoder.counters["no_start"] > 300


def test_memory_is_bounded_for_any_input() -> None:
    rng = np.random.default_rng(5)
    decoder = CanDecoder()
    kinds = [int(k) for k in MessageType]

    def flood(rounds: int) -> None:
        """Start and continue, but never end, transfers of every board and type."""
        for _ in range(rounds):
            for board in range(0, 128, 4):
                for kind in kinds:
                    can_id = MARK << 16 | kind << 8 | board
                    tail = int(rng.choice([0xA0, 0x00, 0x20]))
                    decoder.feed([CanFrame(can_id, rng.bytes(63) + bytes([tail]), fd=True)])

    flood(4)
    tracemalloc.start()
    flood(8)
    grown, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert grown < 32 * len(kinds) * 1200


frames_at_random = st.builds(
    CanFrame,
    st.one_of(
        st.integers(0, 2**32),
        st.builds(lambda k, b: MARK << 16 | k << 8 | b, st.sampled_from(MessageType), u7),
    ),
    st.binary(max_size=70),
    st.booleans(),
    st.integers(0, 9).map(lambda n: n == 0),
)


@given(st.lists(frames_at_random, max_size=30))
@settings(max_examples=100, deadline=None)
def test_random_frames_never_raise_and_are_never_accepted(frames: Frames) -> None:
    decoder = CanDecoder()
    assert decoder.feed(frames) == []
    assert decoder.counters["accepted"] == 0


def test_reset_forgets_unfinished_transfers(transfers: list[Frames]) -> None:
    decoder = CanDecoder()
    decoder.feed(transfers[0][:2])
    decoder.reset()
    assert numbers(decoder.feed(transfers[0][2:] + transfers[1])) == [(3, 1)]
    assert "interrupted" not in refused(decoder)


def test_unknown_commands_can_be_answered_by_number(reference: SimpleNamespace) -> None:
    packet = reference.packet(0xF0, b"\x34\x12", 3)
    can_id = start_id() & ~0xFF00 | 0xF000
    decoder = CanDecoder()
    decoder.feed([CanFrame(can_id, d) for d in reference.can(packet, 0, 8)])
    assert decoder.take_unknown() == [(0xF0, 0x1234)]


def test_broadcast_is_recognised() -> None:
    (received,) = CanDecoder().feed(CanEncoder(BROADCAST, fd=False).encode(Start(1)))
    assert received.board == BROADCAST == 127


def test_losses_are_exact_by_sequence(make_samples: MakeSamples) -> None:
    """sent = accepted + lost, on a bus that loses one frame in fifty."""
    rng = np.random.default_rng(8)
    encoder, decoder = CanEncoder(1, fd=False), CanDecoder()
    got: list[int] = []
    whole: list[int] = []
    for i in range(400):
        frames = encoder.encode(make_samples(i, taxels=4))
        kept = [f for f in frames if rng.random() > 0.02]
        if len(kept) == len(frames):
            whole.append(i)
        got += [n for _, n in numbers(decoder.feed(kept))]
    assert got == whole
    assert 0 < len(got) < 400
