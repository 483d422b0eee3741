"""Every driver against every fault: at rest within 0.1 s of the robot's time, latched, the reason
said, and nothing goes on without the operator."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable
from typing import Any

import pytest

from tactile_core.bus.services import ServiceError
from tactile_core.types import ArmLimits, Twist

pytestmark = pytest.mark.skipif(
    "ARMS_RUNS" not in os.environ, reason="drives emulated robots in real time: `make arms`"
)

WITHIN = 0.1
"""s of the robot's time."""

ON_ITS_WAY = 0.02
"""s in which a command that was sent right before a fault still arrives."""

NOTICED = 0.25
"""s in which a robot that goes elsewhere than told is at rest: it must first have gone 2 mm."""

SLOW = "slow 0.3 0.4"
"""A network whose delay grows by 0.3 s a second, up to 0.4 s."""

LONGER: dict[Any, float] = {
    "mirror": NOTICED,
    # Noticed when states are 50 ms old, which takes 0.17 s; the rest takes as long to arrive.
    SLOW: 0.6,
    # Its protocol knows no age: the one velocity that was on its way when the network stood still
    # is obeyed afterwards, until the rest that follows it.
    ("xarm", "freeze 0.5"): 0.6,
    # A pose that lies 0.1 s ahead is still gone to when all that follows is lost; and what was on
    # its way when the network stood still is gone to afterwards, and back again at 5 mm/s.
    "flexiv": 0.2,
    # Slower than real time, and only our clock is at hand.
    "franka": 0.5,
    ("flexiv", "freeze 0.5"): 1.5,
    ("flexiv", "mirror"): 0.6,
    ("flexiv", SLOW): 1.0,
}

FARTHEST = 0.012
"""m from the fault to the rest."""

RUNS = range(int(os.environ.get("ARMS_RUNS", "1")))

FAULTS = {
    "protective_stop": ("protective stop", "fault", "release"),
    "estop": ("emergency stop", "estop", "release"),
    "stop_program": ("program stopped at the robot", "stopped", "true"),
    "nan": ("NaN in the state", "fault", "numbers"),
    "freeze 0.5": ("network stands still for 0.5 s", "fault", "true"),
    SLOW: ("network ever slower", "fault", "slow 0 0"),
    "mirror": ("base frame mirrored", "fault", "true"),
}
"""What befalls the robot in motion: its name, the mode it ends in, what takes its cause away."""


def within(driver: str, fault: str = "") -> float:
    return max(LONGER.get(key, WITHIN) for key in ((driver, fault), fault, driver))


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("run", RUNS)
def test_fault_in_motion_stops_and_latches(
    robot_rig: Any, fault: str, run: int, wait: Callable[..., None], note: Any
) -> None:
    rig, (name, mode, remedy) = robot_rig, FAULTS[fault]
    commander = rig.commander
    rig.moving()
    at = rig.robot.fault(fault)
    try:
        wait(lambda: commander.mode == mode and commander.status()["reason"], f"{mode}, {fault}")
        commander.twist = Twist(0.03, 0.0, 0.0)
        allowed = within(rig.driver, fault)
        time.sleep(max(0.7, allowed + 0.3))  # told to move on
        rest = rig.robot.stopped(at, allowed)
        assert rest.metres < FARTHEST
        assert commander.mode == mode
        assert commander.status()["reason"]
    finally:
        rig.robot.fault(remedy)
    gone = rig.robot.truth()[-1][0]
    time.sleep(0.5)
    rig.robot.stopped(gone, 0.02)  # nor when the cause has gone
    note(rig.driver, name, rest)
    rig.moving()


@pytest.mark.parametrize("run", RUNS)
def test_silent_commander_stops_the_robot(
    rig: Any, run: int, wait: Callable[..., None], note: Any
) -> None:
    rig.moving()
    rig.commander.silent = True
    at = rig.mark()
    wait(lambda: rig.commander.mode == "stopped", "stopped")
    allowed = within(rig.driver) + ON_ITS_WAY
    time.sleep(allowed + 0.2)
    rest = rig.stopped(at, allowed)
    note(rig.driver, "commander silent", rest)


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGSTOP], ids=["SIGKILL", "SIGSTOP"])
@pytest.mark.parametrize("run", RUNS)
def test_commanding_process_killed_or_stopped(
    rig: Any, how: signal.Signals, run: int, commanding: Callable[[Any], Any], note: Any
) -> None:
    """A process of its own streams commands, as reachd does; a test of reachd itself is below."""
    process = commanding(rig)
    try:
        at = rig.mark()
        process.send_signal(how)
        time.sleep(0.6)
        rest = rig.stopped(at, within(rig.driver) + ON_ITS_WAY)
        note(rig.driver, f"commander {how.name}", rest)
    finally:
        process.kill()
        process.wait()
        rig.claim()
    rig.moving()


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGSTOP], ids=["SIGKILL", "SIGSTOP"])
@pytest.mark.parametrize("run", RUNS)
def test_armd_killed_or_stopped(robot_rig: Any, how: signal.Signals, run: int, note: Any) -> None:
    rig = robot_rig
    rig.moving()
    at = rig.robot.fault("mark")
    rig.armd.process.send_signal(how)
    time.sleep(0.5)
    note(rig.driver, f"armd {how.name}", rig.robot.stopped(at, within(rig.driver) + ON_ITS_WAY))
    rig.armd.process.send_signal(signal.SIGCONT)
    time.sleep(0.3)
    rest = rig.robot.truth()[-1][0]
    time.sleep(0.2)
    if how == signal.SIGKILL:
        rig.robot.stopped(rest, 0.02)
    rig.restart()
    rig.moving()


