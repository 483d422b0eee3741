"""Contact features of one cycle from the forces on the taxels."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tactile_bus.geometry import Side, SkinGeometry
from tactile_bus.instant import Instant, seconds_between
from tactiled.blocks import Features, Patch
from tactiled.patches import Adjacency
from tactiled.pipeline_settings import PipelineSettings

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]

BRIDGED_CYCLES = 1
"""Cycles without a usable tip that a light contact survives: one lost frame is no lifted tip."""
CERTAIN_RATIO = 4 / 3
"""A taxel above this many times its threshold (6 sigma) is in contact at once; between 1 and this
it must be there in two cycles running, or noise on 80 taxels at 100 Hz would touch every second."""

_ZERO3 = np.zeros(3)
_ZERO6 = np.zeros(6)
_ZERO3.flags.writeable = False
_ZERO6.flags.writeable = False


class FeatureExtractor:
    """Features of a skin with N taxels; remembers which were in contact, and since when the tip.

    Forces are summed over taxels in contact alone: the noise of eighty idle taxels would make half
    a newton.
    """

    def __init__(self, geometry: SkinGeometry, settings: PipelineSettings) -> None:
        self._adjacency = Adjacency(geometry)
        self._position = np.concatenate([a.position for a in geometry.arrays])
        self._rotation = np.concatenate([a.rotation for a in geometry.arrays])
        self._array = np.concatenate(
            [np.full(a.taxels, i) for i, a in enumerate(geometry.arrays)]
        ).tolist()
        self._side = [a.side for a in geometry.arrays]
        self._tip = np.concatenate([np.full(a.taxels, a.side is Side.TIP) for a in geometry.arrays])
        self._light = settings.tip_light_n
        self._minimum = settings.contact_minimum_n
        self._sigmas = settings.contact_sigmas
        self._ratio = settings.release_ratio
        n = geometry.taxels
        self._on = np.full(n, self._minimum)
        self._certain = self._on * CERTAIN_RATIO
        self._off = self._on * self._ratio
        self._contact = np.zeros(n, dtype=bool)
        self._above = np.zeros(n, dtype=bool)
        self._light_since: Instant | None = None
        self._light_until: Instant | None = None
        self._unusable = 0

    @property
    def contact(self) -> Bool:
        """(N,) taxels in contact in the last cycle."""
        return self._contact

    def set_noise(self, sigma_n: Float) -> None:
        """Noise of the normal forces, (N,) N rms: contact thresholds follow."""
        self._on = np.maximum(self._minimum, self._sigmas * sigma_n)
        self._certain = self._on * CERTAIN_RATIO
        self._off = self._on * self._ratio

    def reset(self) -> None:
        """Forget every contact."""
        self._contact = np.zeros_like(self._contact)
        self._above = np.zeros_like(self._above)
        self._light_since = self._light_until = None
        self._unusable = 0

    def update(
        self,
        force: Float,
        masked: int,
        reasons: tuple[str, ...],
        valid: bool,
        tip_usable: bool,
        captured: Instant,
    ) -> Features:
        """Features of one cycle.

        ``force``: (N, 3) N in taxel axes, NaN where a taxel is masked. ``masked``: how many are.
        ``tip_usable``: whether what the tip feels counts towards its time in light contact.
        """
        normal = -force[:, 2]
        above = normal > self._on
        contact = (
            (above & self._above)
            | (normal > self._certain)
            | (self._contact & (normal > self._off))
        )
        self._above, self._contact = above, contact
        members = contact.nonzero()[0]
        tip_force = 0.0
        if members.size == 0:
            tip_time = self._tip_time(tip_force, tip_usable, captured)
            return Features(
                valid, reasons, 0.0, Side.NONE, _ZERO3, 0.0, _ZERO6, 0.0, tip_time, 0, masked
            )
        pressed = normal[members]
        position = self._position[members]
        force_ee = (self._rotation[members] @ force[members][:, :, None])[..., 0]
        tip_force = float(pressed[self._tip[members]].sum())
        wrench = np.empty(6)
        wrench[:3] = force_ee.sum(axis=0)
        wrench[3:] = _cross_sum(position, force_ee)
        peak = int(members[pressed.argmax()])
        return Features(
            valid=valid,
            reasons=reasons,
            peak_force=float(pressed.max()),
            peak_side=self._side[self._array[peak]],
            peak_position=self._peak_position(peak, normal),
            normal_force=float(pressed.sum()),
            wrench=wrench,
            tip_force=tip_force,
            tip_contact_time=self._tip_time(tip_force, tip_usable, captured),
            taxels_in_contact=len(members),
            taxels_masked=masked,
            patches=self._patches(members.tolist(), pressed, position, force_ee),
        )

    def _peak_position(self, peak: int, normal: Float) -> Float:
        """Centroid of the normal forces on the peak taxel and its neighbours in contact."""
        around = self._adjacency.neighbours[peak]
        weight = np.where(self._contact[around], normal[around], 0.0)
        place: Float = weight @ self._position[around] / weight.sum()
        return place

    def _patches(
        self, members: list[int], pressed: Float, position: Float, force_ee: Float
    ) -> tuple[Patch, ...]:
        """All patches, the strongest first."""
        row = {taxel: i for i, taxel in enumerate(members)}
        groups = self._adjacency.clusters(members)
        belongs = np.zeros((len(groups), len(members)))
        for g, group in enumerate(groups):
            belongs[g, [row[taxel] for taxel in group]] = 1.0
        table = np.empty((len(members), 7))
        table[:, 0] = pressed
        table[:, 1:4] = force_ee
        table[:, 4:7] = position * pressed[:, None]
        sums = belongs @ table
        sums[:, 4:7] /= sums[:, :1]
        peaks = (belongs * pressed).max(axis=1).tolist()
        total = sums[:, 0].tolist()
        out = []
        for g in sorted(range(len(groups)), key=lambda g: (-total[g], groups[g][0])):
            array = self._array[groups[g][0]]
            out.append(
                Patch(
                    array,
                    self._side[array],
                    len(groups[g]),
                    total[g],
                    peaks[g],
                    sums[g, 1:4],
                    sums[g, 4:7],
                )
            )
        return tuple(out)

    def _tip_time(self, tip_force: float, usable: bool, captured: Instant) -> float:
        """Seconds that the tip has been in light contact without a break, bridging a lost cycle."""
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


def _cross_sum(a: Float, b: Float) -> list[float]:
    """Sum of a × b over rows of (k, 3), without the overhead of np.cross on few rows."""
    p = a.T @ b
    return [p[1, 2] - p[2, 1], p[2, 0] - p[0, 2], p[0, 1] - p[1, 0]]
