"""Jumps from one reading to the next: 16-bit wraps, undone where that is certain, and faults."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tactile_bus.instant import NS_PER_S, Instant
from tactiled.sensing.scale import Scales

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]

WRAP_RATIO = 1 / 6
"""Share of the counts' range that may be left of a jump of a whole range: a wrap for certain."""
SETTLED_S = 0.5
SETTLED_CYCLES = 5
"""A chip that jumped and then goes on from there so long has a new level; its rest is unknown."""
REST_UT = 1000.0
"""A reading that comes back to within this of the rest field after a jump is at rest, but for the
creep of the rubber: 89 to 178 µT after 3.9 mT in eFlesh recordings."""

ALONE_UT = 1500.0
"""Jump of one chip that another must feel on a board of a few chips: the one that feels it most
moves by 28 % and more in eFlesh recordings."""
ALONE_RATIO = 0.02
"""Share of it, besides noise, that counts as not moved: a dipole 10 mm away feels 0.8 to 3.5 % at
the usual gaps, and rubber passes on more."""
ALONE_CHIPS = (3, 8)
"""Numbers of chips of an array that all feel every contact."""
ALONE_CYCLES = 2
"""Readings in which such a chip is not believed; one that stays where it went has been hit at the
very edge of the skin."""
ALONE_S = 0.05
"""Seconds between readings beyond which nobody knows how fast it went."""


