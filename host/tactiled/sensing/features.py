"""Contact features of one cycle from the forces on the taxels."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from tactile_core.arrays import FloatArray
from tactile_core.geometry import ArrayGeometry, Side, SkinGeometry
from tactile_core.types import Instant, seconds_between
from tactiled.blocks import Features, Patch, Reason
from tactiled.sensing.settings import PipelineSettings

# Contact patches: clusters of neighbouring taxels in contact.


NEIGHBOUR_REACH = 1.6
"""Taxels are neighbours up to this many times the array's typical spacing: in a square grid,
diagonals are at 1.41 and the second row at 2."""


class Adjacency:
    """Neighbours of each taxel within its array: a patch belongs to one array and one side.

    ``masks``: for each taxel, an int whose bits are its neighbours. ``neighbours``: for each taxel,
    itself and its neighbours.
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
        """Connected groups of the taxels ``members``; each ascending, ordered by first taxel."""
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
        """Taxels around each of ``groups``, without those in a group or ``blind``; each once."""
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
    """(n, n) bool, neighbours on the unrolled skin; grids need not be square."""
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


Bool = NDArray[np.bool_]

BRIDGED_CYCLES = 1
"""Cycles without a usable tip that do not end a light contact: one lost frame is not a release."""
CERTAIN_RATIO = 4 / 3
"""A taxel above this many times its threshold (6 sigma) is in contact at once; between 1 and this,
after two cycles in a row. Otherwise noise on 80 taxels at 100 Hz would touch every second."""

SLIGHT_SIGMAS = 1.5
"""Sigma of noise above which a taxel known to be loaded is in contact."""

_ZERO3 = np.zeros(3)
_ZERO6 = np.zeros(6)
_ZERO3.flags.writeable = False
_ZERO6.flags.writeable = False


