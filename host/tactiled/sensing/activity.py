"""How much each chip's reading varies: a dead chip is given away by having too little noise.

Over blocks of a quarter of a second the smallest and largest reading of every component are kept.
A live chip spans three to five sigma of its noise in a block; one that is dead but for a last bit
that toggles spans a count.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tactile_bus.instant import NS_PER_S, Instant

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]

BLOCK_S = 0.25
BLOCK_CYCLES = 16
"""A block lasts at least this long and has at least so many cycles."""
LEARNT_BLOCKS = 4
"""Blocks of its own after which a chip's least span is known."""
DEAD_RATIO = 12.0
"""A span this many times smaller than a live one is dead. Noise alone varies the span of sixteen
samples by a factor of two."""
MUTE_RATIO = 16.0
"""The same where the other chips have gone just as still: a motion that ends does that too."""
STEPS = 6.0
"""Counts that a live axis spans at least, if one that repeats a value is to be called stuck: noise
below half a count makes axes of coarse chips repeat for seconds."""


class Activity:
    """Spans of a board's chips; memory of two readings and a few numbers a taxel."""

    def __init__(self, shape: tuple[int, int, int], real: Bool) -> None:
        self._real = real
        self._shape = shape
        middle = real.sum(axis=1) // 2
        self._middle = np.broadcast_to(middle[:, None, None], (shape[0], 3, 1))
        self.reset()

    def reset(self) -> None:
        """Forget all that was seen."""
        arrays, _, width = self._shape
        self.least = np.full(self._shape, np.inf)
        """(A, 3, n) µT, smallest span of a block in which the chip was alive."""
        self.dead: Bool = np.zeros((arrays, width), bool)
        self.stuck: Bool = np.zeros((arrays, width), bool)
        self._blocks = np.zeros((arrays, width), np.int64)
        self._low = np.full(self._shape, np.inf)
        self._high = np.full(self._shape, -np.inf)
        self._start: Instant | None = None
        self._cycles = 0

    def add(self, raw: Float, captured: Instant) -> bool:
        """Take finite (A, 3, n) µT of one cycle; True when it ended a block, see `judge`."""
        np.minimum(self._low, raw, out=self._low)
        np.maximum(self._high, raw, out=self._high)
        self._cycles += 1
        if self._start is None or captured < self._start:
            self._start = captured
        return self._cycles >= BLOCK_CYCLES and captured - self._start >= BLOCK_S * NS_PER_S

    def forgive(self, moved: Bool) -> None:
        """Chips of (A, n) ``moved`` by more than the last bits: they are alive."""
        self.dead &= ~moved
        self.stuck &= ~moved

    def judge(self, steps: Float) -> None:
        """End a block: find who is ``dead`` or has an axis ``stuck``.

        ``steps``: (A, 3, 1) µT a count, NaN where it is not known.
        """
        span = self._high - self._low
        self._low = np.full(self._shape, np.inf)
        self._high = np.full(self._shape, -np.inf)
        self._start, self._cycles = None, 0
        own = np.where((self._blocks >= LEARNT_BLOCKS)[:, None], self.least, np.inf)
        shown = np.where(self._real[:, None], span, np.inf)
        usual = np.take_along_axis(np.sort(shown, axis=2), self._middle, axis=2)
        # Quieter than it ever was, and than the others are just now; or, where many have died at
        # once, so quiet that no more than a bit toggles.
        mute = (span * DEAD_RATIO <= own).all(axis=1)
        beside = (span * DEAD_RATIO <= usual).all(axis=1) & (usual > 0).all(axis=1)
        known = np.isfinite(own).all(axis=1)
        bit = (span <= 1.01 * steps).all(axis=1) | (span * MUTE_RATIO <= own).all(axis=1)
        still = (span == 0).all(axis=1)  # that is frozen, which the monitor times by itself
        dead = np.where(known, mute & (beside | bit), beside) & self._real & ~still
        axis = (span == 0) & np.isfinite(own) & (own >= STEPS * steps)
        self.stuck = axis.any(axis=1) & ~still & self._real
        self.dead = dead
        alive = self._real & ~dead & ~self.stuck & ~still
        self._blocks[alive] += 1
        self.least = np.where(alive[:, None], np.minimum(self.least, span), self.least)
