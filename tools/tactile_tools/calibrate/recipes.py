"""Kinds of model that are tried: their features and readouts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from tactile_core.arrays import FloatArray
from tactile_core.calibration.force_model import FeatureMap, RestTracker
from tactile_tools.calibrate.recording import Recording

NEAR_SHARE = 0.08
"""The rest field is followed while the field is within this share of the strongest presses: twice
the 4 % by which rest fields creep in the eFlesh recordings."""
STILL_SHARE = 0.012
"""... and stays within this share of its one-second mean: the field of a released skin creeps by
0.2 % of the strongest press in a second; a press that begins changes by that in 50 ms."""
STILL_SIGMAS = 3.0
"""... or within this many times the noise of one frame, whichever is more."""
REST_TAU_S = 1.0
"""Time constant with which the rest field is followed, s."""
STRONG_PERCENTILE = 95

CREEP_TAUS_S = (0.3, 1.0, 3.0, 10.0, 30.0, 100.0)
"""Time constants of creep, s, half a decade apart from the filter of a load cell to the length of a
recording: rubber and printed lattices creep with the logarithm of time, so no single constant would
do."""
PLAY_RADII = (0.1, 0.3, 0.6, 1.0)
"""Half widths of the play operators, in rms of the component; a press spans about 3."""


@dataclass(frozen=True, slots=True)
class Recipe:
    """One kind of model; further fields as in `NetModel`.

    ``components``: principal ones of the field's change, 0 for all channels as they are.
    ``tracked``: the rest field is followed. ``restarts``: the fit also sees each recording begun
    anew at each of its pauses, as after a fresh tare. ``units``: of the readout. ``penalties``:
    tried in cross-validation (ridge, on features scaled to unit variance).
    """

    name: str
    components: int = 15
    degree: int = 1
    curved: int = 0
    taus_s: tuple[float, ...] = ()
    lagged: int = 0
    lag_degree: int = 0
    radii: tuple[float, ...] = ()
    direction: bool = False
    tracked: bool = False
    restarts: bool = False
    readout: Literal["ridge", "mlp", "rbf"] = "ridge"
    units: int = 0
    penalties: tuple[float, ...] = (1.0,)

    @property
    def knows_history(self) -> bool:
        """Whether the prediction depends on the past."""
        return self.tracked or bool(self.taus_s or self.radii)


_HISTORY = Recipe(
    "creep",
    components=6,
    degree=3,
    curved=3,
    taus_s=CREEP_TAUS_S,
    lagged=3,
    lag_degree=2,
    tracked=True,
    restarts=True,
    penalties=(3.0, 10.0),  # blocks of one recording call for less, another recording for this
)

FORCE_RECIPES = (
    Recipe("linear", components=30, penalties=(0.01, 1.0)),
    Recipe("cubic", components=15, degree=3, curved=3, penalties=(0.01, 1.0)),
    _HISTORY,
    replace(_HISTORY, name="creep+play", radii=PLAY_RADII, lag_degree=1, lagged=2),
)
"""For recordings of force over time; the first two ignore history and are the ones to beat."""

PLACE_RECIPES = (
    Recipe("linear", components=0, penalties=(0.01, 1.0)),
    Recipe("cubic", components=15, degree=3, curved=15, penalties=(0.01, 1.0)),
    Recipe(
        "pattern",
        components=0,
        direction=True,
        readout="rbf",
        units=600,
        penalties=(1e-3, 1e-2),
    ),
)
"""For recordings of single touches: place, from the pattern of the field rather than its
strength."""


def feature_map(recipe: Recipe, recordings: Sequence[Recording]) -> FeatureMap:
    """Make the features that ``recipe`` asks for, scaled to what ``recordings`` hold."""
    changes = [r.change_ut() for r in recordings]
    change = np.concatenate(changes)
    channels = change.shape[1]
    if recipe.components:
        _, size, axes = np.linalg.svd(change, full_matrices=False)
        rms = size / np.sqrt(len(change))
        k = min(recipe.components, int((rms > rms[0] * 1e-6).sum()))
        projection = axes[:k].T / rms[:k]
        # The sign of an axis is arbitrary: make presses positive, so that powers mean the same.
        projection *= np.where((change @ projection).mean(axis=0) < 0, -1.0, 1.0)
    else:
        projection = np.eye(channels) / np.sqrt((change**2).mean())
        k = channels
    return FeatureMap(
        tracker=_tracker(changes) if recipe.tracked else None,
        projection=projection,
        degree=recipe.degree,
        curved=min(recipe.curved, k),
        taus_s=np.array(recipe.taus_s),
        lagged=min(recipe.lagged, k),
        lag_degree=recipe.lag_degree,
        radii=np.array(recipe.radii),
        direction=recipe.direction,
    )


def floor(recordings: Sequence[Recording]) -> FloatArray:
    """Least value of each target: zero for a force that is never negative in the labels."""
    labels = np.concatenate([r.labels for r in recordings])
    least: FloatArray = np.full(labels.shape[1], -np.inf)
    if recordings[0].forces:
        noise = 0.01 * np.abs(labels).max(axis=0)
        least[labels.min(axis=0) > -noise] = 0.0
    return least


def _tracker(changes: list[FloatArray]) -> RestTracker:
    """Limits of what counts as rest, from the strength of presses and noise."""
    size = np.concatenate([np.linalg.norm(c, axis=1) for c in changes])
    strong = float(np.percentile(size, STRONG_PERCENTILE))
    # Successive differences: a press changes slowly from frame to frame, noise does not.
    noise = np.sqrt(sum(float(np.median(np.diff(c, axis=0) ** 2, axis=0).sum()) for c in changes))
    noise *= np.sqrt(1 / (2 * 0.455 * len(changes)))  # from the median of chi² to the variance
    return RestTracker(
        near_ut=max(NEAR_SHARE * strong, 2 * STILL_SIGMAS * noise),
        still_ut=max(STILL_SHARE * strong, STILL_SIGMAS * noise),
        tau_s=REST_TAU_S,
    )
