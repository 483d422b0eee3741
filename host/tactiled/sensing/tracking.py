"""What becomes of fits over time: the last good plane of each array, its age, and what is borrowed.

A plane that the present cycle does not support is never passed off as a fit: it stays in force,
marked invalid, its age growing; where other arrays of the rigid board still see the ambient field,
its change since then is carried over.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tactile_bus.instant import NS_PER_S, Instant
from tactiled.blocks import Ambient
from tactiled.sensing.compensate import Estimate, outside_plane
from tactiled.sensing.consensus import IMPOSTOR_UT, Fit, Prior
from tactiled.sensing.layout import Layout

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]

OFFSET_MEMORY_S = 30.0
"""s that an array's own offset from the board's constant is remembered while it borrows: chips
warm up with a time constant of minutes."""
LENDING_ARRAY = 0.75
LENDING_BOARD = 0.25
"""Arrays without a fit follow the others if one of those has this support, or all of those together
this fraction of the board's taxels: half of one array of many might be chance."""
TURNING_UT_PER_S = 17.5
"""How fast a board turning at 0.35 rad/s sees 50 µT change: what it saw last binds the less, the
longer ago."""
BORROWED_UT = 5.0
"""µT rms by which the field of an array that borrows differs from what the others see: gradients
of 30 µT/m over the finger."""
REVERSED_UT = 130.0
"""Most that the earth's field can change at all: 65 µT turned round. Beyond it a uniform press on a
lone array is never taken for the field, however long it lasts."""


class FieldTracker:
    """Last good plane and its age of each array of one board."""

    def __init__(self, layout: Layout, method: str, borrows: bool) -> None:
        self._layout = layout
        self._method = method
        # What another array sees says nothing where nobody knows how they lie to one another.
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
        self.theta: Float = np.zeros((arrays, 3, 3))
        self._sure = np.zeros(arrays)  # taxels that bear out the plane in force
        self._common = np.full((arrays, 3), np.nan)
        self._fitted_at = np.zeros(arrays, dtype=np.int64)
        self._ever = np.zeros(arrays, dtype=bool)
        self._seen: Instant | None = None
        self._newest: list[float] = []

    def prior(self, captured: Instant) -> Prior | None:
        """Where the board's constant must be by what it saw last; None before it saw anything."""
        if self._seen is None:
            return None
        turned = TURNING_UT_PER_S * (captured - self._seen) / NS_PER_S
        return Prior(self._newest, min(IMPOSTOR_UT + turned, REVERSED_UT))

    def take(self, fit: Fit, captured: Instant, fresh: bool = True) -> Estimate:
        """Estimate of a cycle from its fit; ``fresh`` False: only a check of the earlier planes."""
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
        self, fit: Fit, theta: Float, valid: Bool, age: Float, borrowed: Bool
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
        """Whether the arrays with a valid fit are enough to speak for the board."""
        supporting = fit.support * self._layout.counts * fit.valid
        return bool(
            (fit.support[fit.valid] >= LENDING_ARRAY).any()
            or supporting.sum() >= LENDING_BOARD * self._layout.taxels
        )

    def _borrow(self, fit: Fit, valid: Bool, age: Float) -> tuple[Float, Bool]:
        """Planes in which the arrays without a fit of their own follow the rest of the board."""
        theta = self.theta.copy()
        for a in np.flatnonzero(~valid):
            if age[a] <= OFFSET_MEMORY_S:
                theta[a, :, 0] += fit.common - self._common[a]
            else:
                theta[a] = 0.0
                theta[a, :, 0] = fit.common
        return theta, ~valid
