"""How the daemon ends under various conditions, and faults of clock and log (rows 34, 43)."""

from __future__ import annotations

import os
import pty
import signal
import subprocess
import sys
import threading
import tty
from pathlib import Path
from typing import Any

import pytest

from tactile_core.bus.messages import log_message
from tactile_core.bus.session import BusConfig, close_session, open_session
from tactile_core.bus.topics import LOG
from tactile_core.log.info import info
from tactile_core.types import NS_PER_S, WallClock
from tactiled.publisher import MessagePublisher
from tests.support.network import free_endpoint
from tests.support.tactiled_lab import FeatureListener

BURN = "while True: sum(range(10000))"


def test_closed_publisher_publishes_nothing() -> None:
    session = open_session(BusConfig(listen=(), connect=()))
    publisher = MessagePublisher(session, None, WallClock.take())
    going, failed = threading.Event(), []

    def produce() -> None:
        try:
            while not going.is_set() or publisher.late < 1000:
                publisher.send(LOG, "b0", log_message(1, 20, "b0", "x"), 1)
        except BaseException as error:  # noqa: BLE001 - the test checks what ended the thread
            failed.append(error)

    threads = [threading.Thread(target=produce) for _ in range(3)]
    for thread in threads:
        thread.start()
    publisher.end()
    publisher.close()
    assert close_session(session)
    going.set()
    for thread in threads:
        thread.join(60)
    assert failed == []
    assert publisher.late >= 1000
    assert publisher.refused == 0


def test_unexpected_bus_closure_costs_only_the_bus() -> None:
    session = open_session(BusConfig(listen=(), connect=()))
    publisher = MessagePublisher(session, None, WallClock.take())
    message = log_message(1, 20, "b0", "x")
    publisher.send(LOG, "b0", message, 1)
    close_session(session)
    for _ in range(10):
        publisher.send(LOG, "b0", message, 1)
    assert publisher.refused == 10
    publisher.close()


def test_sigterm_under_load_shuts_down_cleanly(lab: Any) -> None:
    burning = [subprocess.Popen([sys.executable, "-c", BURN]) for _ in range(2)]
    try:
        lab.boards("--pty", "board0", "--seed", "1", link="board0")
        for k in range(2):
            daemon = lab.tactiled(
                "--port", "board0", "--log", f"run{k}.mcap", endpoint=free_endpoint()
            )
            daemon.wait_for_text("streaming")
            daemon.process.send_signal(signal.SIGTERM)
            assert daemon.wait() == 0, daemon.said
            assert "Traceback" not in daemon.said
            assert "session closed" not in daemon.said
            assert info(lab.folder / f"run{k}.mcap").closed
    finally:
        for process in burning:
            process.kill()
            process.wait()


CLOCK = """\
import time
_shift = {wall_ns} - time.time_ns()
_s, _ns = time.time, time.time_ns
time.time = lambda: _s() + _shift / 1e9
time.time_ns = lambda: _ns() + _shift
"""

DAY_S = 86_400


@pytest.mark.parametrize(
    ("wall_s", "says"), [(-DAY_S + 3600, "1969-12-31"), (2**31 + DAY_S, "2038-01-20")]
)
def test_tactiled_runs_at_any_system_time(
    wall_s: int, says: str, lab: Any, ask: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    (lab.folder / "sitecustomize.py").write_text(CLOCK.format(wall_ns=wall_s * NS_PER_S))
    monkeypatch.setenv("PYTHONPATH", str(lab.folder))
    lab.boards("--pty", "board0", "--seed", "1", link="board0")
    daemon = lab.tactiled("--port", "board0", "--log", "run.mcap")
    monkeypatch.delenv("PYTHONPATH")
    session = lab.listen()
    features = FeatureListener(session).wait(30)
    assert (features.header.stamp.sec == 0) == (wall_s > 0)  # zero instead of a wrong stamp
    assert says in ask(session, "status").get("clock_problem", "")
    daemon.process.send_signal(signal.SIGTERM)
    assert daemon.wait() == 0, daemon.said
    assert f"the system clock reads {says}" in daemon.said
    told = info(lab.folder / "run.mcap")
    assert told.closed
    assert says in told.metadata["software"]["clock_problem"]
    counts = {c.topic: c.messages for c in told.channels}
    assert counts["/tactile/board0/features"] > 30


def test_failed_log_gives_a_failing_exit_status(lab: Any) -> None:
    lab.boards("--pty", "board0", "--seed", "1", link="board0")
    daemon = lab.tactiled("--port", "board0", "--log", "logs")
    listener = FeatureListener(lab.listen())
    listener.wait(10)
    (lab.folder / "logs").rename(lab.folder / "gone")
    (lab.folder / "logs").touch()  # a file in place of the folder, so that no log can be opened
    daemon.wait_for_text("deleted or moved")
    listener.wait(20)
    daemon.process.send_signal(signal.SIGTERM)
    assert daemon.wait() == 1, daemon.said
    assert "tactiled: the log failed" in daemon.said
    assert "Traceback" not in daemon.said


def test_changed_symlink_is_followed_until_a_board_is_found(lab: Any) -> None:
    master, slave = pty.openpty()
    tty.setraw(slave)
    link = lab.folder / "board"
    link.symlink_to(os.ttyname(slave))
    try:
        daemon = lab.tactiled("--port", "board", "--name", "board0", "--no-log", "--wait")
        daemon.wait_for_text("is silent")
        session = lab.listen()
        lab.boards("--pty", "right", "--seed", "1", link="right")
        _relink(link, os.path.realpath(lab.folder / "right"))
        listener = FeatureListener(session)
        listener.wait(10)
        assert "board leads to another device now" in daemon.said
        # Once a board is found the port belongs to it, and the path is not checked any more.
        _relink(link, os.ttyname(slave))
        listener.wait(100, after=listener.heard[-1][0])
        assert daemon.process.poll() is None
    finally:
        os.close(master)
        os.close(slave)


def _relink(link: Path, target: str) -> None:
    fresh = link.with_name("fresh")
    fresh.symlink_to(target)
    fresh.replace(link)
