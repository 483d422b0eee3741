"""The daemon as a real process: pseudo-terminals, signals and a real bus."""

from __future__ import annotations

import os
import pty
import signal
import sys
import threading
import time
import tty
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from tactile_core.bus.services import ServiceError
from tactile_core.log.info import info
from tactiled.cli import main
from tactiled.port import Port
from tests.support.tactiled_lab import FeatureListener
from tests.support.waiting import PATIENCE_S


def test_ctrl_c_leaves_a_complete_log_that_replays_on_its_own_keys(lab: Any) -> None:
    lab.boards("--pty", "board0", "--seed", "1", link="board0")
    daemon = lab.tactiled("--port", "board0", "--log", "run.mcap")
    session = lab.listen()
    listener = FeatureListener(session)
    listener.wait(50)
    daemon.process.send_signal(signal.SIGINT)
    assert daemon.wait() == 0, daemon.said
    told = info(lab.folder / "run.mcap")
    assert told.closed
    logged = {c.topic: c.messages for c in told.channels}
    assert logged["/tactile/board0/features"] >= len(listener.heard)
    replay = lab.tactiled("--mcap", "run.mcap", "--speed", "inf", "--log", "again.mcap")
    assert replay.wait() == 0, replay.said
    again = {c.topic: c.messages for c in info(lab.folder / "again.mcap").channels}
    # All of it again, and the cycles that were in hand when Ctrl-C came.
    assert again["/tactile/board0/features"] >= logged["/tactile/board0/features"]
    live, replayed = FeatureListener(session), FeatureListener(session, prefix="replay")
    lab.tactiled("--mcap", "run.mcap", "--speed", "0.5")
    replayed.wait(5)
    assert not live.heard


def test_pending_requests_are_told_that_the_daemon_stops(lab: Any, ask: Any) -> None:
    board = lab.boards("--pty", "board0", "--seed", "1", link="board0")
    daemon = lab.tactiled("--port", "board0", "--no-log")
    session = lab.listen()
    FeatureListener(session).wait(10)
    board.process.send_signal(signal.SIGSTOP)
    answers: list[str] = []

    def tare() -> None:
        try:
            ask(session, "tare", timeout=PATIENCE_S)
        except ServiceError as error:
            answers.append(str(error))

    thread = threading.Thread(target=tare)
    thread.start()
    time.sleep(0.5)
    daemon.process.terminate()
    thread.join(PATIENCE_S)
    assert daemon.wait() == 0, daemon.said
    assert answers
    assert "did not end in time" not in daemon.said


def test_silence_ends_features_without_repeating_one(lab: Any) -> None:
    board = lab.boards("--pty", "board0", "--seed", "1", link="board0")
    daemon = lab.tactiled("--port", "board0", "--no-log")
    listener = FeatureListener(lab.listen())
    listener.wait(10)
    board.process.send_signal(signal.SIGSTOP)
    daemon.wait_for_text("no samples for")
    time.sleep(2.0)
    board.process.send_signal(signal.SIGCONT)
    listener.wait(20, after=time.monotonic())
    numbers = [m.sequence for _, m in listener.heard]
    assert numbers == sorted(set(numbers))
    pauses = [b - a for (a, _), (b, _) in zip(listener.heard, listener.heard[1:], strict=False)]
    assert max(pauses) > 1.0


def test_replugged_board_is_resumed_and_another_in_its_place_refused(lab: Any) -> None:
    board = lab.boards("--pty", "board0", "--seed", "1", link="board0")
    daemon = lab.tactiled("--port", "board0", "--log", "run.mcap")
    listener = FeatureListener(lab.listen())
    listener.wait(10)
    board.end()
    daemon.wait_for_text("waiting for it to come back")
    (lab.folder / "board0").unlink(missing_ok=True)
    board = lab.boards("--pty", "board0", "--seed", "1", link="board0")
    listener.wait(10, after=time.monotonic())
    board.end()
    (lab.folder / "board0").unlink(missing_ok=True)
    lab.boards("--pty", "board0", "--seed", "2", link="board0")
    daemon.wait_for_text("answers where")
    assert daemon.process.poll() is None


