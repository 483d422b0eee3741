"""The gate's limits of speed and acceleration and the slow-down near the goal, at their boundaries.

The limits are those of the paper's Table I.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import pytest

from reachd.gate.gate import Decision
from reachd.gate.limits import within_acceleration, within_speed
from reachd.gate.settings import Check, SafetySettings
from reachd.interfaces import ZERO, Goal, Twist
from tactile_core.types import Instant

T0 = Instant(5_000_000_000)
SPEED, TURN, L = 0.045 + 0.158 * 0.1, 0.1, 0.158
INSIDE = {"x": 0.05, "y": 0.0}


def speed(twist: Twist) -> float:
    return math.hypot(twist.vx, twist.vy)


# --- speed and turn rate ----------------------------------------------------------------------


@pytest.mark.parametrize("angle", [0.0, 0.7, 2.0, -2.9])
@pytest.mark.parametrize(
    ("factor", "limited"),
    [(0.0, False), (0.5, False), (1 - 1e-9, False), (1 + 1e-9, True), (1.01, True), (1e9, True)],
)
def test_speed_is_limited(
    angle: float, factor: float, limited: bool, send: Callable[..., Decision], codes: Callable
) -> None:
    v = SPEED * factor
    wanted = Twist(v * math.cos(angle), v * math.sin(angle), 0.05)
    decision = send(wanted, Check.WORKSPACE)
    assert codes(decision) == (["speed"] if limited else [])
    assert speed(decision.twist) == pytest.approx(min(v, SPEED), rel=1e-9)
    if limited:  # the same path, slower: all three components by the same factor
        assert decision.twist.omega == pytest.approx(0.05 * SPEED / v)
        assert all(i.effect == "limited" for i in decision.interventions)
    assert send(wanted, Check.WORKSPACE, Check.SPEED).twist == wanted


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(
    ("factor", "limited"),
    [(0.0, False), (1.0, False), (1 + 1e-9, True), (1.01, True), (1e9, True)],
)
def test_turn_rate_is_limited(
    sign: float, factor: float, limited: bool, send: Callable[..., Decision], codes: Callable
) -> None:
    wanted = Twist(0.02, 0.01, sign * TURN * factor)
    decision = send(wanted, **INSIDE)
    assert codes(decision) == (["turn_rate"] if limited else [])
    assert abs(decision.twist.omega) == pytest.approx(min(TURN * factor, TURN))
    if limited:
        assert decision.twist.vx == pytest.approx(0.02 / factor)
    off = send(wanted, Check.TURN_RATE, Check.WORKSPACE, **INSIDE)
    assert off.twist == wanted


def test_command_at_the_limits_is_no_intervention(send: Callable[..., Decision]) -> None:
    for wanted in (Twist(SPEED, 0.0, TURN), Twist(0.0, -SPEED, -TURN)):
        decision = send(wanted, Check.WORKSPACE)
        assert decision.twist == wanted
        assert decision.interventions == ()


def test_speed_scaling_keeps_the_path() -> None:
    twist = Twist(0.3, 0.4, 2.0)
    assert within_speed(twist, 0.5, 2.0) is twist
    assert within_speed(twist, 0.25, 9.0) == Twist(0.15, 0.2, 1.0)
    assert within_speed(twist, 9.0, 1.0) == Twist(0.15, 0.2, 1.0)
    assert within_speed(twist, 0.25, 0.5) == Twist(0.075, 0.1, 0.5), "the tighter of both"
    assert within_speed(twist, 0.125, 1.0) == Twist(0.075, 0.1, 0.5)
    huge = within_speed(Twist(1e308, 1e308, 0.0), 1.0, 1.0)
    assert speed(huge) == pytest.approx(1.0)


# --- acceleration -----------------------------------------------------------------------------


def test_acceleration_is_bounded_each_cycle(send: Callable[..., Decision], codes: Callable) -> None:
    on = (Check.ACCELERATION,)
    decision = send(Twist(0.04, 0.0, 0.0), on=on, **INSIDE)
    assert decision.twist == Twist(pytest.approx(0.005), 0.0, 0.0)
    assert codes(decision) == ["acceleration"]
    assert send(Twist(0.04, 0.0, 0.0), on=on, cycles=7, **INSIDE).twist.vx == pytest.approx(0.035)
    decision = send(Twist(0.04, 0.0, 0.0), on=on, cycles=9, **INSIDE)
    assert (decision.twist.vx, codes(decision)) == (0.04, [])
    decision = send(Twist(0.0, 0.0, -0.1), on=on, cycles=3, **INSIDE)
    assert decision.twist.omega == pytest.approx(-0.03)
    assert send(Twist(0.04, 0.0, -0.1), **INSIDE).twist == Twist(0.04, 0.0, -0.1)


@pytest.mark.parametrize(
    ("wanted", "last", "expected"),
    [
        (Twist(0.0, 0.0, 0.0), Twist(1.0, 1.0, 1.0), Twist(0.0, 0.0, 0.0)),
        (Twist(0.1, 0.0, 0.2), Twist(0.0, 0.0, 0.0), Twist(0.1, 0.0, 0.2)),
        (Twist(0.1 + 1e-9, 0.0, 0.0), Twist(0.0, 0.0, 0.0), Twist(0.1, 0.0, 0.0)),
        (Twist(0.0, -0.3, 0.0), Twist(0.0, 0.0, 0.0), Twist(0.0, -0.1, 0.0)),
        (Twist(0.3, 0.4, 0.1), Twist(0.0, 0.0, 0.0), Twist(0.06, 0.08, 0.1)),
        (Twist(0.05, 0.0, 0.5), Twist(0.0, 0.0, 0.0), Twist(0.05, 0.0, 0.2)),
        (Twist(0.05, 0.0, -0.5), Twist(0.0, 0.0, 0.0), Twist(0.05, 0.0, -0.2)),
        # Braking is as sudden as commanded; a reversal begins with standing still.
        (Twist(-0.5, 0.0, 0.1), Twist(0.5, 0.0, 0.0), Twist(0.0, 0.0, 0.1)),
        (Twist(-0.5, 0.0, 0.1), Twist(0.1, 0.0, 0.0), Twist(0.0, 0.0, 0.1)),
        (Twist(-0.5, 0.0, 0.1), Twist(0.06, 0.0, 0.0), Twist(-0.04, 0.0, 0.1)),
        (Twist(0.0, 0.0, 0.01), Twist(0.5, 0.0, 0.9), Twist(0.0, 0.0, 0.01)),
        (Twist(0.2, 0.2, 0.0), Twist(0.4, 0.4, 0.9), Twist(0.2, 0.2, 0.0)),
        (Twist(0.0, 0.01, 0.0), Twist(0.0, 0.0, -0.9), Twist(0.0, 0.01, 0.0)),
        (Twist(0.0, 0.0, -0.5), Twist(0.0, 0.0, 0.9), Twist(0.0, 0.0, 0.0)),
        (Twist(0.0, 0.0, -0.5), Twist(0.0, 0.0, 0.1), Twist(0.0, 0.0, -0.1)),
        (Twist(0.0, 0.0, 0.9), Twist(0.0, 0.0, 0.5), Twist(0.0, 0.0, 0.7)),
        # Neither a change of direction nor a higher speed is braking.
        (Twist(0.0, 0.3, 0.0), Twist(0.3, 0.0, 0.0), Twist(0.3 - 0.1 / 2**0.5, 0.1 / 2**0.5, 0.0)),
        (Twist(0.6, 0.0, 0.0), Twist(0.3, 0.0, 0.0), Twist(0.4, 0.0, 0.0)),
    ],
)
def test_acceleration_scaling_keeps_the_bound(wanted: Twist, last: Twist, expected: Twist) -> None:
    found = within_acceleration(wanted, last, 0.1, 0.2)
    assert (found.vx, found.vy, found.omega) == pytest.approx(
        (expected.vx, expected.vy, expected.omega)
    )


def test_acceleration_bound_never_violates_another_limit(
    make_gate: Callable, make_touch: Callable, make_arm: Callable, settings: SafetySettings
) -> None:
    """A load appears from one state to the next: the arm brakes along its path, then slides off."""
    gate = make_gate(settings)
    for k in range(1, 12):
        now = Instant(T0 + k * 10_000_000)
        last = gate.step(Twist(0.04, 0.0, 0.0), make_touch(now), make_arm(now, **INSIDE), None, now)
    assert last.twist == Twist(0.04, 0.0, 0.0)
    slid = []
    for k in range(12, 20):
        now = Instant(T0 + k * 10_000_000)
        arm = make_arm(now, fx=-15.0, **INSIDE)
        decision = gate.step(Twist(0.04, 0.03, 0.0), make_touch(now), arm, None, now)
        slid.append((decision.twist.vx, decision.twist.vy))
    assert slid[0] == pytest.approx((0.0, 0.0), abs=1e-12)
    assert slid[1] == pytest.approx((0.0, 0.005), abs=1e-9)
    assert slid[-1] == pytest.approx((0.0, 0.03), abs=1e-9)


def test_stop_is_not_delayed_by_acceleration_bound(
    make_gate: Callable, make_touch: Callable, make_arm: Callable, settings: SafetySettings
) -> None:
    gate = make_gate(settings)
    for k in range(1, 20):
        now = Instant(T0 + k * 10_000_000)
        gate.step(Twist(0.04, 0.0, 0.1), make_touch(now), make_arm(now, **INSIDE), None, now)
    now = Instant(now + 10_000_000)
    decision = gate.step(ZERO, make_touch(now), make_arm(now, **INSIDE), None, now)
    assert decision.twist == ZERO
    assert decision.interventions == ()


def test_long_cycle_does_not_allow_a_jump(
    make_gate: Callable, make_touch: Callable, make_arm: Callable, settings: SafetySettings
) -> None:
    """At most 60 ms of a cycle count: 0.05 m/s² · 0.06 s, also when the loop is late."""
    for passed, expected in ((50, 0.0025), (60, 0.003), (600, 0.003), (-50, 0.0)):
        chosen = replace(
            settings,
            acceleration=0.05,
            disabled=frozenset({Check.LOOP_LATE, Check.CLOCK_BACKWARDS}),
        )
        gate = make_gate(chosen)
        now = Instant(T0 + passed * 1_000_000)
        arm = make_arm(now, **INSIDE)
        decision = gate.step(Twist(0.04, 0.0, 0.0), make_touch(now), arm, None, now)
        assert decision.twist.vx == pytest.approx(expected)


# --- slow-down near the goal ------------------------------------------------------------------


@pytest.mark.parametrize(
    ("distance", "near"),
    [(0.0, True), (0.005, True), (0.01 - 1e-9, True), (0.01 + 1e-9, False), (0.3, False)],
)
@pytest.mark.parametrize("bearing", [0.0, 2.0])
def test_gate_slows_near_the_goal(
    distance: float, near: bool, bearing: float, send: Callable[..., Decision], codes: Callable
) -> None:
    """Half of the greatest speeds within 1 cm of the tip, whatever the strategy commands."""
    heading = 0.3
    x, y = 0.05 + L * math.cos(heading), L * math.sin(heading)
    goal = Goal(x + distance * math.cos(bearing), y + distance * math.sin(bearing), 0.0075, 40.0)
    pose = {"x": 0.05, "y": 0.0, "heading": heading, "goal": goal}
    wanted = Twist(0.6 * SPEED, 0.0, 0.01)
    decision = send(wanted, **pose)
    assert codes(decision) == (["slow_down"] if near else [])
    assert decision.twist.vx == pytest.approx(SPEED / 2 if near else 0.6 * SPEED)
    turning = send(Twist(0.001, 0.0, -0.06), **pose)
    assert turning.twist.omega == pytest.approx(-0.05 if near else -0.06)
    slow = Twist(0.49 * SPEED, 0.0, 0.049)
    assert send(slow, **pose).interventions == ()
    assert send(wanted, Check.SLOW_DOWN, **pose).twist == wanted


def test_slow_zone_excludes_its_border(send: Callable[..., Decision], codes: Callable) -> None:
    """At exactly its radius motion is not slowed, just inside it is."""
    goal = Goal(0.3, 0.0, 0.0075, 40.0)
    radius = 0.3 - (0.05 + L)
    wanted = Twist(0.6 * SPEED, 0.0, 0.0)
    for r, slowed in ((radius, False), (math.nextafter(radius, 1.0), True)):
        decision = send(wanted, goal=goal, values={"slow_radius": r}, **INSIDE)
        assert (codes(decision) == ["slow_down"]) == slowed
