"""Health of the taxels in each cycle: which are faulty and why, and what can be repaired.

A faulty chip is recognised by its readings: values that no chip sends (not a number, out of range,
an impossible temperature), values that only a failed read gives (the same count on every axis, far
from the last reading), the end of the range, a jump that no contact makes, the bits of another
chip or of an earlier frame, or too little noise. A 16-bit wrap is undone where continuity proves
it.
"""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

from tactile_core.arrays import FloatArray
from tactile_core.geometry import SkinGeometry
from tactile_core.types import NS_PER_S, Instant
from tactiled.blocks import Reason, TaxelHealth
from tactiled.sensing import reasons as why
from tactiled.sensing.consensus import PLANE_TAXELS
from tactiled.sensing.features import Adjacency
from tactiled.sensing.layout import Layout
from tactiled.sensing.reasons import BITS, Fault
from tactiled.sensing.scale import Scale, Scales

# Activity: a dead chip has too little noise.
#
# Over blocks of a quarter of a second the smallest and largest reading of every component are kept.
# In a block a live chip spans three to five sigma of its noise; a dead chip whose last bit toggles
# spans one count.


Bool = NDArray[np.bool_]

BLOCK_S = 0.25
BLOCK_CYCLES = 16
"""A block has at least this length and this many cycles."""
LEARNT_BLOCKS = 4
"""Blocks in which a chip was alive, after which its least span is known."""
DEAD_RATIO = 12.0
"""A chip whose span is this many times smaller than a live one's is dead. Noise alone varies the
span of sixteen samples by a factor of two."""
MUTE_RATIO = 16.0
"""The same when the other chips are as still, which the end of a motion causes too."""
STEPS = 6.0
"""Least span of a live axis, in counts, for a constant one to count as stuck: noise below half a
count makes axes of coarse chips repeat a value for seconds."""


class Activity:
    """Spans of a board's chips; keeps two readings and a few numbers per taxel."""

    def __init__(self, shape: tuple[int, int, int], real: Bool) -> None:
        self._real = real
        self._shape = shape
        middle = real.sum(axis=1) // 2
        self._middle = np.broadcast_to(middle[:, None, None], (shape[0], 3, 1))
        self.reset()

    def reset(self) -> None:
        """Forget everything."""
        arrays, _, width = self._shape
        self.least = np.full(self._shape, np.inf)
        """Smallest span in a block in which the chip was alive, (A, 3, n) µT."""
        self.dead: Bool = np.zeros((arrays, width), bool)
        self.stuck: Bool = np.zeros((arrays, width), bool)
        self._blocks = np.zeros((arrays, width), np.int64)
        self._low = np.full(self._shape, np.inf)
        self._high = np.full(self._shape, -np.inf)
        self._start: Instant | None = None
        self._cycles = 0

    def add(self, raw: FloatArray, captured: Instant) -> bool:
        """Add finite readings of one cycle, (A, 3, n) µT; True when a block ends: call `judge`."""
        np.minimum(self._low, raw, out=self._low)
        np.maximum(self._high, raw, out=self._high)
        self._cycles += 1
        if self._start is None or captured < self._start:
            self._start = captured
        return self._cycles >= BLOCK_CYCLES and captured - self._start >= BLOCK_S * NS_PER_S

    def forgive(self, moved: Bool) -> None:
        """Mark the chips ``moved`` (A, n) as alive: they changed by more than their last bits."""
        self.dead &= ~moved
        self.stuck &= ~moved

    def judge(self, steps: FloatArray) -> None:
        """End a block: find chips that are ``dead`` or have an axis ``stuck``.

        ``steps``: (A, 3, 1) µT per count, NaN where unknown.
        """
        span = self._high - self._low
        self._low = np.full(self._shape, np.inf)
        self._high = np.full(self._shape, -np.inf)
        self._start, self._cycles = None, 0
        own = np.where((self._blocks >= LEARNT_BLOCKS)[:, None], self.least, np.inf)
        shown = np.where(self._real[:, None], span, np.inf)
        usual = np.take_along_axis(np.sort(shown, axis=2), self._middle, axis=2)
        # Quieter than ever before and than the others now; or, in case many die at once, so quiet
        # that at most one bit toggles.
        mute = (span * DEAD_RATIO <= own).all(axis=1)
        beside = (span * DEAD_RATIO <= usual).all(axis=1) & (usual > 0).all(axis=1)
        known = np.isfinite(own).all(axis=1)
        bit = (span <= 1.01 * steps).all(axis=1) | (span * MUTE_RATIO <= own).all(axis=1)
        still = (span == 0).all(axis=1)  # frozen, which `HealthMonitor` times itself
        dead = np.where(known, mute & (beside | bit), beside) & self._real & ~still
        axis = (span == 0) & np.isfinite(own) & (own >= STEPS * steps)
        self.stuck = axis.any(axis=1) & ~still & self._real
        self.dead = dead
        alive = self._real & ~dead & ~self.stuck & ~still
        self._blocks[alive] += 1
        self.least = np.where(alive[:, None], np.minimum(self.least, span), self.least)


