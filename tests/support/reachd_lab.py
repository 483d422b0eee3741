"""reachd as a real process with a fake arm and a fake board, and its publications."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import zenoh

from tactile_core.bus.messages import codec
from tactile_core.bus.services import ServiceError, call
from tactile_core.bus.topics import REACH_EVENT, REACH_STATE, service_key
from tests.support.fake_arm import FakeArm
from tests.support.network import free_endpoint
from tests.support.processes import Program
from tests.support.waiting import PATIENCE_S, wait_until
from tests.support.wire import Wire

AGES = {
    "features_stale": ("features_age", 30.0),
    "features_lost": ("features_latch", 60.0),
    "arm_stale": ("arm_age", 0.5),  # more, and the gate foresees the arm far out of its region
    "arm_lost": ("arm_latch", 60.0),
    "loop_late": ("lateness", 30.0),
    "request_stale": ("request_age", 60.0),
}
"""Checks that a starved machine trips, and what they are set to where a test is not about them."""

TIMED = (
    "arm_frozen", "arm_path", "arm_speed", "arm_tracking", "echo_late", "echo_lost",
    "features_sparse",
)  # fmt: skip
"""Checks that compare what was told with what came of it, which a starved arm is late to do."""

TRIES = 5
"""Starts of a reachd that found its inputs late; a healthy one on a busy machine needs two."""


def patient_config(folder: Path, *strict: str, more: str = "") -> tuple[str, str]:
    """Flags with a configuration under which a starved machine only makes reachd slow.

    ``strict``: codes of the gate's checks that stay as they are, for a test that is about them.
    ``more``: lines in front, for other tables.
    """
    ages = {name: f"{name} = {s}\n" for code, (name, s) in AGES.items() if code not in strict}
    off = sorted({*TIMED, "arm_stale"} - set(strict))
    path = folder / "patient.toml"
    path.write_text(
        f"time_limit = 600.0\n{more}\n[parameters.safety]\ndisabled = {off}\n"
        + "".join(ages.values())
    )
    return "--config", str(path)


class ReachdLab:
    """Starts what a test needs and records reachd's publications."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.reachd_at = free_endpoint()
        self.arm_at = free_endpoint()
        self.events: list[Any] = []
        self.states: list[Any] = []
        self._arm: FakeArm | None = None
        self._programs: list[Program] = []
        self._wires: list[Wire] = []

    @property
    def arm(self) -> FakeArm:
        if self._arm is None:
            self._arm = FakeArm(self.arm_at)
            session = self._arm.session
            for topic, into in ((REACH_EVENT, self.events), (REACH_STATE, self.states)):
                session.declare_subscriber(topic.key("reach"), _into(topic, into))
        return self._arm

    def wire(self, target: str) -> Wire:
        """A connection to ``target`` that can be cut."""
        self._wires.append(Wire(target))
        return self._wires[-1]

    def board(
        self,
        name: str = "board0",
        ahead: float = 0.0,
        prefix: str = "",
        via: str | None = None,
    ) -> Program:
        script = str(Path(__file__).with_name("board_process.py"))
        return self._start(
            [sys.executable, script, via or self.reachd_at, name, str(ahead), prefix]
        )

    def reachd(
        self, *words: str, listen: str | None = None, via: str | None = None, **environment: str
    ) -> Program:
        bus = ["--listen", listen or self.reachd_at, "--connect", via or self.arm_at]
        return self._start([sys.executable, "-m", "reachd", *bus, *words], **environment)

    def patient(self, *strict: str, more: str = "") -> tuple[str, str]:
        """Flags of `patient_config` in the lab's folder."""
        return patient_config(self.folder, *strict, more=more)

    def reach(self, *words: str, **how: Any) -> Program:
        """A reachd that moves the arm; started anew where a starved machine let it find no input.

        That one says so before anything moves, and ends with 3.
        """
        for _ in range(TRIES):
            program = self.reachd(*words, "--wait", str(PATIENCE_S), **how)
            wait_until(lambda p=program: self.arm.moving or not p.running)  # type: ignore[misc]
            if program.running or program.wait() != 3:
                return program
            for log in self.folder.glob("*.mcap"):
                log.unlink()
        raise AssertionError(program.said)

    def ask(self, service: str, request: object = None) -> Any:
        return call(self.arm.session, service_key("reach", service, "reach"), request, PATIENCE_S)

    def arms(self) -> bool:
        """Ask to arm; False while refused, as before the arm has granted its command."""
        try:
            return bool(self.ask("arm")["armed"])
        except ServiceError:
            return False

    def codes(self, kind: str) -> list[str]:
        return [event.code for event in list(self.events) if event.kind == kind]

    def wait_for_codes(self, kind: str, *codes: str) -> None:
        """Wait until reachd has told of events of all these codes."""
        wait_until(lambda: set(codes) <= set(self.codes(kind)), explain=lambda: self.codes(kind))

    def stopped(self) -> bool:
        """Whether the arm has been told to stand still for good: ten commands in a row.

        Where reachd has ended meanwhile, it was told so a few times, and stands.
        """
        last = self.arm.heard[-10:]
        if len(last) == 10 and all(h.still for h in last):
            return True
        return not (self.arm.moving or self._reachd_runs)

    @property
    def _reachd_runs(self) -> bool:
        return any(p.running for p in self._programs if "reachd" in p.words)

    def wait_until_told_to_stop(self) -> None:
        """Wait until the last command to the arm is zero; it may be under way when reachd ends.

        On a loaded machine it may arrive expired, or not before reachd's session has closed. Then
        the arm must have stopped by itself. That zeros are sent is for `tests/reachd/test_loop.py`.
        """

        def stands() -> bool:
            told = bool(self.arm.heard) and self.arm.heard[-1].still
            return told or not (self.arm.moving or self._reachd_runs)

        wait_until(stands)

    def close(self) -> None:
        # Daemons end before their boards: one that outlives its board would follow the remaining
        # link to a terminal that may already belong to another test.
        for program in reversed(self._programs):
            program.end()
        for wire in self._wires:
            wire.close()
        if self._arm is not None:
            self._arm.close()

    def _start(self, words: list[str], **environment: str) -> Program:
        program = Program(
            self.folder, words, **({"TACTILE_RUNTIME_DIR": str(self.folder)} | environment)
        )
        self._programs.append(program)
        return program


def _into(topic: Any, into: list[Any]) -> Callable[[zenoh.Sample], None]:
    return lambda sample: into.append(codec().decode(topic, sample.payload.to_bytes()))
