"""Content of a log: channels, rates, times, losses and their places. Constant memory."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tactile_core.bus.topics import find_topic
from tactile_core.log.reader import LogReader
from tactile_core.log.recorder import Repeats, is_latched
from tactile_core.log.records import (
    AttachmentRecord,
    Block,
    ChannelRecord,
    Damage,
    Message,
    MetadataRecord,
    Progress,
    SchemaRecord,
)
from tactile_core.log.writer import DROPPED, GAP
from tactile_core.types import NS_PER_S

DIAGNOSTICS_TYPE = "diagnostic_msgs/msg/DiagnosticArray"
EVENT_TYPE = "tactile_msgs/msg/ReachEvent"

FILE = "file"
"""Metadata table that identifies a file within its log."""

MAX_NAME = 4096
"""Most characters kept of an attachment's name."""

MAX_EXTRAS = 65_536
"""Most tables and attachments remembered to recognise repetitions in later files."""

MAX_LISTED = 1000
"""Most gaps, silences, tables and attachments kept individually; further ones are only counted."""

MAX_TABLE_BYTES = 16 << 20
"""Most bytes of all kept tables; real ones have a few kB."""

MAX_STAMP_NS = (1 << 63) - 1
"""Latest time in signed 64-bit ns (in the year 2262); ROS cannot express a later one."""

MAX_HOLES = 256
"""Most ranges of missing numbers per channel in which late messages are recognised."""

MASK = 0xFFFFFFFF
HALF = 1 << 31

ONE_COUNTER_SHARE = 0.99
"""Fraction of changes between channels at which the number rises if one counter serves all
channels. With one counter per channel it falls about as often as it rises."""

SETTLED = 20
"""Messages after which a channel's usual period is known well enough to call a pause a silence."""

BACK_LEAST_NS = NS_PER_S // 100
"""Smaller backward steps of a channel's times come from threads overtaking one another."""

CLOCK_WINDOW = 100
"""Messages per window in which the smallest delay from stamp to logging shows the offset of the
clocks, as delays only add."""

CLOCK_STEP_NS = NS_PER_S // 2
"""Change between two windows that means a clock was set."""

SILENCE_PERIODS = 10
SILENCE_LEAST_NS = NS_PER_S // 2
"""A silence is a pause of more than ten usual periods and half a second; shorter ones are
jitter."""


@dataclass(frozen=True, slots=True)
class Silence:
    """Pause in a stream that is too long for its rate."""

    first_ns: int
    last_ns: int


