"""Judge models on samples that they were not fitted to."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tactile_core.arrays import FloatArray
from tactile_core.calibration.force_model import NetModel
from tactile_tools.calibrate.fit import Choice, Progress, choose, fit, quiet
from tactile_tools.calibrate.recipes import Recipe
from tactile_tools.calibrate.recording import Recording
from tactile_tools.calibrate.rows import causal
from tactile_tools.calibrate.splits import TAIL_SHARE
from tactiled.sensing.forces import batch_features, readout


@dataclass(frozen=True, slots=True, eq=False)
class Judged:
    """Predictions of one model for samples of a recording that it was not fitted to.

    ``time_s`` (k,), ``measured`` and ``predicted`` (k, targets); ``tested`` (k,) marks the samples
    that errors are computed over. ``fitted_on``: what the model was fitted to. ``choice``: what
    cross-validation chose on that.
    """

    recording: Recording
    model: NetModel
    choice: Choice
    measured: FloatArray
    predicted: FloatArray
    time_s: FloatArray
    tested: NDArray[np.bool_]
    fitted_on: tuple[Recording, ...]

    @property
    def errors(self) -> FloatArray:
        """Predicted minus measured, (tested, targets)."""
        return (self.predicted - self.measured)[self.tested]

    @property
    def rmse(self) -> FloatArray:
        """Root mean square error, (targets,)."""
        value: FloatArray = np.sqrt((self.errors**2).mean(axis=0))
        return value


def predict(model: NetModel, recording: Recording, label_clock: bool = True) -> FloatArray:
    """Predict every label of ``recording`` causally, tared at its beginning: (k, targets).

    ``label_clock``: predict at the instant each label was true, not at its stamp less the mean lag.
    """
    features = batch_features(model.features, recording.time_s, recording.change_ut())
    late = (
        recording.lag_s if label_clock else np.full(len(recording.labels), recording.lag_s.mean())
    )
    at = causal(recording.time_s, features, recording.label_time_s, late + model.delay_s)
    return readout(model, at)


def tail20(
    recordings: Sequence[Recording],
    recipes: Sequence[Recipe] | None = None,
    progress: Progress = quiet,
) -> list[Judged]:
    """Judge each recording by itself: choose and fit on its first 80 %, test on its last 20 %."""
    out = []
    for recording in recordings:
        head = recording.until(TAIL_SHARE)
        choice = choose([head], recipes, progress)
        model = fit([head], choice)
        tested = recording.label_time_s > head.time_s[-1]
        out.append(_judge(recording, model, choice, tested, [head]))
    return out


def leave_one_out(
    recordings: Sequence[Recording],
    recipes: Sequence[Recipe] | None = None,
    progress: Progress = quiet,
) -> list[Judged]:
    """Judge each recording by a model chosen and fitted on all the others."""
    out = []
    for recording in recordings:
        others = [other for other in recordings if other is not recording]
        choice = choose(others, recipes, progress)
        model = fit(others, choice)
        out.append(_judge(recording, model, choice, np.ones(len(recording.labels), bool), others))
    return out


def _judge(
    recording: Recording,
    model: NetModel,
    choice: Choice,
    tested: NDArray[np.bool_],
    fitted_on: Sequence[Recording],
) -> Judged:
    return Judged(
        recording=recording,
        model=model,
        choice=choice,
        measured=recording.labels,
        predicted=predict(model, recording),
        time_s=recording.label_time_s,
        tested=tested,
        fitted_on=tuple(fitted_on),
    )
