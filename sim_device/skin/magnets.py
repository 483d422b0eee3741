"""Field of point dipoles at the chips of a skin, from their own magnets and their neighbours'."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tactile_core.arrays import FloatArray

Index = NDArray[np.intp]

MU0_OVER_4PI = 1e-7
"""Magnetic constant over 4π, T·m/A."""

UT_PER_T = 1e6


def dipole_field_ut(offset: FloatArray, moment: FloatArray) -> FloatArray:
    """Field in µT at ``offset`` (..., 3) m from point dipoles ``moment`` (..., 3) A·m².

    B = µ0/4π · (3 (m·r̂) r̂ − m) / r³ (Jackson, Classical Electrodynamics, eq. 5.56).
    """
    r2 = np.einsum("...i,...i->...", offset, offset)
    along = np.einsum("...i,...i->...", moment, offset)
    scale = (MU0_OVER_4PI * UT_PER_T) / (r2 * np.sqrt(r2))
    field: FloatArray = (3.0 * along / r2 * scale)[..., None] * offset - scale[..., None] * moment
    return field


class MagnetArray:
    """Magnets over chips: ``chips`` (N, 3) m, ``rest`` (N, 3) m and ``moment`` (N, 3) A·m² in ee.

    Each chip sees the magnets within ``radius`` m of it at rest; others are ignored.
    """

    def __init__(
        self, chips: FloatArray, rest: FloatArray, moment: FloatArray, radius: float
    ) -> None:
        self._rest = rest
        distance = np.linalg.norm(chips[:, None] - rest[None], axis=2)
        seen = distance <= radius
        np.fill_diagonal(seen, True)
        pairs = np.argwhere(seen)
        self._chip, self._magnet = chip, _ = pairs[:, 0], pairs[:, 1]
        # Every chip has at least its own magnet, so each has a run of pairs, in order.
        self._starts = np.searchsorted(chip, np.arange(len(chips)))
        # One row per component: numpy is several times faster on long rows than on triples.
        self._offset = np.ascontiguousarray((chips[chip] - rest[self._magnet]).T)
        self._whole = np.ascontiguousarray(moment[self._magnet].T)
        self._moment = self._whole

    def scale(self, factor: FloatArray) -> None:
        """Set every moment to ``factor`` (N,) times its original value; 0: the magnet is gone."""
        self._moment = self._whole * factor[self._magnet]

    @property
    def pairs(self) -> tuple[Index, Index]:
        """Chip and magnet (P,) of every pair in which the chip sees the magnet."""
        return self._chip, self._magnet

    def shares_ut(self, displacement: FloatArray) -> FloatArray:
        """Field (..., P, 3) µT in ee at the chip of each pair, from the pair's magnet alone.

        ``displacement``: (..., N, 3) m in ee.
        """
        offset = self._offset.T - displacement.take(self._magnet, axis=-2)
        return dipole_field_ut(offset, self._moment.T)

    def field_ut(self, displacement: FloatArray, strength: float = 1.0) -> FloatArray:
        """Field (N, 3) µT in ee at the chips with the magnets moved by ``displacement``.

        ``displacement``: (N, 3) m in ee. ``strength``: factor on every moment.
        """
        offset = self._offset - displacement.take(self._magnet, axis=0).T
        x, y, z = offset
        mx, my, mz = self._moment
        r2 = x * x + y * y + z * z
        along = mx * x + my * y + mz * z
        scale = (MU0_OVER_4PI * UT_PER_T * strength) / (r2 * np.sqrt(r2))
        along *= 3.0 * scale / r2
        pairs = along * offset - scale * self._moment
        total: FloatArray = np.add.reduceat(pairs, self._starts, axis=1).T
        return total
