"""The gate's checks of the loop, the command, the arm's mode and the limits that it confirms.

Rows 14, 16, 18, 26 and 28 of the fault table.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import pytest

from reachd.gate.settings import Check
from reachd.gate.workspace import Region
from reachd.interfaces import ZERO, Twist
from tactile_core.types import Instant

MS = 1_000_000
T0 = Instant(5_000_000_000)
SLOWLY = Twist(0.001, 0.0, 0.0)
"""A twist slow enough to be reached in one cycle's acceleration."""


def test_healthy_command_passes_unchanged(rig: Callable) -> None:
    decision = rig().step()
    assert decision.twist == SLOWLY
    assert decision.interventions == ()
    assert decision.held is None
    assert decision.expiry == 0.06


# --- loop -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("late", "moves"),
    [
        (0.0, True),
        (-1.0, True),
        (0.05, True),
        (math.nextafter(0.05, 1), False),
        (1.0, False),
        (math.nan, False),
        (math.inf, False),
    ],
)
def test_late_loop_does_not_move(
    late: float, moves: bool, rig: Callable, codes: Callable, passes: Callable
) -> None:
    decision = rig().step(lateness=late)
    assert passes(decision) == moves
    assert set(codes(decision)) == (set() if moves else {"loop_late"})
    assert passes(rig(Check.LOOP_LATE).step(lateness=late))


@pytest.mark.parametrize(("passed", "moves"), [(60 * MS, True), (60 * MS + 1, False)])
def test_gap_between_cycles_counts_as_late(
    passed: int, moves: bool, rig: Callable, passes: Callable
) -> None:
    r = rig()
    now = Instant(r.now + passed)
    decision = r.step(passed=passed, arm=replace(r.arm, captured=now, received=now))
    assert passes(decision) == moves
    assert passes(r.step()), "one late cycle does not latch"


@pytest.mark.parametrize(("passed", "moves"), [(0, True), (-1, False), (-(10**9), False)])
def test_backward_time_stops(passed: int, moves: bool, rig: Callable, passes: Callable) -> None:
    for off in ((), (Check.CLOCK_BACKWARDS,)):
        r = rig(Check.ACCELERATION, *off)
        now = Instant(r.now + passed)
        arm = replace(r.arm, captured=now, received=now)
        decision = r.step(passed=passed, arm=arm, touch=replace(r.touch, captured=now))
        assert passes(decision) == (moves or bool(off))


# --- command ----------------------------------------------------------------------------------


@pytest.mark.parametrize("index", range(3))
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_non_finite_command_latches(index: int, value: float, rig: Callable) -> None:
    parts = [0.001, 0.001, 0.001]
    parts[index] = value
    r = rig()
    decision = r.step(Twist(*parts))
    assert decision.twist == ZERO
    assert decision.held is Check.COMMAND_NOT_FINITE
    assert r.step().twist == ZERO, "it stays so"


def test_overflow_in_the_gate_latches(rig: Callable, codes: Callable) -> None:
    """With the speed limit off, a slanted border makes a huge number overflow."""
    slanted = Region(((-1.0, -1.0), (1.0, -1.0), (-1.0, 1.0)))
    off = (Check.SPEED, Check.TURN_RATE, Check.ACCELERATION)
    r = rig(*off, tip_region=slanted)
    decision = r.step(Twist(1.7e308, 1.0, 0.0))
    assert all(map(math.isfinite, (decision.twist.vx, decision.twist.vy)))
    r = rig(*off, tip_region=Region(((-1.0, -1.0), (1.0, -1.0), (1.0, 0.2), (-0.9, -0.9))))
    decision = r.step(Twist(-1.7e308, 1.7e308, 0.0), arm=r.fresh_arm(-r.period, x=0.0, y=-0.5))
    assert decision.twist == ZERO
    assert decision.held is Check.COMMAND_NOT_FINITE
    assert set(codes(decision)) == {"command_not_finite"}
    assert r.step().held is Check.COMMAND_NOT_FINITE


