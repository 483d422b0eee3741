"""Directions of forces, contacts and motion: the gate prefers none, and confuses none."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from reachd.gate.limits import Constraint, braked, touch_constraints
from reachd.gate.settings import Check
from reachd.interfaces import Touch, Twist
from tactile_core.geometry import Side

ANGLES = st.floats(-math.pi, math.pi)
MIRRORED = {Side.LEFT: Side.RIGHT, Side.RIGHT: Side.LEFT}
STATIC = (Check.WORKSPACE, Check.ARM_TRACKING, Check.ARM_PATH, Check.ARM_FROZEN, Check.ARM_SPEED)
"""Checks that would see that the arm of these tests stays where it is."""


def polar(size: float, angle: float) -> tuple[float, float]:
    return size * math.cos(angle), size * math.sin(angle)


def parts(twist: Twist) -> tuple[float, float, float]:
    return twist.vx, twist.vy, twist.omega


# --- the whole gate ---------------------------------------------------------------------------

SCENES = st.fixed_dictionaries(
    {
        "velocity": st.builds(polar, st.floats(0.0, 0.08), ANGLES),
        "omega": st.floats(-0.12, 0.12),
        "heading": ANGLES,
        "force": st.builds(polar, st.floats(0.1, 20.0), ANGLES),
        "mz": st.floats(-5.0, 5.0),
        "total_force": st.floats(0.0, 22.0),
        "side": st.sampled_from(Side),
        "place": st.tuples(st.floats(0.0, 0.16), st.floats(-0.03, 0.03)),
    }
)


def decide(r: Any, scene: dict[str, Any], view: Any) -> Any:
    """One cycle of the gate with ``scene`` as it looks in ``view``."""
    velocity, place = scene["velocity"], scene["place"]
    mirrored = view.sign < 0.0
    touch = replace(
        r.fresh_touch(),
        total_force=scene["total_force"],
        peak_force=scene["total_force"],
        normal_force_bound=0.0,
        peak_force_bound=0.0,
        peak_side=MIRRORED.get(scene["side"], scene["side"]) if mirrored else scene["side"],
        peak_x=place[0],
        peak_y=view.sign * place[1],
    )
    fx, fy = scene["force"]
    state = view.state(heading=scene["heading"], fx=fx, fy=fy, mz=scene["mz"])
    wanted = view.twist(Twist(*velocity, scene["omega"]))
    return r.step(wanted, touch=touch, arm=r.fresh_arm(**state))


@settings(max_examples=60)
@given(
    scenes=st.lists(SCENES, min_size=1, max_size=4),
    angle=ANGLES,
    mirrored=st.booleans(),
    steady=st.booleans(),
)
def test_a_turned_or_mirrored_scene_is_decided_alike(
    scenes: list[dict[str, Any]],
    angle: float,
    mirrored: bool,
    steady: bool,
    rig: Callable,
    make_view: Callable,
    codes: Callable,
) -> None:
    """``steady``: nothing limits the acceleration, so that each scene counts alone."""
    off = (*STATIC, *((Check.ACCELERATION,) if steady else ()))
    as_it_is, turned = rig(*off), rig(*off)
    plain, view = make_view(0.0, False), make_view(angle, mirrored)
    for scene in scenes:
        one, other = decide(as_it_is, scene, plain), decide(turned, scene, view)
        assert codes(one) == codes(other)
        assert parts(other.twist) == pytest.approx(parts(view.twist(one.twist)), abs=1e-9)


# --- contacts ---------------------------------------------------------------------------------


@settings(max_examples=60)
@given(
    heading=ANGLES,
    side=st.sampled_from((Side.TIP, Side.LEFT, Side.RIGHT)),
    place=st.tuples(st.floats(0.0, 0.16), st.floats(-0.03, 0.03)),
    twist=st.builds(Twist, *(st.floats(-0.1, 0.1),) * 3),
)
def test_the_contact_itself_must_not_press_further(
    heading: float,
    side: Side,
    place: tuple[float, float],
    twist: Twist,
    make_touch: Callable[..., Touch],
    make_arm: Callable,
) -> None:
    """Compared with the way of the touched point, in a microsecond, along the skin's normal."""
    dt = 1e-6
    normal = {Side.TIP: 0.0, Side.LEFT: math.pi / 2, Side.RIGHT: -math.pi / 2}[side] + heading

    def point(x: float, y: float, h: float) -> tuple[float, float]:
        c, s = math.cos(h), math.sin(h)
        return x + c * place[0] - s * place[1], y + s * place[0] + c * place[1]

    before = point(0.2, 0.1, heading)
    later = point(0.2 + twist.vx * dt, 0.1 + twist.vy * dt, heading + twist.omega * dt)
    went = (later[0] - before[0]) * math.cos(normal) + (later[1] - before[1]) * math.sin(normal)
    touch = make_touch(peak_side=side, peak_x=place[0], peak_y=place[1])
    (rule,) = touch_constraints(touch, make_arm(heading=heading), 0.02)
    assert rule.along(twist) == pytest.approx(went / dt, abs=1e-6)
    assert rule.bound == 0.02


