"""Frames of AnySkin, ReSkin and eFlesh boards: n × (float32 t in °C, x, y, z in µT), then CR LF.

The frames have no header, check or sequence number, so the decoder infers where they begin (see
`Search`) and searches again when the data stops fitting.
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

# Search for the frame boundary and the number of magnetometers in an unframed float stream.
#
# CR LF ends every frame but also occurs inside the floats. It is trusted only at the right distance
# and where the temperatures are plausible for the chip. Among overlapping candidates the better
# supported one wins. All candidates of one search are judged at once, so that noise full of CR LF
# stays cheap.


MAX_MAGNETOMETERS = 20
"""Largest assembly on sale: four boards of five magnetometers on one controller."""

LOCK_FRAMES = 3
"""Consecutive frames that must fit before a number of magnetometers is accepted."""

SURE_FRAMES = 8
"""Frames needed to tell whether a column varies as slowly as a temperature."""

READING = 16
"""Bytes of one magnetometer: t, x, y, z as float32."""

END = b"\r\n"
FLOAT = np.dtype("<f4")

AFTER_END = 0.04
"""Score for a CR LF right before a frame. It only breaks ties: the temperature scores of two
candidates differ by at least 1/20."""

Flags = NDArray[np.bool_]


def frame_size(magnetometers: int) -> int:
    """Size of one frame in bytes."""
    return READING * magnetometers + len(END)


class Search:
    """One search for a frame boundary in the bytes received since the last frame."""

    def __init__(self, data: bytes) -> None:
        values = np.frombuffer(data, np.uint8)
        self._size = len(data)
        self._mark = np.zeros(self._size, dtype=np.bool_)
        if self._size > 1:
            self._mark[:-1] = (values[:-1] == END[0]) & (values[1:] == END[1])
        self._ends = np.flatnonzero(self._mark)
        self._values = values

    def known(self, count: int) -> int | None:
        """Offset of the first frame of ``count`` magnetometers after the boundary was lost.

        One frame is enough if all its temperatures are plausible, or most of them are and it
        directly follows the end of a frame.
        """
        return self._first_frame(count, 2)

    def new(self, counts: Iterable[int]) -> tuple[int, int] | None:
        """Offset of the first of `LOCK_FRAMES` consecutive frames, and their magnetometers."""
        if not len(self._ends) or not self._plausible_at.any():
            return None
        for count in counts:
            start = self._first_frame(count, LOCK_FRAMES)
            if start is None:
                continue
            sure = self._column_is_temperature(start, count)
            if sure:
                return start, count
            if sure is None:
                return None
        return None

    def _column_is_temperature(self, start: int, count: int) -> bool | None:
        """Whether the first column holds temperatures; None when more data is needed to tell.

        The fields of a bare board are as small as temperatures. Data in the order x, y, z, t could
        then pass for t, x, y, z, and four chips without temperatures for three chips with them.
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

    def _first_frame(self, count: int, depth: int) -> int | None:
        """Best supported of the first overlapping candidates; None when more data may change it."""
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
        shares = self._plausible_shares(starts, count, depth)
        after_end = (starts >= len(END)) & self._mark[starts - len(END)]
        if known:
            # The bytes before were consumed up to the end of a frame.
            after_end |= starts == 0
        likely = np.where(np.arange(depth) < fits[:, None], shares, 0.0).sum(axis=1) / fits
        score = fits + likely + AFTER_END * after_end
        if known:
            enough = (fits > 1) | (likely == 1.0) | (after_end & (likely > 0.5))
        else:
            enough = shares.min(axis=1) > 0.5
        # The tail of a damaged frame can end like a whole one, but its first readings are
        # implausible.
        enough &= after_end | (shares[:, 0] == 1.0)
        chosen = np.flatnonzero(enough)
        if not len(chosen):
            return None
        rivals = chosen[starts[chosen] < starts[chosen[0]] + size]
        best = int(starts[rivals[score[rivals].argmax()]])
        return best if best + (depth + 1) * size <= self._size else None

    @cached_property
    def _plausible_at(self) -> Flags:
        """(bytes,): whether the float that starts at each byte is a plausible temperature."""
        words = np.zeros(self._size, dtype="<u4")
        whole = max(0, self._size - 3)
        for byte in range(4):
            words[:whole] |= self._values[byte : whole + byte].astype("<u4") << np.uint32(8 * byte)
        with np.errstate(invalid="ignore"):
            warm = plausible(words.view(FLOAT))
        warm[whole:] = False
        return warm

    def _plausible_shares(
        self, starts: NDArray[np.intp], count: int, depth: int
    ) -> NDArray[np.float64]:
        """Fraction of plausible temperatures in each of the ``depth`` frames after each start."""
        nth = np.arange(depth)[:, None] * frame_size(count) + np.arange(count) * READING
        shares: NDArray[np.float64] = self._plausible_at[starts[:, None, None] + nth].mean(axis=2)
        return shares


SUSPECT_FRAMES = 3
"""Consecutive frames with mostly implausible temperatures after which the boundary is searched
again."""

RELOCK_FRAMES = 8
"""Bytes without a boundary, in frames, after which another number of magnetometers is tried."""

MAX_BUFFER = RELOCK_FRAMES * frame_size(MAX_MAGNETOMETERS)
"""Most bytes held while searching: enough to try another count after the longest frames, and twice
what `LOCK_FRAMES` of them need wherever they begin."""

PIECE = 4096
"""Bytes processed at a time (a pty returns at most as many). Bounds the work of one search."""

MAX_FIELD_UT = 1e6
"""Field limit in µT: above any int16 count times the chip's coarsest scale (9.7 µT)."""


