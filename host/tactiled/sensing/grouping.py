"""Blocks of the arrays of one board put together into sampling cycles, by sequence number."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from tactiled.blocks import SampleBlock

HALF = 1 << 31
"""Sequence numbers are 32 bits and wrap: a step of less than half the circle is forwards."""
LATE_RUN = 8
"""Late blocks in a row, none of them repeated, after which the board must have begun anew: links
reorder a block or two, a restarted board never stops being late."""


@dataclass(slots=True)
class CycleCounters:
    """What became of every block and cycle since the pipeline was made.

    ``cycles`` came out, ``incomplete_cycles`` of them with ``missing_blocks`` arrays absent;
    ``lost_cycles`` never came at all (gaps in the sequence). Blocks that were not used:
    ``duplicate_blocks``, ``late_blocks`` (their cycle was already out), ``unknown_array``,
    ``wrong_shape``. ``restarts``: the sequence went back for good.
    """

    cycles: int = 0
    incomplete_cycles: int = 0
    missing_blocks: int = 0
    lost_cycles: int = 0
    duplicate_blocks: int = 0
    late_blocks: int = 0
    unknown_array: int = 0
    wrong_shape: int = 0
    restarts: int = 0


@dataclass(slots=True)
class Group:
    """Blocks of one cycle; ``blocks`` has a place for every array of the board."""

    sequence: int
    blocks: list[SampleBlock | None]
    present: int = field(default=0)


class Grouper:
    """Holds the blocks of the one cycle that is under way; nothing else is ever kept."""

    def __init__(self, taxels: tuple[int, ...]) -> None:
        self._taxels = taxels
        self._open: Group | None = None
        self._last: int | None = None
        self._late_run = 0
        self.counters = CycleCounters()

    def feed(self, block: SampleBlock) -> list[Group]:
        """Cycles that this block completes or, by being of a later one, ends: at most two."""
        count = self.counters
        if not 0 <= block.array < len(self._taxels):
            count.unknown_array += 1
            return []
        if not _fits(block, self._taxels[block.array]):
            count.wrong_shape += 1
            return []
        out: list[Group] = []
        group = self._open
        if group is not None:
            step = _step(group.sequence, block.sequence)
            if step == 0:
                if group.blocks[block.array] is not None:
                    count.duplicate_blocks += 1
                    return []
            elif step < 0:
                return self._late(block)
            else:
                out.append(self._close(group))
                group = None
        if group is None:
            if self._last is not None:
                step = _step(self._last, block.sequence)
                if step <= 0:
                    return out + self._late(block)
                count.lost_cycles += step - 1
            group = self._open = Group(block.sequence, [None] * len(self._taxels))
        self._late_run = 0
        group.blocks[block.array] = block
        group.present += 1
        if group.present == len(self._taxels):
            out.append(self._close(group))
        return out

    def flush(self) -> list[Group]:
        """The cycle under way, as it stands; for the end of a stream."""
        return [] if self._open is None else [self._close(self._open)]

    def reset(self) -> None:
        """Forget the sequence and the cycle under way: the board begins anew."""
        self._open = None
        self._last = None
        self._late_run = 0

    def _close(self, group: Group) -> Group:
        self._open = None
        self._last = group.sequence
        self.counters.cycles += 1
        missing = len(group.blocks) - group.present
        if missing:
            self.counters.incomplete_cycles += 1
            self.counters.missing_blocks += missing
        return group

    def _late(self, block: SampleBlock) -> list[Group]:
        """Count a block that came too late; a run of them is a board that begins anew."""
        if block.sequence == self._last and self._open is None:
            self.counters.duplicate_blocks += 1
            return []
        self._late_run += 1
        if self._late_run < LATE_RUN:
            self.counters.late_blocks += 1
            return []
        self.counters.restarts += 1
        self.reset()
        return self.feed(block)


def _fits(block: SampleBlock, taxels: int) -> bool:
    return (
        block.field_ut.shape == (taxels, 3)
        and block.status.shape == (taxels,)
        and block.temperature_c.shape in ((1,), (taxels,))
    )


def _step(earlier: int, later: int) -> int:
    """Signed steps from one 32-bit sequence number to another."""
    return (later - earlier + HALF) % (1 << 32) - HALF


def gather_temperature(group: Group) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    """Temperatures of a cycle, °C, one an array or one a taxel as they came; NaN where missing."""
    parts = [
        np.array([np.nan]) if b is None else np.asarray(b.temperature_c, np.float64)
        for b in group.blocks
    ]
    return np.concatenate(parts)
