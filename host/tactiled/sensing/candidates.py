"""Designed subsets of an array's taxels, each of which proposes a surface for the ambient field.

No random draws: the subsets depend on the geometry alone, so equal inputs give equal fits.
"""

from __future__ import annotations

from itertools import combinations

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]

PLANE_TAXELS = 9
"""Arrays of fewer taxels get a constant instead of a plane: on five taxels a plane takes 46 % of
the contact's energy with it, a constant 16 % (measured on AnySkin-like boards)."""
CONSTANTS = 24
"""Most subsets that propose a constant, each from one compact group of taxels. A contact is
compact, so where half of an array is free, whole groups are free."""
TRIPLES = 40
"""Subsets of three taxels that propose a plane. Where half of the taxels are free at random, one
triple in ten is: all 40 are hit with probability 0.9^40 = 1.5 %, and the constants stand beside
them."""
GROUP = 4
"""Taxels of a compact group: their mean has half of one sample's noise."""
DENSE = 24
"""Triples are drawn from at most this many taxels, evenly strided, so that designing them for
the largest array of 128 takes no longer than for one of 24 (2,024 triples)."""


def design_candidates(design: Float) -> tuple[Float, NDArray[np.bool_]]:
    """Operators from the field on n taxels to the coefficients that each subset proposes.

    ``design``: (n, 3), `Layout.design` of one array, taxels first. Returns
    (k, 3, n) and (k, n) which taxels each uses.
    """
    n = len(design)
    operators: list[Float] = []
    used: list[tuple[int, ...]] = []
    for group in _groups(design):
        operator = np.zeros((3, n))
        operator[0, list(group)] = 1 / len(group)
        operators.append(operator)
        used.append(group)
    if n >= PLANE_TAXELS:
        for triple in _triples(design):
            operator = np.zeros((3, n))
            operator[:, list(triple)] = np.linalg.inv(design[list(triple)])
            operators.append(operator)
            used.append(triple)
    uses = np.zeros((len(used), n), dtype=bool)
    for k, subset in enumerate(used):
        uses[k, list(subset)] = True
    return np.array(operators), uses


def _groups(design: Float) -> list[tuple[int, ...]]:
    """Compact groups that propose a constant; all pairs on small arrays."""
    n = len(design)
    if n < PLANE_TAXELS:
        return list(combinations(range(n), 2)) if n > 1 else [(0,)]
    flat = design[:, 1:]
    distance = np.linalg.norm(flat[:, None] - flat[None], axis=2)
    groups: dict[tuple[int, ...], None] = {}
    for i in range(n):
        # nearest to a point just up and right of the taxel: the 2 × 2 block it is the corner of
        corner = flat[i] + 0.5 * np.sort(distance[i])[1] * np.array([1.0, 1.0])
        away = np.linalg.norm(flat - corner, axis=1)
        nearest = np.argsort(np.round(away, 9), kind="stable")[:GROUP]
        groups.setdefault(tuple(sorted(nearest.tolist())))
    every = list(groups)
    keep = np.unique(np.linspace(0, len(every) - 1, min(CONSTANTS, len(every))).round().astype(int))
    return [every[i] for i in keep.tolist()]


def _triples(design: Float) -> list[tuple[int, ...]]:
    """Wide triples that use all taxels about equally often."""
    n = len(design)
    pool = np.unique(np.linspace(0, n - 1, min(n, DENSE)).round().astype(int)).tolist()
    every = list(combinations(pool, 3))
    corners = design[np.array(every)][:, :, 1:]
    one, two = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = np.abs(one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0])
    spread = area / max(float(area.max()), 1e-12)
    chosen: list[tuple[int, ...]] = []
    members = np.array(every)
    uses = np.zeros(n)
    free = spread > 0.05  # slimmer ones amplify noise more than twenty times
    for _ in range(min(TRIPLES, int(free.sum()))):
        # the least used taxels first, among them the widest triple
        merit = np.where(free, np.sqrt(spread) - uses[members].sum(axis=1), -np.inf)
        best = int(np.argmax(np.round(merit, 9)))
        chosen.append(every[best])
        uses[members[best]] += 1
        free[best] = False
    return chosen
