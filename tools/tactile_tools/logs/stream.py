"""Logs as one stream of messages: several files as one, several logs in the order of time.

Constant memory: one chunk a log, whatever their length.
"""

from __future__ import annotations

import fnmatch
import heapq
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from tactile_bus.log_bytes import Progress
from tactile_bus.log_reader import LogReader
from tactile_bus.log_records import (
    AttachmentRecord,
    Block,
    ChannelRecord,
    Message,
    MetadataRecord,
    SchemaRecord,
)
from tactile_tools.logs.sources import FILE, Series
from tactile_tools.logs.terminal import ToolError

MAX_ATTACHMENT = 256 << 20
"""Bytes of an attachment that is read at once: calibrations and configurations have kilobytes."""


@dataclass(frozen=True, slots=True)
class Stream:
    """What a channel carries, the same for every file that says the same of it."""

    topic: str
    msgtype: str
    schema_encoding: str
    definition: bytes
    encoding: str
    metadata: tuple[tuple[str, str], ...] = ()


class Record(NamedTuple):
    """One message; stamps in wall-clock ns."""

    stream: Stream
    sequence: int
    log_ns: int
    publish_ns: int
    data: bytes


class Attachment(NamedTuple):
    """A file within the log."""

    name: str
    media_type: str
    log_ns: int
    create_ns: int
    data: bytes


Item = Record | MetadataRecord | Attachment

Wanted = Callable[[str], bool]
"""Tells by its topic whether a stream is wanted."""


@dataclass(slots=True)
class Reading:
    """What became of reading: whether every byte was readable, and the writer of the first file."""

    damages: int = 0
    unclosed: int = 0
    orphans: int = 0
    library: str = ""
    profile: str = ""
    seen: dict[Stream, None] = field(default_factory=dict)

    def remark(self) -> str:
        """What to say of logs that are not whole; empty for whole ones."""
        parts = []
        if self.unclosed:
            parts.append(f"{self.unclosed} not closed")
        if self.damages:
            parts.append(f"{self.damages} damaged places passed over")
        if self.orphans:
            parts.append(f"{self.orphans} messages of channels defined nowhere left out")
        return ", ".join(parts)


def read_series(
    series: Series,
    reading: Reading,
    progress: Progress | None = None,
    wanted: Wanted | None = None,
    window: tuple[int, int] | None = None,
) -> Iterator[Item]:
    """Everything of one log, its files one after another. ``window``: log times in ns, inclusive.

    Messages that a later file repeats at its start are left out; metadata and attachments are not.
    """
    total = sum(path.stat().st_size for path in series.paths)
    done = 0
    last: dict[Stream, int] = {}
    for number, path in enumerate(series.paths):
        report = _part(progress, done, total)
        ours = bool(series.identity) and number > 0
        yield from _read_file(path, reading, report, wanted, window, last, ours)
        done += path.stat().st_size


def _part(progress: Progress | None, before: int, total: int) -> Progress | None:
    if progress is None:
        return None
    return lambda done, size: progress(before + done, max(total, before + size))


def _read_file(
    path: Path,
    reading: Reading,
    progress: Progress | None,
    wanted: Wanted | None,
    window: tuple[int, int] | None,
    last: dict[Stream, int],
    later: bool,
) -> Iterator[Item]:
    streams: dict[int, Stream | None] = {}
    with LogReader(path, progress, window=window) as reader:
        for event in reader.events():
            if isinstance(event, MetadataRecord):
                yield event
            elif isinstance(event, AttachmentRecord):
                if event.size <= MAX_ATTACHMENT:
                    data = reader.read_at(event.position, event.size)
                    yield Attachment(
                        event.name, event.media_type, event.log_ns, event.create_ns, data
                    )
            else:
                for message in reader.messages(event):
                    if window is not None and not window[0] <= message.log_ns <= window[1]:
                        continue
                    number = message.channel
                    if number not in streams:
                        stream = _stream(number, reader)
                        if stream is None:
                            reading.orphans += 1
                            continue
                        reading.seen[stream] = None
                        use = wanted is None or wanted(stream.topic)
                        streams[number] = stream if use else None
                    found = streams[number]
                    if found is None:
                        continue
                    if later and _repeats(message, last.get(found)):
                        continue
                    last[found] = message.sequence
                    yield Record(
                        found, message.sequence, message.log_ns, message.publish_ns, message.data
                    )
        for channel in reader.channels:
            if (stream := _stream(channel, reader)) is not None:
                reading.seen[stream] = None
        reading.damages += reader.damage_count
        reading.unclosed += not reader.closed
        reading.library = reading.library or reader.library
        reading.profile = reading.profile or reader.profile


