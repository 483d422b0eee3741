"""Progress shown while a simulation runs: a live line on a terminal, and totals at the end."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING

from rich.console import Console
from rich.table import Table
from rich.text import Text

from tactile_core.cli import LiveLines

if TYPE_CHECKING:
    from sim_device.ports_plan import Planned


class StatusLine(LiveLines):
    """Shows rates and losses of the ports of ``planned``, only if the output is a terminal."""

    def __init__(self, planned: Sequence[Planned], console: Console | None = None) -> None:
        super().__init__(console or Console(stderr=True))
        self._planned = planned
        self._last = (0.0, [0] * len(planned))
        self._text = ""

    def show_at(self, elapsed_s: float) -> None:
        """Show rates since the last call and losses so far, ``elapsed_s`` after the start."""
        before, counts = self._last
        now = [plan.server.sent for plan in self._planned]
        self._last = elapsed_s, now
        span = elapsed_s - before
        parts = []
        for plan, count, earlier in zip(self._planned, now, counts, strict=True):
            rate = (count - earlier) / span if span > 0 else 0.0
            part = f"{plan.name} {rate:.0f}/s"
            if plan.note is not None:
                part += f"  {plan.note()}"
            elif losses := sum(plan.server.losses.values()):
                part += f" lost {losses}"
            parts.append(part)
        self._text = f"{elapsed_s:8.1f} s  " + "  ".join(parts)
        self.show()

    def table(self) -> Table:
        """Table of one row, the line."""
        table = Table.grid()
        table.add_row(Text(self._text, no_wrap=True, overflow="ellipsis"))
        return table

    def lines(self) -> tuple[str, ...]:
        """No lines: what was announced and the totals are enough for a file."""
        return ()

    def sum_up(self) -> None:
        """Print to standard error what each port sent and lost."""
        for plan in self._planned:
            losses = {k: v for k, v in plan.server.losses.items() if v}
            lost = ", ".join(f"{name} {count}" for name, count in sorted(losses.items()))
            text = f"{plan.name}: {plan.server.sent} sent" + (f"; {lost}" if lost else "")
            print(text, file=sys.stderr, flush=True)
