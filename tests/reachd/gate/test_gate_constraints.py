"""The arithmetic of limits: only violating motion is removed, and none is added."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from reachd.gate.limits import (
    ROUNDING,
    Constraint,
    constrained,
    workspace_constraints,
    wrench_constraints,
)
from reachd.interfaces import ZERO, ArmState, Twist
from reachd.strategies.parameters import HARDWARE
from tactile_core.types import Instant

T0 = Instant(5_000_000_000)
L = 0.158
HORIZON = math.e * (0.05 + 0.06)
"""s, e times the greatest age of a state plus the expiry of a command."""


def speed(twist: Twist) -> float:
    return math.hypot(twist.vx, twist.vy)


def test_only_violating_velocity_is_removed() -> None:
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


def test_retreat_along_a_slant_allows_turning() -> None:
    lever = Constraint(0.6, 0.8, 0.5, 0.01)
    got = constrained(Twist(-0.012, -0.016, 0.1), [lever])
    assert (got.vx, got.vy, got.omega) == pytest.approx((-0.012, -0.016, 0.06))


def test_rounding_does_not_end_motion() -> None:
    """Rounding error left of a removed component is not a reason to stop."""
    for k in range(100):
        a = 0.1 + 0.06 * k
        wall = Constraint(math.cos(a), math.sin(a), 0.0, 0.0)
        got = constrained(Twist(0.05, 0.0, 0.0), [wall])
        along = 0.05 * math.sin(a)
        expected = 0.05 if math.cos(a) < 0 else abs(along)
        assert speed(got) == pytest.approx(expected, abs=1e-12)


def test_narrow_wedge_leaves_zero_velocity() -> None:
    """Removing one component after the other would send the arm back out of the wedge."""
    wedge = [Constraint(math.cos(a), math.sin(a), 0.0, 0.0) for a in (1.0, 2.0)]
    assert speed(constrained(Twist(0.0, 1.0, 0.0), wedge)) == pytest.approx(0.0, abs=1e-12)
    blunt = [Constraint(math.cos(a), math.sin(a), 0.0, 0.1) for a in (0.5, 2.6)]
    got = constrained(Twist(0.01, 1.0, 0.0), blunt)
    assert [rule.along(got) for rule in blunt] == pytest.approx([0.1, 0.1])
    same = [Constraint(0.0, 1.0, 0.0, b) for b in (0.2, 0.1)]
    assert constrained(Twist(0.3, 1.0, 0.0), same) == Twist(0.3, pytest.approx(0.1), 0.0)


def test_contradicting_constraints_scale_the_whole_twist() -> None:
    """Less turning leaves less room for the velocity, so the whole twist is scaled."""
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
def test_workspace_constraints_limit_point_velocities(
    x: float, y: float, heading: float, vx: float, vy: float, omega: float
) -> None:
    """Compared with the distance that tip and pivot move in a microsecond."""
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


def test_no_load_gives_no_constraints(make_arm: Callable) -> None:
    assert wrench_constraints(Twist(1, 1, 1), make_arm(), 0.0) == []
    one = wrench_constraints(Twist(1, 0, 1), make_arm(fx=-3.0), 0.5)
    assert one == [Constraint(1.0, 0.0, 0.0, 0.5)]
    one = wrench_constraints(Twist(1, 0, 1), make_arm(mz=2.0), 0.5)
    assert one == [Constraint(0.0, 0.0, -1.0, 0.0)]
