"""What a log holds: channels, rates, times, losses and where they are. Constant memory."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tactile_bus.gaps import DROPPED, GAP
from tactile_bus.instant import NS_PER_S
from tactile_bus.log_bytes import Progress
from tactile_bus.log_reader import LogReader
from tactile_bus.log_records import (
    AttachmentRecord,
    ChannelRecord,
    Damage,
    Message,
    MetadataRecord,
    SchemaRecord,
)
from tactile_bus.topics import find_topic

DIAGNOSTICS_TYPE = "diagnostic_msgs/msg/DiagnosticArray"
EVENT_TYPE = "tactile_msgs/msg/ReachEvent"

MAX_LISTED = 1000
"""Gaps, silences, table and attachment names kept one by one; beyond that only counted."""

SETTLED = 20
"""Messages after which a channel's usual period is known well enough to call a pause a silence."""

BACK_LEAST_NS = NS_PER_S // 100
"""Times of a channel that go back by less are threads overtaking one another."""

CLOCK_WINDOW = 100
"""Messages of which the one logged soonest after its stamp tells how the two clocks stand: delays
only add."""

CLOCK_STEP_NS = NS_PER_S // 2
"""How much that must change from one such window to the next to be a clock that was set."""

SILENCE_PERIODS = 10
SILENCE_LEAST_NS = NS_PER_S // 2
"""A silence is a pause of over ten usual periods and half a second: shorter ones are jitter."""


@dataclass(frozen=True, slots=True)
class Silence:
    """A pause in a stream, longer than its rate explains."""

    first_ns: int
    last_ns: int


@dataclass(slots=True)
class ChannelInfo:
    """One stream of a log. ``missing``: messages whose sequence numbers are not in the log.

    ``steady``: it is meant to have a rate, so that a pause says something.
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
    clock_steps: list[tuple[int, int]] = field(default_factory=list)  # log time, change in ns
    _sequence: int | None = None
    _period: float = 0.0
    _prior_ns: int = 0
    _least: int | None = None  # of log time less stamp, in this window
    _before: int | None = None  # and in the one before

    @property
    def rate(self) -> float:
        """Mean rate in Hz; 0 for fewer than two messages."""
        span = self.last_ns - self.first_ns
        return (self.messages - 1) * NS_PER_S / span if self.messages > 1 and span > 0 else 0.0

    def take(self, message: Message, from_start: bool, later: bool = False) -> None:
        """Count one message; ``from_start``: this file is the first of its log.

        ``later``: it is a later one, at whose start latched messages are repeated: not counted.
        """
        log_ns, sequence = message.log_ns, message.sequence
        last = self._sequence
        if later and last is not None and (sequence - last - 1) & 0xFFFFFFFF >= 1 << 31:
            return
        if last is None and from_start:
            last = -1
        if last is not None:
            step = (sequence - last) & 0xFFFFFFFF
            if step < 1 << 31:  # else a repeated message, as at the start of a later file
                self.missing += max(step - 1, 0)
                self._sequence = sequence
        else:
            self._sequence = sequence
        if not self.messages:
            self.first_ns = self.last_ns = log_ns
        self._watch_clock(log_ns, message.publish_ns)
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

    def _watch_clock(self, log_ns: int, publish_ns: int) -> None:
        """Notice when the clock of the stamps and that of the log have parted."""
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
    """What the recorder says it could not write; see `tactile_bus.gaps`."""

    reason: str
    first_ns: int
    last_ns: int
    messages: int
    detail: str
    channels: dict[str, int]


@dataclass(slots=True)
class LogInfo:
    """Everything `tactile log info` shows. ``drops``: the last counts by source and reason.

    ``path``: the first file, ``files``: how many. ``missing_files``: numbers not there between the
    first and the last. ``outcomes``: of the reaches in it.
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
    damages: list[Damage] = field(default_factory=list)
    damage_count: int = 0
    bytes_damaged: int = 0
    messages_lost: int = 0
    lost_unknown: int = 0
    missing_files: list[int] = field(default_factory=list)
    outcomes: list[str] = field(default_factory=list)

    @property
    def messages(self) -> int:
        """Messages of all channels."""
        return sum(channel.messages for channel in self.channels)

    @property
    def span_ns(self) -> tuple[int, int] | None:
        """Times of the first and the last message."""
        with_messages = [channel for channel in self.channels if channel.messages]
        if not with_messages:
            return None
        return min(c.first_ns for c in with_messages), max(c.last_ns for c in with_messages)

    @property
    def whole(self) -> bool:
        """Whether every file was finished in order and every byte of it is readable."""
        return self.closed and not self.damage_count