# Repeated frames, and chips with equal readings: noise never produces them.


KEPT = 128
"""Earlier frames that a frame is compared with; a recording played in a loop is longer."""
NOISY_FRAMES = 32
"""Different frames needed before a copy counts: a stream without noise may repeat itself."""

TWIN_CYCLES = 4
"""Cycles with new readings in which two chips must agree bit for bit before that is a fault."""


class Copies:
    """Recognises frames of one array that are exact copies of earlier ones."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget every frame."""
        self._places: dict[int, int] = {}
        self._order: deque[tuple[int, int]] = deque()
        self._last = 0
        self._place = 0
        self._before = (-2, -2)
        self._fresh = 0
        self._verdict = False

    def add(self, frame: bytes) -> bool:
        """Whether ``frame`` is a copy of an earlier one, not counting the last.

        A motion that runs back through the same frames, which needs a stream without noise, is not
        a copy.
        """
        digest = hash(frame)
        if digest == self._last:
            return self._verdict
        self._last = digest
        found = self._places.get(digest)
        self._place += 1
        place = self._place
        self._places[digest] = place
        self._order.append((place, digest))
        if len(self._order) > KEPT:
            oldest, key = self._order.popleft()
            if self._places.get(key) == oldest:
                del self._places[key]
        before = self._before
        if found is None:
            self._fresh += 1
            self._before = (place, place)
            self._verdict = False
            return False
        self._before = (found, place)
        self._verdict = self._fresh >= NOISY_FRAMES and found + 1 not in before
        return self._verdict


class Twins:
    """Finds chips with equal bits in all three components, cycle after cycle.

    ``rest_ut``: rest field by the calibration, (A, 3, n) µT in chip axes; chips that read the same
    at rest may read the same. None: unknown.
    """

    def __init__(self, real: Bool, rest_ut: FloatArray | None) -> None:
        self._real = real
        self._places = np.flatnonzero(real)
        self._whole = bool(real.all())
        self._rest = None if rest_ut is None else _columns(rest_ut)
        self.reset()

    def reset(self) -> None:
        """Forget which chips were equal."""
        self._run: NDArray[np.int64] | None = None

    def check(
        self, raw: FloatArray, trusted: FloatArray, unchanged: Bool, near: FloatArray
    ) -> Bool | None:
        """(A, n) taxels found to send another chip's bits; None when there are none.

        ``raw``: (A, 3, n) µT. A chip that differs from its last good reading, ``trusted``, by more
        than ``near`` (3, 1) µT is found at once, others after `TWIN_CYCLES` readings; ``unchanged``
        (A, n) ones do not count as readings.
        """
        # not a matrix product, whose sums may be rounded differently from taxel to taxel
        key = raw[:, 0] + raw[:, 1] * np.pi + raw[:, 2] * np.e
        flat: list[float] = key.ravel().tolist() if self._whole else key[self._real].tolist()
        if len(set(flat)) == len(flat):
            self._run = None
            return None
        columns, still = _columns(raw), unchanged.ravel()
        before = np.zeros(still.size, np.int64) if self._run is None else self._run
        run = np.zeros(still.size, np.int64)
        guilty = np.zeros(still.size, bool)
        for i, j in self._pairs(key.ravel()):
            if not columns[i].any() or (columns[i] != columns[j]).any():
                continue
            if not self._differ(i, j, near):
                continue
            for one in (i, j):
                run[one] = before[one] + (0 if still[one] else 1)
                left = np.abs(columns[one] - _columns(trusted)[one]) > near[:, 0]
                guilty[one] = run[one] >= TWIN_CYCLES or bool(left.any())
        self._run = run
        return guilty.reshape(unchanged.shape) if guilty.any() else None

    def _pairs(self, key: FloatArray) -> list[list[int]]:
        """Pairs of flat indices of taxels with the same key."""
        values = key[self._places]
        order = np.argsort(values, kind="stable")
        same = np.flatnonzero(np.diff(values[order]) == 0)
        pairs = np.column_stack([self._places[order[same]], self._places[order[same + 1]]])
        out: list[list[int]] = pairs.tolist()
        return out

    def _differ(self, i: int, j: int, near: FloatArray) -> bool:
        """Whether two taxels have different rest fields, however their chips are turned about z."""
        if self._rest is None:
            return True
        one, other = self._rest[i], self._rest[j]
        z = abs(one[2] - other[2])
        xy = abs(np.hypot(one[0], one[1]) - np.hypot(other[0], other[1]))
        return bool(z > near[2, 0] or xy > near[0, 0])


