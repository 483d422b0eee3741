"""``tactile log merge``: several logs into one, in the order of time."""

from __future__ import annotations

import argparse
import hashlib
import heapq
import uuid
from collections import OrderedDict
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from tactile_bus.gaps import GAP
from tactile_bus.instant import NS_PER_S
from tactile_bus.log_records import MetadataRecord
from tactile_tools.logs.arguments import add_output, check_output
from tactile_tools.logs.sources import FILE, Series, find_series
from tactile_tools.logs.stream import (
    Attachment,
    Item,
    Reading,
    Record,
    Stream,
    read_merged,
    read_series,
)
from tactile_tools.logs.terminal import ToolError, complain, plain_console, progress
from tactile_tools.logs.writing import LogOutput

SORTED_NS = 5 * NS_PER_S
SORTED_LIMIT = 50_000
"""Messages within so much time, and so many, are put into order: daemons write theirs within a
second, however busy the disk."""

REMEMBERED = 8192
"""Messages of a topic in which another log's copy is looked for: what one daemon heard of another
it logs within milliseconds."""

CLOCKS_APART_NS = NS_PER_S // 20

SOFTWARE, OFFSET = "software", "clock_offset_ns"


def fill(parser: argparse.ArgumentParser) -> None:
    """Give ``tactile log merge`` its arguments."""
    parser.description = (
        "Write several logs, such as those of both daemons, as one: messages in the "
        "order of time, all attachments and tables. What one daemon logged of what another said, "
        "and that one logged too, is kept once."
    )
    parser.add_argument(
        "files", nargs="+", type=Path, metavar="FILE", help="logs, folders, names of split logs"
    )
    add_output(parser, "new log", required=True)
    parser.add_argument(
        "--keep-duplicates", action="store_true", help="keep messages that several logs have"
    )
    parser.add_argument(
        "--align",
        action="store_true",
        help="put the clocks of the logs together by the monotonic clock of the machine, if its "
        "clock was set between their starts",
    )
    parser.set_defaults(func=run)


def run(options: argparse.Namespace) -> int:
    """Merge; 0 when the new log was written."""
    logs = find_series(options.files)
    check_output(options.out, options.force, logs)
    shifts = _shifts(logs, options.align)
    reading = Reading()
    with progress("looking through") as report:
        shared = _shared(logs, report)
    seen = Copies(shared)
    with progress("merging") as report, LogOutput(options.out) as output:
        output.metadata(FILE, {"set": uuid.uuid4().hex, "file": "0"})
        tables = Tables(logs, output)
        items = read_merged(logs, reading, report)
        for number, item in in_order(_shifted(items, shifts)):
            if isinstance(item, Record):
                if options.keep_duplicates or not seen.is_copy(number, item):
                    output.write(item, renumber=item.stream in shared)
            else:
                tables.take(number, item)
        for stream in reading.seen:
            output.declare(stream)
        messages = output.messages
    console = plain_console()
    console.print(f"{options.out}: {messages} messages of {len(logs)} logs")
    if seen.copies:
        console.print(f"{seen.copies} messages were in several logs and are kept once")
    if remark := reading.remark():
        console.print(f"{remark}: merged what could be read")
    return 0


def _shifts(logs: list[Series], align: bool) -> list[int]:
    """ns to add to the times of each log, so that the same moment has the same time in all."""
    offsets: list[int | None] = []
    for series in logs:
        found: int | None = None
        for item in read_series(Series(series.paths[:1]), Reading(), None, lambda _: False, (0, 0)):
            if isinstance(item, MetadataRecord) and item.name == SOFTWARE:
                text = item.values.get(OFFSET, "")
                found = int(text) if text.lstrip("-").isdecimal() else None
                break
        offsets.append(found)
    told = [offset for offset in offsets if offset is not None]
    if not told:
        if align:
            raise ToolError("--align: none of the logs tells how its clock stood")
        return [0] * len(logs)
    if align:
        return [0 if offset is None else told[0] - offset for offset in offsets]
    apart = max(told) - min(told)
    if apart > CLOCKS_APART_NS:
        complain(
            f"the clock was set between the starts of these logs, they stand {apart / 1e9:.3f} s "
            "apart: --align puts them together, if they are of one machine and one boot"
        )
    return [0] * len(logs)


