"""The rest field while a pipeline runs: taring, tracking its drift, and checking it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

import msgspec
import numpy as np
from numpy.typing import NDArray

from tactile_core.arrays import FloatArray
from tactile_core.types import Instant, seconds_between
from tactiled.blocks import Reason
from tactiled.sensing import reasons as why
from tactiled.sensing.compensation import Estimate
from tactiled.sensing.consensus import PLANE_TAXELS
from tactiled.sensing.forces import ForceModel
from tactiled.sensing.layout import Layout
from tactiled.sensing.settings import PipelineSettings

# Taring: the reading of the untouched, still skin becomes its rest field.


Bool = NDArray[np.bool_]

MIN_CYCLES = 8
"""Fewest cycles of a tare: enough for the mean to have a third of one sample's noise, and to
measure that noise."""
MAX_WAIT_RATIO = 10.0
"""A tare still short of cycles after this many times its length is refused, ..."""
MAX_WAIT_CYCLES = 4 * MIN_CYCLES
"""... but not before this many came, complete or not: a slow board takes longer."""
STILL_SIGMAS = 6.0
"""Standard errors by which first and second half may differ before the skin counts as moving: with
240 channels chance alone gives 4."""
STILL_FLOOR_UT = 2.0
"""µT by which the halves may always differ: two LSB and slow thermal drift."""
NOISY_RATIO = 4.0
"""A channel that varies by more than this many times the expected noise is moving."""


@dataclass(frozen=True, slots=True, eq=False)
class TareReport:
    """Result of a tare, or why it was refused.

    ``shift_ut``: largest change of the rest field, µT. ``noise_ut``: (3,) measured noise, µT rms.
    """

    accepted: bool
    message: str
    cycles: int
    shift_ut: float
    noise_ut: FloatArray
    sequence: int


class Tare:
    """Running sums of one tare; constant memory. ``expected``: (3,) noise of one sample, µT rms."""

    def __init__(self, shape: tuple[int, ...], seconds: float, noise_ut: FloatArray) -> None:
        self._seconds = seconds
        self.expected = noise_ut
        self._start: Instant | None = None
        self._sums = np.zeros((2, *shape))
        self._squares = np.zeros(shape)
        self._pivot = np.zeros(shape)  # the first cycle: sums of differences from it stay precise
        self._counts = [0, 0]
        self._offered = 0
        self._healthy = np.ones((shape[0], shape[2]), dtype=bool)

    def again(self) -> Tare:
        """A new tare with the same settings."""
        return Tare(self._squares.shape, self._seconds, self.expected)

    @property
    def cycles(self) -> int:
        """Cycles taken so far."""
        return sum(self._counts)

    @property
    def mean(self) -> FloatArray:
        """Mean of the cycles taken, of which there must be one; (A, 3, n) µT."""
        mean: FloatArray = self._pivot + self._sums.sum(axis=0) / self.cycles
        return mean

    @property
    def healthy(self) -> Bool:
        """(A, n) whether a taxel was healthy in every cycle taken."""
        return self._healthy

    def add(self, field: FloatArray, healthy: Bool, whole: bool, captured: Instant) -> bool:
        """Add one cycle, unless an array is missing from it; True when the tare is over."""
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
        """Why the cycles taken do not give a rest field; None when they do."""
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

    def noise(self) -> FloatArray:
        """Noise of one sample in x, y, z, (3,) µT rms: median over taxels healthy throughout."""
        noise: FloatArray = np.median(self._spread().swapaxes(1, 2)[self._healthy], axis=0)
        return noise

    def _spread(self) -> FloatArray:
        total = self._sums.sum(axis=0)
        variance = (self._squares - total * total / self.cycles) / (self.cycles - 1)
        spread: FloatArray = np.sqrt(np.maximum(variance, 0.0))
        return spread


# The rest field as stored in a log, so that a later file of the log can be reprocessed alone.


class RecordedRest(msgspec.Struct, frozen=True):
    """A rest field in a log. ``rest_ut``: µT by array, axis and taxel, padded to the widest array.

    ``unrested``: taxels without a rest field. ``noise_ut``: noise of one sample by axis, µT rms.
    ``rough``: taken while the skin moved. ``bare``: taxels that have lost their magnet.
    ``rested_c``: temperature at which it was taken, °C by array and taxel; empty when unknown.
    """

    rest_ut: list[list[list[float]]]
    unrested: list[list[bool]]
    noise_ut: list[float]
    rough: bool = False
    bare: list[list[bool]] = []
    rested_c: list[list[float]] = []


# Checks of the rest field: changes that no contact can make.
#
# Each cycle is compared with the signatures of a skin that was lifted or exchanged, a lost magnet,
# a changed gain, and a jump of the field on all taxels at once. A match makes the rest field
# *suspect*; when the field returns to what it was, the suspicion is dropped.


BARE_UT = 130.0
"""µT, most that a chip without a magnet reads: the earth's 65, and as much from nearby magnets."""
MAGNET_UT = 400.0
"""µT of rest field above which there is a magnet over a chip."""
BARE_SHARE = 0.6
"""Share of the chips that must be without magnet for the skin to count as off."""
LOST_AFTER_S = 0.3
"""s that a single chip must read no magnet: a press may carry its field through zero."""
AT_ONCE = 0.6
"""Share of its rest field by which a chip that loses its magnet changes within `SCRAMBLE_S`."""
GONE_SHARE = 0.3
"""Most of its rest field, as a share, that a chip reads without its magnet: its neighbours' magnets
add a tenth."""
EARTH_UT = 150.0
"""µT; no turn of the arm changes the ambient field by more: the earth's 65 reversed, and noise."""
GAIN_STEP = 0.12
"""Smallest common relative change of all fields that counts as a change of gain: the finest step of
an MLX90393 is 20 %."""
GAIN_MISFIT = 0.1
"""Share of such a change that may remain unexplained."""
SCRAMBLE_UT = 100.0
"""µT by which every chip of a small array changes at once when its skin has moved."""
SCRAMBLE_S = 0.06
"""s that count as at once."""
SCRAMBLE_PULL = 0.4
"""Pull on some taxel, as a share of the largest press, that then shows it: a contact presses."""
SCRAMBLE_N = 0.5
"""N that this pull must exceed."""
BACK_N = 0.3
"""N per taxel within which a field counts as back at rest."""


