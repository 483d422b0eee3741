"""The daemon as users run it: real processes, pseudo-terminals, signals and a real bus."""

from __future__ import annotations

import os
import pty
import signal
import socket
import subprocess
import sys
import threading
import time
import tty
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import zenoh

from tactile_bus.log_info import info
from tactile_bus.messages import codec
from tactile_bus.services import ServiceError, call
from tactile_bus.session import BusConfig, close_session, open_session
from tactile_bus.streams import latest
from tactile_bus.topics import FEATURES, FORCES, service_key
from tactiled.cli import main
from tactiled.outgoing import MessageMaker

SLOW = 60.0
"""s that anything may take on a busy machine before a test gives it up."""


pytestmark = pytest.mark.timeout(300)


class Program:
    """One of our commands with its output in a file."""

    def __init__(self, folder: Path, name: str, *words: str) -> None:
        self.output = folder / f"{name}-{time.monotonic_ns()}.txt"
        with self.output.open("wb") as file:
            self.process = subprocess.Popen(
                [str(Path(sys.executable).with_name(name)), *words],
                stdout=file, stderr=subprocess.STDOUT, cwd=folder,
            )  # fmt: skip

    @property
    def said(self) -> str:
        return self.output.read_text(errors="replace")

    def wait(self, seconds: float = SLOW) -> int:
        return self.process.wait(seconds)

    def wait_for(self, text: str) -> None:
        until(lambda: text in self.said or self.process.poll() is not None)
        assert text in self.said, self.said

    def end(self) -> None:
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait()


def until(done: Callable[[], bool], seconds: float = SLOW) -> None:
    end = time.monotonic() + seconds
    while not done():
        assert time.monotonic() < end, "waited too long"
        time.sleep(0.02)


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


