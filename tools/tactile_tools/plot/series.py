"""Time series of boards from a log, for plots and summaries, in bounded memory."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactile_core.arrays import FloatArray
from tactile_core.bus.messages import DROPS_PREFIX, LATER_FIELDS, DecodeError, codec, stamp_ns
from tactile_core.bus.topics import (
    AMBIENT,
    DIAGNOSTICS,
    FEATURES,
    FIELD,
    FORCES,
    GEOMETRY,
    LOG,
    REACH_EVENT,
    Topic,
    find_topic,
)
from tactile_core.log.records import LogError, Progress
from tactile_tools.log.decode import Decoder
from tactile_tools.log.sources import find_series
from tactile_tools.log.stream import Reading, Record, Stream, read_merged
from tactile_tools.log.terminal import ToolError

WANTED = frozenset({AMBIENT, DIAGNOSTICS, FEATURES, FIELD, FORCES, GEOMETRY, LOG, REACH_EVENT})

MAX_POINTS = 16_384
"""Points of one curve: ten times the pixels of a picture's width. With more, each pair becomes
one."""

MAX_EVENTS = 200
"""Events kept of a board or of reaches: more would not be legible. The rest are counted."""

WARNING = 30
"""Level of ``rcl_interfaces/Log`` from which a message is an event."""

LATENCY_BINS = np.geomspace(1e-5, 100.0, 281)
"""Edges of bins, s; 40 per decade, so that a percentile is accurate to 6 %."""


class LogUnreadableError(Exception):
    """The file is not an MCAP log, or lacks what was asked for; the text names the remedy."""


class Track:
    """Points of one curve. When there are too many, the greater of each pair is kept."""

    def __init__(self, limit: int = MAX_POINTS) -> None:
        self.time: list[float] = []
        self.items: list[Any] = []
        self._weights: list[float] = []
        self._limit = limit
        self._share = 1
        self._best: tuple[float, float, Any] | None = None
        self._taken = 0

    def __len__(self) -> int:
        return len(self.time)

    def add(self, time: float, item: Any, weight: float = 0.0) -> None:
        """Add a point.

        Of two neighbours the one with the greater ``weight`` may outlive the other.
        """
        if self._best is None or weight > self._best[1]:
            self._best = (time, weight, item)
        self._taken += 1
        if self._taken < self._share:
            return
        kept, weight, item = self._best
        self._best, self._taken = None, 0
        self.time.append(kept)
        self.items.append(item)
        self._weights.append(weight)
        if len(self.time) >= self._limit:
            self._halve()

    def _halve(self) -> None:
        weights = np.nan_to_num(np.array(self._weights))
        first = weights[0::2] >= weights[1::2]
        chosen = np.arange(0, len(weights), 2) + ~first
        self.time = [self.time[i] for i in chosen.tolist()]
        self.items = [self.items[i] for i in chosen.tolist()]
        self._weights = [self._weights[i] for i in chosen.tolist()]
        self._share *= 2


@dataclass(eq=False)
class Spread:
    """Distribution of a duration, s: exact count, extremes and mean; percentiles to 6 %."""

    counts: NDArray[np.int64] = field(
        default_factory=lambda: np.zeros(len(LATENCY_BINS) + 1, np.int64)
    )
    total: float = 0.0
    least: float = np.inf
    greatest: float = -np.inf

    def add(self, seconds: float) -> None:
        """Count a duration."""
        self.counts[int(np.searchsorted(LATENCY_BINS, seconds))] += 1
        self.total += seconds
        self.least, self.greatest = min(self.least, seconds), max(self.greatest, seconds)

    @property
    def number(self) -> int:
        """Number of durations."""
        return int(self.counts.sum())

    def percentile(self, share: float) -> float:
        """Duration, s, below which ``share`` (0 to 1) of them lie; NaN if there are none."""
        if not self.number:
            return float("nan")
        index = int(np.searchsorted(np.cumsum(self.counts), share * self.number))
        edge = LATENCY_BINS[min(index, len(LATENCY_BINS) - 1)]
        return float(min(max(edge, self.least), self.greatest))


@dataclass(eq=False)
class BoardSeries:
    """What a log says of one board. Times are seconds since the first cycle of the log."""

    name: str
    start_ns: int = 0  # sender's monotonic clock at time 0
    geometry: Any = None
    cycles: int = 0
    first: float = 0.0
    last: float = 0.0
    lost: int = 0  # cycles missing in the sequence
    force_track: Track = field(default_factory=Track)  # (N, 3) N, taxel axes
    delay_track: Track = field(
        default_factory=Track
    )  # (captured to received, uncertainty, to log), s
    feature_track: Track = field(default_factory=Track)  # features
    ambient_track: Track = field(default_factory=Track)  # ambient
    temperature_track: Track = field(default_factory=Track)  # °C, one per array
    diagnostics_track: Track = field(default_factory=Track)  # diagnostics as dictionaries
    latency_spread: Spread = field(default_factory=Spread)
    logging_spread: Spread = field(default_factory=Spread)
    period_spread: Spread = field(default_factory=Spread)
    events: list[tuple[float, str]] = field(default_factory=list)
    events_left_out: int = 0  # beyond `MAX_EVENTS`
    drops: dict[str, int] = field(default_factory=dict)
    _sequence: int | None = None

    @property
    def time(self) -> list[float]:
        """Times of `force`, s."""
        return self.force_track.time

    @property
    def force(self) -> list[FloatArray]:
        """Force on each taxel, (N, 3) N each."""
        return self.force_track.items

    @property
    def feature_time(self) -> list[float]:
        """Times of `features`, s."""
        return self.feature_track.time

    @property
    def features(self) -> list[Any]:
        """Messages of type ``ContactFeatures``."""
        return self.feature_track.items

    @property
    def ambient_time(self) -> list[float]:
        """Times of `ambient`, s."""
        return self.ambient_track.time

    @property
    def ambient(self) -> list[Any]:
        """Messages of type ``AmbientField``."""
        return self.ambient_track.items

    def array_slices(self) -> list[tuple[str, slice]]:
        """Name and taxels of each array, in order."""
        sizes = np.asarray(self.geometry.array_rows, int) * np.asarray(
            self.geometry.array_columns, int
        )
        ends = np.cumsum([0, *sizes]).tolist()
        names = list(self.geometry.array_name)
        return [(n, slice(a, b)) for n, a, b in zip(names, ends, ends[1:], strict=False)]

    def contact_force(self) -> FloatArray:
        """Sum of the normal forces of each array's contact patches, (features, arrays) N."""
        force = np.zeros((len(self.features), len(self.array_slices())))
        for row, features in enumerate(self.features):
            for patch in features.patches:
                if patch.array < force.shape[1]:
                    force[row, patch.array] += patch.normal_force
        return force

    def take(self, topic: Topic, message: Any, log_ns: int, start: int) -> None:
        """Add a message of this board. ``start``: monotonic ns of time 0."""
        if topic == GEOMETRY:
            self.geometry = message
        elif topic == DIAGNOSTICS:
            self._take_diagnostics(message)
        elif topic == LOG:
            if message.level >= WARNING:
                self.remark(self.last, message.msg)
        elif topic == FORCES:
            self._take_forces(message, log_ns, (message.captured_ns - start) * 1e-9)
        else:
            now = (message.captured_ns - start) * 1e-9
            if topic == FEATURES:
                total = sum(patch.normal_force for patch in message.patches)
                self.feature_track.add(now, message, max(total, message.peak_force))
            elif topic == AMBIENT:
                self.ambient_track.add(now, message)
            elif topic == FIELD:
                self.temperature_track.add(
                    now, np.asarray(message.temperature_c, np.float32).copy()
                )

    def remark(self, when: float, text: str) -> None:
        """Keep an event, or count it where there are too many."""
        if len(self.events) < MAX_EVENTS:
            self.events.append((when, text))
        else:
            self.events_left_out += 1

    def _take_forces(self, message: Any, log_ns: int, now: float) -> None:
        force = np.asarray(message.force, np.float32).reshape(-1, 3).copy()
        self.force_track.add(now, force, float(np.nan_to_num(-force[:, 2]).max(initial=0.0)))
        delay = (message.received_ns - message.captured_ns) * 1e-9
        # The header's stamp is the instant of capture on the wall clock of the log.
        offset = stamp_ns(message.header.stamp) - message.captured_ns
        logged = (log_ns - offset - message.received_ns) * 1e-9
        self.delay_track.add(
            now, (delay, float(message.uncertainty), logged), delay + max(0.0, logged)
        )
        self.latency_spread.add(delay)
        self.logging_spread.add(logged)
        if self.cycles:
            self.period_spread.add(now - self.last)
        else:
            self.first = now
        if self._sequence is not None:
            step = (message.sequence - self._sequence) & 0xFFFFFFFF
            self.lost += step - 1 if 0 < step < 1 << 31 else 0
        self._sequence = message.sequence
        self.cycles += 1
        self.last = now

    def _take_diagnostics(self, message: Any) -> None:
        for status in message.status:
            if status.name == f"tactiled/{self.name}":
                values = {pair.key: pair.value for pair in status.values}
                self.diagnostics_track.add(self.last, values)
                self.drops = {
                    key.removeprefix(DROPS_PREFIX): int(text)
                    for key, text in values.items()
                    if key.startswith(DROPS_PREFIX) and text.isdecimal()
                }