def _columns(vectors: FloatArray) -> FloatArray:
    """Reshape (A, 3, n) to (A n, 3)."""
    return vectors.swapaxes(1, 2).reshape(-1, 3)


# Jumps from one reading to the next: 16-bit wraps, which are undone where certain, and faults.


WRAP_RATIO = 1 / 6
"""Share of the range of counts by which a certain wrap may differ from a jump of a whole range."""
SETTLED_S = 0.5
SETTLED_CYCLES = 5
"""A chip that jumped and stays there this long has a new level; its rest field is unknown."""
REST_UT = 1000.0
"""µT; a reading that returns to within this of the rest field after a jump is at rest, apart from
the creep of the rubber: 89 to 178 µT after 3.9 mT in eFlesh recordings."""

ALONE_UT = 1500.0
"""µT; on an array of few chips, a contact by which one chip jumps more must show on another: the
second largest change is 28 % or more in eFlesh recordings."""
ALONE_RATIO = 0.02
"""Share of it, besides noise, up to which another chip has not moved: a dipole 10 mm away changes
by 0.8 to 3.5 % at the usual gaps, and rubber transmits more."""
ALONE_CHIPS = (3, 8)
"""Fewest and most chips of arrays whose chips all respond to every contact."""
ALONE_CYCLES = 2
"""Readings for which such a chip is not trusted; if it stays there, it was hit at the very edge of
the skin."""
ALONE_S = 0.05
"""s between readings above which the speed of a jump is unknown."""


class Jumps:
    """Jumps and wraps of each chip of a board.

    After `check`: ``settled`` (A, n) bool, chips that have just settled at a new level, and
    ``restored``, such chips that read their rest field again.
    """

    def __init__(self, real: Bool, counts: NDArray[np.int64], scales: Scales) -> None:
        self._real = real
        self._scales = scales
        self._small: Bool = (counts >= ALONE_CHIPS[0]) & (counts <= ALONE_CHIPS[1])
        self._any_small = bool(self._small.any())
        self.never: Bool = np.zeros(real.shape, bool)
        self._none = np.zeros(real.shape, np.int64)
        self.rest: FloatArray | None = None
        """Rest field, (A, 3, n) µT in chip axes; None: unknown."""
        self.near: FloatArray = np.zeros((3, 1))
        """Largest step that noise alone may make, (3, 1) µT."""
        self.reset()

    def reset(self) -> None:
        """Forget every jump and wrap."""
        shape = self._real.shape
        self.turns = np.zeros((shape[0], 3, shape[1]))
        self.wrapped = False
        self.offset = self.turns
        """Correction to add to readings while ``wrapped``, (A, 3, n) µT."""
        self._jumping: Bool = self.never
        self._since = np.zeros(shape, np.int64)
        self._cycles = np.zeros(shape, np.int64)
        self._lonely = self._none
        self._displaced: Bool = self.never
        self.settled: Bool = self.never
        self.restored: Bool = self.never

    @property
    def least(self) -> float:
        """µT; smaller steps are never jumps."""
        largest = float(self._scales.jump.min())
        return min(largest, ALONE_UT) if self._any_small else largest

    @property
    def displaced(self) -> bool:
        """Whether a chip has settled at another level and may return from it."""
        return self._displaced is not self.never

    def accept_rest(self, rest_ut: FloatArray) -> None:
        """Set the rest field, (A, 3, n) µT in chip axes, after a tare."""
        self.rest = rest_ut
        self._displaced = self.never

    def forget_wraps(self, array: int) -> None:
        """Forget the wraps of ``array``: its µT per count have changed."""
        turns = self.turns.copy()
        turns[array] = 0.0
        self._turn(turns)

    def check(
        self,
        raw: FloatArray,
        trusted: FloatArray,
        last: FloatArray,
        open_: Bool,
        before: Bool,
        captured: Instant,
        previous: Instant,
    ) -> tuple[Bool, Bool]:
        """Undo wraps in ``raw`` (A, 3, n) µT, in place.

        ``trusted``: last good reading of each chip; ``last``: its reading in the cycle of
        ``previous``. ``open_``: (A, n) chips with no other fault; ``before``: those without a fault
        in the previous cycle. Returns (A, n) chips that jumped, and chips that wrapped by an
        unknown amount.
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
            # a chip not trusted yet either continues from its last reading or returns
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

    def _settle(self, jumped: Bool, step: FloatArray, captured: Instant) -> Bool:
        """``jumped`` without the chips that have stayed at the new level for long enough."""
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

    def _undo(self, raw: FloatArray, turns: FloatArray) -> None:
        """Subtract ``turns`` (A, 3, n) whole ranges from ``raw``, now and in later cycles."""
        if np.count_nonzero(turns):
            raw -= np.where(turns == 0, 0.0, turns * self._scales.span)
            self._turn(self.turns - turns)

    def _turn(self, turns: FloatArray) -> None:
        self.turns = turns
        self.wrapped = bool(np.count_nonzero(turns))
        self.offset = np.where(turns == 0, 0.0, turns * self._scales.span)

    def _at_rest(self, raw: FloatArray) -> Bool:
        """(A, n) taxels that read about their rest field, where that is known."""
        if self.rest is None:
            return self.never
        return np.asarray((np.abs(raw - self.rest) <= REST_UT).all(axis=1))

    def _find_again(self, raw: FloatArray) -> None:
        """Correct in ``raw``, in place, chips that differ from their rest field by whole ranges:
        their wraps were miscounted, and they are at rest.
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
        self, distance: FloatArray, step: FloatArray, open_: Bool, before: Bool, elapsed_ns: int
    ) -> Bool:
        """(A, n) chips of small arrays that jumped while no other chip moved, and are not yet
        confirmed."""
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


