"""Topics and services of a daemon with two boards."""

from __future__ import annotations

from typing import Any

import pytest

from tactile_core.bus.messages import codec
from tactile_core.bus.services import ServiceError
from tactile_core.bus.streams import latest
from tactile_core.bus.topics import FORCES
from tests.support.network import free_endpoint
from tests.support.tactiled_lab import FeatureListener
from tests.support.waiting import PATIENCE_S, wait_until


def test_one_daemon_serves_two_kinds_of_board(running: tuple[Any, Any, Any]) -> None:
    _, daemon, session = running
    features = FeatureListener(session, "board0").wait(5)
    assert features.calibrated
    features = FeatureListener(session, "skin0").wait(5)
    assert not features.calibrated
    assert "anyskin board without a serial number found" in daemon.said
    forces = latest(session, FORCES.key("skin0")).wait(PATIENCE_S)
    assert forces is not None
    assert len(codec().decode(FORCES, forces.data).status) == 5


def test_status_describes_the_board_completely(running: tuple[Any, Any, Any], ask: Any) -> None:
    _, _, session = running
    status: dict[str, Any] = {}

    def streaming() -> bool:  # on a starved machine a board seems silent for a moment
        status.update(ask(session, "status"))
        return status["state"] == "streaming" and status["rate_hz"] > 0

    wait_until(streaming)
    assert status["model"] == "finger"
    assert status["clock_synchronised"]
    assert 0 < status["clock_uncertainty_s"] < 1
    assert not status["calibration"]["nominal"]
    assert len(status["calibration"]["hash"]) == 64
    assert len(status["field_support"]) == 3
    assert status["log"]["state"] == "recording"


def test_tare_replies_when_done_with_a_report(running: tuple[Any, Any, Any], ask: Any) -> None:
    _, _, session = running
    report = ask(session, "tare", timeout=PATIENCE_S)
    assert report["accepted"]
    assert report["cycles"] >= 8
    assert report["shift_ut"] < 100


def test_rate_is_set_and_bad_rates_are_refused(running: tuple[Any, Any, Any], ask: Any) -> None:
    _, _, session = running

    def set_rate() -> bool:
        try:
            answer = ask(session, "set_rate", {"rate_hz": 50.0})
        except ServiceError as error:
            if "did not answer" in str(error):  # a board that is starved for a second
                return False
            raise
        assert answer == {"rate_hz": 50.0}
        return True

    wait_until(set_rate)
    ear = FeatureListener(session)
    ear.wait(60)
    steps = [
        (b.captured_ns - a.captured_ns) / (b.sequence - a.sequence)
        for (_, a), (_, b) in zip(ear.heard, ear.heard[1:], strict=False)
    ]
    assert sorted(steps)[len(steps) // 2] == pytest.approx(20e6, rel=0.1)
    for rate in (0, -1, 1e6):
        with pytest.raises(ServiceError, match="rate_hz"):
            ask(session, "set_rate", {"rate_hz": rate})
    with pytest.raises(ServiceError, match="bad request"):
        ask(session, "set_rate", {"rate": 50})
    with pytest.raises(ServiceError, match="takes no commands"):
        ask(session, "set_rate", {"rate_hz": 50.0}, name="skin0")


def test_recalibrate_rereads_the_file_or_says_why_not(
    running: tuple[Any, Any, Any], ask: Any
) -> None:
    lab, _, session = running
    path = lab.folder / "board0.cal.toml"
    text = path.read_text()
    before = ask(session, "status")["calibration"]["hash"]
    path.write_text(text.replace('provenance = "', 'provenance = "again: '))
    after = ask(session, "recalibrate")
    assert after["hash"] != before
    path.write_text("nonsense")
    with pytest.raises(ServiceError, match=r"board0\.cal\.toml"):
        ask(session, "recalibrate")
    assert ask(session, "status")["calibration"]["hash"] == after["hash"]
    path.write_text(text)
    geometry = ask(session, "geometry")
    assert [a["name"] for a in geometry["arrays"]] == ["left", "right", "tip"]


def test_second_daemon_is_refused_port_and_name(
    running: tuple[Any, Any, Any],
) -> None:
    lab, _, _ = running
    other = free_endpoint()
    second = lab.tactiled("--port", "board0", "--no-log", endpoint=other)
    assert second.wait() == 3
    assert "board0 is held" in second.said
    lab.boards("--pty", "spare", "--seed", "5", link="spare")
    for _ in range(5):
        third = lab.tactiled(
            *("--port", "spare", "--name", "skin0", "--no-log", "--connect", lab.endpoint),
            endpoint=other,
        )
        wait_until(lambda p=third: not p.running or "streaming" in p.said)  # type: ignore[misc]
        if not third.running:
            break
        third.end()  # on a starved machine it asks the other one before there is a link to it
    assert third.wait() == 3
    assert "'skin0' already" in third.said
    fourth = lab.tactiled("--port", "spare", "--no-log")
    assert fourth.wait() == 3
    assert "--listen" in fourth.said
