"""Logs as one stream of messages: several files as one, several logs in the order of time.

Constant memory: one chunk a log, whatever their length.
"""

from __future__ import annotations

import fnmatch
import hashlib
import heapq
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from tactile_core.log.info import Extras
from tactile_core.log.reader import ANY, LogReader
from tactile_core.log.recorder import Repeats, is_latched
from tactile_core.log.records import (
    AttachmentRecord,
    Block,
    ChannelRecord,
    MetadataRecord,
    Progress,
    SchemaRecord,
)
from tactile_core.log.writer import GAP
from tactile_tools.log.sources import FILE, Series
from tactile_tools.log.terminal import ToolError, shown

NAMED = 20
"""Topics named when one that was asked for is not there."""


class Stream:
    """What a channel carries, the same for every file that says the same of it. Immutable.

    ``metadata``: of the channel, as pairs in order.
    """

    __slots__ = (
        "_hash",
        "_key",
        "definition",
        "encoding",
        "metadata",
        "msgtype",
        "schema_encoding",
        "topic",
    )

    def __init__(
        self,
        topic: str,
        msgtype: str,
        schema_encoding: str,
        definition: bytes,
        encoding: str,
        metadata: tuple[tuple[str, str], ...] = (),
    ) -> None:
        self.topic = topic
        self.msgtype = msgtype
        self.schema_encoding = schema_encoding
        self.definition = definition
        self.encoding = encoding
        self.metadata = metadata
        self._key = topic, msgtype, schema_encoding, encoding, metadata, definition
        self._hash = hash(self._key)  # looked up with every message

    def __hash__(self) -> int:
        return self._hash

    def __eq__(self, other: object) -> bool:
        if self is other:
            return True
        return isinstance(other, Stream) and self._key == other._key

    def __repr__(self) -> str:
        return f"Stream({self.topic!r}, {self.msgtype!r})"


class Record(NamedTuple):
    """One message; stamps in wall-clock ns."""

    stream: Stream
    sequence: int
    log_ns: int
    publish_ns: int
    data: bytes


class Attachment(NamedTuple):
    """A file within the log; ``pieces``: makes its ``size`` bytes, while the log is being read."""

    name: str
    media_type: str
    log_ns: int
    create_ns: int
    size: int
    pieces: Callable[[], Iterable[bytes]]

    def read(self) -> bytes:
        """All of it, for what is known to be small."""
        return b"".join(self.pieces())

    def digest(self) -> bytes:
        """Stands for name, type and contents."""
        digest = hashlib.blake2b(f"{self.name}\0{self.media_type}\0".encode(), digest_size=16)
        for piece in self.pieces():
            digest.update(piece)
        return digest.digest()

    @classmethod
    def of(cls, name: str, media_type: str, log_ns: int, create_ns: int, data: bytes) -> Attachment:
        """One whose bytes are at hand."""
        return cls(name, media_type, log_ns, create_ns, len(data), lambda: (data,))


Item = Record | MetadataRecord | Attachment

Wanted = Callable[[str], bool]
"""Tells by its topic whether a stream is wanted."""


