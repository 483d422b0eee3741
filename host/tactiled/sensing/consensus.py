"""Deterministic robust fit of the ambient field, all arrays and all components at once.

A contact disturbs a taxel in all three components, while the ambient field is a plane over the
unrolled skin and, in ``ee`` axes, nearly the same constant on every array. Designed subsets of
taxels propose planes. All taxels vote on them by their joint three-component distance. The winner
(or the constant of the whole board, where that explains an array better) is refined by reweighted
least squares, the last time on fields without the neighbours' contacts.

The fit is linear in the field as long as the same taxels are chosen: a uniform field added to the
readings is recovered exactly, a plane mostly to a fraction of the noise and at worst to about the
noise. Shapes as in `Layout`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from tactile_core.arrays import FloatArray
from tactile_core.types import NS_PER_S, Instant
from tactiled.blocks import Ambient
from tactiled.sensing.compensation import Estimate, outside_plane
from tactiled.sensing.forces import ForceModel
from tactiled.sensing.layout import Layout

# Designed subsets of an array's taxels, each of which proposes a plane for the ambient field.
#
# Nothing is random: the subsets depend only on the geometry, so equal inputs give equal fits.


PLANE_TAXELS = 9
"""Arrays of fewer taxels get a constant instead of a plane: on five taxels a plane absorbs 46 % of
the contact's energy, a constant 16 % (measured on AnySkin-like boards)."""
CONSTANTS = 24
"""Most subsets that propose a constant, each a compact group of taxels. A contact is compact, so
when half of an array is free, whole groups are free."""
TRIPLES = 40
"""Subsets of three taxels that propose a plane. When a random half of the taxels is free, so is one
triple in ten: all 40 are disturbed with probability 0.9^40 = 1.5 %, and the constants remain."""
GROUP = 4
"""Taxels of a compact group; their mean has half of one sample's noise."""
DENSE = 24
"""Triples are formed from at most this many taxels, evenly strided, so that designing them for the
largest array of 128 takes no longer than for 24 (2,024 triples)."""


