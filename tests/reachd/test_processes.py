"""reachd as a real process: a real bus, an arm that obeys, signals."""

from __future__ import annotations

import json
import signal
import time
from typing import Any

import pytest

from tactile_core.bus.messages import codec
from tactile_core.bus.services import ServiceError, declare_service
from tactile_core.bus.streams import declare_publisher
from tactile_core.bus.topics import FEATURES, service_key
from tactile_core.log.info import info
from tactile_core.log.recovery import recover
from tactile_core.types import ArmLimits
from tests.support.reachd_lab import TRIES
from tests.support.waiting import PATIENCE_S, wait_until

NEAR = ("--strategy", "straight", "--target", "0.04,0.0", "--seed", "1")
FAR = ("--strategy", "straight", "--target", "0.36,0.0", "--seed", "1")


def test_complete_reach_is_held_in_one_log_file(lab: Any, hardware_limits: ArmLimits) -> None:
    arm, _ = lab.arm, lab.board()
    asked: list[object] = []
    key = service_key("board0", "geometry")

    def publish_geometry(request: object) -> object:
        asked.append(request)
        return {}

    service = declare_service(arm.session, key, publish_geometry)
    words = ("--log", "trial.mcap", "--json", "outcome.json")
    program = lab.reach(*NEAR, *words, *lab.patient())
    assert program.wait() == 0, program.said
    outcome = json.loads((lab.folder / "outcome.json").read_text())
    assert outcome["success"] is True
    assert 1 <= len(asked) <= TRIES, "once by every reachd"
    service.close()
    assert outcome["distance"] <= 0.0075
    assert (outcome["strategy"], outcome["set"], outcome["seed"]) == ("straight", "hardware", 1)
    assert "REACHED: " in program.said
    # Limits were set and confirmed before anything moved, and every command obeyed them.
    assert arm.limits.f_max == hardware_limits.f_max
    assert all(abs(h.omega) <= 0.1 + 1e-9 for h in arm.heard)
    assert all((h.vx**2 + h.vy**2) ** 0.5 <= arm.limits.v_max + 1e-9 for h in arm.heard)
    lab.wait_until_told_to_stop()
    lab.wait_for_codes("outcome", "reached")
    assert lab.codes("outcome") == ["reached"]
    lab.wait_for_codes("operator", "limits", "arm", "goal")
    log = info(lab.folder / "trial.mcap")
    assert log.closed
    topics = {channel.topic for channel in log.channels}
    assert {
        "/tactile/board0/features",
        "/arm/arm/state",
        "/arm/arm/cmd_vel",
        "/reach/reach/state",
        "/reach/reach/event",
    } <= topics
    assert log.metadata["reachd"]["seed"] == "1"
    assert json.loads(log.metadata["outcome"]["json"])["reason"] == "reached"
    assert "parameters.json" in log.attachments


def test_silent_features_stop_the_arm_and_lost_features_end_the_reach(lab: Any) -> None:
    """Rows 4, 13, 14 and 19: a stopped, then a killed, tactiled."""
    _, board = lab.arm, lab.board()
    program = lab.reach(*FAR, "--no-log", *lab.patient("features_stale", "features_lost"))
    board.signal(signal.SIGSTOP)
    wait_until(lab.stopped)
    lab.wait_for_codes("intervention", "features_stale")
    board.signal(signal.SIGKILL)
    assert program.wait() == 1, program.said
    assert "NOT REACHED (held)" in program.said
    lab.wait_for_codes("intervention", "features_lost")
    lab.wait_until_told_to_stop()


def test_short_silence_only_pauses_the_reach(lab: Any) -> None:
    arm, board = lab.arm, lab.board()
    program = lab.reach(*FAR, "--no-log", *lab.patient("features_stale"))
    board.signal(signal.SIGSTOP)
    wait_until(lab.stopped)
    board.signal(signal.SIGCONT)
    wait_until(lambda: arm.moving)
    program.signal(signal.SIGTERM)
    assert program.wait() == 1


def test_lost_arm_state_stops_motion_and_ends_the_reach(lab: Any) -> None:
    """Row 24, and the latch after a second."""
    arm, _ = lab.arm, lab.board()
    program = lab.reach(*FAR, "--no-log", *lab.patient("arm_stale", "arm_lost"))
    arm.paused = True
    wait_until(lab.stopped)
    assert program.wait() == 1, program.said
    lab.wait_for_codes("intervention", "arm_stale", "arm_lost")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_sigterm_stops_arm_before_closing_log(lab: Any, number: signal.Signals) -> None:
    """Row 34."""
    arm, _ = lab.arm, lab.board()
    program = lab.reach(*FAR, "--log", "trial.mcap", *lab.patient())
    program.signal(number)
    assert program.wait() == 1, program.said
    assert "NOT REACHED (stopped)" in program.said
    lab.wait_until_told_to_stop()
    assert info(lab.folder / "trial.mcap").closed
    wait_until(lambda: not arm.moving)


