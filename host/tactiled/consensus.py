"""Deterministic robust fit of the ambient field, all arrays and all components at once.

A contact disturbs a taxel in all three components, the ambient field is a plane over the unrolled
skin, nearly the same constant on every array when seen in ``ee`` axes. So: designed subsets
propose planes, all taxels vote on them by their joint three-component distance, the winner (or
the constant that the whole board agrees on, where that explains an array better) is refined by
reweighted least squares, the last steps on fields from which the neighbours' contacts were taken.
Linear in the field wherever the choice of taxels is the same: an added plane comes out exactly.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tactiled.candidates import PLANE_TAXELS, design_candidates
from tactiled.force_model import ForceModel
from tactiled.layout import Layout

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]

INLIER_SIGMAS = 4.0
"""A taxel supports a fit within this many sigma, all components together: noise leaves 0.1 % out."""
FIRST_REACH = 6.0
LAST_REACH = 5.0
"""Sigma at which Tukey's weight falls to zero, in the first and the later refinements: wide while
the proposal still carries the noise of its few taxels, then just beyond the inliers."""
MODEL_ERROR_UT = 1.5
"""µT rms by which chips differ in a uniform field: 3 % sensitivity in 50 µT."""
MIN_SUPPORT = 0.4
"""Least fraction of an array's healthy taxels that must agree. Half of them may be in contact;
chance and crosstalk take a tenth more."""
MIN_INLIERS = 3
"""Two taxels agree by chance."""
MAX_RESIDUAL_RATIO = 1.5
"""rms of the supporting taxels over the expected: contacts below the inlier gate raise it."""
BOARD_REACH_UT = 15.0
"""µT by which the ambient field of an array may differ from the board's constant within the
board's own vote: 150 µT/m over 10 cm."""
BOARD_BONUS = 0.8
"""The board's constant is preferred to an array's own proposal that is not clearly better."""
IMPOSTOR_UT = 50.0
"""µT from the board's constant beyond which a plane with the support of less than
`IMPOSTOR_SUPPORT` is a uniform press (0.4 N) rather than the ambient field."""
IMPOSTOR_SUPPORT = 0.75
MAX_LEVERAGE = 1.0
"""Variance of the plane at its worst taxel over that of one sample, beyond which the free taxels
are too few or too much to one side to tell its slope; shrinkage sets in."""
SLOPE_UT_PER_M = 100.0
"""Spread of ambient gradients, the scale of that shrinkage: steel at arm's length makes 30."""


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """One fit of all arrays.

    ``theta``: (A, 3, 3) over `Layout.design`. ``support``, ``residual_ut``, ``valid``: (A,) as in
    `Ambient`. ``common``: (3,) µT in ``ee`` that the arrays with a valid fit share; NaN when none.
    """

    theta: Float
    support: Float
    residual_ut: Float
    valid: Bool
    common: Float


