"""Where each taxel stands in the rectangular arrays the sensing core computes with."""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from tactile_bus.geometry import SkinGeometry

Float = NDArray[np.float64]
Scalar = TypeVar("Scalar", bound=np.generic)


class Layout:
    """Arrays of different sizes side by side as (A, n, ...), n taxels of the largest.

    ``real``: (A, n) bool, False in the padding. ``counts``: (A,) taxels of each array.
    ``design``: (A, n, 3), 1 and both coordinates on the unrolled skin about the array's centre,
    divided by ``scale`` (A,) m so that fits are well conditioned; zero in the padding.
    ``rotation``: (A, n, 3, 3), taxel axes to ``ee``.
    """

    def __init__(self, geometry: SkinGeometry) -> None:
        arrays = geometry.arrays
        self.geometry = geometry
        self.arrays = len(arrays)
        self.counts = np.array([a.taxels for a in arrays])
        self.width = int(self.counts.max())
        self.taxels = int(self.counts.sum())
        self.real = np.arange(self.width) < self.counts[:, None]
        self._uniform = bool(self.real.all())
        self._where = np.flatnonzero(self.real)
        self.design = np.zeros((self.arrays, self.width, 3))
        self.rotation = np.zeros((self.arrays, self.width, 3, 3))
        self.scale = np.ones(self.arrays)
        for a, array in enumerate(arrays):
            flat = array.surface - array.surface.mean(axis=0)
            spread = float(np.sqrt((flat**2).mean()))
            self.scale[a] = spread if spread > 0 else 1.0
            self.design[a, : array.taxels, 0] = 1.0
            self.design[a, : array.taxels, 1:] = flat / self.scale[a]
            self.rotation[a, : array.taxels] = array.rotation

    def flat(self, padded: NDArray[Scalar]) -> NDArray[Scalar]:
        """(A, n, ...) → (N, ...), all taxels one array after another; may be a view."""
        joined = padded.reshape(self.arrays * self.width, *padded.shape[2:])
        return joined if self._uniform else joined[self._where]

    def padded(self, flat: Float, fill: float = 0.0) -> Float:
        """(N, ...) → (A, n, ...), ``fill`` in the padding."""
        out = np.full((self.arrays * self.width, *flat.shape[1:]), fill)
        out[self._where] = flat
        return out.reshape(self.arrays, self.width, *flat.shape[1:])
