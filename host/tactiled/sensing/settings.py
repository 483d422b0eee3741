"""User settings of the sensing core, checked once."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from msgspec import Meta

from tactile_core.config import (
    ConfigError,
    Hertz,
    Microtesla,
    Newtons,
    Seconds,
    check_fields,
    written,
)
from tactiled.sensing import Method

RANSAC_RATE_HZ = 3.0
"""Compensation rate of the paper."""

Noise = Annotated[Microtesla, Meta(ge=0.001, le=10_000)]
TipForce = Annotated[Newtons, Meta(ge=0, le=1000)]


@dataclass(frozen=True, slots=True)
class PipelineSettings:
    """Settings of `BoardPipeline`; `ConfigError` names the first that cannot be used.

    Sources of the defaults: ``hold_s`` keeps the error of a held field below 0.25 N, half the
    paper's lowest threshold, at 0.35 rad/s in 50 µT. It does not apply to arrays of fewer than nine
    taxels, where every contact removes the support; the ambient field itself is always marked
    invalid at once. ``bound_limit_n`` is a third of the 1.5 N at which reachd's thresholds begin;
    it also limits the summed normal force where every array has fewer than nine taxels.
    ``tip_light_n`` is from the paper's Table II.
    """

    method: Annotated[
        Method,
        Meta(description="how the ambient field is removed"),
    ] = "consensus"
    compensation_rate_hz: Annotated[
        Annotated[Hertz, Meta(ge=0.01, le=10_000)] | None,
        Meta(
            description="how often a new fit is made; left out: 3 Hz (the paper) for ransac, "
            "every cycle for consensus"
        ),
    ] = None
    feature_rate_hz: Annotated[
        Annotated[Hertz, Meta(ge=0.01, le=10_000)] | None,
        Meta(description="how often features are sent; left out: every cycle"),
    ] = None
    noise_ut: Annotated[
        tuple[Noise, Noise, Noise],
        Meta(description="rms of one sample, x, y, z of a chip, until a tare has measured it"),
    ] = (4.4, 4.4, 6.7)
    contact_minimum_n: Annotated[
        Newtons,
        Meta(ge=1e-4, le=100, description="least force on a taxel that is a contact"),
    ] = 0.1
    contact_sigmas: Annotated[
        float, Meta(ge=1, le=100, description="the same, in standard deviations of its noise")
    ] = 4.5
    release_ratio: Annotated[
        float, Meta(ge=0.05, le=1, description="part of that force at which a contact ends")
    ] = 0.6
    tip_light_n: Annotated[
        tuple[TipForce, TipForce],
        Meta(description="least and greatest force on the tip that is a light contact"),
    ] = (0.5, 7.5)
    frozen_after_s: Annotated[
        Annotated[Seconds, Meta(ge=0.01, le=3600)] | None,
        Meta(description="unchanging counts for so long mean a frozen taxel"),
    ] = 0.5
    range_limit_ut: Annotated[
        Microtesla, Meta(ge=100, le=1e7, description="a reading beyond it is impossible")
    ] = 50_000.0
    tare_s: Annotated[
        Seconds, Meta(ge=0.02, le=60, description="how long the rest field is averaged")
    ] = 0.5
    tare_limit_n: Annotated[
        Newtons,
        Meta(ge=0.01, le=1000, description="a tare is refused beyond it on one taxel: a contact"),
    ] = 1.0
    auto_tare: Annotated[
        bool | None,
        Meta(
            description="tare at the start; left out: when the rest is unknown (no calibration) "
            "or a fitted model must start from it"
        ),
    ] = None
    rest_tracking_s: Annotated[
        Annotated[Seconds, Meta(ge=0.1, le=1e6)] | None,
        Meta(
            description="time constant at which the rest of untouched taxels follows; left out: "
            "never"
        ),
    ] = None
    hold_s: Annotated[
        Seconds,
        Meta(
            ge=0,
            le=3600,
            description="how long features stay valid, degraded, after an array's fit lost its "
            "support",
        ),
    ] = 1.5
    bound_limit_n: Annotated[
        Newtons,
        Meta(ge=0.01, le=1000, description="bound of the peak force beyond which it is not valid"),
    ] = 0.5
    masked_limit: Annotated[
        float, Meta(ge=0, le=1, description="masked part of an array beyond which it is invalid")
    ] = 0.25
    seed: Annotated[int, Meta(ge=0, le=2**32 - 1, description="of the random draws of ransac")] = 0

    def __post_init__(self) -> None:
        """Check the values; `ConfigError`."""
        check_fields(self)
        least, greatest = self.tip_light_n
        if greatest < least:
            raise ConfigError(
                f"tip_light_n = {written(self.tip_light_n)}; allowed: the least force first",
                ("tip_light_n",),
            )

    @property
    def compensation_period_s(self) -> float:
        """Seconds from one fit to the next; 0: every cycle."""
        rate = self.compensation_rate_hz
        if rate is None and self.method == "ransac":
            rate = RANSAC_RATE_HZ
        return 0.0 if rate is None else 1.0 / rate
