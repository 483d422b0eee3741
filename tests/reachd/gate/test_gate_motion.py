"""The gate's checks of the arm's motion: speed, deviation from the commanded path, frozen poses."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from reachd.gate.motion import DEAD, OFF_THE_WAY, TOO_FAST, MotionWatch
from reachd.gate.settings import Check
from reachd.interfaces import ZERO, Twist
from reachd.strategies.parameters import SETS
from tactile_core.types import Instant, after

AHEAD = Twist(0.04, 0.0, 0.0)
L = 0.158
MS = 1_000_000


class Plant:
    """An arm that moves with ``does(command)``, checked by a gate at 100 Hz."""

    def __init__(self, rig: Any, does: Callable[[Twist], Twist], **state: Any) -> None:
        self.rig, self.does, self.state = rig, does, state
        self.x, self.y, self.heading = -0.2, 0.0, 0.0
        self.last = ZERO
        self.travelled = 0.0
        self.rng = np.random.default_rng(0)
        self.noise = 0.0

    def step(self, wanted: Twist = AHEAD, **how: Any) -> Any:
        moves = self.does(self.last)
        self.x += 0.01 * moves.vx
        self.y += 0.01 * moves.vy
        self.heading += 0.01 * moves.omega
        self.travelled += 0.01 * math.hypot(moves.vx, moves.vy)
        nx, ny, nh = self.rng.normal(0.0, self.noise, 3) if self.noise else (0.0, 0.0, 0.0)
        values = {"x": self.x + nx, "y": self.y + ny, "heading": self.heading + nh / L}
        told = {"twist": moves} | self.state
        arm = self.rig.fresh_arm(-self.rig.period, **values, **told)
        decision = self.rig.step(wanted, arm=arm, **how)
        self.last = decision.twist
        return decision

    def run(self, cycles: int, wanted: Twist = AHEAD) -> tuple[int | None, Any]:
        """Cycle in which the gate latched, or None, and the last decision."""
        for k in range(cycles):
            decision = self.step(wanted)
            if decision.held is not None:
                return k, decision
        return None, decision


OFF = (Check.ACCELERATION, Check.WORKSPACE)


@pytest.mark.parametrize(
    ("does", "code"),
    [
        (lambda t: Twist(-t.vx, -t.vy, -t.omega), Check.ARM_TRACKING),
        (lambda t: Twist(-t.vy, t.vx, t.omega), Check.ARM_TRACKING),
        (lambda t: Twist(5 * t.vx, 5 * t.vy, 5 * t.omega), Check.ARM_SPEED),
        (lambda t: Twist(2 * t.vx, 2 * t.vy, 2 * t.omega), Check.ARM_TRACKING),
    ],
)
@pytest.mark.parametrize(
    "wanted", [AHEAD, Twist(-0.03, 0.02, 0.0), Twist(0.0, -0.04, 0.1), Twist(0.02, 0.0, -0.1)]
)
def test_deviating_arm_latches_within_150_ms_and_10_mm(
    does: Callable, code: Check, wanted: Twist, rig: Callable
) -> None:
    plant = Plant(rig(*OFF), does)
    when, decision = plant.run(60, wanted)
    assert when is not None
    assert when <= 15
    assert plant.travelled <= 0.010
    assert decision.held in {Check.ARM_TRACKING, Check.ARM_SPEED}
    assert decision.held is code or wanted.omega != 0.0 or code is Check.ARM_SPEED
    assert Plant(rig(*OFF, *MOTION), does).run(60, wanted)[0] is None, "all of them are off"


MOTION = (Check.ARM_SPEED, Check.ARM_TRACKING, Check.ARM_PATH, Check.ARM_FROZEN)


@pytest.mark.parametrize("part", [0.0, 0.2, 0.6, 1.0])
def test_arm_may_lag_under_load(part: float, rig: Callable) -> None:
    def does(told: Twist) -> Twist:
        return Twist(part * told.vx, part * told.vy, part * told.omega)

    plant = Plant(rig(*OFF, Check.WRENCH), does, fx=-8.0)
    assert plant.run(120)[0] is None
    assert plant.run(40, Twist(0.0, 0.0, 0.1))[0] is None


@pytest.mark.parametrize("late", [0.0, 0.01, 0.03, 0.05])
def test_commands_may_act_until_they_expire(late: float, rig: Callable) -> None:
    queue = [ZERO] * round(late / 0.01)

    def does(told: Twist) -> Twist:
        queue.append(told)
        return queue.pop(0)

    plant = Plant(rig(*OFF), does)
    for k in range(300):
        angle = k * 0.04
        wanted = Twist(0.04 * math.cos(angle), 0.04 * math.sin(angle), 0.1 * math.sin(angle / 3))
        assert plant.step(wanted).held is None


@pytest.mark.parametrize("noise", [0.0, 2e-5])
@pytest.mark.parametrize("wanted", [AHEAD, Twist(0.0, 0.004, 0.0), Twist(0.0, 0.0, -0.1)])
def test_dead_noisy_pose_latches_within_half_a_second(
    noise: float, wanted: Twist, rig: Callable
) -> None:
    plant = Plant(rig(*OFF), lambda _: ZERO)
    plant.noise = noise
    when, decision = plant.run(60, wanted)
    assert when is not None
    assert when <= 50
    assert decision.held is Check.ARM_FROZEN


def test_jammed_arm_may_tremble(rig: Callable) -> None:
    """Its load explains that it stays; a twist far below the command does not contradict that."""
    for wanted, load, twist in (
        (Twist(0.0, 0.0, 0.1), {"mz": -2.0}, Twist(0.0, 0.0, 0.004)),
        (AHEAD, {"fx": -6.0}, Twist(0.002, 0.0, 0.0)),
    ):
        plant = Plant(rig(*OFF, Check.WRENCH), lambda _: ZERO, twist=twist, **load)
        plant.noise = 3e-5
        assert plant.run(100, wanted)[0] is None
        lying = Plant(rig(*OFF, Check.WRENCH), lambda _: ZERO, twist=wanted, **load)
        lying.noise = 3e-5
        assert lying.run(100, wanted)[1].held is Check.ARM_FROZEN


@pytest.mark.parametrize("held_still", [False, True])
def test_wedged_finger_may_chatter_but_not_claim_to_turn(held_still: bool, rig: Callable) -> None:
    """Rates sampled while it turns to and fro have a mean by chance, those of a lie have one."""
    plant = Plant(rig(*OFF, Check.WRENCH), lambda _: ZERO, mz=-2.0)
    plant.noise = 3e-5
    rng = np.random.default_rng(3)
    when = None
    for k in range(200):
        rate = 0.02 + rng.normal(0.0, 0.004) if held_still else rng.normal(0.0, 0.04)
        plant.state["twist"] = Twist(0.0, 0.0, rate)
        if plant.step(Twist(0.0, 0.0, 0.02)).held is not None:
            when = k
            break
    assert (when is not None) == held_still
    assert when is None or when <= 50


def test_unloaded_arm_moving_half_the_way_latches(rig: Callable) -> None:
    plant = Plant(rig(*OFF), lambda t: Twist(0.4 * t.vx, 0.4 * t.vy, t.omega))
    when, decision = plant.run(60)
    assert when is not None
    assert decision.held is Check.ARM_PATH
    assert "was told to go" in decision.interventions[0].text
    turning = Plant(rig(*OFF), lambda t: Twist(t.vx, t.vy, 0.4 * t.omega))
    assert turning.run(60, Twist(0.0, 0.0, 0.1))[1].held is Check.ARM_PATH
    slow = Plant(rig(*OFF), lambda t: Twist(t.vx, t.vx, t.omega))
    assert slow.run(60, Twist(0.008, 0.0, 0.0))[1].held is Check.ARM_PATH


def test_slow_command_gives_no_verdict(rig: Callable) -> None:
    assert Plant(rig(*OFF), lambda _: ZERO).run(100, Twist(0.0019, 0.0, 0.0))[0] is None


def test_noise_in_free_motion_does_not_latch(rig: Callable) -> None:
    plant = Plant(rig(*OFF), lambda t: t)
    plant.noise = 2e-5
    assert plant.run(300, Twist(0.03, 0.01, 0.05))[0] is None


def test_arm_at_its_force_limit_may_be_pushed_aside(rig: Callable) -> None:
    def pushed(told: Twist) -> Twist:
        return Twist(0.5 * told.vx, 0.03 if told.vx else 0.0, told.omega)

    for load, held in (({"fx": -9.0, "fy": 1.5}, False), ({"mz": 3.7, "fy": 1.5}, False),
                       ({"fy": 9.0}, False), ({"fx": -5.0}, True)):  # fmt: skip
        plant = Plant(rig(*OFF, Check.WRENCH), pushed, **load)
        assert (plant.run(40)[0] is not None) == held, load


def test_speed_is_checked_by_twist_and_pose(rig: Callable) -> None:
    for field in ("vx", "vy"):
        twist = replace(ZERO, **{field: -0.0608 * TOO_FAST * 1.01})
        r = rig(*OFF)
        assert r.step(arm=r.fresh_arm(-r.period, twist=twist)).held is Check.ARM_SPEED
    r = rig(*OFF)
    twist = Twist(0.0, 0.0, 0.1 * TOO_FAST * 1.01)
    decision = r.step(arm=r.fresh_arm(-r.period, twist=twist))
    assert decision.held is Check.ARM_SPEED
    assert "turns at" in decision.interventions[0].text
    r = rig(*OFF)
    assert r.step(arm=r.fresh_arm(-r.period, twist=Twist(0.09, 0.0, 0.149))).held is None
    for does in (lambda _: Twist(0.0, 0.12, 0.0), lambda _: Twist(0.0, 0.0, -0.3)):
        plant = Plant(rig(*OFF, Check.ARM_TRACKING), does, twist=ZERO)
        when, decision = plant.run(20)
        assert decision.held is Check.ARM_SPEED
        assert when is not None
        assert when <= 5


def test_reset_pose_is_not_motion(rig: Callable) -> None:
    """For instance after a reset of a simulated world: earlier motion is forgotten."""
    for jump in ({"x": 0.1}, {"heading": 0.5}):
        r = rig(*OFF)
        for _ in range(20):
            r.step(ZERO)
        assert r.step(ZERO, arm=r.fresh_arm(-r.period, **jump)).held is None
    r = rig(*OFF)
    for _ in range(20):
        r.step(ZERO)
    assert r.step(ZERO, arm=r.fresh_arm(-r.period, x=-0.16)).held is not None


def test_gaps_or_old_states_restart_the_motion_check(settings: Any, make_arm: Callable) -> None:
    watch = MotionWatch(settings)
    t0 = Instant(5_000_000_000)
    watch.add_command(AHEAD, t0)
    assert watch.judge(make_arm(t0)) == ()
    bad = make_arm(after(t0, 0.01), twist=Twist(1.0, 0.0, 0.0))
    assert [c for c, _ in watch.judge(bad)] == [Check.ARM_SPEED]
    assert watch.judge(bad) == watch.judge(bad), "the same state says the same"
    assert watch.judge(make_arm(after(t0, 0.5), x=-0.18)) == ()
    assert watch.judge(make_arm(after(t0, 0.2), x=-0.15)) == ()
    watch.restart()
    assert watch.judge(make_arm(after(t0, 0.21), x=-0.19)) == ()


def test_command_history_is_kept_and_cleared_on_backward_time(
    settings: Any, make_arm: Callable
) -> None:
    watch = MotionWatch(settings)
    t0 = Instant(5_000_000_000)
    assert watch.first_command_after(t0) is None
    x = -0.2
    for k in range(3000):
        now = Instant(t0 + k * 10 * MS)
        watch.add_command(AHEAD if k % 2000 < 1000 else Twist(-0.04, 0.0, 0.0), now)
        x += 0.0004 if k % 2000 < 1000 else -0.0004
        assert watch.judge(make_arm(Instant(now + 10 * MS), x=x)) == ()
    assert watch.first_command_after(Instant(now - 15 * MS)) == now - 10 * MS
    assert watch.first_command_after(now) is None
    watch.add_command(AHEAD, t0)
    assert watch.first_command_after(Instant(t0 - 1)) == t0
    assert watch.first_command_after(t0) is None


def test_command_without_successor_expired(settings: Any, make_arm: Callable) -> None:
    """The loop was stalled: the arm moves until the command expires, and no further."""
    for went, right in ((0.06, True), (0.17, False)):
        watch = MotionWatch(settings)
        t0 = Instant(5_000_000_000)
        x = 0.0
        for k in range(30):
            watch.add_command(AHEAD, Instant(t0 + k * 10 * MS))
            watch.judge(make_arm(Instant(t0 + (k + 1) * 10 * MS), x=x + 0.0004))
            x += 0.0004
        seen: tuple = ()
        for k in range(1, 20):
            x += 0.0004 if k * 0.01 <= went - 0.009 else 0.0
            seen = watch.judge(make_arm(Instant(t0 + (30 + k) * 10 * MS), x=x)) or seen
        assert (seen == ()) == right


def test_thresholds_are_well_separated() -> None:
    """Thresholds exceed what simulated arms do in every set, with margin."""
    assert OFF_THE_WAY >= 1.5 * 0.0006
    assert 0 < DEAD < 0.5
    for one in SETS.values():
        assert one.safety.arm_v_max * TOO_FAST > one.safety.speed


@pytest.mark.parametrize("told", [ZERO, AHEAD, Twist(0.0, 0.03, 0.05), Twist(0.0, 0.0, -0.1)])
@pytest.mark.parametrize(
    ("drift", "held"),
    [
        (Twist(0.0, 0.0, 0.0), False),
        (Twist(0.001, -0.001, 0.0), False),
        (Twist(0.0021, 0.0023, 0.0), True),
        (Twist(0.003, -0.0025, 0.0), True),
        (Twist(0.0, 0.0, 0.03), True),
        (Twist(0.0, 0.0, 0.01), False),
    ],
)
def test_an_arm_that_drifts_while_nothing_touches_it_latches(
    told: Twist, drift: Twist, held: bool, rig: Callable
) -> None:
    plant = Plant(
        rig(*OFF),
        lambda t: Twist(t.vx + drift.vx, t.vy + drift.vy, t.omega + drift.omega),
    )
    when, decision = plant.run(250, told)
    if not held or drift.omega * told.omega < 0.0:  # falling short is lag, not drift
        assert when is None
        return
    assert when is not None
    assert when <= 205, "whatever the delay that it might be"
    assert decision.held is Check.ARM_TRACKING
    assert "drifted" in decision.interventions[0].text
    off = Plant(rig(*OFF, *MOTION), plant.does)
    assert off.run(250, told)[0] is None


@pytest.mark.parametrize("load", [{"fx": -1.01}, {"fy": 1.01}, {"mz": 0.159}, {"mz": -0.159}])
def test_what_touches_the_arm_may_push_it(load: dict, rig: Callable) -> None:
    def drifts(_: Twist) -> Twist:
        return Twist(0.0, 0.004, 0.0)

    plant = Plant(rig(*OFF), drifts, **load)
    assert plant.run(250, ZERO)[0] is None
    plant.state = {}
    when, _ = plant.run(150, ZERO)
    assert when is not None
    assert 99 <= when <= 101, "counted anew from when it was let go"


def test_an_arm_that_falls_short_does_not_drift(settings: Any, make_arm: Callable) -> None:
    """Commands are lost: it moves a part of the path, never beside it."""
    watch = MotionWatch(settings)
    t0 = Instant(5_000_000_000)
    x = 0.0
    for k in range(400):
        watch.add_command(AHEAD, Instant(t0 + k * 10 * MS))
        x += 0.0 if k % 4 == 0 else 0.0004
        assert watch.judge(make_arm(Instant(t0 + (k + 1) * 10 * MS), x=x)) == ()
    x -= 0.0004
    assert [c for c, _ in watch.judge(make_arm(Instant(t0 + 401 * 10 * MS), x=x + 0.05))] != []


@pytest.mark.parametrize("back", [1, 2, 5])
def test_stamps_that_go_back_hide_no_motion(back: int, rig: Callable) -> None:
    """Every second state has an older stamp than the one before; the arm moves backwards."""
    r = rig(*OFF)
    x, last = -0.2, ZERO
    for k in range(80):
        x -= 0.01 * last.vx
        age = back * 10 * MS if k % 2 else 0
        decision = r.step(AHEAD, arm=r.fresh_arm(age - r.period, x=x, twist=Twist(-0.04, 0.0, 0.0)))
        last = decision.twist
        if decision.held is not None:
            break
    assert decision.held in {Check.ARM_TRACKING, Check.ARM_PATH}
    assert -0.2 - x <= 0.010


@pytest.mark.parametrize("field", ["vx", "vy", "omega"])
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_a_twist_that_is_not_finite_stops(field: str, value: float, rig: Callable) -> None:
    r = rig(*OFF)
    twist = replace(ZERO, **{field: value})
    decision = r.step(AHEAD, arm=r.fresh_arm(-r.period, twist=twist))
    assert decision.twist == ZERO
    assert [i.code for i in decision.interventions] == [Check.ARM_NOT_FINITE]


@pytest.mark.parametrize("axis", ["x", "y", "heading"])
def test_an_arm_that_is_mirrored_latches(axis: str, rig: Callable) -> None:
    signs = {"x": (-1, 1, 1), "y": (1, -1, 1), "heading": (1, 1, -1)}[axis]
    plant = Plant(rig(*OFF), lambda t: Twist(signs[0] * t.vx, signs[1] * t.vy, signs[2] * t.omega))
    when, decision = plant.run(60, Twist(0.03, 0.02, 0.05))
    assert when is not None
    assert plant.travelled <= 0.015
    assert decision.held in {Check.ARM_TRACKING, Check.ARM_PATH}


def test_what_was_not_told_for_a_second_is_no_drift(settings: Any, make_arm: Callable) -> None:
    """The arm was moved otherwise before the first command."""
    watch = MotionWatch(settings)
    t0 = Instant(5_000_000_000)
    for k in range(150):
        if k >= 140:
            watch.add_command(ZERO, Instant(t0 + k * 10 * MS))
        assert watch.judge(make_arm(Instant(t0 + k * 10 * MS), x=min(k, 125) * 1e-4)) == ()
