"""The status shown while reachd runs: a live line, or plain lines now and then."""

from __future__ import annotations

import math
from collections.abc import Sequence

from rich.console import Console
from rich.table import Table
from rich.text import Text

from reachd.control import ControlLoop, Cycle
from tactile_core.cli import LiveLines
from tactile_core.log.recorder import Recorder


class StatusLine(LiveLines):
    """Live line of a control loop."""

    def __init__(
        self,
        console: Console,
        loop: ControlLoop,
        recorder: Recorder | None,
        cautions: Sequence[str] = (),
    ) -> None:
        super().__init__(console, recorder)
        self._loop = loop
        self._cautions = len(cautions)

    def table(self) -> Table | None:
        """One row; None before the first control cycle."""
        cycle = self._loop.last
        if cycle is None:
            return None
        cells = describe(cycle, self._cautions)
        table = Table.grid(padding=(0, 2))
        style = "green" if cycle.decision.held is None else "red"
        table.add_row(
            Text(cells.pop("state"), f"bold {style}"),
            *(Text(f"{k} {v}" if v else "", no_wrap=True) for k, v in cells.items()),
        )
        return table

    def lines(self) -> list[str]:
        """One line; empty before the first control cycle."""
        cycle = self._loop.last
        if cycle is None:
            return []
        return [", ".join(f"{k} {v}" for k, v in describe(cycle, self._cautions).items() if v)]


def describe(cycle: Cycle, cautions: int = 0) -> dict[str, str]:
    """State of a reach in a few short texts, some of which may be empty.

    ``cautions``: number of checks that are off and limits that are too wide.
    """
    status, touch, arm = cycle.status, cycle.inputs.touch, cycle.inputs.arm
    return {
        "state": f"{status.state} ({status.activity}) {status.elapsed:.1f} s",
        "distance": f"{status.distance * 1e3:.1f} mm" if math.isfinite(status.distance) else "",
        "touch": "none" if touch is None else f"{touch.peak_force:.1f} N {_age(cycle.touch_age)}",
        "arm": "none"
        if arm is None
        else f"{arm.mode} {math.hypot(arm.fx, arm.fy):.1f} N {_age(cycle.arm_age)}",
        "late": f"{cycle.lateness * 1e3:.1f} ms",
        "CAUTIONS": str(cautions) if cautions else "",
        "gate": ", ".join(str(i.code) for i in cycle.decision.interventions),
    }


def _age(seconds: float) -> str:
    return f"{seconds * 1e3:.0f} ms" if abs(seconds) < 10 else f"{seconds:.0f} s"