class RestWatch:
    """Checks the rest field of one board; remembers one cycle and a few numbers."""

    def __init__(self, layout: Layout, model: ForceModel, names: Sequence[str]) -> None:
        self._layout, self._model, self._names = layout, model, names
        self._every = np.repeat(layout.real[:, None], 3, axis=1)
        self._few: list[int] = np.flatnonzero(layout.counts < PLANE_TAXELS).tolist()
        self._last: tuple[Instant, FloatArray] | None = None
        self._bare_since = np.full(layout.real.shape, -1, np.int64)
        self._gone = np.zeros_like(layout.real)
        self.off = False
        """Whether the board has no skin now, so that it must not be tared."""

    def reset(self) -> None:
        """Forget the last cycles: the stream has restarted or the rest field has changed."""
        self._last = None
        self._bare_since[:] = -1

    def regained(self, field: FloatArray, bare: Bool) -> Reason | None:
        """A reason when a taxel of ``bare`` (A, n) has a magnet again: the skin was changed."""
        reading = np.linalg.norm(field + self._model.rest, axis=1)
        least = np.maximum(MAGNET_UT, 2.0 * self._model.rest_size)
        if not (bare & (reading > least)).any():
            return None
        return why.field_jump(float(reading[bare].max()))

    def judge(
        self,
        field: FloatArray,
        forces: FloatArray,
        estimate: Estimate,
        healthy: Bool,
        captured: Instant,
    ) -> Reason | None:
        """Why the rest field is suspect in this cycle; None when it is not.

        ``field``: (A, 3, n) µT in taxel axes over rest, including the ambient field. ``forces``:
        (A, 3, n) N after compensation. ``healthy``: (A, n).
        """
        last, self._last = self._last, (captured, field.copy())
        self.off = False
        return (
            self._bare(field, healthy, captured, last)
            or self._jumped(estimate)
            or self._gain(field, healthy)
            or self._scrambled(field, forces, healthy, captured, last)
        )

    def restored(self, forces: FloatArray, estimate: Estimate, healthy: Bool) -> bool:
        """Whether the skin reads its rest field again: no taxel bears a force."""
        if estimate.leap.any() or (np.abs(estimate.theta[:, :, 0]) > EARTH_UT).any():
            return False
        free = (np.abs(forces).max(axis=1) < BACK_N) & healthy
        return bool((free | ~healthy).all())

    def _bare(
        self,
        field: FloatArray,
        healthy: Bool,
        captured: Instant,
        last: tuple[Instant, FloatArray] | None,
    ) -> Reason | None:
        strong = self._model.rest_size
        chips = healthy & (self._model.rest_squared > MAGNET_UT**2)
        reading = ((field + self._model.rest) ** 2).sum(axis=1)
        fallen = self._lost_field(field, reading, strong, chips, captured, last)
        bare = chips & (reading < BARE_UT**2)
        if not (np.count_nonzero(bare) or np.count_nonzero(fallen)):
            self._bare_since[:] = -1
            return None
        begun = bare & (self._bare_since < 0)
        self._bare_since[begun] = captured
        self._bare_since[~bare] = -1
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

    def _lost_field(
        self,
        field: FloatArray,
        reading: FloatArray,
        strong: FloatArray,
        chips: Bool,
        captured: Instant,
        last: tuple[Instant, FloatArray] | None,
    ) -> Bool:
        """(A, n) chips that have lost most of their field at once, which no press does."""
        if last is None or seconds_between(last[0], captured) > SCRAMBLE_S:
            return np.zeros_like(chips)
        low: Bool = chips & (reading < (GONE_SHARE * strong) ** 2)
        if not np.count_nonzero(low):
            return low
        step = np.linalg.norm(field - last[1], axis=1)
        return np.asarray(low & (strong > 2 * MAGNET_UT) & (step > AT_ONCE * strong))

    def lost(self, before: FloatArray) -> Bool:
        """(A, n) taxels whose magnet is gone, from the rest fields ``before`` (A, 3, n) and now."""
        magnet = (before**2).sum(axis=1) > MAGNET_UT**2
        low = self._model.rest_squared < BARE_UT**2
        gone, self._gone = self._gone, np.zeros_like(self._gone)
        return np.asarray(magnet & (low | gone))

    def covered(self) -> Bool:
        """(A, n) taxels whose present rest field is as large as a magnet's."""
        return np.asarray(self._model.rest_squared > 4 * MAGNET_UT**2)

    def _jumped(self, estimate: Estimate) -> Reason | None:
        size = float(estimate.leap.max())
        if size == 0.0:
            sizes = np.linalg.norm(estimate.theta[:, :, 0], axis=1) * estimate.ambient.valid
            size = float(sizes.max())
            if size <= EARTH_UT:
                return None
        return why.field_jump(size)

    def _gain(self, field: FloatArray, healthy: Bool) -> Reason | None:
        rest = self._model.rest
        use = self._every
        if healthy is not self._layout.real:
            use = np.broadcast_to(healthy[:, None], rest.shape)
        known = rest[use]
        there = float((known**2).sum())
        if there == 0.0 or there < np.count_nonzero(healthy) * MAGNET_UT**2:
            return None
        gain = float((known * field[use]).sum()) / there
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
        field: FloatArray,
        forces: FloatArray,
        healthy: Bool,
        captured: Instant,
        last: tuple[Instant, FloatArray] | None,
    ) -> Reason | None:
        if last is None or seconds_between(last[0], captured) > SCRAMBLE_S:
            return None
        if not self._few:
            return None
        moved = np.linalg.norm(field - last[1], axis=1)
        for a in self._few:
            use = healthy[a]
            if use.sum() < 3 or (moved[a][use] < SCRAMBLE_UT).any():
                continue
            normal = -forces[a, 2][use]
            pull, press = -float(normal.min()), float(normal.max())
            if pull > SCRAMBLE_N and pull > SCRAMBLE_PULL * press:
                return why.field_jump(float(np.median(moved[a][use])))
        return None


