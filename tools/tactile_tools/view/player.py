"""A log as the page's source: played at any speed from any place, one second read ahead.

Memory holds some seconds of the log, whatever its length.
"""

from __future__ import annotations

import bisect
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

from tactile_core.bus.messages import DecodeError
from tactile_core.bus.topics import (
    AMBIENT,
    ARM_STATE,
    DIAGNOSTICS,
    FEATURES,
    FORCES,
    GEOMETRY,
    REACH_EVENT,
    REACH_STATE,
    WORLD,
    Topic,
    find_topic,
)
from tactile_core.log.reader import LogReader
from tactile_core.log.records import LogError
from tactile_core.types import NS_PER_S, Instant
from tactile_tools.log.decode import Decoder
from tactile_tools.log.sources import Series, find_series
from tactile_tools.log.stream import Reading, Record, Stream, read_series
from tactile_tools.log.terminal import ToolError
from tactile_tools.view.state import PageModel

SHOWN: frozenset[Topic] = frozenset(
    {
        AMBIENT, ARM_STATE, DIAGNOSTICS, FEATURES, FORCES, GEOMETRY, REACH_EVENT, REACH_STATE, WORLD
    }
)  # fmt: skip

AHEAD_S = 1.0
"""Length of log that is read at once at normal speed, s."""

BACK_S = 1.5
"""Read before the place of a jump, s, so that what comes once a second is there."""

MAX_WINDOW_MESSAGES = 200_000
"""Messages of one window; a log of 16 boards at 1 kHz has 80,000 a second."""

SPEEDS = (0.1, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0)
"""Speeds at which a log may be played, as multiples of real time."""


class PlayError(Exception):
    """The log cannot be shown; the text names the remedy."""


class _Item(NamedTuple):
    log_ns: int
    topic: Topic
    name: str
    stream: Stream
    data: bytes


