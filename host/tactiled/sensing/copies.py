"""Readings that came before, and chips that say the same: what noise never does."""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]

KEPT = 128
"""Frames that a frame is compared with. A recording that is played in a loop is longer."""
NOISY_FRAMES = 32
"""Different frames that must have come first: a stream without noise repeats itself by right."""

TWIN_CYCLES = 4
"""Cycles with new readings in which two chips agree to the bit before they count as one."""


class Copies:
    """Frames of one array; knows one that is the very copy of an earlier one."""

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
        """Whether ``frame`` came before, other than just before.

        A motion that goes back through the very same frames, as only one without noise can, is
        not a copy.
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
    """Chips whose three components are the same bits, cycle after cycle.

    ``rest_ut``: (A, 3, n) µT in chip axes that the calibration says of the untouched chips; those
    that read the same at rest may read the same. None: unknown.
    """

    def __init__(self, real: Bool, rest_ut: Float | None) -> None:
        self._real = real
        self._places = np.flatnonzero(real)
        self._whole = bool(real.all())
        self._rest = None if rest_ut is None else _columns(rest_ut)
        self.reset()

    def reset(self) -> None:
        """Forget who was the same."""
        self._run: NDArray[np.int64] | None = None

    def check(self, raw: Float, trusted: Float, unchanged: Bool, near: Float) -> Bool | None:
        """(A, n) taxels that are found to send another chip's bits; None: none is.

        ``raw``: (A, 3, n) µT. A chip that left what it last read, ``trusted``, by more than
        ``near`` (3, 1) µT is found at once, others after `TWIN_CYCLES` readings; those that are
        ``unchanged`` (A, n) do not count as readings.
        """
        # not by a matrix product: its sums may be rounded differently from taxel to taxel
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

    def _pairs(self, key: Float) -> list[list[int]]:
        """Flat indices of taxels with the same key."""
        values = key[self._places]
        order = np.argsort(values, kind="stable")
        same = np.flatnonzero(np.diff(values[order]) == 0)
        pairs = np.column_stack([self._places[order[same]], self._places[order[same + 1]]])
        out: list[list[int]] = pairs.tolist()
        return out

    def _differ(self, i: int, j: int, near: Float) -> bool:
        """Whether two taxels at rest read different fields, however their chips are turned."""
        if self._rest is None:
            return True
        one, other = self._rest[i], self._rest[j]
        z = abs(one[2] - other[2])
        xy = abs(np.hypot(one[0], one[1]) - np.hypot(other[0], other[1]))
        return bool(z > near[2, 0] or xy > near[0, 0])


def _columns(vectors: Float) -> Float:
    """(A, 3, n) as (A n, 3)."""
    return vectors.swapaxes(1, 2).reshape(-1, 3)
