"""The gate's hands: speed, acceleration, slow-down, workspace and wrench, at their boundaries.

Row 25 of the fault table, and the limits of Table I.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from reachd.limits import (
    ROUNDING,
    Constraint,
    approach_left,
    constrained,
    load,
    within_acceleration,
    within_speed,
    workspace_constraints,
    wrench_constraints,
)
from reachd.parameters import HARDWARE
from reachd.safety import Decision, SafetyGate
from reachd.safety_settings import Check, SafetySettings
from reachd.seam import ZERO, ArmState, Goal, Twist
from tactile_bus.instant import Instant

T0 = Instant(5_000_000_000)
SPEED, TURN, L = 0.045 + 0.158 * 0.1, 0.1, 0.158
HORIZON = math.e * (0.05 + 0.06)
"""s: e times the greatest age of the state and life of a command."""
INSIDE = {"x": 0.05, "y": 0.0}


def speed(twist: Twist) -> float:
    return math.hypot(twist.vx, twist.vy)


@pytest.fixture
def send(
    make_gate: Callable, make_touch: Callable, make_arm: Callable, settings: SafetySettings
) -> Callable[..., Decision]:
    """One command through an armed gate; ACCELERATION is off unless named in ``on``."""

    def go(
        wanted: Twist,
        *off: Check,
        on: tuple[Check, ...] = (),
        goal: Goal | None = None,
        values: dict | None = None,
        cycles: int = 1,
        **arm: object,
    ) -> Decision:
        disabled = frozenset({Check.ACCELERATION, *off}) - set(on)
        gate: SafetyGate = make_gate(replace(settings, disabled=disabled, **(values or {})))
        for k in range(1, cycles + 1):
            now = Instant(T0 + k * 10_000_000)
            decision = gate.step(wanted, make_touch(now), make_arm(now, **arm), goal, now)
        assert decision.held is None
        return decision

    return go


def codes(decision: Decision) -> list[str]:
    return [i.code.value for i in decision.interventions]


# --- speed and turn rate ----------------------------------------------------------------------


@pytest.mark.parametrize("angle", [0.0, 0.7, 2.0, -2.9])
@pytest.mark.parametrize(
    ("factor", "limited"),
    [(0.0, False), (0.5, False), (1 - 1e-9, False), (1 + 1e-9, True), (1.01, True), (1e9, True)],
)
def test_speed(angle: float, factor: float, limited: bool, send: Callable[..., Decision]) -> None:
    v = SPEED * factor
    wanted = Twist(v * math.cos(angle), v * math.sin(angle), 0.05)
    decision = send(wanted, Check.WORKSPACE)
    assert codes(decision) == (["speed"] if limited else [])
    assert speed(decision.twist) == pytest.approx(min(v, SPEED), rel=1e-9)
    if limited:  # the same path, slower: all three parts by the same factor
        assert decision.twist.omega == pytest.approx(0.05 * SPEED / v)
        assert all(i.effect == "limited" for i in decision.interventions)
    assert send(wanted, Check.WORKSPACE, Check.SPEED).twist == wanted


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(
    ("factor", "limited"),
    [(0.0, False), (1.0, False), (1 + 1e-9, True), (1.01, True), (1e9, True)],
)
def test_turn_rate(
    sign: float, factor: float, limited: bool, send: Callable[..., Decision]
) -> None:
    wanted = Twist(0.02, 0.01, sign * TURN * factor)
    decision = send(wanted, **INSIDE)
    assert codes(decision) == (["turn_rate"] if limited else [])
    assert abs(decision.twist.omega) == pytest.approx(min(TURN * factor, TURN))
    if limited:
        assert decision.twist.vx == pytest.approx(0.02 / factor)
    off = send(wanted, Check.TURN_RATE, Check.WORKSPACE, **INSIDE)
    assert off.twist == wanted


def test_exactly_at_the_limits_nothing_is_said(send: Callable[..., Decision]) -> None:
    for wanted in (Twist(SPEED, 0.0, TURN), Twist(0.0, -SPEED, -TURN)):
        decision = send(wanted, Check.WORKSPACE)
        assert decision.twist == wanted
        assert decision.interventions == ()


def test_within_speed_keeps_the_path() -> None:
    twist = Twist(0.3, 0.4, 2.0)
    assert within_speed(twist, 0.5, 2.0) is twist
    assert within_speed(twist, 0.25, 9.0) == Twist(0.15, 0.2, 1.0)
    assert within_speed(twist, 9.0, 1.0) == Twist(0.15, 0.2, 1.0)
    assert within_speed(twist, 0.25, 0.5) == Twist(0.075, 0.1, 0.5), "the tighter of both"
    assert within_speed(twist, 0.125, 1.0) == Twist(0.075, 0.1, 0.5)
    huge = within_speed(Twist(1e308, 1e308, 0.0), 1.0, 1.0)
    assert speed(huge) == pytest.approx(1.0)


# --- acceleration -----------------------------------------------------------------------------


def test_acceleration_is_bounded_each_cycle(send: Callable[..., Decision]) -> None:
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
        (Twist(-0.5, 0.0, 0.1), Twist(0.5, 0.0, 0.0), Twist(0.4, 0.0, 0.1)),
        (Twist(0.0, 0.0, 0.01), Twist(0.5, 0.0, 0.9), Twist(0.4, 0.0, 0.7)),
        (Twist(0.0, 0.01, 0.0), Twist(0.0, 0.0, 0.9), Twist(0.0, 0.01, 0.7)),
        (Twist(0.01, 0.0, 0.0), Twist(0.0, 0.0, 0.9), Twist(0.01, 0.0, 0.7)),
    ],
)
def test_within_acceleration(wanted: Twist, last: Twist, expected: Twist) -> None:
    found = within_acceleration(wanted, last, 0.1, 0.2)
    assert (found.vx, found.vy, found.omega) == pytest.approx(
        (expected.vx, expected.vy, expected.omega)
    )


def test_a_stop_is_not_delayed(
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


def test_a_long_cycle_does_not_allow_a_leap(
    make_gate: Callable, make_touch: Callable, make_arm: Callable, settings: SafetySettings
) -> None:
    """60 ms is the longest cycle that counts: 0.05 m/s² · 0.06 s, late loop or not."""
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
def test_near_the_goal_it_is_slower(
    distance: float, near: bool, bearing: float, send: Callable[..., Decision]
) -> None:
    """Half of the greatest speeds within 1 cm of the tip, whatever the strategy wants."""
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


def test_the_circle_of_slow_motion_is_open(send: Callable[..., Decision]) -> None:
    """At exactly its radius nothing is slowed, just inside it is."""
    goal = Goal(0.3, 0.0, 0.0075, 40.0)
    radius = 0.3 - (0.05 + L)
    wanted = Twist(0.6 * SPEED, 0.0, 0.0)
    for r, slowed in ((radius, False), (math.nextafter(radius, 1.0), True)):
        decision = send(wanted, goal=goal, values={"slow_radius": r}, **INSIDE)
        assert (codes(decision) == ["slow_down"]) == slowed


# --- workspace --------------------------------------------------------------------------------


def place(which: str, side: str, depth: float) -> tuple[dict, tuple[float, float]]:
    """Pose that leaves tip or pivot ``depth`` m inside a border; and the border's normal."""
    region = HARDWARE.safety.tip_region if which == "tip" else HARDWARE.safety.pivot_region
    xs, ys = zip(*region.corners, strict=True)
    edge, normal = {
        "front": (min(xs), (-1.0, 0.0)),
        "back": (max(xs), (1.0, 0.0)),
        "right": (min(ys), (0.0, -1.0)),
        "left": (max(ys), (0.0, 1.0)),
    }[side]
    at = [0.05, 0.0]
    axis = 0 if normal[0] else 1
    at[axis] = edge - depth * (normal[0] or normal[1])
    heading = 0.0
    if which == "tip":
        # Turned so that the pivot is well inside its own region.
        heading = {"front": math.pi, "back": 0.0, "right": -0.2, "left": 0.2}[side]
        at = [at[0] - L * math.cos(heading), at[1] - L * math.sin(heading)]
    elif side in ("left", "right"):
        heading = -math.pi / 2 if side == "left" else math.pi / 2
    elif side == "back":
        heading = math.pi
    return {"x": at[0], "y": at[1], "heading": heading}, normal


