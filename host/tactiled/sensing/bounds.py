"""95 % bounds of the errors of published forces, in N.

They add up: noise of the chips, uncertainty of the ambient field (which grows while a fit is held,
`Estimate.sigma`), differences between chips in a uniform field, warming since the rest field was
taken, forces too small to be detected, and the scale of the calibration. The first five do not
depend on the force and decide whether features are valid; the last grows with the force.
"""

from __future__ import annotations

import math

import numpy as np

from tactile_core.arrays import FloatArray
from tactiled.sensing.compensation import Estimate
from tactiled.sensing.consensus import PLANE_TAXELS
from tactiled.sensing.forces import ForceModel
from tactiled.sensing.layout import Layout

QUANTILE_95 = 1.96
"""Normally distributed errors are within this many sigma in 95 % of cycles."""
MEASURED_SCALE = 0.06
"""Relative error of a force with the board's own calibration (95 %): hysteresis of up to 6 %,
curvature of the dipole law of 7 % at twice the calibrated load."""
NOMINAL_SCALE = 1.0
"""The same for nominal figures, which are accurate to within a factor of two."""
PULL_N = 0.3
"""N of apparent pull at a taxel that crosstalk and hysteresis explain."""
FRICTION = 1.0
"""Largest shear over normal force that rubber bears."""
SLIP_N = 0.5
"""N of shear that are tolerated: a neighbour's contact shears a taxel that bears little itself."""
UNEVEN_UT = 1.5
"""µT rms by which chips differ in a uniform field: 3 % sensitivity in 50 µT."""
KNOWN_DRIFT_UT_PER_K = 0.3
"""µT/K rms that remain after correction with a measured drift (0.1 of the chips' own)."""
UNKNOWN_DRIFT_UT_PER_K = 1.5
"""µT/K rms drift of an unmeasured chip's offset (datasheet: ± 150 µT over 60 K at most)."""
UNKNOWN_DRIFT_SHARE_PER_K = 0.0003
"""Deviation of magnets from their makers' −0.12 %/K, as a share of the rest field per K, rms."""


class Bounds:
    """Computes bounds of one board's forces; keeps no state besides settings."""

    def __init__(self, model: ForceModel, layout: Layout, nominal: bool) -> None:
        self._layout = layout
        slopes = model.normal_slopes()
        every = [layout.flat(slopes[..., c, k].copy()) for c in range(3) for k in range(3)]
        self._slopes = np.stack(every, axis=1).reshape(-1, 3, 3)  # (N, component, coefficient)
        self._array = np.repeat(np.arange(layout.arrays), layout.counts)
        self._few: bool = bool((layout.counts < PLANE_TAXELS).all())
        self._scale = NOMINAL_SCALE if nominal else MEASURED_SCALE
        self._nominal = nominal
        self._constant = np.ascontiguousarray(self._slopes[:, :, 0])
        self._tilt = (self._slopes[:, :, 1:] ** 2).sum(axis=(1, 2))  # (N,) N²/µT²
        self._gain = np.linalg.norm(self._constant, axis=1)  # N/µT
        self._still: FloatArray = np.zeros(layout.taxels)  # N², the part equal in every cycle
        self._drift: FloatArray = np.zeros(layout.taxels)  # N/K rms

    @property
    def few(self) -> bool:
        """Whether all arrays have so few taxels that their sum is as well known as each taxel."""
        return self._few

    def set_noise(self, normal_sigma: FloatArray) -> None:
        """Set the noise of each taxel's normal force, (N,) N rms."""
        self._still = normal_sigma**2 + (UNEVEN_UT * self._gain) ** 2

    def set_rest(self, rest_ut: FloatArray) -> None:
        """Set the rest field, (N, 3) µT, from which the drift follows."""
        per_kelvin = np.full(len(rest_ut), KNOWN_DRIFT_UT_PER_K)
        if self._nominal:
            share = UNKNOWN_DRIFT_SHARE_PER_K * np.linalg.norm(rest_ut, axis=1)
            per_kelvin = np.hypot(UNKNOWN_DRIFT_UT_PER_K, share)
        self._drift = per_kelvin * self._gain

    def drift_sigma(self, warmer_k: FloatArray) -> FloatArray:
        """Apparent force of warming by ``warmer_k`` (N,) K since the rest was taken, (N,) N rms."""
        return np.abs(warmer_k) * self._drift

    def taxels(self, estimate: Estimate, drift: FloatArray) -> FloatArray:
        """Additive bound of each taxel's normal force, (N,) N. ``drift``: from `drift_sigma`."""
        a = self._array
        ambient = (self._constant * estimate.sigma[a]) ** 2
        slope = self._tilt * estimate.slope_sigma[a] ** 2
        variance: FloatArray = ambient.sum(axis=1) + slope + self._still + drift**2
        return QUANTILE_95 * np.sqrt(variance)

    def together(self, taxels: list[int], estimate: Estimate, drift: FloatArray) -> float:
        """Additive bound of the summed normal force of ``taxels``, N."""
        if not taxels:
            return 0.0
        variance = float((self._still[taxels] + drift[taxels] ** 2).sum())
        arrays, slopes = self._array[taxels], self._slopes[taxels]
        for a in sorted(set(arrays.tolist())):
            lost = slopes[arrays == a].sum(axis=0)  # (component, coefficient)
            variance += float(((lost[:, 0] * estimate.sigma[a]) ** 2).sum())
            variance += float((lost[:, 1:] ** 2).sum()) * float(estimate.slope_sigma[a]) ** 2
        return QUANTILE_95 * math.sqrt(variance)

    def apart(self, patches: list[list[int]], estimate: Estimate, drift: FloatArray) -> list[float]:
        """N, the additive bound of the summed normal force of each of ``patches``.

        As `together`, for groups of taxels that are each of one array, all at once.
        """
        if not patches:
            return []
        every = [taxel for patch in patches for taxel in patch]
        starts = np.cumsum([0, *map(len, patches[:-1])])
        a = self._array[[patch[0] for patch in patches]]
        lost = np.add.reduceat(self._slopes[every], starts, axis=0)
        variance = np.add.reduceat(self._still[every] + drift[every] ** 2, starts)
        variance += ((lost[:, :, 0] * estimate.sigma[a]) ** 2).sum(axis=1)
        variance += (lost[:, :, 1:] ** 2).sum(axis=(1, 2)) * estimate.slope_sigma[a] ** 2
        found: list[float] = (QUANTILE_95 * np.sqrt(variance)).tolist()
        return found

    def implausible(self, force: FloatArray) -> float:
        """Force that no contact exerts, N: pulls, and shear beyond friction. ``force``: (N, 3) N.

        A passing magnet looks like that. Used only on arrays of few taxels, which have no better
        check, and only with the board's own calibration, which knows what a press looks like.
        """
        if self._nominal or not self._few:
            return 0.0
        normal = -force[:, 2]
        shear = np.hypot(force[:, 0], force[:, 1])
        pull = float(np.nanmax(-normal, initial=0.0)) - PULL_N
        slip = float(np.nanmax(shear - FRICTION * np.maximum(normal, 0.0), initial=0.0)) - SLIP_N
        return max(pull, 0.0) + max(slip, 0.0)

    def scaled(self, force: float) -> float:
        """Error of a force of ``force`` N due to the scale of the calibration, N."""
        return self._scale * abs(force)
