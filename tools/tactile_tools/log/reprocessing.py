"""Run a log's raw bytes through the daemon's own pipelines, for ``tactile log reprocess``."""

from __future__ import annotations

import hashlib
import json
import logging
from collections import OrderedDict
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from tactile_core.bus.messages import DecodeError, codec, stamp_ns
from tactile_core.bus.topics import (
    AMBIENT,
    CONTACTS,
    FEATURES,
    FIELD,
    FORCES,
    GEOMETRY,
    PORT,
    RAW,
    Topic,
    find_topic,
)
from tactile_core.calibration import BoardCalibration, CalibrationError, loads, saves
from tactile_core.calibration.file import SUFFIX
from tactile_core.log.recorder import Recorder
from tactile_core.log.records import MetadataRecord, Progress
from tactile_core.types import Instant, WallClock
from tactile_tools.log.sources import FILE, Series
from tactile_tools.log.stream import Attachment, Reading, Record, Stream, read_series
from tactile_tools.log.terminal import FAULTY, ToolError
from tactile_tools.log.writing import LogOutput
from tactiled.calibration_store import CalibrationStore
from tactiled.journal import STATE_PREFIX, RecordedState, recorded_state
from tactiled.rerun import (
    PIPELINE,
    PORT_PREFIX,
    RecordedError,
    RecordedPort,
    Rerun,
    recorded_pipeline,
    recorded_port,
)
from tactiled.sensing.settings import PipelineSettings
from tactiled.transports.recorded_log import from_raw

MADE = (FEATURES, FORCES, FIELD, AMBIENT, CONTACTS, GEOMETRY)
"""Topics that are computed anew; all others are copied."""

COMPARED = (FEATURES, FORCES, FIELD, AMBIENT, CONTACTS)
"""Topics whose messages are compared with the old ones; a geometry is stamped when it is sent."""

PENDING = 65_536
"""Old and new messages of a topic that wait for their counterparts: ten minutes of one board."""


@dataclass(slots=True)
class Known:
    """Findings of the first pass over a log. ``versions``: calibrations by hash, oldest first."""

    ports: dict[str, RecordedPort] = field(default_factory=dict)
    settings: PipelineSettings = field(default_factory=PipelineSettings)
    has_settings: bool = False
    versions: dict[str, BoardCalibration] = field(default_factory=dict)
    first: dict[str, BoardCalibration] = field(default_factory=dict)  # by board name
    states: dict[str, RecordedState] = field(default_factory=dict)  # by board name
    serials: set[str] = field(default_factory=set)
    raw: set[str] = field(default_factory=set)
    journals: set[str] = field(default_factory=set)


def survey(series: Series, report: Progress | None = None) -> Known:
    """Read settings, ports and calibrations of a log; ToolError when it has no raw bytes."""
    known, reading = Known(), Reading()
    try:
        for item in read_series(series, reading, report, lambda _: False):
            if isinstance(item, MetadataRecord):
                if item.name == PIPELINE and not known.has_settings:
                    known.settings, known.has_settings = recorded_pipeline(item.values), True
                elif item.name.startswith(PORT_PREFIX):
                    name = item.name.removeprefix(PORT_PREFIX)
                    known.ports.setdefault(name, recorded_port(name, item.values))
                elif item.name.startswith(STATE_PREFIX):
                    name = item.name.removeprefix(STATE_PREFIX)
                    state = recorded_state(name, item.values)
                    if state is not None:
                        known.states.setdefault(name, state)
                elif item.name.startswith("board:"):
                    known.serials.add(item.values.get("serial_number", ""))
            elif isinstance(item, Attachment) and item.name.endswith(SUFFIX):
                text = item.read().decode("utf-8", "replace")
                calibration = loads(text, f"{series.name}: {item.name}")
                known.versions.setdefault(calibration.hash, calibration)
                known.first.setdefault(item.name.removesuffix(SUFFIX), calibration)
                known.serials.add(calibration.serial_number)
    except (RecordedError, CalibrationError) as error:
        raise ToolError(str(error)) from error
    for stream in reading.seen:
        found = find_topic(stream.topic)
        if found is not None and found[0] == RAW:
            known.raw.add(found[1])
        elif found is not None and found[0] == PORT:
            known.journals.add(found[1])
    if not known.raw:
        raise ToolError(
            f"{series.name} holds no raw bytes to run again: only logs of tactiled do, on "
            "/tactile/<name>/raw"
        )
    return known


