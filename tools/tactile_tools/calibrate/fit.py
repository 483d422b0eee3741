"""Choose a model by cross-validation, and fit it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tactile_core.arrays import FloatArray
from tactile_core.calibration.force_model import NetModel
from tactile_tools.calibrate.readouts import export, pipeline
from tactile_tools.calibrate.recipes import (
    FORCE_RECIPES,
    PLACE_RECIPES,
    Recipe,
    feature_map,
    floor,
)
from tactile_tools.calibrate.recording import Recording, RecordingError
from tactile_tools.calibrate.rows import Rows, align, copies
from tactile_tools.calibrate.splits import GAP_S, block_edges, block_masks

Bool = NDArray[np.bool_]

DELAYS_S = tuple(round(0.05 * i, 2) for i in range(-2, 9))
"""Delays of labels behind the field that are tried, s. A load cell that averages over 0.2 s lags by
0.1 s; a negative delay means that the board is read late."""

Progress = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class Score:
    """Cross-validated error of one candidate, in the targets' unit."""

    recipe: Recipe
    penalty: float
    rmse: float


@dataclass(frozen=True, slots=True)
class Choice:
    """What cross-validation chose. ``delays``: the tried ones, as (delay s, error)."""

    recipe: Recipe
    penalty: float
    delay_s: float
    scores: tuple[Score, ...]
    delays: tuple[tuple[float, float], ...]


def quiet(_: str) -> None:
    """Report no progress."""


def require_alike(recordings: Sequence[Recording]) -> None:
    """`RecordingError` for recordings that one model could not be fitted to together."""
    first = recordings[0]
    for other in recordings[1:]:
        if other.taxels != first.taxels:
            raise RecordingError(
                f"{other.path} is of {other.taxels} magnetometers, {first.path} of {first.taxels}; "
                "calibrate one board at a time"
            )
        if other.serial_number != first.serial_number:
            raise RecordingError(
                f"{other.path} is of board {other.serial_number or 'unknown'}, {first.path} of "
                f"{first.serial_number or 'unknown'}; calibrate one board at a time"
            )


def recipes_for(recordings: Sequence[Recording]) -> tuple[Recipe, ...]:
    """Kinds of model to try."""
    return FORCE_RECIPES if recordings[0].forces else PLACE_RECIPES


def choose(
    recordings: Sequence[Recording],
    recipes: Sequence[Recipe] | None = None,
    progress: Progress = quiet,
) -> Choice:
    """Choose delay, recipe and penalty with the least cross-validated error on ``recordings``."""
    recipes = recipes_for(recordings) if recipes is None else tuple(recipes)
    delays: list[tuple[float, FloatArray]] = []
    delay = 0.0
    judge = next((r for r in recipes if r.knows_history), None)
    if judge is not None:
        progress("delay of the labels")
        made = copies(feature_map(judge, recordings), recordings, judge.restarts)
        penalty = judge.penalties[0]
        for each in DELAYS_S:
            rows = align(made, recordings, each)
            delays.append((each, cross_validate(rows, recordings, judge, penalty)))
        nearest = sorted(delays, key=lambda pair: abs(pair[0]))
        delay = nearest[simplest([errors for _, errors in nearest])][0]
    scores: list[Score] = []
    best: tuple[float, Score] | None = None
    for recipe in recipes:
        progress(recipe.name)
        made = copies(feature_map(recipe, recordings), recordings, recipe.restarts)
        rows = align(made, recordings, delay)
        strict = sorted(recipe.penalties, reverse=True)
        errors = [cross_validate(rows, recordings, recipe, penalty) for penalty in strict]
        own = [Score(recipe, p, float(e.mean())) for p, e in zip(strict, errors, strict=True)]
        scores += own
        least = min(score.rmse for score in own)
        if best is None or least < best[0]:
            best = least, own[simplest(errors)]
    if best is None:
        raise ValueError("no recipe was given")
    chosen = best[1]
    means = tuple((d, float(e.mean())) for d, e in delays)
    return Choice(chosen.recipe, chosen.penalty, delay, tuple(scores), means)


def simplest(errors: Sequence[FloatArray]) -> int:
    """Index of the first candidate, simplest first, whose errors by fold are as good as the best.

    As good: worse by no more than one standard error of the difference, fold by fold (Breiman's
    rule). Candidates that blocks of one recording cannot distinguish may differ on another
    recording, where the stricter one does better.
    """
    best = min(errors, key=lambda e: float(e.mean()))
    for i, each in enumerate(errors):
        worse = each - best
        if worse.mean() <= worse.std(ddof=1) / np.sqrt(len(worse)) or each is best:
            return i
    raise ValueError("no candidate was given")


def cross_validate(
    rows: Rows, recordings: Sequence[Recording], recipe: Recipe, penalty: float
) -> FloatArray:
    """Root mean square error of each fold, (folds,), in the targets' unit.

    Candidates are judged by the mean of these, not by the root of the mean square: otherwise one
    fold with the first press of a fresh skin, which no other fold has, would decide for all the
    others.
    """
    errors = []
    for fit, test in folds(rows, recordings):
        model = pipeline(recipe, penalty, int(fit.sum()))
        model.fit(rows.features[fit], rows.labels[fit])
        guess = model.predict(rows.features[test]).reshape(-1, rows.labels.shape[1])
        guess = np.maximum(guess, floor(recordings))
        errors.append(float(np.sqrt(((guess - rows.labels[test]) ** 2).mean())))
    return np.array(errors)


def folds(rows: Rows, recordings: Sequence[Recording]) -> Iterator[tuple[Bool, Bool]]:
    """Yield rows to fit on and rows to test on: blocks of time of each recording, whole recordings.

    `RecordingError` for a recording so short that nothing is left beside one of its blocks.
    """
    numbers = range(len(recordings))
    for number in numbers:
        own = rows.recording == number
        for edges in block_edges(recordings[number].label_time_s):
            fit, test = block_masks(rows.time_s, edges)
            fit, test = fit | ~own, test & own
            if not fit.any() or not test.any():
                raise too_short(recordings[number])
            yield fit, test
    if len(recordings) > 1:
        for number in numbers:
            own = rows.recording == number
            yield ~own, own & rows.whole


def too_short(recording: Recording) -> RecordingError:
    """Make the error for a recording that has too little in it to choose a model by."""
    time = recording.label_time_s
    return RecordingError(
        f"{recording.path} has labels over {time[-1] - time[0]:.0f} s; to choose a model, a fifth "
        f"of them and {GAP_S:g} s on both sides are left out in turn, and nothing is left to fit: "
        "record more presses, a minute of them or more"
    )


def fit(recordings: Sequence[Recording], choice: Choice) -> NetModel:
    """Fit the model of ``choice`` to all of ``recordings``."""
    recipe = choice.recipe
    features = feature_map(recipe, recordings)
    rows = align(copies(features, recordings, recipe.restarts), recordings, choice.delay_s)
    fitted = pipeline(recipe, choice.penalty, len(rows.labels)).fit(rows.features, rows.labels)
    mean, scale, layers = export(fitted)
    return NetModel(
        recipe=recipe.name,
        targets=recordings[0].targets,
        features=features,
        mean=mean,
        scale=scale,
        layers=layers,
        floor=floor(recordings),
        delay_s=choice.delay_s,
        figures=(),
    )
