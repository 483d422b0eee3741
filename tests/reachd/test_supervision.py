"""reachd notifies its service manager: ready, alive while the control loop runs, stopping."""

from __future__ import annotations

import signal
import socket
import time
from pathlib import Path
from typing import Any

from tests.support.waiting import PATIENCE_S


def test_control_loop_feeds_the_watchdog_only_while_running(lab: Any, tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(str(tmp_path / "notify"))
        manager.settimeout(PATIENCE_S)

        def wait(wanted: str) -> str:
            while wanted not in (said := manager.recv(4096).decode()):
                pass
            return said

        assert lab.arm is not None  # the arm must grant its command
        lab.board()
        program = lab.reachd(
            "--serve", "--no-log",
            NOTIFY_SOCKET=str(tmp_path / "notify"), WATCHDOG_USEC="2000000",
        )  # fmt: skip
        assert "STATUS=disarmed" in wait("READY=1")
        for _ in range(3):
            wait("WATCHDOG=1")
        program.signal(signal.SIGSTOP)
        manager.settimeout(0.5)
        quiet = 0.0
        while quiet < 3.0:  # beats that were on their way, then none
            before = time.monotonic()
            try:
                manager.recv(4096)
                quiet = 0.0
            except TimeoutError:
                quiet += time.monotonic() - before
        program.signal(signal.SIGCONT)
        manager.settimeout(PATIENCE_S)
        wait("WATCHDOG=1")
        program.signal(signal.SIGTERM)
        wait("STOPPING=1")
        assert program.wait() == 0
