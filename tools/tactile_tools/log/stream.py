"""Logs as one stream of messages: several files as one log, several logs in the order of time.

Memory is constant: one chunk per log, however long.
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
"""Topics that an error names when the wanted one is missing."""


class Stream:
    """Content of a channel; equal for all files that describe it alike. Immutable.

    Comments in the definition do not count: they changed between versions of this software, and
    two logs of one topic stay one topic. ``metadata``: of the channel, as sorted pairs.
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
        layout = _layout(definition) if schema_encoding == "ros2msg" else definition
        self._key = topic, msgtype, schema_encoding, encoding, metadata, layout
        self._hash = hash(self._key)  # looked up with every message

    def __hash__(self) -> int:
        return self._hash

    def __eq__(self, other: object) -> bool:
        if self is other:
            return True
        return isinstance(other, Stream) and self._key == other._key

    def __repr__(self) -> str:
        return f"Stream({self.topic!r}, {self.msgtype!r})"


def _layout(definition: bytes) -> bytes:
    """Return a ``ros2msg`` definition without its comments and spacing."""
    lines = []
    for line in definition.splitlines():
        # The value of a text constant or default may contain a # that begins no comment.
        is_text = line.lstrip().startswith((b"string", b"wstring"))
        has_value = any(sign in line for sign in (b"=", b'"', b"'"))
        words = line.split() if is_text and has_value else line.partition(b"#")[0].split()
        if words:
            lines.append(b" ".join(words))
    return b"\n".join(lines)


class Record(NamedTuple):
    """A message; stamps in wall-clock ns."""

    stream: Stream
    sequence: int
    log_ns: int
    publish_ns: int
    data: bytes


class Attachment(NamedTuple):
    """A file within the log. ``pieces``: yields its ``size`` bytes while the log is being read."""

    name: str
    media_type: str
    log_ns: int
    create_ns: int
    size: int
    pieces: Callable[[], Iterable[bytes]]

    def read(self) -> bytes:
        """Return all bytes, for an attachment known to be small."""
        return b"".join(self.pieces())

    def digest(self) -> bytes:
        """Hash of name, type and contents."""
        digest = hashlib.blake2b(f"{self.name}\0{self.media_type}\0".encode(), digest_size=16)
        for piece in self.pieces():
            digest.update(piece)
        return digest.digest()

    @classmethod
    def of(cls, name: str, media_type: str, log_ns: int, create_ns: int, data: bytes) -> Attachment:
        """Make an attachment of ``data``."""
        return cls(name, media_type, log_ns, create_ns, len(data), lambda: (data,))


Item = Record | MetadataRecord | Attachment

Wanted = Callable[[str], bool]
"""Returns whether the stream of a topic is wanted."""


@dataclass(slots=True)
class Reading:
    """State and findings of reading: damage, losses, and the writer of the first file.

    ``messages_lost``: messages lost, as far as they can be counted. ``lost_unknown``: places with
    an unknown number of lost messages.
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
        """Return the one object for all equal streams, and note it as seen."""
        return self.seen.setdefault(stream, stream)

    @property
    def lossy(self) -> bool:
        """Whether some messages of the files could not be returned."""
        return bool(self.messages_lost or self.lost_unknown or self.orphans)

    def remark(self) -> str:
        """Describe what is wrong with the files; empty if nothing is."""
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
    """Yield everything in one log, file by file. ``window``: log times in ns, both inclusive.

    Tables, attachments and latched messages that a later file repeats at its start are left out.
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
    """Contents of the files read so far that a later file may repeat."""

    repeats: Repeats = field(default_factory=Repeats)
    extras: Extras = field(default_factory=Extras)
    series: bool = False  # several files of one log
    later: bool = False  # not the first file


def _read_file(
    path: Path,
    reading: Reading,
    progress: Progress | None,
    wanted: Wanted | None,
    window: tuple[int, int] | None,
    held: _Held,
) -> Iterator[Item]:
    streams: dict[int, tuple[Stream, bool] | None] = {}
    unwanted: set[int] = set()  # channel numbers
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
                # The attachment is read for its digest, so only where it can be a repetition.
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
    """Make the stream of a channel; its type is empty if the schema is lost."""
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
    """Yield everything in several logs with the index of the log, messages in the order of time.

    Each log keeps its own order; metadata and attachments come just before the message that follows
    them.
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
            time = max(time, item.log_ns)  # a log's own order is kept even where its times go back
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
    """Log time of the first message, at which relative times begin; 0 if there is none."""
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
    """Profile of all files; empty where they differ."""
    found = set()
    for series in logs:
        for path in series.paths:
            with LogReader(path) as reader:
                for _ in reader.events():
                    break  # the header comes first
                found.add(reader.profile)
    return found.pop() if len(found) == 1 else ""


def matcher(patterns: Sequence[str] | None) -> Wanted | None:
    """Make a function that matches topics with any pattern, leading slash optional.

    None, for no patterns, matches all.
    """
    if not patterns:
        return None
    plain = [pattern.lstrip("/") for pattern in patterns]
    return lambda topic: any(fnmatch.fnmatchcase(topic.lstrip("/"), each) for each in plain)


def require_topics(patterns: Sequence[str] | None, logs: Sequence[Series]) -> None:
    """`ToolError` for a pattern that matches no topic; it names the topics there are."""
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
    """Topics of the logs.

    They come from the summaries, or from a whole pass over files that were not closed.
    """
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