class Jumps:
    """What each chip of a board jumped by, and how many ranges it is beyond its own.

    After `check`: ``settled`` (A, n) bool, chips that have just been given another level, and
    ``restored``, such chips that read again what they did at rest.
    """

    def __init__(self, real: Bool, counts: NDArray[np.int64], scales: Scales) -> None:
        self._real = real
        self._scales = scales
        self._small: Bool = (counts >= ALONE_CHIPS[0]) & (counts <= ALONE_CHIPS[1])
        self._any_small = bool(self._small.any())
        self.never: Bool = np.zeros(real.shape, bool)
        self._none = np.zeros(real.shape, np.int64)
        self.rest: Float | None = None
        """(A, 3, n) µT in chip axes that the untouched chips read; None: unknown."""
        self.near: Float = np.zeros((3, 1))
        """µT that noise alone may make."""
        self.reset()

    def reset(self) -> None:
        """Forget every jump and wrap."""
        shape = self._real.shape
        self.turns = np.zeros((shape[0], 3, shape[1]))
        self.wrapped = False
        self.offset = self.turns
        """(A, 3, n) µT to add to what comes, where ``wrapped``."""
        self._jumping: Bool = self.never
        self._since = np.zeros(shape, np.int64)
        self._cycles = np.zeros(shape, np.int64)
        self._lonely = self._none
        self._displaced: Bool = self.never
        self.settled: Bool = self.never
        self.restored: Bool = self.never

    @property
    def least(self) -> float:
        """µT below which no step is a jump."""
        largest = float(self._scales.jump.min())
        return min(largest, ALONE_UT) if self._any_small else largest

    def accept_rest(self, rest_ut: Float) -> None:
        """A tare has found what the untouched chips read."""
        self.rest = rest_ut
        self._displaced = self.never

    def forget_wraps(self, array: int) -> None:
        """The counts of ``array`` have another size."""
        turns = self.turns.copy()
        turns[array] = 0.0
        self._turn(turns)

    def check(
        self,
        raw: Float,
        trusted: Float,
        last: Float,
        open_: Bool,
        before: Bool,
        captured: Instant,
        previous: Instant,
    ) -> tuple[Bool, Bool]:
        """Undo wraps in ``raw`` (A, 3, n) µT, in place.

        ``trusted``: what each chip read when it was last believed, ``last``: what it read in the
        cycle of ``previous``. ``open_``: (A, n) chips with no other fault; ``before``: those that
        had none then. Returns (A, n) chips that jumped, and that wrapped by who knows how much.
        """
        self.settled = self.restored = self.never
        away = raw - trusted
        if self._lonely is self._none and self._displaced is self.never:
            size = np.abs(away).max(axis=1)
            if not np.count_nonzero(open_ & (size > self.least)):
                self._jumping = self.never
                return self.never, self.never
        base = away
        if self._lonely is not self._none:
            # a chip that is not believed yet goes on from where it was last, or goes back
            step = raw - np.where(np.isnan(last), trusted, last)
            nearer = (self._lonely > 0) & ~self._jumping
            nearer &= np.abs(step).max(axis=1) < np.abs(away).max(axis=1)
            base = np.where(nearer[:, None], step, away)
        large = (np.abs(base) > self._scales.jump) & open_[:, None]
        jumped = wrapped = self.never
        if np.count_nonzero(large):
            span = self._scales.span
            turns = np.where(large, np.rint(base / span), 0.0)
            sure = (turns != 0) & (np.abs(base - turns * span) <= WRAP_RATIO * span)
            jumped = (large & ~sure).any(axis=1)
            wrapped = (large & ~sure & (turns != 0)).any(axis=1)
            self._undo(raw, np.where(sure & ~jumped[:, None], turns, 0.0))
        if self._displaced is not self.never:
            self._find_again(raw)
        at_rest = self._at_rest(raw)
        if self._displaced is not self.never:
            self.restored = self._displaced & at_rest & open_
            left = self._displaced & ~self.restored
            self._displaced = left if np.count_nonzero(left) else self.never
        distance = np.abs(raw - trusted)
        step = np.abs(raw - last)
        alone = self._alone(distance, step, open_, before, captured - previous) & ~at_rest
        jumped = jumped & ~at_rest
        if np.count_nonzero(jumped):
            jumped = self._settle(jumped, step, captured)
        self._jumping = jumped
        return jumped | alone, jumped & wrapped

    def _settle(self, jumped: Bool, step: Float, captured: Instant) -> Bool:
        """Those of ``jumped`` that have not gone on from there for long enough."""
        on = jumped & self._jumping & (step <= self._scales.jump).all(axis=1)
        fresh = jumped & ~on
        self._since[fresh] = captured
        self._cycles[fresh] = 0
        self._cycles[on] += 1
        settled = on & (self._cycles >= SETTLED_CYCLES)
        settled &= captured - self._since >= SETTLED_S * NS_PER_S
        if np.count_nonzero(settled):
            jumped = jumped & ~settled
            self.settled = settled
            self._displaced = self._displaced | settled
        return jumped

    def _undo(self, raw: Float, turns: Float) -> None:
        """Take ``turns`` (A, 3, n) whole ranges off ``raw``, now and from now on."""
        if np.count_nonzero(turns):
            raw -= np.where(turns == 0, 0.0, turns * self._scales.span)
            self._turn(self.turns - turns)

    def _turn(self, turns: Float) -> None:
        self.turns = turns
        self.wrapped = bool(np.count_nonzero(turns))
        self.offset = np.where(turns == 0, 0.0, turns * self._scales.span)

    def _at_rest(self, raw: Float) -> Bool:
        """(A, n) taxels that read about what they do untouched, where that is known."""
        if self.rest is None:
            return self.never
        return np.asarray((np.abs(raw - self.rest) <= REST_UT).all(axis=1))

    def _find_again(self, raw: Float) -> None:
        """A chip whose wraps were lost count of, and that reads its rest but for whole ranges, is
        at rest: correct it in ``raw``, in place.
        """
        if self.rest is None:
            return
        span = self._scales.span
        over = raw - self.rest
        turns = np.where(np.isnan(span), 0.0, np.rint(over / span))
        apart = np.where(turns == 0, over, over - turns * span)
        here = self._displaced & (np.abs(apart) <= REST_UT).all(axis=1)
        self._undo(raw, np.where(here[:, None], turns, 0.0))

    def _alone(
        self, distance: Float, step: Float, open_: Bool, before: Bool, elapsed_ns: int
    ) -> Bool:
        """(A, n): a chip of a small array jumped, no other moved, and it is not yet certain."""
        if not self._any_small or not 0 <= elapsed_ns <= ALONE_S * NS_PER_S:
            self._lonely = self._none
            return self.never
        usable = self._real & open_ & (before | (self._lonely > 0))
        far = np.where(usable, np.nan_to_num(distance.max(axis=1)), 0.0)
        if not float(far.max()) > ALONE_UT:
            self._lonely = self._none
            return self.never
        ordered = np.sort(far, axis=1)
        most, next_most = ordered[:, -1], ordered[:, -2]
        lonely = self._small & (most > ALONE_UT)
        lonely &= next_most < ALONE_RATIO * most + float(self.near.max())
        lonely &= usable.sum(axis=1) >= ALONE_CHIPS[0]
        out = (lonely[:, None] & (far == most[:, None])) | ((self._lonely > 0) & (far > ALONE_UT))
        steady = step.max(axis=1) <= far / 2
        count = np.where(steady, self._lonely, 0) + 1
        out &= count <= ALONE_CYCLES
        self._lonely = np.where(out, count, 0) if np.count_nonzero(out) else self._none
        return np.asarray(out)
