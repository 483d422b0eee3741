"""Contact patches: clusters of neighbouring taxels in contact."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tactile_bus.geometry import ArrayGeometry, SkinGeometry

NEIGHBOUR_REACH = 1.6
"""Taxels are neighbours up to this many times the array's typical spacing: diagonals of a square
grid are at 1.41, the second row at 2."""


class Adjacency:
    """Which taxels touch which, within each array: a patch belongs to one array and one side.

    ``masks``: per taxel an int whose bits are its neighbours. ``neighbours``: per taxel itself
    and its neighbours.
    """

    def __init__(self, geometry: SkinGeometry) -> None:
        self.masks: list[int] = []
        self.neighbours: list[tuple[int, ...]] = []
        for part, array in zip(geometry.slices, geometry.arrays, strict=True):
            near = _near(array)
            for i in range(array.taxels):
                others = np.flatnonzero(near[i]) + part.start
                self.masks.append(sum(1 << j for j in others.tolist()))
                self.neighbours.append((part.start + i, *others.tolist()))

    def clusters(self, members: list[int]) -> list[list[int]]:
        """Connected groups of the taxels ``members``, each ascending, ordered by first taxel."""
        left = 0
        for taxel in members:
            left |= 1 << taxel
        out: list[list[int]] = []
        while left:
            seed = left & -left
            left ^= seed
            group, border = [], seed
            while border:
                bit = border & -border
                border ^= bit
                taxel = bit.bit_length() - 1
                group.append(taxel)
                new = self.masks[taxel] & left
                left ^= new
                border |= new
            group.sort()
            out.append(group)
        return out

    def rings(self, groups: list[list[int]], blind: list[int]) -> list[list[int]]:
        """Taxels round each of ``groups`` that are in none and not ``blind``; each used once."""
        taken = sum(1 << taxel for group in groups for taxel in group)
        taken |= sum(1 << taxel for taxel in blind)
        out = []
        for group in groups:
            near = 0
            for taxel in group:
                near |= self.masks[taxel]
            near &= ~taken
            taken |= near
            ring = []
            while near:
                bit = near & -near
                near ^= bit
                ring.append(bit.bit_length() - 1)
            out.append(ring)
        return out


def _near(array: ArrayGeometry) -> NDArray[np.bool_]:
    """(n, n) bool, neighbours over the unrolled skin; grids need not be square."""
    n = array.taxels
    if n == 1:
        return np.zeros((1, 1), dtype=bool)
    apart = array.surface[:, None] - array.surface[None]
    if array.rows > 1 and array.columns > 1:
        step = np.abs(apart)
        for axis in (0, 1):
            steps = step[..., axis][step[..., axis] > 1e-6]
            apart[..., axis] /= steps.min() if steps.size else 1.0
        near = np.all(np.abs(apart) <= NEIGHBOUR_REACH, axis=-1)
    else:
        distance = np.linalg.norm(apart, axis=-1)
        others = distance + np.where(np.eye(n, dtype=bool), np.inf, 0)
        near = distance <= NEIGHBOUR_REACH * np.median(others.min(axis=1))
    touching: NDArray[np.bool_] = near & ~np.eye(n, dtype=bool)
    return touching