# The chips' thermometers: impossible, jumping and stuck temperatures.


LIMITS_C = (-45.0, 130.0)
"""The datasheet's −40 to 125 °C with some tolerance. Beyond, the magnetometer did not answer."""
_MIDDLE_C = sum(LIMITS_C) / 2
_HALF_RANGE_C = (LIMITS_C[1] - LIMITS_C[0]) / 2
STEP_C = 15.0
"""K; no chip warms by this from one reading to the next, at the rates of boards."""
THERMOMETER_SETTLED_S = 1.0
"""s after which a temperature that stays where it jumped is accepted; the firmware may, for
instance, have stopped reading it."""
MOVED_C = 5.0
"""K by which the other chips must have warmed since a chip's thermometer last changed before it
counts as stuck: all are warmed by the same room, board and hand."""
FEWEST = 3
"""Fewest chips of an array whose thermometers can be compared."""
ROOM_C = 25.0
"""°C assumed for a chip that has never sent one."""


class Thermometers:
    """Checks the chips' temperatures.

    ``stuck``: (A, n) bool; None when none is. ``uneasy``: one has just jumped.
    """

    def __init__(self, real: Bool) -> None:
        self._real = real
        self.reset()

    def reset(self) -> None:
        """Forget every temperature."""
        shape = self._real.shape
        self.last: FloatArray = np.full(shape, np.nan)
        """Temperatures of the last cycle, (A, n) °C."""
        self._good = np.full(shape, np.nan)
        self._since = np.zeros(shape, np.int64)
        self._changed_at = np.full(shape, np.nan)
        self._middle_then = np.full(shape, np.nan)
        self.stuck: Bool | None = None
        self.uneasy = False

    def plain(self, temperature_c: FloatArray) -> bool:
        """Whether temperatures (A, n) °C are near those of the cycle before, so need no check."""
        return float(np.abs(temperature_c - self.last).max()) < STEP_C

    def possible(self, temperature_c: FloatArray) -> bool:
        """Whether a working chip may send all of the temperatures (A, n) °C."""
        return float(np.abs(temperature_c - _MIDDLE_C).max()) <= _HALF_RANGE_C

    def accept(self, temperature_c: FloatArray) -> None:
        """Take temperatures (A, n) °C that need no check."""
        self._good = temperature_c

    def check(self, temperature_c: FloatArray, read: Bool, captured: Instant) -> tuple[Bool, Bool]:
        """Find impossible and jumped temperatures, (A, n) each; impossible ones are replaced.

        ``read``: (A, n) chips that were read; temperatures of others are not kept.
        """
        impossible: Bool = ~(np.abs(temperature_c - _MIDDLE_C) <= _HALF_RANGE_C)
        if np.count_nonzero(impossible):
            np.copyto(temperature_c, np.nan_to_num(self._good, nan=ROOM_C), where=impossible)
        # zero: the board's buffer has never been filled with a reading
        jumped: Bool = (np.abs(temperature_c - self._good) > STEP_C) & (self._good != 0.0)
        if np.count_nonzero(jumped):
            on = jumped & (np.abs(temperature_c - self.last) <= STEP_C)
            self._since[jumped & ~on] = captured
            jumped = jumped & ~(on & (captured - self._since >= THERMOMETER_SETTLED_S * NS_PER_S))
        self._good = np.where(read & ~(impossible | jumped), temperature_c, self._good)
        self.uneasy = bool(np.count_nonzero(jumped))
        return impossible, jumped

    def judge(self, alive: Bool) -> None:
        """Find thermometers stuck while the others of their array change. ``alive``: (A, n) chips
        with noise."""
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


