"""Arming, latching and arming again.

Rows 22, 26 and 27 of the fault table.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest

from reachd.gate.gate import Decision
from reachd.gate.settings import Check
from reachd.interfaces import ZERO, Twist
from tactile_core.types import Instant, after

MS = 1_000_000
T0 = Instant(5_000_000_000)


def test_gate_starts_disarmed(rig: Callable, codes: Callable, passes: Callable) -> None:
    r = rig(armed=False)
    assert not r.gate.armed
    decision = r.step()
    assert (decision.twist, decision.held, set(codes(decision))) == (
        ZERO,
        Check.NOT_ARMED,
        {"not_armed"},
    )
    assert r.request() == set()
    assert r.gate.armed
    assert r.gate.held is None
    assert passes(r.step())


@pytest.mark.parametrize(
    ("force", "torque", "arms"),
    [
        ((0.0, 0.0), 0.0, True),
        ((math.nextafter(1.0, 0), 0.0), 0.0, True),
        ((1.0, 0.0), 0.0, False),
        ((0.0, -1.0), 0.0, False),
        ((0.8, 0.6001), 0.0, False),
        ((0.7, -0.7), 0.0, True),
        ((0.0, 0.0), math.nextafter(0.158, 0), True),
        ((0.0, 0.0), 0.158, False),
        ((0.0, 0.0), -0.2, False),
    ],
)
def test_biased_force_sensor_prevents_arming(
    force: tuple[float, float], torque: float, arms: bool, rig: Callable
) -> None:
    for off, expected in (((), arms), ((Check.FREE_AIR,), True)):
        r = rig(*off, armed=False)
        arm = r.fresh_arm(fx=force[0], fy=force[1], mz=torque)
        assert r.request(arm=arm) == (set() if expected else {"free_air"})
        assert r.gate.armed == expected


def test_arming_in_contact_requires_free_air_first(rig: Callable) -> None:
    r = rig(armed=False)
    pressed = {"fx": -6.0}
    assert r.request(arm=r.fresh_arm(**pressed), free_air=False) == {"free_air"}
    assert r.request() == set()
    r.gate.disarm(r.now, "operator")
    r.now = after(r.now, 0.1)
    assert r.request(arm=r.fresh_arm(**pressed)) == {"free_air"}
    assert r.request(arm=r.fresh_arm(**pressed), free_air=False) == set()


@pytest.mark.parametrize(
    ("age", "arms"),
    [
        (0, True),
        (2000 * MS, True),
        (2000 * MS + 1, False),
        (-10 * MS, True),
        (-10 * MS - 1, False),
    ],
)
def test_only_a_new_request_arms(age: int, arms: bool, rig: Callable) -> None:
    r = rig(armed=False)
    refused = r.request(requested=Instant(r.now - age))
    assert refused == (set() if arms else {"request_stale"})


def estop(r: Any) -> Decision:
    return r.step(arm=r.fresh_arm(mode="estop"))


@pytest.mark.parametrize(("delay", "arms"), [(-1, False), (0, False), (1, True)])
def test_rearming_requires_a_request_newer_than_the_latch(
    delay: int, arms: bool, rig: Callable
) -> None:
    r = rig()
    estop(r)
    latched = r.now
    r.step()
    r.step()
    refused = r.request(requested=Instant(latched + delay))
    assert refused == (set() if arms else {"request_stale"})


def test_request_during_a_fault_is_not_kept(rig: Callable, passes: Callable) -> None:
    r = rig()
    estop(r)
    asked = Instant(r.now + 1)
    assert r.request(requested=asked, arm=r.fresh_arm(mode="estop")) == {"arm_mode"}
    estop(r)
    r.step()
    assert r.request(requested=asked) == {"request_stale"}
    assert not passes(r.step())
    assert r.request(requested=r.now) == set()
    assert passes(r.step())


@pytest.mark.parametrize(
    ("how", "code"),
    [
        ({"touch": None}, "features_stale"),
        ({"arm": None}, "arm_stale"),
        ({"duplicate": True}, "duplicate_publisher"),
    ],
)
def test_arming_requires_every_condition(how: dict, code: str, rig: Callable) -> None:
    r = rig(armed=False)
    assert code in r.request(**how)
    assert not r.gate.armed


def test_stopped_arm_may_be_armed_but_not_moved(
    rig: Callable, codes: Callable, passes: Callable
) -> None:
    r = rig(armed=False)
    assert r.request(arm=r.fresh_arm(mode="stopped")) == set()
    assert set(codes(r.step(arm=r.fresh_arm(mode="stopped")))) == {"arm_stopped"}
    assert passes(r.step())


def test_invalid_first_feature_does_not_arm(rig: Callable) -> None:
    r = rig(armed=False)
    assert "features_stale" in r.request(touch=replace(r.fresh_touch(), valid=False))
    ahead = replace(r.fresh_touch(), captured=Instant(r.now + 10**9))
    assert "features_stale" in r.request(touch=ahead)


def test_second_publisher_latches(rig: Callable, passes: Callable) -> None:
    r = rig()
    assert r.step(duplicate=True).held is Check.DUPLICATE_PUBLISHER
    assert r.step().held is Check.DUPLICATE_PUBLISHER
    r = rig(Check.DUPLICATE_PUBLISHER)
    assert passes(r.step(duplicate=True))


def test_first_latch_reason_stays_and_later_ones_are_reported(
    rig: Callable, codes: Callable
) -> None:
    r = rig()
    estop(r)
    decision = r.step(Twist(math.nan, 0, 0), lateness=1.0)
    assert decision.held is Check.ARM_MODE
    assert set(codes(decision)) == {"arm_mode", "command_not_finite", "loop_late"}
    assert decision.interventions[0].code is Check.ARM_MODE
    r.gate.disarm(r.now, "end")
    assert r.gate.held is not None
    assert r.gate.held.code is Check.ARM_MODE
    assert [i.code for i in estop(r).interventions] == [Check.ARM_MODE]


def test_disarm_holds_until_a_newer_request(rig: Callable) -> None:
    r = rig()
    r.gate.disarm(r.now, "the operator said so")
    decision = r.step()
    assert (decision.twist, decision.held) == (ZERO, Check.NOT_ARMED)
    assert decision.interventions[0].text == "the operator said so"
    assert r.request(requested=T0) == {"request_stale"}
    assert r.request() == set()


def test_arming_twice_changes_nothing(rig: Callable, passes: Callable) -> None:
    r = rig()
    assert r.request(arm=None) == set()
    assert passes(r.step())


def test_motion_after_arming_starts_from_rest(rig: Callable) -> None:
    """And not from the last twist before the latch: 0.5 m/s² is 5 mm/s per cycle."""
    r = rig()
    for _ in range(20):
        r.step(Twist(0.04, 0.0, 0.0))
    estop(r)
    r.step()
    assert r.request() == set()
    assert r.step(Twist(0.04, 0.0, 0.0)).twist.vx == pytest.approx(0.005)