class LogPlayer:
    """Plays a log. `load` blocks and runs in a thread of its own; the rest runs in the page's."""

    playing = True

    def __init__(self, paths: Sequence[Path]) -> None:
        """Open the log; `PlayError` when it has nothing to show."""
        try:
            found = find_series(paths)
            if len(found) > 1:
                names = ", ".join(series.name for series in found[:4])
                raise PlayError(f"{len(found)} logs are named ({names}); give one, or merge them")
            self._series = found[0]
            self.first_ns, self.last_ns = _span(self._series)
            self._decoder = Decoder()
            self._geometry = self._find_geometry()
        except (LogError, ToolError) as error:
            raise PlayError(str(error)) from error
        self.name = self._series.name
        self.position_ns = self.first_ns
        self.paused = False
        self.speed = 1.0
        self.undecodable = 0
        self._items: list[_Item] = []
        self._next = 0
        self._loaded_ns = self.first_ns - 1  # messages up to this log time were loaded
        self._model_fresh = False

    # Called by the page's thread

    def advance(self, seconds: float) -> None:
        """Let ``seconds`` of real time pass."""
        if not self.paused:
            step = round(seconds * self.speed * NS_PER_S)
            # Never beyond what was read: a slow disk slows the playing and does not blank the page.
            self.position_ns = min(self.position_ns + step, self.last_ns, self._loaded_ns)
            if self.position_ns >= self.last_ns:
                self.paused = True

    def seek(self, share: float) -> None:
        """Go to a place, 0 for the beginning and 1 for the end; then `window` says what to load."""
        share = min(max(share, 0.0), 1.0)
        self.position_ns = self.first_ns + round(share * (self.last_ns - self.first_ns))
        back_ns = max(self.first_ns, self.position_ns - round(BACK_S * NS_PER_S))
        self._items, self._next, self._loaded_ns = [], 0, back_ns - 1
        self._model_fresh = False

    def play(self, speed: float | None = None) -> None:
        """Play on, from the beginning if the end was reached."""
        if speed is not None:
            if speed not in SPEEDS:
                allowed = ", ".join(f"{each:g}" for each in SPEEDS)
                raise PlayError(f"speed {speed:g}; allowed: {allowed}")
            self.speed = speed
        if self.position_ns >= self.last_ns:
            self.seek(0.0)
        self.paused = False

    @property
    def window(self) -> tuple[int, int] | None:
        """Log times to read next, ns, first and last; None while enough is loaded."""
        ahead_ns = round(AHEAD_S * max(self.speed, 1.0) * NS_PER_S)
        if self._loaded_ns >= min(self.position_ns + ahead_ns // 2, self.last_ns):
            return None
        return self._loaded_ns + 1, max(self.position_ns, self._loaded_ns) + ahead_ns

    def take_window(self, window: tuple[int, int], items: list[_Item]) -> None:
        """Add what `load` has read, unless the place was changed meanwhile."""
        if window[0] == self._loaded_ns + 1:
            self._items = self._items[self._next :] + items
            self._next, self._loaded_ns = 0, window[1]

    def poll(self, model: PageModel) -> bool:
        """Give the model the newest of each stream up to the present place.

        Returns whether any was new.
        """
        if not self._model_fresh:
            model.forget()
            for name, message in self._geometry.items():
                model.take(GEOMETRY, name, message, Instant(self.position_ns))
            self._model_fresh = True
        end = bisect.bisect_right(
            self._items, self.position_ns, lo=self._next, key=lambda item: item.log_ns
        )
        if end == self._next:
            return False
        newest: dict[tuple[Any, ...], _Item] = {}
        for item in self._items[self._next : end]:
            every = item.topic == REACH_EVENT
            newest[(item.topic, item.name, item.log_ns) if every else (item.topic, item.name)] = (
                item
            )
        self._next = end
        for item in newest.values():
            try:
                message = self._decoder.decode(item.stream, item.data)
                model.take(item.topic, item.name, message, Instant(item.log_ns))
            except (DecodeError, ValueError, AttributeError, IndexError):
                self.undecodable += 1
        return True

    def status(self) -> dict[str, Any]:
        """State of playing for the page."""
        span = max(self.last_ns - self.first_ns, 1)
        return {
            "file": self.name,
            "share": round((self.position_ns - self.first_ns) / span, 5),
            "at_s": round((self.position_ns - self.first_ns) / NS_PER_S, 2),
            "length_s": round(span / NS_PER_S, 2),
            "paused": self.paused,
            "speed": self.speed,
        }

    # Called by a thread of its own

    def load(self, window: tuple[int, int]) -> list[_Item]:
        """Read the messages logged in ``window``, in the order of time; blocks for the disk."""
        items: list[_Item] = []
        known: dict[Stream, tuple[Topic, str] | None] = {}
        for record in read_series(self._series, Reading(), None, _is_shown, window):
            if not isinstance(record, Record) or not window[0] <= record.log_ns <= window[1]:
                continue
            stream = record.stream
            if stream not in known:
                known[stream] = find_topic(stream.topic)
            found = known[stream]
            if found is not None and len(items) < MAX_WINDOW_MESSAGES:
                items.append(_Item(record.log_ns, found[0], found[1], stream, record.data))
        items.sort(key=lambda item: item.log_ns)
        return items

    def _find_geometry(self) -> dict[str, Any]:
        """Find the first geometry of each board; every file begins with it."""
        found: dict[str, Any] = {}
        boards: set[str] = set()
        window = (self.first_ns, self.first_ns + 60 * NS_PER_S)
        for record in read_series(self._series, Reading(), None, _is_shown, window):
            if not isinstance(record, Record):
                continue
            topic = find_topic(record.stream.topic)
            if topic is None:
                continue
            if topic[0] == GEOMETRY and topic[1] not in found:
                with suppress(DecodeError):
                    found[topic[1]] = self._decoder.decode(record.stream, record.data)
            elif topic[0] == FEATURES:
                boards.add(topic[1])
            if boards and boards <= set(found) and record.log_ns > window[0] + 5 * NS_PER_S:
                break
        return found


def _is_shown(topic: str) -> bool:
    found = find_topic(topic)
    return found is not None and found[0] in SHOWN


def _span(series: Series) -> tuple[int, int]:
    """Log times of the first and the last message that the page can show, ns."""
    spans = [_span_of(path) for path in series.paths]
    told = [span for span in spans if span is not None]
    if not told:
        raise PlayError(
            f"{series.name} holds nothing that the page shows (contact features, forces, reach); "
            "`tactile log info` lists what it has"
        )
    return min(first for first, _ in told), max(last for _, last in told)


def _span_of(path: Path) -> tuple[int, int] | None:
    with LogReader(path) as reader:
        summary = reader.summarize()
        statistics = None if summary is None else summary.statistics
        if statistics is not None and summary is not None and summary.knows_all_channels:
            shown = {c.number for c in summary.channels if _is_shown(c.topic)}
            counts = statistics.channel_message_counts
            if not any(counts.get(number) for number in shown):
                return None
            return statistics.message_start_time, statistics.message_end_time
    first = last = None
    for record in read_series(Series((path,)), Reading(), None, _is_shown):
        if isinstance(record, Record):
            first = record.log_ns if first is None else min(first, record.log_ns)
            last = record.log_ns if last is None else max(last, record.log_ns)
    return None if first is None or last is None else (first, last)
