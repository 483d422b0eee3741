"""A daemon with two boards as those on the bus meet it: what it publishes and what it answers."""

from __future__ import annotations

from typing import Any

import pytest

from tactile_core.bus.messages import codec
from tactile_core.bus.services import ServiceError
from tactile_core.bus.streams import latest
from tactile_core.bus.topics import FORCES

SLOW = 60.0
"""s that anything may take on a busy machine before a test gives it up."""

pytestmark = pytest.mark.timeout(300)


def test_two_boards_of_two_kinds_under_one_daemon(running: tuple[Any, Any, Any], hear: Any) -> None:
    _, daemon, session = running
    features = hear(session, "board0").wait(5)
    assert features.calibrated
    features = hear(session, "skin0").wait(5)
    assert not features.calibrated
    assert "anyskin board without a serial number found" in daemon.said
    forces = latest(session, FORCES.key("skin0")).wait(SLOW)
    assert forces is not None
    assert len(codec().decode(FORCES, forces.data).status) == 5


def test_status_tells_everything_of_a_board(
    running: tuple[Any, Any, Any], ask: Any, until: Any
) -> None:
    _, _, session = running
    until(lambda: ask(session, "status")["rate_hz"] > 0)
    status = ask(session, "status")
    assert status["state"] == "streaming"
    assert status["model"] == "finger"
    assert status["clock_synchronised"]
    assert 0 < status["clock_uncertainty_s"] < 1
    assert not status["calibration"]["nominal"]
    assert len(status["calibration"]["hash"]) == 64
    assert len(status["field_support"]) == 3
    assert status["log"]["state"] == "recording"


def test_tare_waits_for_its_end_and_reports(running: tuple[Any, Any, Any], ask: Any) -> None:
    _, _, session = running
    report = ask(session, "tare", timeout=SLOW)
    assert report["accepted"]
    assert report["cycles"] >= 8
    assert report["shift_ut"] < 100


def test_the_rate_is_set_and_bad_rates_are_refused(
    running: tuple[Any, Any, Any], hear: Any, ask: Any
) -> None:
    _, _, session = running
    assert ask(session, "set_rate", {"rate_hz": 50.0}, timeout=SLOW) == {"rate_hz": 50.0}
    ear = hear(session)
    ear.wait(60)
    steps = [
        b.captured_ns - a.captured_ns
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


def test_recalibrating_reads_the_file_again_or_says_why_not(
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


def test_a_second_daemon_is_refused_the_port_and_the_name(
    running: tuple[Any, Any, Any],
) -> None:
    lab, _, _ = running
    other = lab.free_endpoint()
    second = lab.tactiled("--port", "board0", "--no-log", endpoint=other)
    assert second.wait() == 3
    assert "board0 is held" in second.said
    lab.boards("--pty", "spare", "--seed", "5", link="spare")
    third = lab.tactiled(
        "--port", "spare", "--name", "skin0", "--no-log", "--connect", lab.endpoint, endpoint=other
    )
    assert third.wait() == 3
    assert "'skin0' already" in third.said
    fourth = lab.tactiled("--port", "spare", "--no-log")
    assert fourth.wait() == 3
    assert "--listen" in fourth.said