@dataclass(slots=True)
class ChannelInfo:
    """One stream of a log.

    ``missing``: messages whose sequence numbers are not in the log; 0 if the number never changes,
    as then nothing is counted. ``steady``: whether the stream should have a rate, so that pauses
    are significant. ``impossible``: messages stamped later than `MAX_STAMP_NS`, the first of them
    at ``impossible_ns``.
    """

    topic: str
    msgtype: str
    steady: bool = True
    messages: int = 0
    first_ns: int = 0
    last_ns: int = 0
    missing: int = 0
    longest_ns: int = 0
    silences: list[Silence] = field(default_factory=list)
    silence_count: int = 0
    backwards: int = 0
    furthest_back_ns: int = 0
    impossible: int = 0
    impossible_ns: int = 0
    clock_steps: list[tuple[int, int]] = field(default_factory=list)  # log time, change in ns
    _sequence: int | None = None
    _holes: list[tuple[int, int]] = field(default_factory=list)  # first and last missing number
    _period: float = 0.0
    _prior_ns: int = 0
    _least: int | None = None  # log time minus stamp, in this window
    _before: int | None = None  # the same in the previous window

    @property
    def rate(self) -> float:
        """Mean rate in Hz; 0 for fewer than two messages."""
        span = self.last_ns - self.first_ns
        return (self.messages - 1) * NS_PER_S / span if self.messages > 1 and span > 0 else 0.0

    def take(self, message: Message, from_start: bool) -> None:
        """Count one message; ``from_start``: this file is the first of its log."""
        log_ns, sequence = message.log_ns, message.sequence
        last = self._sequence
        if last is None:
            self._sequence = sequence
            if from_start and sequence:
                self._skipped(0, sequence)
        elif sequence == last + 1:
            self._sequence = sequence
        elif sequence != last:
            self._number(sequence, last)
        if not self.messages:
            self.first_ns = self.last_ns = log_ns
        self._watch_clock(log_ns, message.publish_ns)
        if log_ns > MAX_STAMP_NS or message.publish_ns > MAX_STAMP_NS:
            self.impossible_ns = self.impossible_ns or max(log_ns, message.publish_ns)
            self.impossible += 1
        pause = log_ns - self.last_ns
        back = self._prior_ns - log_ns
        if back > BACK_LEAST_NS:
            self.backwards += 1
            self.furthest_back_ns = max(self.furthest_back_ns, back)
        self._prior_ns = log_ns
        self.longest_ns = max(self.longest_ns, pause)
        usual = max(SILENCE_PERIODS * self._period, SILENCE_LEAST_NS)
        if self.steady and self.messages > SETTLED and pause > usual:
            self.silence_count += 1
            if len(self.silences) < MAX_LISTED:
                self.silences.append(Silence(self.last_ns, log_ns))
        elif self.messages:
            weight = max(1 / self.messages, 1 / SETTLED)
            self._period += weight * (pause - self._period)
        self.first_ns = min(self.first_ns, log_ns)
        self.last_ns = max(self.last_ns, log_ns)
        self.messages += 1

    def _number(self, sequence: int, last: int) -> None:
        """Handle a number out of sequence: after missing ones, or a late one of those."""
        if (sequence - last) & MASK < HALF:
            self._sequence = sequence
            self._skipped((last + 1) & MASK, sequence)
            return
        for place, (first, end) in enumerate(self._holes):
            if first <= sequence <= end:
                left = [(first, sequence - 1), (sequence + 1, end)]
                self._holes[place : place + 1] = [hole for hole in left if hole[0] <= hole[1]]
                self.missing -= 1
                return

    def _skipped(self, first: int, sequence: int) -> None:
        """Count the numbers from ``first`` to before ``sequence`` as missing so far."""
        self.missing += (sequence - first) & MASK
        if first < sequence:
            self._holes.append((first, sequence - 1))
            del self._holes[:-MAX_HOLES]

    def _watch_clock(self, log_ns: int, publish_ns: int) -> None:
        """Detect a step between the clock of the stamps and that of the log."""
        if not publish_ns:
            return
        late = log_ns - publish_ns
        self._least = late if self._least is None else min(self._least, late)
        if (self.messages + 1) % CLOCK_WINDOW:
            return
        change = 0 if self._before is None else self._least - self._before
        if abs(change) > CLOCK_STEP_NS and len(self.clock_steps) < MAX_LISTED:
            self.clock_steps.append((log_ns, change))
        self._before, self._least = self._least, None


@dataclass(frozen=True, slots=True)
class GapInfo:
    """Losses reported by the recorder; see `tactile_core.log.writer`."""

    reason: str
    first_ns: int
    last_ns: int
    messages: int
    detail: str
    channels: dict[str, int]


@dataclass(frozen=True, slots=True)
class TableInfo:
    """A metadata table in a log."""

    name: str
    values: dict[str, str]


@dataclass(frozen=True, slots=True)
class AttachmentInfo:
    """An attachment in a log; ``size`` in bytes."""

    name: str
    media_type: str
    size: int


