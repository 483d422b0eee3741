"""Which taxels may be trusted in a cycle, and why the others may not."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tactile_bus.instant import NS_PER_S, Instant
from tactiled.blocks import TaxelHealth
from tactiled.sensing.layout import Layout

Float = NDArray[np.float64]
UInt8 = NDArray[np.uint8]

_FROZEN = np.uint8(TaxelHealth.FROZEN)
_MISSING = np.uint8(TaxelHealth.MISSING)
_OUT_OF_RANGE = np.uint8(TaxelHealth.OUT_OF_RANGE)

FROZEN_CYCLES = 3
"""Unchanged readings in a row before a taxel can be frozen, so that at low rates two equal
readings by chance do not condemn it (three 12-bit noisy components repeat once in 10^3)."""
TEMPERATURE_LIMITS_C = (-45.0, 130.0)
"""A magnetometer outside its datasheet's −40 to 125 °C (and some tolerance) did not answer."""
_MIDDLE_C = sum(TEMPERATURE_LIMITS_C) / 2
_HALF_RANGE_C = (TEMPERATURE_LIMITS_C[1] - TEMPERATURE_LIMITS_C[0]) / 2


class HealthMonitor:
    """Per-taxel health of a board; memory of one reading and two numbers a taxel."""

    def __init__(self, layout: Layout, frozen_after_s: float | None, range_limit_ut: float) -> None:
        shape = (layout.arrays, layout.width)
        self._frozen_after = None if frozen_after_s is None else round(frozen_after_s * NS_PER_S)
        self._limit = range_limit_ut
        self._last = np.full((layout.arrays, 3, layout.width), np.nan)
        self._padding = ~layout.real
        self._since = np.zeros(shape, dtype=np.int64)
        self._repeats = np.zeros(shape, dtype=np.int64)

    def update(
        self,
        raw: Float,
        temperature_c: Float,
        status: UInt8,
        present: NDArray[np.bool_],
        captured: Instant,
    ) -> UInt8:
        """(A, n) uint8 of `TaxelHealth` for one cycle.

        ``raw``: (A, 3, n) µT in chip axes. ``temperature_c``: (A, n). ``status``: (A, n), what the
        board said. ``present``: (A,) whether the array's block came at all.
        """
        health = status.copy()
        possible = np.abs(raw).max(axis=1) <= self._limit  # False for NaN too
        possible &= np.abs(temperature_c - _MIDDLE_C) <= _HALF_RANGE_C
        if np.count_nonzero(possible) < possible.size:
            health[~possible] |= _OUT_OF_RANGE
        changed = (raw != self._last).any(axis=1)
        changed |= self._padding
        if np.count_nonzero(changed) == changed.size and np.count_nonzero(present) == len(present):
            self._last = raw
            self._since.fill(captured)
            self._repeats.fill(0)
            return health
        if not present.all():
            changed &= present[:, None]  # an array that did not come neither froze nor moved
            health[~present] = _MISSING
            self._last[present] = raw[present]
            self._repeats[present] += 1
        else:
            self._last = raw
            self._repeats += 1
        self._repeats[changed] = 0
        self._since[changed] = captured
        if self._frozen_after is not None:
            frozen = (captured - self._since) >= self._frozen_after
            frozen &= self._repeats >= FROZEN_CYCLES
            if frozen.any():
                health[frozen & present[:, None]] |= _FROZEN
        return health

    def reset(self) -> None:
        """Forget what was read before."""
        self._last = np.full(self._last.shape, np.nan)
        self._since[:] = 0
        self._repeats[:] = 0
