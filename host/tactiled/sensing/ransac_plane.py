"""scikit-learn's RANSAC for one surface. Importing this takes 1.1 s: do so only when needed."""

from __future__ import annotations

import warnings

import numpy as np
from sklearn.base import BaseEstimator, RegressorMixin
from sklearn.linear_model import LinearRegression, RANSACRegressor

from tactile_core.arrays import FloatArray

MAX_TRIALS = 100
"""scikit-learn's default."""


class Plane(RegressorMixin, BaseEstimator):  # type: ignore[misc]  # scikit-learn has no types
    """Least-squares plane as by `LinearRegression`; without its checks it is ten times faster."""

    def fit(self, surface: FloatArray, values: FloatArray) -> Plane:
        """Fit ``values`` (k,) at ``surface`` (k, 2)."""
        design = np.empty((len(surface), 3))
        design[:, 0] = 1.0
        design[:, 1:] = surface
        solution = np.linalg.lstsq(design, values, rcond=None)[0]
        self.intercept_, self.coef_ = solution[0], solution[1:]
        return self

    def predict(self, surface: FloatArray) -> FloatArray:
        """Heights of the plane, (k,), at ``surface`` (k, 2)."""
        heights: FloatArray = self.intercept_ + surface @ self.coef_
        return heights


def fit_plane(
    surface: FloatArray, values: FloatArray, rng: np.random.Generator, plain: bool = False
) -> FloatArray | None:
    """RANSAC plane through ``values`` (n,) at ``surface`` (n, 2): (3,) height at 0 and slopes.

    None when there is no consensus. ``plain``: use scikit-learn's default, `LinearRegression`,
    instead of `Plane`.
    """
    regressor = RANSACRegressor(
        LinearRegression() if plain else Plane(),
        min_samples=3,
        max_trials=MAX_TRIALS,
        random_state=int(rng.integers(2**32)),
    )
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # scores of two samples and failed trials are expected
            regressor.fit(surface, values)
    except ValueError:  # "RANSAC could not find a valid consensus set"
        return None
    plane = regressor.estimator_
    return np.array([plane.intercept_, *plane.coef_])
