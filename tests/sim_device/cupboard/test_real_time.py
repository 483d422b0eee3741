"""World and arm with a clock that is late, stops, and goes on; the tests set the clock."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from sim_device.arm.arm import FACTORY_LIMITS, ArmSettings
from sim_device.arm.cupboard import MAX_CATCH_UP_S, Cupboard, NotNow
from sim_device.arm.server import parse_arm_faults
from sim_device.world.mujoco_world import MujocoWorld
from sim_device.world.scenes import Scene
from tactile_core.types import ARM_LIMITS, ArmState, Instant, Twist, after, seconds_between

T0 = Instant(7_000_000_123)
AHEAD = Twist(0.05, 0.0, 0.0)


def made(scene: Scene, faults: str = "", settings: ArmSettings | None = None) -> Cupboard:
    cupboard = Cupboard(
        MujocoWorld(scene),
        settings or ArmSettings(),
        parse_arm_faults(faults),
        np.random.default_rng(1),
    )
    cupboard.begin(T0)
    cupboard.request_limits(ARM_LIMITS["authors_sim"])
    return cupboard


def run(cupboard: Cupboard, start: float, end: float, twist: Twist | None = None) -> list[ArmState]:
    """Tick every ms from ``start`` to ``end`` s, with a command every 10 ms."""
    states = []
    for ms in range(round(start * 1000), round(end * 1000)):
        now = after(T0, ms / 1000)
        states += cupboard.advance(now)
        if twist is not None and ms % 10 == 0:
            cupboard.command(twist, now, waited=0.001)
    return states


def moving(state: ArmState) -> bool:
    return abs(state.twist.vx) > 1e-4


def test_states_come_on_a_grid_of_their_rate(scene: Scene) -> None:
    states = run(made(scene), 0, 0.5)
    gaps = {b.captured - a.captured for a, b in itertools.pairwise(states)}
    assert gaps == {10_000_000}
    assert len(states) == 49


def test_arm_rests_within_100_ms_of_the_last_command_even_if_served_late(
    scene: Scene,
) -> None:
    for stall in (0.001, 0.02, 0.06, 0.2, 3.0):
        cupboard = made(scene)
        run(cupboard, 0, 0.3, AHEAD)
        last = after(T0, 0.29)
        states = cupboard.advance(after(T0, 0.3 + stall)) + run(
            cupboard, 0.301 + stall, 0.8 + stall
        )
        still = [s.captured for s in states if moving(s)]
        assert still
        assert seconds_between(last, max(still)) <= 0.1
        stood = cupboard.world.finger().x
        run(cupboard, 0.8 + stall, 1.2 + stall)
        assert cupboard.world.finger().x == pytest.approx(stood, abs=1e-6)


def test_missed_steps_are_caught_up_in_order_and_counted(scene: Scene) -> None:
    steady, late = made(scene), made(scene)
    whole = run(steady, 0, 0.4)
    first = run(late, 0, 0.1)
    held_up = late.advance(after(T0, 0.3)) + run(late, 0.301, 0.4)
    assert first + held_up == whole
    assert steady.counters["late_steps"] == 0
    assert 38 <= late.counters["late_steps"] <= 40
    assert late.counters["suspended_ms"] == 0


def test_long_stop_suspends_the_world_and_stamps_follow_the_clock(scene: Scene) -> None:
    cupboard = made(scene)
    before = run(cupboard, 0, 0.2, AHEAD)
    states = cupboard.advance(after(T0, 60.0))
    assert cupboard.counters["suspended_ms"] == pytest.approx(
        1000 * (60 - 0.2 - MAX_CATCH_UP_S), abs=6
    )
    assert states[-1].captured <= before[-1].captured + round(1e9 * (MAX_CATCH_UP_S + 0.01))
    assert not moving(states[-1])
    where = cupboard.world.finger().x
    after_it = run(cupboard, 60.001, 60.3)
    assert all(s.captured > after(T0, 60.0) for s in after_it[1:])
    assert after_it[-1].x == pytest.approx(where, abs=1e-6)
    assert len(after_it) == pytest.approx(30, abs=1)


def test_command_expired_while_waiting_is_not_obeyed(scene: Scene) -> None:
    cupboard = made(scene)
    run(cupboard, 0, 0.1)
    now = after(T0, 0.1)
    cupboard.advance(now)
    assert not cupboard.command(AHEAD, now, waited=0.06)
    assert cupboard.counters["late_commands"] == 1
    assert not any(moving(s) for s in run(cupboard, 0.101, 0.3))
    assert cupboard.command(AHEAD, after(T0, 0.3), waited=0.0)


def test_faults_start_and_end_by_the_clock(scene: Scene) -> None:
    cupboard = made(scene, "silent@0.2s+0.2s,estop@0.6s,biased@1s")
    first = run(cupboard, 0, 0.5, AHEAD)
    stamps = [seconds_between(T0, s.captured) for s in first]
    assert not any(0.205 < s < 0.395 for s in stamps)
    assert max(stamps) > 0.45
    pressed = run(cupboard, 0.5, 0.75, AHEAD)
    assert pressed[-1].mode == "estop"
    with pytest.raises(NotNow, match="still there"):
        cupboard.clear()
    stopped = run(cupboard, 0.75, 1.1, AHEAD)
    assert {s.mode for s in stopped} == {"estop"}  # latched though the button is out
    assert not any(moving(s) for s in stopped[5:])
    assert stopped[-1].fx == pytest.approx(stopped[0].fx + 3.0, abs=0.01)
    assert cupboard.clear() == "ready"
    assert any(moving(s) for s in run(cupboard, 1.1, 1.3, AHEAD))


def test_reset_restores_everything_but_limits_and_stops(scene: Scene) -> None:
    cupboard = made(scene, "fault@1.5s")
    run(cupboard, 0, 1.2, AHEAD)
    assert cupboard.contacts()
    with pytest.raises(NotNow, match="moving"):
        cupboard.reset(MujocoWorld(scene))
    run(cupboard, 1.2, 1.4)
    accepted = cupboard.counters["accepted"]
    cupboard.reset(MujocoWorld(scene))
    states = run(cupboard, 1.4, 1.48)
    assert states[0].x == pytest.approx(scene.start.x, abs=1e-6)
    assert states[0].f_max == ARM_LIMITS["authors_sim"].f_max
    assert cupboard.contacts() == []
    assert cupboard.counters["accepted"] == accepted
    run(cupboard, 1.48, 2.0)
    cupboard.reset(MujocoWorld(scene))
    assert run(cupboard, 2.0, 2.1, AHEAD)[-1].mode == "fault"
    assert cupboard.clear() == "ready"


def test_arm_refusing_limits_confirms_its_own_after_reset(scene: Scene) -> None:
    cupboard = made(scene, "refuses_limits")
    assert cupboard.request_limits(ARM_LIMITS["hardware"]) == FACTORY_LIMITS
    cupboard.reset(MujocoWorld(scene))
    assert cupboard.request_limits(ARM_LIMITS["hardware"]) == FACTORY_LIMITS


def test_latency_delays_commands_and_states(scene: Scene) -> None:
    slow = made(scene, settings=ArmSettings(command_latency=0.03, state_latency=0.03))
    states = run(slow, 0, 0.2, AHEAD)
    assert {s.received - s.captured for s in states} == {30_000_000}
    begun = next(s for s in states if moving(s))
    assert seconds_between(T0, begun.captured) >= 0.03