def test_frozen_server_latches(robot_rig: Any, wait: Callable[..., None], note: Any) -> None:
    rig = robot_rig
    rig.moving()
    rig.robot.process.send_signal(signal.SIGSTOP)
    try:
        wait(lambda: rig.commander.mode == "fault", "a fault")
        assert "no new state" in rig.commander.status()["reason"] or rig.driver == "xarm"
    finally:
        rig.robot.process.send_signal(signal.SIGCONT)
    note(rig.driver, "robot's server frozen")
    rig.moving()


def test_second_commander_is_refused_and_not_obeyed(
    rig: Any, second: Any, wait: Callable[..., None], note: Any
) -> None:
    rig.moving()
    with pytest.raises(ServiceError, match="commanded by another"):
        second.claim()
    second.signer = rig.commander.signer.__class__(
        type("Grant", (), {"commander": rig.commander.signer.commander, "key": "00" * 32})()
    )
    second.twist = Twist(0.0, 0.04, 0.0)
    y = rig.commander.state.y
    wait(lambda: rig.commander.status()["counters"]["forged"] > 10, "forged commands")
    assert rig.commander.state.y == pytest.approx(y, abs=1e-4)
    note(rig.driver, "second commander")


def test_limits_are_confirmed_as_they_are_kept(
    rig: Any, wait: Callable[..., None], note: Any
) -> None:
    given = rig.commander.limit(ArmLimits(v_max=0.02, omega_max=0.1, f_max=50.0, m_max=4.5))
    cap = rig.f_max
    assert given == ArmLimits(v_max=0.02, omega_max=0.1, f_max=cap, m_max=4.5), "the file's cap"
    rig.commander.twist = Twist(0.0, 0.0, 0.0)
    wait(lambda: (rig.commander.state.v_max, rig.commander.state.f_max) == (0.02, cap), "limits")
    x = rig.commander.state.x
    rig.commander.twist = Twist(-0.04 if x > -0.1 else 0.04, 0.0, 0.0)
    time.sleep(0.4)
    assert abs(rig.commander.state.twist.linear.x) < 0.021
    rig.commander.twist = Twist(0.0, 0.0, 0.0)
    rig.commander.limit()
    note(rig.driver, "limits beyond its own")


def test_nothing_moves_before_limits_were_asked_for(
    served: Any, wait: Callable[..., None], note: Any
) -> None:
    rig, commander = served, served.commander
    rig.moving()
    rig.resting()
    commander.ask("release")
    commander.claim()
    x = commander.state.x
    commander.twist = Twist(0.03, 0.0, 0.0)
    wait(lambda: rig.unlatched() and commander.status()["counters"]["no_limits"] > 3, "refusals")
    assert commander.state.x == pytest.approx(x, abs=1e-3)
    commander.limit()
    rig.moving()
    note(rig.driver, "limits not asked for")


def test_robot_that_refuses_limits_does_not_move(
    flexiv_rig: Any, wait: Callable[..., None], note: Any
) -> None:
    """Only this one keeps a limit itself, and may refuse it."""
    rig, commander = flexiv_rig, flexiv_rig.commander
    rig.moving()
    rig.resting()
    commander.ask("release")
    commander.claim()
    rig.robot.fault("refuse_limits")
    time.sleep(0.1)
    with pytest.raises(ServiceError, match="refuses the limits"):
        commander.limit()
    x = commander.state.x
    commander.twist = Twist(0.03, 0.0, 0.0)
    accepted = commander.status()["counters"]["accepted"]
    wait(lambda: commander.status()["counters"]["accepted"] > accepted + 20, "commands")
    assert commander.state.x == pytest.approx(x, abs=1e-3)
    rig.robot.fault("accept_limits")
    time.sleep(0.1)
    commander.limit()
    rig.moving()
    note(rig.driver, "limits refused by the robot")


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGSTOP], ids=["SIGKILL", "SIGSTOP"])
@pytest.mark.parametrize("arm", ["simulated", "ur", "xarm"])
def test_reachd_killed_or_stopped_in_a_reach(
    reaching: Callable[[str], Any], arm: str, how: signal.Signals, note: Any,
    wait: Callable[..., None],
) -> None:  # fmt: skip
    """A whole rig: cupboard, board, tactiled, the arm and reachd, which is under way."""
    rig = reaching(arm)
    rig.reachd.send_signal(how)
    at = time.monotonic()
    wait(lambda: rig.rows and rig.rows[-1][0] - at > 1.0, "a second of states")
    rest = rig.stopped(at, WITHIN + ON_ITS_WAY)
    note(arm, f"reachd {how.name}", rest)
    if how == signal.SIGSTOP:
        on = time.monotonic()
        rig.reachd.send_signal(signal.SIGCONT)
        wait(lambda: rig.rows[-1][0] - on > 1.0, "a second of states")
        rig.stopped(on, ON_ITS_WAY)  # it does not go on by itself


def test_killed_server_latches(robot_rig: Any, wait: Callable[..., None], note: Any) -> None:
    """Last of all, for there is not any robot after it."""
    rig = robot_rig
    rig.moving()
    rig.robot.process.kill()
    wait(
        lambda: rig.commander.mode == "fault" or rig.armd.process.poll() is not None,
        "a fault, or the end of armd",
    )
    note(rig.driver, "robot's server killed")