def test_kill_9_stops_the_arm_and_a_new_reachd_starts(lab: Any) -> None:
    """Rows 15 and 29: nothing left of it blocks a restart."""
    arm, _ = lab.arm, lab.board()
    program = lab.reach(*FAR, "--log", "trial.mcap", *lab.patient())
    wait_until(lambda: (lab.folder / "trial.mcap").stat().st_size > 20_000)
    program.signal(signal.SIGKILL)
    program.wait()
    wait_until(lambda: not arm.moving)
    report = recover(lab.folder / "trial.mcap", lab.folder / "whole.mcap")
    assert report.messages > 0
    target = ("--strategy", "straight", "--target", f"{arm.x + 0.17},0")
    again = lab.reach(*target, "--no-log", *lab.patient())
    assert again.wait() == 0, again.said


def test_sigstop_and_sigcont_do_not_resume_motion(lab: Any) -> None:
    """Row 14 for reachd itself: the arm stops without it, and waits for an operator."""
    arm, _ = lab.arm, lab.board()
    program = lab.reach(
        *FAR, "--no-log", *lab.patient("features_stale", "features_lost", "arm_stale", "arm_lost")
    )
    program.signal(signal.SIGSTOP)
    time.sleep(1.5)
    assert not arm.moving
    count = len(arm.heard)
    program.signal(signal.SIGCONT)
    assert program.wait() == 1, program.said
    # Whichever was noticed first: the stalled loop or its old inputs.
    assert "stood still" in program.said or "features_lost" in program.said, program.said
    # A command that was on its way when it was stopped may still arrive; then only zero.
    assert sum(not h.still for h in arm.heard[count:]) <= 1


def test_goals_are_served_over_the_bus(lab: Any) -> None:
    """Goals, refusals, and rows 22, 26 and 35, with one daemon."""
    arm, _ = lab.arm, lab.board()
    program = lab.reachd("--serve", "--strategy", "straight", "--no-log", *lab.patient())
    wait_until(lambda: lab.ask("status")["features"]["accepted"] > 5)
    goal = {"x": 0.36, "y": 0.0}
    for service, request, words in (
        ("goal", goal, "not armed"),
        ("goal", {"x": 3.0, "y": 0.0}, "outside the region"),
        ("goal", {"x": "far"}, "bad request"),
        ("stop", None, "nothing to stop"),
        ("reset", None, "a reset follows a reach"),
    ):
        with pytest.raises(ServiceError, match=words):
            lab.ask(service, request)
    assert not any(not h.still for h in arm.heard)

    second = lab.reachd(*NEAR, "--no-log", listen="tcp/127.0.0.1:0")
    assert second.wait() == 3
    assert f"process {program.process.pid}" in second.said

    wait_until(lab.arms)
    lab.ask("goal", goal)
    wait_until(lambda: arm.moving)
    lab.ask("stop", {"reason": "enough"})
    wait_until(lab.stopped)
    status = lab.ask("status")
    assert (status["state"], status["armed"]) == ("resetting", True)
    assert status["outcome"]["text"] == "enough"
    lab.ask("reset")
    wait_until(lambda: lab.ask("status")["state"] == "idle")

    lab.ask("goal", goal)
    wait_until(lambda: arm.moving)
    arm.mode = "estop"
    wait_until(lambda: lab.ask("status")["held"] == "arm_mode")
    with pytest.raises(ServiceError, match="clear it at the arm"):
        lab.ask("arm")
    arm.mode = "ready"
    assert lab.ask("status")["armed"] is False  # the arm's health alone never arms it
    wait_until(lab.arms)
    lab.ask("reset")
    wait_until(lambda: lab.ask("status")["state"] == "idle")

    lab.ask("goal", goal)
    wait_until(lambda: arm.moving)
    forger = declare_publisher(arm.session, FEATURES, "board0")
    forger.put(b"forged", 0)
    wait_until(lambda: lab.ask("status")["held"] == "duplicate_publisher")
    wait_until(lambda: lab.stopped() or not arm.moving)
    wait_until(lab.arms)

    program.signal(signal.SIGTERM)
    assert program.wait() == 0, program.said
    lab.wait_until_told_to_stop()


def test_without_features_or_arm_no_reach_starts(lab: Any) -> None:
    """Row 23 as well: a replay does not count as a board."""
    lab.board(prefix="replay")
    for wait_s in (2, 10, 60):
        program = lab.reachd(*NEAR, "--no-log", "--wait", str(wait_s))
        assert program.wait() == 3
        if "boards on the bus: board0" in program.said:  # it may take its time to come
            break
    assert "no features came on tactile/board0/features" in program.said
    assert "boards on the bus: board0" in program.said
    assert "no state came on arm/arm/state" in program.said
    assert "Traceback" not in program.said


