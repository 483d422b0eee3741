"""The command ``reachd``."""

from __future__ import annotations

import logging
import os
import signal
import sys
import threading
from collections.abc import Sequence
from types import FrameType

import numpy as np
from rich.console import Console

from reachd.arguments import make_parser
from reachd.daemon import Daemon, StartError
from reachd.interfaces import Strategy
from reachd.publish import show
from reachd.settings import Settings, SettingsError, make_settings
from reachd.status import StatusLine
from reachd.strategies import StrategyError, load_strategy
from reachd.trial import Outcome
from tactile_core.ending import leave
from tactile_core.terminal import set_up_logging

log = logging.getLogger(__name__)

REACHED, FAILED, USAGE, REFUSED = range(4)

REFRESH = 0.1
"""s between looks of the main thread at the others."""

HUNG = 20
"""Looks in a row that see no new cycle after which the control loop is taken to be stuck: 2 s."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run reachd; the exit status: 0 reached, 1 not, 2 usage, 3 refused.

    Without ``argv`` this is the whole process, which then ends here.
    """
    code = _main(argv)
    if argv is None:
        leave(code)
    return code


def _main(argv: Sequence[str] | None) -> int:
    options = make_parser().parse_args(argv)
    console = Console(stderr=True)
    set_up_logging(console, verbose=options.verbose)
    try:
        settings = make_settings(options)
        strategy = _load(settings)
    except (SettingsError, StrategyError) as error:
        print(f"reachd: {error}", file=sys.stderr)
        return USAGE
    stopping = threading.Event()

    def stop(number: int, _: FrameType | None) -> None:
        stopping.set()
        signal.signal(number, signal.SIG_DFL)  # a second one ends it at once

    before = {n: signal.signal(n, stop) for n in (signal.SIGINT, signal.SIGTERM)}
    try:
        return _run(settings, strategy, console, stopping)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _load(settings: Settings) -> Strategy:
    """The strategy; one of the user's own may lie in the folder reachd was started in."""
    if ":" in settings.strategy and os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())
    rng = np.random.default_rng(settings.seed)
    return load_strategy(settings.strategy, settings.parameters, rng)


def _run(
    settings: Settings, strategy: Strategy, console: Console, stopping: threading.Event
) -> int:
    daemon = Daemon(settings, strategy)
    try:
        daemon.start()
    except StartError as error:
        print(f"reachd: {error}", file=sys.stderr)
        return REFUSED
    daemon.watchdog.ready("disarmed")
    session = _Session(daemon, stopping)
    try:
        with StatusLine(
            console, daemon.loop, daemon.recorder, settings.parameters.safety.cautions
        ) as line:
            code = session.run(line)
    except StartError as error:
        print(f"reachd: {error}", file=sys.stderr)
        code = REFUSED
    finally:
        clean = daemon.stop()
    code = session.conclude(code)
    if not clean:
        log.warning("a thread did not end in time; leaving without it")
        leave(code)
    return code


class _Session:
    """What the main thread does while the daemon runs."""

    def __init__(self, daemon: Daemon, stopping: threading.Event) -> None:
        self._daemon = daemon
        self._stopping = stopping
        self._outcome: Outcome | None = None
        self._beat = 0
        self._looks = 0

    def run(self, line: StatusLine) -> int:
        """Reach once, or serve until told to stop; the exit status."""
        daemon, settings = self._daemon, self._daemon.settings
        if settings.goal is not None:
            daemon.wait_ready(self._stopping)
            if not self._ended():
                daemon.reach(settings.goal)
        while not self._ended():
            self._stopping.wait(REFRESH)
            self._look(line)
            if not settings.serve and not daemon.moving:
                break
        daemon.cancel("reachd was told to stop")
        self._note_outcome()
        if settings.serve:
            return REACHED
        return REACHED if self._outcome is not None and self._outcome.success else FAILED

    def conclude(self, code: int) -> int:
        """Say how it ended; the exit status."""
        daemon = self._daemon
        if daemon.recorder is not None:
            log.info("log: %s", daemon.recorder.stats.path)
        if daemon.failure is not None:
            thread, cause = daemon.failure
            print(f"reachd: thread {thread} failed: {cause}", file=sys.stderr)
            return FAILED
        if self._outcome is None and code == FAILED:
            cycle = daemon.loop.last
            why = "" if cycle is None else cycle.status.text
            print(f"reachd: no reach: {why or 'told to stop before it began'}", file=sys.stderr)
        if daemon.recorder is not None and (problem := daemon.recorder.trouble) is not None:
            print(f"reachd: {problem}", file=sys.stderr)
            return FAILED if code == REACHED else code
        return code

    def _ended(self) -> bool:
        return self._stopping.is_set() or self._daemon.done.is_set()

    def _look(self, line: StatusLine) -> None:
        self._note_outcome()
        self._daemon.check_arm()
        line.show()
        self._daemon.watch()
        beat = self._daemon.loop.lateness.cycles
        self._looks = self._looks + 1 if beat == self._beat else 0
        self._beat = beat
        if self._looks >= HUNG:
            self._daemon.fail(
                RuntimeError("the control loop is stuck, in the strategy most likely")
            )

    def _note_outcome(self) -> None:
        """Show new outcomes, write them where they are wanted."""
        daemon = self._daemon
        finished = daemon.loop.controller.finished
        while finished:
            self._outcome, goal = finished.popleft()
            text = daemon.conclude(self._outcome, goal)
            show(Console(), self._outcome, goal, daemon.about)
            path = daemon.settings.json
            if path is None:
                continue
            try:
                path.write_text(text + "\n")
            except OSError as error:
                log.error("cannot write %s: %s", path, error.strerror)
