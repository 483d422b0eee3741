"""Behaviour that PROTOCOL.md requires beside the bytes, of simulated board and reference codec."""

from __future__ import annotations

import numpy as np
import pytest

from sensor_proto.can_transfers import CanDecoder, CanEncoder, CanFrame
from sensor_proto.packets import (
    Ack,
    AckResult,
    Descriptor,
    Identify,
    Message,
    Samples,
    SetGain,
    Start,
    Status,
)
from sim_device.board.catalogue import build_skin, identity
from sim_device.board.firmware import ClockParameters, Controller
from sim_device.faults import FaultPlan
from sim_device.skin.elastomer import Contact
from sim_device.skin.environment import Environment
from sim_device.skin.sampler import Sampler
from tactile_core.types import Instant

MS = 1_000_000


def board(contacts: tuple[Contact, ...] = ()) -> Controller:
    sampler = Sampler(build_skin("finger", 0), Environment(), contacts)
    return Controller(sampler, identity("finger", 0), ClockParameters(), FaultPlan())


def run(controller: Controller, start_ms: int, end_ms: int) -> list[Message]:
    sent: list[Message] = []
    for ms in range(start_ms, end_ms, 5):
        now = Instant(ms * MS)
        controller.advance(now)
        while messages := controller.take(now):
            sent += messages
    return sent


def test_status_is_sent_before_any_identify() -> None:
    sent = run(board(), 0, 1500)
    assert any(isinstance(m, Status) for m in sent)
    assert not any(isinstance(m, Descriptor | Samples) for m in sent)


@pytest.mark.parametrize(
    "gain",
    [
        SetGain(7, 255, 8, 0, 0, 3),  # no such gain
        SetGain(7, 255, 7, 4, 0, 3),  # no such resolution
        SetGain(7, 9, 7, 0, 0, 3),  # no such array
        SetGain(7, 255, 7, 0, 3, 7),  # too slow for 100 Hz
    ],
)
def test_unsupported_gain_is_refused_and_changes_nothing(gain: SetGain) -> None:
    controller = board()
    run(controller, 0, 500)
    before = controller.descriptor()
    controller.handle(gain, Instant(500 * MS))
    (ack,) = [m for m in run(controller, 500, 520) if isinstance(m, Ack)]
    assert (ack.request, ack.result) == (7, AckResult.BAD_ARGUMENT)
    assert controller.descriptor() == before


def test_arrays_sampled_together_carry_the_same_ticks() -> None:
    controller = board()
    run(controller, 0, 500)
    controller.handle(Start(1), Instant(500 * MS))
    samples = [m for m in run(controller, 500, 700) if isinstance(m, Samples)]
    by_cycle: dict[int, set[int]] = {}
    for m in samples:
        by_cycle.setdefault(m.sequence, set()).add(m.ticks)
    assert len(by_cycle) > 10
    assert all(len(ticks) == 1 for ticks in by_cycle.values())


@pytest.mark.parametrize("model", ["finger", "anyskin"])
def test_press_increases_z(model: str) -> None:
    skin = build_skin(model, 0)
    array = skin.geometry.arrays[0]
    middle = array.taxels // 2 if model == "finger" else 0
    outwards = array.rotation[middle][:, 2]
    counts = []
    for pressed in ((), (Contact(array.position[middle], -5.0 * outwards, 2e-3),)):
        skin.reset()
        sampler = Sampler(skin, Environment(), pressed)
        for ms in range(0, 200, 10):
            reading = sampler.read(Instant(ms * MS), ms / 1000)
        counts.append(reading.counts[middle].astype(np.int64))
    assert counts[1][2] - counts[0][2] > 200


def test_frame_with_bit_7_set_is_ignored() -> None:
    decoder = CanDecoder()
    (frame,) = CanEncoder(5, fd=True).encode(Identify(1))
    assert len(decoder.feed((frame,))) == 1
    assert decoder.feed((CanFrame(frame.identifier | 0x80, frame.data, True),)) == []
    assert decoder.counters["foreign"] == 1


def test_each_type_counts_its_own_transfers() -> None:
    encoder = CanEncoder(5, fd=True)
    sent: tuple[Message, ...] = (Start(1), Identify(2), Start(3), Start(4), Identify(5))
    ids = [encoder.encode(message)[-1].data[-1] & 0x1F for message in sent]
    assert ids == [0, 0, 1, 2, 1]
