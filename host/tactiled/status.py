"""The status shown while tactiled runs: a live line per board, or plain lines now and then.

A line starts with the force on the skin, or why there is none, and fits 80 columns.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from rich.console import Console
from rich.table import Table
from rich.text import Text

from tactile_core.cli import LiveLines
from tactile_core.geometry import Side
from tactile_core.log.recorder import Recorder
from tactile_core.types import Instant, monotonic_now, seconds_between
from tactiled.blocks import Features
from tactiled.board_session import BoardSession
from tactiled.port import Port

REFRESH = 0.2
"""s between refreshes of the live lines."""

WIDTH = 80
"""Columns of a plain line, and of a terminal of unknown width."""

NAME_WIDTH = 12
"""Columns of a board's name; longer ones are shortened in the middle."""

FULL_BAR_N = 10.0
"""N at which a force bar is full; the paper's thresholds are lower."""

BAR = " ▁▂▃▄▅▆▇█"

STALE_AFTER = 0.5
"""s without data after which a board's figures are shown as old."""

STALE_PERIODS = 3
"""The same in periods of its rate, if that is longer."""

SIDES = ((Side.LEFT, "left"), (Side.RIGHT, "right"), (Side.TIP, "tip"))


@dataclass(frozen=True, slots=True)
class BoardSummary:
    """What is shown of a board. ``forces``: normal force of the contacts on each side, N.

    ``bound``: 95 % bound of the error of their sum, N; inf where unknown. ``rate``: Hz.
    ``latency``: median from the last byte to the features, s; NaN when not measured. ``alarms``:
    warnings of faults to come.
    """

    name: str
    state: str
    forces: Mapping[Side, float]
    valid: bool
    reasons: tuple[str, ...]
    rate: float
    drops: int
    latency: float
    bound: float = math.inf
    alarms: tuple[str, ...] = ()


def summarise(board: BoardSession, now: Instant) -> BoardSummary:
    """Collect what is shown of a board at ``now``."""
    cycle, limit = board.last, STALE_AFTER
    if board.rate > 0:
        limit = max(limit, STALE_PERIODS / board.rate)
    forces: dict[Side, float] = {}
    reasons: tuple[str, ...] = ()
    valid, bound = False, math.inf
    if cycle is not None and seconds_between(cycle.received, now) < limit:
        features = cycle.features
        valid = features.valid
        if cycle.calibrated:  # nominal figures are accurate only to within a factor of two
            bound = features.normal_force_bound
        reasons = tuple(reason.text for reason in features.reasons)
        if board.choice is not None:
            arrays = board.choice.calibration.geometry.arrays
            forces = side_forces(features, list(dict.fromkeys(a.side for a in arrays)))
    drops = sum(board.summary.get("drops", {}).values())
    return BoardSummary(
        board.name, board.state, forces, valid, reasons, board.rate, drops,
        board.latency.p50, bound, tuple(board.summary.get("alarms", ())),
    )  # fmt: skip


def side_forces(features: Features, sides: Sequence[Side]) -> dict[Side, float]:
    """Normal force of the contacts on each of ``sides``, N."""
    if len(sides) == 1:
        return {sides[0]: features.normal_force}
    return {
        side: sum((p.normal_force for p in features.patches if p.side is side), 0.0)
        for side in sides
    }


def line(seen: BoardSummary, width: int = WIDTH, name_width: int = 0) -> Text:
    """Format at most ``width`` columns: name, force or why there is none, then the rest.

    ``name_width``: columns of the longest name, to align the lines.
    """
    text = Text(no_wrap=True)
    text.append(f"{_cut_middle(seen.name, NAME_WIDTH):{min(name_width, NAME_WIDTH)}}", "bold")
    if seen.state != "streaming":
        text.append(f"  {seen.state}", "red" if seen.state == "refused" else "yellow")
    elif seen.valid and seen.forces:
        text.append("  " + force_text(seen.forces, seen.bound), "green")
    elif seen.reasons:
        text.append("  not valid", "yellow")
    if seen.state == "streaming" and seen.rate > 0:
        text.append(f"  {seen.rate:.3g} Hz")
    text.append(f"  {seen.drops} dropped", "yellow" if seen.drops else "")
    if seen.state == "streaming" and not math.isnan(seen.latency):
        latency = f"  latency {_duration(seen.latency)}"
        if len(latency) <= width - text.cell_len:
            text.append(latency)
    room = width - text.cell_len - 2
    said = (*seen.alarms, *seen.reasons)
    if said and room > 8:
        because = Text("  " + "; ".join(said), "yellow")
        because.truncate(room + 2, overflow="ellipsis")
        text.append_text(because)
    text.truncate(width, overflow="ellipsis")
    return text


def force_text(forces: Mapping[Side, float], bound: float = math.inf) -> str:
    """Force of each side in N with a bar; a single side has its bound instead of a name."""
    shown = [(name, forces[side]) for side, name in SIDES if side in forces]
    if len(shown) <= 1:
        force = sum(forces.values())
        within = f" ± {bound:.2f}" if math.isfinite(bound) else ""
        return f"{force:5.2f}{within} N {bar(force)}"
    return "  ".join(f"{name} {force:.1f}{bar(force)}" for name, force in shown) + " N"


def bar(force: float) -> str:
    """One character for a force in N, full at `FULL_BAR_N`."""
    level = round(min(max(force / FULL_BAR_N, 0.0), 1.0) * (len(BAR) - 1))
    return BAR[level]


class StatusLines(LiveLines):
    """Live lines of the boards of ``ports``."""

    def __init__(self, console: Console, ports: list[Port], recorder: Recorder | None) -> None:
        super().__init__(console, recorder)
        self._ports = ports
        self._console = console

    def _boards(self) -> list[BoardSession]:
        return [board for port in self._ports for board in list(port.boards.values())]

    def table(self) -> Table:
        """A row for each board."""
        table, now, boards = Table.grid(), monotonic_now(), self._boards()
        names = max((len(board.name) for board in boards), default=0)
        for board in boards:
            table.add_row(line(summarise(board, now), self._console.width, names))
        return table

    def lines(self) -> list[str]:
        """A line for each board."""
        now = monotonic_now()
        return [line(summarise(board, now)).plain.rstrip() for board in self._boards()]


def _duration(seconds: float) -> str:
    return f"{seconds * 1e3:.1f} ms" if seconds < 0.1 else f"{seconds:.1f} s"


def _cut_middle(text: str, width: int) -> str:
    if len(text) <= width:
        return text
    head = (width - 1) // 2
    return f"{text[:head]}…{text[head + 1 - width :]}"