class Lab:
    """Starts simulated boards and daemons, and listens to them."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.endpoint = f"tcp/127.0.0.1:{free_port()}"
        self._programs: list[Program] = []
        self._sessions: list[zenoh.Session] = []

    def boards(self, *words: str, link: str) -> Program:
        program = self._start("simdevice", "boards", *words)
        until(lambda: (self.folder / link).exists() or program.process.poll() is not None)
        assert program.process.poll() is None, program.said
        return program

    def tactiled(self, *words: str, endpoint: str | None = None) -> Program:
        return self._start("tactiled", "--listen", endpoint or self.endpoint, *words)

    def listen(self) -> zenoh.Session:
        session = open_session(BusConfig(listen=(), connect=(self.endpoint,)))
        self._sessions.append(session)
        return session

    def close(self) -> None:
        for session in self._sessions:
            close_session(session)
        for program in self._programs:
            program.end()

    def _start(self, name: str, *words: str) -> Program:
        program = Program(self.folder, name, *words)
        self._programs.append(program)
        return program


class Ear:
    """Every features message of a board, with the instant at which it came."""

    def __init__(self, session: zenoh.Session, name: str = "board0", prefix: str = "") -> None:
        self.heard: list[tuple[float, Any]] = []
        self._subscriber = session.declare_subscriber(FEATURES.key(name, prefix), self._take)

    def _take(self, sample: zenoh.Sample) -> None:
        message = codec().decode(FEATURES, sample.payload.to_bytes())
        self.heard.append((time.monotonic(), message))

    def wait(self, count: int = 1, after: float = 0.0) -> Any:
        """The last of ``count`` valid features that came after an instant."""
        fresh: list[Any] = []

        def enough() -> bool:
            fresh[:] = [m for at, m in list(self.heard) if at > after and m.valid]
            return len(fresh) >= count

        until(enough)
        return fresh[-1]


@contextmanager
def a_lab(folder: Path) -> Iterator[Lab]:
    lab = Lab(folder)
    try:
        yield lab
    finally:
        lab.close()


@pytest.fixture
def lab(tmp_path: Path) -> Iterator[Lab]:
    with a_lab(tmp_path) as made:
        yield made


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Lab, Program, Any]]:
    """A finger and an AnySkin board under one daemon, for tests that only ask and listen."""
    with a_lab(tmp_path_factory.mktemp("running")) as lab:
        lab.boards("--pty", "board0", "--seed", "1", link="board0")
        lab.boards("--pty", "skin0", "--board", "anyskin", "--seed", "2", link="skin0")
        made = Program(
            lab.folder, "simdevice", "calibration", "--seed", "1", "--out", "board0.cal.toml"
        )
        assert made.wait() == 0
        daemon = lab.tactiled(
            "--port", "board0", "--name", "board0", "--port", "skin0", "--name", "skin0",
            "--calibration", "board0.cal.toml", "--log", "run.mcap",
        )  # fmt: skip
        session = lab.listen()
        Ear(session).wait(20)
        yield lab, daemon, session


def test_two_boards_of_two_kinds_under_one_daemon(running: tuple[Lab, Program, Any]) -> None:
    _, daemon, session = running
    features = Ear(session, "board0").wait(5)
    assert features.calibrated
    features = Ear(session, "skin0").wait(5)
    assert not features.calibrated
    assert "anyskin board without a serial number found" in daemon.said
    forces = latest(session, FORCES.key("skin0")).wait(SLOW)
    assert forces is not None
    assert len(codec().decode(FORCES, forces.data).status) == 5


def test_status_tells_everything_of_a_board(running: tuple[Lab, Program, Any]) -> None:
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


def test_tare_waits_for_its_end_and_reports(running: tuple[Lab, Program, Any]) -> None:
    _, _, session = running
    report = ask(session, "tare", timeout=SLOW)
    assert report["accepted"]
    assert report["cycles"] >= 8
    assert report["shift_ut"] < 100


def test_the_rate_is_set_and_bad_rates_are_refused(running: tuple[Lab, Program, Any]) -> None:
    _, _, session = running
    assert ask(session, "set_rate", {"rate_hz": 50.0}, timeout=SLOW) == {"rate_hz": 50.0}
    ear = Ear(session)
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
    running: tuple[Lab, Program, Any],
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
    running: tuple[Lab, Program, Any],
) -> None:
    lab, _, _ = running
    other = f"tcp/127.0.0.1:{free_port()}"
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


def test_ctrl_c_leaves_a_whole_log_that_replays_on_keys_of_its_own(lab: Lab) -> None:
    lab.boards("--pty", "board0", "--seed", "1", link="board0")
    daemon = lab.tactiled("--port", "board0", "--log", "run.mcap")
    session = lab.listen()
    ear = Ear(session)
    ear.wait(50)
    daemon.process.send_signal(signal.SIGINT)
    assert daemon.wait() == 0, daemon.said
    told = info(lab.folder / "run.mcap")
    assert told.closed
    logged = {c.topic: c.messages for c in told.channels}
    assert logged["/tactile/board0/features"] >= len(ear.heard)
    replay = lab.tactiled("--mcap", "run.mcap", "--speed", "inf", "--log", "again.mcap")
    assert replay.wait() == 0, replay.said
    again = {c.topic: c.messages for c in info(lab.folder / "again.mcap").channels}
    # All of it again, and at most the cycles that were in hand when Ctrl-C came.
    ahead = again["/tactile/board0/features"] - logged["/tactile/board0/features"]
    assert 0 <= ahead <= 3
    live, replayed = Ear(session), Ear(session, prefix="replay")
    lab.tactiled("--mcap", "run.mcap", "--speed", "0.5")
    replayed.wait(5)
    assert not live.heard


def test_whoever_waits_for_an_answer_is_told_that_the_daemon_stops(lab: Lab) -> None:
    board = lab.boards("--pty", "board0", "--seed", "1", link="board0")
    daemon = lab.tactiled("--port", "board0", "--no-log")
    session = lab.listen()
    Ear(session).wait(10)
    board.process.send_signal(signal.SIGSTOP)
    answers: list[str] = []

    def tare() -> None:
        try:
            ask(session, "tare", timeout=SLOW)
        except ServiceError as error:
            answers.append(str(error))

    thread = threading.Thread(target=tare)
    thread.start()
    time.sleep(0.5)
    daemon.process.terminate()
    thread.join(SLOW)
    assert daemon.wait() == 0, daemon.said
    assert answers
    assert "did not end in time" not in daemon.said


def test_silence_ends_the_features_and_never_repeats_one(lab: Lab) -> None:
    board = lab.boards("--pty", "board0", "--seed", "1", link="board0")
    daemon = lab.tactiled("--port", "board0", "--no-log")
    ear = Ear(lab.listen())
    ear.wait(10)
    board.process.send_signal(signal.SIGSTOP)
    daemon.wait_for("no samples for")
    time.sleep(1.2)
    board.process.send_signal(signal.SIGCONT)
    ear.wait(20, after=time.monotonic())
    numbers = [m.sequence for _, m in ear.heard]
    assert numbers == sorted(set(numbers))
    pauses = [b - a for (a, _), (b, _) in zip(ear.heard, ear.heard[1:], strict=False)]
    assert max(pauses) > 1.0


def test_an_unplugged_board_is_taken_up_again_and_another_in_its_place_refused(lab: Lab) -> None:
    board = lab.boards("--pty", "board0", "--seed", "1", link="board0")
    daemon = lab.tactiled("--port", "board0", "--log", "run.mcap")
    ear = Ear(lab.listen())
    ear.wait(10)
    board.end()
    daemon.wait_for("waiting for it to come back")
    (lab.folder / "board0").unlink(missing_ok=True)
    board = lab.boards("--pty", "board0", "--seed", "1", link="board0")
    ear.wait(10, after=time.monotonic())
    board.end()
    (lab.folder / "board0").unlink(missing_ok=True)
    lab.boards("--pty", "board0", "--seed", "2", link="board0")
    daemon.wait_for("answers where")
    assert daemon.process.poll() is None


def test_a_killed_daemon_starts_again_and_its_log_is_read(lab: Lab) -> None:
    lab.boards("--pty", "board0", "--seed", "1", link="board0")
    daemon = lab.tactiled("--port", "board0", "--log", "run.mcap")
    session = lab.listen()
    ear = Ear(session)
    ear.wait(60)
    daemon.process.kill()
    daemon.wait()
    lab.tactiled("--port", "board0", "--log", "next.mcap")
    ear.wait(20, after=time.monotonic())
    told = info(lab.folder / "run.mcap")
    assert not told.closed
    assert {c.topic: c.messages for c in told.channels}["/tactile/board0/features"] > 20


def test_a_thread_that_dies_takes_the_daemon_down_and_the_log_is_whole(
    lab: Lab, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    lab.boards("--pty", "board0", "--seed", "1", link="board0")
    real, log, calls = MessageMaker.forces, lab.folder / "run.mcap", []

    def fail_at_last(maker: MessageMaker, cycle: Any) -> Any:
        calls.append(cycle)
        if len(calls) == 100:
            raise ZeroDivisionError("a mistake in the pipeline")
        return real(maker, cycle)

    monkeypatch.setattr(MessageMaker, "forces", fail_at_last)
    interval = sys.getswitchinterval()
    try:
        port = str(lab.folder / "board0")
        assert main(["--listen", lab.endpoint, "--port", port, "--log", str(log)]) == 1
    finally:
        sys.setswitchinterval(interval)
    assert "thread pipeline failed: a mistake in the pipeline" in capsys.readouterr().err
    told = info(log)
    assert told.closed
    assert {c.topic: c.messages for c in told.channels}["/tactile/board0/forces"] == 99


def test_boards_on_a_can_bus_are_named_by_node(lab: Lab) -> None:
    lab.boards(
        "--slcan", "can0", "--node", "3", "--node", "5", "--rate", "25", "--seed", "1", link="can0"
    )
    daemon = lab.tactiled("--can", "slcan:can0@1000000", "--name", "hand", "--no-log")
    session = lab.listen()
    for name in ("hand-3", "hand-5"):
        Ear(session, name).wait(5)
    daemon.process.terminate()
    assert daemon.wait() == 0, daemon.said


def test_a_calibration_of_another_board_ends_with_both_named(lab: Lab) -> None:
    lab.boards("--pty", "board0", "--serial", "a1", link="board0")
    made = Program(
        lab.folder, "simdevice", "calibration", "--serial", "b2", "--out", "other.cal.toml"
    )
    assert made.wait() == 0, made.said
    daemon = lab.tactiled("--port", "board0", "--calibration", "other.cal.toml", "--no-log")
    assert daemon.wait() == 3
    assert "00000000000000a1" in daemon.said
    assert "00000000000000b2" in daemon.said
    assert "Traceback" not in daemon.said


def test_a_device_that_is_no_board_is_named_with_a_remedy(lab: Lab) -> None:
    with chattering(b"T=21.5 C\r\n") as path:
        daemon = lab.tactiled("--port", path, "--log", "run.mcap")
        assert daemon.wait() == 3
    assert "sends text, not taxel frames: 'T=21.5 C'" in daemon.said
    assert "Traceback" not in daemon.said
    # What it said is in the log all the same.
    assert {c.topic for c in info(lab.folder / "run.mcap").channels} >= {"/tactile/board0/raw"}


def test_an_unwritable_log_is_refused_before_anything_runs(lab: Lab) -> None:
    lab.boards("--pty", "board0", link="board0")
    (lab.folder / "file").write_text("")
    daemon = lab.tactiled("--port", "board0", "--log", "file/logs")
    assert daemon.wait() == 3
    assert "file/logs" in daemon.said


def ask(
    session: zenoh.Session,
    service: str,
    payload: object = None,
    name: str = "board0",
    timeout: float = 10.0,
) -> Any:
    return call(session, service_key(name, service), payload, timeout)


@contextmanager
def chattering(data: bytes) -> Iterator[str]:
    """A terminal on which some device says the same thing over and over."""
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