@dataclass(slots=True)
class Reading:
    """What became of reading: whether every byte was readable, and the writer of the first file.

    ``messages_lost``: as far as they can be counted; ``lost_unknown``: places where they cannot.
    """

    damages: int = 0
    messages_lost: int = 0
    lost_unknown: int = 0
    unclosed: int = 0
    orphans: int = 0
    library: str = ""
    profile: str = ""
    seen: dict[Stream, Stream] = field(default_factory=dict)

    def intern(self, stream: Stream) -> Stream:
        """The one object that stands for all equal streams; noted as seen."""
        return self.seen.setdefault(stream, stream)

    @property
    def lossy(self) -> bool:
        """Whether messages of the files could not be handed out."""
        return bool(self.messages_lost or self.lost_unknown or self.orphans)

    def remark(self) -> str:
        """What to say of logs that are not whole; empty for whole ones."""
        parts = []
        if self.unclosed:
            parts.append(f"{self.unclosed} not closed")
        if self.damages:
            parts.append(f"{self.damages} damaged places passed over")
        if self.messages_lost:
            parts.append(f"{self.messages_lost} messages lost")
        if self.lost_unknown:
            parts.append(f"an unknown number of messages lost at {self.lost_unknown} places")
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

    What a later file repeats at its start is left out: tables, attachments, and messages that hold.
    """
    total = sum(path.stat().st_size for path in series.paths)
    done = 0
    held = _Held(series=bool(series.identity) and len(series.paths) > 1)
    for number, path in enumerate(series.paths):
        report = _part(progress, done, total)
        held.later = held.series and number > 0
        held.repeats.next_file()
        held.extras.next_file()
        yield from _read_file(path, reading, report, wanted, window, held)
        done += path.stat().st_size


def _part(progress: Progress | None, before: int, total: int) -> Progress | None:
    if progress is None:
        return None
    return lambda done, size: progress(before + done, max(total, before + size))


@dataclass(slots=True)
class _Held:
    """What the files of a log so far hold that a later one may repeat."""

    repeats: Repeats = field(default_factory=Repeats)
    extras: Extras = field(default_factory=Extras)
    series: bool = False  # there are several files, of one log
    later: bool = False  # this is not the first of them


def _read_file(
    path: Path,
    reading: Reading,
    progress: Progress | None,
    wanted: Wanted | None,
    window: tuple[int, int] | None,
    held: _Held,
) -> Iterator[Item]:
    streams: dict[int, tuple[Stream, bool] | None] = {}
    unwanted: set[int] = set()  # channels
    with LogReader(path, progress, window=window) as reader:
        for event in reader.events():
            if isinstance(event, Block):
                held.extras.begin_messages()
                for message in reader.messages(event, unwanted):
                    if window is not None and not window[0] <= message.log_ns <= window[1]:
                        continue
                    number = message.channel
                    found = streams.get(number)
                    if found is None:
                        if number in unwanted:
                            continue
                        stream = _stream(number, reader)
                        if stream is None:
                            reading.orphans += 1
                            continue
                        stream = reading.intern(stream)
                        if wanted is not None and not wanted(stream.topic):
                            unwanted.add(number)
                            continue
                        latched = is_latched(stream.topic, dict(stream.metadata))
                        found = streams[number] = stream, latched
                    stream, latched = found
                    if latched and held.repeats.is_repeat(stream, message) and held.later:
                        continue
                    yield Record(
                        stream, message.sequence, message.log_ns, message.publish_ns, message.data
                    )
            elif isinstance(event, MetadataRecord):
                key = "table", event.name, tuple(event.values.items())
                if event.name == GAP or not (held.extras.is_repeat(hash(key)) and held.later):
                    yield event
            else:
                attachment = _attachment(reader, event)
                # It is read for that: only where there can be another.
                repeat = held.series and held.extras.is_repeat(attachment.digest())
                if not (repeat and held.later):
                    yield attachment
        for channel in reader.channels:
            if (stream := _stream(channel, reader)) is not None:
                reading.intern(stream)
        reading.damages += reader.damage_count
        reading.messages_lost += reader.messages_lost
        reading.lost_unknown += reader.lost_unknown
        reading.unclosed += not reader.closed
        reading.library = reading.library or reader.library
        reading.profile = reading.profile or reader.profile


def _attachment(reader: LogReader, record: AttachmentRecord) -> Attachment:
    def pieces() -> Iterator[bytes]:
        return reader.pieces_at(record.position, record.size)

    return Attachment(
        record.name, record.media_type, record.log_ns, record.create_ns, record.size, pieces
    )


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
    found = []
    for series in logs:
        for path in series.paths:
            with LogReader(path) as reader:
                start = next(
                    (
                        min(times)
                        for event in reader.events()
                        if isinstance(event, Block)
                        and (times := [m.log_ns for m in reader.messages(event, ANY)])
                    ),
                    None,
                )
            if start is not None:
                found.append(start)
                break
    return min(found, default=0)


def common_profile(logs: Sequence[Series]) -> str:
    """The profile of all files of the logs; empty where they differ."""
    found = set()
    for series in logs:
        for path in series.paths:
            with LogReader(path) as reader:
                for _ in reader.events():
                    break  # the header comes before everything else
                found.add(reader.profile)
    return found.pop() if len(found) == 1 else ""


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
            held = ", ".join(map(shown, topics[:NAMED])) if topics else "no topic at all"
            if len(topics) > NAMED:
                held += f" and {len(topics) - NAMED} more: tactile log info lists them"
            raise ToolError(f"no topic {pattern!r} in {logs[0].name}; it holds {held}")


def all_topics(logs: Sequence[Series]) -> set[str]:
    """Topics of the logs; a whole pass over files that were not closed, else their summaries."""
    topics: set[str] = set()
    for series in logs:
        for path in series.paths:
            with LogReader(path) as reader:
                for event in reader.events():
                    if reader.summary is not None and reader.summary.knows_all_channels:
                        break
                    if isinstance(event, Block):
                        for _ in reader.messages(event, ANY):
                            pass
                topics |= {channel.topic for channel in reader.channels.values()}
    return topics


__all__ = ["FILE", "Attachment", "Reading", "Record", "Stream", "read_merged", "read_series"]
