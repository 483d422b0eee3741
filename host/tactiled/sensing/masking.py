"""Whether what is left of an array says enough once some of its taxels are masked.

A masked taxel under a contact hides it, one beside a contact hides part of it. On an array of
sixteen and more that matters where the contact is: where the taxel was in contact when it went, or
has a neighbour that is. On a board of a few chips every contact is felt by all (the one that
feels it most but one by 28 % and more in eFlesh recordings), and each bears a large share of it:
there anything that is felt anywhere makes the array's forces unknown, and so does a chip that went
because its field left its range.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tactile_bus.geometry import SkinGeometry
from tactiled.blocks import Reason
from tactiled.sensing import reasons as why
from tactiled.sensing.candidates import PLANE_TAXELS
from tactiled.sensing.patches import Adjacency
from tactiled.sensing.readings import Fault

Bool = NDArray[np.bool_]
UInt8 = NDArray[np.uint8]

_LEFT_RANGE = np.array(
    [Fault.SATURATED, Fault.RAIL, Fault.WRAPPED, Fault.JUMPED, Fault.BEYOND_RANGE], np.uint8
)
"""Faults that a strong field may be behind."""


class Masking:
    """Remembers which taxels went while in contact. N taxels, one array after another."""

    def __init__(self, geometry: SkinGeometry) -> None:
        self._names = tuple(a.name for a in geometry.arrays)
        self._slices = geometry.slices
        self._small = tuple(a.taxels < PLANE_TAXELS for a in geometry.arrays)
        self._neighbours = Adjacency(geometry).neighbours
        self.reset()

    def reset(self) -> None:
        """A tare or a new beginning: nothing is in contact."""
        taxels = self._slices[-1].stop
        self._sick = False
        self._masked = np.zeros(taxels, bool)
        self._hidden = np.zeros(taxels, bool)
        self.touched = np.zeros(taxels, bool)
        """(N,) taxels in contact in the last cycle; for the owner to set."""

    def well(self, touched: Bool) -> None:
        """No taxel was masked in a cycle in which (N,) taxels were in contact."""
        self.touched = touched
        if self._sick:
            self._sick = False
            self._masked = np.zeros_like(self._masked)
            self._hidden = self._masked

    def judge(self, fault: UInt8, felt: Bool) -> tuple[list[Reason], bool]:
        """Reasons for which the forces of one cycle are incomplete, and whether too much so.

        ``fault``: (N,) of `Fault`. ``felt``: (N,) healthy taxels that something presses or pulls.
        """
        self._sick = True
        masked = fault != 0
        self._hidden = masked & (self._hidden | (self.touched & ~self._masked))
        self._masked = masked
        reasons: list[Reason] = []
        enough = True
        for name, part, small in zip(self._names, self._slices, self._small, strict=True):
            gone = np.flatnonzero(masked[part])
            if not 0 < len(gone) < part.stop - part.start:
                continue  # of an array that is gone altogether others tell
            if small:
                bad = self._hidden[part] | np.isin(fault[part], _LEFT_RANGE)
                if felt[part].any():
                    bad = masked[part]
                first = int(gone[0])
                reasons.append(why.chip_masked(name, first, Fault(int(fault[part][first]))))
            else:
                bad = self._hidden[part].copy()
                for taxel in gone.tolist():
                    around = self._neighbours[part.start + taxel]
                    bad[taxel] |= any(felt[one] for one in around)
            if bad.any():
                reasons.append(why.masked_contact(name, np.flatnonzero(bad).tolist()))
                enough = False
        return reasons, enough
