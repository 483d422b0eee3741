"""The clock map with simulated oscillators: its error stays within the published bound."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sensor_proto.packets import ClockReply
from tactile_core.types import NS_PER_S, Instant
from tactiled.boards.clock import ClockMap, TickUnwrapper

TICK_HZ = 1_000_000
START = 3_600 * NS_PER_S


@dataclass
class Oscillator:
    """Board clock with a drifting rate error; host time is in s since START."""

    error: float = 0.0
    drift: float = 0.0  # 1/s
    phase: int = 0

    def ticks(self, host: float) -> int:
        elapsed = host * (1 + self.error) + self.drift * host * host / 2
        return (self.phase + int(elapsed * TICK_HZ)) % 2**32


def at(host: float) -> Instant:
    return Instant(START + round(host * NS_PER_S))


def poll(clock: ClockMap, board: Oscillator, token: int, t: float, out: float, back: float) -> bool:
    """Send one poll at ``t`` s; ``out`` and ``back``: delays of the two directions, s."""
    clock.polled(token, at(t))
    turnaround = 50e-6
    reply = ClockReply(token, board.ticks(t + out), board.ticks(t + out + turnaround))
    return clock.replied(reply, at(t + out + turnaround + back))


def worst(clock: ClockMap, board: Oscillator, rng: np.random.Generator, seconds: float) -> float:
    """Poll with random delays; returns the largest error as a multiple of the uncertainty."""
    ratio, previous, token = 0.0, 0, 0
    for step in range(round(seconds * 100)):
        t = step / 100
        if step % 25 == 0:
            token += 1
            poll(clock, board, token, t, *(0.2e-3 + rng.exponential(1e-3, 2)))
        if step > 10:
            seen = at(t + 0.003 + rng.exponential(1e-3))
            stamp = clock.stamp(board.ticks(t + 0.001), seen)
            error = abs(stamp.captured - at(t + 0.001)) / NS_PER_S
            ratio = max(ratio, error / stamp.uncertainty)
            assert stamp.captured >= previous
            assert stamp.captured <= seen
            previous = stamp.captured
    return ratio


@given(
    error=st.floats(-0.0975, 0.1025),
    drift=st.floats(-1.8e-5, 1.8e-5),
    phase=st.integers(0, 2**32 - 1),
    seed=st.integers(0, 2**32 - 1),
)
@settings(max_examples=20, deadline=None)
def test_clock_error_stays_within_uncertainty(
    error: float, drift: float, phase: int, seed: int
) -> None:
    clock = ClockMap(TICK_HZ)
    board = Oscillator(error, drift, phase)
    assert worst(clock, board, np.random.default_rng(seed), 20.0) <= 1.0


def test_uncertainty_holds_for_an_asymmetric_link() -> None:
    clock, board = ClockMap(TICK_HZ), Oscillator(0.03)
    for token in range(40):
        poll(clock, board, token, token * 0.25, 0.1e-3, 4e-3)
    stamp = clock.stamp(board.ticks(10.0), at(10.01))
    error = abs(stamp.captured - at(10.0)) / NS_PER_S
    assert 1.9e-3 < error <= stamp.uncertainty < 10e-3


def test_clock_rate_error_is_estimated() -> None:
    clock, board = ClockMap(TICK_HZ), Oscillator(0.05)
    for token in range(40):
        poll(clock, board, token, token * 0.25, 0.2e-3, 0.2e-3)
    assert clock.rate_error == pytest.approx(0.05, abs=1e-4)


def test_slow_polls_do_not_degrade_the_clock_map() -> None:
    clock, board, rng = ClockMap(TICK_HZ), Oscillator(-0.02), np.random.default_rng(4)
    for token in range(80):
        delay = 0.1e-3 if token % 4 == 0 else rng.uniform(0.01, 0.1)
        poll(clock, board, token, token * 0.125, 0.1e-3, delay)
    stamp = clock.stamp(board.ticks(10.0), at(10.01))
    assert abs(stamp.captured - at(10.0)) < 0.5e-3 * NS_PER_S
    assert stamp.uncertainty < 1e-3


def test_uncertainty_grows_while_polls_go_unanswered() -> None:
    clock, board = ClockMap(TICK_HZ), Oscillator()
    for token in range(20):
        poll(clock, board, token, token * 0.25, 0.2e-3, 0.2e-3)
    early = clock.stamp(board.ticks(6.0), at(6.01)).uncertainty
    late = clock.stamp(board.ticks(60.0), at(60.01)).uncertainty
    assert late > 10 * early


def test_clock_map_recovers_from_a_jump() -> None:
    clock, board = ClockMap(TICK_HZ), Oscillator()
    for token in range(20):
        poll(clock, board, token, token * 0.25, 0.2e-3, 0.2e-3)
    board.phase += 30 * TICK_HZ
    for token in range(20, 20 + 5):
        poll(clock, board, token, token * 0.25, 0.2e-3, 0.2e-3)
    stamp = clock.stamp(board.ticks(7.0), at(7.01))
    assert abs(stamp.captured - at(7.0)) / NS_PER_S <= stamp.uncertainty
    assert clock.counters["jump"] == 1


def test_one_contradicting_reply_is_refused() -> None:
    clock, board = ClockMap(TICK_HZ), Oscillator()
    for token in range(20):
        poll(clock, board, token, token * 0.25, 0.2e-3, 0.2e-3)
    wrong = Oscillator(phase=500_000)
    assert not poll(clock, wrong, 20, 5.0, 0.2e-3, 0.2e-3)
    stamp = clock.stamp(board.ticks(5.5), at(5.51))
    assert abs(stamp.captured - at(5.5)) < 1e-3 * NS_PER_S


@pytest.mark.parametrize(
    ("reply", "delay", "reason"),
    [
        (ClockReply(99, 1000, 1100), 0.001, "unasked"),
        (ClockReply(1, 2000, 1000), 0.001, "impossible"),
        (ClockReply(1, 0, 900_000), 0.001, "impossible"),
        (ClockReply(1, 1000, 1100), 2.0, "slow"),
    ],
)
def test_useless_replies_are_counted(reply: ClockReply, delay: float, reason: str) -> None:
    clock = ClockMap(TICK_HZ)
    clock.polled(1, at(0.0))
    assert not clock.replied(reply, at(delay))
    assert clock.counters == {reason: 1}


def test_arrival_times_are_used_until_a_poll_is_answered() -> None:
    clock, board, rng = ClockMap(TICK_HZ), Oscillator(0.04), np.random.default_rng(1)
    errors = []
    for step in range(500):
        t = step / 100
        ticks, seen = board.ticks(t), at(t + 0.004 + rng.exponential(2e-3))
        clock.arrived(ticks, seen)
        stamp = clock.stamp(ticks, seen)
        errors.append(abs(stamp.captured - at(t)) / NS_PER_S / stamp.uncertainty)
    assert not clock.synchronised
    assert max(errors[100:]) <= 1.0
    assert clock.rate_error == pytest.approx(0.04, abs=2e-3)


def test_unanswered_polls_are_dropped_oldest_first() -> None:
    clock, board = ClockMap(TICK_HZ), Oscillator()
    for token in range(1000):
        clock.polled(token, at(token * 0.001))
    assert not clock.replied(ClockReply(0, board.ticks(1.0), board.ticks(1.0)), at(1.0))
    assert clock.replied(ClockReply(999, board.ticks(1.0), board.ticks(1.0)), at(1.001))


@given(st.lists(st.integers(-(2**31) + 1, 2**31 - 1), max_size=50), st.integers(0, 2**32 - 1))
@settings(max_examples=50, deadline=None)
def test_unwrapped_ticks_keep_every_step(steps: list[int], first: int) -> None:
    unwrapper = TickUnwrapper()
    newest = unwrapper.unwrap(first)
    for step in steps:
        value = newest + step
        assert unwrapper.unwrap(value % 2**32) == value
        newest = max(newest, value)


def test_bad_tick_rate_is_refused() -> None:
    with pytest.raises(ValueError, match="tick_hz"):
        ClockMap(0)
