"""What a log holds: channels, rates, times, losses and where they are. Constant memory."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tactile_bus.gaps import DROPPED, GAP
from tactile_bus.instant import NS_PER_S
from tactile_bus.log_bytes import Progress
from tactile_bus.log_reader import LogReader
from tactile_bus.log_records import AttachmentRecord, Damage, Message, MetadataRecord

DIAGNOSTICS_TYPE = "diagnostic_msgs/msg/DiagnosticArray"

MAX_LISTED = 1000
"""Gaps, silences, table and attachment names kept one by one; beyond that only counted."""

SETTLED = 20
"""Messages after which a channel's usual period is known well enough to call a pause a silence."""

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
    """One stream of a log. ``missing``: messages whose sequence numbers are not in the log."""

    topic: str
    msgtype: str
    messages: int = 0
    first_ns: int = 0
    last_ns: int = 0
    missing: int = 0
    longest_ns: int = 0
    silences: list[Silence] = field(default_factory=list)
    silence_count: int = 0
    _sequence: int | None = None
    _period: float = 0.0

    @property
    def rate(self) -> float:
        """Mean rate in Hz; 0 for fewer than two messages."""
        span = self.last_ns - self.first_ns
        return (self.messages - 1) * NS_PER_S / span if self.messages > 1 and span > 0 else 0.0

    def take(self, message: Message, from_start: bool) -> None:
        """Count one message; ``from_start``: this file is the first of its log."""
        log_ns, sequence = message.log_ns, message.sequence
        last = self._sequence
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
        pause = log_ns - self.last_ns
        self.longest_ns = max(self.longest_ns, pause)
        usual = max(SILENCE_PERIODS * self._period, SILENCE_LEAST_NS)
        if self.messages > SETTLED and pause > usual:
            self.silence_count += 1
            if len(self.silences) < MAX_LISTED:
                self.silences.append(Silence(self.last_ns, log_ns))
        elif self.messages:
            weight = max(1 / self.messages, 1 / SETTLED)
            self._period += weight * (pause - self._period)
        self.first_ns = min(self.first_ns, log_ns)
        self.last_ns = max(self.last_ns, log_ns)
        self.messages += 1


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
    """Everything `tactile log info` shows. ``drops``: the last counts by source and reason."""

    path: Path
    size: int = 0
    profile: str = ""
    library: str = ""
    closed: bool = False
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
        """Whether the file was finished in order and every byte of it is readable."""
        return self.closed and not self.damage_count


def info(path: Path, progress: Progress | None = None) -> LogInfo:
    """Read a log from end to end, checking its checksums. `LogError` when it is none."""
    result = LogInfo(path)
    with LogReader(path, progress) as reader:
        channels: dict[int, ChannelInfo] = {}
        result.size = reader.size
        for event in reader.events():
            if isinstance(event, MetadataRecord):
                _take_metadata(result, event)
            elif isinstance(event, AttachmentRecord):
                if len(result.attachments) < MAX_LISTED:
                    result.attachments[event.name] = (event.media_type, event.size)
            else:
                from_start = result.metadata.get("file", {}).get("file") == "0"
                for message in reader.messages(event):
                    channel = channels.get(message.channel)
                    if channel is None:
                        record = reader.channels.get(message.channel)
                        if record is None:
                            result.orphans += 1
                            continue
                        schema = reader.schemas.get(record.schema)
                        channel = ChannelInfo(record.topic, schema.name if schema else "")
                        channels[message.channel] = channel
                    channel.take(message, from_start)
                    if channel.msgtype == DIAGNOSTICS_TYPE:
                        _take_diagnostics(result, message)
        for record in reader.channels.values():
            if record.number not in channels:
                schema = reader.schemas.get(record.schema)
                channels[record.number] = ChannelInfo(record.topic, schema.name if schema else "")
        result.channels = sorted(channels.values(), key=lambda channel: channel.topic)
        result.profile, result.library, result.closed = (
            reader.profile,
            reader.library,
            reader.closed,
        )
        result.damages, result.damage_count = reader.damages, reader.damage_count
        result.bytes_damaged = reader.bytes_damaged
    return result


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


def _number(text: str) -> int:
    try:
        return int(text)
    except ValueError:
        return 0
