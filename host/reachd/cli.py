"""The command ``reachd``."""

from __future__ import annotations

import argparse
import logging
import os
import sys
from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING

from reachd.arguments import make_parser
from tactile_core.cli import DONE, FAILED, USAGE, CommandError, set_up_logging
from tactile_core.daemon import Shutdown, run, serve

if TYPE_CHECKING:
    from reachd.daemon import Daemon
    from reachd.interfaces import Strategy
    from reachd.settings import Settings
    from reachd.status import StatusLine
    from reachd.trial import Outcome

log = logging.getLogger(__name__)

REFRESH_S = 0.1
"""Time between checks of the main thread on the others."""

HUNG = 20
"""Checks in a row without a new cycle after which the control loop counts as stuck: 2 s."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run reachd and return the exit status: 0 reached, 1 not reached, 2 usage, 3 refused.

    Without ``argv`` the arguments are those of the process, which ends here.
    """

    def parser(shutdown: Shutdown) -> argparse.ArgumentParser:
        parser = make_parser()
        parser.set_defaults(func=partial(_run, shutdown))
        return parser

    return run(parser, argv)


def _run(shutdown: Shutdown, options: argparse.Namespace) -> int:
    from rich.console import Console

    console = Console(stderr=True)
    set_up_logging(console, verbose=options.verbose)

    from reachd.daemon import Daemon
    from reachd.settings import SettingsError, make_settings
    from reachd.status import StatusLine
    from reachd.strategies import StrategyError

    try:
        settings = make_settings(options)
        strategy = _load(settings)
    except (SettingsError, StrategyError) as error:
        raise CommandError(str(error), USAGE) from error
    daemon = Daemon(settings, strategy)
    cautions = settings.parameters.safety.cautions

    def work() -> int:
        session = _Session(daemon, shutdown)
        with StatusLine(console, daemon.loop, daemon.recorder, cautions) as line:
            code = session.run(line)
        if code == FAILED:
            session.print_reason()
        return code

    return serve(daemon, shutdown, "disarmed", work)


def _load(settings: Settings) -> Strategy:
    """Load the strategy; the user's own may be in the folder that reachd was started in."""
    import numpy as np

    from reachd.strategies import load_strategy

    if ":" in settings.strategy and os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())
    rng = np.random.default_rng(settings.seed)
    return load_strategy(settings.strategy, settings.parameters, rng)


class _Session:
    """The main thread's work while the daemon runs."""

    def __init__(self, daemon: Daemon, shutdown: Shutdown) -> None:
        self._daemon = daemon
        self._shutdown_requested = shutdown.requested
        self._outcome: Outcome | None = None
        self._beat = 0
        self._idle_checks = 0

    def run(self, line: StatusLine) -> int:
        """Reach once, or serve until told to stop; returns the exit status."""
        daemon, settings = self._daemon, self._daemon.settings
        if settings.goal is not None:
            daemon.wait_ready(self._shutdown_requested)
            if not self._ended():
                daemon.reach(settings.goal)
        while not self._ended():
            self._shutdown_requested.wait(REFRESH_S)
            self._check(line)
            if not settings.serve and not daemon.moving:
                break
        daemon.cancel("reachd was told to stop")
        self._note_outcome()
        if settings.serve:
            return DONE
        return DONE if self._outcome is not None and self._outcome.success else FAILED

    def print_reason(self) -> None:
        """Print why there was no reach."""
        if self._outcome is None and self._daemon.failure is None:
            cycle = self._daemon.loop.last
            why = "" if cycle is None else cycle.status.text
            print(f"reachd: no reach: {why or 'told to stop before it began'}", file=sys.stderr)

    def _ended(self) -> bool:
        return self._shutdown_requested.is_set() or self._daemon.done.is_set()

    def _check(self, line: StatusLine) -> None:
        self._note_outcome()
        self._daemon.check_arm()
        line.show()
        self._daemon.watch()
        beat = self._daemon.loop.lateness.cycles
        self._idle_checks = self._idle_checks + 1 if beat == self._beat else 0
        self._beat = beat
        if self._idle_checks >= HUNG:
            self._daemon.fail(
                RuntimeError("the control loop is stuck, in the strategy most likely")
            )

    def _note_outcome(self) -> None:
        """Show new outcomes, and write them to the file asked for."""
        from rich.console import Console

        from reachd.publish import show

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


if __name__ == "__main__":
    sys.exit(main())
