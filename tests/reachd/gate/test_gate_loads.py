"""Hard and repeated loads on the wrist, force on the skin, and rising touch."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest

from reachd.gate.gate import SKIN_LATCH
from reachd.gate.limits import largest_skin_force
from reachd.gate.settings import Check
from reachd.interfaces import ZERO, Twist
from tactile_core.geometry import Side
from tactile_core.types import after

AHEAD = Twist(0.04, 0.0, 0.0)
OFF = (Check.ACCELERATION, Check.WORKSPACE, Check.ARM_FROZEN, Check.WRENCH)


def loaded(r: Any, part: float, wanted: Twist = AHEAD, **how: Any) -> Any:
    return r.step(wanted, arm=r.fresh_arm(-r.period, fx=-15.0 * part), **how)


@pytest.mark.parametrize(("part", "held"), [(1.499, False), (1.5, True), (2.999, True)])
def test_overload_in_two_states_latches(part: float, held: bool, rig: Callable) -> None:
    r = rig(*OFF)
    assert loaded(r, part).held is None, "an impact is over with the next state"
    assert loaded(r, 0.5).held is None
    loaded(r, part)
    assert loaded(r, part).held is (Check.OVERLOAD if held else None)
    assert [loaded(x := rig(*OFF, Check.OVERLOAD), part).held for _ in range(3)] == [None] * 3
    assert x.gate.armed


@pytest.mark.parametrize("values", [{"fx": -45.0}, {"fy": 45.0}, {"mz": -13.5}])
def test_three_times_the_limit_latches_at_once(values: dict, rig: Callable) -> None:
    r = rig(*OFF)
    below = {k: 0.999 * v for k, v in values.items()}
    assert r.step(arm=r.fresh_arm(-r.period, **below)).held is None
    r = rig(*OFF)
    decision = r.step(arm=r.fresh_arm(-r.period, **values))
    assert decision.held is Check.OVERLOAD
    assert "300% of its limit" in decision.interventions[0].text


def test_repeated_state_counts_once(rig: Callable) -> None:
    r = rig(*OFF)
    arm = r.fresh_arm(-r.period, fx=-23.0)
    assert r.step(arm=arm).held is None
    assert r.step(arm=arm).held is None


def passing(r: Any, times: int, every: int) -> int | None:
    """Cycle of the latch when the load passes its limit ``times``, once per ``every`` cycles."""
    for k in range(times * every):
        if loaded(r, 1.0 if k % every == 0 else 0.5).held is not None:
            return k
    return None


def test_repeated_overloads_latch(rig: Callable) -> None:
    r = rig(*OFF, overload_passes=5.0)
    when = passing(r, 10, 20)
    assert when == 80
    assert r.gate.held.code is Check.OVERLOAD_REPEATED
    assert "5 times within 5 s" in r.gate.held.text
    assert passing(rig(*OFF, overload_passes=5.0), 10, 125) == 500, "in just five seconds"
    assert passing(rig(*OFF, overload_passes=5.0), 10, 126) is None, "over more than five seconds"
    assert passing(rig(*OFF, Check.OVERLOAD_REPEATED, overload_passes=5.0), 10, 20) is None
    assert passing(rig(*OFF), 29, 16) is None, "the set allows so many"
    assert passing(rig(*OFF), 30, 16) is not None
    r.now = after(r.now, 0.01)
    assert r.request() == set()
    assert loaded(r, 1.0).held is None, "after arming it counts anew"


def test_load_jittering_about_its_limit_counts_once(rig: Callable) -> None:
    r = rig(*OFF, overload_passes=2.0)
    for k in range(100):
        assert loaded(r, 1.0 if k % 2 else 0.81).held is None
    loaded(r, 0.79)
    assert loaded(r, 1.0).held is Check.OVERLOAD_REPEATED


def test_felt_force_includes_its_uncertainty(make_touch: Callable) -> None:
    assert largest_skin_force(make_touch()) == 0.0
    assert largest_skin_force(make_touch(total_force=3.0, normal_force_bound=0.5)) == 3.5
    for unknown in (math.nan, math.inf, -1.0):
        assert largest_skin_force(make_touch(total_force=3.0, normal_force_bound=unknown)) == 6.0
    assert largest_skin_force(make_touch(total_force=1.0, normal_force_bound=0.0, peak_force=4.0,
                           peak_force_bound=1.0)) == 5.0  # fmt: skip
    assert largest_skin_force(make_touch(total_force=-2.0, normal_force_bound=0.0)) == 0.0


SKIN = (*OFF, Check.TOUCH_RISING)
TWISTS = [AHEAD, Twist(0.0, 0.03, 0.0), Twist(0.0, -0.03, 0.0), Twist(0.0, 0.0, 0.1),
          Twist(0.0, 0.0, -0.1)]  # fmt: skip


def feeling(r: Any, force: float, wanted: Twist = AHEAD, **values: Any) -> Any:
    told = {"total_force": force, "normal_force_bound": 0.0} | values
    return r.step(wanted, touch=replace(r.fresh_touch(-r.period), **told))


@pytest.mark.parametrize("wanted", TWISTS)
@pytest.mark.parametrize(
    ("force", "left"), [(16.0, 1.0), (17.0, 0.75), (18.0, 0.5), (20.0, 0.0), (39.9, 0.0)]
)
def test_skin_force_slows_and_stops_without_wrist_force(
    force: float, left: float, wanted: Twist, rig: Callable, codes: Callable
) -> None:
    r = rig(*SKIN)
    decision = feeling(r, force, wanted)
    out = decision.twist
    assert (out.vx, out.vy, out.omega) == pytest.approx(
        (left * wanted.vx, left * wanted.vy, left * wanted.omega), abs=1e-12
    )
    assert codes(decision) == (["skin_force"] if left < 1.0 else [])
    back = feeling(r, force, Twist(-0.03, 0.0, 0.0))
    assert back.twist.vx == -0.03, "straight back it may always go"
    assert feeling(rig(*SKIN, Check.SKIN_FORCE), force, wanted).twist == wanted


def test_retreat_is_along_the_finger(rig: Callable) -> None:
    r = rig(*SKIN)
    c, s = math.cos(0.7), math.sin(0.7)
    for sign, passes in ((-1.0, True), (1.0, False)):
        touch = replace(r.fresh_touch(-r.period), total_force=25.0, normal_force_bound=0.0)
        wanted = Twist(sign * 0.03 * c, sign * 0.03 * s, 0.0)
        out = r.step(wanted, touch=touch, arm=r.fresh_arm(-r.period, heading=0.7)).twist
        assert math.hypot(out.vx, out.vy) == pytest.approx(0.03 if passes else 0.0, abs=1e-9)


@pytest.mark.parametrize(("force", "bound"), [(40.0, 0.0), (30.0, 10.0), (20.0, math.nan)])
def test_twice_the_skin_limit_latches(force: float, bound: float, rig: Callable) -> None:
    assert SKIN_LATCH == 2.0
    assert feeling(rig(*SKIN), force - 0.1, normal_force_bound=bound).held is None
    r = rig(*SKIN)
    decision = feeling(r, force, normal_force_bound=bound)
    assert decision.held is Check.SKIN_OVERLOAD
    assert decision.twist == ZERO
    assert "its limit is 20 N" in decision.interventions[0].text
    off = rig(*SKIN, Check.SKIN_OVERLOAD, Check.SKIN_FORCE)
    assert feeling(off, 500.0).held is None
    # Invalid touch does not clear the load.
    spoilt = replace(r.fresh_touch(-r.period), valid=False)
    assert r.step(touch=spoilt).interventions[0].code is Check.SKIN_OVERLOAD
    r.now = after(r.now, 0.01)
    assert "skin_overload" in r.request(touch=spoilt)
    assert r.request() == set()


RISING = (*OFF, Check.SKIN_FORCE)


def touching(r: Any, force: float, side: Side, wanted: Twist, **values: Any) -> Any:
    at = {Side.TIP: (0.15, 0.0), Side.LEFT: (0.08, 0.028), Side.RIGHT: (0.08, -0.028)}
    x, y = at.get(side, (0.0, 0.0))
    return feeling(r, force, wanted, peak_side=side, peak_x=x, peak_y=y, **values)


def test_approach_is_slowed_by_touch(rig: Callable, codes: Callable) -> None:
    """6 N slow it, 15 N stop it, predicted 10 ms ahead; motion away is free."""
    for force, most in ((6.0, 0.045), (9.0, 0.0608 * 6 / 9), (12.0, 0.0608 / 3), (15.0, 0.0)):
        r = rig(*RISING)
        for _ in range(3):
            decision = touching(r, force, Side.TIP, Twist(0.06, 0.0, 0.0))
        assert decision.twist.vx == pytest.approx(most, abs=1e-4)
        assert codes(decision) == ["touch_rising"]
        assert touching(r, force, Side.TIP, Twist(-0.05, 0.02, 0.0)).twist.vx == -0.05
    assert touching(rig(*RISING, Check.TOUCH_RISING), 12.0, Side.TIP, AHEAD).twist == AHEAD


@pytest.mark.parametrize(
    ("side", "into", "along"),
    [
        (Side.LEFT, Twist(0.0, 0.04, 0.0), Twist(0.03, 0.0, 0.0)),
        (Side.RIGHT, Twist(0.0, -0.04, 0.0), Twist(0.03, 0.0, 0.0)),
        (Side.LEFT, Twist(0.0, 0.0, 0.09), Twist(0.03, 0.0, -0.09)),
        (Side.RIGHT, Twist(0.0, 0.0, -0.09), Twist(0.0, 0.03, 0.09)),
        (Side.TIP, Twist(0.04, 0.0, 0.0), Twist(-0.02, 0.03, 0.09)),
    ],
)
def test_motion_into_the_touching_side_is_slowed(
    side: Side, into: Twist, along: Twist, rig: Callable
) -> None:
    for heading in (0.0, 0.8):
        c, s = math.cos(heading), math.sin(heading)
        for wanted, stops in ((into, True), (along, False)):
            turned = Twist(c * wanted.vx - s * wanted.vy, s * wanted.vx + c * wanted.vy,
                           wanted.omega)  # fmt: skip
            r = rig(*RISING)
            r.arm = replace(r.arm, heading=heading)
            for _ in range(3):
                out = touching(r, 15.0, side, turned).twist
            size = math.hypot(out.vx, out.vy) + abs(out.omega)
            assert (size < 1e-9) == stops


def test_rising_force_is_extrapolated(rig: Callable) -> None:
    r = rig(*RISING)
    touching(r, 0.0, Side.TIP, AHEAD)
    jumped = touching(r, 7.0, Side.TIP, AHEAD).twist.vx
    assert jumped == pytest.approx(0.0608 * (15.0 - 14.0) / 9.0, abs=1e-4)
    assert touching(r, 7.0, Side.TIP, AHEAD).twist.vx == 0.04, "it no longer rises"
    # Without a side of the skin, the wrist gives the direction of the push.
    r = rig(*RISING)
    for _ in range(3):
        touch = replace(r.fresh_touch(-r.period), total_force=15.0, normal_force_bound=0.0)
        out = r.step(AHEAD, touch=touch, arm=r.fresh_arm(-r.period, fx=-2.0)).twist
    assert out.vx == pytest.approx(0.0, abs=1e-9)
    old = rig(*RISING)
    touching(old, 0.0, Side.TIP, AHEAD)
    old.step(AHEAD, passed=300_000_000)
    assert touching(old, 4.0, Side.TIP, AHEAD).twist.vx == 0.04, "too long ago for a rate"


def test_without_touch_only_the_wrist_counts(rig: Callable) -> None:
    r = rig(*OFF, Check.FEATURES_STALE, Check.FEATURES_LOST, Check.FEATURES_SPARSE, armed=False)
    assert r.request(touch=None) == set()
    assert r.step(AHEAD, touch=None).twist == AHEAD
