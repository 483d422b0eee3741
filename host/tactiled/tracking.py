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
from tactiled.compensate import Estimate, outside_plane
from tactiled.consensus import Fit
from tactiled.layout import Layout

Float = NDArray[np.float64]

OFFSET_MEMORY_S = 30.0
"""s that an array's own offset from the board's constant is remembered while it borrows: chips
warm up with a time constant of minutes."""


class FieldTracker:
    """Last good plane and its age of each array of one board."""

    def __init__(self, layout: Layout, method: str, borrows: bool) -> None:
        self._layout = layout
        self._method = method
        self._borrows = borrows and layout.arrays > 1
        self.reset()

    def reset(self) -> None:
        """Forget every plane."""
        arrays = self._layout.arrays
        self.theta: Float = np.zeros((arrays, 3, 3))
        self._common = np.full((arrays, 3), np.nan)
        self._fitted_at = np.zeros(arrays, dtype=np.int64)
        self._ever = np.zeros(arrays, dtype=bool)

    def take(self, fit: Fit, captured: Instant, fresh: bool = True) -> Estimate:
        """Estimate of a cycle from its fit; ``fresh`` False: only a check of the earlier planes."""
        valid = fit.valid if fresh else fit.valid & self._ever
        if fresh:
            if valid.all():
                self.theta = fit.theta
                self._common[:] = fit.common
                self._fitted_at[:] = captured
                self._ever[:] = True
            elif valid.any():
                self.theta = np.where(valid[:, None, None], fit.theta, self.theta)
                self._common[valid] = fit.common
                self._fitted_at[valid] = captured
                self._ever |= valid
        age = (captured - self._fitted_at) / NS_PER_S
        age[~self._ever] = np.inf
        theta = self.theta
        borrowed = np.zeros(len(valid), dtype=bool)
        if self._borrows and fresh and valid.any() and not valid.all():
            theta, borrowed = self._borrow(fit, valid, age)
        ambient = Ambient(
            method=self._method,
            plane=outside_plane(theta, self._layout),
            support=fit.support,
            residual_ut=fit.residual_ut,
            age=age,
            valid=valid,
        )
        return Estimate(theta, ambient, borrowed)

    def _borrow(
        self, fit: Fit, valid: NDArray[np.bool_], age: Float
    ) -> tuple[Float, NDArray[np.bool_]]:
        """Planes in which the arrays without a fit of their own follow the rest of the board."""
        theta = self.theta.copy()
        for a in np.flatnonzero(~valid):
            if age[a] <= OFFSET_MEMORY_S:
                theta[a, :, 0] += fit.common - self._common[a]
            else:
                theta[a] = 0.0
                theta[a, :, 0] = fit.common
        return theta, ~valid
