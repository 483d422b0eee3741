"""Scale of a chip's counts: reported by the board, or found in the values that it sends.

A chip delivers 16-bit counts. Boards that send floats multiply them by the chip's scale, so that
all their values lie on a grid, whose step shows where the counts end and how they wrap.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tactile_core.arrays import FloatArray

Bool = NDArray[np.bool_]
Scale = tuple[float, float]
"""µT per count of x and y, and of z."""

COUNTS = 65536
"""Number of values of a 16-bit count."""

KNOWN_UT = (0.150, 0.200, 0.250, 0.300, 0.375, 0.451, 0.601, 0.751)
KNOWN_Z_UT = (0.242, 0.323, 0.403, 0.484, 0.605, 0.727, 0.968, 1.210)
"""µT per count of an MLX90393 (datasheet, HALLCONF 0xC) from gain 7 to 0, finest resolution."""
RESOLUTIONS = (1.0, 2.0, 4.0, 8.0)
"""Factors of these scales at the chip's coarser resolutions."""
SNAP = 1.5e-3
"""Relative distance within which a step counts as one of the datasheet's."""

SAMPLES = 48
"""Cycles analysed; with noise of a third of a step they contain neighbouring counts for certain."""
MOST_SKIPPED = 8192
"""Most cycles between two analyses of values that show no grid."""
DISTINCT = 10
"""Fewest different values: by chance ten lie on a grid once in 10^6, and values without a grid
hardly ever repeat, so that there are hundreds."""
FINEST_UT = 0.02
"""Smaller steps are rounding of floats or computed values, not a grid."""
ON_GRID = 0.12
"""Distance from the grid in steps that rounding of float32 explains."""
MISFITS = 2
"""Checks in a row in which readings do not fit the grid before it is dropped."""

JUMP_UT = np.array([6500.0, 6500.0, 10_500.0])[:, None]
"""µT from one reading to the next that no contact, removed skin or magnet causes, when the range of
the counts is unknown: two thirds of the smallest range, 9.83 and 15.86 mT."""
JUMP_LIMIT_UT = 20_000.0
"""The same when the range is known and larger: twice the field of the usual magnet at rest."""
AMBIGUOUS_RATIO = 1 / 3
"""Share of the range above which a jump may also be a wrap."""


class ScaleFinder:
    """Finds the scale of one array from `SAMPLES` cycles of its values."""

    def __init__(self) -> None:
        self._kept: list[FloatArray] = []
        self._skip = 0
        self._failures = 0

    def add(self, raw: FloatArray) -> tuple[float, float] | None:
        """Add a reading, (3, n) µT in chip axes; returns the scale once it is found.

        Tries again, less and less often, when the values show no grid.
        """
        if self._skip:
            self._skip -= 1
            return None
        self._kept.append(raw.copy())
        if len(self._kept) < SAMPLES:
            return None
        values = np.array(self._kept)
        self._kept = []
        xy = step_of(values[:, :2].reshape(len(values), -1), KNOWN_UT)
        z = None if xy is None else step_of(values[:, 2], KNOWN_Z_UT)
        if xy is not None and z is not None:
            return xy, z
        self._skip = min(SAMPLES << self._failures, MOST_SKIPPED)
        self._failures += 1
        return None


def step_of(values: FloatArray, known: tuple[float, ...] = ()) -> float | None:
    """Step, µT, of the grid on which every column of (k, m) values lies; None: there is none."""
    flat = np.abs(values[np.isfinite(values)])
    distinct = np.unique(flat[flat > FINEST_UT])
    if len(distinct) < DISTINCT:
        return None
    steps: list[float] = []
    for column in values.T:
        gaps = np.diff(np.unique(column[np.isfinite(column)]))
        gaps = gaps[gaps > FINEST_UT]
        if len(gaps):
            steps.append(float(gaps.min()))
    if not steps:
        return None
    step = min(steps)
    # Small values first: they refine the step well enough for the next larger ones.
    for most in (8, 64, 512, 4096, COUNTS):
        some = distinct[distinct < most * step]
        counts = np.rint(some / step)
        if counts.any():
            step = float((some * counts).sum() / (counts * counts).sum())
    likely = [fine * factor for fine in known for factor in RESOLUTIONS]
    snapped = [one for one in likely if abs(step / one - 1) < SNAP]
    for one in (*snapped, step):
        if on_grid(distinct, one):
            return one
    return None


