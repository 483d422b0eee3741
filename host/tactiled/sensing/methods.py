"""The methods of compensation: which one each array gets."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tactile_core.arrays import FloatArray
from tactile_core.types import NS_PER_S, Instant
from tactiled.blocks import Ambient
from tactiled.sensing.compensation import Compensator, Estimate, Off, outside_plane
from tactiled.sensing.consensus import PLANE_TAXELS, Consensus, FieldTracker
from tactiled.sensing.forces import ForceModel
from tactiled.sensing.layout import Layout
from tactiled.sensing.ransac import RansacCompensator
from tactiled.sensing.settings import PipelineSettings
from tactiled.sensing.small_array import SmallArray

Bool = NDArray[np.bool_]


MIN_FREE = 0.5
"""Share of a small array's healthy taxels that must be free for a valid ambient field."""
CONTACT_UT = 1.2
"""µT rms of the slight onset of a press that may have been taken for the ambient field."""
COVERED_UT = 7.0
"""The same while the field turns and every chip is loaded or a contact is changing: the two cannot
be told apart at once."""
UNKNOWN_UT = 60.0
"""µT rms per component of an unknown ambient field: the earth's, turned."""
LONGEST_GAP_S = 5.0
"""s; longer gaps count as this long, which already allows any field of the earth."""


class ConsensusCompensator:
    """The default method: a fit in every cycle, or one per period with checks between."""

    def __init__(self, layout: Layout, consensus: Consensus, period_s: float) -> None:
        self._consensus = consensus
        self._period = round(period_s * NS_PER_S)
        self._tracker = FieldTracker(layout, "consensus", borrows=True)
        self._fitted: Instant | None = None
        self._sound = False  # whether the last fit was valid on every array, to continue from

    def set_noise(self, noise_ut: FloatArray) -> None:
        """Set the noise of one sample, (3,) µT rms in chip axes."""
        self._consensus.set_noise(noise_ut)
        self._tracker.sample_sigma = self._consensus.sample_sigma

    def reset(self, rested: bool = False) -> None:  # noqa: ARG002 - as every `Compensator`
        """Forget every plane."""
        self._tracker.reset()
        self._fitted = None
        self._sound = False

    def update(
        self, field_ee: FloatArray, forces: FloatArray, healthy: Bool, captured: Instant
    ) -> Estimate:
        """Estimate the ambient field of one cycle; see `Compensator.update`."""
        if self._fitted is None or captured - self._fitted >= self._period:
            prior = self._tracker.prior(captured)
            fit = None
            if self._sound:
                theta = self._tracker.theta
                fit = self._consensus.follow(theta, field_ee, forces, healthy, prior)
            if fit is None:
                fit = self._consensus.fit(field_ee, forces, healthy, prior)
            self._fitted, self._sound = captured, fit.whole
            return self._tracker.update(fit, captured)
        prior = self._tracker.prior(captured)
        fit = self._consensus.check(self._tracker.theta, field_ee, forces, healthy, prior)
        return self._tracker.update(fit, captured, fresh=False)