# Chips that came late get their rest field once the skin is untouched and still.


class LateRest:
    """Averages the readings of chips without a rest field over ``seconds``."""

    def __init__(self, seconds: float) -> None:
        self._seconds = seconds
        self._tare: Tare | None = None
        self._wanted: Bool | None = None

    def forget(self) -> None:
        """Drop the average: something moved, or no chip lacks its rest field."""
        self._tare = self._wanted = None

    def advance(
        self, left_over: FloatArray, wanted: Bool, noise_ut: FloatArray, captured: Instant
    ) -> FloatArray | None:
        """Add one untouched cycle; returns (A, 3, n) µT to add to the rest field, or None yet.

        ``left_over``: (A, 3, n) µT over the present rest field, ambient field removed.
        ``wanted``: (A, n) healthy taxels without a rest field; a change restarts the average.
        ``noise_ut``: (3,) noise of one sample, µT rms.
        """
        if self._tare is None or self._wanted is None or (self._wanted != wanted).any():
            self._tare = Tare(left_over.shape, self._seconds, noise_ut)
            self._wanted = wanted
        if not self._tare.add(left_over, wanted, True, captured):
            return None
        tare, self._tare = self._tare, None
        if tare.trouble() is not None:
            return None
        return np.where(wanted[:, None], tare.mean, 0.0)


