"""What befalls a whole skin: lifted off, exchanged, a magnet lost, gain changed, a magnet near."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sim_device.chips import COUNT_MAX, Reading
from sim_device.environment import Surroundings
from sim_device.faults import ALL_TAXELS, FaultPlan, TaxelFaultKind
from sim_device.skin import SkinModel

Float = NDArray[np.float64]

OTHER_SKIN = 0.2
"""Largest relative difference of another skin's magnets from this one's."""
LEAP_DIRECTION = np.array([0.6, -0.4, 0.693])
"""Unit vector in world axes of a field that leaps."""


class SkinChanges:
    """Applies the changes of ``plan`` to ``skin`` and to what it reads.

    ``taxels``: how many each array has, by its name. ValueError for magnets that are not there.
    """

    def __init__(self, plan: FaultPlan, skin: SkinModel, taxels: Mapping[str, int]) -> None:
        self._plan, self._skin = plan, skin
        n = skin.geometry.taxels
        first, starts = 0, {}
        for name, count in taxels.items():
            starts[name] = (first, count)
            first += count
        self._loose = []
        for fault in plan.taxels:
            if fault.kind is not TaxelFaultKind.LOOSE:
                continue
            start, count = starts.get(fault.array, (0, 0))
            chosen = range(count) if fault.taxel == ALL_TAXELS else (fault.taxel,)
            if not all(0 <= taxel < count for taxel in chosen):
                raise ValueError(f"there is no taxel {fault.array}:{fault.taxel}")
            self._loose.append((fault.window, [start + taxel for taxel in chosen]))
        rng = np.random.default_rng([plan.seed, 11])
        self._other = 1.0 + rng.uniform(-OTHER_SKIN, OTHER_SKIN, n)
        self._scale = np.ones(n)

    def surround(self, seconds: float, surroundings: Surroundings) -> Surroundings:
        """Surroundings at ``seconds`` after power-on; the skin's magnets are what they then are."""
        plan = self._plan
        scale = np.ones(len(self._scale))
        if any(window.covers(seconds) for window in plan.newskin):
            scale = self._other.copy()
        for window, magnets in self._loose:
            if window.covers(seconds):
                scale[magnets] = 0.0
        if any(window.covers(seconds) for window in plan.skinoff):
            scale[:] = 0.0
        if not np.array_equal(scale, self._scale):
            self._scale = scale
            self._skin.magnets.scale(scale)
        leap = sum(size for size, window in plan.leap if window.covers(seconds))
        if not leap:
            return surroundings
        field = surroundings.world_field_ut + leap * LEAP_DIRECTION
        return replace(surroundings, world_field_ut=field)

    def amplify(self, seconds: float, reading: Reading) -> Reading:
        """The reading with the gain that its chips have at ``seconds``."""
        gain = 1.0
        for factor, window in self._plan.gain:
            gain *= factor if window.covers(seconds) else 1.0
        if gain == 1.0:
            return reading
        counts = np.clip(np.round(reading.counts * gain), -COUNT_MAX - 1, COUNT_MAX)
        return replace(reading, counts=counts.astype(np.int16))
