"""Sort the messages of a log by time, however far back its times go, in bounded memory.

The first pass notes the earliest time after each stretch of the log. In the second pass a message
is handed out once no earlier one can follow; when too many wait, they go to a file.
"""

from __future__ import annotations

import heapq
import struct
import tempfile
from array import array
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import IO, NamedTuple

from tactile_tools.log.stream import Item, Record, Stream

STRETCH_MESSAGES = 256
STRETCH_BYTES = 1 << 20
"""A stretch of a log ends after this many messages or bytes."""

HELD_BYTES = 16 << 20
"""Bytes of waiting messages held in memory; more go to a file."""

MAX_RUNS = 32
"""Greatest number of such files, each sorted; when there are more they are merged into one."""

OVERHEAD = 200
"""Bytes that a message takes in memory besides its own."""

HEAD = struct.Struct("<QQQIII")  # log time, publish time, count, stream, sequence, size


class Stretches:
    """Divides a log into stretches, the same way in both passes; the first pass fills `low`.

    ``low``: for each stretch, the earliest log time after it, ns.
    """

    def __init__(self) -> None:
        self.low: array[int] = array("Q")
        self.first_ns = 0
        """Earliest log time of all, ns, once the first pass is over; 0 if there are no messages."""
        self._messages = self._bytes = 0
        self._least = (1 << 64) - 1

    def ends(self, record: Record) -> bool:
        """Count a message; return whether a stretch ends with it."""
        self._messages += 1
        self._bytes += len(record.data)
        if self._messages < STRETCH_MESSAGES and self._bytes < STRETCH_BYTES:
            return False
        self._messages = self._bytes = 0
        return True

    def survey(self, record: Record) -> None:
        """Take a message of the first pass."""
        self._least = min(self._least, record.log_ns)
        if self.ends(record):
            self.low.append(self._least)
            self._least = (1 << 64) - 1

    def finish(self) -> None:
        """End the first pass: turn the minima of stretches into minima of all that follows."""
        least, low = self._least, self.low
        for k in range(len(low) - 1, -1, -1):
            low[k], least = least, min(least, low[k])
        self.first_ns = least if least < (1 << 64) - 1 else 0
        self._messages = self._bytes = 0


class _Waiting(NamedTuple):
    """A waiting message. ``run``: number of the file that it came from, or -1."""

    log_ns: int
    number: int
    run: int
    record: Record


class TimeSorter:
    """Sorts one log. ``folder``: where files of waiting messages are made."""

    def __init__(self, stretches: Stretches, folder: Path) -> None:
        self._stretches = stretches
        self._folder = folder
        self._heap: list[_Waiting] = []
        self._held = 0
        self._runs: dict[int, Iterator[_Waiting]] = {}
        self._streams: list[Stream] = []
        self._numbers: dict[Stream, int] = {}
        self._made = 0

    def sort(self, items: Iterable[Item]) -> Iterator[Item]:
        """Yield the items, messages sorted by time, others as soon as they come."""
        count = stretch = 0
        for item in items:
            if not isinstance(item, Record):
                yield item
                continue
            heapq.heappush(self._heap, _Waiting(item.log_ns, count, -1, item))
            count += 1
            self._held += len(item.data) + OVERHEAD
            if self._stretches.ends(item):
                low = self._stretches.low
                if stretch < len(low):
                    yield from self._until(low[stretch])
                stretch += 1
                if self._held > HELD_BYTES:
                    self._spill()
        yield from self._until((1 << 64) - 1)

    def _until(self, limit: int) -> Iterator[Record]:
        heap = self._heap
        while heap and heap[0].log_ns <= limit:
            first = heap[0]
            if first.run < 0:
                heapq.heappop(heap)
                self._held -= len(first.record.data) + OVERHEAD
            else:
                following = next(self._runs[first.run], None)
                if following is None:
                    heapq.heappop(heap)
                    del self._runs[first.run]
                else:
                    heapq.heapreplace(heap, following)
            yield first.record

    def _spill(self) -> None:
        """Move waiting messages to a sorted file; the heap keeps the first message of each file."""
        mine = sorted(waiting for waiting in self._heap if waiting.run < 0)
        self._heap = [waiting for waiting in self._heap if waiting.run >= 0]
        self._held = 0
        self._add_run(mine)
        if len(self._runs) > MAX_RUNS:
            heads, self._heap = sorted(self._heap), []
            runs, self._runs = self._runs, {}
            each = ([head] for head in heads)
            self._add_run(
                heapq.merge(*(_chain(head, runs[head[0].run]) for head in each), key=_place)
            )
        heapq.heapify(self._heap)

    def _add_run(self, ordered: Iterable[_Waiting]) -> None:
        file: IO[bytes] = tempfile.TemporaryFile(dir=self._folder)  # noqa: SIM115 - of the run
        for _, count, _, record in ordered:
            number = self._numbers.get(record.stream)
            if number is None:
                number = self._numbers[record.stream] = len(self._streams)
                self._streams.append(record.stream)
            size = len(record.data)
            file.write(
                HEAD.pack(record.log_ns, record.publish_ns, count, number, record.sequence, size)
            )
            file.write(record.data)
        file.seek(0)
        run, self._made = self._made, self._made + 1
        self._runs[run] = self._read(file, run)
        first = next(self._runs[run], None)
        if first is None:
            del self._runs[run]
        else:
            self._heap.append(first)

    def _read(self, file: IO[bytes], run: int) -> Iterator[_Waiting]:
        with file:
            while head := file.read(HEAD.size):
                log_ns, publish_ns, count, number, sequence, size = HEAD.unpack(head)
                record = Record(
                    self._streams[number], sequence, log_ns, publish_ns, file.read(size)
                )
                yield _Waiting(log_ns, count, run, record)


def _chain(first: list[_Waiting], rest: Iterator[_Waiting]) -> Iterator[_Waiting]:
    yield from first
    yield from rest


def _place(waiting: _Waiting) -> tuple[int, int]:
    return waiting.log_ns, waiting.number