class FeatureExtractor:
    """Computes features of a skin with N taxels; remembers which were in contact.

    Forces are summed over the taxels in contact and the ring of taxels around each patch, which
    bears a tenth of a press of 4 N below the threshold of contact (its noise makes 0.1 N). Ring
    taxels that read a pull beyond that threshold are left out: it is crosstalk, and without
    calibrated coupling it would cancel half of the press (eFlesh recordings: correlation with the
    load cell 0.998 without them, 0.83 with them). Idle taxels are left out as well: the noise of
    eighty would make half a newton.
    """

    def __init__(self, geometry: SkinGeometry, settings: PipelineSettings) -> None:
        self._adjacency = Adjacency(geometry)
        position = np.concatenate([a.position for a in geometry.arrays])
        rotation = np.concatenate([a.rotation for a in geometry.arrays])
        self._position = position.tolist()
        # (N, 6, 3): maps a taxel's force in its own axes to force and moment about the origin of ee
        turned = np.cross(position[:, :, None], rotation, axis=1)
        self._lever = np.concatenate([rotation, turned], axis=1)
        self._outward = rotation[:, :, 2]  # (N, 3) unit normals of the taxels in ee
        self._place = np.concatenate([np.ones((len(position), 1)), position], axis=1)
        self._array = np.concatenate(
            [np.full(a.taxels, i) for i, a in enumerate(geometry.arrays)]
        ).tolist()
        self._side = [a.side for a in geometry.arrays]
        self._light = settings.tip_light_n
        self._minimum = settings.contact_minimum_n
        self._sigmas = settings.contact_sigmas
        self._ratio = settings.release_ratio
        n = geometry.taxels
        self._on = np.full(n, self._minimum)
        self._slight = self._on * SLIGHT_SIGMAS / self._sigmas
        self._certain = self._on * CERTAIN_RATIO
        self._off = self._on * self._ratio
        self._contact = np.zeros(n, dtype=bool)
        self._threshold = self._certain
        self._light_since: Instant | None = None
        self._light_until: Instant | None = None
        self._unusable = 0
        self.summed: list[int] = []
        """Taxels whose normal forces were summed in the last cycle."""
        self.tip_summed: list[int] = []
        """Taxels of ``summed`` at the tip."""
        self.patch_summed: list[list[int]] = []
        """Taxels of ``summed`` in each patch."""
        self.peak_taxel = 0
        """Taxel of the peak force; 0 when nothing is in contact."""

    @property
    def contact(self) -> Bool:
        """(N,) taxels in contact in the last cycle."""
        return self._contact

    @property
    def least_n(self) -> FloatArray:
        """Least normal force of a taxel in contact, (N,) N."""
        return self._on

    def set_noise(self, sigma_n: FloatArray) -> None:
        """Set the contact thresholds from the noise of the normal forces, (N,) N rms."""
        self._on = np.maximum(self._minimum, self._sigmas * sigma_n)
        self._slight = SLIGHT_SIGMAS * sigma_n
        self._certain = self._on * CERTAIN_RATIO
        self._off = self._on * self._ratio
        self._threshold = np.where(self._contact, self._off, self._certain)

    def reset(self) -> None:
        """Forget every contact."""
        self._contact = np.zeros_like(self._contact)
        self._threshold = self._certain
        self._light_since = self._light_until = None
        self._unusable = 0

    def update(
        self,
        force: FloatArray,
        masked: int,
        reasons: tuple[Reason, ...],
        valid: bool,
        tip_usable: bool,
        captured: Instant,
        loaded: Bool | None = None,
    ) -> Features:
        """Features of one cycle.

        ``force``: (N, 3) N in taxel axes, NaN where a taxel is masked. ``masked``: how many are.
        ``tip_usable``: whether the tip's force counts towards its time in light contact.
        ``loaded``: (N,) taxels known to bear a load; they are in contact from a smaller force on.
        """
        normal = -force[:, 2]
        above = normal > self._on
        contact = normal > self._threshold
        if loaded is not None and np.count_nonzero(loaded):
            contact |= loaded & (normal > self._slight)
        members = contact.nonzero()[0]
        self._contact = contact
        if np.count_nonzero(above) or members.size:
            self._threshold = np.where(contact, self._off, np.where(above, self._on, self._certain))
        else:
            self._threshold = self._certain
        if members.size == 0:
            self.summed, self.tip_summed, self.patch_summed, self.peak_taxel = [], [], [], 0
            tip_time = self._tip_time(0.0, tip_usable, captured)
            return Features(
                valid, reasons, 0.0, Side.NONE, _ZERO3, 0.0, _ZERO6, 0.0, tip_time, 0, masked
            )
        taxels = members.tolist()
        groups = self._adjacency.clusters(taxels)
        # left out of the rings: masked taxels, and pulled ones, which is crosstalk
        blind = (~(normal > -self._on)).nonzero()[0].tolist()
        rings = self._adjacency.rings(groups, blind)
        involved = taxels + [taxel for ring in rings for taxel in ring]
        row = {taxel: i for i, taxel in enumerate(involved)}
        presses = normal[members].tolist()
        core = np.zeros((len(groups), len(involved)))
        for g, group in enumerate(groups):
            core[g, [row[taxel] for taxel in group]] = 1.0
        bearing = core.copy()
        for g, ring in enumerate(rings):
            bearing[g, [row[taxel] for taxel in ring]] = 1.0
        # columns: fx, fy, fz, mx, my, mz about the origin of ee, then the normal force's moments
        table = np.empty((len(involved), 10))
        table[:, :6] = (self._lever[involved] * force[involved, None]).sum(axis=2)
        table[:, 6:] = self._place[involved] * normal[involved, None]
        sums = bearing @ table
        total = sums.sum(axis=0)
        # Positions are weighted over the core alone: noise in the ring would have a long lever.
        weights = core @ table[:, 6:]
        centroids = weights[:, 1:] / weights[:, :1]
        normals = core @ (self._outward[involved] * normal[involved, None])
        patches_summed = []
        for g, (group, normal_force) in enumerate(zip(groups, sums[:, 6].tolist(), strict=True)):
            array = self._array[group[0]]
            length = math.sqrt(float(normals[g] @ normals[g]))
            found = (
                Patch(
                    array=array,
                    side=self._side[array],
                    taxels=len(group),
                    normal_force=normal_force,
                    peak_force=max(presses[row[taxel]] for taxel in group),
                    force=sums[g, :3],
                    centroid=centroids[g],
                    normal=normals[g] / length if length > 0.0 else self._outward[group[0]],
                ),
                group + rings[g],
            )
            patches_summed.append(found)
        patches_summed.sort(key=lambda found: -found[0].normal_force)  # stable: then by first taxel
        patches = [patch for patch, _ in patches_summed]
        self.patch_summed = [summed for _, summed in patches_summed]
        tip_force = sum((p.normal_force for p in patches if p.side is Side.TIP), 0.0)
        peak_force = max(presses)
        peak = taxels[presses.index(peak_force)]
        self.summed, self.peak_taxel = involved, peak
        self.tip_summed = [t for t in involved if self._side[self._array[t]] is Side.TIP]
        return Features(
            valid=valid,
            reasons=reasons,
            peak_force=peak_force,
            peak_side=self._side[self._array[peak]],
            peak_position=self._peak_position(peak, row, presses),
            normal_force=float(total[6]),
            wrench=total[:6],
            tip_force=tip_force,
            tip_contact_time=self._tip_time(tip_force, tip_usable, captured),
            taxels_in_contact=len(taxels),
            taxels_masked=masked,
            patches=tuple(patches),
        )

    def _peak_position(self, peak: int, row: dict[int, int], presses: list[float]) -> FloatArray:
        """Centroid, (3,) m in ``ee``, of the normal forces on the peak taxel and its neighbours in
        contact."""
        touching = len(presses)  # rows from this one on belong to the rings
        around = [t for t in self._adjacency.neighbours[peak] if row.get(t, touching) < touching]
        weights = [presses[row[taxel]] for taxel in around]
        share = 1.0 / sum(weights)
        places = [self._position[taxel] for taxel in around]
        return np.array(
            [share * sum(w * p[c] for w, p in zip(weights, places, strict=True)) for c in range(3)]
        )

    def _tip_time(self, tip_force: float, usable: bool, captured: Instant) -> float:
        """Seconds of uninterrupted light contact of the tip, bridging a lost cycle."""
        if not usable:
            self._unusable += 1
            if self._unusable > BRIDGED_CYCLES:
                self._light_since = self._light_until = None
        else:
            self._unusable = 0
            if self._light[0] <= tip_force <= self._light[1]:
                if self._light_since is None:
                    self._light_since = captured
                self._light_until = captured
            else:
                self._light_since = self._light_until = None
        if self._light_since is None or self._light_until is None:
            return 0.0
        return seconds_between(self._light_since, self._light_until)
