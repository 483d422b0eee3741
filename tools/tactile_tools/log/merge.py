"""``tactile log merge``: merge several logs into one, in the order of time."""

from __future__ import annotations

import argparse
import hashlib
import heapq
import uuid
from collections import Counter, deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tactile_core.cli import progress
from tactile_core.log.records import MetadataRecord
from tactile_core.log.writer import GAP
from tactile_core.types import NS_PER_S
from tactile_tools.log.arguments import check_output
from tactile_tools.log.ordering import Stretches, TimeSorter
from tactile_tools.log.sources import FILE, Series, find_series
from tactile_tools.log.stream import (
    Attachment,
    Item,
    Reading,
    Record,
    Stream,
    common_profile,
    read_series,
)
from tactile_tools.log.terminal import ToolError, complain, plain_console
from tactile_tools.log.writing import LogOutput

COPY_WITHIN_NS = 10 * NS_PER_S
"""Greatest difference between the log times of a message and its copy. A daemon logs what another
one says within milliseconds, a busy one within seconds."""

REMEMBERED = 200_000
"""Greatest number of messages among which a copy is looked for."""

SHOWN = 20
"""Topics whose copies are reported one by one; the rest are reported as a sum."""

CLOCKS_APART_NS = NS_PER_S // 20

SOFTWARE, OFFSET = "software", "clock_offset_ns"


def run(options: argparse.Namespace) -> int:
    """Merge logs. Returns 0 if the new log was written."""
    logs = find_series(options.files)
    check_output(options.out, options.force, logs)
    shifts = _shifts(logs, options.align)
    reading = Reading()
    with progress("looking through") as report:
        surveys = [_first_pass(series, report) for series in logs]
    streams = Counter(stream for survey in surveys for stream in survey.streams)
    shared = {stream for stream, count in streams.items() if count > 1}
    counted = {stream for survey in surveys for stream in survey.counted}
    seen = CopyFilter(shared)
    with progress("merging") as report, LogOutput(options.out, common_profile(logs)) as output:
        output.metadata(FILE, {"set": uuid.uuid4().hex, "file": "0"})
        tables = ExtrasMerger(logs, output)
        for number, item in _merged(logs, surveys, shifts, reading, report, options.out.parent):
            if not isinstance(item, Record):
                tables.take(number, item)
            elif options.keep_duplicates or not seen.is_copy(number, item, shifts[number]):
                again = item.stream in shared and item.stream in counted
                output.write(item, renumber=again)
        for stream in reading.seen:
            output.declare(stream)
        messages = output.messages
    console = plain_console()
    console.print(f"{options.out}: {messages} messages of {len(logs)} logs")
    for topic, copies in seen.copies.most_common(SHOWN):
        console.print(f"{topic}: {copies} messages were in several logs and are kept once")
    rest = seen.copies.total() - sum(n for _, n in seen.copies.most_common(SHOWN))
    if rest:
        console.print(f"{rest} messages of other topics likewise")
    if remark := reading.remark():
        console.print(f"{remark}: merged what could be read")
    return 0


@dataclass(slots=True)
class Survey:
    """Findings of the first pass over a log. ``counted``: streams whose messages are numbered."""

    streams: dict[Stream, Stream] = field(default_factory=dict)
    counted: set[Stream] = field(default_factory=set)
    stretches: Stretches = field(default_factory=Stretches)


def _first_pass(series: Series, report: Any) -> Survey:
    survey, reading = Survey(), Reading()
    for item in read_series(series, reading, report):
        if isinstance(item, Record):
            survey.stretches.survey(item)
            if item.sequence:
                survey.counted.add(item.stream)
    survey.stretches.finish()
    survey.streams = reading.seen
    return survey


def _merged(
    logs: list[Series],
    surveys: list[Survey],
    shifts: list[int],
    reading: Reading,
    progress: Any,
    folder: Path,
) -> Iterator[tuple[int, Item]]:
    """Yield everything in the logs with the index of the log, messages in the order of time."""
    total = sum(series.size for series in logs)
    done = [0] * len(logs)

    def numbered(number: int) -> Iterator[tuple[int, int, int, Item]]:
        def report(position: int, _: int) -> None:
            done[number] = position
            progress(sum(done), total)

        shift = shifts[number]
        time = max(0, surveys[number].stretches.first_ns + shift)
        items = read_series(logs[number], reading, report if progress is not None else None)
        ordered = TimeSorter(surveys[number].stretches, folder).sort(items)
        for count, item in enumerate(ordered):
            if isinstance(item, Record):
                if shift:
                    item = item._replace(
                        log_ns=max(0, item.log_ns + shift),
                        publish_ns=max(0, item.publish_ns + shift),
                    )
                time = item.log_ns
            yield time, number, count, item

    for _, number, _, item in heapq.merge(*(numbered(k) for k in range(len(logs)))):
        yield number, item