@pytest.mark.parametrize("which", ["tip", "pivot"])
@pytest.mark.parametrize("side", ["front", "back", "right", "left"])
@pytest.mark.parametrize(
    ("depth", "allowed"),
    [
        (0.02, 0.05),
        (0.05 * HORIZON + 1e-9, 0.05),
        (0.05 * HORIZON - 1e-6, 0.05 - 1e-6 / HORIZON),
        (0.01 * HORIZON, 0.01),
        (0.0, 0.0),
        (-1e-9, 0.0),
        (-0.05, 0.0),
    ],
)
def test_workspace(
    which: str, side: str, depth: float, allowed: float, send: Callable[..., Decision]
) -> None:
    pose, (nx, ny) = place(which, side, depth)
    outward = Twist(0.05 * nx, 0.05 * ny, 0.0)
    decision = send(outward, **pose)
    got = decision.twist.vx * nx + decision.twist.vy * ny
    assert got == pytest.approx(allowed, abs=1e-9)
    assert codes(decision) == (["workspace"] if allowed < 0.05 else [])
    back = Twist(-0.05 * nx, -0.05 * ny, 0.0)
    assert send(back, **pose).twist == back, "the way back is open"
    along = Twist(-0.05 * ny, 0.05 * nx, 0.0)
    assert send(along, **pose).twist == along, "and so is the way along"
    assert send(outward, Check.WORKSPACE, **pose).twist == outward


