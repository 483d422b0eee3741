"""Features and labels side by side: a row per label, for each possible beginning of a recording."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tactile_core.arrays import FloatArray
from tactile_core.calibration.force_model import FeatureMap
from tactile_tools.calibrate.recording import TARE_S, UNTOUCHED_SHARE, Recording
from tactiled.sensing.forces import batch_features

Bool = NDArray[np.bool_]

LEAST_PAUSE_S = 3.0
"""A pause at least this long, s, can be the beginning of a recording: a tare, and time to spare."""
LEAST_REST_S = 20.0
"""A beginning with less than this left after it, s, would teach nothing about the past."""
MAX_RESTARTS = 12
"""Most beginnings of one recording; more take time and say the same."""


@dataclass(frozen=True, slots=True, eq=False)
class Copy:
    """One recording from one of its beginnings on: ``time_s`` (m,), ``features`` (m, F)."""

    recording: int
    time_s: FloatArray
    features: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Rows:
    """Rows to fit and to test on.

    ``features`` (r, F), ``labels`` (r, targets), ``time_s`` (r,) of the label, ``recording`` (r,)
    its index; ``whole`` (r,) is True for rows of recordings from their true beginning.
    """

    features: FloatArray
    labels: FloatArray
    time_s: FloatArray
    recording: NDArray[np.intp]
    whole: Bool


def beginnings(recording: Recording) -> list[int]:
    """Frames at which the recording could have begun: its first, and one in each pause."""
    out = [0]
    if not recording.forces or recording.rest_ut is not None:
        return out
    load = recording.load()
    idle = load <= UNTOUCHED_SHARE / 3 * load.max()
    edges = np.flatnonzero(np.diff(np.concatenate([[0], idle.astype(int), [0]])))
    for first, last in zip(edges[::2], edges[1::2] - 1, strict=True):
        begin, end = recording.label_time_s[first], recording.label_time_s[last]
        # The field still creeps fast at the start of a pause, and a press begins at its end.
        start = end - 2 * TARE_S
        if end - begin < LEAST_PAUSE_S or start <= recording.time_s[0] + LEAST_PAUSE_S:
            continue
        if recording.time_s[-1] - start >= LEAST_REST_S:
            out.append(int(np.searchsorted(recording.time_s, start)))
    if len(out) > MAX_RESTARTS:
        keep = np.linspace(0, len(out) - 1, MAX_RESTARTS).round().astype(int)
        out = [out[i] for i in keep]
    return out


def copies(features: FeatureMap, recordings: Sequence[Recording], restarts: bool) -> list[Copy]:
    """Features of every recording, from its beginning and, if ``restarts``, from each pause."""
    out = []
    for number, recording in enumerate(recordings):
        for start in beginnings(recording) if restarts else [0]:
            time = recording.time_s[start:]
            out.append(
                Copy(number, time, batch_features(features, time, recording.change_ut(start)))
            )
    return out


def align(made: Sequence[Copy], recordings: Sequence[Recording], delay_s: float) -> Rows:
    """Make a row for each label: the field ``delay_s`` s before it was read, never after it."""
    parts: list[tuple[FloatArray, FloatArray, FloatArray, NDArray[np.intp], Bool]] = []
    for copy in made:
        recording = recordings[copy.recording]
        time = recording.label_time_s
        inside = (time - recording.lag_s >= copy.time_s[0] + max(delay_s, 0.0)) & (
            time <= recording.time_s[-1]
        )
        if recording.rest_ut is not None or not recording.forces:
            inside = time >= copy.time_s[0]
        count = int(inside.sum())
        parts.append(
            (
                causal(copy.time_s, copy.features, time[inside], recording.lag_s[inside] + delay_s),
                recording.labels[inside],
                time[inside],
                np.full(count, copy.recording),
                np.full(count, len(copy.time_s) == len(recording.time_s)),
            )
        )
    columns = [np.concatenate(column) for column in zip(*parts, strict=True)]
    return Rows(columns[0], columns[1], columns[2], columns[3], columns[4])


def causal(
    time_s: FloatArray, values: FloatArray, at_s: FloatArray, delay_s: FloatArray | float
) -> FloatArray:
    """Interpolate ``values`` (m, F) at ``at_s - delay_s``, using no frame after ``at_s``."""
    if len(time_s) == 1:
        return np.repeat(values, len(at_s), axis=0)
    wanted = np.clip(at_s - delay_s, time_s[0], time_s[-1])
    left = np.clip(np.searchsorted(time_s, wanted, side="right") - 1, 0, len(time_s) - 2)
    share = np.clip((wanted - time_s[left]) / (time_s[left + 1] - time_s[left]), 0.0, 1.0)
    share[(time_s[left + 1] > at_s) & (share < 1.0)] = 0.0
    return values[left] + share[:, None] * (values[left + 1] - values[left])
