"""A trial from idle to its outcome, with the gate and a finger in free air."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from reachd.gate.gate import Intervention, SafetyGate
from reachd.gate.settings import Check
from reachd.interfaces import ZERO, ArmState, Goal, Strategy, Touch, Twist
from reachd.services import make_goal
from reachd.strategies import load_strategy
from reachd.strategies.parameter_fields import Parameters
from reachd.strategies.parameters import AUTHORS_SIM, HARDWARE, parameters
from reachd.trial import HOMING_LIMIT, Onsets, Outcome, Pose, Reason, State, Supervisor
from tactile_core.geometry import Side
from tactile_core.types import Instant, after

T0 = Instant(5_000_000_000)
HOME = Pose(-0.2, 0.0, 0.0)


class Bench:
    """Supervisor, gate and a finger that obeys, in lockstep at 100 Hz."""

    def __init__(
        self,
        strategy: str | Strategy = "straight",
        p: Parameters = HARDWARE,
        *,
        pose: tuple[float, float, float] = (-0.2, 0.0, 0.0),
        home: Pose | None = None,
        **how: Any,
    ) -> None:
        made = (
            load_strategy(strategy, p, np.random.default_rng(1))
            if isinstance(strategy, str)
            else strategy
        )
        self.p = p
        self.supervisor = Supervisor(made, p, home, **how)
        self.gate = SafetyGate(p.safety)
        self.now = T0
        self.x, self.y, self.heading = pose
        self.mode, self.stuck, self.force = "ready", False, 0.0
        self.feel: dict = {}
        self.states: list[State] = []
        self.twist = ZERO
        assert self.gate.arm(T0, self.touch(), self.arm(), T0) == ()

    def touch(self) -> Touch:
        calm = Touch(self.now, self.now, True, 0.0, Side.NONE, 0.0, 0.0, 0.0, 0.0)
        return replace(calm, **self.feel)

    def arm(self) -> ArmState:
        limits = self.p.safety.arm_limits
        force = self.force or (-5.0 if self.stuck else 0.0)  # a stuck finger is under load
        return ArmState(
            self.now, self.now, self.x, self.y, self.heading, self.twist, force, 0.0, 0.0,
            self.mode, limits.v_max, limits.omega_max, limits.f_max, limits.m_max,
        )  # fmt: skip

    def cycle(self) -> tuple[Intervention, ...]:
        command = self.supervisor.step(self.touch(), self.arm(), self.now)
        decision = self.gate.step(
            command.wanted,
            self.touch(),
            self.arm(),
            command.goal,
            self.now,
            failure=command.failure,
        )
        new = self.supervisor.observe(decision, self.now)
        self.twist = ZERO if self.stuck else decision.twist
        self.x += self.twist.vx * 0.01
        self.y += self.twist.vy * 0.01
        self.heading += self.twist.omega * 0.01
        self.now = after(self.now, 0.01)
        if not self.states or self.states[-1] is not self.supervisor.state:
            self.states.append(self.supervisor.state)
        return new

    def run(self, seconds: float, until: State | None = None) -> None:
        for _ in range(round(seconds / 0.01)):
            self.cycle()
            if self.supervisor.state is until:
                return
        assert until is None, f"never {until}: {self.supervisor.status(self.now)}"

    def go(self, x: float = 0.1, y: float = 0.03, **how: float) -> None:
        assert self.supervisor.request_goal(make_goal(x, y, self.p, **how), self.now) is None

    @property
    def outcome(self) -> Outcome:
        assert self.supervisor.outcome is not None
        return self.supervisor.outcome

    @property
    def tip(self) -> tuple[float, float]:
        return self.x + 0.158 * math.cos(self.heading), self.y + 0.158 * math.sin(self.heading)


def test_complete_trial_from_homing_to_success() -> None:
    bench = Bench(home=HOME, pose=(-0.25, 0.05, 0.1))
    bench.cycle()
    bench.go()
    bench.run(20.0, State.RESETTING)
    assert bench.states == [State.IDLE, State.HOMING, State.REACHING, State.RESETTING]
    outcome = bench.outcome
    assert outcome.success
    assert outcome.reason is Reason.REACHED
    assert outcome.distance <= 0.0075
    assert math.hypot(bench.tip[0] - 0.1, bench.tip[1] - 0.03) < 0.0085
    # 14.5 cm minus the circle at 4.5 cm/s, a moment to start, half speed in the last 2.5 mm.
    assert outcome.time == pytest.approx((0.1451 - 0.01) / 0.045 + 0.0025 / 0.0225, abs=0.15)
    bench.run(1.0)
    assert bench.twist == ZERO, "it waits, holding still, to be reset"
    assert bench.supervisor.status(bench.now).activity == "waiting for a reset"
    assert bench.supervisor.request_reset(bench.now) is None
    bench.run(30.0, State.IDLE)
    assert (bench.x, bench.y, bench.heading) == pytest.approx((-0.2, 0.0, 0.0), abs=0.02)
    assert math.hypot(bench.x + 0.2, bench.y) < 0.0021
    bench.go(0.1, -0.03)
    assert bench.supervisor.outcome is None
    bench.run(20.0, State.RESETTING)
    assert bench.outcome.success, "and it is ready for another"


def test_without_home_trial_starts_and_ends_in_place() -> None:
    bench = Bench(pose=(-0.21, 0.02, 0.05))
    bench.go()
    bench.cycle()
    assert bench.supervisor.state is State.REACHING
    bench.run(20.0, State.RESETTING)
    there = bench.x
    bench.supervisor.request_reset(bench.now)
    bench.run(0.05, State.IDLE)
    assert bench.x == there


def test_trial_resets_automatically_when_configured() -> None:
    bench = Bench(home=HOME, auto_reset=True)
    bench.go()
    bench.run(60.0, State.RESETTING)
    bench.run(60.0, State.IDLE)
    assert bench.outcome.success
    assert bench.x == pytest.approx(-0.2, abs=0.0021)


def test_unreachable_target_times_out_with_the_reason() -> None:
    """Row 36: zero at t_tot, with the reason."""
    bench = Bench()
    bench.stuck = True
    bench.go(time_limit=2.0)
    bench.run(1.99)
    assert bench.supervisor.state is State.REACHING
    bench.run(0.03, State.RESETTING)
    assert bench.twist == ZERO
    outcome = bench.outcome
    assert (outcome.success, outcome.reason) == (False, Reason.TIMEOUT)
    assert outcome.time == pytest.approx(2.0)
    assert "not reached within 2 s" in outcome.text
    assert outcome.distance == outcome.closest == pytest.approx(math.hypot(0.142, 0.03))


@pytest.mark.parametrize(("distance", "reached"), [(0.0074, True), (0.0076, False)])
def test_success_requires_the_tip_in_the_circle(distance: float, reached: bool) -> None:
    bench = Bench(pose=(-0.058 - distance, 0.03, 0.0))
    bench.stuck = True
    bench.go(0.1, 0.03)
    bench.run(0.05)
    assert (bench.supervisor.outcome is not None) == reached


@pytest.mark.parametrize(("p", "reached"), [(HARDWARE, True), (AUTHORS_SIM, False)])
def test_success_counts_during_an_excavation(p: Parameters, reached: bool) -> None:
    """Not tested in the authors' simulator; the paper makes no exception."""
    bench = Bench("excavate", replace(p, trigger_interval=0.1))
    bench.stuck = True
    bench.go(0.1, 0.03)
    bench.run(0.5)
    assert bench.supervisor.status(bench.now).activity.startswith("excavate")
    bench.x, bench.y, bench.heading = 0.1 - 0.158, 0.03, 0.0
    bench.run(0.5)
    assert (bench.supervisor.outcome is not None) == reached
    bench.run(5.0)
    assert bench.outcome.success, "at the latest when the excavation has ended"


