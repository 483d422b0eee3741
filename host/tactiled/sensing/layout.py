"""Index of each taxel in the rectangular arrays that the sensing core computes with.

Vectors of all taxels are (A, 3, n): A arrays, component, n taxels of the largest array, so that
one component of one array is contiguous; scalars are (A, n). The padding of smaller arrays holds
zeros and counts as unhealthy.
"""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from tactile_core.geometry import SkinGeometry

Scalar = TypeVar("Scalar", bound=np.generic)


class Layout:
    """Shapes and positions of a board's taxels.

    ``posed``: whether the arrays' poses relative to each other are known.
    ``real``: (A, n) bool, False in the padding. ``counts``: (A,) taxels of each array.
    ``design``: (A, 3, n): 1 and both coordinates on the unrolled skin about the array's centre,
    divided by ``scale`` (A,) m so that fits are well conditioned; zero in the padding.
    ``rotation``: (A, 3, 3, n); [a, :, :, i] rotates vectors from the axes of taxel i to ``ee``.
    """

    def __init__(self, geometry: SkinGeometry) -> None:
        arrays = geometry.arrays
        self.arrays = len(arrays)
        self.posed = geometry.posed
        self.counts = np.array([a.taxels for a in arrays])
        self.width = int(self.counts.max())
        self.taxels = int(self.counts.sum())
        self.real = np.arange(self.width) < self.counts[:, None]
        self._uniform = bool(self.real.all())
        self._where = np.flatnonzero(self.real)
        self.design = np.zeros((self.arrays, 3, self.width))
        self.rotation = np.zeros((self.arrays, 3, 3, self.width))
        self.scale = np.ones(self.arrays)
        self.plane_scale = np.ones((self.arrays, 1, 3))  # converts coefficients to slopes per m
        for a, array in enumerate(arrays):
            flat = array.surface - array.surface.mean(axis=0)
            spread = float(np.sqrt((flat**2).mean()))
            self.scale[a] = spread if spread > 0 else 1.0
            self.plane_scale[a, 0, 1:] = 1.0 / self.scale[a]
            self.design[a, 0, : array.taxels] = 1.0
            self.design[a, 1:, : array.taxels] = flat.T / self.scale[a]
            self.rotation[a, :, :, : array.taxels] = array.rotation.transpose(1, 2, 0)

    def flat(self, padded: NDArray[Scalar]) -> NDArray[Scalar]:
        """Convert (A, n) to (N,), taxels ordered array by array; may be a view."""
        joined = padded.reshape(-1)
        return joined if self._uniform else joined[self._where]

    def flat_vectors(self, padded: NDArray[Scalar]) -> NDArray[Scalar]:
        """Convert (A, 3, n) to (N, 3), taxels ordered array by array; always a copy."""
        joined = padded.swapaxes(1, 2).reshape(-1, 3)
        return joined if self._uniform else joined[self._where]

    def padded(self, flat: NDArray[Scalar]) -> NDArray[Scalar]:
        """Convert (N,) to (A, n), with zero in the padding."""
        out = np.zeros(self.arrays * self.width, flat.dtype)
        out[self._where] = flat
        return out.reshape(self.arrays, self.width)
