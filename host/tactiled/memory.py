"""Keep memory flat for weeks: garbage is collected between cycles, large buffers are returned."""

from __future__ import annotations

import ctypes
import gc
import sys

M_MMAP_THRESHOLD = -3
"""Parameter number in glibc's malloc.h."""

LARGE = 65_536
"""Bytes from which a buffer is mapped on its own and returned when freed. By default glibc raises
this limit to the largest buffer freed so far, then places the log's chunks (some 150 kB twice a
second) between small objects and never reuses the holes: 2.5 kB/s of growth measured."""

FREEZE_AFTER = 5
"""s after the start at which all objects alive are exempted from collection for good."""

COLLECT_EVERY = 10
"""s between collections thereafter; with so few objects left to look at they take 1 ms."""


def return_large_buffers() -> None:
    """Make malloc map large buffers on their own, if it is glibc's."""
    if sys.platform == "linux":
        mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
        if mallopt is not None:
            mallopt(M_MMAP_THRESHOLD, LARGE)


class Collector:
    """Collects garbage at a good moment; at any other it would stop every thread."""

    def __init__(self) -> None:
        self._seconds = 0

    def each_second(self) -> None:
        """Call once a second, between two cycles."""
        self._seconds += 1
        if self._seconds == FREEZE_AFTER:
            gc.collect()
            gc.freeze()
            gc.disable()
        elif self._seconds > FREEZE_AFTER and self._seconds % COLLECT_EVERY == 0:
            gc.collect()