def test_stop_ends_each_state() -> None:
    bench = Bench(home=Pose(-0.3, 0.0, 0.0))
    assert "nothing to stop" in str(bench.supervisor.request_stop(bench.now))
    bench.go()
    bench.run(0.5)
    assert bench.supervisor.state is State.HOMING
    assert bench.twist != ZERO
    assert bench.supervisor.request_stop(bench.now) is None
    bench.cycle()
    assert (bench.supervisor.state, bench.twist) == (State.IDLE, ZERO)
    assert bench.supervisor.outcome is None
    bench.go()
    bench.run(20.0, State.REACHING)
    bench.run(0.5)
    assert bench.supervisor.request_stop(bench.now) is None
    bench.cycle()
    assert (bench.supervisor.state, bench.twist) == (State.RESETTING, ZERO)
    assert (bench.outcome.reason, bench.outcome.success) == (Reason.STOPPED, False)
    bench.supervisor.request_reset(bench.now)
    bench.run(0.3)
    assert bench.twist != ZERO
    bench.supervisor.request_stop(bench.now)
    bench.run(0.3)
    assert (bench.supervisor.state, bench.twist) == (State.RESETTING, ZERO)


def test_out_of_order_requests_are_refused_with_a_reason() -> None:
    bench = Bench()
    assert "idle" in str(bench.supervisor.request_reset(bench.now))
    bench.go()
    bench.run(0.1)
    goal = make_goal(0.1, 0.0, HARDWARE)
    assert "reaching" in str(bench.supervisor.request_goal(goal, bench.now))
    assert "reaching" in str(bench.supervisor.request_reset(bench.now))