class Sink:
    """Receives what the pipelines publish and writes it to the new log, on the old log's time."""

    def __init__(self) -> None:
        self.wall = WallClock(0)
        self.recorder: Recorder | None = None
        self.warnings: OrderedDict[str, None] = OrderedDict()
        self.output: LogOutput | None = None
        self.compare = Comparison()
        self.sent: dict[Stream, int] = {}
        self._now = Instant(0)
        self._streams: dict[tuple[Topic, str], Stream] = {}

    def set(self, now: Instant) -> None:
        """Set the present time of the rerun."""
        self._now = now

    def now(self) -> Instant:
        """Present time of the rerun."""
        return self._now

    def send(self, topic: Topic, name: str, message: Any, stamp_ns: int) -> None:
        """Write a message to the new log."""
        if self.output is None or topic not in MADE:
            return
        data = codec().encode(topic, message)
        key = topic, name
        stream = self._streams.get(key)
        if stream is None:
            stream = self._streams[key] = _stream(topic, name)
        sequence = self.sent.get(stream, 0)
        self.sent[stream] = sequence + 1
        log_ns = self.wall.wall_ns(self._now)
        self.output.write(Record(stream, sequence, log_ns, stamp_ns, data))
        if topic in COMPARED:
            self.compare.new(stream.topic, data)

    def announce(self, name: str, level: int, text: str, at: Instant | None = None) -> None:
        """Keep warnings for the user."""
        del at
        if level >= logging.WARNING:
            self.warnings[f"{name}: {text}"] = None

    def firmware_text(
        self, name: str, level: int, speaker: str, text: str, at: Instant | None = None
    ) -> None:
        """Ignored: the text is in the log already."""


def _stream(topic: Topic, name: str) -> Stream:
    """The stream as the recorder would have made it."""
    schema = codec().schema(topic)
    metadata = (("offered_qos_profiles", ""), ("topic_type_hash", schema.type_hash))
    return Stream(topic.channel(name), schema.name, schema.encoding, schema.data, "cdr", metadata)


class Comparison:
    """Counts, by topic, the messages of the old log that came out bit for bit the same.

    Memory is bounded.
    """

    def __init__(self) -> None:
        self.same: dict[str, int] = {}
        self.before: dict[str, int] = {}
        self.after: dict[str, int] = {}
        self._waiting: dict[tuple[str, bool], OrderedDict[bytes, None]] = {}

    def old(self, topic: str, data: bytes) -> None:
        """Take a message of the old log."""
        self.before[topic] = self.before.get(topic, 0) + 1
        self._meet(topic, data, True)

    def new(self, topic: str, data: bytes) -> None:
        """Take a message of the new log."""
        self.after[topic] = self.after.get(topic, 0) + 1
        self._meet(topic, data, False)

    def _meet(self, topic: str, data: bytes, old: bool) -> None:
        digest = hashlib.blake2b(data, digest_size=16).digest()
        others = self._waiting.setdefault((topic, not old), OrderedDict())
        if digest in others:
            del others[digest]
            self.same[topic] = self.same.get(topic, 0) + 1
            return
        mine = self._waiting.setdefault((topic, old), OrderedDict())
        mine[digest] = None
        if len(mine) > PENDING:
            mine.popitem(last=False)


