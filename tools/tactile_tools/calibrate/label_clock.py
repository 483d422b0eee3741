"""Find when labels were true: a reference read more slowly than it measures skips readings.

A load cell that measures every T s and is read every R s, R a little more than T, hands over its
readings later and later until one is skipped; then it is up to date again. The lag is a sawtooth of
the height of one reading and the period of the beat, T R / (R - T), and shows as a jump in the
label at every tooth. It is found from labels and their times alone, never from the field or a
model.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tactile_core.arrays import FloatArray

NEIGHBOURS = 3
"""Steps on each side whose median is the slope that a jump stands out from."""
STEEP_SHARE = 0.25
"""Jumps can be seen only where the label changes by more than this share of its fastest change."""
JUMP_SHARE = (0.6, 1.5)
"""A jump adds between these shares of an ordinary step: one reading was skipped, not two."""
BEAT_STEPS = (8.0, 400.0)
"""Beats that are looked for, in readings: below, it would not be a beat; above, no recording shows
two."""
MIN_JUMPS = 15
MIN_CONCENTRATION = 0.85
"""Least mean resultant length R of the jumps' phases: n random jumps reach it at one beat with
probability exp(-n R²), so at any of a few hundred beats once in two hundred recordings."""
TOOTH_SEARCH = 4
"""Readings on each side of a tooth's expected place among which it is looked for."""


@dataclass(frozen=True, slots=True, eq=False)
class LabelClock:
    """Lag of labels. ``lag_s`` (k,): of each label, s, 0 to ``reading_s``; ``beat_s``: period, s.

    ``concentration``: how well the jumps keep to the beat, 0 to 1.
    """

    beat_s: float
    reading_s: float
    jumps: int
    concentration: float
    lag_s: FloatArray


def find_clock(time_s: FloatArray, label: FloatArray) -> LabelClock | None:
    """Find the sawtooth lag of ``label`` (k,), read at ``time_s`` (k,).

    None where there is no beat.
    """
    step = np.diff(time_s)
    period = float(np.median(step))
    slope = np.diff(label) / step
    usual = _running_median(slope)
    fast = float(np.percentile(np.abs(usual), 99))
    excess = np.divide(slope - usual, usual, out=np.zeros_like(slope), where=usual != 0)
    jump = (
        (np.abs(usual) > STEEP_SHARE * fast)
        & (excess > JUMP_SHARE[0])
        & (excess < JUMP_SHARE[1])
        & (step < 1.5 * period)
    )
    at = time_s[1:][jump]
    if len(at) < MIN_JUMPS:
        return None
    span = time_s[-1] - time_s[0]
    low, high = BEAT_STEPS[0] * period, min(BEAT_STEPS[1] * period, span / 2)
    # frequencies closer than a tenth of what the recording can resolve
    beats = 1.0 / np.arange(1.0 / high, 1.0 / low, 0.1 / span)
    phasor = np.exp(2j * np.pi * at[:, None] / beats).mean(axis=0)
    best = int(np.abs(phasor).argmax())
    concentration = float(np.abs(phasor[best]))
    if concentration < MIN_CONCENTRATION:
        return None
    beat = float(beats[best])
    reading = period * beat / (beat + period)
    first = float(np.angle(phasor[best])) / (2 * np.pi) * beat
    tooth = _teeth(time_s, label, beat, first)
    begin = np.array([first + beat * np.floor((time_s[0] - first) / beat), *time_s[tooth]])
    number = np.searchsorted(tooth, np.arange(len(time_s)), side="right")
    # The number of the tooth gives the lag of a reading, not the place where the tooth was seen:
    # teeth keep the beat.
    count = np.round((begin[number] - first) / beat)
    lag = (time_s - first - count * beat) * (reading / beat)
    return LabelClock(beat, reading, len(at), concentration, np.clip(lag, 0.0, reading))


def _teeth(time_s: FloatArray, label: FloatArray, beat: float, first: float) -> NDArray[np.intp]:
    """Index of the first label after each tooth: the steepest step near the expected place."""
    numbers = np.arange(
        np.ceil((time_s[0] - first) / beat + 1e-9), np.ceil((time_s[-1] - first) / beat)
    )
    expected = np.searchsorted(time_s, first + numbers * beat)
    out = []
    for place in expected.tolist():
        low = max(1, place - TOOTH_SEARCH)
        steps = np.abs(np.diff(label[low - 1 : place + TOOTH_SEARCH + 1]))
        best = place
        if len(steps) and steps.max() > (1 + JUMP_SHARE[0]) * np.median(steps) > 0:
            best = low + int(steps.argmax())
        out.append(best)
    return np.unique(np.array(out, np.intp))


def _running_median(values: FloatArray) -> FloatArray:
    padded = np.pad(values, NEIGHBOURS, mode="edge")
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * NEIGHBOURS + 1)
    return np.asarray(np.median(windows, axis=1))
