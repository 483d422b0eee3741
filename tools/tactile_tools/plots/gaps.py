"""Holes in a curve, and the presses in it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]

HOLE_PERIODS = 5.0
"""Periods without a point that are a hole: what a scheduler delays is shorter."""
NEAR = 31
"""Steps whose median is the period thereabouts: a rate may be changed in the middle of a log."""

CHATTER_S = 0.5
"""s for which a press may be let go and still be the same."""
PROMINENCE = 0.4
"""Share of a maximum by which the force must have fallen between it and a greater one."""
BIN_S, MOST_BINS = 0.05, 200_000


def holes(time: Sequence[float] | Float) -> list[tuple[float, float]]:
    """(begin, end) s of each stretch in which points are missing, in order."""
    from scipy.ndimage import median_filter

    times = np.asarray(time, float)
    if len(times) < 4:
        return []
    steps = np.diff(times)
    usual = np.maximum(median_filter(steps, min(NEAR, len(steps)), mode="nearest"), 1e-6)
    return [
        (float(times[i]), float(times[i + 1]))
        for i in np.flatnonzero(steps > HOLE_PERIODS * usual).tolist()
    ]


def period(time: Sequence[float] | Float) -> float:
    """Median step, s; 0 of fewer than two points."""
    return float(np.median(np.diff(time))) if len(time) > 1 else 0.0


def broken(time: Sequence[float] | Float, values: Any) -> tuple[Float, Float]:
    """Curve with a NaN in each hole, so that no line is drawn through it."""
    times, points = np.asarray(time, float), np.asarray(values, float)
    after = np.searchsorted(times, [end for _, end in holes(times)])
    middle = [(times[i - 1] + times[i]) / 2 for i in after]
    return np.insert(times, after, middle), np.insert(points, after, np.nan, axis=0)


def presses(time: Sequence[float] | Float, force: Any, least: float, count: int) -> list[int]:
    """Indices, in order of time, of the strongest point of each of the strongest presses.

    ``force``: (points, places) N. A press is a maximum at one place (an array of a skin) that is
    at least ``least`` N and stands out of what is about it by `PROMINENCE` of its height; what is
    let go for less than `CHATTER_S` is the same press. Presses within `CHATTER_S` at two places
    are one.
    """
    from scipy.ndimage import grey_closing
    from scipy.signal import find_peaks

    times, felt = np.asarray(time, float), np.nan_to_num(np.asarray(force, float))
    if not len(times):
        return []
    width = max(BIN_S, 1.5 * period(times), (times[-1] - times[0]) / MOST_BINS)
    bins = ((times - times[0]) / width).astype(int)
    found: list[tuple[float, int]] = []
    for place in range(felt.shape[1]):
        most = np.zeros(bins[-1] + 3)  # an empty bin at each end, so that what is cut off counts
        np.maximum.at(most, bins + 1, felt[:, place])
        reach = 1 + round(CHATTER_S / width)
        closed = grey_closing(np.pad(most, reach), (reach,))[reach:-reach]
        _, about = find_peaks(closed, height=least, prominence=0.0, plateau_size=1)
        for height, rise, left, right in zip(
            *(about[k] for k in ("peak_heights", "prominences", "left_edges", "right_edges")),
            strict=True,
        ):
            inside = np.flatnonzero((bins + 1 >= left) & (bins + 1 <= right))
            if rise >= PROMINENCE * height and len(inside):
                index = int(inside[felt[inside, place].argmax()])
                found.append((float(felt[index, place]), index))
    chosen: list[int] = []
    for _, index in sorted(found, reverse=True):
        if all(abs(times[index] - times[other]) > CHATTER_S for other in chosen):
            chosen.append(index)
        if len(chosen) == count:
            break
    return sorted(chosen)
