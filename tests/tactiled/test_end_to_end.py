"""A simulated board's bytes through line, link, clock and pipeline, on virtual time."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from sensor_proto.can_transfers import CanFrame
from sim_device.board.catalogue import build_skin, factory_calibration, identity
from sim_device.board.firmware import CanBoard, ClockParameters, SerialBoard
from sim_device.faults import FaultPlan
from sim_device.skin.skin import Contact
from tactile_core.geometry import Side
from tactile_core.types import NS_PER_S, Instant
from tactiled.blocks import Chunk, Cycle
from tactiled.boards.board import BoardLink
from tactiled.boards.events import Identity, Refusal, Sampled
from tactiled.boards.line import CanLine, SerialLine
from tactiled.sensing.pipeline import BoardPipeline

SEED = 7
TICK_NS = NS_PER_S // 500

At = Callable[[float], Instant]


def admit_all(node: int, identity: Identity) -> Refusal | None:
    return None


def drive(
    board: Any, line: Any, pipeline: BoardPipeline, at: At, seconds: float
) -> list[tuple[Instant, Cycle]]:
    """Run board and host in steps of 2 ms; returns every cycle with the instant it was made."""
    out: list[tuple[Instant, Cycle]] = []
    line.connect(at(0.0))
    for step in range(round(seconds * 500)):
        now = Instant(at(0.0) + step * TICK_NS)
        events = list(line.tick(now))
        for payload in line.outgoing():
            board.receive(payload, now)
        payload = board.tick(now)
        if payload:
            events += line.receive(Chunk(now, payload))
        for happened in events:
            if isinstance(happened.event, Sampled):
                out += [(now, cycle) for cycle in pipeline.feed(happened.event.block)]
    return out


def press(seconds: float) -> list[Contact]:
    """3 N on the left side after 2 s."""
    if seconds < 2.0:
        return []
    left = build_skin("finger", SEED).geometry.arrays[0]
    middle = left.position[11]
    return [Contact(middle, left.rotation[11] @ np.array([0.0, 0.0, -3.0]), 0.008)]


def make_board(**options: Any) -> SerialBoard:
    return SerialBoard(build_skin("finger", SEED), identity("finger", SEED), **options)


def run_serial(at: At, seconds: float = 4.0, **options: Any) -> tuple[Any, SerialLine, list[Any]]:
    board = make_board(**options)
    line = SerialLine("p", admit_all)
    pipeline = BoardPipeline(factory_calibration("finger", SEED))
    return board, line, drive(board, line, pipeline, at, seconds)


@pytest.fixture(scope="module")
def pressed() -> tuple[Any, SerialLine, list[tuple[Instant, Cycle]]]:
    def at(seconds: float) -> Instant:
        return Instant(500 * NS_PER_S + round(seconds * NS_PER_S))

    return run_serial(at, contacts=press, clock=ClockParameters(error=0.03))


def test_press_is_located_correctly(pressed: tuple[Any, SerialLine, Any]) -> None:
    _, _, cycles = pressed
    features = cycles[-1][1].features
    assert features.valid
    assert features.peak_side is Side.LEFT
    assert features.normal_force == pytest.approx(3.0, rel=0.3)
    before = [c.features for _, c in cycles if c.sequence < 150]
    assert max(f.normal_force for f in before[20:]) < 0.5


def test_every_cycle_arrives_once_and_stamped_within_uncertainty(
    pressed: tuple[Any, SerialLine, Any],
) -> None:
    board, line, cycles = pressed
    numbers = [cycle.sequence for _, cycle in cycles]
    assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
    assert board.counters["cycles"] - len(numbers) <= 2
    for came, cycle in cycles:
        assert cycle.captured <= cycle.received <= came
    # Conversion takes time before the samples are sent; the capture time is earlier by that.
    late = cycles[-100:]
    assert all(c.uncertainty < 0.01 for _, c in late)
    spacing = np.diff([c.captured for _, c in late]) / NS_PER_S
    assert spacing.mean() == pytest.approx(0.01, rel=0.05)
    link = line.links[0]
    assert isinstance(link, BoardLink)
    assert link.clock is not None
    assert link.clock.rate_error == pytest.approx(0.03, abs=2e-3)


def test_the_same_bytes_give_the_same_features_to_the_bit(instant: At) -> None:
    first, second = (run_serial(instant, 1.2, contacts=press)[2] for _ in range(2))
    assert len(first) == len(second)
    for (_, a), (_, b) in zip(first, second, strict=True):
        assert a.captured == b.captured
        np.testing.assert_array_equal(a.force, b.force)
        assert a.features.peak_force == b.features.peak_force


def test_corrupted_wire_loses_cycles_but_never_invents_one(instant: At) -> None:
    plan = FaultPlan(seed=3, flip=2e-5, loss=0.02, duplicate=0.02, reorder=0.02)
    board, line, cycles = run_serial(instant, 2.5, plan=plan)
    numbers = [cycle.sequence for _, cycle in cycles]
    assert numbers == sorted(set(numbers))
    link = line.links[0]
    assert isinstance(link, BoardLink)
    trackers = [array.tracker for array in link.arrays.values()]
    sent = board.counters["cycles"]
    for tracker in trackers:
        total = tracker.accepted + tracker.late + tracker.missing
        assert sent - 3 <= total <= sent
        assert tracker.missing > 0
    # Samples are correct or missing: there is no force without a press.
    settled = [c for _, c in cycles if c.features.valid][50:]
    assert max(c.features.normal_force for c in settled) < 1.0


def test_stream_survives_a_board_reset(instant: At) -> None:
    _, _, cycles = run_serial(instant, 3.0, plan=FaultPlan(reset=(1.2,)))
    captured = [c.captured for _, c in cycles]
    assert captured == sorted(captured)
    assert captured[-1] > instant(2.9)
    gap = max(np.diff(captured)) / NS_PER_S
    assert 0.15 < gap < 1.5


def test_press_is_located_over_can(instant: At) -> None:
    board = CanBoard(build_skin("finger", SEED), identity("finger", SEED), node=9, contacts=press)
    line = CanLine("can", admit_all)
    cycles = drive(board, line, BoardPipeline(factory_calibration("finger", SEED)), instant, 3.0)
    assert set(line.links) == {9}
    assert cycles[-1][1].features.peak_side is Side.LEFT
    assert len(cycles) > 200
    assert all(isinstance(frame, CanFrame) for frame in board.tick(instant(5.0)))