def test_latch_ends_the_reach_with_its_reason() -> None:
    bench = Bench(auto_reset=True, home=HOME, pose=(-0.23, 0.0, 0.0))
    bench.go()
    bench.run(5.0, State.REACHING)
    bench.run(1.0)
    bench.mode = "estop"
    bench.cycle()
    assert bench.twist == ZERO
    assert bench.supervisor.state is State.RESETTING
    assert bench.outcome.reason is Reason.HELD
    assert "estop" in bench.outcome.text
    assert bench.outcome.interventions == {"acceleration": 1, "arm_mode": 1}, "of the reach alone"
    bench.mode = "ready"
    bench.run(1.0)
    assert bench.twist == ZERO, "the arm is not brought home after a latch"
    bench.now = after(bench.now, 0.01)
    assert bench.gate.arm(bench.now, bench.touch(), bench.arm(), bench.now) == ()
    bench.supervisor.request_reset(bench.now)
    bench.run(20.0, State.IDLE)


def test_latch_ends_homing() -> None:
    bench = Bench(home=Pose(-0.3, 0.1, 0.0))
    bench.go()
    bench.run(0.3)
    bench.mode = "fault"
    bench.cycle()
    assert bench.supervisor.state is State.IDLE
    assert "fault" in bench.supervisor.status(bench.now).text


class Failing:
    """Fails at its start or at its hundredth step."""

    activity = "failing"

    def __init__(self, answer: Any, at_start: bool = False) -> None:
        self.answer, self.at_start, self.steps = answer, at_start, 0

    def start(self, goal: Goal, now: Instant) -> None:
        if self.at_start:
            raise ValueError("cannot start")

    def step(self, *inputs: object) -> Any:
        self.steps += 1
        if self.steps < 100:
            return Twist(0.02, 0.0, 0.0)
        if isinstance(self.answer, Exception):
            raise self.answer
        return self.answer


@pytest.mark.parametrize(
    ("strategy", "words", "code"),
    [
        (Failing(ZeroDivisionError("oops")), "ZeroDivisionError: oops", "strategy_failed"),
        (Failing(None), "NoneType", "strategy_failed"),
        (Failing(Twist(math.nan, 0.0, 0.0)), "not finite", "command_not_finite"),
        (Failing(None, at_start=True), "cannot start", "strategy_failed"),
    ],
)
def test_failing_strategy_stops_the_arm_and_latches(
    strategy: Strategy, words: str, code: str
) -> None:
    """Row 18."""
    bench = Bench(strategy)
    bench.go()
    bench.run(2.0)
    assert bench.twist == ZERO
    assert bench.gate.held is not None
    assert bench.gate.held.code == code
    assert bench.outcome.reason is Reason.HELD
    assert words in bench.outcome.text
    assert bench.outcome.interventions[code] == 1


