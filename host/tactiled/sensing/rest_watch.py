"""Whether the rest field is still what it was: changes that no contact makes.

Each cycle is held against the signatures of a skin that was lifted or exchanged, a magnet that was
lost, a chip whose gain was changed, and a field that leapt on all taxels at once. What is found
makes the rest field *suspect*; where the field comes back to what it was, the suspicion is dropped.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from tactile_bus.instant import Instant, seconds_between
from tactiled.blocks import Reason
from tactiled.sensing import reasons as why
from tactiled.sensing.candidates import PLANE_TAXELS
from tactiled.sensing.compensate import Estimate
from tactiled.sensing.force_model import ForceModel
from tactiled.sensing.layout import Layout

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]

BARE_UT = 130.0
"""µT, most that a chip without a magnet reads: the earth's 65, and as much of what is near."""
MAGNET_UT = 400.0
"""µT of rest field above which there is a magnet over a chip."""
BARE_SHARE = 0.6
"""Share of the chips that must be bare for the skin to be off."""
LOST_AFTER_S = 0.3
"""s that a single chip must be bare: a press may carry its field through zero."""
AT_ONCE = 0.6
"""Share of its rest field by which a chip must change within `SCRAMBLE_S`: its magnet is gone."""
GONE_SHARE = 0.3
"""Share of its rest field that a chip without its magnet reads at most: its neighbours' magnets add
a tenth."""
EARTH_UT = 150.0
"""µT beyond which the ambient field has not been turned: the earth's 65 turned round, and noise."""
GAIN_STEP = 0.12
"""Least relative change of all fields together that is a change of gain: the finest step of an
MLX90393 is 20 %."""
GAIN_MISFIT = 0.1
"""Share of such a change that may be left over."""
SCRAMBLE_UT = 100.0
"""µT by which every chip of a small array must change at once for its skin to have moved."""
SCRAMBLE_S = 0.06
"""s within which that is at once."""
SCRAMBLE_PULL = 0.4
"""Share of the greatest press that a taxel must then be pulled by: a contact presses."""
SCRAMBLE_N = 0.5
BACK_N = 0.3
"""N per taxel within which a field that comes back is what it was."""