def _repeats(message: Message, last: int | None) -> bool:
    return last is not None and (message.sequence - last - 1) & 0xFFFFFFFF >= 1 << 31


def _stream(number: int, reader: LogReader) -> Stream | None:
    channel = reader.channels.get(number)
    if channel is None:
        return None
    return stream_of(channel, reader.schemas.get(channel.schema))


def stream_of(channel: ChannelRecord, schema: SchemaRecord | None) -> Stream:
    """The stream of a channel; without a type where its schema is lost."""
    return Stream(
        topic=channel.topic,
        msgtype=schema.name if schema else "",
        schema_encoding=schema.encoding if schema else "",
        definition=schema.data if schema else b"",
        encoding=channel.encoding,
        metadata=tuple(sorted(channel.metadata.items())),
    )


def read_merged(
    logs: Sequence[Series],
    reading: Reading,
    progress: Progress | None = None,
    wanted: Wanted | None = None,
    window: tuple[int, int] | None = None,
) -> Iterator[tuple[int, Item]]:
    """Everything of several logs with the number of the log, messages in the order of time.

    Within a log the order is its own; metadata and attachments come with the message after them.
    """
    if len(logs) == 1:
        for item in read_series(logs[0], reading, progress, wanted, window):
            yield 0, item
        return
    sizes = [series.size for series in logs]
    done = [0] * len(logs)

    def numbered(number: int) -> Iterator[tuple[int, int, int, Item]]:
        def report(position: int, _: int) -> None:
            done[number] = position
            if progress is not None:
                progress(sum(done), sum(sizes))

        count = 0
        waiting: list[Item] = []
        time = 0
        for item in read_series(logs[number], reading, report, wanted, window):
            if not isinstance(item, Record):
                waiting.append(item)
                continue
            time = max(time, item.log_ns)  # the order of a log is kept even where its times go back
            for each in (*waiting, item):
                yield time, number, count, each
                count += 1
            waiting.clear()
        for each in waiting:
            yield time, number, count, each
            count += 1

    for _, number, _, item in heapq.merge(*(numbered(k) for k in range(len(logs)))):
        yield number, item


def first_ns(logs: Sequence[Series]) -> int:
    """Log time of the first message of the logs, to which relative times are meant; 0 for none."""
    times = []
    for series in logs:
        for path in series.paths:
            with LogReader(path) as reader:
                start = next(
                    (
                        min(times)
                        for event in reader.events()
                        if isinstance(event, Block)
                        and (times := [m.log_ns for m in reader.messages(event)])
                    ),
                    None,
                )
            if start is not None:
                times.append(start)
                break
    return min(times, default=0)


def matcher(patterns: Sequence[str] | None) -> Wanted | None:
    """Tells topics that match any of the patterns, the leading slash left out or not; None: all."""
    if not patterns:
        return None
    plain = [pattern.lstrip("/") for pattern in patterns]
    return lambda topic: any(fnmatch.fnmatchcase(topic.lstrip("/"), each) for each in plain)


def require_topics(patterns: Sequence[str] | None, logs: Sequence[Series]) -> None:
    """`ToolError` for a pattern that no topic of the logs matches; names those there are."""
    if not patterns:
        return
    topics = sorted(all_topics(logs))
    for pattern in patterns:
        wanted = matcher([pattern])
        if wanted is not None and not any(map(wanted, topics)):
            held = ", ".join(topics) if topics else "no topic at all"
            raise ToolError(f"no topic {pattern!r} in {logs[0].name}; it holds {held}")


def all_topics(logs: Sequence[Series]) -> set[str]:
    """Topics of the logs; a whole pass over files that were not closed, else their summaries."""
    topics: set[str] = set()
    for series in logs:
        for path in series.paths:
            with LogReader(path) as reader:
                for event in reader.events():
                    if reader.closed and reader.channels:
                        break
                    if isinstance(event, Block):
                        for _ in reader.messages(event):
                            pass
                topics |= {channel.topic for channel in reader.channels.values()}
    return topics


__all__ = ["FILE", "Attachment", "Reading", "Record", "Stream", "read_merged", "read_series"]
