"""Three processes in real time: the demo, and measurements on them."""

from __future__ import annotations

import dataclasses
import signal
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from matplotlib.image import imread

from tactile_core.bus.topics import ARM_STATE, COMMAND, FEATURES
from tactile_tools.cli import main
from tactile_tools.dev.benches.stop import InvalidTrialError, rest_after, zero_after
from tactile_tools.plot.reach_series import read_reach
from tactile_tools.reach.process_rig import LiveReach, WatchError
from tests.support import trial_trace

MS = 1_000_000
MOTION_S = 20.0
TRIES = 6


def test_demo_reaches_and_leaves_log_and_picture(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """First command that a newcomer runs; on a busy machine it may not reach."""
    log, picture = tmp_path / "demo.mcap", tmp_path / "demo.png"
    for _ in range(2):
        code = main(["demo", "--seed", "13", "--out", str(log), "--png", str(picture)])
        printed = capfd.readouterr()
        if code != 3:
            break  # 3: nothing was felt in time, for which a starved machine is enough
    assert code in (0, 1), printed
    assert ("\nREACHED: " if code == 0 else "\nNOT REACHED") in printed.out
    reach = read_reach(log)
    assert reach.outcome() is not None
    assert (reach.outcome().code == "reached") == (code == 0)
    assert reach.states[-1].strategy == "hybrid_event"
    assert len(reach.touch) > 0, "the log holds what was felt"
    assert reach.last_world is not None
    assert imread(picture).std() > 0.1


def test_stopping_any_of_the_three_processes_stops_the_arm(tmp_path: Path) -> None:
    """Rows 13 to 15 and 24 with the whole chain; `tactile bench` measures how soon."""
    shelf = dataclasses.replace(trial_trace.crowded(0), goal=(0.3, 0.0))
    (tmp_path / "shelf.json").write_text(shelf.to_json())
    with LiveReach(tmp_path, ("--scene", "shelf.json"), strategy="straight") as live:
        for process, number in (
            ("tactiled", signal.SIGSTOP),
            ("cupboard", signal.SIGSTOP),
            ("reachd", signal.SIGKILL),
        ):
            assert any(_stops(live, process, number) for _ in range(TRIES)), "it never moved"


def _stops(live: LiveReach, process: str, number: signal.Signals) -> bool:
    """Stop a process while the arm moves: it comes to rest. False where it was at rest already.

    On a starved machine the gate may have stopped it just before.
    """
    live.begin()
    try:
        live.until(live.moving, "motion", MOTION_S)
        live.clear()
        live.until(lambda: len(live.heard[COMMAND]) > 10 and live.heard[ARM_STATE], "commands")
    except WatchError:
        return False
    since = live.signal(process, number)
    if process == "reachd":
        live.until(lambda: not live.moving(), "rest")
    else:
        live.until(lambda: _still(live), "zero twist")
    try:
        if process == "reachd":
            rest_after(live, since)
        else:
            zero_after(live, FEATURES if process == "tactiled" else ARM_STATE, since)
        moved = True
    except InvalidTrialError:
        moved = False
    if process == "reachd":
        live.start(process)
    else:
        live.signal(process, signal.SIGCONT)
    live.wait_ready()
    return moved


def _still(live: LiveReach) -> bool:
    last = live.last(COMMAND).twist
    return bool(last.linear.x == last.linear.y == last.angular.z == 0.0)


class Heard:
    """Stands in for what a `LiveReach` heard."""

    def __init__(self, **heard: list[tuple[int, Any]]) -> None:
        self._heard = heard

    def decoded(self, topic: Any) -> list[tuple[int, Any]]:
        return self._heard[{FEATURES: "features", ARM_STATE: "states", COMMAND: "commands"}[topic]]


def sample(ms: float, vx: float = 0.0) -> tuple[int, Any]:
    """Message captured at ``ms``, arrived 3 ms later."""
    linear, angular = SimpleNamespace(x=vx, y=0.0), SimpleNamespace(z=0.0)
    message = SimpleNamespace(
        captured_ns=int(ms * MS), twist=SimpleNamespace(linear=linear, angular=angular)
    )
    return int((ms + 3) * MS), message


def test_measured_time_runs_from_last_message_to_standstill() -> None:
    features = [sample(t) for t in range(0, 101, 10)]
    commands = [sample(t, 0.05 if t < 290 else 0.0) for t in range(0, 400, 10)]
    live: Any = Heard(features=features, commands=commands)
    assert zero_after(live, FEATURES, 90 * MS) == pytest.approx(193)  # 290 + 3 − 100
    states = [sample(t, 0.05 if t < 180 else 0.0) for t in range(0, 400, 5)]
    live = Heard(states=states, commands=commands[:11])
    assert rest_after(live, 90 * MS) == pytest.approx(180 - 103)


def test_arm_that_did_not_move_is_no_measurement() -> None:
    still = [sample(t) for t in range(0, 400, 10)]
    live: Any = Heard(features=still, commands=still, states=still)
    with pytest.raises(InvalidTrialError):
        zero_after(live, FEATURES, 90 * MS)
    with pytest.raises(InvalidTrialError):
        rest_after(live, 90 * MS)
    moving = [sample(t, 0.05) for t in range(0, 400, 10)]
    live = Heard(features=still, commands=moving, states=moving)
    with pytest.raises(RuntimeError, match="no zero twist"):
        zero_after(live, FEATURES, 90 * MS)
    with pytest.raises(RuntimeError, match="moved on"):
        rest_after(live, 90 * MS)