class RestWatch:
    """The signatures, for one board; memory of one cycle and a few numbers."""

    def __init__(self, layout: Layout, model: ForceModel, names: Sequence[str]) -> None:
        self._layout, self._model, self._names = layout, model, names
        self._small = layout.counts < PLANE_TAXELS
        self._last: tuple[Instant, Float] | None = None
        self._bare_since = np.full(layout.real.shape, -1, np.int64)
        self._gone = np.zeros_like(layout.real)
        self.off = False
        """Whether there is no skin on the board now: nothing to take a rest field of."""

    def reset(self) -> None:
        """The stream or the rest field began anew."""
        self._last = None
        self._bare_since[:] = -1

    def regained(self, field: Float, bare: Bool) -> Reason | None:
        """A magnet over one of the taxels ``bare`` (A, n) that had none: the skin was changed."""
        reading = np.linalg.norm(field + self._model.rest, axis=1)
        least = np.maximum(MAGNET_UT, 2.0 * np.linalg.norm(self._model.rest, axis=1))
        if not (bare & (reading > least)).any():
            return None
        return why.field_jump(float(reading[bare].max()))

    def judge(
        self, field: Float, forces: Float, estimate: Estimate, healthy: Bool, captured: Instant
    ) -> Reason | None:
        """What speaks against the rest field in this cycle; None when nothing does.

        ``field``: (A, 3, n) µT in taxel axes over rest, ambient and all. ``forces``: (A, 3, n) N
        after compensation. ``healthy``: (A, n).
        """
        last, self._last = self._last, (captured, field.copy())
        self.off = False
        return (
            self._bare(field, healthy, captured, last)
            or self._leapt(estimate)
            or self._gain(field, healthy)
            or self._scrambled(field, forces, healthy, captured, last)
        )

    def restored(self, forces: Float, estimate: Estimate, healthy: Bool) -> bool:
        """Whether the skin reads again what it read at rest: nothing bears a force."""
        if estimate.leap.any() or (np.abs(estimate.theta[:, :, 0]) > EARTH_UT).any():
            return False
        free = (np.abs(forces).max(axis=1) < BACK_N) & healthy
        return bool((free | ~healthy).all())

    def _bare(
        self, field: Float, healthy: Bool, captured: Instant, last: tuple[Instant, Float] | None
    ) -> Reason | None:
        rest = self._model.rest
        magnet = (rest**2).sum(axis=1) > MAGNET_UT**2
        reading = ((field + rest) ** 2).sum(axis=1)
        strong = np.linalg.norm(rest, axis=1)
        fallen = self._fallen(field, reading, strong, healthy & magnet, captured, last)
        bare = healthy & magnet & (reading < BARE_UT**2)
        if not (bare.any() or fallen.any()):
            self._bare_since[:] = -1
            return None
        begun = bare & (self._bare_since < 0)
        self._bare_since[begun] = captured
        self._bare_since[~bare] = -1
        chips = healthy & magnet
        for a in range(len(bare)):
            if chips[a].sum() >= 3 and bare[a].sum() >= BARE_SHARE * chips[a].sum():
                self.off = True
                return why.skin_off(self._names[a])
        for a, i in np.argwhere(bare & (strong > 2 * MAGNET_UT)).tolist():
            since = Instant(int(self._bare_since[a, i]))
            fallen[a, i] |= seconds_between(since, captured) >= LOST_AFTER_S
        if not fallen.any():
            return None
        self._gone |= fallen
        a, i = np.argwhere(fallen)[0].tolist()
        return why.magnet_lost(self._names[a], i)

    def _fallen(
        self,
        field: Float,
        reading: Float,
        strong: Float,
        chips: Bool,
        captured: Instant,
        last: tuple[Instant, Float] | None,
    ) -> Bool:
        """(A, n) chips that have lost most of their field at once, as no press makes it."""
        if last is None or seconds_between(last[0], captured) > SCRAMBLE_S:
            return np.zeros_like(chips)
        step = np.linalg.norm(field - last[1], axis=1)
        low = reading < (GONE_SHARE * strong) ** 2
        return np.asarray(chips & low & (strong > 2 * MAGNET_UT) & (step > AT_ONCE * strong))

    def lost(self, before: Float) -> Bool:
        """(A, n) taxels whose magnet is gone, by the rest field ``before`` (A, 3, n) and now."""
        magnet = (before**2).sum(axis=1) > MAGNET_UT**2
        low = (self._model.rest**2).sum(axis=1) < BARE_UT**2
        gone, self._gone = self._gone, np.zeros_like(self._gone)
        return np.asarray(magnet & (low | gone))

    def covered(self) -> Bool:
        """(A, n) taxels whose rest field in force has a magnet's size."""
        return np.asarray((self._model.rest**2).sum(axis=1) > 4 * MAGNET_UT**2)

    def _leapt(self, estimate: Estimate) -> Reason | None:
        size = float(estimate.leap.max())
        if size == 0.0:
            sizes = np.linalg.norm(estimate.theta[:, :, 0], axis=1) * estimate.ambient.valid
            size = float(sizes.max())
            if size <= EARTH_UT:
                return None
        return why.field_jump(size)

    def _gain(self, field: Float, healthy: Bool) -> Reason | None:
        rest = self._model.rest
        use = healthy[:, None] & np.ones_like(rest, dtype=bool)
        there = float((rest[use] ** 2).sum())
        if there == 0.0 or there < healthy.sum() * MAGNET_UT**2:
            return None
        gain = float((rest[use] * field[use]).sum()) / there
        if abs(gain) < GAIN_STEP:
            return None
        left = np.where(use, field - gain * rest, 0.0)
        change = np.where(use, gain * rest, 0.0)
        limit = (GAIN_MISFIT * np.linalg.norm(change, axis=1) + 30.0) * healthy
        if (np.linalg.norm(left, axis=1) * healthy > limit).any():
            return None
        return why.gain_changed(1.0 + gain)

    def _scrambled(
        self,
        field: Float,
        forces: Float,
        healthy: Bool,
        captured: Instant,
        last: tuple[Instant, Float] | None,
    ) -> Reason | None:
        if last is None or seconds_between(last[0], captured) > SCRAMBLE_S:
            return None
        moved = np.linalg.norm(field - last[1], axis=1)
        for a in np.flatnonzero(self._small).tolist():
            use = healthy[a]
            if use.sum() < 3 or (moved[a][use] < SCRAMBLE_UT).any():
                continue
            normal = -forces[a, 2][use]
            pull, press = -float(normal.min()), float(normal.max())
            if pull > SCRAMBLE_N and pull > SCRAMBLE_PULL * press:
                return why.field_jump(float(np.median(moved[a][use])))
        return None
