"""Split a recording into parts to fit and to test on that never hold neighbouring samples."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tactile_core.arrays import FloatArray

Bool = NDArray[np.bool_]

TAIL_SHARE = 0.8
"""Share of a recording's frames that ``tail20`` fits on; the rest is for testing (as by the eFlesh
authors)."""
FOLDS = 5
"""Blocks that a recording is cut into for cross-validation."""
GAP_S = 3.0
"""Time on both sides of a block that is neither fitted nor tested, s: longer than neighbouring
samples stay alike at the rates of presses."""


def block_edges(time_s: FloatArray, folds: int = FOLDS) -> list[tuple[float, float]]:
    """Times [begin, end) of ``folds`` blocks with equally many samples each, s."""
    bounds = np.linspace(0, len(time_s), folds + 1).round().astype(int)
    begin = [float(time_s[b]) for b in bounds[:-1]]
    return list(zip(begin, [*begin[1:], float("inf")], strict=True))


def block_masks(
    time_s: FloatArray, edges: tuple[float, float], gap_s: float = GAP_S
) -> tuple[Bool, Bool]:
    """Samples to fit on (at least ``gap_s`` s away from the block) and to test on (inside it)."""
    begin, end = edges
    test = (time_s >= begin) & (time_s < end)
    fit = (time_s < begin - gap_s) | (time_s >= end + gap_s)
    return fit, test
