"""Compensation as in the paper: a RANSAC plane per component and array, once per period.

scikit-learn fits one surface at a time, which takes some milliseconds, so the surfaces of a period
are spread over its cycles instead of being fitted all in one.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from tactile_core.arrays import FloatArray
from tactile_core.types import NS_PER_S, Instant
from tactiled.sensing.compensation import Estimate
from tactiled.sensing.consensus import Consensus, FieldTracker
from tactiled.sensing.layout import Layout

Bool = NDArray[np.bool_]

MIN_TAXELS = 4
"""Fewest healthy taxels: three for a plane and another to check it."""


class RansacCompensator:
    """The paper's method. In every cycle the support of the planes in use is checked, by the same
    measure as for consensus.
    """

    def __init__(
        self, layout: Layout, checker: Consensus, period_s: float, rng: np.random.Generator
    ) -> None:
        from tactiled.sensing.ransac_plane import (
            fit_plane,  # imports scikit-learn, 1.1 s, so only when the method is used
        )

        self._fit_plane = fit_plane
        self._layout = layout
        self._checker = checker
        self._rng = rng
        self._period = round(period_s * NS_PER_S)
        self._tracker = FieldTracker(layout, "ransac", borrows=False)
        self.reset()

    def set_noise(self, noise_ut: FloatArray) -> None:
        """Set the noise of one sample, (3,) µT rms in chip axes."""
        self._checker.set_noise(noise_ut)
        self._tracker.sample_sigma = self._checker.sample_sigma

    def reset(self, rested: bool = False) -> None:  # noqa: ARG002 - as every `Compensator`
        """Forget every plane."""
        self._tracker.reset()
        self._begun: Instant | None = None
        self._done = 0
        self._theta = np.zeros((self._layout.arrays, 3, 3))
        self._complete = np.zeros(self._layout.arrays, dtype=bool)

    def update(
        self, field_ee: FloatArray, forces: FloatArray, healthy: Bool, captured: Instant
    ) -> Estimate:
        """Estimate the ambient field of one cycle; see `Compensator.update`."""
        surfaces = 3 * self._layout.arrays
        due = 0
        if self._begun is None:
            self._begun, due = captured, surfaces  # all at once: there are no planes yet
        elif self._done == surfaces:
            if captured - self._begun >= self._period:
                self._begun, self._done, due = captured, 0, 1
        else:
            due = min(surfaces, 1 + (captured - self._begun) * surfaces // self._period)
        prior = self._tracker.prior(captured)
        if self._fit_surfaces(due, field_ee, healthy):
            fit = self._checker.check(self._theta, field_ee, forces, healthy, prior)
            return self._tracker.update(replace(fit, valid=fit.valid & self._complete), captured)
        held = self._checker.check(self._tracker.theta, field_ee, forces, healthy, prior)
        return self._tracker.update(held, captured, fresh=False)

    def _fit_surfaces(self, upto: int, field: FloatArray, healthy: Bool) -> bool:
        """Fit surfaces until ``upto`` of them are done; True when that completes the period."""
        surfaces = 3 * self._layout.arrays
        if self._done >= upto:
            return False
        while self._done < upto:
            a, component = divmod(self._done, 3)
            use = healthy[a]
            plane = None
            if use.sum() >= MIN_TAXELS:
                plane = self._fit_plane(
                    self._layout.design[a, 1:, use], field[a, component, use], self._rng
                )
            if component == 0:
                self._complete[a] = True
            if plane is None:
                self._complete[a] = False
            else:
                self._theta[a, component] = plane
            self._done += 1
        return self._done == surfaces
