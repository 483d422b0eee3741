"""What people see while reachd runs: a live line, or plain lines now and then."""

from __future__ import annotations

import logging
import math

from rich.console import Console
from rich.live import Live
from rich.table import Table
from rich.text import Text

from reachd.cycle import Cycle
from reachd.loop import ControlLoop
from tactile_bus.instant import monotonic_now, seconds_between
from tactile_bus.recorder import Recorder
from tactile_bus.terminal import describe_log

log = logging.getLogger(__name__)

PLAIN_EVERY = 5.0
"""s between plain lines."""


class StatusLine:
    """Shows what ``loop`` does; `show` is called often, from the main thread."""

    def __init__(self, console: Console, loop: ControlLoop, recorder: Recorder | None) -> None:
        self._loop = loop
        self._recorder = recorder
        self._live: Live | None = None
        self._plain_at = monotonic_now()
        if console.is_terminal:
            self._live = Live(console=console, auto_refresh=False, transient=True)

    def __enter__(self) -> StatusLine:
        """Begin."""
        if self._live is not None:
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Leave the terminal as it was."""
        if self._live is not None:
            self._live.stop()

    def show(self) -> None:
        """Refresh the live line, or log a plain one when it is time."""
        cycle = self._loop.last
        if cycle is None:
            return
        if self._live is not None:
            self._live.update(self._table(cycle), refresh=True)
        elif seconds_between(self._plain_at, monotonic_now()) >= PLAIN_EVERY:
            self._plain_at = monotonic_now()
            log.info("%s", ", ".join(f"{k} {v}" for k, v in describe(cycle).items() if v))

    def _table(self, cycle: Cycle) -> Table:
        cells = describe(cycle)
        table = Table.grid(padding=(0, 2))
        style = "green" if cycle.decision.held is None else "red"
        table.add_row(
            Text(cells.pop("state"), f"bold {style}"),
            *(Text(f"{k} {v}" if v else "", no_wrap=True) for k, v in cells.items()),
        )
        if self._recorder is None:
            return table
        good = self._recorder.stats.state == "recording"
        grid = Table.grid()
        grid.add_row(table)
        row = Text(describe_log(self._recorder), "" if good else "red")
        grid.add_row(Text.assemble(("log ", "dim"), row))
        return grid


def describe(cycle: Cycle) -> dict[str, str]:
    """State of a reach in a few short texts; empty where there is nothing to say."""
    status, touch, arm = cycle.status, cycle.inputs.touch, cycle.inputs.arm
    return {
        "state": f"{status.state} ({status.activity}) {status.elapsed:.1f} s",
        "distance": f"{status.distance * 1e3:.1f} mm" if math.isfinite(status.distance) else "",
        "touch": "none" if touch is None else f"{touch.peak_force:.1f} N {_age(cycle.touch_age)}",
        "arm": "none"
        if arm is None
        else f"{arm.mode} {math.hypot(arm.fx, arm.fy):.1f} N {_age(cycle.arm_age)}",
        "late": f"{cycle.lateness * 1e3:.1f} ms",
        "gate": ", ".join(str(i.code) for i in cycle.decision.interventions),
    }


def _age(seconds: float) -> str:
    return f"{seconds * 1e3:.0f} ms" if abs(seconds) < 10 else f"{seconds:.0f} s"
