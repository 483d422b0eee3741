"""Runs a `NetModel`: frame by frame as the daemon does, or over a whole recording at once.

Both go through the same two functions: `History.step` for what remembers, `expand` for what does
not. Time enters as the seconds between frames, so that a model fitted at 14 Hz runs at any rate.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from tactile_bus.net_types import FeatureMap, Layer, NetModel, RestTracker, monomials

Float = NDArray[np.float64]

STILL_TAU_S = 1.0
"""s of the mean that a still field stays close to."""
MAX_STEP_S = 60.0
"""s: after a longer gap in the stream nothing is known of what happened in it, so the rest is not
moved by that frame."""


class RestFollower:
    """The rest field of one board as it drifts; (3n,) µT, over the tared rest."""

    def __init__(self, tracker: RestTracker | None, channels: int) -> None:
        self._tracker = tracker
        self.rest = np.zeros(channels)
        self._mean = np.zeros(channels)
        self._begun = False

    def step(self, field: Float, elapsed: float) -> Float:
        """Change from rest of ``field`` (3n,) µT, ``elapsed`` s after the last."""
        tracker = self._tracker
        if tracker is None:
            return field
        if not self._begun:
            self._begun = True
            self._mean = field.copy()
        away = field - self.rest
        moving = field - self._mean
        self._mean += (1.0 - math.exp(-elapsed / STILL_TAU_S)) * moving
        if (
            float(away @ away) < tracker.near_ut**2
            and float(moving @ moving) < tracker.still_ut**2
            and elapsed < MAX_STEP_S
        ):
            share = 1.0 - math.exp(-elapsed / tracker.tau_s)
            self.rest += share * away
            away *= 1.0 - share
        return away


class History:
    """Leaky integrators and play operators of the first components; all start at rest, zero."""

    def __init__(self, features: FeatureMap) -> None:
        self._taus = -1.0 / features.taus_s[:, None]
        self._radii = features.radii[:, None]
        self._count = features.lagged
        self._leaky = np.zeros((len(features.taus_s), features.lagged))
        self._play = np.zeros((len(features.radii), features.lagged))

    def step(self, components: Float, elapsed: float) -> Float:
        """(lagged * (T + P),): component minus integrator, then component minus play."""
        now = components[: self._count]
        leaky, play = self._leaky, self._play
        leaky += (now - leaky) * -np.expm1(self._taus * elapsed)
        np.clip(play, now - self._radii, now + self._radii, out=play)
        return np.concatenate([(now - leaky).ravel(), (now - play).ravel()])


def expand(features: FeatureMap, components: Float, history: Float) -> Float:
    """(..., F) features of (..., k) components and (..., h) history terms."""
    parts, first = [components], components[..., :1]
    indices = _indices(features.curved, features.degree)
    if len(indices):
        padded = np.concatenate([components, np.ones_like(first)], axis=-1)
        product = padded[..., indices[:, 0]]
        for column in indices.T[1:]:
            product = product * padded[..., column]
        parts.append(product)
    parts.append(history)
    power = first
    for _ in range(features.lag_degree):
        parts.append(history * power)
        power = power * first
    if features.direction:
        size = np.linalg.norm(components, axis=-1, keepdims=True)
        parts.append(components / np.maximum(size, np.finfo(np.float64).tiny))
    return np.concatenate(parts, axis=-1)


@lru_cache(maxsize=64)  # few models are in use; asked for in every frame
def _indices(components: int, degree: int) -> NDArray[np.intp]:
    """(M, degree) factors of each of `monomials`; -1, the padding, is the factor one."""
    found = monomials(components, degree)
    out = np.full((len(found), degree), -1, np.intp)
    for row, factors in zip(out, found, strict=True):
        row[: len(factors)] = factors
    return out


def readout(model: NetModel, features: Float) -> Float:
    """(..., targets) of (..., F) features."""
    value = (features - model.mean) / model.scale
    for layer in model.layers:
        value = _apply(layer, value)
    return np.maximum(value, model.floor)


def _apply(layer: Layer, value: Float) -> Float:
    if layer.kind == "rbf":
        square = (value**2).sum(axis=-1, keepdims=True) + (layer.weights**2).sum(axis=1)
        square = square - 2.0 * (value @ layer.weights.T)
        near: Float = np.exp(-layer.bias[0] * np.maximum(square, 0.0))
        return near
    out: Float = value @ layer.weights + layer.bias
    return np.tanh(out) if layer.kind == "tanh" else out


class NetEstimator:
    """One model in service on one board; memory and time of a frame are constant."""

    def __init__(self, model: NetModel) -> None:
        self.model = model
        self.reset()

    def reset(self) -> None:
        """Forget everything: a tare has just said what rest is."""
        features = self.model.features
        self._rest = RestFollower(features.tracker, features.channels)
        self._history = History(features)

    def step(self, field: Float, elapsed: float) -> Float:
        """(targets,) for ``field`` (3n,) µT over the tared rest, ``elapsed`` s after the last."""
        change = self._rest.step(field, elapsed)
        components: Float = change @ self.model.features.projection
        history = self._history.step(components, elapsed)
        return readout(self.model, expand(self.model.features, components, history))


def batch_features(features: FeatureMap, time_s: Float, field: Float) -> Float:
    """(m, F) features of a whole recording: ``time_s`` (m,) s, ``field`` (m, 3n) µT over rest."""
    rest = RestFollower(features.tracker, field.shape[1])
    history = History(features)
    change, past = np.empty_like(field), []
    elapsed = np.diff(time_s, prepend=time_s[0]).tolist()
    for i, step in enumerate(elapsed):
        change[i] = rest.step(field[i], step)
        past.append(history.step(change[i] @ features.projection, step))
    return expand(features, change @ features.projection, np.array(past))
