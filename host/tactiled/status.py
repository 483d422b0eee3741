"""What people see while tactiled runs: a live line for each board, or plain lines now and then."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table
from rich.text import Text

from tactile_bus.geometry import Side
from tactile_bus.instant import monotonic_now, seconds_between
from tactile_bus.recorder import Recorder
from tactile_bus.terminal import LiveLines, drops_text
from tactiled.chip_watch import MOST_NAMED, Masked
from tactiled.port import Port
from tactiled.station import Station

REFRESH = 0.2
"""s between refreshes of the live lines."""

FULL_BAR_N = 10.0
"""N at which a force bar is full: the paper's thresholds lie below."""

BAR = " ▁▂▃▄▅▆▇█"
STALE_AFTER = 0.5
"""s without data after which a board's figures are shown as old."""

SIDES = ((Side.LEFT, "L"), (Side.RIGHT, "R"), (Side.TIP, "T"))


class StatusLines(LiveLines):
    """Shows the boards of ``ports``."""

    def __init__(self, console: Console, ports: list[Port], recorder: Recorder | None) -> None:
        super().__init__(console, recorder)
        self._ports = ports

    def _boards(self) -> list[Station]:
        return [station for port in self._ports for station in list(port.stations.values())]

    def table(self) -> Table:
        """A row for each board."""
        table = Table.grid(padding=(0, 2))
        for station in self._boards():
            cells = describe(station)
            style = {"streaming": "green", "refused": "red"}.get(station.state, "yellow")
            table.add_row(
                Text(station.name, "bold"),
                Text(cells.pop("state"), style),
                *(Text(f"{k} {v}" if v else "", no_wrap=True) for k, v in cells.items()),
            )
        return table

    def lines(self) -> list[str]:
        """A line for each board."""
        return [
            f"{station.name}: " + ", ".join(f"{k} {v}" for k, v in describe(station).items() if v)
            for station in self._boards()
        ]


def describe(station: Station) -> dict[str, str]:
    """State of a board in a few short texts; empty where there is nothing to say."""
    cycle = station.last
    fresh = cycle is not None and seconds_between(cycle.received, monotonic_now()) < STALE_AFTER
    latency = station.latency
    cells = {
        "state": station.state,
        "rate": f"{station.rate:.1f} Hz",
        "drops": drops_text(station.summary.get("drops", {})),
        "latency": ""
        if math.isnan(latency.p50)
        else f"{latency.p50 * 1e3:.1f}/{latency.p99 * 1e3:.1f} ms",
        "field": "",
        "force": "",
        "masked": "" if station.chips is None else masked_text(station.chips.masked),
        "because": "",
    }
    if cycle is not None and fresh:
        ambient = cycle.ambient
        if ambient.method != "off":
            good = "ok" if ambient.valid.all() else "INVALID"
            worst = float(np.nanmin(ambient.support)) if ambient.support.size else 0.0
            residual = float(np.nanmax(ambient.residual_ut)) if ambient.residual_ut.size else 0.0
            cells["field"] = f"{good} {worst:.0%} ±{residual:.1f} µT"
        cells["force"] = force_text(station)
        cells["because"] = ", ".join(reason.text for reason in cycle.features.reasons)
    return cells


def masked_text(chips: list[Masked]) -> str:
    """Chips that are masked, by array: ``skin 2 4``."""
    arrays: dict[str, list[int]] = {}
    for one in chips:
        arrays.setdefault(one.array, []).append(one.chip)
    named = []
    for array, which in arrays.items():
        few = len(which) <= MOST_NAMED
        named.append(f"{array} {' '.join(map(str, which)) if few else f'{len(which)} chips'}")
    return ", ".join(named)


def force_text(station: Station) -> str:
    """Peak normal force of each side as a bar and in N."""
    cycle, choice = station.last, station.choice
    if cycle is None or choice is None:
        return ""
    geometry = choice.calibration.geometry
    normal = -cycle.force[:, 2]
    peaks: dict[Any, float] = {}
    for array, taxels in zip(geometry.arrays, geometry.slices, strict=True):
        seen = normal[taxels]
        if np.isfinite(seen).any():
            peaks[array.side] = max(peaks.get(array.side, 0.0), float(np.nanmax(seen)))
    return " ".join(
        f"{letter}{bar(peaks[side])}{peaks[side]:4.1f} N" for side, letter in SIDES if side in peaks
    )


def bar(force: float) -> str:
    """One character for a force in N, full at `FULL_BAR_N`."""
    level = round(min(max(force / FULL_BAR_N, 0.0), 1.0) * (len(BAR) - 1))
    return BAR[level]