def test_turning_may_not_swing_the_tip_out(send: Callable[..., Decision]) -> None:
    pose, _ = place("tip", "left", 0.0)
    heading = pose["heading"]
    assert send(Twist(0.0, 0.0, 0.1), **pose).twist == ZERO
    assert send(Twist(0.0, 0.0, -0.1), **pose).twist == Twist(0.0, 0.0, -0.1)
    # Moving to the right as fast as the tip swings to the left is allowed.
    away = Twist(0.0, -0.1 * L * math.cos(heading), 0.1)
    assert send(away, **pose).twist == away
    pose, _ = place("tip", "left", 0.005 * HORIZON)
    turned = send(Twist(0.0, 0.0, 0.1), **pose).twist
    assert turned.omega * L * math.cos(heading) == pytest.approx(0.005)


def test_in_a_corner_both_borders_hold(send: Callable[..., Decision]) -> None:
    xs, ys = 0.378, 0.255
    heading = 0.2
    pose = {"x": xs - L * math.cos(heading), "y": ys - L * math.sin(heading), "heading": heading}
    assert speed(send(Twist(0.04, 0.04, 0.0), **pose).twist) == pytest.approx(0.0, abs=1e-12)
    slid = send(Twist(0.04, -0.04, 0.0), **pose).twist
    assert (slid.vx, slid.vy) == pytest.approx((0.0, -0.04), abs=1e-12)


def test_it_comes_to_rest_before_the_border(
    make_gate: Callable, make_touch: Callable, make_arm: Callable, settings: SafetySettings
) -> None:
    """State 37 ms old, commands kept for the whole of their life: it stays inside."""
    gate = make_gate(settings)
    xs = [0.0] * 5  # tip 0.158 inside
    held = ZERO
    for k in range(1, 1500):
        now = Instant(T0 + k * 10_000_000)
        seen = Instant(now - 37_000_000)
        arm = make_arm(seen, x=xs[-5])
        decision = gate.step(Twist(0.06, 0.0, 0.0), make_touch(now), arm, None, now)
        if k % 6 == 0:  # five of six commands are lost; the arm goes on with the last
            held = decision.twist
        xs.append(xs[-1] + held.vx * 0.01)
    assert xs[-1] + L <= 0.378 + 1e-9
    assert xs[-1] + L == pytest.approx(0.378, abs=1e-4)


# --- wrench -----------------------------------------------------------------------------------

LOADS = [
    (0.0, 1.0),
    (0.5, 1.0),
    (0.8 - 1e-9, 1.0),
    (0.8, 1.0),
    (0.8 + 1e-6, 1.0 - 5e-6),
    (0.85, 0.75),
    (0.9, 0.5),
    (0.95, 0.25),
    (1 - 1e-6, 5e-6),
    (1.0, 0.0),
    (1 + 1e-9, 0.0),
    (3.0, 0.0),
]


