"""What the user may choose of the sensing core, checked once."""

from __future__ import annotations

import math
from dataclasses import dataclass

METHODS = ("off", "ransac", "consensus")

RANSAC_RATE_HZ = 3.0
"""Compensation rate of the paper."""


@dataclass(frozen=True, slots=True)
class PipelineSettings:
    """Settings of `BoardPipeline`; ValueError names the first that cannot be used.

    ``method``: of ambient compensation, one of `METHODS`. ``compensation_rate_hz``: how often a
    new fit is made; None: 3 Hz (the paper) for ransac, every cycle for consensus.
    ``feature_rate_hz``: how often a cycle's features are due to be sent; None: every cycle.
    ``noise_ut``: µT rms of one sample, x, y, z of a chip, until a tare has measured it.
    ``contact_minimum_n``, ``contact_sigmas``, ``release_ratio``: a taxel is in contact above the
    larger of a force and that many sigma of its noise, until it falls below the ratio of it.
    ``tip_light_n``: N, least and greatest tip force that is a light contact (paper, Table II).
    ``frozen_after_s``: s of unchanging counts after which a taxel is frozen; None: never.
    ``range_limit_ut``: µT beyond which a chip's reading is impossible. ``tare_s``: s averaged.
    ``tare_limit_n``: N on one taxel beyond which a tare is refused as a contact.
    ``auto_tare``: tare at the start; None: when the rest is unknown (the calibration is nominal) or
    a fitted model must start from it.
    ``rest_tracking_s``: s, time constant at which untouched taxels' rest follows; None: never.
    ``hold_s``: s that features stay valid, degraded, on a held field after an array's fit lost its
    support; the default keeps its error below 0.25 N, half the paper's least threshold, at
    0.35 rad/s in 50 µT. Without limit on arrays of fewer than nine taxels, where every contact
    takes the support away. The ambient field itself is marked invalid at once in any case.
    ``bound_limit_n``: N, least additive bound of the peak force (and of the summed normal force
    where every array has fewer than nine taxels) at which features are no longer valid; the
    default is a third of the 1.5 N from which reachd's thresholds act.
    ``masked_limit``: fraction of an array's taxels beyond which features are invalid.
    ``seed``: of RANSAC's random draws.
    """

    method: str = "consensus"
    compensation_rate_hz: float | None = None
    feature_rate_hz: float | None = None
    noise_ut: tuple[float, float, float] = (4.4, 4.4, 6.7)
    contact_minimum_n: float = 0.1
    contact_sigmas: float = 4.5
    release_ratio: float = 0.6
    tip_light_n: tuple[float, float] = (0.5, 7.5)
    frozen_after_s: float | None = 0.5
    range_limit_ut: float = 50_000.0
    tare_s: float = 0.5
    tare_limit_n: float = 1.0
    auto_tare: bool | None = None
    rest_tracking_s: float | None = None
    hold_s: float = 1.5
    bound_limit_n: float = 0.5
    masked_limit: float = 0.25
    seed: int = 0

    def __post_init__(self) -> None:
        """Refuse what cannot be used."""
        if self.method not in METHODS:
            raise ValueError(f"method is {self.method!r}; allowed: {', '.join(METHODS)}")
        for name, value, low, high in (
            ("compensation_rate_hz", self.compensation_rate_hz, 0.01, 10_000),
            ("feature_rate_hz", self.feature_rate_hz, 0.01, 10_000),
            *((f"noise_ut[{i}]", value, 0.001, 10_000) for i, value in enumerate(self.noise_ut)),
            ("contact_minimum_n", self.contact_minimum_n, 1e-4, 100),
            ("contact_sigmas", self.contact_sigmas, 1, 100),
            ("release_ratio", self.release_ratio, 0.05, 1),
            ("tip_light_n[0]", self.tip_light_n[0], 0, 1000),
            ("tip_light_n[1]", self.tip_light_n[1], self.tip_light_n[0], 1000),
            ("frozen_after_s", self.frozen_after_s, 0.01, 3600),
            ("range_limit_ut", self.range_limit_ut, 100, 1e7),
            ("tare_s", self.tare_s, 0.02, 60),
            ("tare_limit_n", self.tare_limit_n, 0.01, 1000),
            ("rest_tracking_s", self.rest_tracking_s, 0.1, 1e6),
            ("hold_s", self.hold_s, 0, 3600),
            ("bound_limit_n", self.bound_limit_n, 0.01, 1000),
            ("masked_limit", self.masked_limit, 0, 1),
            ("seed", self.seed, 0, 2**32 - 1),
        ):
            if value is not None and not (math.isfinite(value) and low <= value <= high):
                raise ValueError(f"{name} is {value}; allowed: {low:g} to {high:g}")

    @property
    def compensation_period_s(self) -> float:
        """Seconds from one fit to the next; 0: every cycle."""
        rate = self.compensation_rate_hz
        if rate is None and self.method == "ransac":
            rate = RANSAC_RATE_HZ
        return 0.0 if rate is None else 1.0 / rate
