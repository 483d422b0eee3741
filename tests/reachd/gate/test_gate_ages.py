"""Age limits of the gate's inputs, and detection of a frozen arm state.

Rows 4, 14 and 24 of the fault table.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest

from reachd.gate.gate import Decision
from reachd.gate.settings import Check
from reachd.interfaces import ZERO, Touch, Twist
from tactile_core.types import Instant, after

MS = 1_000_000
T0 = Instant(5_000_000_000)

FEATURE_AGES = [
    (1 * MS, True),
    (100 * MS, True),
    (182 * MS - 1, True),
    (182 * MS, True),
    (182 * MS + 1, False),
    (200 * MS, False),
    (990 * MS, False),
]


@pytest.mark.parametrize(("age", "moves"), FEATURE_AGES)
def test_motion_ends_before_features_are_200_ms_old(
    age: int, moves: bool, rig: Callable, passes: Callable
) -> None:
    """A period and 8 ms early; otherwise the next command would still move after 200 ms."""
    r = rig()
    decision = aged(r, r.fresh_touch(), age)
    assert passes(decision) == moves
    assert (Check.FEATURES_STALE in {i.code for i in decision.interventions}) == (not moves)
    off = rig(Check.FEATURES_STALE)
    assert passes(aged(off, off.fresh_touch(), age))


def aged(r: Any, touch: Touch, age: int) -> Decision:
    """Run until ``touch``, captured at T0, is ``age`` ns old; returns the last decision."""
    while r.now + r.period < T0 + age:
        r.step(touch=touch)
    return r.step(touch=touch, passed=T0 + age - r.now)


@pytest.mark.parametrize(
    ("age", "latches"),
    [(900 * MS, False), (1000 * MS, False), (1000 * MS + 1, True), (5000 * MS, True)],
)
def test_features_lost_for_a_second_latch(
    age: int, latches: bool, rig: Callable, passes: Callable
) -> None:
    r = rig()
    decision = aged(r, r.fresh_touch(), age)
    assert (decision.held is Check.FEATURES_LOST) == latches
    assert r.step().held == decision.held, "fresh features alone do not arm it again"
    assert passes(r.step()) == (not latches)
    off = rig(Check.FEATURES_LOST)
    assert aged(off, off.fresh_touch(), age).held is None


def test_older_of_capture_and_arrival_counts(rig: Callable, codes: Callable) -> None:
    for captured, received in ((195 * MS, 0), (0, 195 * MS)):
        r = rig()
        for _ in range(30):
            touch = replace(r.touch, captured=r.now - captured, received=Instant(r.now - received))
            decision = r.step(touch=touch, passed=0)
            r.now = Instant(r.now + r.period)
        assert set(codes(decision)) == {"features_stale"}


@pytest.mark.parametrize("spoil", [{"valid": False}, {"tip_force": math.nan}, {"peak_x": math.inf}])
def test_only_valid_features_renew_touch(spoil: dict, rig: Callable, passes: Callable) -> None:
    r = rig()
    moved = 0
    for _ in range(30):
        moved += passes(r.step(touch=replace(r.fresh_touch(), **spoil)))
    # Half of the last 200 ms, including the last valid features.
    assert moved == 10
    r = rig(Check.FEATURES_SPARSE)
    moved = 0
    for _ in range(30):
        moved += passes(r.step(touch=replace(r.fresh_touch(), **spoil)))
    assert moved == 18


@pytest.mark.parametrize(("every", "moves"), [(1, True), (2, True), (3, False), (18, False)])
def test_intermittently_valid_touch_stops(
    every: int, moves: bool, rig: Callable, codes: Callable
) -> None:
    """Half of the last 200 ms is enough, a third is not."""
    r, off = rig(), rig(Check.FEATURES_SPARSE)
    for one, expected in ((r, moves), (off, True)):
        for k in range(200):
            decision = one.step(touch=replace(one.fresh_touch(-one.period), valid=k % every == 0))
        assert ("features_sparse" not in codes(decision)) == expected
        assert decision.held is None
    for _ in range(30):
        r.step()
    assert r.step().twist != ZERO, "it goes on by itself"


def test_backward_time_does_not_renew_touch(rig: Callable) -> None:
    r = rig(Check.CLOCK_BACKWARDS)
    for _ in range(30):
        r.step(touch=replace(r.fresh_touch(), valid=False))
    r.now = after(r.now, -5.0)
    assert "features_sparse" not in {i.code.value for i in r.step().interventions}


def test_out_of_order_features_do_not_age_touch(rig: Callable, passes: Callable) -> None:
    r = rig()
    r.step()
    assert passes(r.step(touch=r.fresh_touch(age=500 * MS)))


@pytest.mark.parametrize(
    ("ahead", "used"), [(0, True), (10 * MS, True), (10 * MS + 1, False), (10**12, False)]
)
def test_future_features_are_not_used(
    ahead: int, used: bool, rig: Callable, codes: Callable, passes: Callable
) -> None:
    for field in ("captured", "received"):
        r = rig()
        for _ in range(17):
            r.step(touch=r.touch)
        r.now = Instant(r.now + r.period)
        spoiled = replace(r.fresh_touch(), **{field: Instant(r.now + ahead)})
        decision = r.step(touch=spoiled, passed=0)
        assert (set(codes(decision)) == set()) == used
        if not used:
            assert set(codes(decision)) == {"features_future"}
            assert passes(decision), "the last good ones are 180 ms old: this once"
            assert set(codes(r.step(touch=spoiled))) == {"features_future", "features_stale"} or (
                ahead <= 20 * MS
            )
    off = rig(Check.FEATURES_FUTURE)
    assert set(codes(off.step(touch=replace(off.touch, captured=Instant(T0 + 10**12))))) == set()


@pytest.mark.parametrize(
    ("age", "moves"),
    [(0, True), (37 * MS, True), (37 * MS + 1, False), (50 * MS, False), (1000 * MS, False)],
)
def test_motion_ends_before_arm_state_is_50_ms_old(
    age: int, moves: bool, rig: Callable, codes: Callable, passes: Callable
) -> None:
    for captured, received in ((age, 0), (0, age), (age, age)):
        # Its stamps also go back, which is another fault.
        r = rig(Check.CLOCK_BACKWARDS)
        off = rig(Check.ARM_STALE, Check.CLOCK_BACKWARDS)
        for one, expected in ((r, moves), (off, True)):
            now = one.now + one.period
            arm = replace(one.arm, captured=now - captured, received=now - received)
            decision = one.step(arm=arm)
            assert passes(decision) == expected
            assert set(codes(decision)) == (set() if expected else {"arm_stale"})


@pytest.mark.parametrize(("age", "latches"), [(1000 * MS, False), (1000 * MS + 1, True)])
def test_missing_arm_latches(age: int, latches: bool, rig: Callable) -> None:
    r = rig()
    assert (r.step(arm=r.fresh_arm(age=age - r.period)).held is Check.ARM_LOST) == latches
    r = rig(Check.ARM_LOST)
    assert r.step(arm=r.fresh_arm(age=age)).held is None


@pytest.mark.parametrize(("ahead", "moves"), [(10 * MS, True), (10 * MS + 1, False)])
def test_future_arm_state_stops(ahead: int, moves: bool, rig: Callable, passes: Callable) -> None:
    for field in ("captured", "received"):
        for off, expected in (((), moves), ((Check.ARM_FUTURE,), True)):
            r = rig(*off)
            stamp = Instant(r.now + r.period + ahead)
            arm = replace(r.fresh_arm(age=-r.period), **{field: stamp})
            assert passes(r.step(arm=arm)) == expected


def test_without_inputs_nothing_moves(rig: Callable, codes: Callable, passes: Callable) -> None:
    r = rig(Check.ARM_STALE, Check.ARM_LOST)
    decision = r.step(arm=None)
    assert not passes(decision)
    assert set(codes(decision)) == {"arm_stale"}
    decision = rig(armed=False).step(touch=None, arm=None)
    assert decision.held is Check.NOT_ARMED
    assert {"not_armed", "features_stale", "arm_stale"} <= set(codes(decision))


@pytest.mark.parametrize("field", ["x", "y", "heading", "fx", "fy", "mz"])
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_non_finite_arm_state_stops(
    field: str, value: float, rig: Callable, codes: Callable, passes: Callable
) -> None:
    r = rig()
    decision = r.step(arm=r.fresh_arm(-r.period, **{field: value}))
    assert set(codes(decision)) == {"arm_not_finite"}
    assert not passes(decision)
    assert passes(r.step())


STEP = Twist(0.04, 0.0, 0.0)


def still(r: Any, cycles: int, wanted: Twist = STEP, **values: object) -> list[Decision]:
    """Run cycles in which the arm, commanded to move, reports constant values, fresh stamps."""
    return [r.step(wanted, arm=r.fresh_arm(-r.period, **values)) for _ in range(cycles)]


def test_frozen_arm_state_latches(rig: Callable, passes: Callable) -> None:
    """300 ms after the last state in which nothing had moved yet."""
    r = rig()
    held = [d.held for d in still(r, 33)]
    assert held.index(Check.ARM_FROZEN) <= 32
    assert passes(still(rig(Check.ARM_FROZEN), 100)[-1])
    r.now = after(r.now, 0.01)
    assert r.request() == set()
    assert all(passes(d) for d in still(r, 28)), "it begins to count anew"


@pytest.mark.parametrize(
    ("values", "frozen"),
    [
        ({"fx": -math.nextafter(1.0, 0)}, True),
        ({"y": 0.1, "heading": 0.4}, True),
        ({"fx": -1.0}, False),
        ({"fx": -9.0}, False),
        ({"fx": -9.0, "twist": Twist(0.03, 0.0, 0.0)}, True),
        ({"fx": -9.0, "twist": Twist(0.0, 0.0011, 0.0)}, True),
        ({"fx": -9.0, "twist": Twist(0.001, 0.0, 0.001)}, False),
        ({"fx": -9.0, "twist": Twist(0.0, 0.0, -0.002)}, True),
    ],
)
def test_jammed_arm_is_not_frozen(values: dict, frozen: bool, rig: Callable) -> None:
    assert (still(rig(), 60, **values)[-1].held is Check.ARM_FROZEN) == frozen


@pytest.mark.parametrize(
    ("wanted", "frozen"),
    [
        (ZERO, False),
        (Twist(0.0019, 0.0, 0.0), False),
        (Twist(0.0021, 0.0, 0.0), True),
        (Twist(0.0, 0.0, 0.012), False),  # 1.9 mm/s at the tip
        (Twist(0.0, 0.0, -0.014), True),
    ],
)
def test_arm_at_rest_is_not_frozen(wanted: Twist, frozen: bool, rig: Callable) -> None:
    assert (still(rig(), 60, wanted)[-1].held is Check.ARM_FROZEN) == frozen


@pytest.mark.parametrize("name", ["x", "y", "heading"])
@pytest.mark.parametrize("step", [1.1e-5, 1e-6])
def test_creep_is_not_the_commanded_motion(name: str, step: float, rig: Callable) -> None:
    for sign in (1.0, -1.0):
        r = rig()
        at = 0.0 if name != "x" else -0.2
        for k in range(40):
            decision = r.step(STEP, arm=r.fresh_arm(-r.period, **{name: at + sign * k * step}))
        assert decision.held is Check.ARM_FROZEN


def test_a_state_stamped_before_the_last_one_stops(rig: Callable, codes: Callable) -> None:
    for off, expected in (((), {"clock_backwards"}), ((Check.CLOCK_BACKWARDS,), set())):
        r = rig(*off)
        r.step(arm=r.fresh_arm(-r.period))
        decision = r.step(arm=r.fresh_arm(age=20 * MS - r.period))
        assert set(codes(decision)) == expected
        assert (decision.twist == ZERO) == bool(expected)
        assert decision.held is None
        assert set(codes(r.step(arm=r.fresh_arm(-r.period)))) <= {"acceleration"}
