"""Simulated boards and tactiled as real processes, and a listener on their bus."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import zenoh

from tactile_core.bus.messages import codec
from tactile_core.bus.session import BusConfig, close_session, open_session
from tactile_core.bus.topics import FEATURES
from tests.support.network import free_endpoint
from tests.support.processes import Program, command
from tests.support.waiting import wait_until

CALM_HZ = "25"
"""Rate of boards whose rate is not the subject: machines that are slow or busy keep up with it."""


class TactiledLab:
    """Starts simulated boards and daemons, and listens to them."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.endpoint = free_endpoint()
        self._programs: list[Program] = []
        self._sessions: list[zenoh.Session] = []

    def boards(self, *words: str, link: str) -> Program:
        """Simulated boards; at `CALM_HZ` where ``words`` give no rate."""
        calm = () if "--rate" in words else ("--rate", CALM_HZ)
        program = self._start("simdevice", "boards", *words, *calm)
        program.wait_for_file(self.folder / link)
        return program

    def tactiled(self, *words: str, endpoint: str | None = None) -> Program:
        return self._start("tactiled", "--listen", endpoint or self.endpoint, *words)

    def calibration(self, *words: str) -> None:
        """Write a calibration with `simdevice calibration`."""
        made = self._start("simdevice", "calibration", *words)
        assert made.wait() == 0, made.said

    def listen(self) -> zenoh.Session:
        session = open_session(BusConfig(listen=(), connect=(self.endpoint,)))
        self._sessions.append(session)
        return session

    def close(self) -> None:
        for session in self._sessions:
            close_session(session)
        # Daemons end before their boards: one that outlives its board would follow the remaining
        # link to a terminal that may already belong to another test.
        for program in reversed(self._programs):
            program.end()

    def _start(self, name: str, *words: str) -> Program:
        program = Program(self.folder, [command(name), *words])
        self._programs.append(program)
        return program


class FeatureListener:
    """Records every features message of a board with the time of its arrival."""

    def __init__(self, session: zenoh.Session, name: str = "board0", prefix: str = "") -> None:
        self.heard: list[tuple[float, Any]] = []
        self._subscriber = session.declare_subscriber(FEATURES.key(name, prefix), self._take)

    def _take(self, sample: zenoh.Sample) -> None:
        message = codec().decode(FEATURES, sample.payload.to_bytes())
        self.heard.append((time.monotonic(), message))

    def wait(self, count: int = 1, after: float = 0.0) -> Any:
        """Wait for ``count`` valid features after an instant; returns the last."""
        fresh: list[Any] = []

        def enough() -> bool:
            fresh[:] = [m for at, m in list(self.heard) if at > after and m.valid]
            return len(fresh) >= count

        wait_until(enough, explain=lambda: self._why_not(count, after))
        return fresh[-1]

    def _why_not(self, count: int, after: float) -> str:
        since = [message for at, message in list(self.heard) if at > after]
        reasons = Counter(tuple(message.reason_codes) for message in since if not message.valid)
        return f"{count} valid features wanted, {len(since)} came; invalid for: {dict(reasons)}"


@contextmanager
def tactiled_lab(folder: Path) -> Iterator[TactiledLab]:
    lab = TactiledLab(folder)
    try:
        yield lab
    finally:
        lab.close()
