"""What limits the error on a recording: evidence from its data, cause by cause.

Each figure is the error that a perfect model of the skin would leave, in the unit of the label.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tactile_core.arrays import FloatArray
from tactile_tools.calibrate.evaluate import Judged
from tactile_tools.calibrate.recording import TARE_S, UNTOUCHED_SHARE
from tactiled.sensing.forces import batch_features, readout

STEADY = 5
"""Labels of a short run that a straight line is fitted to; a press is straight for a second."""


def limits(judged: Judged) -> dict[str, float]:
    """Evidence by name; each key ends in its unit."""
    recording = judged.recording
    if not recording.forces:
        return _place_limits(judged)
    label = recording.load()
    time = recording.label_time_s
    tested = judged.tested
    idle = tested & (label <= UNTOUCHED_SHARE / 3 * label.max())
    loaded = tested & ~idle
    values = np.unique(label)
    rate = np.gradient(label, time)
    period = float(np.median(np.diff(recording.time_s)))
    # A reading was true at some instant of the frame it came with: uniform over one frame.
    jitter = period / np.sqrt(12)
    error = np.linalg.norm(judged.predicted - judged.measured, axis=1)
    out = {
        "label_step_n": float(np.diff(values).min()) if len(values) > 1 else 0.0,
        "label_roughness_n": _rms(_roughness(time, label)[loaded]),
        "label_at_exactly_zero_share": float((label[tested] == 0).mean()),
        "label_period_s": float(np.median(np.diff(time))),
        "frame_period_s": period,
        "timing_n": _rms(rate[loaded]) * jitter,
        "field_noise_n": field_noise(judged),
        "error_untouched_n": _rms(error[idle]),
        "error_loaded_n": _rms(error[loaded]),
    }
    first = _first_press(judged)
    if first is not None:
        out["error_first_press_n"] = _rms(error[first & tested])
        out["error_after_first_press_n"] = _rms(error[~first & tested])
    return {key: value for key, value in out.items() if np.isfinite(value)}


def field_noise(judged: Judged) -> float:
    """Rms change of the prediction from frame to frame while nothing moves."""
    recording, model = judged.recording, judged.model
    still = recording.time_s <= recording.time_s[0] + TARE_S
    noise = np.diff(recording.field_ut[still], axis=0).std(axis=0) / np.sqrt(2)
    rng = np.random.default_rng(0)
    change = recording.change_ut()
    shaken = change + rng.normal(size=change.shape) * noise
    features = model.features
    calm = readout(model, batch_features(features, recording.time_s, change))
    moved = readout(model, batch_features(features, recording.time_s, shaken))
    return _rms(np.linalg.norm(moved - calm, axis=1))


def _place_limits(judged: Judged) -> dict[str, float]:
    """Error of touches that barely move the field, and of those that do."""
    size = np.linalg.norm(judged.recording.change_ut(), axis=1)
    size = np.interp(judged.time_s, judged.recording.time_s, size)
    error = np.linalg.norm(judged.predicted - judged.measured, axis=1)
    strong = size > np.median(size)
    return {
        "field_change_median_ut": float(np.median(size)),
        "error_weak_half_mm": float(error[judged.tested & ~strong].mean()),
        "error_strong_half_mm": float(error[judged.tested & strong].mean()),
    }


def _roughness(time: FloatArray, label: FloatArray) -> FloatArray:
    """Distance of each label from a line through its neighbours, (k,).

    It is scaled to the deviation of a single label.
    """
    out = np.zeros_like(label)
    half = STEADY // 2
    for i in range(half, len(label) - half):
        near = np.r_[i - half : i, i + 1 : i + half + 1]
        if time[near[-1]] - time[near[0]] > STEADY:
            continue
        line = np.polynomial.polynomial.polyfit(time[near] - time[i], label[near], 1)
        out[i] = label[i] - line[0]
    scale: FloatArray = out / np.sqrt(1 + 1 / (2 * half))
    return scale


def _first_press(judged: Judged) -> NDArray[np.bool_] | None:
    """Labels up to the end of the recording's first press, as a mask.

    None where that is not tested.
    """
    label = judged.recording.load()
    busy = label > UNTOUCHED_SHARE * label.max()
    ends = np.flatnonzero(busy[:-1] & ~busy[1:])
    if not len(ends) or not judged.tested[: ends[0]].any():
        return None
    return np.asarray(np.arange(len(label)) <= ends[0])


def _rms(values: FloatArray) -> float:
    return float(np.sqrt((values**2).mean())) if len(values) else float("nan")