@dataclass(slots=True)
class LogInfo:
    """Everything that `tactile log info` shows.

    ``drops``: last counts by source and reason. ``path``: the first file; ``files``: how many.
    ``missing_files``: missing numbers between the first and the last. ``outcomes``: of the reaches
    in it. ``tables`` and ``files_within``: the first MAX_LISTED of each, without repetitions in
    later files; ``metadata`` and ``attachments``: the last of each name. ``indexed``: all messages
    are in chunks known to the summaries, as are all channels. ``one_counter``: messages are
    numbered across all channels; then ``numbers_missing`` counts instead of each channel's
    ``missing``.
    """

    path: Path
    files: int = 1
    size: int = 0
    profile: str = ""
    library: str = ""
    closed: bool = True
    channels: list[ChannelInfo] = field(default_factory=list)
    orphans: int = 0
    gaps: list[GapInfo] = field(default_factory=list)
    gap_count: int = 0
    drops: dict[str, dict[str, int]] = field(default_factory=dict)
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    attachments: dict[str, tuple[str, int]] = field(default_factory=dict)
    tables: list[TableInfo] = field(default_factory=list)
    table_count: int = 0
    files_within: list[AttachmentInfo] = field(default_factory=list)
    attachment_count: int = 0
    indexed: bool = True
    one_counter: bool = False
    numbers_missing: int = 0
    damages: list[Damage] = field(default_factory=list)
    damage_count: int = 0
    bytes_damaged: int = 0
    messages_lost: int = 0
    lost_unknown: int = 0
    missing_files: list[int] = field(default_factory=list)
    outcomes: list[str] = field(default_factory=list)

    @property
    def messages(self) -> int:
        """Number of messages of all channels."""
        return sum(channel.messages for channel in self.channels)

    @property
    def span_ns(self) -> tuple[int, int] | None:
        """Times of the first and the last message; None without messages."""
        with_messages = [channel for channel in self.channels if channel.messages]
        if not with_messages:
            return None
        return min(c.first_ns for c in with_messages), max(c.last_ns for c in with_messages)

    @property
    def whole(self) -> bool:
        """Whether every file was finished in order and is fully readable."""
        return self.closed and not self.damage_count


def info(path: Path, progress: Progress | None = None) -> LogInfo:
    """Read a log from end to end and verify its checksums. Raises `LogError` if it is not a log."""
    return info_of([path], progress)


def info_of(
    paths: Sequence[Path],
    progress: Progress | None = None,
    watch: Callable[[ChannelRecord, SchemaRecord | None, Message], None] | None = None,
) -> LogInfo:
    """Like `info`, for a log in several files, in order. ``watch``: called with every message."""
    collector = _Collector(LogInfo(paths[0], len(paths)), watch)
    sizes = [_size(path) for path in paths]
    numbers: list[int] = []
    for index, path in enumerate(paths):
        before, total = sum(sizes[:index]), sum(sizes)

        def report(done: int, _: int, before: int = before, total: int = total) -> None:
            if progress is not None:
                progress(before + done, total)

        with LogReader(path, report if progress is not None else None) as reader:
            collector.take(reader, index > 0)
        number = collector.result.metadata.get("file", {}).get("file", "")
        if number.isdecimal():
            numbers.append(int(number))
    result = collector.finish()
    if len(numbers) == len(paths):
        result.missing_files = sorted(set(range(numbers[0], numbers[-1])) - set(numbers))
    return result


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except OSError:
        return 0  # opening it will report why


class Extras:
    """Recognises tables and attachments repeated at the start of a log's later files."""

    def __init__(self) -> None:
        self._seen: set[Hashable] = set()
        self._now: set[Hashable] = set()
        self._amid = False

    def next_file(self) -> None:
        """Start the next file of the log."""
        self._seen |= self._now
        self._now.clear()
        self._amid = False

    def begin_messages(self) -> None:
        """Note that nothing after this point is a repetition."""
        self._amid = True

    def is_repeat(self, key: Hashable) -> bool:
        """Whether ``key``, which identifies name and contents, was in an earlier file."""
        if len(self._seen) + len(self._now) < MAX_EXTRAS:
            self._now.add(key)
        return not self._amid and key in self._seen


