"""AnySkin, ReSkin and eFlesh boards: n × (float32 t °C, x, y, z µT), then CR LF, and no more.

The frames carry no header, check or sequence: their boundary is inferred (`anyskin_search`) and
doubted again when it stops to fit.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from sensor_proto.layouts import (
    COLDEST_C,
    HOTTEST_C,
    TINY_C,
    evidence,
    plausible,
    temperature_first,
)
from sensor_proto.packets import (
    ACCEPTED,
    FloatBurst,
    FloatSamples,
    Received,
    Reject,
    Tally,
    TaxelStatus,
)

# Where the frames of an unframed float stream begin, and how many magnetometers they hold.
#
# CR LF ends every frame but occurs inside the floats as well, so that it is trusted only at the
# right distance and together with temperatures that a chip can have. Among overlapping claims the
# better supported wins. All claims of one search are judged at once: noise full of CR LF is cheap.


MAX_MAGNETOMETERS = 20
"""Four boards of five on one controller, the largest assembly on sale."""

LOCK_FRAMES = 3
"""Consecutive frames that must fit before a count of magnetometers is believed."""

SURE_FRAMES = 8
"""Frames that show whether a column moves as a temperature does."""

READING = 16
"""Bytes of one magnetometer: t, x, y, z as float32."""

END = b"\r\n"
FLOAT = np.dtype("<f4")

AFTER_END = 0.04
"""Worth of CR LF right before a frame: decides only between claims whose temperatures are equally
good, of which the least difference is one in twenty."""

Flags = NDArray[np.bool_]


def frame_size(magnetometers: int) -> int:
    """Bytes of one frame."""
    return READING * magnetometers + len(END)


class Search:
    """One look at the bytes since the last frame (or since the beginning)."""

    def __init__(self, data: bytes) -> None:
        values = np.frombuffer(data, np.uint8)
        self._size = len(data)
        self._mark = np.zeros(self._size, dtype=np.bool_)
        if self._size > 1:
            self._mark[:-1] = (values[:-1] == END[0]) & (values[1:] == END[1])
        self._ends = np.flatnonzero(self._mark)
        self._values = values

    def known(self, count: int) -> int | None:
        """Start of the first frame of ``count`` magnetometers after a lost boundary.

        One frame is enough when all of its temperatures are plausible, or more than that.
        """
        return self._first(count, 2)

    def new(self, counts: Iterable[int]) -> tuple[int, int] | None:
        """Start of the first of `LOCK_FRAMES` consecutive frames, and their magnetometers."""
        if not len(self._ends) or not self._warm.any():
            return None
        for count in counts:
            start = self._first(count, LOCK_FRAMES)
            if start is None:
                continue
            sure = self._sure(start, count)
            if sure:
                return start, count
            if sure is None:
                return None
        return None

    def _sure(self, start: int, count: int) -> bool | None:
        """Whether what stands where t should be is a temperature; None: more must come to tell.

        Fields of a bare board are as small as temperatures. Then numbers in the order x, y, z, t
        would pass for t, x, y, z, and so would four chips without temperatures for three with.
        """
        size = frame_size(count)
        whole = 0
        while whole < SURE_FRAMES and start + (whole + 1) * size <= self._size:
            if not self._mark[start + (whole + 1) * size - len(END)]:
                break
            whole += 1
        raw = self._values[start : start + whole * size].reshape(whole, size)
        values = raw[:, : -len(END)].copy().view(FLOAT).reshape(whole, count, 4)
        if temperature_first(values) is False:
            return False
        if count % 3:
            return True
        first = evidence(values, 0)
        if first.sure:
            return True
        return None if first.likely and whole < SURE_FRAMES else False

    def _first(self, count: int, depth: int) -> int | None:
        """Best supported of the first claims that overlap; None while support may yet come."""
        size = frame_size(count)
        starts = self._ends + len(END) - size
        starts = starts[(starts >= 0) & (starts + depth * size <= self._size)]
        known = depth < LOCK_FRAMES
        fits = np.ones(len(starts), dtype=np.intp)
        for nth in range(1, depth):
            fits += (fits == nth) & self._mark[starts + (nth + 1) * size - len(END)]
        if not known:
            starts, fits = starts[fits == depth], fits[fits == depth]
        if not len(starts):
            return None
        shares = self._shares(starts, count, depth)
        after_end = (starts >= len(END)) & self._mark[starts - len(END)]
        if known:
            # What comes before was taken up to the end of a frame.
            after_end |= starts == 0
        likely = np.where(np.arange(depth) < fits[:, None], shares, 0.0).sum(axis=1) / fits
        score = fits + likely + AFTER_END * after_end
        if known:
            enough = (fits > 1) | (likely == 1.0) | (after_end & (likely > 0.5))
        else:
            enough = shares.min(axis=1) > 0.5
        # Part of a damaged frame can end like a whole one; its first readings give it away.
        enough &= after_end | (shares[:, 0] == 1.0)
        chosen = np.flatnonzero(enough)
        if not len(chosen):
            return None
        rivals = chosen[starts[chosen] < starts[chosen[0]] + size]
        best = int(starts[rivals[score[rivals].argmax()]])
        return best if best + (depth + 1) * size <= self._size else None

    @cached_property
    def _warm(self) -> Flags:
        """(bytes,): whether the float that begins there is a plausible temperature."""
        words = np.zeros(self._size, dtype="<u4")
        whole = max(0, self._size - 3)
        for byte in range(4):
            words[:whole] |= self._values[byte : whole + byte].astype("<u4") << np.uint32(8 * byte)
        with np.errstate(invalid="ignore"):
            warm = plausible(words.view(FLOAT))
        warm[whole:] = False
        return warm

    def _shares(self, starts: NDArray[np.intp], count: int, depth: int) -> NDArray[np.float64]:
        """Share of plausible temperatures in each of ``depth`` frames from each start."""
        nth = np.arange(depth)[:, None] * frame_size(count) + np.arange(count) * READING
        shares: NDArray[np.float64] = self._warm[starts[:, None, None] + nth].mean(axis=2)
        return shares


SUSPECT_FRAMES = 3
"""Consecutive frames with mostly impossible temperatures after which the boundary is doubted."""

RELOCK_FRAMES = 8
"""Frames' worth of bytes without a boundary after which another count is tried."""

