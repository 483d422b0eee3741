"""Notifications to the service manager, alarms, and `tactile health`."""

from __future__ import annotations

import contextlib
import json
import math
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tactile_core import daemon as supervision
from tactile_core.log.retention import DiskWatch
from tactile_core.types import NS_PER_S, Instant, monotonic_now
from tactile_tools.operate import health
from tactiled.arguments import make_parser
from tactiled.daemon import Daemon
from tactiled.diagnostics import ALARM_WINDOW_S, DRIFT_N, WINDOWS, DriftWatch
from tactiled.settings import make_settings
from tests.support.waiting import PATIENCE_S, wait_until


class Manager:
    """Receives notifications like a service manager."""

    def __init__(self, place: str) -> None:
        self._end = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._end.bind(place)
        self._end.settimeout(PATIENCE_S)

    def wait(self, wanted: str) -> None:
        """Wait until the line ``wanted`` is received."""
        while wanted not in self._end.recv(4096).decode().splitlines():
            pass

    def drain(self) -> None:
        """Hear what has been said by now."""
        self._end.setblocking(False)
        with contextlib.suppress(BlockingIOError):
            while True:
                self._end.recv(4096)
        self._end.settimeout(PATIENCE_S)

    def said_within(self, seconds: float) -> list[str]:
        """Lines received in that time."""
        said, end = [], time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            self._end.settimeout(left)
            try:
                said += self._end.recv(4096).decode().splitlines()
            except TimeoutError:
                break
        self._end.settimeout(PATIENCE_S)
        return said

    def close(self) -> None:
        self._end.close()


@pytest.fixture
def manager(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Manager]:
    place = str(tmp_path / "notify")
    monkeypatch.setenv(supervision.SOCKET_VARIABLE, place)
    monkeypatch.setenv(supervision.WATCHDOG_VARIABLE, "1000000")
    monkeypatch.delenv(supervision.WATCHDOG_PID_VARIABLE, raising=False)
    manager = Manager(place)
    yield manager
    manager.close()