# Whether an array's features are still valid when some of its taxels are masked.
#
# A masked taxel under a contact hides it; one beside a contact hides part of it. On arrays of
# sixteen taxels and more this matters only near the contact: when the taxel was in contact before
# it was masked, or has a neighbour that is. On a board of few chips every contact reaches all of
# them (the second largest change is 28 % or more in eFlesh recordings), and each bears a large
# share. There, any force anywhere makes the array's forces unknown, and so does a chip that was
# masked because its field left its range.


UInt8 = NDArray[np.uint8]

_LEFT_RANGE = np.array(
    [Fault.SATURATED, Fault.RAIL, Fault.WRAPPED, Fault.JUMPED, Fault.BEYOND_RANGE], np.uint8
)
"""Faults that a strong field may cause."""


class Masking:
    """Decides whether masked taxels hide a contact. N taxels, ordered array by array."""

    def __init__(self, geometry: SkinGeometry) -> None:
        self._names = tuple(a.name for a in geometry.arrays)
        self._slices = geometry.slices
        self._small = tuple(a.taxels < PLANE_TAXELS for a in geometry.arrays)
        self._neighbours = Adjacency(geometry).neighbours
        self.reset()

    def reset(self) -> None:
        """Forget contacts, after a tare or a restart."""
        taxels = self._slices[-1].stop
        self._sick = False
        self._masked = np.zeros(taxels, bool)
        self._hidden = np.zeros(taxels, bool)
        self.touched = np.zeros(taxels, bool)
        """(N,) taxels in contact in the last cycle; for the owner to set."""

    def all_healthy(self, touched: Bool) -> None:
        """Take a cycle without masked taxels. ``touched``: (N,) taxels in contact."""
        self.touched = touched
        if self._sick:
            self._sick = False
            self._masked = np.zeros_like(self._masked)
            self._hidden = self._masked

    def judge(self, fault: UInt8, felt: Bool) -> tuple[list[Reason], bool]:
        """Why the forces of one cycle are incomplete, and whether they are still good enough.

        ``fault``: (N,) of `Fault`. ``felt``: (N,) healthy taxels that bear a force.
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
                continue  # an array that is missing altogether is reported elsewhere
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


FROZEN_CYCLES = 3
"""Unchanged readings in a row before a taxel can count as frozen, so that at low rates two equal
readings by chance do not mask it (three 12-bit noisy components repeat once in 10^3)."""
FROZEN_BITS = 30.0
"""Improbability in bits of a run of repeated readings that counts as frozen, given how often the
board's chips repeat readings otherwise: coarse and quiet ones do so one time in three."""
MOST_REPEATED = 0.5
"""Upper limit of that share of repeated readings."""
LONG_RUN = 8
"""Most repetitions of one run that count towards that share: a frozen chip does not show noise."""
REMEMBERED = 1e5
"""Readings after which the weight of earlier ones is halved."""
NEAR_SIGMAS = 7.0
"""Steps within this many sigma may be noise."""
NOISE_UT = (4.4, 4.4, 6.7)
"""µT rms of one sample until it has been measured."""
Z_PER_XY = (1.595, 1.635)
"""Ratio of the scale of z to that of x and y at any gain of an MLX90393; it is 1 for chips with a
single scale."""
TINY_UT = 20.0
"""µT, two counts of the coarsest scale: a count of minus one is less."""
ALIKE_CYCLES = 4
"""Repeats of zero or minus one on every axis that make a failed read of a chip that never read
anything else: at zero field, noise of a count gives it once in twenty readings."""
REVIVED_S = 1.0
"""s; after a longer failure the rest field of a chip may have changed."""
COPY_BITS = 30.0
"""Least information of a frame, in bits, for a copy among `KEPT` frames not to be chance."""

_WELL = (
    Fault.NONE,
    Fault.MISSING,
    Fault.SATURATED,
    Fault.STALE,
    Fault.RAIL,
    Fault.COPY,
    Fault.TEMPERATURE_JUMP,
    Fault.TEMPERATURE_STUCK,
)
"""Faults after which the chip's rest field is still good."""
_SICK: Bool = np.array([fault not in _WELL for fault in Fault])


