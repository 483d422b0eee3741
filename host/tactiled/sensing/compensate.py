"""Removal of the ambient field: what every method takes and gives, and the one that does none."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from tactile_bus.instant import Instant
from tactiled.blocks import Ambient
from tactiled.sensing.layout import Layout

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """What a method takes for the ambient field in one cycle.

    ``theta``: (A, 3, 3) µT, [a, component in ``ee``, coefficient over `Layout.design`].
    ``ambient``: the same for the outside. ``borrowed``: (A,) bool, where the array's own fit has
    no support and the field was carried on by what the board's other arrays see.
    """

    theta: Float
    ambient: Ambient
    borrowed: Bool


class Compensator(Protocol):
    """One method of compensation."""

    def update(self, field_ee: Float, forces: Float, healthy: Bool, captured: Instant) -> Estimate:
        """Estimate for one cycle.

        ``field_ee``: (A, 3, n) µT. ``forces``: (A, 3, n) N, ambient included. ``healthy``:
        (A, n), False in the padding; what unhealthy taxels hold is finite and means nothing.
        """

    def set_noise(self, noise_ut: Float) -> None:
        """Noise of one sample, (3,) µT rms in chip axes, as a tare measured it."""

    def reset(self) -> None:
        """Forget every earlier fit: rest fields have changed or the stream has begun anew."""


class Off:
    """No compensation: the plane is zero and supported by every taxel."""

    def __init__(self, layout: Layout) -> None:
        arrays = layout.arrays
        theta = np.zeros((arrays, 3, 3))
        self._estimate = Estimate(
            theta=theta,
            ambient=Ambient(
                method="off",
                plane=np.zeros((arrays, 3, 3)),
                support=np.ones(arrays),
                residual_ut=np.zeros(arrays),
                age=np.zeros(arrays),
                valid=np.ones(arrays, dtype=bool),
            ),
            borrowed=np.zeros(arrays, dtype=bool),
        )

    def update(self, field_ee: Float, forces: Float, healthy: Bool, captured: Instant) -> Estimate:  # noqa: ARG002 - as every `Compensator`
        """The same estimate for every cycle."""
        return self._estimate

    def set_noise(self, noise_ut: Float) -> None:
        """Nothing depends on it."""

    def reset(self) -> None:
        """Nothing is remembered."""


def outside_plane(theta: Float, layout: Layout) -> Float:
    """(A, 3, 3) of `Ambient.plane` ([a, component, value or slope per m]) from ``theta``."""
    return theta * layout.plane_scale