class Consensus:
    """The fit; stateless between cycles but for the noise it was told."""

    def __init__(self, layout: Layout, model: ForceModel) -> None:
        self._layout, self._model = layout, model
        arrays, n = layout.arrays, layout.width
        self._design = layout.design
        self._transposed = np.ascontiguousarray(layout.design.swapaxes(1, 2))
        x = layout.design
        self._products = (x[:, :, :, None] * x[:, :, None, :]).reshape(arrays, n, 9)
        sets = [design_candidates(x[a, : layout.counts[a]]) for a in range(arrays)]
        self._count = max(len(operators) for operators, _ in sets)
        propose = np.zeros((arrays, n, self._count, 3))
        self._uses = np.zeros((arrays, self._count, n))
        for a, (operators, uses) in enumerate(sets):
            # arrays with fewer subsets repeat theirs
            k = np.arange(self._count) % len(operators)
            propose[a, : layout.counts[a]] = operators[k].transpose(2, 0, 1)
            self._uses[a, :, : layout.counts[a]] = uses[k]
        self._propose = propose.reshape(arrays, n, 3 * self._count)
        self._rows = np.arange(arrays)
        few = layout.counts < PLANE_TAXELS
        self._stiff = np.zeros((arrays, 3, 3))
        self._stiff[:, 1, 1] = self._stiff[:, 2, 2] = np.where(few, 1e9, 1e-9) * layout.counts
        self._plane = ~few
        self._shrink = 1.0 / (layout.scale * SLOPE_UT_PER_M) ** 2
        self._variance = 1.0
        self.set_noise(np.array([4.4, 4.4, 6.7]))

    def set_noise(self, noise_ut: Float) -> None:
        """Noise of one sample, (3,) µT rms in chip axes."""
        self._variance = float((noise_ut**2).mean()) + MODEL_ERROR_UT**2

    def fit(self, field_ee: Float, forces: Float, healthy: Bool) -> Fit:
        """Fit of one cycle; see `Compensator.update` for the arguments."""
        weight = healthy.astype(np.float64)
        theta, score = self._vote(field_ee, weight, healthy)
        if len(theta) > 1:
            theta = self._prefer_common(theta, score, field_ee, weight)
        reach = FIRST_REACH**2 * self._variance
        theta = self._refine(theta, field_ee, weight, reach)
        target = field_ee
        reach = LAST_REACH**2 * self._variance
        if self._model.coupled:
            undone = self._model.decoupled_in_ee(field_ee, forces)
            target = undone - self._model.plane_leak(theta)
            theta = self._refine(theta, target, weight, reach)
            target = undone - self._model.plane_leak(theta)
        else:
            theta = self._refine(theta, target, weight, reach)
        theta = self._refine(theta, target, weight, reach, shrink=True)
        return self._judge(theta, target, healthy)

    def check(self, theta: Float, field_ee: Float, forces: Float, healthy: Bool) -> Fit:
        """How the present cycle supports the earlier fit ``theta``."""
        target = field_ee
        if self._model.coupled:
            undone = self._model.decoupled_in_ee(field_ee, forces)
            target = undone - self._model.plane_leak(theta)
        return self._judge(theta, target, healthy)

    def _vote(self, field: Float, weight: Float, healthy: Bool) -> tuple[Float, Float]:
        """Best proposal of each array, (A, 3, 3), and its score, (A,) µT²."""
        arrays, n, _ = field.shape
        by_component = field.swapaxes(1, 2)
        proposed = (by_component @ self._propose).reshape(arrays, 3 * self._count, 3)
        away = (proposed @ self._transposed).reshape(arrays, 3, self._count, n)
        away -= by_component[:, :, None, :]
        np.square(away, out=away)
        squared = away[:, 0]
        squared += away[:, 1]
        squared += away[:, 2]
        np.minimum(squared, INLIER_SIGMAS**2 * self._variance, out=squared)
        score = (squared @ weight[:, :, None])[..., 0]
        sick = (1.0 - weight) * self._layout.real
        if sick.any():
            score += 1e12 * (self._uses @ sick[:, :, None])[..., 0]
        best = score.argmin(axis=1)
        chosen = proposed.reshape(arrays, 3, self._count, 3)[self._rows, :, best]
        return chosen.swapaxes(1, 2), score[self._rows, best]

    def _prefer_common(self, theta: Float, score: Float, field: Float, weight: Float) -> Float:
        """Start from the board's constant on arrays that it explains about as well."""
        middle = theta[:, 0, :]
        away = field[None] - middle[:, None, None, :]
        squared = np.einsum("kanc,kanc->kan", away, away)
        gate = INLIER_SIGMAS**2 * self._variance + BOARD_REACH_UT**2
        np.minimum(squared, gate, out=squared)
        common = middle[int(np.tensordot(squared, weight, 2).argmin())]
        for _ in range(2):
            away = field - common
            inside = np.maximum(0.0, 1.0 - np.einsum("anc,anc->an", away, away) / gate)
            inside *= weight
            total = inside.sum()
            if total > 0:
                common = np.einsum("an,anc->c", inside, field) / total
        away = field - common
        squared = np.minimum(
            np.einsum("anc,anc->an", away, away), INLIER_SIGMAS**2 * self._variance
        )
        better = (squared * weight).sum(axis=1) * BOARD_BONUS <= score
        if better.any():
            theta = theta.copy()
            theta[better] = 0.0
            theta[better, 0] = common
        return theta

    def _refine(
        self, theta: Float, target: Float, weight: Float, reach: float, shrink: bool = False
    ) -> Float:
        """One step of reweighted least squares with Tukey's weights."""
        away = target - self._design @ theta
        inside = np.einsum("anc,anc->an", away, away)
        inside *= -1.0 / reach
        inside += 1.0
        np.maximum(inside, 0.0, out=inside)
        inside *= inside
        inside *= weight
        normal = (inside[:, None, :] @ self._products).reshape(-1, 3, 3) + self._stiff
        normal[:, 0, 0] += 1e-9  # no taxel inside: zero, and `_judge` refuses it
        right = (self._transposed * inside[:, None, :]) @ target
        inverse = np.linalg.inv(normal)
        if shrink:
            leverage = np.einsum("ank,ank->an", self._design @ inverse, self._design).max(axis=1)
            over = np.minimum(leverage - MAX_LEVERAGE, 1.0)
            over[~self._plane] = 0.0
            if (over > 0).any():
                ridge = np.maximum(over, 0.0) * self._variance * self._shrink
                normal[:, 1, 1] += ridge
                normal[:, 2, 2] += ridge
                inverse = np.linalg.inv(normal)
        refined: Float = inverse @ right
        return refined

    def _judge(self, theta: Float, target: Float, healthy: Bool) -> Fit:
        """Whether the taxels bear out a fit."""
        away = target - self._design @ theta
        squared = np.einsum("anc,anc->an", away, away)
        agree = (squared <= INLIER_SIGMAS**2 * self._variance) & healthy
        inliers = agree.sum(axis=1)
        support = inliers / np.maximum(healthy.sum(axis=1), 1)
        residual = np.sqrt((squared * agree).sum(axis=1) / (3.0 * np.maximum(inliers, 1)))
        valid = (
            (support >= MIN_SUPPORT)
            & (inliers >= MIN_INLIERS)
            & (residual <= MAX_RESIDUAL_RATIO * self._variance**0.5)
        )
        middle = theta[:, 0, :]
        common = _shared(middle, inliers * valid)
        if len(theta) > 1 and valid.any():
            far = np.linalg.norm(middle - common, axis=1) > IMPOSTOR_UT
            impostor = far & (support < IMPOSTOR_SUPPORT)
            if (impostor & valid).any():
                valid &= ~impostor
                common = _shared(middle, inliers * valid)
        return Fit(theta, support, residual, valid, common)


def _shared(middle: Float, inliers: NDArray[np.int_]) -> Float:
    """(3,) mean of the arrays' constants, weighted by their supporting taxels; NaN without any."""
    total = inliers.sum()
    if not total:
        return np.full(3, np.nan)
    mean: Float = inliers @ middle / total
    return mean
