"""Removal of the ambient field: what every method takes and gives, and the one that does none."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from tactile_core.arrays import FloatArray
from tactile_core.types import Instant
from tactiled.blocks import Ambient
from tactiled.sensing.layout import Layout

Bool = NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """What a method takes for the ambient field in one cycle.

    ``theta``: (A, 3, 3) µT, [a, component in ``ee``, coefficient over `Layout.design`].
    ``ambient``: the same for the outside. ``borrowed``: (A,) bool, where the array's own fit has
    no support and the field was carried on by what the board's other arrays see. ``sigma``:
    (A, 3) µT rms, how well the field at the array's centre is known, along ``ee``;
    ``slope_sigma``: (A,) µT rms, the same of either slope. ``leap``: (A,) µT by which the field
    has leapt on all taxels alike, more than the earth's can; 0 otherwise. ``loaded``: (A, n) bool,
    taxels that are known to bear something although it may be little; only small arrays tell.
    """

    theta: FloatArray
    ambient: Ambient
    borrowed: Bool
    sigma: FloatArray
    slope_sigma: FloatArray
    leap: FloatArray
    loaded: Bool


class Compensator(Protocol):
    """One method of compensation."""

    def update(
        self, field_ee: FloatArray, forces: FloatArray, healthy: Bool, captured: Instant
    ) -> Estimate:
        """Estimate for one cycle.

        ``field_ee``: (A, 3, n) µT. ``forces``: (A, 3, n) N, ambient included. ``healthy``:
        (A, n), False in the padding; what unhealthy taxels hold is finite and means nothing.
        """

    def set_noise(self, noise_ut: FloatArray) -> None:
        """Noise of one sample, (3,) µT rms in chip axes, as a tare measured it."""

    def reset(self, rested: bool = False) -> None:
        """Forget every earlier fit.

        ``rested``: the rest field has just been taken, ambient field and all, so that this is
        zero now; otherwise the stream has begun anew, and nobody knows how the board has turned.
        """


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
            sigma=np.zeros((arrays, 3)),  # who turns compensation off says that nothing turns
            slope_sigma=np.zeros(arrays),
            leap=np.zeros(arrays),
            loaded=np.zeros_like(layout.real),
        )

    def update(  # the arguments of every `Compensator`
        self,
        field_ee: FloatArray,  # noqa: ARG002
        forces: FloatArray,  # noqa: ARG002
        healthy: Bool,  # noqa: ARG002
        captured: Instant,  # noqa: ARG002
    ) -> Estimate:
        """The same estimate for every cycle."""
        return self._estimate

    def set_noise(self, noise_ut: FloatArray) -> None:
        """Nothing depends on it."""

    def reset(self, rested: bool = False) -> None:
        """Nothing is remembered."""


def outside_plane(theta: FloatArray, layout: Layout) -> FloatArray:
    """(A, 3, 3) of `Ambient.plane` ([a, component, value or slope per m]) from ``theta``."""
    return theta * layout.plane_scale