def design_candidates(design: FloatArray) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Operators from the field on n taxels to the coefficients that each of k subsets proposes.

    ``design``: (n, 3), `Layout.design` of one array, taxels first. Returns the operators (k, 3, n)
    and which taxels each uses, (k, n) bool.
    """
    n = len(design)
    operators: list[FloatArray] = []
    used: list[tuple[int, ...]] = []
    for group in _groups(design):
        operator = np.zeros((3, n))
        operator[0, list(group)] = 1 / len(group)
        operators.append(operator)
        used.append(group)
    if n >= PLANE_TAXELS:
        for triple in _triples(design):
            operator = np.zeros((3, n))
            operator[:, list(triple)] = np.linalg.inv(design[list(triple)])
            operators.append(operator)
            used.append(triple)
    uses = np.zeros((len(used), n), dtype=bool)
    for k, subset in enumerate(used):
        uses[k, list(subset)] = True
    return np.array(operators), uses


def _groups(design: FloatArray) -> list[tuple[int, ...]]:
    """Compact groups that propose a constant; all pairs on small arrays."""
    n = len(design)
    if n < PLANE_TAXELS:
        return list(combinations(range(n), 2)) if n > 1 else [(0,)]
    flat = design[:, 1:]
    distance = np.linalg.norm(flat[:, None] - flat[None], axis=2)
    groups: dict[tuple[int, ...], None] = {}
    for i in range(n):
        # nearest to a point just up and right of the taxel: the 2 × 2 block with it as corner
        corner = flat[i] + 0.5 * np.sort(distance[i])[1] * np.array([1.0, 1.0])
        away = np.linalg.norm(flat - corner, axis=1)
        nearest = np.argsort(np.round(away, 9), kind="stable")[:GROUP]
        groups.setdefault(tuple(sorted(nearest.tolist())))
    every = list(groups)
    keep = np.unique(np.linspace(0, len(every) - 1, min(CONSTANTS, len(every))).round().astype(int))
    return [every[i] for i in keep.tolist()]


def _triples(design: FloatArray) -> list[tuple[int, ...]]:
    """Wide triples that use all taxels about equally often."""
    n = len(design)
    pool = np.unique(np.linspace(0, n - 1, min(n, DENSE)).round().astype(int)).tolist()
    every = list(combinations(pool, 3))
    corners = design[np.array(every)][:, :, 1:]
    one, two = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = np.abs(one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0])
    spread = area / max(float(area.max()), 1e-12)
    chosen: list[tuple[int, ...]] = []
    members = np.array(every)
    uses = np.zeros(n)
    free = spread > 0.05  # narrower triples amplify noise more than twenty times
    for _ in range(min(TRIPLES, int(free.sum()))):
        # prefer rarely used taxels, then wide triples
        merit = np.where(free, np.sqrt(spread) - uses[members].sum(axis=1), -np.inf)
        best = int(np.argmax(np.round(merit, 9)))
        chosen.append(every[best])
        uses[members[best]] += 1
        free[best] = False
    return chosen


Bool = NDArray[np.bool_]

INLIER_SIGMAS = 4.0
"""A taxel supports a fit within this many sigma, components together; noise excludes 0.1 %."""
FIRST_REACH = 6.0
LAST_REACH = 5.0
"""Sigma at which Tukey's weight reaches zero, in the first and the last refinement: wide while the
start is noisy itself (a proposal's few taxels, the cycle before), then just beyond the inliers."""
MODEL_ERROR_UT = 1.5
"""µT rms by which chips differ in a uniform field: 3 % sensitivity in 50 µT."""
MIN_SUPPORT = 0.5
"""Least fraction of an array's healthy taxels that must agree on a plane. With sixteen random
presses of 1–3 N, some plane has six or seven taxels within its gate by chance."""
LONE_SUPPORT = 0.65
"""The same when there is no other evidence, from another array or an earlier cycle."""
CONFIRMED_SUPPORT = 0.3
CONFIRMED_UT = 15.0
"""The same for a plane within this many µT of what the rest of the board indicates."""
FOLLOW_SUPPORT = 0.65
"""Support above which a plane has no rival on arrays of nine taxels and more."""
MIN_INLIERS = 3
"""Two taxels agree by chance."""
MAX_RESIDUAL_RATIO = 1.5
"""Most rms of the supporting taxels relative to the expected; contacts below the gate raise it."""
BOARD_REACH_UT = 15.0
"""µT by which the ambient field of an array may differ from the board's constant in the vote of the
whole board: 150 µT/m over 10 cm."""
BOARD_BONUS = 0.8
"""Factor on its score with which the board's constant competes: an array's own proposal must be
clearly better."""
IMPOSTOR_UT = 50.0
"""µT from the arrays' common field, or that of the cycle before, beyond which a plane is a uniform
press (a third of a newton) and not the ambient field."""
MAX_SLOPE_UT_PER_M = 1000.0
"""Steeper planes are evenly varying pressure, as under a tilted wall: the ambient field is not that
uneven unless a magnet is closer than a hand's breadth."""
MAX_LEVERAGE = 1.0
"""Variance of the plane at its worst taxel relative to one sample's, above which the free taxels
are too few or too one-sided to determine its slope, and shrinkage sets in."""
AMPLE_WEIGHT = 0.6
"""Mean weight of an array's taxels above which no choice of free ones has that leverage."""
SLOPE_UT_PER_M = 100.0
"""Spread of ambient gradients, which scales that shrinkage: steel at arm's length makes 30."""

_NONE = (math.nan, math.nan, math.nan)


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """One fit of all arrays.

    ``theta``: (A, 3, 3) µT, [array, component in ``ee``, coefficient]. ``support``,
    ``residual_ut``, ``valid``: (A,) as in `Ambient`. ``common``: (3,) µT in ``ee``, mean constant
    of the arrays with a valid fit; NaN when there are none. ``whole``: every array is valid.
    ``leap``: (A,) µT, distance of a field that an array's taxels agree on from where the ambient
    field can be; 0 where it is within reach.
    """

    theta: FloatArray
    support: FloatArray
    residual_ut: FloatArray
    valid: Bool
    common: FloatArray
    whole: bool
    leap: FloatArray


@dataclass(frozen=True, slots=True)
class Prior:
    """The board's ``constant``, (3,) µT in ``ee``, is known to within ``reach`` µT."""

    constant: list[float]
    reach: float


class Consensus:
    """Fits the ambient field; keeps no state between cycles except the noise."""

    def __init__(self, layout: Layout, model: ForceModel) -> None:
        self._layout, self._model = layout, model
        arrays, n = layout.arrays, layout.width
        self._design = layout.design
        taxels_first = np.ascontiguousarray(layout.design.swapaxes(1, 2))
        self._taxels_first = taxels_first
        self._products = (taxels_first[..., None] * taxels_first[:, :, None]).reshape(arrays, n, 9)
        sets = [design_candidates(taxels_first[a, : layout.counts[a]]) for a in range(arrays)]
        self._count = count = max(len(operators) for operators, _ in sets)
        operators_of = np.zeros((arrays, count, 3, n))
        self._uses = np.zeros((arrays, count, n))
        for a, (operators, uses) in enumerate(sets):
            k = np.arange(count) % len(operators)  # arrays with fewer subsets repeat them
            operators_of[a, :, :, : layout.counts[a]] = operators[k]
            self._uses[a, :, : layout.counts[a]] = uses[k]
        # the vote only ranks proposals: single precision halves its time
        propose = operators_of.transpose(0, 3, 2, 1).reshape(arrays, n, 3 * count)
        self._propose = np.ascontiguousarray(propose, np.float32)
        self._places = taxels_first.astype(np.float32)
        self._rows = np.arange(arrays)
        self._counts: list[int] = layout.counts.tolist()
        few = layout.counts < PLANE_TAXELS
        self._stiff = np.zeros((arrays, 3, 3))
        # the constant's 1e-9 keeps an array without any weight invertible; `_judge` refuses it
        self._stiff[:, 0, 0] = 1e-9
        self._stiff[:, 1, 1] = self._stiff[:, 2, 2] = np.where(few, 1e9, 1e-12) * layout.counts
        self._few = few
        self._steep: list[float] = (layout.scale * MAX_SLOPE_UT_PER_M).tolist()
        self._ample = AMPLE_WEIGHT * layout.counts
        self._shrink = 1.0 / (layout.scale * SLOPE_UT_PER_M) ** 2
        self._variance = 1.0
        self.set_noise(np.array([4.4, 4.4, 6.7]))

    @property
    def sample_sigma(self) -> float:
        """Deviation of one component of a free taxel from a perfect plane, µT rms."""
        return math.sqrt(self._variance)

    def set_noise(self, noise_ut: FloatArray) -> None:
        """Noise of one sample, (3,) µT rms in chip axes."""
        self._variance = float((noise_ut**2).mean()) + MODEL_ERROR_UT**2
        self._gate = INLIER_SIGMAS**2 * self._variance
        # sum of squared distances when a quarter of the taxels are at the gate
        self._doubtful = (0.25 * self._gate + 0.75 * 3.3 * self._variance) * self._layout.counts

    def fit(
        self, field_ee: FloatArray, forces: FloatArray, healthy: Bool, prior: Prior | None = None
    ) -> Fit:
        """Fit one cycle; for the arguments see `Compensator.update`.

        ``prior``: the ambient field by earlier cycles; None: unknown.
        """
        weight = healthy.astype(np.float64)
        theta, score = self._vote(field_ee, healthy)
        if len(theta) > 1 and np.count_nonzero(score > self._doubtful):
            self._prefer_common(theta, score, field_ee, weight)
        theta = self._refine(theta, field_ee, weight, FIRST_REACH**2 * self._variance)
        target = self._target(theta, field_ee, forces)
        if self._model.decouples:
            theta = self._refine(theta, target, weight, FIRST_REACH**2 * self._variance)
            target = self._target(theta, field_ee, forces)
        theta = self._refine(theta, target, weight, LAST_REACH**2 * self._variance, shrink=True)
        return self._judge(theta, target, healthy, prior)

    def follow(
        self,
        theta: FloatArray,
        field_ee: FloatArray,
        forces: FloatArray,
        healthy: Bool,
        prior: Prior | None,
    ) -> Fit | None:
        """Fit a cycle by continuing the earlier fit ``theta``; None when a vote is needed.

        Accepted only where a vote could have no other result: two planes share at most three
        taxels of an array, so a plane with a support of `FOLLOW_SUPPORT` has no rival.
        """
        target = self._target(theta, field_ee, forces)
        weight = healthy.astype(np.float64)
        theta = self._refine(theta, target, weight, FIRST_REACH**2 * self._variance, shrink=True)
        fit = self._judge(theta, target, healthy, prior)
        return fit if fit.whole and fit.support.min() >= FOLLOW_SUPPORT else None

    def check(
        self,
        theta: FloatArray,
        field_ee: FloatArray,
        forces: FloatArray,
        healthy: Bool,
        prior: Prior | None,
    ) -> Fit:
        """Judge how well the cycle supports ``theta``, an earlier or another method's fit."""
        target = self._target(theta, field_ee, forces)
        return self._judge(theta, target, healthy, prior)

    def _all(self, healthy: Bool) -> bool:
        return int(np.count_nonzero(healthy)) == self._layout.taxels

    def _target(self, theta: FloatArray, field_ee: FloatArray, forces: FloatArray) -> FloatArray:
        """Fields without neighbours' contacts, given the approximate ambient field ``theta``."""
        if not self._model.decouples:
            return field_ee
        target = self._model.decoupled_in_ee(field_ee, forces)
        target -= self._model.plane_leak(theta)
        return target

    def _vote(self, field: FloatArray, healthy: Bool) -> tuple[FloatArray, FloatArray]:
        """Best proposal of each array, (A, 3, 3), and its score, (A,) µT²."""
        # components first, so that every step below runs over contiguous memory
        single = field.swapaxes(0, 1).astype(np.float32, order="C")
        proposed = single[:, :, None] @ self._propose
        proposed = proposed.reshape(3, len(field), 3, self._count)
        away = self._places @ proposed
        away -= single[..., None]
        np.square(away, out=away)
        squared = away[0]
        squared += away[1]
        squared += away[2]
        np.minimum(squared, np.float32(self._gate), out=squared)
        score = (healthy.astype(np.float32)[:, None, :] @ squared)[:, 0]
        if not self._all(healthy):
            sick = self._layout.real & ~healthy
            score += 1e12 * (self._uses @ sick[:, :, None])[..., 0]
        best = score.argmin(axis=1)
        theta = proposed[:, self._rows, :, best].astype(np.float64)
        return theta, score[self._rows, best]

    def _prefer_common(
        self, theta: FloatArray, score: FloatArray, field: FloatArray, weight: FloatArray
    ) -> None:
        """Set ``theta`` to the board's constant for arrays that it explains about as well."""
        flat = field.swapaxes(0, 1).reshape(3, -1)
        flat_weight = weight.reshape(-1)
        gate = self._gate + BOARD_REACH_UT**2
        proposals = theta[:, :, 0]
        squared = np.square(flat - proposals[:, :, None]).sum(axis=1)
        np.minimum(squared, gate, out=squared)
        common = proposals[(squared @ flat_weight).argmin()]
        inside = 1.0 - np.square(flat - common[:, None]).sum(axis=0) / gate
        np.maximum(inside, 0.0, out=inside)
        inside *= flat_weight
        total = float(inside.sum())
        if total > 0:
            common = flat @ inside / total
        squared_now = np.square(flat - common[:, None]).sum(axis=0)
        np.minimum(squared_now, self._gate, out=squared_now)
        explained = (squared_now * flat_weight).reshape(weight.shape).sum(axis=1)
        for a in np.flatnonzero(explained * BOARD_BONUS <= score).tolist():
            theta[a] = 0.0
            theta[a, :, 0] = common

    def _refine(
        self,
        theta: FloatArray,
        target: FloatArray,
        weight: FloatArray,
        reach: float,
        shrink: bool = False,
    ) -> FloatArray:
        """One step of reweighted least squares with Tukey's weights."""
        away = target - theta @ self._design
        inside = np.einsum("acn,acn->an", away, away)
        inside *= -1.0 / reach
        inside += 1.0
        np.maximum(inside, 0.0, out=inside)
        inside *= inside
        inside *= weight
        normal = (inside[:, None, :] @ self._products).reshape(-1, 3, 3)
        normal += self._stiff
        right = (target * inside[:, None, :]) @ self._taxels_first
        inverse = np.linalg.inv(normal)
        if shrink and np.count_nonzero(normal[:, 0, 0] < self._ample):
            leverage = np.einsum("akn,akn->an", inverse @ self._design, self._design).max(axis=1)
            over = leverage - MAX_LEVERAGE
            over[self._few] = 0.0
            if np.count_nonzero(over > 0):
                ridge = np.minimum(np.maximum(over, 0.0), 1.0) * self._variance * self._shrink
                normal[:, 1, 1] += ridge
                normal[:, 2, 2] += ridge
                inverse = np.linalg.inv(normal)
        refined: FloatArray = (
            right @ inverse
        )  # symmetric: each row is the solution of one component
        return refined

    def _judge(
        self, theta: FloatArray, target: FloatArray, healthy: Bool, prior: Prior | None
    ) -> Fit:
        """Judge whether the taxels support a fit."""
        away = target - theta @ self._design
        squared = np.einsum("acn,acn->an", away, away)
        agree = np.empty((2, *squared.shape))
        np.less_equal(squared, self._gate, out=agree[0], casting="unsafe")
        agree[0] *= healthy
        np.multiply(squared, agree[0], out=agree[1])
        # there are few arrays, so plain numbers are faster from here on
        inliers, sums = agree.sum(axis=2).tolist()
        sound = self._counts if self._all(healthy) else healthy.sum(axis=1).tolist()
        middle = theta[:, :, 0].tolist()
        limit = 3.0 * MAX_RESIDUAL_RATIO**2 * self._variance
        support = [k / h if h else 0.0 for k, h in zip(inliers, sound, strict=True)]
        steepest = np.abs(theta[:, :, 1:]).max(axis=(1, 2)).tolist()
        fair = [
            k >= MIN_INLIERS and q <= limit * k and slope <= most
            for k, q, slope, most in zip(inliers, sums, steepest, self._steep, strict=True)
        ]
        valid = [ok and s >= MIN_SUPPORT for ok, s in zip(fair, support, strict=True)]
        residual = [math.sqrt(q / (3 * max(k, 1))) for q, k in zip(sums, inliers, strict=True)]
        agreed = _agreed(middle, inliers, valid, prior)
        leap = np.zeros(len(middle))
        for a, centre in enumerate(middle):
            if agreed is None:
                valid[a] = valid[a] and support[a] >= LONE_SUPPORT
            else:
                off = math.dist(centre, agreed.constant)
                if fair[a] and support[a] >= LONE_SUPPORT and off > agreed.reach:
                    leap[a] = off
                confirmed = fair[a] and support[a] >= CONFIRMED_SUPPORT and off <= CONFIRMED_UT
                valid[a] = confirmed or (valid[a] and off <= agreed.reach)
        common = _shared(middle, inliers, valid)
        return Fit(
            theta,
            np.array(support),
            np.array(residual),
            np.array(valid),
            np.array(common or _NONE),
            all(valid),
            leap,
        )


def _agreed(
    middle: list[list[float]], inliers: list[float], valid: list[bool], prior: Prior | None
) -> Prior | None:
    """Where the ambient field must be; None when unknown.

    The constant that two or more arrays have in common, because presses on arrays that face
    different ways cannot agree in ``ee``; else ``prior``.
    """
    most, agreed = 0.0, prior
    for middling, sound in zip(middle, valid, strict=True):
        if sound:
            near = [
                count
                for other, count, ok in zip(middle, inliers, valid, strict=True)
                if ok and math.dist(middling, other) <= IMPOSTOR_UT
            ]
            if len(near) > 1 and sum(near) > most:
                most, agreed = sum(near), Prior(middling, IMPOSTOR_UT)
    return agreed


def _shared(
    middle: list[list[float]], inliers: list[float], valid: list[bool]
) -> list[float] | None:
    """Mean of the valid arrays' constants, weighted by their inliers; None when none is valid."""
    weights = [k if ok else 0 for k, ok in zip(inliers, valid, strict=True)]
    total = sum(weights)
    if not total:
        return None
    return [sum(w * m[c] for w, m in zip(weights, middle, strict=True)) / total for c in range(3)]


# Fits over time: the last good plane of each array, its age, and planes borrowed from other arrays.
#
# A plane without support in the present cycle is never presented as a fit: it stays in use, marked
# invalid, with growing age. Where other arrays of the rigid board still see the ambient field, its
# change since then is added.


OFFSET_MEMORY_S = 30.0
"""s for which an array's own offset from the board's constant is used while it borrows: chips warm
up with a time constant of minutes."""
LENDING_ARRAY = 0.75
LENDING_BOARD = 0.25
"""Arrays without a fit follow the others if one of these has this support, or all together have
this fraction of the board's taxels: half of one array among many might be chance."""
TURNING_UT_PER_S = 17.5
"""Rate of change of 50 µT for a board turning at 0.35 rad/s: with time the last field says less."""
BORROWED_UT = 5.0
"""µT rms by which the field of a borrowing array differs from that of the others: gradients of
30 µT/m over the finger."""
REVERSED_UT = 130.0
"""µT, largest possible change of the earth's field: 65 µT reversed. A uniform press beyond it on a
lone array is never taken for the ambient field, however long it lasts."""


class FieldTracker:
    """Keeps the last good plane of each array of one board, and its age."""

    def __init__(self, layout: Layout, method: str, borrows: bool) -> None:
        self._layout = layout
        self._method = method
        # Arrays can only borrow from each other if their relative poses are known.
        self._borrows = borrows and layout.arrays > 1 and layout.posed
        self._zero_age = np.zeros(layout.arrays)
        self._none = np.zeros(layout.arrays, dtype=bool)
        self.sample_sigma = 5.0
        self._unloaded = np.zeros_like(layout.real)
        self._zero_age.flags.writeable = self._none.flags.writeable = False
        self.reset()

    def reset(self) -> None:
        """Forget every plane."""
        arrays = self._layout.arrays
        self.theta: FloatArray = np.zeros((arrays, 3, 3))
        self._sure = np.zeros(arrays)  # taxels that supported the plane in use
        self._common = np.full((arrays, 3), np.nan)
        self._fitted_at = np.zeros(arrays, dtype=np.int64)
        self._ever = np.zeros(arrays, dtype=bool)
        self._seen: Instant | None = None
        self._newest: list[float] = []

    def prior(self, captured: Instant) -> Prior | None:
        """Range of the board's constant by its last fit; None before the first."""
        if self._seen is None:
            return None
        turned = TURNING_UT_PER_S * (captured - self._seen) / NS_PER_S
        return Prior(self._newest, min(IMPOSTOR_UT + turned, REVERSED_UT))

    def update(self, fit: Fit, captured: Instant, fresh: bool = True) -> Estimate:
        """Estimate of a cycle from its fit. ``fresh`` False: the fit only checks earlier planes."""
        if fresh and fit.whole:
            self.theta = fit.theta
            self._common[:] = fit.common
            self._seen, self._newest = captured, fit.common.tolist()
            self._fitted_at.fill(captured)
            self._ever.fill(True)
            return self._estimate(fit, fit.theta, fit.valid, self._zero_age, self._none)
        valid = fit.valid if fresh else fit.valid & self._ever
        if fresh and valid.any():
            self.theta = np.where(valid[:, None, None], fit.theta, self.theta)
            self._common[valid] = fit.common
            self._seen, self._newest = captured, fit.common.tolist()
            self._fitted_at[valid] = captured
            self._ever |= valid
        age = (captured - self._fitted_at) / NS_PER_S
        age[~self._ever] = np.inf
        if self._borrows and fresh and self._lends(fit):
            theta, borrowed = self._borrow(fit, valid, age)
            return self._estimate(fit, theta, valid, age, borrowed)
        return self._estimate(fit, self.theta, valid, age, self._none)

    def _estimate(
        self, fit: Fit, theta: FloatArray, valid: Bool, age: FloatArray, borrowed: Bool
    ) -> Estimate:
        support = fit.support * self._layout.counts
        self._sure = np.where(valid, support, self._sure)
        variance = self.sample_sigma**2 / np.maximum(self._sure, 1.0)
        if borrowed is not self._none:
            variance = np.where(borrowed, variance + BORROWED_UT**2, variance)
        sigma = np.sqrt(variance)
        if age is not self._zero_age:
            turned = np.where(borrowed, 0.0, TURNING_UT_PER_S * age)
            sigma = sigma + np.where(np.isfinite(age), turned, REVERSED_UT)
        ambient = Ambient(
            method=self._method,
            plane=outside_plane(theta, self._layout),
            support=fit.support,
            residual_ut=fit.residual_ut,
            age=age,
            valid=valid,
        )
        return Estimate(
            theta,
            ambient,
            borrowed,
            np.repeat(sigma[:, None], 3, axis=1),
            sigma,
            fit.leap,
            self._unloaded,
        )

    def _lends(self, fit: Fit) -> bool:
        """Whether the arrays with a valid fit suffice to lend their field to the others."""
        supporting = fit.support * self._layout.counts * fit.valid
        return bool(
            (fit.support[fit.valid] >= LENDING_ARRAY).any()
            or supporting.sum() >= LENDING_BOARD * self._layout.taxels
        )

    def _borrow(self, fit: Fit, valid: Bool, age: FloatArray) -> tuple[FloatArray, Bool]:
        """Planes in which arrays without a valid fit follow the rest of the board, and which do."""
        theta = self.theta.copy()
        for a in np.flatnonzero(~valid):
            if age[a] <= OFFSET_MEMORY_S:
                theta[a, :, 0] += fit.common - self._common[a]
            else:
                theta[a] = 0.0
                theta[a, :, 0] = fit.common
        return theta, ~valid