@pytest.mark.parametrize(("part", "left"), LOADS)
def test_what_is_left_of_the_approach(part: float, left: float) -> None:
    assert approach_left(part, 0.8) == pytest.approx(left, abs=1e-9)


@pytest.mark.parametrize("direction", [0.0, 1.0, 2.5, -1.7])
@pytest.mark.parametrize(("part", "left"), LOADS)
def test_force_slows_stops_and_lets_retreat(
    part: float, left: float, direction: float, send: Callable[..., Decision]
) -> None:
    c, s = math.cos(direction), math.sin(direction)
    pressed = {"fx": -15.0 * part * c, "fy": -15.0 * part * s, **INSIDE}
    inward = Twist(0.05 * c, 0.05 * s, 0.0)
    decision = send(inward, **pressed)
    assert decision.twist.vx * c + decision.twist.vy * s == pytest.approx(0.05 * left, abs=1e-9)
    assert decision.twist.vx * s - decision.twist.vy * c == pytest.approx(0.0, abs=1e-12)
    assert codes(decision) == (["wrench"] if left < 1.0 else [])
    retreat = Twist(-0.05 * c, -0.05 * s, 0.0)
    assert send(retreat, **pressed).twist == retreat
    across = Twist(-0.04 * s, 0.04 * c, 0.0)
    kept = send(across, **pressed).twist
    assert (kept.vx, kept.vy) == pytest.approx((across.vx, across.vy), abs=1e-9)
    both = send(Twist(across.vx + 0.03 * c, across.vy + 0.03 * s, 0.0), **pressed).twist
    assert -both.vx * s + both.vy * c == pytest.approx(0.04, abs=1e-9), "it slides along"
    assert both.vx * c + both.vy * s == pytest.approx(0.03 * left, abs=1e-9)
    assert send(inward, Check.WRENCH, **pressed).twist == inward


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(("part", "left"), LOADS)
def test_torque_slows_stops_and_lets_turn_back(
    part: float, left: float, sign: float, send: Callable[..., Decision]
) -> None:
    twisted = {"mz": -4.5 * part * sign, **INSIDE}
    decision = send(Twist(0.0, 0.0, 0.1 * sign), **twisted)
    assert decision.twist.omega == pytest.approx(0.1 * sign * left, abs=1e-9)
    assert codes(decision) == (["wrench"] if left < 1.0 else [])
    back = Twist(0.01, 0.0, -0.1 * sign)
    assert send(back, **twisted).twist == back
    assert send(Twist(0.0, 0.0, 0.1 * sign), Check.WRENCH, **twisted).twist.omega == 0.1 * sign


def test_a_force_at_the_tip_also_holds_the_turning(send: Callable[..., Decision]) -> None:
    """15 N sideways at the tip are 2.4 N·m: far from the torque limit, but turning adds to them."""
    pressed = {"fy": -15.0, "mz": -15.0 * L, **INSIDE}
    assert send(Twist(0.0, 0.0, 0.1), **pressed).twist == ZERO
    assert send(Twist(0.0, 0.0, -0.1), **pressed).twist.omega == -0.1
    assert send(Twist(0.0, 0.04, 0.1), **pressed).twist == ZERO
    kept = send(Twist(0.03, 0.04, 0.1), **pressed).twist
    assert (kept.vx, kept.vy, kept.omega) == pytest.approx((0.03, 0.0, 0.0), abs=1e-12)


def test_the_greater_part_counts(make_arm: Callable, settings: SafetySettings) -> None:
    assert load(make_arm(fx=9.0, fy=12.0), settings) == pytest.approx(1.0)
    assert load(make_arm(fx=3.0, mz=-2.25), settings) == pytest.approx(0.5)
    assert load(make_arm(), settings) == 0.0


