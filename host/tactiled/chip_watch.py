"""Which chips of a board are masked, since when, how often: for the log, status and diagnostics."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tactile_bus.geometry import SkinGeometry
from tactile_bus.instant import Instant, seconds_between
from tactiled.sensing.readings import Fault

REPEAT_S = 10.0
"""s between two lines about the same fault of the same array."""
QUIET_S = 3.0
"""s that a chip must read well before it is said to be well again."""
MOST_NAMED = 6
"""Chips named in a line; of more it says how many."""

_UNTOLD = (Fault.NONE, Fault.MISSING)
"""Of an array that is missing others tell."""
_TOLD = np.array([fault not in _UNTOLD for fault in Fault])


@dataclass(frozen=True, slots=True)
class Masked:
    """One chip that is masked, or was in the last `QUIET_S`.

    ``seconds``: since it was first masked. ``share``: of the cycles of the last second.
    """

    array: str
    chip: int
    fault: Fault
    seconds: float
    share: float

    def __str__(self) -> str:
        """As status and diagnostics show it."""
        often = "" if self.share > 0.99 else f" in {self.share:.0%} of cycles"
        return f"{self.fault.text}; masked{often} since {self.seconds:.0f} s: {self.fault.remedy}"


class ChipWatch:
    """Watches the cycles of one board; memory of a few numbers a taxel."""

    def __init__(self, geometry: SkinGeometry) -> None:
        self._names = [
            (array.name, chip) for array in geometry.arrays for chip in range(array.taxels)
        ]
        n = geometry.taxels
        self._fault = np.zeros(n, np.uint8)
        self._since = np.zeros(n, np.int64)
        self._until = np.zeros(n, np.int64)
        self._count = np.zeros(n, np.int64)
        self._share = np.zeros(n)
        self._open = np.zeros(n, bool)
        self._told = np.zeros(n, bool)
        self._cycles = 0
        self._said: dict[tuple[str, Fault], Instant] = {}
        self.masked: list[Masked] = []
        """Chips masked now or just now, as of the last `each_second`; replaced as a whole."""

    def observe(self, fault: NDArray[np.uint8], captured: Instant) -> None:
        """Take (N,) uint8 of `Fault` of one cycle."""
        self._cycles += 1
        if not fault.any():
            return
        bad = _TOLD[fault]
        new = bad & ~self._open
        self._since[new] = captured
        self._open |= new
        self._fault[bad] = fault[bad]
        self._until[bad] = captured
        self._count[bad] += 1

    def each_second(self, now: Instant) -> list[tuple[int, str]]:
        """Levels and texts of what has changed, for the log."""
        lines: list[tuple[int, str]] = []
        self._share = self._count / max(self._cycles, 1)
        cycles = self._cycles
        if self._open.any():
            over = self._open & (now - self._until > QUIET_S * 1e9)
            lines += self._recovered(np.flatnonzero(over & self._told))
            self._open &= ~over
            self._told &= ~over
            lines += self._worse(np.flatnonzero(self._open & (self._count > 0)), cycles, now)
        self.masked = [
            Masked(
                *self._names[i],
                Fault(int(self._fault[i])),
                seconds_between(Instant(int(self._since[i])), now),
                float(self._share[i]),
            )
            for i in np.flatnonzero(self._open).tolist()
        ]
        self._count[:] = 0
        self._cycles = 0
        return lines

    def _worse(self, chips: NDArray[np.intp], cycles: int, now: Instant) -> list[tuple[int, str]]:
        groups: dict[tuple[str, Fault], list[int]] = {}
        for i in chips.tolist():
            groups.setdefault((self._names[i][0], Fault(int(self._fault[i]))), []).append(i)
        lines = []
        for (array, fault), members in groups.items():
            steady = all(self._told[i] and self._share[i] > 0.99 for i in members)
            last = self._said.get((array, fault))
            if steady or (last is not None and seconds_between(last, now) < REPEAT_S):
                continue
            self._said[array, fault] = now
            self._told[members] = True
            seen = int(self._count[members].max())
            often = "" if seen >= cycles else f" in {seen} of {cycles} cycles"
            lines.append(
                (
                    logging.WARNING,
                    f"{self._called(array, members)} {fault.text}; masked{often}: {fault.remedy}",
                )
            )
        return lines

    def _recovered(self, chips: NDArray[np.intp]) -> list[tuple[int, str]]:
        groups: dict[str, list[int]] = {}
        for i in chips.tolist():
            groups.setdefault(self._names[i][0], []).append(i)
        return [
            (
                logging.INFO,
                f"{self._called(array, members)} {'reads' if len(members) == 1 else 'read'} well "
                f"again, first masked {self._length(members):.1f} s before",
            )
            for array, members in groups.items()
        ]

    def _length(self, members: Sequence[int]) -> float:
        return float((self._until[members] - self._since[members]).max() * 1e-9)

    def _called(self, array: str, members: Sequence[int]) -> str:
        """``chip 2 of skin``, ``chips 2, 4 of skin``, ``16 chips of left``."""
        if len(members) > MOST_NAMED:
            return f"each of {len(members)} chips of {array}"
        which = ", ".join(str(self._names[i][1]) for i in members)
        return (
            f"chip {which} of {array}" if len(members) == 1 else f"each of chips {which} of {array}"
        )
