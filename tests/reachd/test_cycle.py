"""The controller on virtual time: arming, reaching, stalls and ending."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from reachd.control import Controller, Cycle, Inputs
from reachd.gate.gate import SafetyGate
from reachd.gate.settings import Check
from reachd.interfaces import ZERO, ArmState, Touch
from reachd.services import make_goal
from reachd.strategies import load_strategy
from reachd.strategies.parameters import HARDWARE
from reachd.trial import Reason, Supervisor
from tactile_core.geometry import Side
from tactile_core.types import NS_PER_S, Instant, after

SAFETY = HARDWARE.safety


class Bench:
    """A controller, an arm without inertia and a finger that touches nothing."""

    def __init__(self) -> None:
        strategy = load_strategy("straight", HARDWARE, np.random.default_rng(0))
        supervisor = Supervisor(strategy, HARDWARE)
        self.controller = Controller(supervisor, SafetyGate(SAFETY), SAFETY)
        self.now = Instant(3 * NS_PER_S)
        self.limits = SAFETY.arm_limits
        self.x, self.y, self.heading = -0.158, 0.0, 0.0
        self.force = 0.0
        self.duplicate = False
        self.twist = ZERO

    def step(self, lateness: float = 0.0, skip: float = 0.01) -> Cycle:
        self.now = after(self.now, skip)
        if skip == 0.01:
            self.x += self.twist.vx * 0.01
            self.y += self.twist.vy * 0.01
            self.heading += self.twist.omega * 0.01
        cycle = self.controller.cycle(
            Inputs(self._touch(), self._arm(), self.duplicate), self.now, lateness
        )
        self.twist = cycle.decision.twist
        return cycle

    def arm(self, ago: float = 0.0) -> tuple[str, ...]:
        since = after(self.now, -ago)
        return self.controller.arm(self.now, since, after(self.now, 0.001), free_air=True)

    def _touch(self) -> Touch:
        return Touch(self.now, self.now, True, 0.0, Side.NONE, 0.0, 0.0, 0.0, 0.0)

    def _arm(self) -> ArmState:
        a = self.limits
        return ArmState(
            self.now, self.now, self.x, self.y, self.heading, self.twist, self.force, 0.0, 0.0,
            "ready", a.v_max, a.omega_max, a.f_max, a.m_max,
        )  # fmt: skip


@pytest.fixture
def bench() -> Bench:
    made = Bench()
    made.step()
    return made


def test_disarmed_loop_neither_moves_nor_accepts_goals(bench: Bench) -> None:
    assert bench.step().decision.held is Check.NOT_ARMED
    refusal = bench.controller.reach(make_goal(0.05, 0.0, HARDWARE), bench.now)
    assert refusal is not None
    assert "not armed" in refusal
    assert bench.step().decision.twist == ZERO


def test_reach_runs_from_arming_to_outcome(bench: Bench) -> None:
    assert bench.arm() == ()
    goal = make_goal(0.05, 0.0, HARDWARE)
    assert bench.controller.reach(goal, bench.now) is None
    moved = [bench.step().decision.twist != ZERO for _ in range(200)]
    assert any(moved)
    assert not moved[-1]
    [(outcome, of)] = bench.controller.finished
    assert of is goal
    assert outcome.success
    assert outcome.distance <= goal.radius


def test_unconfirmed_limits_do_not_cancel_the_arm_request(bench: Bench) -> None:
    bench.limits = replace(bench.limits, v_max=0.5)
    bench.step()
    acted = bench.now
    bench.limits = SAFETY.arm_limits
    bench.step()
    requested = after(bench.now, 0.001)
    assert bench.controller.arm(requested, acted, requested, free_air=True) == ()


def test_persistently_unconfirmed_limits_are_named(bench: Bench) -> None:
    bench.limits = replace(bench.limits, f_max=100.0)
    bench.step()
    [why] = bench.arm()
    assert "f_max is 100 N, 10.6066 asked" in why


def test_fault_between_request_and_arming_is_not_cleared(bench: Bench) -> None:
    acted = bench.now
    bench.duplicate = True
    bench.step()
    bench.duplicate = False
    bench.step()
    requested = after(bench.now, 0.001)
    [why] = bench.controller.arm(requested, acted, requested, free_air=True)
    assert "ask again" in why
    assert bench.arm() == ()


def test_force_sensor_bias_refuses_arming(bench: Bench) -> None:
    bench.force = 1.2
    bench.step()
    [why] = bench.arm()
    assert "1.20 N" in why


def test_second_publisher_ends_the_reach_and_latches(bench: Bench) -> None:
    bench.arm()
    bench.controller.reach(make_goal(0.3, 0.0, HARDWARE), bench.now)
    for _ in range(30):
        bench.step()
    assert bench.twist != ZERO
    bench.duplicate = True
    assert bench.step().decision.twist == ZERO
    bench.duplicate = False
    assert bench.step().decision.held is Check.DUPLICATE_PUBLISHER
    [(outcome, _)] = bench.controller.finished
    assert outcome.reason is Reason.HELD


@pytest.mark.parametrize(("lateness", "held"), [(0.9, None), (1.1, Check.NOT_ARMED)])
def test_long_stalled_loop_does_not_resume_motion(
    bench: Bench, lateness: float, held: Check | None
) -> None:
    bench.arm()
    bench.controller.reach(make_goal(0.3, 0.0, HARDWARE), bench.now)
    for _ in range(30):
        bench.step()
    cycle = bench.step(lateness, skip=lateness + 0.01)
    assert cycle.decision.twist == ZERO
    cycle = bench.step()
    assert cycle.decision.held is held
    assert (cycle.decision.twist == ZERO) == (held is not None)


def test_ages_are_measured_from_capture(bench: Bench) -> None:
    old = after(bench.now, -0.03)
    touch = Touch(old, bench.now, True, 0.0, Side.NONE, 0.0, 0.0, 0.0, 0.0)
    cycle = bench.controller.cycle(Inputs(touch, None), bench.now, 0.0)
    assert cycle.touch_age == pytest.approx(0.03)
    assert np.isnan(cycle.arm_age)