def test_the_inward_motion_ends_with_the_sample_that_shows_the_limit(
    make_gate: Callable, make_touch: Callable, make_arm: Callable, settings: SafetySettings
) -> None:
    """No filter and no delay: the very step that sees 15 N sends no inward motion (row 25)."""
    gate = make_gate(settings)
    touch = make_touch(T0)  # features come far more slowly than the arm's state
    for k in range(1, 15):
        now = Instant(T0 + k * 10_000_000)
        force = 0.0 if k < 14 else -15.0
        twist = gate.step(Twist(0.045, 0, 0), touch, make_arm(now, fx=force, **INSIDE), None, now)
    assert twist.twist == ZERO


def test_workspace_and_wrench_together(send: Callable[..., Decision]) -> None:
    """Neither may undo the other: at a border with something pressing, little is left."""
    pose, _ = place("tip", "left", 0.0)
    pressed = {**pose, "fx": -10.0, "fy": 15.0}
    got = send(Twist(0.05, 0.01, 0.0), **pressed).twist
    assert got.vy <= ROUNDING
    assert got.vx * -10.0 + got.vy * 15.0 >= -1e-9
    away = Twist(-0.03, 0.0, 0.0)
    assert send(away, **pressed).twist == away


# --- the arithmetic of constraints ------------------------------------------------------------


def test_only_what_offends_is_taken_away() -> None:
    wall = Constraint(1.0, 0.0, 0.0, 0.01)
    assert constrained(Twist(0.05, 0.03, 0.2), [wall]) == Twist(pytest.approx(0.01), 0.03, 0.2)
    assert constrained(Twist(0.01, 0.03, 0.2), [wall]) == Twist(0.01, 0.03, 0.2)
    assert constrained(Twist(-0.05, 0.03, 0.2), [wall]) == Twist(-0.05, 0.03, 0.2)
    lever = Constraint(1.0, 0.0, 0.5, 0.01)
    assert constrained(Twist(0.0, 0.0, 0.1), [lever]).omega == pytest.approx(0.02)
    got = constrained(Twist(0.05, 0.0, 0.1), [lever])
    assert (got.vx, got.omega) == pytest.approx((0.0, 0.02)), "moving yields before turning"
    got = constrained(Twist(0.05, 0.0, -0.06), [lever])
    assert (got.vx, got.omega) == pytest.approx((0.04, -0.06)), "turning away makes room"
    got = constrained(Twist(-0.02, 0.0, 0.1), [lever])
    assert (got.vx, got.omega) == pytest.approx((-0.02, 0.06)), "so does moving away"


def test_moving_away_along_a_slant_makes_room_for_turning() -> None:
    lever = Constraint(0.6, 0.8, 0.5, 0.01)
    got = constrained(Twist(-0.012, -0.016, 0.1), [lever])
    assert (got.vx, got.vy, got.omega) == pytest.approx((-0.012, -0.016, 0.06))


def test_rounding_does_not_end_motion() -> None:
    """What is left of a component that was taken away is not a reason to stop."""
    for k in range(100):
        a = 0.1 + 0.06 * k
        wall = Constraint(math.cos(a), math.sin(a), 0.0, 0.0)
        got = constrained(Twist(0.05, 0.0, 0.0), [wall])
        along = 0.05 * math.sin(a)
        expected = 0.05 if math.cos(a) < 0 else abs(along)
        assert speed(got) == pytest.approx(expected, abs=1e-12)


def test_in_a_narrow_wedge_the_nearest_velocity_is_none_at_all() -> None:
    """Taking one component after the other would send the arm back out of the wedge."""
    wedge = [Constraint(math.cos(a), math.sin(a), 0.0, 0.0) for a in (1.0, 2.0)]
    assert speed(constrained(Twist(0.0, 1.0, 0.0), wedge)) == pytest.approx(0.0, abs=1e-12)
    blunt = [Constraint(math.cos(a), math.sin(a), 0.0, 0.1) for a in (0.5, 2.6)]
    got = constrained(Twist(0.01, 1.0, 0.0), blunt)
    assert [rule.along(got) for rule in blunt] == pytest.approx([0.1, 0.1])
    same = [Constraint(0.0, 1.0, 0.0, b) for b in (0.2, 0.1)]
    assert constrained(Twist(0.3, 1.0, 0.0), same) == Twist(0.3, pytest.approx(0.1), 0.0)