def info(path: Path, progress: Progress | None = None) -> LogInfo:
    """Read a log from end to end, checking its checksums. `LogError` when it is none."""
    return info_of([path], progress)


def info_of(
    paths: Sequence[Path],
    progress: Progress | None = None,
    watch: Callable[[ChannelRecord, SchemaRecord | None, Message], None] | None = None,
) -> LogInfo:
    """The same of a log in several files, in their order. ``watch``: is shown every message."""
    result = LogInfo(paths[0], len(paths))
    channels: dict[tuple[str, str], ChannelInfo] = {}
    sizes = [_size(path) for path in paths]
    numbers: list[int] = []
    for index, path in enumerate(paths):
        before, total = sum(sizes[:index]), sum(sizes)

        def report(done: int, _: int, before: int = before, total: int = total) -> None:
            if progress is not None:
                progress(before + done, total)

        with LogReader(path, report if progress is not None else None) as reader:
            _take_file(result, reader, channels, index > 0, watch)
        number = result.metadata.get("file", {}).get("file", "")
        if number.isdecimal():
            numbers.append(int(number))
    if len(numbers) == len(paths):
        result.missing_files = sorted(set(range(numbers[0], numbers[-1])) - set(numbers))
    result.channels = sorted(channels.values(), key=lambda channel: channel.topic)
    return result


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except OSError:
        return 0  # opening it will say why


def _take_file(
    result: LogInfo,
    reader: LogReader,
    channels: dict[tuple[str, str], ChannelInfo],
    later: bool,
    watch: Callable[[ChannelRecord, SchemaRecord | None, Message], None] | None,
) -> None:
    numbers: dict[int, ChannelInfo] = {}

    def channel_of(record: ChannelRecord) -> ChannelInfo:
        schema = reader.schemas.get(record.schema)
        key = record.topic, schema.name if schema else ""
        if key not in channels:
            known = find_topic(record.topic)
            channels[key] = ChannelInfo(*key, steady=known is None or known[0].rate > 0)
        return channels[key]

    for event in reader.events():
        if isinstance(event, MetadataRecord):
            _take_metadata(result, event)
        elif isinstance(event, AttachmentRecord):
            if len(result.attachments) < MAX_LISTED:
                result.attachments[event.name] = (event.media_type, event.size)
        else:
            place = result.metadata.get("file", {})
            from_start, follows = place.get("file") == "0", later and "set" in place
            for message in reader.messages(event):
                record = reader.channels.get(message.channel)
                if record is None:
                    result.orphans += 1
                    continue
                channel = numbers.get(message.channel)
                if channel is None:
                    channel = numbers[message.channel] = channel_of(record)
                channel.take(message, from_start, follows)
                if channel.msgtype == DIAGNOSTICS_TYPE:
                    _take_diagnostics(result, message)
                elif channel.msgtype == EVENT_TYPE:
                    _take_event(result, message)
                if watch is not None:
                    watch(record, reader.schemas.get(record.schema), message)
    for record in reader.channels.values():
        channel_of(record)
    result.size += reader.size
    result.profile, result.library = reader.profile, reader.library
    result.closed &= reader.closed
    result.damages += reader.damages[: MAX_LISTED - len(result.damages)]
    result.damage_count += reader.damage_count
    result.bytes_damaged += reader.bytes_damaged
    result.messages_lost += reader.messages_lost
    result.lost_unknown += reader.lost_unknown


def _take_metadata(result: LogInfo, record: MetadataRecord) -> None:
    if record.name != GAP:
        if len(result.metadata) < MAX_LISTED:
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
    # Imported here: building the type store takes 0.2 s, and most of `log recover` needs none.
    from tactile_bus.messages import DROPS_PREFIX, DecodeError, codec

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
    from tactile_bus.messages import DecodeError, codec

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