class SmallArrays:
    """Compensates each array of fewer than `PLANE_TAXELS` taxels on its own; see `SmallArray`.

    ``rest``: the method for the board's other arrays; None when there are none.
    """

    def __init__(
        self, layout: Layout, model: ForceModel, method: str, rest: Compensator | None
    ) -> None:
        self._layout, self._model, self._method, self._rest = layout, model, method, rest
        few = np.flatnonzero(layout.counts < PLANE_TAXELS).tolist()
        self._arrays = {a: SmallArray(model.press_direction[a, :, : layout.counts[a]]) for a in few}
        self.reset()

    def set_noise(self, noise_ut: FloatArray) -> None:
        """Set the noise of one sample, (3,) µT rms in chip axes."""
        if self._rest is not None:
            self._rest.set_noise(noise_ut)
        for a, array in self._arrays.items():
            turn = self._layout.rotation[a, :, :, 0]
            array.set_noise(np.sqrt(turn**2 @ noise_ut**2))

    def reset(self, rested: bool = False) -> None:
        """Start without contact; the ambient field is zero after a tare, else unknown."""
        arrays = self._layout.arrays
        self._theta = np.zeros((arrays, 3, 3))
        self._last: Instant | None = None
        self._age = np.zeros(arrays)
        for array in self._arrays.values():
            array.reset(0.0 if rested else UNKNOWN_UT)
        if self._rest is not None:
            self._rest.reset(rested)

    def update(
        self, field_ee: FloatArray, forces: FloatArray, healthy: Bool, captured: Instant
    ) -> Estimate:
        """Estimate the ambient field of one cycle; see `Compensator.update`."""
        layout, model = self._layout, self._model
        elapsed = 0.0 if self._last is None else (captured - self._last) / NS_PER_S
        elapsed = min(max(elapsed, 1e-4), LONGEST_GAP_S)
        self._last = captured
        if self._rest is None:
            estimate = self._blank()
        else:
            estimate = self._rest.update(field_ee, forces, healthy, captured)
        target = field_ee
        if model.decouples:
            target = model.decoupled_in_ee(field_ee, forces) - model.plane_leak(self._theta)
        theta, sigma = estimate.theta.copy(), estimate.sigma.copy()
        slope_sigma, leap = estimate.slope_sigma.copy(), estimate.leap.copy()
        support, residual = estimate.ambient.support.copy(), estimate.ambient.residual_ut.copy()
        age, valid = estimate.ambient.age.copy(), estimate.ambient.valid.copy()
        borrowed, loaded = estimate.borrowed.copy(), estimate.loaded.copy()
        for a, array in self._arrays.items():
            n = layout.counts[a]
            said = array.update(target[a, :, :n], healthy[a, :n], elapsed)
            theta[a] = 0.0
            theta[a, :, 0] = said.field
            free = said.free[healthy[a, :n]]
            blind = said.moving and (said.changing.any() or not free.any())
            taken = COVERED_UT if blind else 0.0 if free.all() else CONTACT_UT
            sigma[a] = np.hypot(said.sigma, taken)
            slope_sigma[a], leap[a] = 0.0, said.leap
            sound = int(np.count_nonzero(healthy[a]))
            support[a] = np.count_nonzero(said.free & healthy[a, :n]) / sound if sound else 0.0
            residual[a] = said.left_over
            loaded[a, :n] = ~said.free & healthy[a, :n]
            valid[a] = support[a] >= MIN_FREE and not said.leap
            self._age[a] = 0.0 if valid[a] else self._age[a] + elapsed
            age[a], borrowed[a] = self._age[a], False
        self._theta = theta
        ambient = Ambient(self._method, outside_plane(theta, layout), support, residual, age, valid)
        return Estimate(theta, ambient, borrowed, sigma, slope_sigma, leap, loaded)

    def _blank(self) -> Estimate:
        arrays = self._layout.arrays
        zero, none = np.zeros(arrays), np.zeros(arrays, dtype=bool)
        theta = np.zeros((arrays, 3, 3))
        ambient = Ambient(self._method, theta, zero, zero, zero, none)
        loaded = np.zeros_like(self._layout.real)
        return Estimate(theta, ambient, none, np.zeros((arrays, 3)), zero, zero, loaded)


def make_compensator(settings: PipelineSettings, layout: Layout, model: ForceModel) -> Compensator:
    """Make the compensator that ``settings`` name."""
    if settings.method == "off":
        return Off(layout)
    if settings.method == "consensus" and (layout.counts < PLANE_TAXELS).any():
        rest: Compensator | None = None
        if (layout.counts >= PLANE_TAXELS).any():
            rest = ConsensusCompensator(
                layout, Consensus(layout, model), settings.compensation_period_s
            )
        return SmallArrays(layout, model, settings.method, rest)
    consensus = Consensus(layout, model)
    if settings.method == "ransac":
        rng = np.random.default_rng(settings.seed)
        return RansacCompensator(layout, consensus, settings.compensation_period_s, rng)
    return ConsensusCompensator(layout, consensus, settings.compensation_period_s)