def test_contradicting_constraints_scale_the_whole() -> None:
    """Less turning takes the room that a velocity had: then all of it is scaled."""
    rules = [Constraint(1.0, 0.0, -1.0, 0.0), Constraint(0.0, 0.0, 1.0, 0.1)]
    got = constrained(Twist(0.2, 0.1, 0.2), rules)
    assert got == ZERO
    rules = [Constraint(1.0, 0.0, -1.0, 0.05), Constraint(0.0, 0.0, 1.0, 0.1)]
    got = constrained(Twist(0.2, 0.1, 0.2), rules)
    assert (got.vx, got.vy, got.omega) == pytest.approx((0.1, 0.05, 0.05))


def test_many_contradicting_constraints_are_all_obeyed() -> None:
    rules = [
        Constraint(math.cos(a), math.sin(a), w, 0.001)
        for a, w in ((0.0, 0.9), (2.2, -0.9), (-2.2, 0.9), (1.2, -0.4))
    ]
    got = constrained(Twist(0.05, 0.03, 0.3), rules)
    assert not any(rule.broken_by(got) for rule in rules)


FINITE = st.floats(-1.0, 1.0)


@settings(max_examples=150, deadline=None)
@given(
    FINITE,
    FINITE,
    FINITE,
    st.lists(
        st.builds(
            lambda a, w, b: Constraint(math.cos(a), math.sin(a), w, b),
            st.floats(0, math.tau),
            st.floats(-0.2, 0.2),
            st.floats(0.0, 0.2) | st.just(0.0),
        ),
        max_size=5,
    ),
)
def test_constrained_obeys_every_rule_and_adds_nothing(
    vx: float, vy: float, omega: float, rules: list[Constraint]
) -> None:
    wanted = Twist(vx, vy, omega)
    got = constrained(wanted, rules)
    assert not any(rule.along(got) > rule.bound + 2 * ROUNDING for rule in rules)
    assert speed(got) <= speed(wanted) + 1e-12
    assert abs(got.omega) <= abs(omega)
    assert got.omega * omega >= 0.0
    assert got.vx * vx + got.vy * vy >= speed(got) ** 2 - 1e-9, "it never turns round"


@settings(max_examples=200, deadline=None)
@given(
    st.floats(-0.6, 0.6),
    st.floats(-0.6, 0.6),
    st.floats(-4, 4),
    FINITE,
    FINITE,
    FINITE,
)
def test_workspace_constraints_are_the_points_velocities(
    x: float, y: float, heading: float, vx: float, vy: float, omega: float
) -> None:
    """Checked against the distance that tip and pivot really go in a microsecond."""
    s = HARDWARE.safety
    arm = ArmState(T0, T0, x, y, heading, ZERO, 0, 0, 0, "ready", 1, 1, 1, 1)
    rules = workspace_constraints(arm, s)
    dt = 1e-6

    def points(x: float, y: float, h: float) -> list[tuple[float, float]]:
        return [(x + L * math.cos(h), y + L * math.sin(h)), (x, y)]

    before = points(x, y, heading)
    after = points(x + vx * dt, y + vy * dt, heading + omega * dt)
    index = 0
    for region, one, other in zip((s.tip_region, s.pivot_region), before, after, strict=True):
        for b in region.borders:
            went = b.nx * (other[0] - one[0]) + b.ny * (other[1] - one[1])
            assert rules[index].along(Twist(vx, vy, omega)) == pytest.approx(went / dt, abs=1e-5)
            left = b.offset - b.nx * one[0] - b.ny * one[1]
            assert rules[index].bound == pytest.approx(max(0.0, left) / HORIZON)
            index += 1
    assert index == len(rules)


def test_no_load_no_rules(make_arm: Callable) -> None:
    assert wrench_constraints(Twist(1, 1, 1), make_arm(), 0.0) == []
    one = wrench_constraints(Twist(1, 0, 1), make_arm(fx=-3.0), 0.5)
    assert one == [Constraint(1.0, 0.0, 0.0, 0.5)]
    one = wrench_constraints(Twist(1, 0, 1), make_arm(mz=2.0), 0.5)
    assert one == [Constraint(0.0, 0.0, -1.0, 0.0)]