MAX_BUFFER = RELOCK_FRAMES * frame_size(MAX_MAGNETOMETERS)
"""Bytes held while looking for a boundary: enough to try another count after the longest frames,
and twice what shows `LOCK_FRAMES` of them wherever they begin."""

PIECE = 4096
"""Bytes taken at a time, as many as a pty returns at once: bounds the work of one search."""

MAX_FIELD_UT = 1e6
"""No int16 count times the coarsest scale of the chip (9.7 µT) comes near this."""


def encode_anyskin(samples: FloatSamples) -> bytes:
    """One frame; ValueError unless 1 to 20 magnetometers with a temperature each."""
    n = len(samples.temperature_c)
    if not 1 <= n <= MAX_MAGNETOMETERS or samples.field_ut.shape != (n, 3):
        raise ValueError(
            f"field {samples.field_ut.shape}, temperature {samples.temperature_c.shape}: "
            f"(n, 3) and (n,), n 1 to {MAX_MAGNETOMETERS}"
        )
    values = np.column_stack([samples.temperature_c, samples.field_ut])
    return values.astype(FLOAT).tobytes() + END


class AnySkinDecoder:
    """Unframed floats to `FloatSamples`; finds the number of magnetometers unless it is given."""

    def __init__(self, magnetometers: int | None = None) -> None:
        if magnetometers is not None and not 1 <= magnetometers <= MAX_MAGNETOMETERS:
            raise ValueError(f"{magnetometers} magnetometers: 1 to {MAX_MAGNETOMETERS}")
        self._given = magnetometers
        self._tally = Tally((Reject.LOST_LOCK, Reject.DISCARDED_BYTES))
        self.reset()

    @property
    def magnetometers(self) -> int | None:
        """Count that frames were last locked on; None before the first lock."""
        return self._count

    @property
    def counters(self) -> dict[str, int]:
        """Frames accepted, times the boundary was lost, bytes that belonged to no frame."""
        return self._tally.snapshot()

    def reset(self) -> None:
        """Forget boundary, count and unfinished input: another board may follow."""
        self._buffer = b""
        self._count: int | None = None
        self._locked = False
        self._suspect = 0

    def feed(self, data: bytes, /) -> list[Received]:
        """Frames that ``data`` completed; on a fresh lock also those held back until then.

        ``trailing`` of frames held back is at most the length of ``data``.
        """
        # Iterating over arrays makes the views of single frames at half the cost of indexing.
        return [
            Received(FloatSamples(field_ut, temperature_c, bits), 0, after)
            for burst in self.feed_bursts(data)
            for field_ut, temperature_c, bits, after in zip(
                burst.values[:, :, 1:],
                burst.values[:, :, 0],
                burst.status,
                burst.trailing,
                strict=True,
            )
        ]

    def feed_bursts(self, data: bytes, /) -> list[FloatBurst]:
        """Same frames as `feed`, as arrays: a tenth of the cost where many come at once."""
        bursts: list[FloatBurst] = []
        size = len(data)
        for begin in range(0, size, PIECE):
            self._feed(data[begin : begin + PIECE], size, max(0, size - begin - PIECE), bursts)
        return bursts

    def _feed(self, piece: bytes, fed: int, later: int, bursts: list[FloatBurst]) -> None:
        """Take one piece; ``fed``: bytes of the whole chunk, ``later``: those after the piece."""
        buffer = self._buffer + piece
        at = 0
        while True:
            if self._locked:
                at += self._take(buffer, at, later, fed, bursts)
                if self._locked:
                    break
            found = self._search(buffer[at:])
            if found is None:
                surplus = len(buffer) - at - MAX_BUFFER
                if surplus > 0:
                    self._tally[Reject.DISCARDED_BYTES] += surplus
                    at += surplus
                break
            skipped, self._count = found
            self._tally[Reject.DISCARDED_BYTES] += skipped
            at += skipped
            self._locked = True
            self._suspect = 0
        self._buffer = buffer[at:]

    def _search(self, data: bytes) -> tuple[int, int] | None:
        """Start of a frame in ``data`` and its magnetometers; None: wait for more."""
        search = Search(data)
        if self._count is not None:
            start = search.known(self._count)
            if start is not None:
                return start, self._count
            if len(data) < RELOCK_FRAMES * frame_size(self._count):
                return None
        counts = range(1, MAX_MAGNETOMETERS + 1) if self._given is None else (self._given,)
        return search.new(counts)

    def _take(self, buffer: bytes, at: int, later: int, fed: int, bursts: list[FloatBurst]) -> int:
        """Append the frames from ``at`` on, and unlock where they cease to fit; bytes taken."""
        n = self._count or 0
        size = frame_size(n)
        whole = (len(buffer) - at) // size
        if not whole:
            return 0
        raw = np.frombuffer(buffer, np.uint8, whole * size, at).reshape(whole, size)
        fitting = whole
        if whole > 1 or not buffer.startswith(END, at + size - len(END)):
            ends = (raw[:, -2] == END[0]) & (raw[:, -1] == END[1])
            if not ends.all():
                fitting = int(ends.argmin())
                self._locked = False
                self._tally[Reject.LOST_LOCK] += 1
                if not fitting:
                    return 0
        values = raw[:fitting, : -len(END)].copy().view(FLOAT).reshape(fitting, n, 4)
        if _all_good(values):
            self._suspect = 0
            status = np.zeros((fitting, n), dtype=np.uint8)
        else:
            fitting = self._trusted(values[:, :, 0])
            status = _status(values[:fitting])
        values.flags.writeable = status.flags.writeable = False
        self._tally[ACCEPTED] += fitting
        first = len(buffer) - at - size + later
        trailing: Sequence[int] = range(first, first - fitting * size, -size)
        if first > fed:
            trailing = [min(after, fed) for after in trailing]
        bursts.append(FloatBurst(values[:fitting], status[:fitting], trailing))
        return fitting * size

    def _trusted(self, temperature_c: NDArray[np.float32]) -> int:
        """Frames up to the one, if any, at which (k, n) °C put the boundary in doubt."""
        with np.errstate(invalid="ignore"):
            likely = plausible(temperature_c).mean(axis=1) >= 0.5
        for i, good in enumerate(likely.tolist()):
            self._suspect = 0 if good else self._suspect + 1
            if self._suspect >= SUSPECT_FRAMES:
                self._locked = False
                return i + 1
        return len(likely)


def _all_good(values: NDArray[np.float32]) -> bool:
    """Whether no reading of (k, n, 4) needs a closer look; False for any NaN."""
    temperature_c = values[:, :, 0]
    return bool(
        temperature_c.min() >= TINY_C
        and temperature_c.max() <= HOTTEST_C
        and np.abs(values).max() <= MAX_FIELD_UT
    )


def _status(values: NDArray[np.float32]) -> NDArray[np.uint8]:
    """(k, n) of `TaxelStatus` for readings (k, n, 4) of t, x, y, z."""
    with np.errstate(invalid="ignore"):
        temperature_c, field_ut = values[:, :, 0], values[:, :, 1:]
        good = (temperature_c >= COLDEST_C) & (temperature_c <= HOTTEST_C)
        good &= (np.abs(field_ut) <= MAX_FIELD_UT).all(axis=2)
    return np.where(good, TaxelStatus.OK, TaxelStatus.READ_FAILED).astype(np.uint8)