ROUGH_ATTEMPTS = 3
"""Refused tares after which a board without a rest field gets a rough one all the same, so that a
skin that is always touched shows something, marked as rough."""


SUSPECT_TARE_S = 1.0
"""s, least length of the tare of a suspect skin."""


UNRECOVERED_SHARE = 0.06
"""Share of an array's recent peak that a released skin may still read: measured on eFlesh boards,
89 to 178 µT of 3.9 mT."""
PEAK_MEMORY_S = 60.0
"""s, time constant with which that peak decays."""
RECOVERY_S = 2.0
"""s, time constant with which the rest field then tracks."""
STILL_TAU_S = 0.7
"""s, time constant of the mean that a still skin stays close to."""
STILL_UT = 4.0
"""µT rms by which a still skin may deviate from it, besides the chips' noise."""


class Recovery:
    """Lets the rest field of small arrays track a skin that was pressed and released.

    Rubber returns to within a few per cent of its peak at once and takes minutes for the rest; on
    a few chips that reads as a contact of newtons. A still skin that reads no more than that share
    of its recent peak is taken to be at rest.
    """

    def __init__(self, layout: Layout) -> None:
        self._small = layout.counts < PLANE_TAXELS
        self.any = bool(self._small.any())
        """Whether the board has such arrays."""
        self.reset(layout)

    def reset(self, layout: Layout) -> None:
        """Forget the peaks."""
        self._peak = np.zeros(layout.arrays)
        self._mean = np.zeros((layout.arrays, 3, layout.width))

    def step(
        self, left_over: FloatArray, healthy: Bool, noise_ut: float, elapsed: float
    ) -> FloatArray | None:
        """Change of the rest field in one cycle, (A, 3, n) µT, or None.

        ``left_over``: (A, 3, n) µT in taxel axes after compensation. ``noise_ut``: µT rms.
        """
        size = np.where(healthy, np.linalg.norm(left_over, axis=1), 0.0).max(axis=1)
        self._peak = np.maximum(size, self._peak * math.exp(-elapsed / PEAK_MEMORY_S))
        away = left_over - self._mean
        self._mean += -math.expm1(-elapsed / STILL_TAU_S) * away
        spread = np.sqrt((away**2).mean(axis=1) * healthy)
        still = (spread < 2.5 * noise_ut + STILL_UT).all(axis=1)
        low = (size < UNRECOVERED_SHARE * self._peak) & (size > 2.0 * noise_ut)
        follow = self._small & still & low
        if not follow.any():
            return None
        share = -math.expm1(-elapsed / RECOVERY_S)
        use = follow[:, None] & healthy
        return np.where(use[:, None], share * self._mean, 0.0)