def encode_anyskin(samples: FloatSamples) -> bytes:
    """Encode one frame.

    Raises ValueError unless it has 1 to 20 magnetometers, each with a temperature.
    """
    n = len(samples.temperature_c)
    if not 1 <= n <= MAX_MAGNETOMETERS or samples.field_ut.shape != (n, 3):
        raise ValueError(
            f"field {samples.field_ut.shape}, temperature {samples.temperature_c.shape}: "
            f"(n, 3) and (n,), n 1 to {MAX_MAGNETOMETERS}"
        )
    values = np.column_stack([samples.temperature_c, samples.field_ut])
    return values.astype(FLOAT).tobytes() + END


class AnySkinDecoder:
    """Decodes an unframed float stream to `FloatSamples`.

    It infers the number of magnetometers unless ``magnetometers`` gives it.
    """

    def __init__(self, magnetometers: int | None = None) -> None:
        if magnetometers is not None and not 1 <= magnetometers <= MAX_MAGNETOMETERS:
            raise ValueError(f"{magnetometers} magnetometers: 1 to {MAX_MAGNETOMETERS}")
        self._given = magnetometers
        self._tally = Tally((Reject.LOST_LOCK, Reject.DISCARDED_BYTES))
        self.reset()

    @property
    def magnetometers(self) -> int | None:
        """Number of magnetometers of the last lock; None before the first lock."""
        return self._count

    @property
    def counters(self) -> dict[str, int]:
        """Frames accepted, times the boundary was lost, and bytes that belonged to no frame."""
        return self._tally.snapshot()

    def reset(self) -> None:
        """Forget the boundary, the count and unfinished input, as another board may follow."""
        self._buffer = b""
        self._count: int | None = None
        self._locked = False
        self._suspect = 0

    def feed(self, data: bytes, /) -> list[Received]:
        """Frames completed by ``data``. The first call after a lock also returns the frames held
        back.

        ``trailing`` of frames held back is at most the length of ``data``.
        """
        # Iterating over the arrays creates the views of single frames at half the cost of indexing.
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
        """Return the same frames as `feed`, as arrays: a tenth of the cost for many at once."""
        bursts: list[FloatBurst] = []
        size = len(data)
        for begin in range(0, size, PIECE):
            self._feed(data[begin : begin + PIECE], size, max(0, size - begin - PIECE), bursts)
        return bursts

    def _feed(self, piece: bytes, fed: int, later: int, bursts: list[FloatBurst]) -> None:
        """Process one piece.

        ``fed``: bytes of the whole chunk; ``later``: those of them after the piece.
        """
        buffer = self._buffer + piece
        at = 0
        while True:
            if self._locked:
                at += self._append_frames(buffer, at, later, fed, bursts)
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
        """Offset of a frame in ``data`` and its magnetometers; None to wait for more data."""
        search = Search(data)
        if self._count is not None:
            start = search.known(self._count)
            if start is not None:
                return start, self._count
            if len(data) < RELOCK_FRAMES * frame_size(self._count):
                return None
        counts = range(1, MAX_MAGNETOMETERS + 1) if self._given is None else (self._given,)
        return search.new(counts)

    def _append_frames(
        self, buffer: bytes, at: int, later: int, fed: int, bursts: list[FloatBurst]
    ) -> int:
        """Append the frames from ``at`` on and return the bytes consumed.

        Unlock where they stop fitting.
        """
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
        if _all_plausible(values):
            self._suspect = 0
            status = np.zeros((fitting, n), dtype=np.uint8)
        else:
            fitting = self._trusted_frames(values[:, :, 0])
            status = _status(values[:fitting])
        values.flags.writeable = status.flags.writeable = False
        self._tally[ACCEPTED] += fitting
        first = len(buffer) - at - size + later
        trailing: Sequence[int] = range(first, first - fitting * size, -size)
        if first > fed:
            trailing = [min(after, fed) for after in trailing]
        bursts.append(FloatBurst(values[:fitting], status[:fitting], trailing))
        return fitting * size

    def _trusted_frames(self, temperature_c: NDArray[np.float32]) -> int:
        """Number of frames up to the one, if any, that casts doubt on the boundary.

        ``temperature_c``: (k, n) °C.
        """
        with np.errstate(invalid="ignore"):
            likely = plausible(temperature_c).mean(axis=1) >= 0.5
        for i, good in enumerate(likely.tolist()):
            self._suspect = 0 if good else self._suspect + 1
            if self._suspect >= SUSPECT_FRAMES:
                self._locked = False
                return i + 1
        return len(likely)


def _all_plausible(values: NDArray[np.float32]) -> bool:
    """Whether every reading of (k, n, 4) is plausible without a closer look; False for any NaN."""
    temperature_c = values[:, :, 0]
    return bool(
        temperature_c.min() >= TINY_C
        and temperature_c.max() <= HOTTEST_C
        and np.abs(values).max() <= MAX_FIELD_UT
    )


def _status(values: NDArray[np.float32]) -> NDArray[np.uint8]:
    """`TaxelStatus` of each reading, (k, n), from readings (k, n, 4) of t, x, y, z."""
    with np.errstate(invalid="ignore"):
        temperature_c, field_ut = values[:, :, 0], values[:, :, 1:]
        good = (temperature_c >= COLDEST_C) & (temperature_c <= HOTTEST_C)
        good &= (np.abs(field_ut) <= MAX_FIELD_UT).all(axis=2)
    return np.where(good, TaxelStatus.OK, TaxelStatus.READ_FAILED).astype(np.uint8)
