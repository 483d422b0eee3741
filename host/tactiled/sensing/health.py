"""Which taxels may be trusted in a cycle, why the others may not, and what can be put right.

A chip tells by its readings that it is not well: by values that no chip sends (not a number, out
of range, an impossible temperature), by values that only a failed read gives (the same count on
every axis, far from what it read before), by the end of its range, by a jump that nothing near a
magnet makes, by the bits of another chip or of an earlier frame, or by too little noise. A 16-bit
wrap is undone where continuity proves it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tactile_bus.instant import NS_PER_S, Instant
from tactiled.blocks import TaxelHealth
from tactiled.sensing.activity import Activity
from tactiled.sensing.copies import Copies, Twins
from tactiled.sensing.jumps import Jumps
from tactiled.sensing.layout import Layout
from tactiled.sensing.readings import BITS, Fault
from tactiled.sensing.scale import Scale, Scales
from tactiled.sensing.thermometers import Thermometers

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]
UInt8 = NDArray[np.uint8]

FROZEN_CYCLES = 3
"""Unchanged readings in a row before a taxel can be frozen, so that at low rates two equal
readings by chance do not condemn it (three 12-bit noisy components repeat once in 10^3)."""
FROZEN_BITS = 30.0
"""Bits that a run of repeated readings must be improbable by, as often as the board's chips repeat
themselves otherwise: coarse and quiet ones do so one time in three."""
MOST_REPEATED = 0.5
"""Share of repeated readings taken at most."""
LONG_RUN = 8
"""Repetitions of a run that count at most: a chip that was frozen says nothing of noise."""
REMEMBERED = 1e5
"""Readings after which earlier ones count half."""
NEAR_SIGMAS = 7.0
"""A reading within so many sigma of the one before may be noise."""
NOISE_UT = (4.4, 4.4, 6.7)
"""µT rms of one sample until it has been measured."""
Z_PER_XY = (1.595, 1.635)
"""Scale of z by that of x and y at any gain of an MLX90393; 1 of chips with one scale."""
TINY_UT = 20.0
"""µT, two counts of the coarsest scale: what minus one is at most."""
ALIKE_CYCLES = 4
"""Times that zero or minus one on every axis must be repeated by a chip that never read anything
else: at naught field, noise of a count gives it once in twenty readings."""
REVIVED_S = 1.0
"""A chip that could not be read for so long comes back as one whose rest may have changed."""
COPY_BITS = 30.0
"""Least information in a frame, bits, for a copy of one among `copies.KEPT` to be no chance."""

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
"""Faults that say nothing against the chip: it comes back as the same."""
_SICK: Bool = np.array([fault not in _WELL for fault in Fault])


class HealthMonitor:
    """Per-taxel health of a board, in constant memory.

    After `update`: ``fault``: (A, n) uint8 of `Fault`. ``revived``: (A, n) bool, taxels that are
    well again in this cycle after they were gone for `REVIVED_S` or went to another level: what
    was their rest need not be. ``restored``: those that had gone to another level and now read
    again what they did at rest.
    """

    def __init__(
        self,
        layout: Layout,
        frozen_after_s: float | None,
        range_limit_ut: float,
        rest_ut: Float | None = None,
    ) -> None:
        """``rest_ut``: (A, 3, n) µT in chip axes that an untouched chip reads; None: unknown."""
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
        """Forget what was read before; sizes of counts stay until they fit no more."""
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
        self._ailing = True  # the first cycle is looked at closely
        self.fault = self._clear
        self._jumps.reset()
        self._activity.reset()
        self._twins.reset()
        self._thermometers.reset()
        for copies in self._copies:
            copies.reset()

    def set_noise(self, noise_ut: Float) -> None:
        """Noise of one sample, (3,) µT rms in chip axes."""
        self._near = self._jumps.near = NEAR_SIGMAS * noise_ut[:, None]
        self._quiet = float(self._near.min())

    def set_rest(self, rest_ut: Float) -> None:
        """A tare has found what the untouched chips read: (A, 3, n) µT in chip axes."""
        self._rest = rest_ut
        self._jumps.accept_rest(rest_ut)

    def told(self, array: int, scale: Scale) -> None:
        """The board says what a count of ``array`` is: µT of x and y, of z."""
        if self.scales.told(array, scale):
            self._jumps.forget_wraps(array)

    def update(
        self,
        raw: Float,
        temperature_c: Float,
        status: UInt8,
        present: Bool,
        captured: Instant,
    ) -> UInt8:
        """(A, n) uint8 of `TaxelHealth` for one cycle.

        ``raw``: (A, 3, n) µT in chip axes. ``temperature_c``: (A, n). ``status``: (A, n), what the
        board said. ``present``: (A,) whether the array's block came at all. In both of the first,
        wraps are undone and what is not a plausible number is replaced, in place, by what the chip
        read before.
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
            or not float(np.abs(raw).max()) < scales.top
            or not self._thermometers.plain(temperature_c)
            or not (float(moved.max()) < self._quiet or self._is_motion(raw, moved))
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

    # What is looked at in every cycle

    def _repair(self, raw: Float) -> tuple[Bool, Bool] | None:
        """Put what was read before in place of what no chip can read, in ``raw``.

        (A, n) taxels that are not a number and that are beyond the range; None: there are none.
        """
        if float(np.abs(raw).max()) <= self._limit:
            return None
        strange: Bool = np.asarray(~np.isfinite(raw).all(axis=1))
        beyond: Bool = np.asarray((np.abs(raw) > self._limit).any(axis=1)) & ~strange
        np.copyto(raw, np.nan_to_num(self._last), where=(strange | beyond)[:, None])
        return strange, beyond

    def _is_motion(self, raw: Float, moved: Float) -> bool:
        """Whether steps beyond the noise are a contact's: small, and x and y not alike, as they
        are in failed reads.
        """
        if float(moved.max()) > self._jumps.least:
            return False
        return not np.count_nonzero((raw[:, 0] == raw[:, 1]) & (moved >= self._quiet))

    def _copied(self, raw: Float, moved: Float, present: Bool) -> Bool | None:
        """(A,) arrays whose frame is a copy of an earlier one; None: none is."""
        out: Bool | None = None
        for a, copies in enumerate(self._copies):
            if not present[a] or not copies.add(raw[a].tobytes()):
                continue
            # one that is just like the last may be chance, unless there is much noise
            if self._rich[a] or float(moved[a].max()) > self._quiet:
                out = np.zeros(len(present), bool) if out is None else out
                out[a] = True
        return out

    def _unchanging(
        self, unchanged: Bool, present: Bool, whole: bool, captured: Instant
    ) -> Bool | None:
        """(A, n) taxels that have repeated one reading for too long; None: none has."""
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
        changed = ~unchanged & present[:, None]  # an array that did not come did neither
        self._repeated += float(np.minimum(self._repeats[changed], LONG_RUN).sum())
        self._repeats[changed] = 0
        self._since[changed] = captured
        if self._frozen_after is None:
            return None
        frozen = (captured - self._since) >= self._frozen_after
        frozen &= self._repeats >= self._needed
        frozen &= present[:, None]
        return frozen if np.count_nonzero(frozen) else None

    # What is looked at where something caught the eye

    def _mark_flagged(
        self, fault: UInt8, status: UInt8, present: Bool, broken: tuple[Bool, Bool] | None
    ) -> None:
        """What did not come, is not a number, or is flagged by the board."""
        fault[~present] = Fault.MISSING
        if broken is not None:
            _mark(fault, broken[0], Fault.NOT_FINITE)
            _mark(fault, broken[1], Fault.BEYOND_RANGE)
        if np.count_nonzero(status):
            _mark(fault, (status & TaxelHealth.READ_FAILED) > 0, Fault.FAILED)
            _mark(fault, (status & TaxelHealth.SATURATED) > 0, Fault.SATURATED)
            _mark(fault, status > 0, Fault.STALE)

    def _mark_failed(self, fault: UInt8, raw: Float, sent: Float) -> None:
        """Failed reads: the same count on every axis; zero, minus one, or what an offset makes.

        Only where the chip read something else before: noise is not that alike.
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
        # from the start on: a chip without any field reads naught by chance, but not for long
        lasts = self._repeats >= ALIKE_CYCLES
        _mark(fault, zero & (far | lasts), Fault.ZEROS)
        _mark(fault, same & (far | (lasts & (np.abs(z) < TINY_UT))), Fault.ONES)

    def _mark_temperatures(self, fault: UInt8, temperature_c: Float, captured: Instant) -> None:
        impossible, jumped = self._thermometers.check(temperature_c, fault == 0, captured)
        if np.count_nonzero(impossible):
            _mark(fault, impossible, Fault.TEMPERATURE)
        if np.count_nonzero(jumped):
            _mark(fault, jumped, Fault.TEMPERATURE_JUMP)

    # What lasts

    def _recover(self, fault: UInt8, captured: Instant) -> None:
        """Note since when taxels are gone, and which are back."""
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

    def _end_block(self, raw: Float, fault: UInt8) -> None:
        """What is looked at four times a second."""
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
    """Note ``what`` for taxels of which nothing worse is known."""
    fault[where & (fault == 0)] = what
