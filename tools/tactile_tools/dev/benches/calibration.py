"""Benchmark of fitted models in the daemon: cost per board and frame."""

from __future__ import annotations

import gc
import time

import numpy as np

from tactile_core.arrays import FloatArray
from tactile_core.calibration.force_model import FeatureMap, Layer, NetModel, RestTracker
from tactiled.sensing.forces import NetEstimator

TAXELS = {"anyskin": 5, "finger": 80}
COMPONENTS = 6
TAUS_S = (0.3, 1.0, 3.0, 10.0, 30.0, 100.0)
RADII = (0.1, 0.3, 0.6, 1.0)
CENTRES = 600
PERIOD_S = 0.01


def bench_calibration(*, quick: bool = False, seed: int = 0) -> dict[str, float]:
    """Milliseconds per frame of the largest model of each kind that `calibrate fit` tries.

    The numbers in the models are random: they do not affect the cost.
    """
    frames = 500 if quick else 5000
    rng = np.random.default_rng(seed)
    figures: dict[str, float] = {}
    for board, taxels in TAXELS.items():
        times = _time(history_model(taxels, rng), frames, rng)
        figures[f"calibration_{board}_ms_p50"] = float(np.median(times))
        figures[f"calibration_{board}_ms_p99"] = float(np.percentile(times, 99))
    figures["calibration_place_ms_p50"] = float(np.median(_time(place_model(rng), frames, rng)))
    return figures


def history_model(taxels: int, rng: np.random.Generator) -> NetModel:
    """Model with creep, play operators and their products, as for a recording of force."""
    features = FeatureMap(
        tracker=RestTracker(near_ut=400.0, still_ut=80.0, tau_s=2.0),
        projection=rng.normal(size=(3 * taxels, COMPONENTS)) / 1000,
        degree=3,
        curved=3,
        taus_s=np.array(TAUS_S),
        lagged=3,
        lag_degree=2,
        radii=np.array(RADII),
    )
    layers = (Layer("linear", rng.normal(size=(features.size, 1)), np.zeros(1)),)
    return _model(("normal",), features, layers)


def place_model(rng: np.random.Generator) -> NetModel:
    """Model with radial basis functions over the pattern of five magnetometers, as for single
    touches."""
    features = FeatureMap(tracker=None, projection=np.eye(15) / 1000, direction=True)
    centres = Layer("rbf", rng.normal(size=(CENTRES, features.size)), np.array([0.01]))
    layers = (centres, Layer("linear", rng.normal(size=(CENTRES, 2)), np.zeros(2)))
    return _model(("x", "y"), features, layers)


def _model(targets: tuple[str, ...], features: FeatureMap, layers: tuple[Layer, ...]) -> NetModel:
    return NetModel(
        recipe="bench",
        targets=targets,
        features=features,
        mean=np.zeros(features.size),
        scale=np.ones(features.size),
        layers=layers,
        floor=np.full(len(targets), -np.inf),
        delay_s=0.0,
        figures=(),
    )


def _time(model: NetModel, frames: int, rng: np.random.Generator) -> FloatArray:
    """Time of each frame (frames,), ms."""
    field = rng.normal(size=(frames, 3 * model.taxels)) * 1000
    estimator = NetEstimator(model)
    times = np.empty(frames)
    gc.disable()
    try:
        for i, frame in enumerate(field):
            start = time.perf_counter_ns()
            estimator.step(frame, PERIOD_S)
            times[i] = (time.perf_counter_ns() - start) / 1e6
    finally:
        gc.enable()
    return times
