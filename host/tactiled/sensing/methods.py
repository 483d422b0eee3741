"""The methods of compensation there are, by name."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tactile_bus.instant import NS_PER_S, Instant
from tactiled.sensing.compensate import Compensator, Estimate, Off
from tactiled.sensing.consensus import Consensus
from tactiled.sensing.force_model import ForceModel
from tactiled.sensing.layout import Layout
from tactiled.sensing.pipeline_settings import PipelineSettings
from tactiled.sensing.ransac import RansacCompensator
from tactiled.sensing.tracking import FieldTracker

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]


class ConsensusCompensator:
    """Our method; see `Compensator`. A fit in every cycle, or one a period and checks between."""

    def __init__(self, layout: Layout, consensus: Consensus, period_s: float) -> None:
        self._consensus = consensus
        self._period = round(period_s * NS_PER_S)
        self._tracker = FieldTracker(layout, "consensus", borrows=True)
        self._fitted: Instant | None = None
        self._sound = False  # the last fit was valid on every array: it can be followed

    def set_noise(self, noise_ut: Float) -> None:
        """Noise of one sample, (3,) µT rms in chip axes."""
        self._consensus.set_noise(noise_ut)

    def reset(self) -> None:
        """Forget every plane."""
        self._tracker.reset()
        self._fitted = None
        self._sound = False

    def update(self, field_ee: Float, forces: Float, healthy: Bool, captured: Instant) -> Estimate:
        """Estimate for one cycle."""
        if self._fitted is None or captured - self._fitted >= self._period:
            prior = self._tracker.prior(captured)
            fit = None
            if self._sound:
                theta = self._tracker.theta
                fit = self._consensus.follow(theta, field_ee, forces, healthy, prior)
            if fit is None:
                fit = self._consensus.fit(field_ee, forces, healthy, prior)
            self._fitted, self._sound = captured, fit.whole
            return self._tracker.take(fit, captured)
        prior = self._tracker.prior(captured)
        fit = self._consensus.check(self._tracker.theta, field_ee, forces, healthy, prior)
        return self._tracker.take(fit, captured, fresh=False)


def make_compensator(settings: PipelineSettings, layout: Layout, model: ForceModel) -> Compensator:
    """Compensator that ``settings`` ask for."""
    if settings.method == "off":
        return Off(layout)
    consensus = Consensus(layout, model)
    if settings.method == "ransac":
        rng = np.random.default_rng(settings.seed)
        return RansacCompensator(layout, consensus, settings.compensation_period_s, rng)
    return ConsensusCompensator(layout, consensus, settings.compensation_period_s)
