"""Several limits at once leave the nearest allowed velocity; exact thresholds of stillness."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import nnls

from reachd.gate.gate import SafetyGate
from reachd.gate.limits import Constraint, constrained, workspace_constraints
from reachd.gate.settings import Check, SafetySettings
from reachd.interfaces import Twist
from tactile_core.types import Instant, after

T0 = Instant(5_000_000_000)
PERIOD_S = 0.01


def test_several_limits_leave_the_nearest_allowed_velocity() -> None:
    """A point of a convex region is nearest if the difference is a sum of active normals."""
    rng = np.random.default_rng(7)
    corners = 0
    for _ in range(3000):
        count = int(rng.integers(1, 6))
        angles = rng.uniform(-math.pi, math.pi, count)
        bounds = rng.uniform(0.0, 0.06, count) * (rng.random(count) < 0.7)
        rules = [
            Constraint(math.cos(a), math.sin(a), 0.0, float(b))
            for a, b in zip(angles, bounds, strict=True)
        ]
        wanted = rng.normal(0.0, 0.06, 2)
        got = constrained(Twist(float(wanted[0]), float(wanted[1]), 0.0), rules)
        point = np.array([got.vx, got.vy])
        normals = np.stack([np.cos(angles), np.sin(angles)])
        room = bounds - point @ normals
        assert room.min() > -1e-11
        active = normals[:, room < 1e-9]
        missing = wanted - point
        if not active.shape[1]:
            assert np.allclose(missing, 0.0)
            continue
        weights, rest = nnls(active, missing)
        assert rest < 1e-8
        corners += int(np.count_nonzero(weights > 1e-9) > 1)
    assert corners > 100, "corners of two limits must be met, too"


def test_border_distance_allows_for_the_slowest_chain(
    make_arm: Callable, settings: SafetySettings
) -> None:
    """At 5 cm/s, with states 1 s old and commands that expire after 0.1 s, from 15 cm."""
    slow = replace(settings, arm_age=1.0, arm_latch=2.0, command_expiry=0.1)
    horizon = math.e * 1.1
    edge = max(b.offset for b in slow.pivot_region.borders if b.nx == 1.0)
    for depth, binds in ((0.10, True), (0.05 * horizon - 1e-9, True), (0.05 * horizon, False)):
        arm = make_arm(T0, x=edge - depth, heading=math.pi)
        ahead = [
            rule
            for rule in workspace_constraints(arm, slow, 0.05)
            if rule.nx == 1.0 and rule.bound == pytest.approx(depth / horizon)
        ]
        assert bool(ahead) == binds


def frozen(gate: SafetyGate, wanted: Twist, make: tuple[Callable, Callable], **pose: float) -> bool:
    """Whether the gate latches an arm that reports one pose, then always ``pose``."""
    make_touch, make_arm = make
    decision = None
    for cycle in range(1, 60):
        now = after(T0, cycle * PERIOD_S)
        arm = make_arm(now, **({"x": 0.0} if cycle == 1 else {"x": 0.0} | pose))
        decision = gate.step(wanted, make_touch(now), arm, None, now)
    assert decision is not None
    return decision.held is Check.ARM_FROZEN


@pytest.mark.parametrize(("speed", "watched"), [(0.002, True), (math.nextafter(0.002, 0), False)])
def test_motion_check_starts_at_two_millimetres_per_second(
    speed: float,
    watched: bool,
    settings: SafetySettings,
    make_gate: Callable,
    make_touch: Callable,
    make_arm: Callable,
) -> None:
    free = replace(settings, disabled=frozenset({Check.ACCELERATION, Check.WORKSPACE}))
    assert frozen(make_gate(free), Twist(speed, 0.0, 0.0), (make_touch, make_arm)) == watched
