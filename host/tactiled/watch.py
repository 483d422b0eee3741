"""Report what repeats without flooding the log: masked chips, silences, messages of one kind."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tactile_core.geometry import SkinGeometry
from tactile_core.types import Instant, seconds_between
from tactiled.sensing.reasons import Fault

# Repeated messages; pure, time is passed in.
#
# The first few of a kind are reported at once. Those that follow within `WINDOW_S` are counted, and
# one line reports them at its end, so that a flood of one kind hides neither the others nor itself.


WINDOW_S = 10.0
"""s within which repeats are only counted."""

FEW = 3
"""Messages of one kind reported at once: someone who plugs and unplugs is not a flood."""

KINDS = 64
"""Most kinds tracked at a time; messages of further kinds are all reported."""


@dataclass(slots=True)
class _Window:
    begun: Instant
    told: int = 1
    count: int = 0
    last: str = ""
    level: int = 0


class Repeats:
    """Decides which repeated messages to report, by kind."""

    def __init__(self) -> None:
        self._windows: dict[str, _Window] = {}

    def should_report(self, kind: str, text: str, level: int, now: Instant) -> bool:
        """Whether to report ``text`` now; if not, it is counted. ``level``: logging level."""
        window = self._windows.get(kind)
        if window is not None and window.told < FEW:
            window.told += 1
            return True
        if window is not None:
            window.count += 1
            window.last, window.level = text, level
            return False
        if len(self._windows) < KINDS:
            self._windows[kind] = _Window(now)
        return True

    def due(self, now: Instant) -> list[tuple[int, str]]:
        """Levels and texts of the summaries that are due."""
        said = []
        for kind, window in list(self._windows.items()):
            past = seconds_between(window.begun, now)
            if past < WINDOW_S:
                continue
            if not window.count:
                del self._windows[kind]
                continue
            times = "once" if window.count == 1 else f"{window.count} times"
            said.append((window.level, f"{times} more in {past:.0f} s: {window.last}"))
            self._windows[kind] = _Window(now, told=FEW)
        return said


class Silences:
    """Silences of one board: several short ones make one line, a long one has its own."""

    def __init__(self) -> None:
        self._begun: Instant | None = None  # of the window
        self._count = 0
        self._longest = 0.0
        self._since: Instant | None = None  # of the silence under way
        self._before = 0.0  # s it had lasted then
        self._told = False

    def fell(self, seconds: float, now: Instant) -> str | None:
        """Take a silence noticed after ``seconds``; returns what to report at once, or None."""
        self._since, self._before = now, seconds
        self._told = self._begun is None
        if not self._told:
            return None
        self._begun = now
        return f"no samples for {seconds:.2f} s"

    def ended(self, seconds: float) -> str | None:
        """Take the end of a silence of ``seconds``; returns what to report at once, or None."""
        self._since = None
        if self._told:
            return f"samples again after {seconds:.2f} s"
        self._count += 1
        self._longest = max(self._longest, seconds)
        return None

    def gone(self) -> None:
        """Forget the silence under way: the board is gone, which is reported elsewhere."""
        self._since = None

    def due(self, now: Instant) -> str | None:
        """What to report of a lasting silence or a window that is over, or None; call it often."""
        if self._since is not None and not self._told:
            lasts = self._before + seconds_between(self._since, now)
            if lasts >= max(LASTING_S, 3 * self._before):
                self._told = True
                return f"no samples for {lasts:.1f} s"
        if self._begun is None:
            return None
        past = seconds_between(self._begun, now)
        if past < WINDOW_S:
            return None
        count, longest = self._count, self._longest
        self._begun, self._count, self._longest = (now if count else None), 0, 0.0
        if not count:
            return None
        what = "1 short silence" if count == 1 else f"{count} short silences"
        return f"{what} in {past:.0f} s, longest {longest:.1f} s"


LASTING_S = 2.0
"""s after which a silence that was only counted is reported after all."""


REPEAT_S = 10.0
"""s between lines about the same fault of the same array."""
QUIET_S = 3.0
"""s that a chip must read without fault before it counts as recovered."""
MOST_NAMED = 6
"""Most chips named in a line; for more, their number is given."""

_UNTOLD = (Fault.NONE, Fault.MISSING)
"""Faults not reported here; a missing array is reported elsewhere."""
_TOLD = np.array([fault not in _UNTOLD for fault in Fault])


@dataclass(frozen=True, slots=True)
class Masked:
    """One chip that is masked, or was in the last `QUIET_S`.

    ``seconds``: time since it was first masked. ``share``: fraction of the last second's cycles in
    which it was.
    """

    array: str
    chip: int
    fault: Fault
    seconds: float
    share: float

    def __str__(self) -> str:
        """Text for status and diagnostics."""
        often = "" if self.share > 0.99 else f" in {self.share:.0%} of cycles"
        return f"{self.fault.text}; masked{often} since {self.seconds:.0f} s: {self.fault.remedy}"


class ChipWatch:
    """Tracks the masked chips of one board; keeps a few numbers per taxel."""

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
        """Chips masked now or shortly before, as of the last `each_second`; replaced as a whole."""

    def observe(self, fault: NDArray[np.uint8], captured: Instant) -> None:
        """Take the faults of one cycle, (N,) uint8 of `Fault`."""
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
        """Levels and texts of changes, for the log."""
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
        """``chip 2 of skin``, ``each of chips 2, 4 of skin``, ``each of 16 chips of left``."""
        if len(members) > MOST_NAMED:
            return f"each of {len(members)} chips of {array}"
        which = ", ".join(str(self._names[i][1]) for i in members)
        return (
            f"chip {which} of {array}" if len(members) == 1 else f"each of chips {which} of {array}"
        )
