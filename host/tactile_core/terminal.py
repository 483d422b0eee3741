"""What daemons say to people: log lines, and a few figures put the same way everywhere."""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from typing import Final, Self

from rich.console import Console
from rich.live import Live
from rich.logging import RichHandler
from rich.table import Table
from rich.text import Text

from tactile_core.log.recorder import Recorder
from tactile_core.types import monotonic_now, seconds_between

log = logging.getLogger(__name__)

PLAIN_EVERY: Final = 5.0
"""s between plain lines where there is no terminal."""


class LiveLines(ABC):
    """What people see while a daemon runs: live lines on a terminal, else plain ones now and then.

    A context manager, used from the main thread. Below the lines stands the log of ``recorder``.
    """

    def __init__(self, console: Console, recorder: Recorder | None) -> None:
        self._recorder = recorder
        self._plain_at = monotonic_now()
        self._failed = False
        self._live = (
            Live(console=console, auto_refresh=False, transient=True)
            if console.is_terminal
            else None
        )

    def __enter__(self) -> Self:
        """Begin."""
        if self._live is not None:
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Leave the terminal as it was."""
        if self._live is not None:
            self._live.stop()

    def show(self) -> None:
        """Refresh the live lines, or log plain ones when it is time; to be called often.

        What cannot be shown is told once, and ends nothing.
        """
        try:
            self._show()
        except Exception as error:
            if not self._failed:
                self._failed = True
                log.error("the state cannot be shown", exc_info=error)

    def _show(self) -> None:
        if self._live is not None:
            table = self.table()
            if table is not None:
                self._live.update(self._above_the_log(table), refresh=True)
        elif seconds_between(self._plain_at, monotonic_now()) >= PLAIN_EVERY:
            self._plain_at = monotonic_now()
            for line in self.lines():
                log.info("%s", line)
            if self._recorder is not None:
                log.info("log %s", describe_log(self._recorder))

    @abstractmethod
    def table(self) -> Table | None:
        """The live lines; None while there is nothing to show."""

    @abstractmethod
    def lines(self) -> Iterable[str]:
        """The plain lines."""

    def _above_the_log(self, table: Table) -> Table:
        if self._recorder is None:
            return table
        good = self._recorder.stats.state == "recording"
        grid = Table.grid()
        grid.add_row(table)
        row = Text(describe_log(self._recorder), "" if good else "red")
        text = Text.assemble(("log ", "dim"), row)
        text.no_wrap, text.overflow = True, "ellipsis"
        grid.add_row(text)
        return grid


def set_up_logging(console: Console, *, verbose: bool) -> None:
    """Log above the live lines of a terminal, or plain lines with their time elsewhere."""
    level = logging.DEBUG if verbose else logging.INFO
    if console.is_terminal:
        handler: logging.Handler = RichHandler(
            console=console, show_path=False, rich_tracebacks=False, markup=False
        )
        handler.setFormatter(logging.Formatter("%(message)s"))
    else:
        handler = logging.StreamHandler()
        handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(message)s"))
    logging.basicConfig(level=level, handlers=[handler], force=True)


def drops_text(drops: Mapping[str, int]) -> str:
    """Counts by reason, the largest first."""
    if not drops:
        return "0"
    ordered = sorted(drops.items(), key=lambda item: -item[1])
    shown = " ".join(f"{reason}={n}" for reason, n in ordered[:4])
    return f"{shown} …" if len(ordered) > 4 else shown


def describe_log(recorder: Recorder) -> str:
    """State of the log in one line."""
    stats = recorder.stats
    text = f"{stats.path}  {stats.bytes_written / 1e6:.1f} MB"
    if stats.state != "recording":
        text += f"  {stats.state.upper()} {stats.last_error}"
    if stats.dropped:
        text += f"  dropped {drops_text(stats.dropped)}"
    return text
