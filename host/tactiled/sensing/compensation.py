"""Removal of the ambient field: the interface of all methods, and the method that does nothing."""

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
    """Estimate of the ambient field in one cycle.

    ``theta``: (A, 3, 3) µT, [array, component in ``ee``, coefficient over `Layout.design`].
    ``ambient``: the same in published form. ``borrowed``: (A,) bool, arrays without a fit of their
    own whose field was updated from the board's other arrays. ``sigma``: (A, 3) uncertainty of the
    field at the array's centre, µT rms along ``ee``; ``slope_sigma``: (A,) of either slope, µT rms.
    ``leap``: (A,) µT by which the field has leapt on all taxels alike, more than the earth's can;
    else 0. ``loaded``: (A, n) bool, taxels known to bear a load, even a small one; only for small
    arrays.
    """

    theta: FloatArray
    ambient: Ambient
    borrowed: Bool
    sigma: FloatArray
    slope_sigma: FloatArray
    leap: FloatArray
    loaded: Bool


class Compensator(Protocol):
    """A method of compensation."""

    def update(
        self, field_ee: FloatArray, forces: FloatArray, healthy: Bool, captured: Instant
    ) -> Estimate:
        """Estimate the ambient field of one cycle.

        ``field_ee``: (A, 3, n) µT in ``ee``. ``forces``: (A, 3, n) N in taxel axes, including the
        ambient field's. ``healthy``: (A, n), False in the padding; values of unhealthy taxels are
        finite but meaningless.
        """

    def set_noise(self, noise_ut: FloatArray) -> None:
        """Set the noise of one sample, (3,) µT rms in chip axes, as measured by a tare."""

    def reset(self, rested: bool = False) -> None:
        """Forget every earlier fit.

        ``rested``: a tare has just been taken, which includes the ambient field, so that this is
        zero now. Otherwise the stream has restarted, and the board may have turned meanwhile.
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
            sigma=np.zeros((arrays, 3)),  # compensation is off because the board does not turn
            slope_sigma=np.zeros(arrays),
            leap=np.zeros(arrays),
            loaded=np.zeros_like(layout.real),
        )

    def update(
        self,
        field_ee: FloatArray,  # noqa: ARG002 - as in `Compensator`
        forces: FloatArray,  # noqa: ARG002 - as in `Compensator`
        healthy: Bool,  # noqa: ARG002 - as in `Compensator`
        captured: Instant,  # noqa: ARG002 - as in `Compensator`
    ) -> Estimate:
        """Return the same estimate for every cycle."""
        return self._estimate

    def set_noise(self, noise_ut: FloatArray) -> None:
        """Ignore the noise."""

    def reset(self, rested: bool = False) -> None:
        """Nothing to forget."""


def outside_plane(theta: FloatArray, layout: Layout) -> FloatArray:
    """Convert ``theta`` to `Ambient.plane`, (A, 3, 3): [array, component, value or slope per m]."""
    return theta * layout.plane_scale
