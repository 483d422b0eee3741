"""The load on the arm: motion that adds to it is slowed and stopped; retreat is allowed.

Row 25 of the fault table.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest

from reachd.gate.gate import Decision
from reachd.gate.limits import approach_left, load
from reachd.gate.settings import Check, SafetySettings
from reachd.interfaces import ZERO, Twist
from tactile_core.types import Instant

T0 = Instant(5_000_000_000)
L = 0.158
INSIDE = {"x": 0.05, "y": 0.0}

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
    (1.49, 0.0),
]


@pytest.mark.parametrize(("part", "left"), LOADS)
def test_approach_scale_falls_with_load(part: float, left: float) -> None:
    assert approach_left(part, 0.8) == pytest.approx(left, abs=1e-9)


@pytest.mark.parametrize("direction", [0.0, 1.0, 2.5, -1.7])
@pytest.mark.parametrize(("part", "left"), LOADS)
def test_force_slows_stops_and_allows_retreat(
    part: float, left: float, direction: float, send: Callable[..., Decision], codes: Callable
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
def test_torque_slows_stops_and_allows_turning_back(
    part: float, left: float, sign: float, send: Callable[..., Decision], codes: Callable
) -> None:
    twisted = {"mz": -4.5 * part * sign, **INSIDE}
    decision = send(Twist(0.0, 0.0, 0.1 * sign), **twisted)
    assert decision.twist.omega == pytest.approx(0.1 * sign * left, abs=1e-9)
    assert codes(decision) == (["wrench"] if left < 1.0 else [])
    back = Twist(0.01, 0.0, -0.1 * sign)
    assert send(back, **twisted).twist == back
    assert send(Twist(0.0, 0.0, 0.1 * sign), Check.WRENCH, **twisted).twist.omega == 0.1 * sign


def test_tip_force_also_limits_turning(send: Callable[..., Decision]) -> None:
    """15 N sideways at the tip are 2.4 N·m: far from the torque limit, but turning adds load."""
    pressed = {"fy": -15.0, "mz": -15.0 * L, **INSIDE}
    assert send(Twist(0.0, 0.0, 0.1), **pressed).twist == ZERO
    assert send(Twist(0.0, 0.0, -0.1), **pressed).twist.omega == -0.1
    assert send(Twist(0.0, 0.04, 0.1), **pressed).twist == ZERO
    kept = send(Twist(0.03, 0.04, 0.1), **pressed).twist
    assert (kept.vx, kept.vy, kept.omega) == pytest.approx((0.03, 0.0, 0.0), abs=1e-12)


def test_larger_load_fraction_counts(make_arm: Callable, settings: SafetySettings) -> None:
    assert load(make_arm(fx=9.0, fy=12.0), settings) == pytest.approx(1.0)
    assert load(make_arm(fx=3.0, mz=-2.25), settings) == pytest.approx(0.5)
    assert load(make_arm(), settings) == 0.0


def test_inward_motion_ends_with_the_sample_at_the_limit(
    make_gate: Callable, make_touch: Callable, make_arm: Callable, settings: SafetySettings
) -> None:
    """No filter and no delay: the step that sees 15 N sends no inward motion (row 25)."""
    gate = make_gate(settings)
    touch = make_touch(T0)  # features are far less frequent than the arm's state
    for k in range(1, 15):
        now = Instant(T0 + k * 10_000_000)
        force = 0.0 if k < 14 else -15.0
        twist = gate.step(Twist(0.045, 0, 0), touch, make_arm(now, fx=force, **INSIDE), None, now)
    assert twist.twist == ZERO