class HealthMonitor:
    """Health of a board's taxels, in constant memory.

    After `update`: ``fault``: (A, n) uint8 of `Fault`. ``revived``: (A, n) bool, taxels that have
    recovered in this cycle after `REVIVED_S` or at another level, so that their rest field may
    have changed. ``restored``: taxels that were at another level and now read their rest field
    again.
    """

    def __init__(
        self,
        layout: Layout,
        frozen_after_s: float | None,
        range_limit_ut: float,
        rest_ut: FloatArray | None = None,
    ) -> None:
        """``rest_ut``: rest field, (A, 3, n) µT in chip axes; None: unknown."""
        shape = (layout.arrays, layout.width)
        self._frozen_after = None if frozen_after_s is None else round(frozen_after_s * NS_PER_S)
        self._limit = range_limit_ut
        self._real = layout.real
        self._taxels = layout.taxels
        self._padded = not layout.real.all()
        self._rest = rest_ut
        self.scales = Scales(layout.real)
        self._jumps = Jumps(layout.real, layout.counts, self.scales)
        self._jumps.rest = rest_ut
        self._activity = Activity((shape[0], 3, shape[1]), layout.real)
        self._twins = Twins(layout.real, rest_ut)
        self._thermometers = Thermometers(layout.real)
        self._copies = [Copies() for _ in range(shape[0])]
        self._never = self._jumps.never
        self._same = np.zeros(shape[0], bool)
        self._clear = np.zeros(shape, np.uint8)
        self.revived = self.restored = self._never
        self.fault: UInt8 = self._clear
        self.set_noise(np.array(NOISE_UT))
        self.reset()

    def reset(self) -> None:
        """Forget all readings; scales (µT per count) stay until they no longer fit."""
        shape = self._real.shape
        self._last = np.full((shape[0], 3, shape[1]), np.nan)
        self._trusted = self._last.copy() if self._rest is None else self._rest.copy()
        self._captured = Instant(0)
        self._since = np.zeros(shape, np.int64)
        self._repeats = np.zeros(shape, np.int64)
        self._repeating = True
        self._needed = float(FROZEN_CYCLES)
        self._readings = self._repeated = 0.0
        self._gone = np.zeros(shape, bool)
        self._gone_since = np.zeros(shape, np.int64)
        self._mute = False
        self._rich: Bool = self._same
        self._ailing = True  # so that the first cycle gets the full check
        self.fault = self._clear
        self._jumps.reset()
        self._activity.reset()
        self._twins.reset()
        self._thermometers.reset()
        for copies in self._copies:
            copies.reset()

    def set_noise(self, noise_ut: FloatArray) -> None:
        """Set the noise of one sample, (3,) µT rms in chip axes."""
        self._near = self._jumps.near = NEAR_SIGMAS * noise_ut[:, None]
        self._quiet = float(self._near.min())

    def set_rest(self, rest_ut: FloatArray) -> None:
        """Set the rest field, (A, 3, n) µT in chip axes, after a tare."""
        self._rest = rest_ut
        self._jumps.accept_rest(rest_ut)

    def set_scale(self, array: int, scale: Scale) -> None:
        """Set the scale of ``array`` as the board reports it: µT per count of x and y, and of z."""
        if self.scales.set_reported(array, scale):
            self._jumps.forget_wraps(array)

    def update(
        self,
        raw: FloatArray,
        temperature_c: FloatArray,
        status: UInt8,
        present: Bool,
        captured: Instant,
    ) -> UInt8:
        """Check one cycle; returns (A, n) uint8 of `TaxelHealth`.

        ``raw``: (A, 3, n) µT in chip axes. ``temperature_c``: (A, n) °C. ``status``: (A, n), flags
        from the board. ``present``: (A,) whether the array's block came. In ``raw`` wraps are
        undone, and in ``raw`` and ``temperature_c`` implausible values are replaced by the chip's
        last good ones, in place.
        """
        self.revived = self.restored = self._jumps.settled = self._never
        scales, jumps, activity = self.scales, self._jumps, self._activity
        if scales.seeking:
            for array in scales.learn(raw):
                self._jumps.forget_wraps(array)
        whole = np.count_nonzero(present) == len(present)
        if not whole:
            raw[~present] = self._last[~present]
            temperature_c[~present] = self._thermometers.last[~present]
        broken = self._repair(raw)
        sent = raw
        if jumps.wrapped:
            sent = raw.copy()
            raw += jumps.offset
        moved = np.abs(raw - self._last).max(axis=1)
        unchanged = moved == 0
        if self._padded:
            unchanged &= self._real
        copied = self._copied(raw, moved, present)
        twin = self._twins.check(raw, self._trusted, unchanged, self._near)
        fault = self._clear
        if (
            self._ailing
            or jumps.wrapped
            or not whole
            or broken is not None
            or copied is not None
            or twin is not None
            or np.count_nonzero(status) > 0
            or not self._thermometers.plain(temperature_c)
            or not (float(moved.max()) < self._quiet or self._is_motion(raw, moved))
            or (not float(np.abs(raw).max()) < scales.top and self._is_doubtful(raw, temperature_c))
        ):
            fault = np.zeros_like(self._clear)
            self._mark_flagged(fault, status, present, broken)
            self._mark_failed(fault, raw, sent)
            self._mark_temperatures(fault, temperature_c, captured)
            if copied is not None:
                _mark(fault, np.broadcast_to(copied[:, None], fault.shape), Fault.COPY)
            rails = (sent >= scales.rails[1]) | (sent <= scales.rails[0])
            if np.count_nonzero(rails):
                _mark(fault, np.asarray(rails.any(axis=1)), Fault.RAIL)
            if twin is not None:
                _mark(fault, twin, Fault.SAME_BITS)
            jumped, wrapped = jumps.check(
                raw,
                self._trusted,
                self._last,
                fault == 0,
                self.fault == 0,
                captured,
                self._captured,
            )
            fault[jumped] = Fault.JUMPED
            fault[wrapped] = Fault.WRAPPED
            self.restored = jumps.restored
            if self._padded:
                fault[~self._real] = Fault.NONE
            self._trusted = np.where((fault == 0)[:, None], raw, self._trusted)
        else:
            self._trusted = raw
            self._thermometers.accept(temperature_c)
        self._last = raw
        self._captured = captured
        self._thermometers.last = temperature_c
        frozen = self._unchanging(unchanged, present, whole, captured)
        if activity.add(raw, captured):
            self._end_block(raw, fault)
        if self._mute:
            activity.forgive(moved > 2 * float(self._near.max()))
        if frozen is not None or self._mute:
            fault = fault.copy()
            if frozen is not None:
                _mark(fault, frozen, Fault.FROZEN)
            _mark(fault, activity.dead, Fault.DITHER)
            _mark(fault, activity.stuck, Fault.AXIS_STUCK)
            if self._thermometers.stuck is not None:
                _mark(fault, self._thermometers.stuck, Fault.TEMPERATURE_STUCK)
        was_ailing, self.fault = self._ailing, fault
        if was_ailing or fault is not self._clear:
            self._recover(fault, captured)
        health: UInt8 = status | BITS[fault] if fault is not self._clear else status.copy()
        if frozen is not None:
            health[frozen] |= np.uint8(TaxelHealth.FROZEN)
        return health

    # Checks in every cycle

    def _repair(self, raw: FloatArray) -> tuple[Bool, Bool] | None:
        """Replace impossible values in ``raw`` by the last readings.

        Returns (A, n) taxels that are not a number, and taxels beyond the range; None: neither.
        """
        if float(np.abs(raw).max()) <= self._limit:
            return None
        strange: Bool = np.asarray(~np.isfinite(raw).all(axis=1))
        beyond: Bool = np.asarray((np.abs(raw) > self._limit).any(axis=1)) & ~strange
        np.copyto(raw, np.nan_to_num(self._last), where=(strange | beyond)[:, None])
        return strange, beyond

    def _is_motion(self, raw: FloatArray, moved: FloatArray) -> bool:
        """Whether steps beyond the noise may be a contact: small, and x and y differ, which they
        do not in failed reads.
        """
        if float(moved.max()) > self._jumps.least:
            return False
        return not np.count_nonzero((raw[:, 0] == raw[:, 1]) & (moved >= self._quiet))

    def _is_doubtful(self, raw: FloatArray, temperature_c: FloatArray) -> bool:
        """Whether fields beyond the smallest range of any axis may hide a fault.

        Magnets whose z exceeds the range of x and y at rest do so in every cycle, and the full
        check would find nothing but what is looked for here.
        """
        low, high = self.scales.rails
        return bool(
            self._jumps.displaced
            or (self._repeating and np.count_nonzero(self._repeats >= ALIKE_CYCLES))
            or np.count_nonzero((raw >= high) | (raw <= low))
            or not self._thermometers.possible(temperature_c)
        )

    def _copied(self, raw: FloatArray, moved: FloatArray, present: Bool) -> Bool | None:
        """(A,) arrays whose frame is a copy of an earlier one; None when there are none."""
        out: Bool | None = None
        for a, copies in enumerate(self._copies):
            if not present[a] or not copies.add(raw[a].tobytes()):
                continue
            # a copy close to the last frame may be chance, unless there is much noise
            if self._rich[a] or float(moved[a].max()) > self._quiet:
                out = np.zeros(len(present), bool) if out is None else out
                out[a] = True
        return out

    def _unchanging(
        self, unchanged: Bool, present: Bool, whole: bool, captured: Instant
    ) -> Bool | None:
        """(A, n) taxels that have repeated one reading for too long; None when there are none."""
        self._readings += self._taxels
        if whole and not np.count_nonzero(unchanged):
            self._since.fill(captured)
            if self._repeating:
                self._repeated += float(np.minimum(self._repeats, LONG_RUN).sum())
                self._repeats.fill(0)
                self._repeating = False
            return None
        self._repeating = True
        self._repeats[present] += 1
        changed = ~unchanged & present[:, None]  # missing arrays count as neither
        self._repeated += float(np.minimum(self._repeats[changed], LONG_RUN).sum())
        self._repeats[changed] = 0
        self._since[changed] = captured
        if self._frozen_after is None:
            return None
        frozen = (captured - self._since) >= self._frozen_after
        frozen &= self._repeats >= self._needed
        frozen &= present[:, None]
        return frozen if np.count_nonzero(frozen) else None

    # Further checks, of cycles in which something is suspicious

    def _mark_flagged(
        self, fault: UInt8, status: UInt8, present: Bool, broken: tuple[Bool, Bool] | None
    ) -> None:
        """Mark taxels that are missing, not a number, beyond the range or flagged by the board."""
        fault[~present] = Fault.MISSING
        if broken is not None:
            _mark(fault, broken[0], Fault.NOT_FINITE)
            _mark(fault, broken[1], Fault.BEYOND_RANGE)
        if np.count_nonzero(status):
            _mark(fault, (status & TaxelHealth.READ_FAILED) > 0, Fault.FAILED)
            _mark(fault, (status & TaxelHealth.SATURATED) > 0, Fault.SATURATED)
            _mark(fault, status > 0, Fault.STALE)

    def _mark_failed(self, fault: UInt8, raw: FloatArray, sent: FloatArray) -> None:
        """Mark failed reads: the same count on every axis (zero, minus one, or with an offset).

        Only where the chip read something else before, which noise does not explain.
        """
        x, y, z = sent[:, 0], sent[:, 1], sent[:, 2]
        alike = x == y
        if not np.count_nonzero(alike):
            return
        far = (np.abs(raw - self._trusted) > self._near).any(axis=1)
        steps = self.scales.steps
        known = np.isfinite(steps[:, 0])
        with np.errstate(invalid="ignore", divide="ignore"):
            ratio = z / x
            exact = np.abs(ratio * steps[:, 0] / steps[:, 2] - 1) < 1e-4
        usual = (ratio == 1) | ((ratio >= Z_PER_XY[0]) & (ratio <= Z_PER_XY[1]))
        zero = alike & (x == 0) & (z == 0)
        same = alike & ~zero & np.where(known, exact, usual)
        # from the start: a chip in zero field reads zero by chance, but not for long
        lasts = self._repeats >= ALIKE_CYCLES
        _mark(fault, zero & (far | lasts), Fault.ZEROS)
        _mark(fault, same & (far | (lasts & (np.abs(z) < TINY_UT))), Fault.ONES)

    def _mark_temperatures(
        self, fault: UInt8, temperature_c: FloatArray, captured: Instant
    ) -> None:
        impossible, jumped = self._thermometers.check(temperature_c, fault == 0, captured)
        if np.count_nonzero(impossible):
            _mark(fault, impossible, Fault.TEMPERATURE)
        if np.count_nonzero(jumped):
            _mark(fault, jumped, Fault.TEMPERATURE_JUMP)

    # Lasting faults

    def _recover(self, fault: UInt8, captured: Instant) -> None:
        """Note since when taxels have been faulty, and which have recovered."""
        settled = self._jumps.settled
        back = self._gone & (fault == 0)
        if np.count_nonzero(back):
            revived = back & ((captured - self._gone_since >= REVIVED_S * NS_PER_S) | settled)
            if np.count_nonzero(revived):
                self.revived = revived
            self._gone &= ~back
        new = _SICK[fault] & ~self._gone
        if np.count_nonzero(new):
            self._gone_since[new] = captured
            self._gone |= new
        self._ailing = bool(np.count_nonzero(fault)) or self._thermometers.uneasy

    def _end_block(self, raw: FloatArray, fault: UInt8) -> None:
        """The checks made four times a second."""
        activity, steps = self._activity, self.scales.steps
        activity.judge(steps)
        self._thermometers.judge(activity.least.min(axis=1) > 0)
        silent = np.count_nonzero(activity.dead | activity.stuck)
        self._mute = bool(silent) or self._thermometers.stuck is not None
        self.scales.recheck(raw, self._real & (fault == 0))
        spans = np.where(np.isfinite(activity.least), activity.least, 0.0)
        bits = np.log2(1.0 + spans / np.where(np.isnan(steps), np.inf, steps)).sum(axis=1)
        self._rich = np.where(self._real, bits, 0.0).sum(axis=1) >= COPY_BITS
        share = self._repeated / max(self._readings, 1.0)
        self._needed = float(FROZEN_CYCLES)
        if share > 0:
            enough = FROZEN_BITS / -np.log2(min(share, MOST_REPEATED))
            self._needed = max(self._needed, float(enough))
        if self._readings > REMEMBERED:
            self._readings /= 2
            self._repeated /= 2


def _mark(fault: UInt8, where: Bool, what: Fault) -> None:
    """Set the fault ``what`` for taxels without a fault so far."""
    fault[where & (fault == 0)] = what