def messages(
    source: Path | Sequence[Path],
    wanted: frozenset[Topic] = WANTED,
    progress: Progress | None = None,
) -> Iterator[tuple[Topic, str, Any]]:
    """Yield (topic, name, message) of a log in file order, also of one that was cut off.

    LogUnreadableError when the file cannot be read, or when a message does not fit its type.
    """
    for topic, name, message, _ in _timed(source, wanted, progress):
        yield topic, name, message


def _timed(
    source: Path | Sequence[Path], wanted: frozenset[Topic], progress: Progress | None
) -> Iterator[tuple[Topic, str, Any, int]]:
    """Yield the messages with their log times, ns."""
    decoder = Decoder()
    found: dict[str, tuple[Topic, str] | None] = {}
    checked: set[Stream] = set()

    def is_wanted(name: str) -> bool:
        found[name] = known = find_topic(name)
        return known is not None and known[0] in wanted

    paths = [source] if isinstance(source, Path) else list(source)
    try:
        logs = find_series(paths)
        for _, item in read_merged(logs, Reading(), progress, is_wanted):
            if isinstance(item, Record) and (known := found[item.stream.topic]) is not None:
                if item.stream.msgtype != known[0].msgtype:
                    continue  # another program's topic of the same name
                if item.stream not in checked:
                    checked.add(item.stream)
                    _require_fields(decoder, item.stream)
                yield *known, decoder.decode(item.stream, item.data), item.log_ns
    except (LogError, DecodeError, ToolError) as error:
        raise LogUnreadableError(str(error)) from error
    except OSError as error:
        raise LogUnreadableError(f"{paths[0]}: {error.strerror}") from error


