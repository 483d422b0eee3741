"""The control loop's deadlines, and its behaviour on failures."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from reachd.control import LAST_ZEROS, Controller, ControlLoop, Cycle, Inputs, Lateness, Schedule
from reachd.gate.gate import SafetyGate
from reachd.interfaces import ZERO, Twist
from reachd.strategies import load_strategy
from reachd.strategies.parameters import HARDWARE
from reachd.trial import Supervisor
from tactile_core.types import NS_PER_S, Instant, after
from tests.support.waiting import wait_until

START = Instant(7 * NS_PER_S)


def at(seconds: float) -> Instant:
    return after(START, seconds)


def controller() -> Controller:
    strategy = load_strategy("straight", HARDWARE, np.random.default_rng(0))
    gate = SafetyGate(HARDWARE.safety)
    return Controller(Supervisor(strategy, HARDWARE), gate, HARDWARE.safety)


class Rig:
    """A loop with stand-ins for inputs, arm and reports."""

    def __init__(self, sense: Callable[[Instant], Inputs] | None = None) -> None:
        self.sent: list[Twist] = []
        self.cycles: list[Cycle] = []
        self.failures: list[BaseException] = []
        self.loop = ControlLoop(
            controller(), 0.01, 0.06, sense or (lambda _: Inputs(None, None)), self._act,
            lambda cycle, _: self.cycles.append(cycle), self.failures.append,
        )  # fmt: skip

    def _act(self, twist: Twist, expiry: float, now: Instant) -> bytes:
        self.sent.append(twist)
        return b""


def test_deadlines_are_absolute_so_lateness_does_not_accumulate() -> None:
    schedule = Schedule(0.01, START)
    assert schedule.deadline == at(0.01)
    assert schedule.begin(at(0.013)) == pytest.approx(0.003)
    assert schedule.deadline == at(0.02)
    assert schedule.begin(at(0.02)) == 0.0
    assert schedule.deadline == at(0.03)
    assert schedule.missed == 0


def test_missed_deadlines_are_skipped_and_counted() -> None:
    schedule = Schedule(0.01, START)
    assert schedule.begin(at(0.055)) == pytest.approx(0.045)
    assert schedule.missed == 4  # of .02, .03, .04, .05
    assert schedule.deadline == at(0.06)


def test_early_cycle_is_not_late() -> None:
    assert Schedule(0.01, START).begin(at(0.0099)) == 0.0


def test_lateness_is_summarised() -> None:
    lateness = Lateness()
    assert lateness.summary() == {}
    for n in range(1000):
        lateness.add(n * 1e-6)
    found = lateness.summary()
    assert found["p50"] == pytest.approx(0.0005, rel=0.01)
    assert found["p99"] == pytest.approx(0.00099, rel=0.01)
    assert found["max"] == pytest.approx(0.000999)


def test_disarmed_loop_sends_zero_every_cycle_and_at_the_end() -> None:
    rig = Rig()
    rig.loop.start()
    wait_until(lambda: len(rig.cycles) > 10)
    assert rig.loop.stop(10.0)
    assert len(rig.sent) == len(rig.cycles) + LAST_ZEROS
    assert set(rig.sent) == {ZERO}
    assert not rig.failures


def test_failure_in_the_loop_ends_it_loudly_with_zero_last() -> None:
    def broken(now: Instant) -> Inputs:
        raise OSError("no more")

    rig = Rig(broken)
    rig.loop.start()
    wait_until(lambda: rig.failures)
    wait_until(lambda: len(rig.sent) == LAST_ZEROS)
    assert isinstance(rig.failures[0], OSError)
    assert set(rig.sent) == {ZERO}


def test_requests_are_served_by_the_loop_thread_between_cycles() -> None:
    rig = Rig()
    rig.loop.start()
    served = rig.loop.call(lambda now: threading.current_thread().name)
    refused = rig.loop.call(_refuse)
    assert served.result(60.0) == "control"
    with pytest.raises(ValueError, match="not that"):
        refused.result(60.0)
    assert rig.loop.stop(10.0)
    assert not rig.failures


def _refuse(now: Instant) -> None:
    raise ValueError("not that")


def test_unserved_requests_do_not_accumulate() -> None:
    rig = Rig()
    futures = [rig.loop.call(lambda now: None) for _ in range(40)]
    with pytest.raises(ValueError, match="waiting already"):
        futures[-1].result(0.0)


def test_stuck_loop_is_stopped_from_outside() -> None:
    release = threading.Event()

    def stuck(now: Instant) -> Inputs:
        release.wait(20.0)
        return Inputs(None, None)

    rig = Rig(stuck)
    rig.loop.start()
    assert not rig.loop.stop(0.05)
    assert rig.sent == [ZERO] * LAST_ZEROS
    release.set()
    wait_until(lambda: len(rig.sent) > LAST_ZEROS)


def test_stopping_before_starting_does_nothing() -> None:
    rig: Any = Rig()
    assert rig.loop.stop(0.0)
    assert rig.sent == []
