"""Taring: what the untouched, unmoving skin reads becomes its rest field."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tactile_bus.instant import Instant, seconds_between

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]

MIN_CYCLES = 8
"""Fewest cycles of a tare: the mean then has a third of one sample's noise, and the spread of the
samples says what that noise is."""
MAX_WAIT_RATIO = 10.0
"""A tare that has not got its cycles after this many times its length is refused,"""
MAX_WAIT_CYCLES = 4 * MIN_CYCLES
"""but not before so many came, whole or not: a slow board takes longer for them."""
STILL_SIGMAS = 6.0
"""First and second half may differ by this many standard errors before the skin counts as moving:
with 240 channels chance alone gives 4."""
STILL_FLOOR_UT = 2.0
"""µT that the halves may differ in any case: two LSB and slow temperature drift."""
NOISY_RATIO = 4.0
"""Spread of a channel beyond this many times the expected noise is motion, not noise."""


@dataclass(frozen=True, slots=True, eq=False)
class TareReport:
    """What a tare did, or why it was refused.

    ``shift_ut``: largest change of a rest field, µT. ``noise_ut``: (3,) µT rms measured.
    """

    accepted: bool
    message: str
    cycles: int
    shift_ut: float
    noise_ut: Float
    sequence: int


class Tare:
    """Sums of the cycles of one tare; constant memory. ``expected``: (3,) µT rms of one sample."""

    def __init__(self, shape: tuple[int, ...], seconds: float, noise_ut: Float) -> None:
        self._seconds = seconds
        self.expected = noise_ut
        self._start: Instant | None = None
        self._sums = np.zeros((2, *shape))
        self._squares = np.zeros(shape)
        self._pivot = np.zeros(shape)  # the first cycle: sums of differences keep their digits
        self._counts = [0, 0]
        self._offered = 0
        self._healthy = np.ones((shape[0], shape[2]), dtype=bool)

    def again(self) -> Tare:
        """A fresh tare of the same kind."""
        return Tare(self._squares.shape, self._seconds, self.expected)

    @property
    def cycles(self) -> int:
        """Cycles taken so far."""
        return sum(self._counts)

    @property
    def mean(self) -> Float:
        """(A, 3, n) µT, mean of the cycles taken, at least one."""
        mean: Float = self._pivot + self._sums.sum(axis=0) / self.cycles
        return mean

    @property
    def healthy(self) -> Bool:
        """(A, n) taxels that were healthy in every cycle taken."""
        return self._healthy

    def add(self, field: Float, healthy: Bool, whole: bool, captured: Instant) -> bool:
        """Take one cycle, unless an array was missing from it; True when the tare is over."""
        if self._start is None:
            self._start = captured
        elapsed = seconds_between(self._start, captured)
        self._offered += 1
        if whole:
            if not self.cycles:
                self._pivot = field.copy()
            half = int(elapsed >= self._seconds / 2 and self._counts[0] >= MIN_CYCLES // 2)
            away = field - self._pivot
            self._sums[half] += away
            self._squares += away * away
            self._counts[half] += 1
            self._healthy &= healthy
        enough = elapsed >= self._seconds and min(self._counts) >= MIN_CYCLES // 2
        waited = elapsed >= self._seconds * MAX_WAIT_RATIO and self._offered >= MAX_WAIT_CYCLES
        return enough or waited

    def trouble(self) -> str | None:
        """Why the cycles taken cannot be a rest field; None when they can."""
        if min(self._counts) < MIN_CYCLES // 2:
            return f"only {self.cycles} whole cycles came"
        if not self._healthy.any():
            return "no taxel was healthy throughout"
        spread = self._spread().swapaxes(1, 2)[self._healthy]
        drift = np.abs(self._sums[1] / self._counts[1] - self._sums[0] / self._counts[0])
        error = self.expected * np.sqrt(1 / self._counts[0] + 1 / self._counts[1])
        allowed = np.maximum(STILL_SIGMAS * error, STILL_FLOOR_UT)
        moved = drift.swapaxes(1, 2)[self._healthy]
        if (moved > allowed).any():
            return f"the field moved by {moved.max():.1f} µT during the tare: keep the skin still"
        if (spread > NOISY_RATIO * self.expected).any():
            return f"the field varied by {spread.max():.1f} µT rms: keep the skin still, untouched"
        return None

    def noise(self) -> Float:
        """(3,) µT rms of one sample in x, y, z: median over taxels healthy throughout."""
        noise: Float = np.median(self._spread().swapaxes(1, 2)[self._healthy], axis=0)
        return noise

    def _spread(self) -> Float:
        total = self._sums.sum(axis=0)
        variance = (self._squares - total * total / self.cycles) / (self.cycles - 1)
        spread: Float = np.sqrt(np.maximum(variance, 0.0))
        return spread