def test_killed_daemon_restarts_and_its_log_is_readable(lab: Any) -> None:
    lab.boards("--pty", "board0", "--seed", "1", link="board0")
    daemon = lab.tactiled("--port", "board0", "--log", "run.mcap")
    session = lab.listen()
    listener = FeatureListener(session)
    listener.wait(60)
    daemon.process.kill()
    daemon.wait()
    lab.tactiled("--port", "board0", "--log", "next.mcap")
    listener.wait(20, after=time.monotonic())
    told = info(lab.folder / "run.mcap")
    assert not told.closed
    assert {c.topic: c.messages for c in told.channels}["/tactile/board0/features"] > 20


def test_dead_thread_ends_the_daemon_and_the_log_is_complete(
    lab: Any, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    lab.boards("--pty", "board0", "--seed", "1", link="board0")
    real, log = Port.pump, lab.folder / "run.mcap"

    def fail_at_last(port: Port, *words: Any) -> None:
        if any(session.sent >= 100 for session in port.boards.values()):
            raise ZeroDivisionError("a mistake in the pipeline")
        real(port, *words)

    monkeypatch.setattr(Port, "pump", fail_at_last)
    interval = sys.getswitchinterval()
    try:
        port = str(lab.folder / "board0")
        assert main(["--listen", lab.endpoint, "--port", port, "--log", str(log)]) == 1
    finally:
        sys.setswitchinterval(interval)
    assert "thread pipeline failed: a mistake in the pipeline" in capsys.readouterr().err
    told = info(log)
    assert told.closed
    assert {c.topic: c.messages for c in told.channels}["/tactile/board0/forces"] >= 100


def test_boards_on_a_can_bus_are_named_by_node(lab: Any) -> None:
    lab.boards(
        "--slcan", "can0", "--node", "3", "--node", "5", "--rate", "25", "--seed", "1", link="can0"
    )
    daemon = lab.tactiled("--can", "slcan:can0@1000000", "--name", "hand", "--no-log")
    session = lab.listen()
    for name in ("hand-3", "hand-5"):
        FeatureListener(session, name).wait(5)
    daemon.process.terminate()
    assert daemon.wait() == 0, daemon.said


def test_calibration_of_another_board_is_refused_naming_both(lab: Any) -> None:
    lab.boards("--pty", "board0", "--serial", "a1", link="board0")
    lab.calibration("--serial", "b2", "--out", "other.cal.toml")
    daemon = lab.tactiled("--port", "board0", "--calibration", "other.cal.toml", "--no-log")
    assert daemon.wait() == 3
    assert "00000000000000a1" in daemon.said
    assert "00000000000000b2" in daemon.said
    assert "Traceback" not in daemon.said


def test_non_board_device_is_named_with_a_remedy(lab: Any) -> None:
    with chattering(b"T=21.5 C\r\n") as path:
        daemon = lab.tactiled("--port", path, "--log", "run.mcap")
        assert daemon.wait() == 3
    assert "sends text, not taxel frames: 'T=21.5 C'" in daemon.said
    assert "Traceback" not in daemon.said
    # Its bytes are in the log all the same.
    assert {c.topic for c in info(lab.folder / "run.mcap").channels} >= {"/tactile/board0/raw"}


def test_unwritable_log_is_refused_before_anything_runs(lab: Any) -> None:
    lab.boards("--pty", "board0", link="board0")
    (lab.folder / "file").write_text("")
    daemon = lab.tactiled("--port", "board0", "--log", "file/logs")
    assert daemon.wait() == 3
    assert "file/logs" in daemon.said


@contextmanager
def chattering(data: bytes) -> Iterator[str]:
    """A terminal on which a device sends the same bytes repeatedly."""
    ours, theirs = pty.openpty()
    tty.setraw(theirs)
    os.set_blocking(ours, False)
    stop = threading.Event()

    def talk() -> None:
        while not stop.wait(0.01):
            try:
                os.write(ours, data)
            except BlockingIOError:
                continue

    thread = threading.Thread(target=talk)
    thread.start()
    try:
        yield os.ttyname(theirs)
    finally:
        stop.set()
        thread.join()
        os.close(ours)
        os.close(theirs)
