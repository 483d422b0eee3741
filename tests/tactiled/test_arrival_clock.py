"""Boards without a clock: numbers and stamps from arrivals alone."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tactile_core.types import NS_PER_S, Instant
from tactiled.boards.clock import Arrival, ArrivalClock

START = 7_200 * NS_PER_S


def at(host: float) -> Instant:
    return Instant(START + round(host * NS_PER_S))


def run(departures: list[float], delays: list[float]) -> tuple[ArrivalClock, list[Arrival]]:
    """Arrivals in order: a frame cannot overtake the one before it."""
    clock, out, latest = ArrivalClock(), [], 0.0
    for departure, delay in zip(departures, delays, strict=True):
        latest = max(latest, departure + delay)
        out.append(clock.arrived(at(latest)))
    return clock, out


@given(
    period=st.floats(0.002, 0.05),
    jitter=st.floats(0.0, 0.4),
    seed=st.integers(0, 2**32 - 1),
)
@settings(max_examples=20, deadline=None)
def test_captured_instant_is_within_its_uncertainty(
    period: float, jitter: float, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    sent = [k * period for k in range(600)]
    _, out = run(sent, list(rng.exponential(jitter * period, 600)))
    previous = 0
    for arrival in out:
        stamp = arrival.stamp
        assert stamp.captured >= previous
        previous = stamp.captured
    for departure, arrival in zip(sent[100:], out[100:], strict=True):
        middle = departure - period / 2
        error = abs(arrival.stamp.captured - at(middle)) / NS_PER_S
        assert error <= arrival.stamp.uncertainty


def test_jitter_is_rejected() -> None:
    rng = np.random.default_rng(3)
    sent = [k * 0.01 for k in range(2000)]
    clock, out = run(sent, list(rng.exponential(0.002, 2000)))
    steps = np.diff([a.stamp.captured for a in out[200:]]) / NS_PER_S
    assert steps.std() < 0.0005
    assert clock.period == pytest.approx(0.01, rel=1e-3)
    assert [a.sequence for a in out] == list(range(2000))


def test_host_stall_ending_in_a_burst_loses_nothing() -> None:
    sent = [k * 0.01 for k in range(400)]
    delays = [0.0] * 400
    for k in range(300, 306):
        delays[k] = sent[306] - sent[k]
    clock, out = run(sent, delays)
    assert out[-1].sequence == 399
    assert clock.counters["lost"] == 0
    stalled = out[301].stamp
    assert abs(stalled.captured - at(sent[301] - 0.005)) / NS_PER_S <= stalled.uncertainty


def test_lost_frames_leave_a_gap_in_the_sequence() -> None:
    sent = [k * 0.01 for k in range(400) if not 300 <= k < 305]
    clock, out = run(sent, [0.0] * len(sent))
    assert clock.counters["lost"] == 5
    assert out[-1].sequence == 399
    error = abs(out[-1].stamp.captured - at(sent[-1] - 0.005)) / NS_PER_S
    assert error <= out[-1].stamp.uncertainty < 0.008


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_changed_rate_is_followed(factor: float) -> None:
    sent = [k * 0.01 for k in range(400)]
    sent += [sent[-1] + (k + 1) * 0.01 * factor for k in range(600)]
    clock, out = run(sent, [0.0] * len(sent))
    assert clock.period == pytest.approx(0.01 * factor, rel=1e-2)
    error = abs(out[-1].stamp.captured - at(sent[-1] - 0.005 * factor)) / NS_PER_S
    assert error <= out[-1].stamp.uncertainty


def test_frames_read_in_one_chunk_keep_their_order() -> None:
    sent = [k * 0.01 for k in range(600)]
    delays = [(3 - k % 4) * 0.01 for k in range(600)]
    clock, out = run(sent, delays)
    assert [a.sequence for a in out] == list(range(600))
    steps = np.diff([a.stamp.captured for a in out[200:]]) / NS_PER_S
    assert steps.min() > 0.005
    assert clock.counters["lost"] == 0


def read_in_chunks(
    sent: list[float], reads: list[float], clock: ArrivalClock | None = None
) -> list[tuple[float, Arrival]]:
    """Send time and `Arrival` of each frame, for a host that reads at ``reads``."""
    clock, out, waiting = clock or ArrivalClock(), [], list(sent)
    for read in reads:
        chunk = [departure for departure in waiting if departure <= read]
        del waiting[: len(chunk)]
        for place, departure in enumerate(chunk, start=1):
            out.append((departure, clock.arrived(at(read), len(chunk) - place, at(read))))
    return out


@given(
    rate=st.sampled_from([0.5, 1.0, 2.0, 5.0, 20.0, 100.0, 400.0, 1000.0]),
    latency=st.floats(1e-4, 0.1),
    stall=st.floats(0.0, 1.5),
    wrong=st.floats(-0.01, 0.01),
    seed=st.integers(0, 2**32 - 1),
)
@settings(max_examples=60, deadline=None)
def test_frames_read_late_and_together_keep_their_instants(
    rate: float, latency: float, stall: float, wrong: float, seed: int
) -> None:
    rng, period = np.random.default_rng(seed), (1 + wrong) / rate
    count = int(max(40, min(4 * rate, 600)))
    sent = [k * period for k in range(count)]
    begin = sent[count // 2]
    reads = [t + min(latency, period / 2) * rng.random() for t in sent]
    reads = sorted(r if not begin <= r < begin + stall else begin + stall for r in reads)
    reads = sorted({*reads, sent[-1] + period})
    out = read_in_chunks(sent, reads)
    assert len(out) == count
    stamps = [arrival.stamp.captured for _, arrival in out]
    assert all(a < b for a, b in itertools.pairwise(stamps))
    for departure, arrival in out:
        captured, error = arrival.stamp.captured, arrival.stamp.uncertainty
        assert captured - error * NS_PER_S <= at(departure - period)
        assert captured + error * NS_PER_S >= at(departure)
    assert [arrival.sequence for _, arrival in out] == list(range(count))


@pytest.mark.parametrize("rate", [0.5, 1.0, 5.0])
def test_slow_board_is_recognised_within_a_few_frames(rate: float) -> None:
    clock = ArrivalClock()
    out = [clock.arrived(at(k / rate)) for k in range(12)]
    assert clock.period == pytest.approx(1 / rate, rel=1e-3)
    error = abs(out[-1].stamp.captured - at(10.5 / rate)) / NS_PER_S
    assert error < 0.01 / rate
    assert out[-1].stamp.uncertainty < 0.51 / rate + 0.01