def test_outcome_reports_forces_excavations_and_interventions() -> None:
    p = parameters("hardware", {"trigger_interval": 1.0, "excavate_duration": 1.0})
    bench = Bench("hybrid_clock", p)
    bench.go(time_limit=4.5)
    bench.stuck = True
    bench.run(1.0)
    bench.feel = {"peak_force": 6.5}
    bench.force = -9.0
    bench.run(0.2)
    bench.feel = {"peak_force": 99.0, "valid": False}
    bench.run(0.1)
    bench.feel = {"peak_force": math.nan}
    bench.run(0.05)
    bench.feel, bench.force = {}, -3.0
    bench.run(4.0, State.RESETTING)
    outcome = bench.outcome
    assert outcome.peak_force == 6.5
    assert outcome.peak_load == 9.0
    assert [e.trigger for e in outcome.excavations] == ["clock", "clock"]
    assert [e.at for e in outcome.excavations] == pytest.approx([1.01, 3.02])
    assert outcome.count() == outcome.count(trigger="clock") == 2
    assert outcome.count("cw") + outcome.count("ccw") == 2
    assert outcome.count(trigger="push") == 0
    assert outcome.interventions["acceleration"] >= 1
    assert bench.supervisor.status(bench.now).outcome is outcome


def test_missing_input_holds_the_arm_while_time_runs() -> None:
    bench = Bench()
    assert bench.supervisor.step(None, None, T0).wanted == ZERO
    bench.go(time_limit=1.0)
    assert bench.supervisor.step(None, None, T0).wanted == ZERO
    assert bench.supervisor.state is State.HOMING, "no pose, no start"
    bench.cycle()
    assert bench.supervisor.step(None, bench.arm(), bench.now).wanted == ZERO
    assert bench.supervisor.step(bench.touch(), None, bench.now).wanted == ZERO
    late = after(bench.now, 1.1)
    assert bench.supervisor.step(None, None, late).wanted == ZERO
    assert bench.outcome.reason is Reason.TIMEOUT


def test_interventions_are_reported_when_they_begin() -> None:
    bench = Bench()
    bench.go()
    told = [i.code for _ in range(30) for i in bench.cycle()]
    assert told == [Check.ACCELERATION], "once, though it goes on for ten cycles"
    onsets = Onsets()
    stale = Intervention(Check.ARM_STALE, "stopped", "x")
    late = Intervention(Check.LOOP_LATE, "stopped", "y")
    assert onsets.update([stale]) == (stale,)
    assert onsets.update([stale, late]) == (late,)
    assert onsets.update([]) == ()
    assert onsets.update([stale]) == (stale,)
    assert onsets.counts == {"arm_stale": 2, "loop_late": 1}


def test_homing_times_out() -> None:
    for resetting in (False, True):
        bench = Bench(home=Pose(-0.3, 0.0, 0.0))
        if resetting:
            bench.go()
            bench.run(60.0, State.RESETTING)
            bench.supervisor.request_reset(bench.now)
        else:
            bench.go()
        bench.stuck = True
        bench.run(1.0)
        bench.now = after(bench.now, HOMING_LIMIT)
        bench.cycle()
        bench.cycle()
        status = bench.supervisor.status(bench.now)
        assert status.state is (State.RESETTING if resetting else State.IDLE)
        assert "by hand" in status.text
        assert bench.twist == ZERO


def test_time_spent_idle_counts_from_the_first_cycle() -> None:
    supervisor = Supervisor(load_strategy("straight", HARDWARE, np.random.default_rng(1)), HARDWARE)
    assert supervisor.status(T0).elapsed == 0.0
    supervisor.step(None, None, T0)
    assert supervisor.status(after(T0, 1.5)).elapsed == pytest.approx(1.5)
