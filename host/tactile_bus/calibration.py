"""Calibration of one board: where its taxels are and how field becomes force."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tactile_bus.geometry import ArrayGeometry, SkinGeometry

Float = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class ArrayCalibration:
    """One array of n taxels; all vectors in taxel axes (after the chips' yaw was undone).

    ``rest_ut``: (n, 3) µT unloaded, at ``reference_c`` °C. ``drift_ut_per_k``: (n, 3) µT/K.
    ``newton_per_ut``: (3n, 3n) N/µT; the taxels' forces, one after another, are this matrix times
    their fields (rest, drift and ambient taken off). Off-diagonal blocks undo crosstalk.
    """

    geometry: ArrayGeometry
    rest_ut: Float
    drift_ut_per_k: Float
    reference_c: float
    newton_per_ut: Float


@dataclass(frozen=True, slots=True, eq=False)
class BoardCalibration:
    """Calibration of the board with ``serial_number``.

    ``nominal``: made from typical figures, not from measurements of this board; then the rest
    field is unknown and must be tared.
    """

    serial_number: str
    model: str
    frame: str
    created: str  # ISO 8601
    provenance: str
    nominal: bool
    arrays: tuple[ArrayCalibration, ...]

    @property
    def geometry(self) -> SkinGeometry:
        """Geometry of the whole board."""
        return SkinGeometry(self.model, self.frame, tuple(a.geometry for a in self.arrays))