@pytest.mark.parametrize(
    ("wanted", "failure", "words"),
    [
        (None, "ValueError: lost", "ValueError: lost"),
        (SLOWLY, "late thought", "late thought"),
        (None, None, "no command"),
    ],
)
def test_failing_strategy_latches(
    wanted: Twist | None, failure: str | None, words: str, rig: Callable
) -> None:
    r = rig()
    decision = r.step(wanted, failure=failure)
    assert decision.twist == ZERO
    assert decision.held is Check.STRATEGY_FAILED
    assert words in decision.interventions[0].text
    assert r.step().held is Check.STRATEGY_FAILED


# --- mode and limits of the arm ---------------------------------------------------------------


@pytest.mark.parametrize(
    ("mode", "moves", "held"),
    [
        ("ready", True, None),
        ("moving", True, None),
        ("stopped", False, None),
        ("estop", False, Check.ARM_MODE),
        ("fault", False, Check.ARM_MODE),
        ("teach", False, Check.ARM_MODE),
        ("", False, Check.ARM_MODE),
    ],
)
def test_arm_mode_decides(
    mode: str, moves: bool, held: Check | None, rig: Callable, passes: Callable
) -> None:
    r = rig()
    decision = r.step(arm=r.fresh_arm(mode=mode))
    assert passes(decision) == moves
    assert decision.held is held
    assert passes(r.step()) == (held is None), "a latch outlives its cause; a pause does not"
    r = rig(Check.ARM_MODE, Check.ARM_STOPPED)
    assert passes(r.step(arm=r.fresh_arm(mode=mode)))


LIMITS = ("v_max", "omega_max", "f_max", "m_max")


@pytest.mark.parametrize("name", LIMITS)
@pytest.mark.parametrize(
    ("factor", "confirmed"),
    [
        (1.0, True),
        (1.0009, True),
        (0.9991, True),
        (1.0011, False),
        (0.9989, False),
        (11.0, False),
        (0.0, False),
        (-1.0, False),
        (math.nan, False),
        (math.inf, False),
    ],
)
def test_arm_must_confirm_every_limit(
    name: str, factor: float, confirmed: bool, rig: Callable
) -> None:
    r = rig(armed=False)
    arm = r.fresh_arm(**{name: factor * getattr(r.arm, name)})
    assert (r.request(arm=arm) == set()) == confirmed
    r = rig()
    decision = r.step(arm=r.fresh_arm(**{name: factor * getattr(r.arm, name)}))
    assert (decision.held is None) == confirmed, "nor may it change them later"
    r = rig(Check.ARM_LIMITS, armed=False)
    assert r.request(arm=r.fresh_arm(**{name: factor * getattr(r.arm, name)})) == set()


def test_limit_refusal_names_both_values(rig: Callable) -> None:
    r = rig(armed=False)
    arm = r.fresh_arm(v_max=0.5, omega_max=1.0)
    (refusal,) = r.gate.arm(T0, r.touch, arm, T0)
    assert "v_max is 0.5 m/s, 0.0608 asked; omega_max is 1 rad/s, 0.1 asked" in refusal.text


def test_limit_may_differ_by_at_most_a_thousandth(rig: Callable) -> None:
    for has, confirmed in ((1001.0, True), (999.0, True), (1001.01, False), (998.99, False)):
        r = rig(armed=False, arm_f_max=1000.0)
        assert (r.request(arm=r.fresh_arm(f_max=has)) == set()) == confirmed


@pytest.mark.parametrize(
    ("how", "words"),
    [
        ({"lateness": 0.075}, "75.0 ms late, 50 at most"),
        ({"passed": -20_000_000}, "went back by 0.020 s"),
    ],
)
def test_loop_faults_are_reported_with_values(how: dict, words: str, rig: Callable) -> None:
    assert words in rig().step(**how).interventions[0].text


def test_every_intervention_has_a_description(rig: Callable) -> None:
    r = rig()
    for decision in (
        r.step(lateness=1.0),
        r.step(arm=r.fresh_arm(age=60 * MS)),
        r.step(Twist(9.0, 9.0, 9.0)),
        r.step(arm=r.fresh_arm(mode="estop")),
    ):
        for one in decision.interventions:
            assert len(one.text) > 15
            assert one.effect in {"stopped", "limited", "latched", "ignored"}
