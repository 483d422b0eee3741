"""How large a count of a chip is: told by the board, or found in the values that it sends.

A chip hands over 16-bit counts. Boards that send floats multiply them by the chip's scale, so
that all their values lie on a grid; its step tells where the counts end and how they wrap.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tactile_core.arrays import FloatArray

Bool = NDArray[np.bool_]
Scale = tuple[float, float]
"""µT a count of x and y, and of z."""

COUNTS = 65536
"""Values of a count."""

KNOWN_UT = (0.150, 0.200, 0.250, 0.300, 0.375, 0.451, 0.601, 0.751)
KNOWN_Z_UT = (0.242, 0.323, 0.403, 0.484, 0.605, 0.727, 0.968, 1.210)
"""µT a count of an MLX90393 (datasheet, HALLCONF 0xC) from gain 7 to 0, finest resolution."""
RESOLUTIONS = (1.0, 2.0, 4.0, 8.0)
SNAP = 1.5e-3
"""Relative distance at which a step that was found is taken for one of the datasheet."""

SAMPLES = 48
"""Cycles looked at; noise of a third of a step then shows neighbouring counts for certain."""
MOST_SKIPPED = 8192
"""Cycles at most between two looks at values that show no grid."""
DISTINCT = 10
"""Least number of different values: chance puts ten on a grid once in 10^6, and values that lie on
none hardly ever repeat, so that there are hundreds."""
FINEST_UT = 0.02
"""Steps below are rounding of floats, or values that were computed: not a grid."""
ON_GRID = 0.12
"""Distance from the grid in steps that rounding of float32 explains."""
MISFITS = 2
"""Looks in a row at which readings do not fit the grid before it is given up."""

JUMP_UT = np.array([6500.0, 6500.0, 10_500.0])[:, None]
"""µT from one reading to the next that a contact, a skin taken off or a magnet does not make
where the counts' range is not known: two thirds of the least range, 9.83 and 15.86 mT."""
JUMP_LIMIT_UT = 20_000.0
"""The same where the range is known and larger: twice the field of the usual magnet at rest."""
AMBIGUOUS_RATIO = 1 / 3
"""Share of the range beyond which a jump may as well be a wrap."""


class ScaleFinder:
    """Finds the step of x and y, and of z, of one array from `SAMPLES` cycles of its values."""

    def __init__(self) -> None:
        self._kept: list[FloatArray] = []
        self._skip = 0
        self._failures = 0

    def add(self, raw: FloatArray) -> tuple[float, float] | None:
        """Take (3, n) µT in chip axes; the steps (xy, z) in µT when they have been found.

        Begins anew by itself, ever less often, where what was kept shows no grid.
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
    """Step in µT of the grid that every column of (k, m) values lies on; None: there is none."""
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
    # Small values first: each refines the step well enough for the next larger ones.
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
    """Whether all values are whole steps."""
    counts = values / step
    return bool((np.abs(counts - np.rint(counts)) < ON_GRID).all())


class Scales:
    """Sizes of the counts of a board's chips, and the limits that follow from them.

    ``steps``: (A, 3, 1) µT a count, NaN where it is not known. ``jump``: (A, 3, 1) µT from one
    reading to the next that no contact makes, or that may as well be a wrap. ``rails``: the lowest
    and the highest count, µT. ``top``: µT, the least of the latter.
    """

    def __init__(self, real: Bool) -> None:
        arrays = len(real)
        self._real = real
        self._now: list[Scale | None] = [None] * arrays
        self._before: list[Scale | None] = [None] * arrays
        self._told = [False] * arrays
        self._misfits = [0] * arrays
        self._finders: list[ScaleFinder | None] = [ScaleFinder() for _ in range(arrays)]
        self.seeking = True
        """Whether there are arrays that `learn` is to look at."""
        self.steps = np.full((arrays, 3, 1), np.nan)
        self._bounds()

    def told(self, array: int, scale: Scale) -> bool:
        """Take over what the board says; True when it said otherwise before, or values did."""
        if self._now[array] == scale:
            return False
        self._told[array] = True
        return self._set(array, scale)

    def learn(self, raw: FloatArray) -> list[int]:
        """Look at (A, 3, n) µT as sent; arrays whose scale is found to be another than before."""
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
        """Give up scales that were found and that the readings of ``good`` (A, n) fit no more."""
        for a, scale in enumerate(self._now):
            if scale is None or self._told[a]:
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
        """(A, 3, 1) µT of all counts: what a wrap is off by; NaN where it is not known."""
        widest = np.minimum(AMBIGUOUS_RATIO * steps * COUNTS, JUMP_LIMIT_UT)
        self.jump = np.where(known, widest, JUMP_UT[None])
        # the last count at either end, less half of one
        low = np.where(known, -(COUNTS / 2 - 0.5) * steps, -np.inf)
        high = np.where(known, (COUNTS / 2 - 1.5) * steps, np.inf)
        self.rails = low, high
        self.top = float(high.min())
