"""The chips' thermometers: what they cannot say, and when they have stopped."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tactile_bus.instant import NS_PER_S, Instant

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]

LIMITS_C = (-45.0, 130.0)
"""A magnetometer outside its datasheet's −40 to 125 °C (and some tolerance) did not answer."""
_MIDDLE_C = sum(LIMITS_C) / 2
_HALF_RANGE_C = (LIMITS_C[1] - LIMITS_C[0]) / 2
STEP_C = 15.0
"""K from one reading to the next that no chip warms by, at the rates that boards have."""
SETTLED_S = 1.0
"""A temperature that goes on from where it jumped for so long is taken: a firmware that does not
read it any more, say."""
MOVED_C = 5.0
"""K that the other chips must have gone since a chip's thermometer last changed before it counts
as stuck: all are warmed by the same room, board and hand."""
FEWEST = 3
"""Chips of an array whose thermometers can be compared."""
ROOM_C = 25.0
"""°C taken where a chip has never told one."""


class Thermometers:
    """Memory of each chip's last good temperature.

    ``stuck``: (A, n) bool, None where none is. ``uneasy``: one has jumped just now.
    """

    def __init__(self, real: Bool) -> None:
        self._real = real
        self.reset()

    def reset(self) -> None:
        """Forget every temperature."""
        shape = self._real.shape
        self.last: Float = np.full(shape, np.nan)
        """(A, n) °C of the last cycle."""
        self._good = np.full(shape, np.nan)
        self._since = np.zeros(shape, np.int64)
        self._changed_at = np.full(shape, np.nan)
        self._middle_then = np.full(shape, np.nan)
        self.stuck: Bool | None = None
        self.uneasy = False

    def plain(self, temperature_c: Float) -> bool:
        """Whether (A, n) °C need no closer look: near those of the cycle before."""
        return float(np.abs(temperature_c - self.last).max()) < STEP_C

    def accept(self, temperature_c: Float) -> None:
        """Take (A, n) °C that need no closer look."""
        self._good = temperature_c

    def check(self, temperature_c: Float, read: Bool, captured: Instant) -> tuple[Bool, Bool]:
        """(A, n) temperatures that are impossible, and that jumped; the former are replaced.

        ``read``: (A, n) chips that were read; what others show is not kept.
        """
        impossible: Bool = ~(np.abs(temperature_c - _MIDDLE_C) <= _HALF_RANGE_C)
        if np.count_nonzero(impossible):
            np.copyto(temperature_c, np.nan_to_num(self._good, nan=ROOM_C), where=impossible)
        # a buffer that no reading has ever filled shows naught
        jumped: Bool = (np.abs(temperature_c - self._good) > STEP_C) & (self._good != 0.0)
        if np.count_nonzero(jumped):
            on = jumped & (np.abs(temperature_c - self.last) <= STEP_C)
            self._since[jumped & ~on] = captured
            jumped = jumped & ~(on & (captured - self._since >= SETTLED_S * NS_PER_S))
        self._good = np.where(read & ~(impossible | jumped), temperature_c, self._good)
        self.uneasy = bool(np.count_nonzero(jumped))
        return impossible, jumped

    def judge(self, alive: Bool) -> None:
        """Find those that stand still while their array goes on; ``alive``: chips with noise."""
        self.stuck = None
        now = self._good
        if self._real.shape[1] < FEWEST:
            return
        middle = np.median(now, axis=1, keepdims=True)
        changed = now != self._changed_at
        np.copyto(self._middle_then, np.broadcast_to(middle, now.shape), where=changed)
        np.copyto(self._changed_at, now, where=changed)
        stuck = (np.abs(middle - self._middle_then) > MOVED_C) & self._real & alive
        if np.count_nonzero(stuck):
            self.stuck = stuck
