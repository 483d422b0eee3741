"""For any input the gate's twist is finite and within limits (row 18 of the fault table).

100,000 inputs in the ordinary run; `make gate-random` uses the million of the fault table and
writes a report.
"""

from __future__ import annotations

import json
import math
import os
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from reachd.gate.gate import SafetyGate
from reachd.gate.limits import ROUNDING, approach_left, load, workspace_constraints
from reachd.gate.settings import MOVING_MODES, Check, SafetySettings
from reachd.interfaces import ZERO, ArmState, Goal, Touch, Twist
from reachd.strategies.parameters import SETS
from tactile_core.geometry import Side
from tactile_core.types import Instant

INPUTS = int(os.environ.get("REACH_RANDOM_INPUTS", "100000"))
REPORT = os.environ.get("REACH_RANDOM_JSON")
BLOCK = 50_000
ODD = np.array([math.nan, math.inf, -math.inf, 1.7e308, -1.7e308, 5e-324, -0.0, 1e30])


def numbers(rng: np.random.Generator, n: int, scale: float, odd: float) -> list[float]:
    """Normal numbers over three decades, a fraction ``odd`` of them replaced by extreme ones."""
    values = rng.normal(0.0, scale, n) * 10.0 ** rng.uniform(-2, 1, n)
    nasty = rng.random(n) < odd
    values[nasty] = rng.choice(ODD, nasty.sum())
    return values.tolist()


def ages(rng: np.random.Generator, n: int, usual: float) -> list[int]:
    """Ages, ns: mostly fresh, some old, some from the future."""
    values = rng.exponential(usual, n)
    values[rng.random(n) < 0.01] *= 100
    values[rng.random(n) < 0.005] *= -50
    return (values * 1e9).astype(np.int64).tolist()


def check(
    gate: SafetyGate, s: SafetySettings, arm: ArmState, twist: Twist, last: Twist, dt: float
) -> None:
    """Check everything that is guaranteed of a twist."""
    parts = (twist.vx, twist.vy, twist.omega)
    assert all(map(math.isfinite, parts))
    if twist == ZERO:
        return
    assert gate.armed
    assert arm.mode in MOVING_MODES
    assert math.hypot(twist.vx, twist.vy) <= s.speed * (1 + 1e-9)
    assert abs(twist.omega) <= s.turn_rate * (1 + 1e-9)
    for rule in workspace_constraints(arm, s):
        assert rule.along(twist) <= rule.bound + 2 * ROUNDING
    left = approach_left(load(arm, s), s.soft_fraction)
    force = math.hypot(arm.fx, arm.fy)
    if left == 0.0:
        inward = -(arm.fx * twist.vx + arm.fy * twist.vy) / force if force else 0.0
        assert inward <= 2 * ROUNDING
        assert -arm.mz * twist.omega <= 2 * ROUNDING * abs(arm.mz)
    # Acceleration is limited last, whatever else acted, except for braking along the path.
    step = math.hypot(twist.vx - last.vx, twist.vy - last.vy)
    before = math.hypot(last.vx, last.vy)
    across = abs(twist.vx * last.vy - twist.vy * last.vx)
    brakes = across <= 1e-5 * before * before and math.hypot(twist.vx, twist.vy) <= before
    assert brakes or step <= s.acceleration * dt + 1e-12
    turns = abs(twist.omega - last.omega) <= s.turn_acceleration * dt + 1e-12
    assert turns or (twist.omega * last.omega >= 0.0 and abs(twist.omega) <= abs(last.omega))


