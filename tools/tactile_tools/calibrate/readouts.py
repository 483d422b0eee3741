"""Turn features into forces: scikit-learn pipelines, and the same as plain numbers."""

from __future__ import annotations

from typing import Any

import numpy as np
from sklearn.compose import TransformedTargetRegressor
from sklearn.kernel_approximation import Nystroem
from sklearn.linear_model import Ridge
from sklearn.neural_network import MLPRegressor
from sklearn.pipeline import Pipeline, make_pipeline
from sklearn.preprocessing import StandardScaler

from tactile_core.arrays import FloatArray
from tactile_core.calibration.force_model import Layer
from tactile_tools.calibrate.recipes import Recipe

RBF_REACH = 0.01
"""gamma of the radial basis functions, per unit variance of a feature: with the 30 features of a
five-magnetometer board a centre then reaches about one and a half times their spread."""
MLP_ITERATIONS = 150
SEED = 0


def pipeline(recipe: Recipe, penalty: float, rows: int) -> Pipeline:
    """Make the unfitted readout for ``rows`` rows; every random draw in it has a fixed seed."""
    if recipe.readout == "ridge":
        return make_pipeline(StandardScaler(), Ridge(penalty))
    if recipe.readout == "rbf":
        basis = Nystroem(gamma=RBF_REACH, n_components=min(recipe.units, rows), random_state=SEED)
        return make_pipeline(StandardScaler(), basis, Ridge(penalty))
    network = MLPRegressor(
        hidden_layer_sizes=(recipe.units,),
        activation="tanh",
        alpha=penalty,
        max_iter=MLP_ITERATIONS,
        random_state=SEED,
    )
    return make_pipeline(
        StandardScaler(), TransformedTargetRegressor(network, transformer=StandardScaler())
    )


def export(fitted: Pipeline) -> tuple[FloatArray, FloatArray, tuple[Layer, ...]]:
    """Mean and scale of the features, and layers, that give the numbers of ``fitted.predict``."""
    scaler = fitted[0]
    mean, scale = np.array(scaler.mean_), np.array(scaler.scale_)
    last: Any = fitted[-1]
    if isinstance(last, Ridge):
        weights = np.atleast_2d(last.coef_).T
        bias = np.atleast_1d(last.intercept_)
        basis: Any = fitted[1] if len(fitted) == 3 else None
        if basis is None:
            return mean, scale, (Layer("linear", weights, bias),)
        centres = Layer("rbf", np.array(basis.components_), np.array([basis.gamma]))
        return mean, scale, (centres, Layer("linear", basis.normalization_.T @ weights, bias))
    network, target = last.regressor_, last.transformer_
    layers = [
        Layer("tanh", w, b)
        for w, b in zip(network.coefs_[:-1], network.intercepts_[:-1], strict=True)
    ]
    weights = network.coefs_[-1] * target.scale_
    bias = network.intercepts_[-1] * target.scale_ + target.mean_
    return mean, scale, (*layers, Layer("linear", weights, bias))