class RestState(Enum):
    """State of the rest field."""

    UNKNOWN = "unknown"
    TARING = "taring"
    KNOWN = "known"
    SUSPECT = "suspect"


class RestField:
    """Owns `ForceModel.rest` and sets it from tares.

    ``known``: there is a rest field. ``rough``: it was taken while the skin moved, so features are
    not valid. ``suspicion``: why it may be wrong; features are then not valid, and it is taken
    anew once the skin is still. ``unrested``: (A, n) bool, taxels without one.
    """

    def __init__(
        self, layout: Layout, model: ForceModel, settings: PipelineSettings, known: bool
    ) -> None:
        self._layout, self._model, self._settings = layout, model, settings
        self.known = known
        self.rough = False
        self.unrested: Bool = np.zeros_like(layout.real) if known else layout.real.copy()
        self.suspicion: Reason | None = None
        self.report: TareReport | None = None
        self._tare: Tare | None = None
        self._forced = False
        self.bare: Bool = np.zeros_like(layout.real)
        """(A, n) taxels without a magnet, which measure no force."""
        self._recovery = Recovery(layout)
        self._peak = 0.0
        self._refused = 0

    @property
    def taring(self) -> bool:
        """Whether a tare is under way."""
        return self._tare is not None

    @property
    def _first(self) -> bool:
        """Whether there is no good rest field, so that a contact cannot be told."""
        return not self.known or self.rough or self.suspicion is not None

    @property
    def state(self) -> RestState:
        """State of the rest field."""
        if self.suspicion is not None:
            return RestState.SUSPECT
        if self.taring:
            return RestState.TARING
        return RestState.KNOWN if self.known and not self.rough else RestState.UNKNOWN

    def begin(self, noise_ut: FloatArray, force: bool = False) -> None:
        """Begin a tare. ``noise_ut``: expected noise of one sample, (3,) µT rms.

        ``force``: take the reading as the rest field even when moving or under load.
        """
        seconds = self._settings.tare_s
        if self.suspicion is not None and not force:
            seconds = max(seconds, SUSPECT_TARE_S)
        self._tare = self._make(seconds, noise_ut)
        self._peak = 0.0
        self._refused = 0
        self._forced = force

    def suspect(self, reason: Reason, noise_ut: FloatArray) -> None:
        """Mark the rest field as suspect; it is taken anew once the skin is still."""
        if self.suspicion is None:
            self.suspicion = reason
            if self._tare is None:
                self.begin(noise_ut)

    def clear_suspicion(self) -> None:
        """Drop the suspicion: the skin reads its rest field again."""
        self.suspicion = None
        self._tare = None

    def forget(self) -> None:
        """Drop the rest field: the skin or the board may have been exchanged."""
        self.known, self.rough, self.suspicion = False, False, None
        self.unrested = self._layout.real.copy()

    def _make(self, seconds: float, noise_ut: FloatArray) -> Tare:
        return Tare((self._layout.arrays, 3, self._layout.width), seconds, noise_ut)

    def restore(self, rest_ut: FloatArray, unrested: Bool, rough: bool) -> None:
        """Use a recorded rest field, (A, 3, n) µT; ``unrested``: (A, n) bool."""
        self._model.rest = rest_ut.copy()
        self.unrested[:] = unrested
        self.known, self.rough = True, rough
        self._tare = None

    @property
    def rest_ut(self) -> FloatArray:
        """The rest field in use, (A, 3, n) µT in taxel axes."""
        return self._model.rest

    def note_peak(self, newton: float) -> None:
        """Note the largest force of a taxel in this cycle, N, to refuse a tare under load."""
        self._peak = max(self._peak, newton)

    def advance(
        self, field: FloatArray, healthy: Bool, whole: bool, captured: Instant, sequence: int
    ) -> FloatArray | None:
        """Add one cycle to the tare under way.

        ``field``: (A, 3, n) µT over the rest field in use. Returns the change of the rest field,
        (A, 3, n) µT, when this cycle ends the tare and it is accepted; else None.
        """
        tare = self._tare
        if tare is None or not tare.add(field, healthy, whole, captured):
            return None
        averaged = self._forced and tare.cycles and tare.healthy.any()
        trouble = None if averaged else tare.trouble()
        limit = self._settings.tare_limit_n
        if trouble is None and not (self._first or self._forced) and self._peak > limit:
            trouble = (
                f"a taxel bears {self._peak:.1f} N, more than the {limit:g} N that drift may look "
                "like: lift the skin off everything, or force the tare"
            )
        self._tare = None
        if trouble is None:
            return self._accept(tare, sequence)
        self._refused += 1
        rough = self.suspicion is None and self._first and self._refused >= ROUGH_ATTEMPTS
        if rough and tare.cycles:
            return self._accept(tare, sequence, trouble)
        message = f"tare refused: {trouble}"
        self.report = TareReport(False, message, tare.cycles, 0.0, tare.expected, sequence)
        if self._first:
            self._tare = tare.again()
        return None

    @property
    def recovers(self) -> bool:
        """Whether the board has arrays whose release is tracked."""
        return self._recovery.any

    def track_release(
        self, left_over: FloatArray, healthy: Bool, noise_ut: float, elapsed: float
    ) -> None:
        """Track a skin that was released; see `Recovery.step`."""
        change = self._recovery.step(left_over, healthy, noise_ut, elapsed)
        if change is not None:
            self._model.rest = self._model.rest + change

    def track(self, left_over: FloatArray, free: Bool, share: float) -> None:
        """Move the rest field of ``free`` (A, n) taxels by a share of what compensation left."""
        self._model.rest = self._model.rest + np.where(free[:, None], share * left_over, 0.0)

    def _accept(self, tare: Tare, sequence: int, trouble: str | None = None) -> FloatArray:
        shift = np.where(tare.healthy[:, None], tare.mean, 0.0)
        self._model.rest = self._model.rest + shift
        largest = float(np.abs(shift).max())
        left = self._layout.real & ~tare.healthy
        self.unrested &= left
        message = f"tared over {tare.cycles} cycles: rest field {self._moved(largest)}"
        if self._forced:
            message += ", as forced"
        if left.any():
            fate = "stay masked" if self.unrested.any() else "keep theirs"
            message += f"; {int(left.sum())} unhealthy taxels {fate}"
        if trouble is not None:
            message += f"; rough, for {trouble}; tare again when it is still"
        self.known, self.rough, self.suspicion = True, trouble is not None, None
        self._forced = False
        self._recovery.reset(self._layout)
        noise = tare.expected if self.rough else tare.noise()
        self.report = TareReport(True, message, tare.cycles, largest, noise, sequence)
        return shift

    def _moved(self, largest: float) -> str:
        if self.suspicion is not None:
            return f"taken anew ({self.suspicion.code})"
        return f"moved by up to {largest:.1f} µT" if self.known else "set"
