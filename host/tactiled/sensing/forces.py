"""Turn chip readings into fields and fields into forces, by the calibration, all arrays at once.

Shapes as in `Layout`: vectors are (A, 3, n). A plane ``theta`` is (A, 3, 3) µT: [array, component
in ``ee``, coefficient over `Layout.design`].
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from tactile_core.arrays import FloatArray
from tactile_core.calibration.force_model import FeatureMap, Layer, NetModel, RestTracker, monomials
from tactile_core.calibration.types import BoardCalibration
from tactile_core.types import Instant, seconds_between
from tactiled.sensing.layout import Layout

MAX_OWN_CONDITION = 1e4
"""Condition number of a taxel's own 3 × 3 block above which it does not resolve three components
of force; its array is then compensated without undoing crosstalk."""

MAGNET_DRIFT_PER_K = -0.0012
"""Reversible loss of remanence of sintered NdFeB, −0.12 %/K (makers' datasheets)."""


class ForceModel:
    """The calibration of a board as batched matrices.

    Force is linear in the field, so a plane adds to every force a fixed matrix times the plane's
    nine coefficients. ``press_direction``: (A, 3, n) unit vectors in ``ee`` along which a press
    changes a taxel's field.
    """

    def __init__(self, calibration: BoardCalibration, layout: Layout) -> None:
        arrays, n = layout.arrays, layout.width
        self.layout = layout
        self._cos = np.ones((arrays, n))
        self._sin = np.zeros((arrays, n))
        rest = np.zeros((arrays, 3, n))
        self._drift = np.zeros((arrays, 3, n))
        self._reference = np.zeros((arrays, n))
        self._nominal = calibration.nominal
        blocks = np.zeros((arrays, 3, n, 3, n))
        for a, array in enumerate(calibration.arrays):
            m = array.geometry.taxels
            blocks[a, :, :m, :, :m] = array.newton_per_ut.reshape(m, 3, m, 3).transpose(1, 0, 3, 2)
            self._cos[a, :m] = np.cos(array.geometry.chip_yaw)
            self._sin[a, :m] = np.sin(array.geometry.chip_yaw)
            rest[a, :, :m] = array.rest_ut.T
            self._drift[a, :, :m] = array.drift_ut_per_k.T
            self._reference[a] = array.reference_c
        self.rest = rest
        self._rested_at = self._reference.copy()
        self._turned = bool(self._sin.any() or (self._cos != 1).any())
        self._drifts = bool(self._drift.any())
        self._matrix = blocks.reshape(arrays, 3 * n, 3 * n)
        self._derive(blocks)

    def _derive(self, blocks: FloatArray) -> None:
        """Precompute everything that depends only on geometry and matrix."""
        layout = self.layout
        arrays, n = layout.arrays, layout.width
        own = np.einsum("acidi->aicd", blocks)
        self._undo = layout.rotation.copy()
        self._decouples = np.zeros(arrays, dtype=bool)
        for a in range(arrays):
            mine = own[a][layout.real[a]]
            coupled = np.abs(blocks[a]).sum() > np.abs(mine).sum() * (1 + 1e-12)
            if coupled and (np.linalg.cond(mine) < MAX_OWN_CONDITION).all():
                self._decouples[a] = True
                turn = layout.rotation[a].transpose(2, 0, 1)[layout.real[a]]
                self._undo[a][:, :, layout.real[a]] = (turn @ np.linalg.inv(mine)).transpose(
                    1, 2, 0
                )
        self.decouples = bool(self._decouples.any())
        self.press_direction = np.zeros((arrays, 3, n))
        for a in range(arrays):
            for i in np.flatnonzero(layout.real[a]).tolist():
                block = own[a, i]
                along = np.array([0.0, 0.0, 1.0])
                if abs(np.linalg.det(block)) > 0 and np.linalg.cond(block) < MAX_OWN_CONDITION:
                    along = np.linalg.solve(block, [0.0, 0.0, -1.0])
                along = layout.rotation[a, :, :, i] @ along
                self.press_direction[a, :, i] = along / np.linalg.norm(along)
        in_ee = np.einsum("akn,cd->acndk", layout.design, np.eye(3)).reshape(arrays, 3, n, 9)
        in_taxel = np.einsum("adcn,adnp->acnp", layout.rotation, in_ee)
        self._plane_force = self._matrix @ in_taxel.reshape(arrays, 3 * n, 9)
        undone = np.einsum(
            "acdn,adnp->acnp", self._undo, self._plane_force.reshape(arrays, 3, n, 9)
        )
        leak = undone - in_ee
        leak[~self._decouples] = 0
        self._plane_leak = leak.reshape(arrays, 3 * n, 9)

    @property
    def rest(self) -> FloatArray:
        """Rest field, (A, 3, n) µT in taxel axes. Assign it anew to change it: what follows from
        it is kept."""
        return self._rest

    @rest.setter
    def rest(self, rest_ut: FloatArray) -> None:
        rest_ut.flags.writeable = False
        self._rest = rest_ut
        self._rest_squared: FloatArray | None = None
        self._rest_size: FloatArray | None = None

    @property
    def rest_squared(self) -> FloatArray:
        """Square of the size of the rest field, (A, n) µT²."""
        if self._rest_squared is None:
            self._rest_squared = (self._rest**2).sum(axis=1)
        return self._rest_squared

    @property
    def rest_size(self) -> FloatArray:
        """Size of the rest field, (A, n) µT."""
        if self._rest_size is None:
            self._rest_size = np.linalg.norm(self._rest, axis=1)
        return self._rest_size

    def rested_at(self, temperature_c: FloatArray) -> None:
        """Note that the rest field was taken at ``temperature_c`` (A, n) °C.

        For a board without a calibration, the datasheet drift of its magnets is removed relative
        to that.
        """
        self._rested_at = temperature_c.copy()
        if self._nominal:
            self._reference = temperature_c.copy()
            self._drift = MAGNET_DRIFT_PER_K * self.rest
            self._drifts = bool(self._drift.any())

    @property
    def rested_c(self) -> FloatArray:
        """(A, n) °C at which the rest field in use was taken."""
        return self._rested_at

    def warmer(self, temperature_c: FloatArray) -> FloatArray:
        """(A, n) K of warming since the rest field was taken."""
        return np.asarray(temperature_c - self._rested_at)

    def taxel_field(self, raw: FloatArray, temperature_c: FloatArray) -> FloatArray:
        """Field in taxel axes, µT, with rest field and thermal drift removed.

        ``raw``: (A, 3, n) µT in chip axes. ``temperature_c``: (A, n) °C.
        """
        if self._turned:
            x, y = raw[:, 0], raw[:, 1]
            field = raw.copy()
            field[:, 0] = self._cos * x - self._sin * y
            field[:, 1] = self._sin * x + self._cos * y
            field -= self.rest
        else:
            field = raw - self.rest
        if self._drifts:
            field -= self._drift * (temperature_c - self._reference)[:, None, :]
        return field

    def chip_rest(self) -> FloatArray:
        """Rest field in chip axes, (A, 3, n) µT."""
        out = self.rest.copy()
        out[:, 0] = self._cos * self.rest[:, 0] + self._sin * self.rest[:, 1]
        out[:, 1] = self._cos * self.rest[:, 1] - self._sin * self.rest[:, 0]
        return out

    def forces(self, field: FloatArray) -> FloatArray:
        """Forces in taxel axes, N, from ``field`` in taxel axes, including the ambient field's."""
        forces: FloatArray = (self._matrix @ field.reshape(len(field), -1, 1)).reshape(field.shape)
        return forces

    def field_in_ee(self, field: FloatArray) -> FloatArray:
        """Field in ``ee`` axes, µT, in which a uniform ambient field is equal at every taxel."""
        return np.asarray((self.layout.rotation * field[:, None]).sum(axis=2))

    def decoupled_in_ee(self, field_ee: FloatArray, forces: FloatArray) -> FloatArray:
        """Field in ``ee`` axes, µT, without the crosstalk of neighbours' contacts, from `forces`.

        This also changes a uniform field, by `plane_leak`.
        """
        undone: FloatArray = (self._undo * forces[:, None]).sum(axis=2)
        if not self._decouples.all():
            undone[~self._decouples] = field_ee[~self._decouples]
        return undone

    def plane_leak(self, theta: FloatArray) -> FloatArray:
        """Change of the plane ``theta`` by `decoupled_in_ee`, µT in ``ee`` axes."""
        return self._of_plane(self._plane_leak, theta)

    def plane_forces(self, theta: FloatArray) -> FloatArray:
        """Contribution of the plane ``theta`` to `forces`, N in taxel axes."""
        return self._of_plane(self._plane_force, theta)

    def plane_field(self, theta: FloatArray) -> FloatArray:
        """Field of the plane ``theta`` in taxel axes, µT."""
        in_ee = theta @ self.layout.design
        field: FloatArray = (self.layout.rotation * in_ee[:, :, None]).sum(axis=1)
        return field

    def normal_slopes(self) -> FloatArray:
        """Contribution of a plane to the normal forces, (A, n, 3, 3) N/µT: [array, taxel,
        component in ``ee``, coefficient over `Layout.design`].
        """
        arrays, n = self.layout.arrays, self.layout.width
        rows = self._plane_force.reshape(arrays, 3, n, 3, 3)[:, 2]
        return np.ascontiguousarray(rows)

    def normal_sigma(self, noise_ut: FloatArray) -> FloatArray:
        """Noise of the normal forces, (A, n) N rms, from independent noise (3,) µT rms."""
        arrays, n = self.layout.arrays, self.layout.width
        rows = self._matrix.reshape(arrays, 3, n, 3, n)[:, 2]
        sigma: FloatArray = np.sqrt(np.einsum("aicj,c->ai", rows**2, noise_ut**2))
        return sigma

    def _of_plane(self, matrix: FloatArray, theta: FloatArray) -> FloatArray:
        vectors: FloatArray = (matrix @ theta.reshape(-1, 9, 1)).reshape(
            self.layout.arrays, 3, self.layout.width
        )
        return vectors


# Evaluate a `NetModel`, frame by frame as the daemon does, or over a whole recording at once.
#
# Both use the same two functions: `History.step` for terms with memory, `expand` for those without.
# Time enters as the seconds between frames, so that a model fitted at 14 Hz runs at any rate.


STILL_TAU_S = 1.0
"""s, time constant of the mean that a still field stays close to."""
MAX_STEP_S = 60.0
"""s; the frame after a longer gap does not move the rest field: what happened in it is unknown."""


class RestFollower:
    """Tracks the drift of one board's rest field; ``rest``: (3n,) µT relative to the tare."""

    def __init__(self, tracker: RestTracker | None, channels: int) -> None:
        self._tracker = tracker
        self.rest = np.zeros(channels)
        self._mean = np.zeros(channels)
        self._begun = False

    def step(self, field: FloatArray, elapsed: float) -> FloatArray:
        """Change of ``field`` from rest, both (3n,) µT, ``elapsed`` s after the last frame."""
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
    """Leaky integrators and play operators of the first components; all start at zero."""

    def __init__(self, features: FeatureMap) -> None:
        self._taus = -1.0 / features.taus_s[:, None]
        self._radii = features.radii[:, None]
        self._count = features.lagged
        self._leaky = np.zeros((len(features.taus_s), features.lagged))
        self._play = np.zeros((len(features.radii), features.lagged))

    def step(self, components: FloatArray, elapsed: float) -> FloatArray:
        """Advance by ``elapsed`` s; returns (lagged * (T + P),): component minus integrator, then
        component minus play."""
        now = components[: self._count]
        leaky, play = self._leaky, self._play
        leaky += (now - leaky) * -np.expm1(self._taus * elapsed)
        np.clip(play, now - self._radii, now + self._radii, out=play)
        return np.concatenate([(now - leaky).ravel(), (now - play).ravel()])


def expand(features: FeatureMap, components: FloatArray, history: FloatArray) -> FloatArray:
    """Features (..., F) of components (..., k) and history terms (..., h)."""
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


@lru_cache(maxsize=64)  # called in every frame, for few models
def _indices(components: int, degree: int) -> NDArray[np.intp]:
    """Factors of each of `monomials`, (M, degree); the padding -1 stands for the factor one."""
    found = monomials(components, degree)
    out = np.full((len(found), degree), -1, np.intp)
    for row, factors in zip(out, found, strict=True):
        row[: len(factors)] = factors
    return out


def readout(model: NetModel, features: FloatArray) -> FloatArray:
    """Predictions (..., targets) from features (..., F)."""
    value = (features - model.mean) / model.scale
    for layer in model.layers:
        value = _apply(layer, value)
    return np.maximum(value, model.floor)


def _apply(layer: Layer, value: FloatArray) -> FloatArray:
    if layer.kind == "rbf":
        square = (value**2).sum(axis=-1, keepdims=True) + (layer.weights**2).sum(axis=1)
        square = square - 2.0 * (value @ layer.weights.T)
        near: FloatArray = np.exp(-layer.bias[0] * np.maximum(square, 0.0))
        return near
    out: FloatArray = value @ layer.weights + layer.bias
    return np.tanh(out) if layer.kind == "tanh" else out


class NetEstimator:
    """One model running on one board; memory, and time per frame, are constant."""

    def __init__(self, model: NetModel) -> None:
        self.model = model
        self.reset()

    def reset(self) -> None:
        """Forget everything: a tare has just set the rest field."""
        features = self.model.features
        self._rest = RestFollower(features.tracker, features.channels)
        self._history = History(features)

    def step(self, field: FloatArray, elapsed: float) -> FloatArray:
        """Predictions (targets,) for ``field`` (3n,) µT relative to the tare, ``elapsed`` s after
        the last frame."""
        change = self._rest.step(field, elapsed)
        components: FloatArray = change @ self.model.features.projection
        history = self._history.step(components, elapsed)
        return readout(self.model, expand(self.model.features, components, history))


def batch_features(features: FeatureMap, time_s: FloatArray, field: FloatArray) -> FloatArray:
    """Features (m, F) of a whole recording: ``time_s`` (m,) s, ``field`` (m, 3n) µT over rest."""
    rest = RestFollower(features.tracker, field.shape[1])
    history = History(features)
    change, past = np.empty_like(field), []
    elapsed = np.diff(time_s, prepend=time_s[0]).tolist()
    for i, step in enumerate(elapsed):
        change[i] = rest.step(field[i], step)
        past.append(history.step(change[i] @ features.projection, step))
    return expand(features, change @ features.projection, np.array(past))


# Fitted models in the pipeline: the total force of the contact, distributed over its taxels.
#
# The matrices of the arrays give each taxel's share of a contact, the models give the total. Where
# the models predict a component of force, the taxels' components are scaled to add up to it.


Bool = NDArray[np.bool_]

_LEAST_SHEAR_N = 1e-9  # below this a shear has no direction


class NetStage:
    """Runs the fitted models of one board, if it has any, frame by frame."""

    def __init__(self, nets: Sequence[NetModel], layout: Layout) -> None:
        self._layout = layout
        self._estimators = tuple(NetEstimator(net) for net in nets)
        self._last: Instant | None = None

    @property
    def fitted(self) -> bool:
        """Whether the board has any model."""
        return bool(self._estimators)

    def reset(self) -> None:
        """Forget the history: a tare has set the rest field."""
        for estimator in self._estimators:
            estimator.reset()
        self._last = None

    def pause(self) -> None:
        """Note a restart of the stream: the next frame has no predecessor; the rest is kept."""
        self._last = None

    def update(self, field: FloatArray, captured: Instant) -> dict[str, float]:
        """Predictions by target. ``field``: (A, 3, n) µT over rest, including the ambient field;
        all taxels healthy."""
        elapsed = 0.0 if self._last is None else max(0.0, seconds_between(self._last, captured))
        self._last = captured
        flat = self._layout.flat_vectors(field).ravel()
        out: dict[str, float] = {}
        for estimator in self._estimators:
            values = estimator.step(flat, elapsed).tolist()
            out.update(zip(estimator.model.targets, values, strict=True))
        return out

    def share(self, forces: FloatArray, net: dict[str, float]) -> None:
        """Scale ``forces`` (A, 3, n) N in place so that they add up to ``net``."""
        press = np.where(self._layout.real, np.maximum(-forces[:, 2], 0.0), 0.0)
        total = float(press.sum())
        part = press / total if total > 0.0 else self._layout.real / self._layout.taxels
        if "normal" in net:
            forces[:, 2] = -net["normal"] * part
        if "shear" in net:
            # the model was fitted on one axis and gives the size; the matrices give the direction
            along = forces[:, :2].sum(axis=(0, 2))
            size = float(np.hypot(along[0], along[1]))
            if size > _LEAST_SHEAR_N:
                forces[:, :2] = (along / size * net["shear"])[:, None] * part[:, None]
        for axis, target in enumerate(("shear_x", "shear_y")):
            if target in net:
                forces[:, axis] = net[target] * part