def test_service_manager_hears_each_line_and_may_be_absent(
    manager: Manager, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert supervision.notify("READY=1", "STATUS=x")
    manager.wait("STATUS=x")
    monkeypatch.setenv(supervision.SOCKET_VARIABLE, f"@tactile-test-{os.getpid()}")
    abstract = Manager(f"\0tactile-test-{os.getpid()}")
    assert supervision.notify("READY=1")
    abstract.wait("READY=1")
    abstract.close()
    assert not supervision.notify("READY=1")  # the manager is gone
    monkeypatch.delenv(supervision.SOCKET_VARIABLE)
    assert not supervision.notify("READY=1")


def test_stalled_service_manager_never_blocks(manager: Manager) -> None:
    while supervision.notify("WATCHDOG=1"):  # until its queue is full
        pass
    watchdog = supervision.Watchdog()
    watchdog.beat(monotonic_now())


@pytest.mark.parametrize(
    ("microseconds", "pid", "period"),
    [("400000", None, 0.2), ("", None, None), ("x", None, None), ("0", None, None),
     ("400000", "1", None)],
)  # fmt: skip
def test_watchdog_beats_twice_per_interval(
    monkeypatch: pytest.MonkeyPatch, microseconds: str, pid: str | None, period: float | None
) -> None:
    monkeypatch.setenv(supervision.WATCHDOG_VARIABLE, microseconds)
    if pid is not None:
        monkeypatch.setenv(supervision.WATCHDOG_PID_VARIABLE, pid)
    assert supervision.Watchdog().period_s == period


def test_tactiled_notifies_ready_alive_and_stopping(manager: Manager, tmp_path: Path) -> None:
    words = ["--port", str(tmp_path / "none"), "--wait", "--no-log"]
    words += ["--listen", f"unixsock-stream/{tmp_path}/t.sock"]
    process = subprocess.Popen(
        [sys.executable, "-m", "tactiled.cli", *words], stderr=subprocess.DEVNULL
    )
    try:
        manager.wait("READY=1")
        for _ in range(3):
            manager.wait("WATCHDOG=1")
        process.send_signal(signal.SIGTERM)
        manager.wait("STOPPING=1")
        assert process.wait(PATIENCE_S) == 0
    finally:
        process.kill()
        process.wait()


def test_stuck_pipeline_thread_stops_the_watchdog(manager: Manager, tmp_path: Path) -> None:
    """All other threads continue: a watchdog fed by one of them would not notice."""
    words = ["--port", str(tmp_path / "none"), "--wait", "--no-log"]
    words += ["--listen", f"unixsock-stream/{tmp_path}/t.sock"]
    daemon = Daemon(make_settings(make_parser().parse_args(words)))
    daemon.start()
    try:
        manager.wait("WATCHDOG=1")
        free, reached = threading.Event(), threading.Event()

        def stick() -> None:
            reached.set()
            free.wait(2 * PATIENCE_S)

        daemon._call(stick)
        assert reached.wait(PATIENCE_S)
        manager.drain()  # beats that were on their way
        assert "WATCHDOG=1" not in manager.said_within(1.5)
        free.set()
        manager.wait("WATCHDOG=1")
    finally:
        free.set()
        daemon.stop()


# Alarms


def watch(forces: list[float], seconds_each: float = 1.0) -> str | None:
    drift = DriftWatch()
    for index, force in enumerate(forces):
        drift.add(force, Instant(round(index * seconds_each * NS_PER_S)))
    return drift.alarm()


LONG = round(ALARM_WINDOW_S * (WINDOWS + 1)) + 2


def test_drifted_zero_raises_the_drift_alarm() -> None:
    text = watch([DRIFT_N * 1.5] * LONG)
    assert text is not None
    assert "tare" in text
    assert watch([math.nan, DRIFT_N * 1.5] * LONG) is not None


def test_released_touch_is_not_drift() -> None:
    touched = ([5.0] * 500 + [DRIFT_N / 2] * 20) * 3
    assert watch(touched) is None
    assert watch([DRIFT_N * 1.5] * (LONG // 2)) is None
    assert watch([DRIFT_N / 2] * LONG) is None
    assert watch([]) is None


def test_tare_clears_the_drift_alarm() -> None:
    drift = DriftWatch()
    for second in range(LONG):
        drift.add(1.0, Instant(second * NS_PER_S))
    assert drift.alarm() is not None
    drift.forget()
    assert drift.alarm() is None


def test_full_failing_or_hanging_disk_is_reported_without_blocking(tmp_path: Path) -> None:
    free = [1 << 40]
    hang = threading.Event()

    def usage(path: Path) -> int:
        if free[0] < 0:
            raise OSError(5, "Input/output error")
        if free[0] == 0:
            hang.wait(2 * PATIENCE_S)
        return free[0]

    disk = DiskWatch(lambda: tmp_path, usage=usage, every=0.01)
    disk.start()
    wait_until(lambda: disk.free_bytes == 1 << 40)
    assert disk.alarm(monotonic_now()) is None
    free[0] = 2 << 30
    wait_until(lambda: "2.1 GB free" in str(disk.alarm(monotonic_now())))
    free[0] = -1
    wait_until(lambda: "Input/output error" in str(disk.alarm(monotonic_now())))
    free[0] = 0
    later = Instant(monotonic_now() + 60 * NS_PER_S)
    wait_until(lambda: "has not answered" in str(disk.alarm(later)))
    disk.stop()
    hang.set()


# tactile health


def test_health_summarises_a_rig(lab: Any, capsys: pytest.CaptureFixture) -> None:
    asked = ["health", "--connect", lab.endpoint, "--timeout", str(PATIENCE_S)]
    from tactile_tools.cli import main

    lab.boards("--pty", "board0", "--seed", "1", link="board0")
    lab.tactiled("--port", "board0", "--no-log")
    wait_until(lambda: main([*asked, "--board", "board0"]) == 0)
    capsys.readouterr()

    def healthy() -> bool:  # a starved machine makes a board seem slow for a moment
        code = main([*asked, "--json"])
        told.update(json.loads(capsys.readouterr().out))
        return code == 0

    told: dict[str, Any] = {}
    wait_until(healthy)
    assert told["level"] == "OK"
    assert [(p["kind"], p["name"], p["level"]) for p in told["parts"]] == [
        ("board", "board0", "OK")
    ]
    assert main(["health", "--connect", lab.endpoint, "--board", "other", "--timeout", "1"]) == 4
    assert "CRITICAL: board other: no service at" in capsys.readouterr().out


def test_health_without_daemons_fails(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    from tactile_tools.cli import main

    words = ["health", "--connect", f"unixsock-stream/{tmp_path}/x.sock", "--timeout", "0.3"]
    assert main(words) == 3
    assert capsys.readouterr().out.startswith("NOBODY")
    assert main(["health", "--keys", str(tmp_path / "none")]) == 3
    assert "no such folder" in capsys.readouterr().err


GOOD = {"state": "streaming", "rate_hz": 100.0, "features_valid": True, "log": None}


@pytest.mark.parametrize(
    ("change", "level", "said"),
    [
        ({}, health.HEALTHY, ""),
        ({"state": "silent"}, health.FAILED, "silent"),
        ({"state": "refused", "refused": "wrong board; swap"}, health.FAILED, "swap"),
        ({"state": "waiting"}, health.DEGRADED, "waiting"),
        ({"features_valid": False, "reasons": ["taring"]}, health.DEGRADED, "taring"),
        ({"unhealthy_taxels": {"frozen": 2}}, health.DEGRADED, "2 taxels frozen"),
        ({"alarms": ["0.5 GB free"]}, health.DEGRADED, "0.5 GB"),
        ({"log": {"state": "disk_full", "last_error": "No space"}}, health.FAILED, "No space"),
        ({"log": {"state": "recording"}}, health.HEALTHY, ""),
    ],
)
def test_board_problems_are_described(change: dict[str, Any], level: int, said: str) -> None:
    part = health.Part("board", "b")
    health.JUDGES["tactile"](part, GOOD | change)
    assert part.level == level
    assert said in "; ".join(part.problems)


def test_reach_and_arm_problems_are_described() -> None:
    reach = health.Part("reach", "r")
    late = {"p99.9": 0.05}
    health.JUDGES["reach"](reach, {"state": "idle", "armed": False, "lateness_s": late})
    assert (reach.level, reach.state) == (health.DEGRADED, "idle disarmed")
    for mode, level in (("idle", 0), ("estop", health.DEGRADED), ("fault", health.FAILED)):
        arm = health.Part("arm", "a")
        health.JUDGES["arm"](arm, {"mode": mode})
        assert arm.level == level