@pytest.mark.timeout(max(120, INPUTS // 500))
@pytest.mark.parametrize("name", SETS)
def test_gate_invariants_hold_for_random_inputs(name: str, make_touch: Callable) -> None:
    began = time.monotonic()
    s = SETS[name].safety
    limits = s.arm_limits
    rng = np.random.default_rng(20240)
    gate = SafetyGate(s)
    now, moved, latches = 10**12, 0, 0
    acted: Counter[str] = Counter()
    last = ZERO
    for _ in range(0, INPUTS // len(SETS), BLOCK):
        n = min(BLOCK, INPUTS // len(SETS))
        columns = zip(
            numbers(rng, n, 0.1, 0.002),
            numbers(rng, n, 0.1, 0.002),
            numbers(rng, n, 0.3, 0.002),
            rng.uniform(-0.5, 0.4, n).tolist(),
            rng.uniform(-0.4, 0.4, n).tolist(),
            rng.uniform(-7, 7, n).tolist(),
            numbers(rng, n, 8.0, 0.002),
            numbers(rng, n, 8.0, 0.002),
            numbers(rng, n, 2.0, 0.002),
            rng.choice(["ready", "moving", "stopped", "estop", "x"], n, p=P_MODE).tolist(),
            numbers(rng, n, 5.0, 0.002),
            (rng.random(n) < 0.98).tolist(),
            ages(rng, n, 0.01),
            ages(rng, n, 0.004),
            np.maximum(rng.normal(0.01, 0.003, n) * 1e9, -1e6).astype(np.int64).tolist(),
            np.where(rng.random(n) < 0.01, 0.1, 0.0).tolist(),
            (rng.random(n) < 0.002).tolist(),
            strict=True,
        )
        for vx, vy, w, x, y, h, fx, fy, mz, mode, f, ok, old, stale, dt, late, double in columns:
            now += dt
            at, seen = Instant(now - old), Instant(now - stale)
            touch = Touch(at, at, ok, f, Side.LEFT, x, y, f, f)
            arm = ArmState(
                seen, seen, x, y, h, ZERO, fx, fy, mz, mode,
                limits.v_max, limits.omega_max, limits.f_max, limits.m_max,
            )  # fmt: skip
            decision = gate.step(
                Twist(vx, vy, w), touch, arm, GOAL, Instant(now), lateness=late, duplicate=double
            )
            check(gate, s, arm, decision.twist, last, max(dt, 0) / 1e9)
            last = decision.twist
            moved += decision.twist != ZERO
            acted.update(i.code.value for i in decision.interventions)
            if decision.held is not None:
                latches += 1
                calm = ArmState(
                    Instant(now), Instant(now), 0.0, 0.0, 0.0, ZERO, 0.0, 0.0, 0.0, "ready",
                    limits.v_max, limits.omega_max, limits.f_max, limits.m_max,
                )  # fmt: skip
                gate.arm(Instant(now + 1), make_touch(Instant(now)), calm, Instant(now + 1))
    assert moved > INPUTS // len(SETS) // 5, "the test must let things move"
    assert latches > INPUTS // len(SETS) // 200
    if REPORT:
        report(
            name,
            {
                "inputs": INPUTS // len(SETS),
                "moved": moved,
                "latched": latches,
                "interventions": dict(sorted(acted.items())),
                "not_finite_or_beyond_a_limit": 0,  # any would have failed above
                "seconds": round(time.monotonic() - began, 1),
            },
        )


def report(name: str, figures: dict[str, object]) -> None:
    """Add the figures of one parameter set to the requested file."""
    path = Path(str(REPORT))
    written = json.loads(path.read_text()) if path.exists() else {}
    path.write_text(json.dumps(written | {name: figures}, indent=1) + "\n")


GOAL = Goal(0.3, 0.0, 0.0075, 40.0)
P_MODE = [0.4, 0.57, 0.015, 0.01, 0.005]


def test_random_commands_without_limits_stay_finite(
    make_gate: Callable, make_touch: Callable, make_arm: Callable, settings: SafetySettings
) -> None:
    from dataclasses import replace

    from reachd.gate.settings import ALWAYS_ON

    off = replace(settings, disabled=frozenset(Check) - ALWAYS_ON)
    gate = make_gate(off)
    rng = np.random.default_rng(3)
    now = Instant(5_000_000_000)
    for vx, vy, w in zip(*(numbers(rng, 3000, 1.0, 0.3) for _ in range(3)), strict=True):
        decision = gate.step(Twist(vx, vy, w), make_touch(now), make_arm(now), None, now)
        out = decision.twist
        assert all(map(math.isfinite, (out.vx, out.vy, out.omega)))
        if not gate.armed:
            now = Instant(now + 1)
            assert gate.arm(now, make_touch(now), make_arm(now), now) == ()