OFF = (*STATIC, Check.ACCELERATION, Check.SKIN_FORCE, Check.WRENCH)


def touched(r: Any, wanted: Twist, force: float, side: Side, **arm: float) -> Twist:
    """The twist that is left while ``force`` N are felt at the middle of a ``side``."""
    place = {"peak_side": side, "peak_x": 0.08, "normal_force_bound": 0.0}
    for _ in range(3):
        touch = replace(r.fresh_touch(-r.period), total_force=force, **place)
        twist: Twist = r.step(wanted, touch=touch, arm=r.fresh_arm(-r.period, **arm)).twist
    return twist


@pytest.mark.parametrize("newtons", [0.3, 2.0, 8.0])
@pytest.mark.parametrize("angle", [0.4, 1.9, -2.5, -0.8])
def test_a_contact_of_unknown_place_ends_motion_against_the_wrists_force(
    newtons: float, angle: float, rig: Callable
) -> None:
    """However small that force is; motion along or across it and turning stay free."""
    force = dict(zip(("fx", "fy"), polar(newtons, angle), strict=True))
    ahead, across = polar(0.03, angle + math.pi), polar(0.02, angle + math.pi / 2)
    r = rig(*OFF)
    for sideways in (-1.0, 0.0, 1.0):
        for omega in (-0.09, 0.0, 0.09):
            x, y = sideways * across[0], sideways * across[1]
            out = touched(r, Twist(ahead[0] + x, ahead[1] + y, omega), 15.0, Side.NONE, **force)
            assert parts(out) == pytest.approx((x, y, omega), abs=1e-9)
            away = Twist(x - ahead[0], y - ahead[1], omega)
            assert touched(r, away, 15.0, Side.NONE, **force) == away


@pytest.mark.parametrize(("side", "sign"), [(Side.LEFT, 1.0), (Side.RIGHT, -1.0)])
def test_a_force_below_the_light_touch_changes_nothing(
    side: Side, sign: float, rig: Callable
) -> None:
    """Even if the touched point moves faster than the pivot may, because the finger turns."""
    into = Twist(0.0, sign * 0.06, sign * 0.1)
    assert touched(rig(*OFF), into, 0.45, side) == into
    slowed = touched(rig(*OFF), into, 0.55, side)
    assert sign * (slowed.vy + 0.08 * slowed.omega) == pytest.approx(0.045)


# --- braking ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("rules", "expected"),
    [
        ([], (0.04, 0.03, 0.1)),
        ([Constraint(1.0, 0.0, 0.0, 0.02)], (0.02, 0.015, 0.05)),
        ([Constraint(0.0, 1.0, 0.0, 0.02)], (0.08 / 3, 0.02, 0.2 / 3)),
        ([Constraint(0.0, -1.0, 0.0, 0.0)], (0.04, 0.03, 0.1)),
        ([Constraint(0.6, -0.8, 0.2, 0.005)], (0.01, 0.0075, 0.025)),
        (
            [Constraint(1.0, 0.0, 0.0, 0.02), Constraint(0.0, 0.0, 1.0, 0.025)],
            (0.01, 0.0075, 0.025),
        ),
        ([Constraint(0.8, 0.6, 0.0, 0.0)], (0.0, 0.0, 0.0)),
    ],
)
def test_braking_keeps_the_path_and_no_more_speed_than_allowed(
    rules: list[Constraint], expected: tuple[float, float, float]
) -> None:
    last = Twist(0.04, 0.03, 0.1)
    assert parts(braked(last, rules, math.inf, math.inf)) == pytest.approx(expected)
    assert parts(braked(last, rules, 0.005, 1.0)) == pytest.approx(
        tuple(min(1.0, 0.1, expected[0] / 0.04) * part for part in parts(last))
    )


def test_a_turn_under_load_first_brakes_along_the_way(rig: Callable) -> None:
    """At 90 % of the limit half of the speed ahead is left, at once, while it turns sideways."""
    r = rig(*STATIC)
    for _ in range(12):
        decision = r.step(Twist(0.04, 0.0, 0.0))
    assert decision.twist == Twist(0.04, 0.0, 0.0)
    pressed = {"fx": -0.9 * 15.0}
    decision = r.step(Twist(0.03, 0.03, 0.0), arm=r.fresh_arm(**pressed))
    assert parts(decision.twist) == pytest.approx((0.015, 0.0, 0.0), abs=1e-9)
    for _ in range(8):
        decision = r.step(Twist(0.03, 0.03, 0.0), arm=r.fresh_arm(**pressed))
    assert parts(decision.twist) == pytest.approx((0.015, 0.03, 0.0), abs=1e-9)
