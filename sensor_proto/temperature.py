"""Whether a column of numbers is the temperature of a chip: what tells apart how boards write.

Frames of four numbers a chip hold a temperature, frames of three do not, and twelve numbers may be
either. A temperature is within what a chip survives, nearly the same on all chips of a board, and
quiet: its noise is a few hundredths of a kelvin, a field's some microtesla.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

COLDEST_C, HOTTEST_C = -45.0, 130.0
"""MLX90393 works from −40 to 85 °C; some room for self-heating and trim."""

FAILED_C = (-998.1, 451.8)
"""What its temperature formula gives for raw 0 and 0xFFFF: the chip did not answer."""

TINY_C = 1e-3
"""Half of all bit patterns are floats below 1; a temperature in steps of 1/45.2 °C never is this
close to nought, save nought itself."""

STEPS_PER_K = 45.2
"""Steps of the chip's temperature in a kelvin (MLX90393 datasheet)."""

ON_STEP = 0.02
"""Part of a step by which a float may miss it."""

ALIKE_K = 25.0
"""K between the chips of one board, one of them beside a hot regulator."""

QUIET_K = 0.5
"""K between two frames; a chip's noise is a tenth of that, its warming still less."""

QUIETER = 3.0
"""Times that a field moves more than a temperature, in microtesla and kelvin."""

Float = NDArray[np.floating]


def plausible(temperature_c: Float) -> NDArray[np.bool_]:
    """Whether each can come from a chip, working or dead; same shape."""
    size = np.abs(temperature_c)
    usual = (temperature_c >= COLDEST_C) & (temperature_c <= HOTTEST_C)
    usual &= (size >= TINY_C) | (size == 0)
    for dead in FAILED_C:
        usual |= np.abs(temperature_c - np.float32(dead)) < 0.1
    return usual


@dataclass(frozen=True, slots=True)
class Evidence:
    """What speaks for one column a chip being its temperature.

    ``likely``: it can be. ``stepped``: every value is on the steps of the chip's thermometer, which
    no field is. ``quieter``: it moves much less than the other columns do.
    """

    likely: bool
    stepped: bool = False
    quieter: bool = False

    @property
    def sure(self) -> bool:
        """Whether it can hardly be a field."""
        return self.likely and (self.stepped or self.quieter)


def evidence(values: Float, column: int) -> Evidence:
    """Judge one column of (frames, chips, numbers a chip)."""
    with np.errstate(invalid="ignore", over="ignore"):
        seen = np.asarray(values[:, :, column], np.float64)
        good = plausible(seen)
        alive = good & (seen >= COLDEST_C) & (seen <= HOTTEST_C)
        if good.mean() < 0.8:
            return Evidence(False)
        if not alive.any():
            return Evidence(True, stepped=True)  # all dead, and each says so
        warm = np.where(alive, seen, np.nan)
        used = warm[alive.any(axis=1)]
        if (np.nanmax(used, axis=1) - np.nanmin(used, axis=1)).max() > ALIKE_K:
            return Evidence(False)
        moves = np.abs(np.diff(warm, axis=0))
        move = float(np.nanmedian(moves)) if np.isfinite(moves).any() else 0.0
        if move > QUIET_K:
            return Evidence(False)
        steps = warm[alive] * STEPS_PER_K
        off = np.abs(steps - np.round(steps))
        stepped = bool((off < ON_STEP).mean() > 0.9 and np.count_nonzero(steps))
        others = np.abs(np.diff(np.delete(values, column, axis=2).astype(np.float64), axis=0))
        others = others[np.isfinite(others)]
        other = float(np.median(others)) if others.size else 0.0
    return Evidence(True, stepped, other > QUIETER * move and other > 0)


def temperature_first(values: Float) -> bool | None:
    """Whether t comes first in (frames, chips, 4), or last (False); None: that cannot be told."""
    first, last = evidence(values, 0), evidence(values, 3)
    if first.likely != last.likely:
        return first.likely
    if not first.likely or first.stepped == last.stepped:
        return None
    return first.stepped


def with_or_without(values: Float) -> str | None:
    """Order of the numbers of each chip, ``txyz``, ``xyzt`` or ``xyz``, of (frames, numbers).

    None where that cannot be told, as with twelve numbers that hardly move.
    """
    count = values.shape[1]
    threes, fours = count % 3 == 0, count % 4 == 0
    if fours:
        grouped = values.reshape(len(values), -1, 4)
        first = temperature_first(grouped)
        if first is not None and (not threes or evidence(grouped, 0 if first else 3).sure):
            return "txyz" if first else "xyzt"
        if first is not None or evidence(grouped, 0).likely:
            return None
    return "xyz" if threes else None