class _Collector:
    """Collects the information from the files of a log."""

    def __init__(
        self,
        result: LogInfo,
        watch: Callable[[ChannelRecord, SchemaRecord | None, Message], None] | None,
    ) -> None:
        self.result = result
        self._watch = watch
        self._channels: dict[tuple[str, str], ChannelInfo] = {}
        self._numbers: dict[int, _ChannelState] = {}  # by channel number in this file
        self._without: set[int] = set()  # channels whose data is no longer needed
        self._repeats = Repeats()
        self._extras = Extras()
        self._table_bytes = 0
        self._number = (-1, -1)  # channel and sequence number of the last message
        self._changes = 0  # changes of channel, and those at which the number rose
        self._rises = 0

    @property
    def watched(self) -> bool:
        """Whether the first message of each channel is passed on."""
        return self._watch is not None

    def take(self, reader: LogReader, later: bool) -> None:
        """Read a file; ``later``: it is not the first one."""
        result = self.result
        self._numbers.clear()
        self._without.clear()
        self._repeats.next_file()
        self._extras.next_file()
        series = False
        for event in reader.events():
            if isinstance(event, MetadataRecord):
                if event.name == FILE:
                    series = "set" in event.values
                self._table(event, later and series)
            elif isinstance(event, AttachmentRecord):
                self._attachment(reader, event, later and series)
            else:
                self._extras.begin_messages()
                self._block(reader, event, later and series)
        for record in reader.channels.values():
            self._channel(reader, record)
        if reader.data_crc and not reader.damage_count and not reader.data_checksum_is_right():
            reader.note_damage(Damage(0, 0, "the checksum over all the data is wrong", 0))
        result.size += reader.size
        result.profile, result.library = reader.profile, reader.library
        result.closed &= reader.closed
        result.indexed &= reader.indexed
        result.damages += reader.damages[: MAX_LISTED - len(result.damages)]
        result.damage_count += reader.damage_count
        result.bytes_damaged += reader.bytes_damaged
        result.messages_lost += reader.messages_lost
        result.lost_unknown += reader.lost_unknown

    def finish(self) -> LogInfo:
        """Return the result after all files."""
        result = self.result
        result.channels = sorted(self._channels.values(), key=lambda channel: channel.topic)
        missing = sum(channel.missing for channel in result.channels)
        if missing and self._changes > 1 and self._rises >= ONE_COUNTER_SHARE * self._changes:
            result.one_counter = True
            for channel in result.channels:
                channel.missing = 0
        else:
            result.numbers_missing = 0
        return result

    def _channel(self, reader: LogReader, record: ChannelRecord) -> ChannelInfo:
        schema = reader.schemas.get(record.schema)
        key = record.topic, schema.name if schema else ""
        found = self._channels.get(key)
        if found is None:
            known = find_topic(record.topic)
            steady = known is None or known[0].rate > 0
            found = self._channels[key] = ChannelInfo(*key, steady=steady)
        return found

    def _block(self, reader: LogReader, block: Block, later: bool) -> None:
        result, numbers, without = self.result, self._numbers, self._without
        from_start = result.metadata.get(FILE, {}).get("file") == "0"
        last_channel, last = self._number
        unneeded = without if block.packed is None else _Unneeded(self, reader, without)
        for message in reader.messages(block, unneeded):
            number = message.channel
            state = numbers.get(number)
            if state is None:
                record = reader.channels.get(number)
                if record is None:
                    result.orphans += 1
                    continue
                state = numbers[number] = _ChannelState(
                    self._channel(reader, record),
                    record,
                    reader.schemas.get(record.schema),
                    is_latched(record.topic, record.metadata),
                )
                first = True
            else:
                first = False
            if state.latched and self._repeats.is_repeat(state.key, message) and later:
                continue
            sequence = message.sequence
            if number != last_channel:
                self._changes += last_channel >= 0
                self._rises += last_channel >= 0 and 0 < (sequence - last) & MASK < HALF
                last_channel = number
            if 1 < (sequence - last) & MASK < HALF and last >= 0:
                result.numbers_missing += (sequence - last - 1) & MASK
            last = sequence
            channel = state.channel
            channel.take(message, from_start)
            if channel.msgtype == DIAGNOSTICS_TYPE:
                _take_diagnostics(result, message)
            elif channel.msgtype == EVENT_TYPE:
                _take_event(result, message)
            elif not state.latched:
                without.add(number)
            if first and self._watch is not None:
                self._watch(state.record, state.schema, message)
        self._number = last_channel, last

    def _table(self, record: MetadataRecord, later: bool) -> None:
        key = record.name, hash(tuple(record.values.items()))
        repeated = record.name != GAP and self._extras.is_repeat(("table", *key))
        if later and (repeated or record.name == FILE):
            self.result.metadata[record.name] = record.values
            return
        self.result.table_count += 1
        size = len(record.name) + sum(len(k) + len(v) for k, v in record.values.items())
        self._table_bytes += size
        if self._table_bytes <= MAX_TABLE_BYTES:
            _take_metadata(self.result, record)
        elif record.name == GAP:
            self.result.gap_count += 1

    def _attachment(self, reader: LogReader, record: AttachmentRecord, later: bool) -> None:
        if self._extras.is_repeat(attachment_key(reader, record)) and later:
            return
        result = self.result
        result.attachment_count += 1
        if len(result.files_within) < MAX_LISTED:
            result.files_within.append(
                AttachmentInfo(record.name[:MAX_NAME], record.media_type[:MAX_NAME], record.size)
            )
            result.attachments[record.name[:MAX_NAME]] = (record.media_type, record.size)