def _require_fields(decoder: Decoder, stream: Stream) -> None:
    """DecodeError when the definition of another version lacks a field that is needed here."""
    ours = {name for name, _ in codec().fields(stream.msgtype)}
    theirs = {name for name, _ in decoder.reader(stream).fields[stream.msgtype][1]}
    if lacking := ours - theirs - LATER_FIELDS.get(stream.msgtype, frozenset()):
        raise DecodeError(
            f"{stream.topic} is of another version: its {stream.msgtype} has no "
            f"{', '.join(sorted(lacking))}; use the tools of the version that wrote it"
        )


def read_boards(
    source: Path | Sequence[Path], progress: Progress | None = None
) -> dict[str, BoardSeries]:
    """Return the series of every board in a log, by board name; raises LogUnreadableError."""
    boards: dict[str, BoardSeries] = {}
    reach: list[tuple[int, str]] = []
    reach_left_out = 0
    start: int | None = None
    for topic, name, message, log_ns in _timed(source, WANTED, progress):
        if topic == REACH_EVENT:
            if message.kind == "intervention":
                continue
            if len(reach) < MAX_EVENTS:
                reach.append((message.stamped_ns, f"{message.kind}: {message.code}"))
            else:
                reach_left_out += 1
            continue
        board = boards.setdefault(name, BoardSeries(name))
        if start is None:
            start = getattr(message, "captured_ns", None)
        board.take(topic, message, log_ns, start or 0)
    boards = {n: b for n, b in boards.items() if b.geometry is not None and b.time}
    for board in boards.values():
        board.start_ns = start or 0
        board.events += [((at - board.start_ns) * 1e-9, text) for at, text in reach]
        board.events.sort()
        board.events_left_out += reach_left_out
    if not boards:
        paths = source if isinstance(source, Path) else source[0]
        raise LogUnreadableError(
            f"{paths} holds no taxel forces: was it written by tactiled? "
            f"`tactile log info {paths}` lists what is in it"
        )
    return boards
