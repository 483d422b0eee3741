"""Where the frames of an unframed float stream begin, and how many magnetometers they hold.

CR LF ends every frame but occurs inside the floats as well, so that it is trusted only at the
right distance and together with temperatures that a chip can have. Among overlapping claims the
better supported wins. All claims of one search are judged at once: noise full of CR LF is cheap.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from sensor_proto.temperature import evidence, plausible, temperature_first

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