class _Unneeded:
    """Channels whose data is not needed.

    Decided before their first message is read, as in a large chunk it may fill the memory.
    """

    def __init__(self, collector: _Collector, reader: LogReader, known: set[int]) -> None:
        self._collector = collector
        self._reader = reader
        self._known = known

    def __contains__(self, number: object) -> bool:
        if number in self._known:
            return True
        record = self._reader.channels.get(number) if isinstance(number, int) else None
        if record is None or self._collector.watched or is_latched(record.topic, record.metadata):
            return False
        schema = self._reader.schemas.get(record.schema)
        return schema is None or schema.name not in (DIAGNOSTICS_TYPE, EVENT_TYPE)


@dataclass(slots=True)
class _ChannelState:
    """State for the messages of one channel of a file."""

    channel: ChannelInfo
    record: ChannelRecord
    schema: SchemaRecord | None
    latched: bool

    @property
    def key(self) -> tuple[str, str]:
        """Key of the stream across all files."""
        return self.channel.topic, self.channel.msgtype


def attachment_key(reader: LogReader, record: AttachmentRecord) -> Hashable:
    """Key of an attachment's name and contents; reads it once more."""
    digest = hashlib.blake2b(digest_size=16)
    for piece in reader.pieces_at(record.position, record.size):
        digest.update(piece)
    return "attachment", record.name, record.media_type, digest.digest()


def _take_metadata(result: LogInfo, record: MetadataRecord) -> None:
    if record.name != GAP:
        if len(result.tables) < MAX_LISTED:
            result.tables.append(TableInfo(record.name, record.values))
            result.metadata[record.name] = record.values
        return
    result.gap_count += 1
    if len(result.gaps) < MAX_LISTED:
        values = record.values
        channels = {
            key.removeprefix(DROPPED): _number(text)
            for key, text in values.items()
            if key.startswith(DROPPED)
        }
        result.gaps.append(
            GapInfo(
                values.get("reason", ""),
                _number(values.get("first_ns", "")),
                _number(values.get("last_ns", "")),
                _number(values.get("messages", "")),
                values.get("detail", ""),
                channels,
            )
        )


def _take_diagnostics(result: LogInfo, message: Message) -> None:
    # Imported here: building the type store takes 0.2 s, and most uses of `log recover` do not need
    # it.
    from tactile_core.bus.messages import DROPS_PREFIX, DecodeError, codec

    try:
        array: Any = codec().decode(DIAGNOSTICS_TYPE, message.data)
    except DecodeError:
        return
    for status in array.status:
        counts = {
            pair.key.removeprefix(DROPS_PREFIX): _number(pair.value)
            for pair in status.values
            if pair.key.startswith(DROPS_PREFIX)
        }
        if counts and (status.name in result.drops or len(result.drops) < MAX_LISTED):
            result.drops[status.name] = counts


def _take_event(result: LogInfo, message: Message) -> None:
    from tactile_core.bus.messages import DecodeError, codec

    try:
        event: Any = codec().decode(EVENT_TYPE, message.data)
    except DecodeError:
        return
    if event.kind == "outcome" and len(result.outcomes) < MAX_LISTED:
        result.outcomes.append(f"{event.code}: {event.text}" if event.text else event.code)


def _number(text: str) -> int:
    try:
        return int(text)
    except ValueError:
        return 0
