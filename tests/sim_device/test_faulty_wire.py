"""Wires that corrupt what they carry, and account for every frame."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sensor_proto.can_transfers import BusState, CanDecoder, CanEncoder, CanFrame, reported_state
from sensor_proto.framing import SerialDecoder, encode_serial
from sensor_proto.packets import Log
from sim_device.board.wire import CanWire, SerialWire
from sim_device.faults import FaultPlan, Window


def frames(n: int) -> list[bytes]:
    return [encode_serial(Log(20, i, f"line {i} " + "x" * (i % 40))) for i in range(n)]


def carry(wire: SerialWire, sent: list[bytes]) -> list[bytes]:
    """What the wire lets through: a frame every 10 ms, then nothing for a minute."""
    out = []
    for i, frame in enumerate(sent):
        out += wire.pass_on([frame], i * 0.01)
    return out + wire.pass_on([], 1e9)


def balanced(counters: dict[str, int]) -> bool:
    gone = ("intact", "damaged", "lost", "silenced", "held")
    return counters["sent"] + counters["duplicated"] == sum(counters[name] for name in gone)


probability = st.sampled_from([0.0, 0.0, 0.02, 0.2])


@given(
    st.builds(
        FaultPlan,
        seed=st.integers(0, 1000),
        flip=st.sampled_from([0.0, 1e-4, 1e-3]),
        byteloss=st.sampled_from([0.0, 1e-3, 1e-2]),
        byteinsert=st.sampled_from([0.0, 1e-3, 1e-2]),
        loss=probability,
        duplicate=probability,
        reorder=probability,
        splice=probability,
        delay=probability,
        silence=st.sampled_from([(), (Window(0.2, 0.3),)]),
    )
)
@settings(max_examples=60, deadline=None)
def test_accepted_frames_are_the_intact_ones(plan: FaultPlan) -> None:
    wire, decoder = SerialWire(plan), SerialDecoder()
    sent = frames(100)
    received = [m for piece in carry(wire, sent) for m in decoder.feed(piece)]
    counters = wire.counters
    assert counters["sent"] == 100
    assert balanced(counters)
    assert decoder.counters["accepted"] == counters["intact"] == len(received)
    assert {encode_serial(r.message) for r in received} <= set(sent)


def test_no_fault_changes_nothing() -> None:
    sent = frames(50)
    wire = SerialWire(FaultPlan())
    assert b"".join(carry(wire, sent)) == b"".join(sent)
    assert wire.counters["intact"] == 50


@pytest.mark.parametrize(
    ("plan", "counter", "low", "high"),
    [
        (FaultPlan(loss=0.1), "lost", 60, 140),
        (FaultPlan(duplicate=0.1), "duplicated", 60, 140),
        (FaultPlan(reorder=0.1), "reordered", 55, 130),
        (FaultPlan(splice=0.1), "spliced", 55, 130),
        (FaultPlan(delay=0.1), "delayed", 60, 140),
        (FaultPlan(flip=1e-3), "bits_flipped", 200, 500),
        (FaultPlan(byteloss=1e-3), "bytes_lost", 20, 70),
        (FaultPlan(byteinsert=1e-3), "bytes_inserted", 20, 70),
        (FaultPlan(silence=(Window(1.0, 2.0),)), "silenced", 200, 200),
    ],
)
def test_every_fault_happens_at_its_rate_and_is_counted(plan, counter, low, high) -> None:
    wire = SerialWire(plan)
    carry(wire, frames(1000))
    assert low <= wire.counters[counter] <= high


def test_same_seed_same_damage() -> None:
    def out(seed: int) -> bytes:
        plan = FaultPlan(seed=seed, flip=1e-3, loss=0.1, reorder=0.1, duplicate=0.1, splice=0.05)
        return b"".join(carry(SerialWire(plan), frames(200)))

    assert out(1) == out(1)
    assert out(1) != out(2)


def test_reordered_frames_change_places() -> None:
    sent = frames(3)
    wire = SerialWire(FaultPlan(reorder=1.0))
    assert wire.pass_on(sent[:1], 0.0) == []
    assert wire.counters["held"] == 1
    assert wire.pass_on(sent[1:2], 0.01) == [sent[1], sent[0]]
    assert wire.pass_on(sent[2:], 0.02) == []


def test_a_delayed_frame_holds_up_those_behind_it() -> None:
    sent = frames(2)
    wire = SerialWire(FaultPlan(seed=0, delay=0.5, delay_s=0.1))
    times = []
    for i in range(400):
        out = wire.pass_on(frames(1), i * 0.001)
        times += [i] * len(out)
    assert wire.counters["delayed"] > 100
    assert times == sorted(times)
    # Half of the frames start a delay of 0.1 s: whatever comes out is at least that late or was
    # behind one that is.
    assert wire.counters["held"] >= 95
    assert len(sent) == 2


def can_frames(n: int, fd: bool = False) -> list[CanFrame]:
    encoder = CanEncoder(3, fd)
    return [f for i in range(n) for f in encoder.encode(Log(20, i, "x" * 60))]


def test_can_faults_are_counted_and_transfers_never_mixed() -> None:
    plan = FaultPlan(
        seed=4, flip=1e-4, loss=0.01, duplicate=0.02, reorder=0.01, splice=0.005, delay=0.01
    )
    wire, decoder = CanWire(plan), CanDecoder()
    received = []
    for i, frame in enumerate(can_frames(300)):
        received += decoder.feed(wire.pass_on([frame], i * 1e-3))
    received += decoder.feed(wire.pass_on([], 1e9))
    counters = wire.counters
    assert balanced(counters)
    assert all(
        counters[name]
        for name in ("lost", "duplicated", "reordered", "spliced", "delayed", "damaged")
    )
    assert 100 < len(received) < 300
    assert all(r.message.text == "x" * 60 for r in received)


def test_bit_flips_in_can_frames_are_detected() -> None:
    wire, decoder = CanWire(FaultPlan(seed=1, flip=0.002)), CanDecoder()
    encoder = CanEncoder(3, True)
    for i in range(500):
        # 33 characters fill 48 bytes: there is no padding, where a flip would do no harm.
        for got in decoder.feed(wire.pass_on(encoder.encode(Log(20, i, "x" * 33)), i * 0.01)):
            assert got.message == Log(20, i, "x" * 33)
    intact = wire.counters["intact"]
    assert 100 < intact < 400
    # A transfer of one frame may survive a flip in its transfer number, on which nothing depends.
    assert intact <= decoder.counters["accepted"] <= intact + 10


def test_bus_off_is_reported_by_error_frames_and_ends() -> None:
    wire = CanWire(FaultPlan(busoff=(Window(1.0, 0.5),)))
    data = can_frames(1)
    assert wire.pass_on(data, 0.9) == data
    (frame,) = wire.pass_on(data, 1.0)
    assert frame.error
    assert reported_state(frame) is BusState.BUS_OFF
    assert wire.pass_on(data, 1.2) == []
    frame, *rest = wire.pass_on(data, 1.5)
    assert reported_state(frame) is BusState.ACTIVE
    assert rest == data
    counters = wire.counters
    assert counters["lost"] == 2 * len(data)
    assert counters["error_frames"] == 2
    assert balanced(counters)


def test_faults_of_the_other_medium_are_refused() -> None:
    with pytest.raises(ValueError, match="busoff"):
        SerialWire(FaultPlan(busoff=(Window(1, 1),)))
    with pytest.raises(ValueError, match="byteloss"):
        CanWire(FaultPlan(byteloss=0.1))
