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

NOTICED = 0.25
"""s in which a robot that goes elsewhere than told is at rest: it must first have gone 2 mm."""

LONGER: dict[Any, float] = {
    "mirror": NOTICED,
    # Its protocol knows no age: the one velocity that was on its way when the network stood still
    # is obeyed afterwards, until the rest that follows it.
    ("xarm", "freeze 0.5"): 0.6,
}

FARTHEST = 0.008
"""m from the fault to the rest."""

RUNS = range(int(os.environ.get("ARMS_RUNS", "1")))

FAULTS = {
    "protective_stop": ("fault", "release"),
    "estop": ("estop", "release"),
    "stop_program": ("stopped", "true"),
    "nan": ("fault", "numbers"),
    "freeze 0.5": ("fault", "true"),
    "mirror": ("fault", "true"),
}
"""What befalls the robot in motion: the mode it ends in, and what takes its cause away."""


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("run", RUNS)
def test_a_fault_in_motion(
    robot_rig: Any, fault: str, run: int, wait: Callable[..., None], distances: Any
) -> None:
    rig, (mode, remedy) = robot_rig, FAULTS[fault]
    commander = rig.commander
    rig.moving()
    at = rig.robot.fault(fault)
    wait(lambda: commander.mode == mode and commander.status()["reason"], f"{mode} after {fault}")
    commander.twist = Twist(0.03, 0.0, 0.0)
    within = LONGER.get((rig.driver, fault), LONGER.get(fault, WITHIN))
    time.sleep(0.7 if fault.startswith("freeze") else within + 0.2)  # told to move on
    gone = rig.robot.stopped(at, within)
    assert gone < FARTHEST
    distances(rig.driver, fault, gone)
    assert commander.mode == mode
    assert commander.status()["reason"]
    rig.robot.fault(remedy)
    rest = rig.robot.truth()[-1][0]
    time.sleep(0.3)
    rig.robot.stopped(rest, 0.02)  # nor when the cause has gone
    rig.moving()


@pytest.mark.parametrize("run", RUNS)
def test_a_commander_who_falls_silent(
    robot_rig: Any, run: int, wait: Callable[..., None], distances: Any
) -> None:
    rig = robot_rig
    rig.moving()
    rig.commander.silent = True
    at = rig.robot.fault("mark")
    wait(lambda: rig.commander.mode == "stopped", "stopped")
    time.sleep(0.3)
    # What was sent just before was on its way still.
    distances(rig.driver, "commander silent", rig.robot.stopped(at, WITHIN + 0.01))


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGSTOP], ids=["SIGKILL", "SIGSTOP"])
@pytest.mark.parametrize("run", RUNS)
def test_armd_is_killed_or_stopped(
    robot_rig: Any, how: signal.Signals, run: int, distances: Any
) -> None:
    rig = robot_rig
    rig.moving()
    at = rig.robot.fault("mark")
    rig.armd.process.send_signal(how)
    time.sleep(0.4)
    distances(rig.driver, f"armd {how.name}", rig.robot.stopped(at, WITHIN + 0.02))
    rig.armd.process.send_signal(signal.SIGCONT)
    time.sleep(0.3)
    rest = rig.robot.truth()[-1][0]
    time.sleep(0.2)
    if how == signal.SIGKILL:
        rig.robot.stopped(rest, 0.02)
    rig.restart()
    rig.moving()


def test_the_robots_server_stands_still(robot_rig: Any, wait: Callable[..., None]) -> None:
    rig = robot_rig
    rig.moving()
    rig.robot.process.send_signal(signal.SIGSTOP)
    try:
        wait(lambda: rig.commander.mode == "fault", "a fault")
        assert "no new state" in rig.commander.status()["reason"] or rig.driver == "xarm"
    finally:
        rig.robot.process.send_signal(signal.SIGCONT)
    rig.moving()


def test_a_second_commander_is_refused_and_not_obeyed(
    rig: Any, second: Any, wait: Callable[..., None]
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


def test_limits_are_confirmed_as_they_are_kept(rig: Any, wait: Callable[..., None]) -> None:
    given = rig.commander.limit(ArmLimits(v_max=0.02, omega_max=0.1, f_max=50.0, m_max=4.5))
    assert given == ArmLimits(v_max=0.02, omega_max=0.1, f_max=20.0, m_max=4.5), "the file's cap"
    rig.commander.twist = Twist(0.0, 0.0, 0.0)
    wait(lambda: (rig.commander.state.v_max, rig.commander.state.f_max) == (0.02, 20.0), "limits")
    x = rig.commander.state.x
    rig.commander.twist = Twist(-0.04 if x > -0.1 else 0.04, 0.0, 0.0)
    time.sleep(0.4)
    assert abs(rig.commander.state.twist.linear.x) < 0.021
    rig.commander.twist = Twist(0.0, 0.0, 0.0)
    rig.commander.limit()


def test_nothing_moves_before_limits_were_asked_for(rig: Any, wait: Callable[..., None]) -> None:
    commander = rig.commander
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


def test_the_robots_server_is_killed(robot_rig: Any, wait: Callable[..., None]) -> None:
    """Last of all, for there is no robot any more after it."""
    rig = robot_rig
    rig.moving()
    rig.robot.process.kill()
    wait(
        lambda: rig.commander.mode == "fault" or rig.armd.process.poll() is not None,
        "a fault, or the end of armd",
    )
