"""What the gate counts over time: overloads, their repetition, touch that is missing."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest

from reachd.gate.gate import HARD_STATES, SafetyGate
from reachd.gate.settings import Check
from reachd.interfaces import Side, Twist
from tactile_core.types import Instant

MS = 1_000_000
OLD = (Check.FEATURES_STALE, Check.FEATURES_LOST)


def sparse(r: Any, valid: list[bool]) -> list[int]:
    """Cycles in which touch is called sparse, if it is valid as told."""
    found = []
    for k, good in enumerate(valid):
        decision = r.step(touch=replace(r.fresh_touch(-r.period), valid=good))
        if Check.FEATURES_SPARSE in {i.code for i in decision.interventions}:
            found.append(k)
    return found


@pytest.mark.parametrize("before", [5, 15, 21, 60])
def test_missing_touch_counts_however_long_it_was_there(before: int, rig: Callable) -> None:
    found = sparse(rig(*OLD), [True] * before + [False] * 40)
    assert found == list(range(before + 10, before + 40))


def test_the_oldest_of_the_last_200_ms_counts(rig: Callable) -> None:
    """Eleven cycles without touch count until the first of them is older."""
    found = sparse(rig(*OLD), [True] * 30 + [False] * 11 + [True] * 20)
    assert found == list(range(40, 50))


def test_just_half_of_the_time_without_touch_is_enough(rig: Callable, codes: Callable) -> None:
    for passed, expected in ((100 * MS, False), (100 * MS + 1, True)):
        r = rig(*OLD)
        for _ in range(30):
            r.step()
        touch = replace(r.fresh_touch(-passed), valid=False)
        found = codes(r.step(touch=touch, passed=passed))
        assert ("features_sparse" in found) == expected


def test_missing_touch_counts_after_time_went_back(rig: Callable) -> None:
    r = rig(*OLD, Check.CLOCK_BACKWARDS)
    sparse(r, [True] * 30)
    r.now = Instant(r.now - 5_000 * MS)
    assert sparse(r, [False] * 20) == list(range(12, 20))


def test_time_that_goes_back_is_named_with_how_far(rig: Callable) -> None:
    """The arm's stamps, which went back as well, have a reason of their own."""
    r = rig()
    state = r.fresh_arm()
    decision = r.step(arm=state, touch=r.touch, passed=-3 * MS)
    texts = [i.text for i in decision.interventions if i.code is Check.CLOCK_BACKWARDS]
    assert texts == ["time went back by 0.003 s"]


def test_a_first_overload_is_no_second_one(
    settings: Any, make_touch: Callable, make_arm: Callable
) -> None:
    """An impact lasts one state, the first that the gate sees as well."""
    gate, at = SafetyGate(settings), Instant(10**9)
    force = settings.force * (settings.overload + 0.05)
    for k in range(HARD_STATES):
        now = Instant(at + k * 10 * MS)
        gate.step(Twist(0.0, 0.0, 0.0), make_touch(now), make_arm(now, fx=-force), None, now)
        assert (Check.OVERLOAD in gate.latched_at) == (k == HARD_STATES - 1)


@pytest.mark.parametrize("armed_anew", [False, True])
def test_repeated_loads_count_from_the_first_and_anew_after_arming(
    armed_anew: bool, settings: Any, rig: Callable
) -> None:
    r = rig(Check.OVERLOAD, Check.WRENCH, armed=False)

    def load(force: float) -> Any:
        return r.step(Twist(0.0, 0.0, 0.0), arm=r.fresh_arm(-r.period, fx=-force))

    load(1.05 * settings.force)
    load(0.0)
    for _ in range(int(settings.overload_passes) - 2):
        load(1.05 * settings.force)
        load(0.0)
    assert Check.OVERLOAD_REPEATED not in r.gate.latched_at
    if armed_anew:
        assert r.request() == set()
    load(1.05 * settings.force)
    assert (Check.OVERLOAD_REPEATED in r.gate.latched_at) == (not armed_anew)


def test_rising_force_is_foreseen_over_at_most_200_ms(rig: Callable) -> None:
    off = (
        *OLD, Check.FEATURES_SPARSE, Check.LOOP_LATE, Check.ACCELERATION, Check.WORKSPACE,
        Check.SKIN_FORCE, Check.ARM_STALE, Check.ARM_LOST,
    )  # fmt: skip

    def speed(before: float, gap: int) -> float:
        """m/s towards a contact of 9 N that was ``before`` N ``gap`` ns earlier."""
        r = rig(*off)
        place = {"peak_side": Side.TIP, "peak_x": 0.15, "normal_force_bound": 0.0}
        r.step(touch=replace(r.fresh_touch(-r.period), total_force=before, **place))
        touch = replace(r.fresh_touch(-gap), total_force=9.0, **place)
        decision = r.step(Twist(0.06, 0.0, 0.0), touch=touch, passed=gap)
        return float(decision.twist.vx)

    steady = speed(9.0, 10 * MS)
    assert 0.0 < speed(0.0, 200 * MS) < steady
    assert speed(0.0, 200 * MS + 1) == steady