class Reprocessing:
    """The second pass: raw bytes go through the pipelines, everything else is copied."""

    def __init__(
        self, known: Known, settings: PipelineSettings, given: list[BoardCalibration]
    ) -> None:
        self.sink = Sink()
        self.reading = Reading()
        self.reruns: dict[str, Rerun] = {}
        self.broken = 0
        self._known = known
        self._settings = settings
        ports = max(1, len(known.ports))
        strict = any(port.strict for port in known.ports.values()) or len(given) >= ports
        store = CalibrationStore((), strict=strict)
        own = {calibration.serial_number for calibration in given}
        for name, calibration in known.first.items():
            if calibration.serial_number not in own:
                store.add(Path(f"{name}{SUFFIX} of the log"), calibration)
        for calibration in given:
            store.add(Path(f"calibration of {calibration.serial_number}"), calibration)
        versions = {h: c for h, c in known.versions.items() if c.serial_number not in own}
        for name in sorted(known.raw):
            self.reruns[name] = Rerun(
                known.ports.get(name, RecordedPort(name)),
                store,
                settings,
                self.sink,
                journal=name in known.journals,
                versions=versions,
                states={b: s for b, s in known.states.items() if self._belongs(b, name)},
            )
        self._given = own
        self._numbers: dict[str, int] = {}
        self._topics: dict[Stream, tuple[Topic, str] | None] = {}

    def take(self, item: Record | MetadataRecord | Attachment, output: LogOutput) -> None:
        """Process one item of the old log."""
        self.sink.output = output
        if isinstance(item, MetadataRecord):
            self._metadata(item, output)
        elif isinstance(item, Attachment):
            if not (item.name.endswith(SUFFIX) and self._is_replaced(item)):
                output.attach(item)
        else:
            self._record(item, output)

    def finish(self, output: LogOutput) -> None:
        """Process what is held back, and attach the given calibrations that were used."""
        for rerun in self.reruns.values():
            rerun.end()
            for board in rerun.boards:
                choice = board.choice
                if choice is not None and choice.calibration.serial_number in self._given:
                    data = saves(choice.calibration).encode()
                    name = f"{board.name}{SUFFIX}"
                    now = self.sink.wall.wall_ns(self.sink.now())
                    output.attach(Attachment.of(name, "application/toml", now, now, data))

    def check(self, series: Series) -> None:
        """`ToolError` with exit status 1 when the raw bytes of a port yielded nothing."""
        for name, rerun in self.reruns.items():
            boards = {
                found[1]
                for topic in self.sink.compare.before
                if (found := find_topic(topic)) is not None and self._belongs(found[1], name)
            }
            made = any(board.sent for board in rerun.boards)
            if rerun.chunks and not made and (boards or not rerun.exact):
                raise ToolError(
                    f"{series.name}: nothing can be made of the raw bytes of {name}: the file does "
                    "not say which board sent them, and its beginning, in which the board does, is "
                    "not here; give all files of the log",
                    FAULTY,
                )

    def summary(self, series: Series, given: list[BoardCalibration]) -> dict[str, str]:
        """Table of the new log that says how it was made."""
        return {
            "source": ", ".join(path.name for path in series.paths),
            "calibrations": ", ".join(c.hash for c in given),
            "timing": "as recorded" if self.exact else "estimated anew",
        }

    @property
    def exact(self) -> bool:
        """Whether the journals were complete, so that the timing is as recorded."""
        return all(rerun.exact for rerun in self.reruns.values())

    def _is_replaced(self, item: Attachment) -> bool:
        first = self._known.first.get(item.name.removesuffix(SUFFIX))
        return first is not None and first.serial_number in self._given

    def _metadata(self, item: MetadataRecord, output: LogOutput) -> None:
        if item.name == PIPELINE and self._settings != self._known.settings:
            table = {key: json.dumps(value) for key, value in asdict(self._settings).items()}
            output.metadata(PIPELINE, table)
        elif item.name == FILE:
            output.metadata(FILE, item.values | {"file": "0"})
        else:
            output.metadata(item.name, item.values)

    def _record(self, item: Record, output: LogOutput) -> None:
        stream = item.stream
        if stream not in self._topics:
            self._topics[stream] = find_topic(stream.topic)
        found = self._topics[stream]
        if found is None or found[0] not in MADE or not self._is_of_ours(found[1]):
            output.write(item)
        elif found[0] in COMPARED:
            self.sink.compare.old(stream.topic, item.data)
        if found is not None and found[0] in (RAW, PORT):
            self._feed(found[0], found[1], item)

    def _is_of_ours(self, board: str) -> bool:
        """Return whether the messages of a board are computed anew."""
        return any(self._belongs(board, name) for name in self.reruns)

    def _belongs(self, board: str, name: str) -> bool:
        """Return whether a board is at port ``name``; on a bus a number follows the port's name."""
        nodes = self._known.ports.get(name, RecordedPort(name)).nodes or {}
        return board == name or board.startswith(f"{name}-") or board in nodes.values()

    def _feed(self, topic: Topic, name: str, item: Record) -> None:
        rerun = self.reruns.get(name)
        if rerun is None:
            return
        last = self._numbers.get(item.stream.topic, -1)
        if item.sequence != last + 1 and (last >= 0 or item.sequence):
            rerun.lost()
        self._numbers[item.stream.topic] = item.sequence
        try:
            message = codec().decode(topic, item.data)
            if topic == RAW:
                chunk = from_raw(message)
                offset = stamp_ns(message.header.stamp) - int(message.received_ns)
                self.sink.wall = WallClock(offset)
                rerun.chunk(chunk)
            else:
                rerun.event(message)
        except DecodeError:
            self.broken += 1
            rerun.lost()