def _shared(logs: list[Series], report: Any) -> set[Stream]:
    """Streams that several of the logs hold."""
    if len(logs) < 2:
        return set()
    shared: set[Stream] = set()
    seen: set[Stream] = set()
    for series in logs:
        reading = Reading()
        for _ in read_series(series, reading, report, lambda _: False):
            pass
        shared |= seen & reading.seen.keys()
        seen |= reading.seen.keys()
    return shared


def _shifted(items: Iterable[tuple[int, Item]], shifts: list[int]) -> Iterator[tuple[int, Item]]:
    for number, item in items:
        shift = shifts[number]
        if shift and isinstance(item, Record):
            log_ns, sent_ns = max(0, item.log_ns + shift), item.publish_ns
            item = item._replace(log_ns=log_ns, publish_ns=max(0, sent_ns + shift))
        yield number, item


def in_order(items: Iterable[tuple[int, Item]]) -> Iterator[tuple[int, Item]]:
    """The same with messages that are a little out of order put into it; bounded memory."""
    waiting: list[tuple[int, int, int, Record]] = []
    count = newest = 0
    for number, item in items:
        if not isinstance(item, Record):
            yield number, item
            continue
        heapq.heappush(waiting, (item.log_ns, count, number, item))
        count += 1
        newest = max(newest, item.log_ns)
        while waiting and (waiting[0][0] < newest - SORTED_NS or len(waiting) > SORTED_LIMIT):
            _, _, number, first = heapq.heappop(waiting)
            yield number, first
    while waiting:
        _, _, number, first = heapq.heappop(waiting)
        yield number, first


class Copies:
    """Tells messages that another log had already; of the streams that several have."""

    def __init__(self, shared: set[Stream]) -> None:
        self.copies = 0
        self._shared = shared
        self._seen: dict[Stream, OrderedDict[bytes, int]] = {}

    def is_copy(self, number: int, record: Record) -> bool:
        """Whether log ``number`` repeats what another one had; counted."""
        if record.stream not in self._shared:
            return False
        seen = self._seen.setdefault(record.stream, OrderedDict())
        digest = hashlib.blake2b(record.data, digest_size=16).digest()
        owner = seen.get(digest)
        if owner is not None and owner != number:
            del seen[digest]
            self.copies += 1
            return True
        seen[digest] = number
        if len(seen) > REMEMBERED:
            seen.popitem(last=False)
        return False


class Tables:
    """Metadata and attachments of several logs in one: told apart by the log where they differ."""

    def __init__(self, logs: list[Series], output: LogOutput) -> None:
        self._logs = logs
        self._output = output
        self._tables: dict[str, tuple[int, dict[str, str]]] = {}
        self._files: dict[str, tuple[int, bytes]] = {}

    def take(self, number: int, item: MetadataRecord | Attachment) -> None:
        """Write one over, once."""
        if isinstance(item, MetadataRecord):
            if item.name == FILE:
                return
            if item.name == GAP:
                self._output.metadata(item.name, item.values)
                return
            name = item.name
            owner = self._tables.setdefault(name, (number, {}))[0]
            if owner != number:
                if self._tables[name][1] == item.values:
                    return
                name = f"{name}@{self._stem(number)}"
            if self._tables.get(name) == (number, item.values):
                return  # as every file of a log repeats it
            self._tables[name] = (number, item.values)
            self._output.metadata(name, item.values)
            return
        name = item.name
        held = self._files.get(name)
        if held is not None and held[1] != item.data and held[0] != number:
            name = f"{self._stem(number)}.{name}"
            held = self._files.get(name)
        if held is not None and held[1] == item.data:
            return
        self._files[name] = (number, item.data)
        self._output.attach(item._replace(name=name))

    def _stem(self, number: int) -> str:
        return self._logs[number].paths[0].stem
