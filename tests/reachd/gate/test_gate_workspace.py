"""The borders of the workspace: tip and pivot stay inside, and motion back inside is allowed."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest

from reachd.gate.gate import Decision
from reachd.gate.limits import ROUNDING
from reachd.gate.settings import Check, SafetySettings
from reachd.interfaces import ZERO, Twist
from reachd.strategies.parameters import HARDWARE
from tactile_core.types import Instant

T0 = Instant(5_000_000_000)
L = 0.158
HORIZON = math.e * (0.05 + 0.06)
"""s, e times the greatest age of a state plus the expiry of a command."""


def place(which: str, side: str, depth: float) -> tuple[dict, tuple[float, float]]:
    """Pose with tip or pivot ``depth`` m inside a border, and the border's normal."""
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
        # The heading keeps the pivot well inside its own region.
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
def test_workspace_is_enforced(
    which: str,
    side: str,
    depth: float,
    allowed: float,
    send: Callable[..., Decision],
    codes: Callable,
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


def test_turning_cannot_swing_the_tip_out(send: Callable[..., Decision]) -> None:
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


def test_both_borders_hold_in_a_corner(send: Callable[..., Decision]) -> None:
    xs, ys = 0.378, 0.255
    heading = 0.2
    pose = {"x": xs - L * math.cos(heading), "y": ys - L * math.sin(heading), "heading": heading}
    held = send(Twist(0.04, 0.04, 0.0), **pose).twist
    assert math.hypot(held.vx, held.vy) == pytest.approx(0.0, abs=1e-12)
    slid = send(Twist(0.04, -0.04, 0.0), **pose).twist
    assert (slid.vx, slid.vy) == pytest.approx((0.0, -0.04), abs=1e-12)


def test_arm_comes_to_rest_before_the_border(
    make_gate: Callable, make_touch: Callable, make_arm: Callable, settings: SafetySettings
) -> None:
    """With states 37 ms old and commands followed until they expire, it stays inside."""
    gate = make_gate(settings)
    xs = [0.0] * 5  # tip 0.158 inside
    held = ZERO
    for k in range(1, 1500):
        now = Instant(T0 + k * 10_000_000)
        seen = Instant(now - 37_000_000)
        arm = make_arm(seen, x=xs[-5])
        decision = gate.step(Twist(0.06, 0.0, 0.0), make_touch(now), arm, None, now)
        if k % 6 == 0:  # five of six commands are lost; the arm follows the last one
            held = decision.twist
        xs.append(xs[-1] + held.vx * 0.01)
    assert xs[-1] + L <= 0.378 + 1e-9
    assert xs[-1] + L == pytest.approx(0.378, abs=1e-4)


def test_workspace_and_wrench_limits_combine(send: Callable[..., Decision]) -> None:
    """Neither may undo the other: at a border and under load, little motion is left."""
    pose, _ = place("tip", "left", 0.0)
    pressed = {**pose, "fx": -10.0, "fy": 15.0}
    got = send(Twist(0.05, 0.01, 0.0), **pressed).twist
    assert got.vy <= ROUNDING
    assert got.vx * -10.0 + got.vy * 15.0 >= -1e-9
    away = Twist(-0.03, 0.0, 0.0)
    assert send(away, **pressed).twist == away
