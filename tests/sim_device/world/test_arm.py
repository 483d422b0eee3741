"""The simulated arm behaves as a real arm's driver does, also when it fails."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim_device.arm.arm import (
    DEFAULT_EXPIRY_S,
    FACTORY_LIMITS,
    MAX_EXPIRY_S,
    MAX_PENDING,
    MAX_UNREAD,
    ArmFault,
    ArmSettings,
    SimulatedArm,
)
from sim_device.world.mujoco_world import MujocoWorld
from sim_device.world.scenes import Pose, Scene
from tactile_core.geometry import FINGER_OUTLINE
from tactile_core.types import (
    ARM_LIMITS,
    ZERO,
    ArmLimits,
    ArmState,
    Echo,
    Instant,
    Twist,
    after,
    seconds_between,
)

START = Instant(1_000_000_000)
LIMITS = ARM_LIMITS["authors_sim"]
FORWARD = Twist(0.05, 0.0, 0.0)


def arm_in(
    scene: Scene, settings: ArmSettings | None = None, limits: ArmLimits | None = LIMITS
) -> SimulatedArm:
    arm = SimulatedArm(
        MujocoWorld(scene), settings or ArmSettings(), START, np.random.default_rng(3)
    )
    if limits is not None:
        assert arm.request_limits(limits) == limits
    return arm


@pytest.fixture
def arm(build: Any) -> SimulatedArm:
    return arm_in(build.cupboard())


def drive(arm: SimulatedArm, seconds: float, twist: Twist, period: float = 0.01) -> list[ArmState]:
    """Command every ``period`` s, as a controller does."""
    states = []
    for _ in range(round(seconds / period)):
        arm.command(twist, arm.now)
        states += arm.advance(after(arm.now, period))
    return states


def wait(arm: SimulatedArm, seconds: float) -> list[ArmState]:
    return arm.advance(after(arm.now, seconds))


def test_arm_moves_as_commanded_and_reports_it(arm: SimulatedArm) -> None:
    state = drive(arm, 1.0, Twist(0.04, -0.03, 0.2))[-1]
    assert state.twist.vx == pytest.approx(0.04, rel=1e-3)
    assert (state.x, state.y) == pytest.approx((-0.2 + 0.04, -0.03), abs=0.001)
    assert state.heading == pytest.approx(0.2, abs=0.005)
    assert state.mode == "moving"
    assert state.captured == arm.now
    assert (state.fx, state.fy, state.mz) == (0.0, 0.0, 0.0)


def test_states_come_at_their_rate_without_commands(arm: SimulatedArm) -> None:
    states = wait(arm, 0.5)
    assert len(states) == 50
    steps = {b.captured - a.captured for a, b in pairwise(states)}
    assert steps == {10_000_000}
    assert {state.mode for state in states} == {"ready"}


def test_uneven_polling_loses_and_repeats_nothing(build: Any) -> None:
    rng = np.random.default_rng(0)
    arm = arm_in(build.cupboard(), ArmSettings(state_rate=200))
    states = []
    now = START
    for _ in range(300):
        now = after(now, float(rng.uniform(0, 0.02)))
        states += arm.advance(now)
    stamps = [state.captured for state in states]
    assert stamps == [START + 5_000_000 * (k + 1) for k in range(len(stamps))]
    assert seconds_between(stamps[-1], now) < 0.005
    assert arm.now == stamps[-1]


def test_backward_time_is_refused(arm: SimulatedArm) -> None:
    drive(arm, 0.1, FORWARD)
    before, pose = arm.now, arm.world.finger().x
    assert arm.advance(Instant(before - 50_000_000)) == []
    assert arm.now == before
    assert arm.world.finger().x == pose


@pytest.mark.parametrize("expiry", [0.02, DEFAULT_EXPIRY_S, MAX_EXPIRY_S, 10.0])
def test_arm_rests_within_100_ms_of_the_last_command(build: Any, expiry: float) -> None:
    arm = arm_in(build.cupboard(), ArmSettings(state_rate=200))
    drive(arm, 0.5, FORWARD)
    arm.command(FORWARD, arm.now, expiry)
    last = arm.now
    states = wait(arm, 0.3)
    still = next(s for s in states if math.hypot(s.twist.vx, s.twist.vy) < 1e-3)
    assert seconds_between(last, still.captured) <= 0.1
    # It must obey until then: a command that expires at once does nothing.
    moving = [s for s in states if s.mode == "moving"]
    assert seconds_between(last, moving[-1].captured) >= min(expiry, MAX_EXPIRY_S) - 0.011
    assert states[-1].mode == "stopped"
    assert arm.counters["expired"] == 1
    x = states[-1].x
    assert wait(arm, 1.0)[-1].x == pytest.approx(x, abs=1e-6)


def test_new_command_moves_a_stopped_arm_again(arm: SimulatedArm) -> None:
    drive(arm, 0.2, FORWARD)
    assert wait(arm, 0.2)[-1].mode == "stopped"
    assert drive(arm, 0.2, FORWARD)[-1].mode == "moving"
    drive(arm, 0.1, ZERO)
    assert arm.mode == "ready"


@settings(max_examples=40, deadline=None)
@given(vx=st.floats(-10, 10), vy=st.floats(-10, 10), omega=st.floats(-10, 10))
def test_speeds_are_limited_and_keep_their_direction(
    build: Any, vx: float, vy: float, omega: float
) -> None:
    arm = arm_in(build.cupboard())
    drive(arm, 0.1, Twist(vx, vy, omega))
    moved = arm.world.finger().twist
    speed = math.hypot(vx, vy)
    assert math.hypot(moved.vx, moved.vy) <= LIMITS.v_max * (1 + 1e-6)
    assert abs(moved.omega) <= LIMITS.omega_max * (1 + 1e-6)
    scale = min(1.0, LIMITS.v_max / speed) if speed else 1.0
    assert (moved.vx, moved.vy) == pytest.approx((vx * scale, vy * scale), abs=1e-4)
    assert (arm.counters["clamped"] > 0) == (speed > LIMITS.v_max or abs(omega) > LIMITS.omega_max)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_non_finite_command_stops_the_arm(arm: SimulatedArm, bad: float) -> None:
    for twist in (Twist(bad, 0, 0), Twist(0, bad, 0), Twist(0, 0, bad)):
        drive(arm, 0.1, FORWARD)
        assert not arm.command(twist, arm.now)
        assert abs(wait(arm, 0.03)[-1].twist.vx) < 1e-3
    for expiry in (bad, 0.0, -1.0):
        drive(arm, 0.1, FORWARD)
        assert not arm.command(FORWARD, arm.now, expiry)
        assert abs(wait(arm, 0.03)[-1].twist.vx) < 1e-3
    assert (arm.counters["not_finite"], arm.counters["bad_expiry"]) == (3, 3)


def test_wrench_never_stays_above_the_confirmed_limit(build: Any) -> None:
    tip = FINGER_OUTLINE[3][0]
    arm = arm_in(build.cupboard(start=Pose(0.375 - tip - 0.01, 0.0, 0.0)))
    for limit in (5.0, 10.0):
        arm.request_limits(ArmLimits(0.05, 0.35, limit, 1.5))
        states = drive(arm, 0.5, FORWARD)
        assert states[-1].fx == pytest.approx(-limit, rel=0.01)
        assert states[-1].f_max == limit


def test_limits_are_confirmed_by_every_state(build: Any) -> None:
    arm = arm_in(build.cupboard(), limits=None)
    state = wait(arm, 0.01)[-1]
    assert (state.v_max, state.omega_max) == (0.5, 1.0)  # Flexiv's defaults
    asked = ArmLimits(v_max=0.04, omega_max=5.0, f_max=8.0, m_max=500.0)
    confirmed = arm.request_limits(asked)
    # It never confirms more than its own limits.
    assert confirmed == ArmLimits(0.04, FACTORY_LIMITS.omega_max, 8.0, FACTORY_LIMITS.m_max)
    state = wait(arm, 0.01)[-1]
    assert ArmLimits(state.v_max, state.omega_max, state.f_max, state.m_max) == confirmed


def test_refused_limits_show_in_reply_and_state(build: Any) -> None:
    arm = arm_in(build.cupboard(), limits=None)
    arm.inject(ArmFault.REFUSES_LIMITS)
    assert arm.request_limits(LIMITS) == FACTORY_LIMITS
    assert wait(arm, 0.01)[-1].v_max == FACTORY_LIMITS.v_max
    arm.clear(ArmFault.REFUSES_LIMITS)
    assert arm.request_limits(LIMITS) == LIMITS


def test_silent_arm_sends_nothing_but_keeps_moving(arm: SimulatedArm) -> None:
    drive(arm, 0.1, FORWARD)
    arm.inject(ArmFault.SILENT)
    x = arm.world.finger().x
    assert drive(arm, 0.2, FORWARD) == []
    assert arm.world.finger().x > x + 0.005
    arm.clear(ArmFault.SILENT)
    (state,) = drive(arm, 0.01, FORWARD)
    assert state.captured == arm.now


def test_frozen_state_has_fresh_stamps_and_old_values(arm: SimulatedArm) -> None:
    last = drive(arm, 0.1, FORWARD)[-1]
    arm.inject(ArmFault.FROZEN)
    states = drive(arm, 0.2, FORWARD)
    assert len(states) == 20
    assert {(s.x, s.twist) for s in states} == {(last.x, last.twist)}
    assert states[-1].captured == arm.now
    assert arm.world.finger().x > last.x + 0.005


def test_stale_state_has_old_stamps(arm: SimulatedArm) -> None:
    last = drive(arm, 0.1, FORWARD)[-1]
    arm.inject(ArmFault.STALE)
    states = drive(arm, 0.2, FORWARD)
    assert {s.captured for s in states} == {last.captured}
    assert states[-1].received == arm.now


@pytest.mark.parametrize(
    ("fault", "went"),
    [
        (ArmFault.BACKWARDS, (-0.01, 0.005, -0.1)),
        (ArmFault.SIDEWAYS, (0.005, 0.01, 0.1)),
        (ArmFault.FAST, (0.05, -0.025, 0.5)),
    ],
)
def test_wrongly_mounted_arm_deviates(
    fault: ArmFault, went: tuple[float, float, float], arm: SimulatedArm
) -> None:
    """Its state reports the true motion, and its limits do not prevent it."""
    arm.inject(fault)
    state = drive(arm, 0.3, Twist(0.01, -0.005, 0.1))[-1]
    twist = state.twist
    assert (twist.vx, twist.vy, twist.omega) == pytest.approx(went, abs=1e-3)
    arm.clear(fault)
    right = drive(arm, 0.3, Twist(0.01, -0.005, 0.1))[-1].twist
    assert right.vx == pytest.approx(0.01, abs=1e-3)


def test_states_echo_the_command_in_force(arm: SimulatedArm) -> None:
    assert arm.advance(after(arm.now, 0.01))[-1].echo is None
    first, second = (Echo("reach-1", k, Instant(100 + k)) for k in (1, 2))
    arm.command(Twist(0.01, 0.0, 0.0), arm.now, echo=first)
    assert arm.advance(after(arm.now, 0.01))[-1].echo == first
    arm.command(Twist(0.01, 0.0, 0.0), after(arm.now, 0.02), echo=second)
    assert wait(arm, 0.01)[-1].echo == first, "not yet in force"
    assert wait(arm, 0.3)[-1].echo == second, "the last that was, although it is over"


def test_force_bias_is_in_the_sensor_frame(build: Any) -> None:
    turned = build.cupboard(start=Pose(-0.2, 0.0, math.pi / 2))
    arm = arm_in(turned, ArmSettings(bias=(3.0, 0.0, 0.1)))
    arm.inject(ArmFault.BIASED)
    state = wait(arm, 0.01)[-1]
    assert (state.fx, state.fy, state.mz) == pytest.approx((0.0, 3.0, 0.1))
    arm.clear(ArmFault.BIASED)
    state = wait(arm, 0.01)[-1]
    assert (state.fx, state.fy, state.mz) == (0.0, 0.0, 0.0)


@pytest.mark.parametrize("fault", [ArmFault.ESTOP, ArmFault.FAULT])
def test_stop_latches_until_the_operator_enables(arm: SimulatedArm, fault: ArmFault) -> None:
    drive(arm, 0.2, FORWARD)
    arm.inject(fault)
    state = drive(arm, 0.05, FORWARD)[-1]
    assert state.mode == fault.value
    assert math.hypot(state.twist.vx, state.twist.vy) < 1e-3
    assert arm.counters["not_enabled"] == 5
    assert not arm.enable()  # the cause is still there
    arm.clear(fault)
    x = state.x
    assert drive(arm, 0.2, FORWARD)[-1].mode == fault.value  # it clears nothing by itself
    assert arm.world.finger().x == pytest.approx(x, abs=1e-3)
    assert arm.enable()
    assert wait(arm, 0.01)[-1].mode == "ready"
    assert drive(arm, 0.1, FORWARD)[-1].mode == "moving"


def test_emergency_stop_outranks_a_fault(arm: SimulatedArm) -> None:
    arm.inject(ArmFault.ESTOP)
    arm.inject(ArmFault.FAULT)
    assert arm.mode == "estop"
    arm.clear(ArmFault.ESTOP)
    assert not arm.enable()


def test_latency_delays_commands_and_states(build: Any) -> None:
    arm = arm_in(build.cupboard(), ArmSettings(command_latency=0.03, state_latency=0.02))
    sent = arm.now
    states = drive(arm, 0.2, FORWARD)
    moved = next(s for s in states if s.twist.vx > 0.001)
    assert seconds_between(sent, moved.captured) == pytest.approx(0.04, abs=0.006)
    assert all(seconds_between(s.captured, s.received) == pytest.approx(0.02) for s in states)
    assert states[-1].captured == arm.now - 20_000_000
    # A command that expires on its way is never obeyed.
    slow = arm_in(build.cupboard(), ArmSettings(command_latency=0.06))
    slow.command(FORWARD, slow.now, 0.05)
    wait(slow, 0.3)
    assert slow.world.finger().x == -0.2


def test_noise_has_its_spread_and_is_seeded(build: Any) -> None:
    noisy = ArmSettings(
        position_noise=1e-4, heading_noise=1e-3, speed_noise=2e-3, turn_noise=3e-3,
        force_noise=0.1, moment_noise=0.02,
    )  # fmt: skip

    def record() -> list[ArmState]:
        arm = arm_in(build.cupboard(), noisy)
        return [state for _ in range(10) for state in wait(arm, 1.0)]

    states = record()
    assert states == record()
    spread = {
        "x": 1e-4, "y": 1e-4, "heading": 1e-3, "fx": 0.1, "fy": 0.1, "mz": 0.02
    }  # fmt: skip
    for name, sigma in spread.items():
        values = [getattr(state, name) for state in states]
        assert np.std(values) == pytest.approx(sigma, rel=0.12), name
    assert np.std([s.twist.vy for s in states]) == pytest.approx(2e-3, rel=0.12)
    assert np.std([s.twist.omega for s in states]) == pytest.approx(3e-3, rel=0.12)


def test_buffers_are_bounded_and_losses_counted(build: Any) -> None:
    arm = arm_in(build.cupboard(), ArmSettings(command_latency=10.0, state_latency=100.0))
    for _ in range(MAX_PENDING + 7):
        arm.command(FORWARD, arm.now)
    assert arm.counters["overflow"] == 7
    assert wait(arm, (MAX_UNREAD + 50) * 0.01) == []
    assert arm.counters["states_lost"] == 50
    arm.inject(ArmFault.SILENT)
    assert len(wait(arm, 100.0)) == MAX_UNREAD


@pytest.mark.parametrize(
    "change",
    [
        {"state_rate": 50.0},
        {"state_rate": 130.0},
        {"state_rate": 400.0},
        {"state_rate": math.nan},
        {"command_latency": -0.01},
        {"state_latency": math.inf},
        {"force_noise": math.nan},
        {"bias": (math.nan, 0.0, 0.0)},
    ],
)
def test_impossible_arm_settings_are_refused(change: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=next(iter(change))):
        ArmSettings(**change)


@pytest.mark.parametrize("bad", [0.0, -1.0, math.nan, math.inf])
@pytest.mark.parametrize("name", ["v_max", "omega_max", "f_max", "m_max"])
def test_useless_limits_are_refused_by_the_arm(name: str, bad: float) -> None:
    figures = {"v_max": 0.05, "omega_max": 0.3, "f_max": 10.0, "m_max": 1.5, name: bad}
    with pytest.raises(ValueError, match=name):
        ArmLimits(**figures)


def test_trial_is_a_function_of_its_seed(build: Any) -> None:
    def trial() -> list[ArmState]:
        scene = build.cupboard(build.box(0.05, 0.005), build.disc(0.12, -0.01))
        arm = arm_in(scene, ArmSettings(force_noise=0.1, command_latency=0.003))
        return drive(arm, 4.0, FORWARD, period=0.008)

    assert trial() == trial()