def test_remote_board_must_be_named(lab: Any) -> None:
    arm, _ = lab.arm, lab.board(ahead=500.0)
    for wait_s in (3, 10, 60):
        program = lab.reachd(*NEAR, "--no-log", "--wait", str(wait_s))
        assert program.wait() == 3
        if 'board_clock = "remote"' in program.said:  # its features may take their time to come
            break
    assert 'board_clock = "remote"' in program.said
    assert arm.travelled == 0.0
    remote = lab.patient(more='[inputs]\nboard_clock = "remote"\n')
    assert lab.reach(*NEAR, "--no-log", *remote).wait() == 0
    assert arm.travelled > 0.02


@pytest.mark.parametrize("trouble", ["limits", "bias", "fault", "broken log"])
def test_unfit_arm_is_not_armed(lab: Any, trouble: str) -> None:
    """Rows 26, 27 and 28: refused before anything moves."""
    arm, _ = lab.arm, lab.board()
    arm.deaf_to_limits = trouble == "limits"
    arm.force = (3.0, 0.0, 0.0) if trouble == "bias" else (0.0, 0.0, 0.0)
    arm.mode = "fault" if trouble == "fault" else "ready"
    log = ["--log", "/proc/nowhere"] if trouble == "broken log" else ["--no-log"]
    words = {
        "limits": "f_max is 100 N, 10.6066 asked",
        "bias": "3.00 N and 0.000 N·m in free air",
        "fault": "mode 'fault'",
        "broken log": "cannot write a log",
    }
    for _ in range(5):
        program = lab.reachd(*NEAR, *log, *lab.patient(), "--wait", str(PATIENCE_S))
        assert program.wait() == 3
        if words[trouble] in program.said:  # else an answer came late: that was said instead
            break
    assert words[trouble] in program.said
    assert "Traceback" not in program.said
    assert all(h.still for h in arm.heard)


def test_failing_or_hanging_strategy_stops_the_arm(lab: Any) -> None:
    """Row 18, and a strategy that never returns."""
    (lab.folder / "own.py").write_text(
        "import time\n"
        "from reachd.interfaces import Twist\n"
        "class Own:\n"
        "    activity = 'own'\n"
        "    def __init__(self, parameters, rng):\n"
        "        self.steps = 0\n"
        "    def start(self, goal, now):\n"
        "        pass\n"
        "    def step(self, touch, arm, goal, now):\n"
        "        self.steps += 1\n"
        "        if self.steps > 40:\n"
        "            self.trouble()\n"
        "        return Twist(0.04, 0.0, 0.0)\n"
        "    def trouble(self):\n"
        "        raise RuntimeError('lost my way')\n"
        "class Hung(Own):\n"
        "    def trouble(self):\n"
        "        while True:\n"
        "            time.sleep(1)\n"
    )
    arm, _ = lab.arm, lab.board()
    target = ("--target", "0.36,0.0", "--no-log", *lab.patient())
    failing = lab.reach("--strategy", "own:Own", *target)
    assert failing.wait() == 1
    assert "RuntimeError: lost my way" in failing.said
    assert arm.travelled > 0.0
    hung = lab.reach("--strategy", "own:Hung", *target)
    assert hung.wait() == 1
    assert "stuck" in hung.said
    lab.wait_until_told_to_stop()


def test_forged_bytes_never_crash_the_daemon(lab: Any) -> None:
    """Row 22: invalid or oversized messages are counted and not acted on."""
    lab.arm, lab.board()
    program = lab.reachd("--serve", "--no-log")
    wait_until(lambda: lab.ask("status")["features"]["accepted"] > 5)
    key = FEATURES.key("board0")
    before = lab.ask("status")["features"]["accepted"]
    for data in (
        b"",
        b"\x00\x01\x00\x00",
        b"x" * 70_000,
        codec().encode(FEATURES.msgtype, _none()),
    ):
        lab.arm.session.put(key, data)
        time.sleep(0.05)
    wait_until(lambda: lab.ask("status")["features"]["accepted"] > before + 20)
    status = lab.ask("status")
    assert program.process.poll() is None
    # None of them has a publisher's id, so none is even decoded.
    assert status["features"]["malformed"] == 0
    assert status["held"] is not None


def _none() -> Any:
    from tactile_core.bus.messages import MSG, header

    zero = MSG.Vector3(0.0, 0.0, 0.0)
    return MSG.ContactFeatures(
        header(0, "ee"), 0, 0, 0.0, 1, True, [], True, 9.0, 1, MSG.Point(0.0, 0.0, 0.0), 9.0,
        MSG.Wrench(zero, zero), 0.0, 0.0, 1, 0, [], [], 0.1, 0.1, 0.1,
    )  # fmt: skip