def on_grid(values: FloatArray, step: float) -> bool:
    """Whether all values are multiples of ``step``."""
    counts = values / step
    return bool((np.abs(counts - np.rint(counts)) < ON_GRID).all())


class Scales:
    """Scales of a board's arrays, and the limits that follow from them.

    ``steps``: (A, 3, 1) µT per count, NaN where unknown. ``jump``: (A, 3, 1) µT from one reading to
    the next that no contact causes, or that may be a wrap. ``rails``: lowest and highest count,
    (A, 3, 1) µT each. ``top``: the smallest highest count, µT: below it no reading is near any end
    of a range.
    """

    def __init__(self, real: Bool) -> None:
        arrays = len(real)
        self._real = real
        self._now: list[Scale | None] = [None] * arrays
        self._before: list[Scale | None] = [None] * arrays
        self._reported = [False] * arrays
        self._misfits = [0] * arrays
        self._finders: list[ScaleFinder | None] = [ScaleFinder() for _ in range(arrays)]
        self.seeking = True
        """Whether any scale is still unknown, so that `learn` must be called."""
        self.steps = np.full((arrays, 3, 1), np.nan)
        self._bounds()

    def set_reported(self, array: int, scale: Scale) -> bool:
        """Set the scale that the board reports; True when a different one was known before."""
        if self._now[array] == scale:
            return False
        self._reported[array] = True
        return self._set(array, scale)

    def learn(self, raw: FloatArray) -> list[int]:
        """Analyse readings as sent, (A, 3, n) µT; returns arrays whose scale has changed."""
        other = []
        for a, finder in enumerate(self._finders):
            if finder is None:
                continue
            values = raw[a]
            good = self._real[a] & np.isfinite(values).all(axis=0) & values.any(axis=0)
            found = finder.add(np.where(good, values, np.nan))
            if found is not None and self._set(a, found):
                other.append(a)
        return other

    def recheck(self, raw: FloatArray, good: Bool) -> None:
        """Drop scales found earlier that the readings of ``good`` (A, n) no longer fit."""
        for a, scale in enumerate(self._now):
            if scale is None or self._reported[a]:
                continue
            values = np.abs(raw[a][:, good[a]])
            fits = on_grid(values[:2].ravel(), scale[0]) and on_grid(values[2], scale[1])
            self._misfits[a] = 0 if fits else self._misfits[a] + 1
            if self._misfits[a] >= MISFITS:
                self._misfits[a] = 0
                self._set(a, None)

    def _set(self, a: int, scale: Scale | None) -> bool:
        other = scale is not None and self._before[a] not in (None, scale)
        self._now[a] = scale
        if scale is None:
            self.steps[a] = np.nan
            self._finders[a] = ScaleFinder()
        else:
            self._before[a] = scale
            self.steps[a, :, 0] = scale[0], scale[0], scale[1]
            self._finders[a] = None
        self.seeking = any(finder is not None for finder in self._finders)
        self._bounds()
        return other

    def _bounds(self) -> None:
        known = np.isfinite(self.steps)
        steps = np.where(known, self.steps, 0.0)
        self.span = self.steps * COUNTS
        """Range of all counts, by which a wrap is off, (A, 3, 1) µT; NaN where unknown."""
        widest = np.minimum(AMBIGUOUS_RATIO * steps * COUNTS, JUMP_LIMIT_UT)
        self.jump = np.where(known, widest, JUMP_UT[None])
        # the last count at either end, minus half a count
        low = np.where(known, -(COUNTS / 2 - 0.5) * steps, -np.inf)
        high = np.where(known, (COUNTS / 2 - 1.5) * steps, np.inf)
        self.rails = low, high
        self.top = float(high.min())
