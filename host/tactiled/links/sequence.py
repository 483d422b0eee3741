"""Exact account of the frames of one array: which came, which came twice, which are missing."""

from __future__ import annotations

from enum import Enum, auto

HISTORY = 64
"""Sequence numbers remembered behind the newest: far more than any medium reorders."""

WRAP = 1 << 32


class Verdict(Enum):
    """What a sequence number says of its frame."""

    FRESH = auto()
    DUPLICATE = auto()
    LATE = auto()  # fills a gap, but newer ones were used already
    FOREIGN = auto()  # further back than anything is reordered: the board started anew


class SequenceTracker:
    """32-bit sequence numbers of one array.

    Counters, since the start and through `restart`: ``accepted``, ``missing`` (in a gap and never
    seen), ``duplicate``, ``late``; sent = accepted + late + missing.
    """

    def __init__(self) -> None:
        self.accepted = self.missing = self.duplicate = self.late = 0
        self._newest: int | None = None
        self._unsure = False
        self._seen = 0  # bit i: newest - i came

    def restart(self) -> None:
        """The next number, whatever it is, follows on; the counters go on."""
        self._newest = None

    def resume(self) -> None:
        """The board was out of sight: it goes on, or, if the next number is no newer, anew."""
        self._unsure = True

    def take(self, sequence: int) -> Verdict:
        """Judge and count one frame; FOREIGN ones are not counted."""
        unsure, self._unsure = self._unsure, False
        if self._newest is None or (unsure and (sequence - self._newest) % WRAP >= WRAP // 2):
            self._newest, self._seen = sequence, (1 << HISTORY) - 1
            self.accepted += 1
            return Verdict.FRESH
        ahead = (sequence - self._newest) % WRAP
        if 0 < ahead < WRAP // 2:
            self.missing += ahead - 1
            self._seen = 1 if ahead >= HISTORY else (self._seen << ahead | 1) & ((1 << HISTORY) - 1)
            self._newest = sequence
            self.accepted += 1
            return Verdict.FRESH
        behind = (self._newest - sequence) % WRAP
        if behind >= HISTORY:
            return Verdict.FOREIGN
        if self._seen >> behind & 1:
            self.duplicate += 1
            return Verdict.DUPLICATE
        self._seen |= 1 << behind
        self.missing -= 1
        self.late += 1
        return Verdict.LATE