def _shifts(logs: list[Series], align: bool) -> list[int]:
    """Nanoseconds to add to the times of each log, so that all logs share one clock."""
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


class CopyFilter:
    """Recognises messages that another log has already written, in streams that several logs share.

    A copy has the same bytes and the same stamp of its sender, and was logged at about the same
    time. Where the sender's stamp is unknown (0), the log time must be the same. What one log holds
    twice is not a copy. ``copies``: number of copies by topic.
    """

    def __init__(self, shared: set[Stream]) -> None:
        self.copies: Counter[str] = Counter()
        self._shared = shared
        self._seen: dict[tuple[Stream, bytes], list[int]] = {}  # number written, then by log
        self._order: deque[tuple[int, tuple[Stream, bytes]]] = deque()

    def is_copy(self, number: int, record: Record, shift: int = 0) -> bool:
        """Return whether a message of log ``number`` repeats one of another log, and count it.

        ``shift``: ns that were added to the times of this log.
        """
        stream = record.stream
        if stream not in self._shared:
            return False
        self._forget(record.log_ns)
        sent = record.publish_ns - shift if record.publish_ns else record.log_ns
        digest = hashlib.blake2b(
            record.data, digest_size=16, salt=sent.to_bytes(16, "little", signed=True)
        )
        key = stream, digest.digest()
        counts = self._seen.get(key)
        if counts is None:
            counts = self._seen[key] = [0]
            self._order.append((record.log_ns, key))
        counts += [0] * (number + 2 - len(counts))
        counts[number + 1] += 1
        if counts[number + 1] <= counts[0]:
            self.copies[stream.topic] += 1
            return True
        counts[0] += 1
        return False

    def _forget(self, now_ns: int) -> None:
        """Drop messages that are too old to be repeated."""
        order = self._order
        while order and (order[0][0] < now_ns - COPY_WITHIN_NS or len(order) > REMEMBERED):
            del self._seen[order.popleft()[1]]


class ExtrasMerger:
    """Metadata and attachments of several logs: those that differ get the name of their log.

    What one log holds twice stays twice; what another log holds in the same form is not added.
    """

    def __init__(self, logs: list[Series], output: LogOutput) -> None:
        self._logs = logs
        self._output = output
        self._owners: dict[tuple[type, str], int] = {}
        self._counts: dict[tuple[str, bytes], list[int]] = {}

    def take(self, number: int, item: MetadataRecord | Attachment) -> None:
        """Copy an item to the output, unless another log had it."""
        if isinstance(item, MetadataRecord):
            if item.name == FILE:
                return
            if item.name == GAP:
                self._output.metadata(item.name, item.values)
            elif self._is_new(number, item.name, repr(sorted(item.values.items())).encode()):
                own = self._is_own(number, item)
                name = item.name if own else f"{item.name}@{self._stem(number)}"
                self._output.metadata(name, item.values)
        elif self._is_new(number, item.name, item.digest()):
            own = self._is_own(number, item)
            name = item.name if own else f"{self._stem(number)}.{item.name}"
            self._output.attach(item._replace(name=name))

    def _is_new(self, number: int, name: str, contents: bytes) -> bool:
        digest = hashlib.blake2b(contents, digest_size=16).digest()
        counts = self._counts.setdefault((name, digest), [0])
        counts += [0] * (number + 2 - len(counts))
        counts[number + 1] += 1
        if counts[number + 1] <= counts[0]:
            return False
        counts[0] += 1
        return True

    def _is_own(self, number: int, item: MetadataRecord | Attachment) -> bool:
        """Return whether this log is the first to have an item of that name."""
        return self._owners.setdefault((type(item), item.name), number) == number

    def _stem(self, number: int) -> str:
        return self._logs[number].paths[0].stem
