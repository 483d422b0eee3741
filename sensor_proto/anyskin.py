"""AnySkin, ReSkin and eFlesh boards: n × (float32 t °C, x, y, z µT), then CR LF, and no more.

The frames carry no header, check or sequence: their boundary is inferred (`anyskin_search`) and
doubted again when it stops to fit.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sensor_proto.anyskin_search import END, FLOAT, MAX_MAGNETOMETERS, Search, frame_size
from sensor_proto.decoder import ACCEPTED, Reject, Tally
from sensor_proto.packets import FloatBurst, FloatSamples, Received, TaxelStatus
from sensor_proto.temperature import COLDEST_C, HOTTEST_C, TINY_C, plausible

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
