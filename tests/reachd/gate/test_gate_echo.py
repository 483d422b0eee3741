"""The gate checks whose commands the arm obeys, and how late they take effect."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from reachd.gate.settings import ALWAYS_ON, Check
from reachd.interfaces import ZERO
from tactile_core.types import Echo, Instant, after

MS = 1_000_000


class DelayedCommands:
    """Commands reach the arm after ``delay`` ms; its states echo the one in effect."""

    def __init__(self, rig: Any) -> None:
        self.rig = rig
        self.sent: list[Instant] = []
        self.delay = 0.0
        self.slow = 0.0  # ms/s by which the delay grows

    def step(self) -> Any:
        now = Instant(self.rig.now + self.rig.period)
        self.delay += self.slow * 0.01
        arrived = [at for at in self.sent if at + round(self.delay * MS) <= now]
        echo = Echo("r-1", len(arrived), arrived[-1] if arrived else Instant(0))
        decision = self.rig.step(arm=self.rig.fresh_arm(-self.rig.period, echo=echo))
        self.sent.append(now)
        return decision

    def run(self, cycles: int) -> tuple[int | None, Any]:
        for k in range(cycles):
            decision = self.step()
            if decision.held is not None:
                return k, decision
        return None, decision


@pytest.fixture
def delayed(rig: Callable) -> DelayedCommands:
    made = DelayedCommands(rig())
    assert made.run(20)[0] is None
    return made


@pytest.mark.parametrize("delay", [0.0, 10.0, 30.0, 39.9])
def test_short_echo_delay_is_ignored(delay: float, delayed: DelayedCommands) -> None:
    delayed.delay = delay
    assert delayed.run(100)[0] is None


@pytest.mark.parametrize("delay", [60.0, 100.0, 250.0])
def test_long_echo_delay_stops_at_once_and_latches(delay: float, delayed: DelayedCommands) -> None:
    """Row 37: within 100 ms after the echo is 50 ms late."""
    delayed.delay = delay
    seen = [delayed.step() for _ in range(30)]
    stopped = [k for k, d in enumerate(seen) if d.twist == ZERO]
    latched = [k for k, d in enumerate(seen) if d.held is not None]
    assert stopped[0] <= 5
    assert latched[0] - stopped[0] == 5, "when it has lasted for 50 ms"
    assert seen[latched[0]].held is Check.ECHO_LOST
    assert "come into force" in seen[latched[0]].interventions[0].text


def test_how_late_commands_come_into_force_is_named(delayed: DelayedCommands) -> None:
    delayed.delay = 700.0
    for _ in range(80):
        decision = delayed.step()
    texts = {i.text for i in decision.interventions if i.code is Check.ECHO_LATE}
    assert texts == {
        "commands come into force at the arm 700 ms late, or not at all: 50 ms are allowed"
    }


def test_no_command_is_due_before_the_first_was_sent(rig: Callable) -> None:
    r = rig(armed=False)
    for cycle in range(4):
        decision = r.step(ZERO, arm=r.fresh_arm(-r.period, echo=Echo("r-1", 0, Instant(0))))
        assert Check.ECHO_LATE not in {i.code for i in decision.interventions}, cycle


def test_slowly_growing_echo_delay_is_detected_at_50_ms(delayed: DelayedCommands) -> None:
    delayed.slow = 10.0
    when, decision = delayed.run(700)
    assert when is not None
    assert decision.held is Check.ECHO_LOST
    assert 40.0 <= delayed.delay <= 52.0


def test_single_delay_spike_only_stops(delayed: DelayedCommands) -> None:
    delayed.delay = 80.0
    stopped = sum(delayed.step().twist == ZERO for _ in range(4))
    delayed.delay = 5.0
    seen = [delayed.step() for _ in range(10)]
    assert stopped
    assert all(d.held is None for d in seen)
    assert seen[-1].twist != ZERO


def test_stalled_loop_does_not_count_as_echo_delay(delayed: DelayedCommands) -> None:
    delayed.rig.now = after(delayed.rig.now, 0.5)
    decisions = [delayed.step() for _ in range(5)]
    codes = {i.code for d in decisions for i in d.interventions}
    assert not codes & {Check.ECHO_LATE, Check.ECHO_LOST}


def test_the_checks_can_be_switched_off(rig: Callable) -> None:
    delayed = DelayedCommands(rig(Check.ECHO_LATE, Check.ECHO_LOST))
    delayed.run(10)
    delayed.delay = 300.0
    assert delayed.run(60)[0] is None
    assert delayed.step().twist != ZERO
    only = DelayedCommands(rig(Check.ECHO_LOST))
    only.run(10)
    only.delay = 300.0
    assert only.run(60)[0] is None
    assert only.step().twist == ZERO


@pytest.mark.parametrize("who", ["", "other-2"])
def test_arm_obeying_another_commander_latches(who: str, delayed: DelayedCommands) -> None:
    r = delayed.rig
    echo = Echo(who, 5, Instant(r.now), own=False)
    decision = r.step(arm=r.fresh_arm(-r.period, echo=echo))
    assert decision.held is Check.COMMANDER
    assert (repr(who) if who else "nobody") in decision.interventions[0].text
    assert "commander" in r.request(arm=r.fresh_arm(echo=echo))
    assert Check.COMMANDER in ALWAYS_ON


def test_new_grant_restarts_the_echo_check(rig: Callable) -> None:
    r = rig()
    for _ in range(50):
        r.step(ZERO)
    other = Echo("", 0, Instant(0), own=False)
    r.step(arm=r.fresh_arm(-r.period, echo=other))
    for k in range(12):
        decision = r.step(arm=r.fresh_arm(-r.period, echo=Echo("r-9", 0, Instant(0))))
        codes = {i.code for i in decision.interventions}
        assert (Check.ECHO_LATE in codes) == (k > 4)


def test_foreign_commands_are_reported_and_do_not_stop(rig: Callable, codes: Callable) -> None:
    r = rig()
    decision = r.step(rivalled=True)
    assert codes(decision) == ["rival_commands"]
    assert decision.interventions[0].effect == "ignored"
    assert decision.twist != ZERO
    assert codes(rig(Check.RIVAL_COMMANDS).step(rivalled=True)) == []


def test_an_echo_of_what_was_never_sent_latches(rig: Callable) -> None:
    r = rig()
    for k in range(1, 20):
        echo = Echo("r-1", k, r.now)
        assert r.step(ZERO, arm=r.fresh_arm(-r.period, echo=echo)).held is None
    for ahead, off, held in ((1, (), Check.ECHO_LOST), (1, (Check.ECHO_LOST,), None)):
        r = rig(*off)
        r.step(ZERO, arm=r.fresh_arm(-r.period, echo=Echo("r-1", 1, r.now)))
        lie = Echo("r-1", 2, Instant(r.now + ahead))
        decision = r.step(ZERO, arm=r.fresh_arm(-r.period, echo=lie))
        assert decision.held is held
        if held:
            assert "never sent" in decision.interventions[0].text
