"""Time series of one board out of a log, for plots and summaries."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactile_bus.log_reader import read_messages
from tactile_bus.log_records import LogError
from tactile_bus.messages import DecodeError, codec
from tactile_bus.topics import AMBIENT, FEATURES, FORCES, GEOMETRY, Topic, find_topic

Float = NDArray[np.float64]

WANTED = frozenset({AMBIENT, FEATURES, FORCES, GEOMETRY})

MAX_POINTS = 200_000
"""Cycles kept for a plot: over half an hour at 100 Hz; no picture shows more."""


class LogUnreadableError(Exception):
    """The file is no MCAP log, or holds nothing that was asked for. The text names the remedy."""


@dataclass(eq=False)
class BoardSeries:
    """What a log says of one board. Times are s since the first cycle; lists grow together."""

    name: str
    start_ns: int = 0  # monotonic clock of the sender at time 0
    geometry: Any = None
    time: list[float] = field(default_factory=list)
    force: list[Float] = field(default_factory=list)  # (N, 3) N, taxel axes
    latency: list[float] = field(default_factory=list)  # s, captured to received
    feature_time: list[float] = field(default_factory=list)
    features: list[Any] = field(default_factory=list)
    ambient_time: list[float] = field(default_factory=list)
    ambient: list[Any] = field(default_factory=list)

    def array_slices(self) -> list[tuple[str, slice]]:
        """Name and taxels of each array, in order."""
        sizes = np.asarray(self.geometry.array_rows, int) * np.asarray(
            self.geometry.array_columns, int
        )
        ends = np.cumsum([0, *sizes]).tolist()
        names = list(self.geometry.array_name)
        return [(n, slice(a, b)) for n, a, b in zip(names, ends, ends[1:], strict=False)]

    def contact_force(self) -> Float:
        """(features, arrays) N: sum of the normal forces of each array's contact patches."""
        force = np.zeros((len(self.features), len(self.array_slices())))
        for row, features in enumerate(self.features):
            for patch in features.patches:
                force[row, patch.array] += patch.normal_force
        return force


def messages(path: Path, wanted: frozenset[Topic] = WANTED) -> Iterator[tuple[Topic, str, Any]]:
    """Yield (topic, name, message) of a log in file order, also of one that was cut off.

    LogUnreadableError when the file cannot be read, or when a message is not what it says.
    """
    decode = codec().decode
    found: dict[str, tuple[Topic, str] | None] = {}
    try:
        for channel, record in read_messages(path):
            if channel.topic not in found:
                found[channel.topic] = find_topic(channel.topic)
            if (known := found[channel.topic]) is not None and known[0] in wanted:
                yield *known, decode(known[0], record.data)
    except (LogError, DecodeError) as error:
        raise LogUnreadableError(str(error)) from error
    except OSError as error:
        raise LogUnreadableError(f"{path}: {error.strerror}") from error


def read_boards(path: Path) -> dict[str, BoardSeries]:
    """Return the series of every board in a log, by board name; raises LogUnreadableError."""
    boards: dict[str, BoardSeries] = {}
    start: int | None = None
    for topic, name, message in messages(path):
        board = boards.setdefault(name, BoardSeries(name))
        if topic == GEOMETRY:
            board.geometry = message
            continue
        captured = message.captured_ns
        if start is None:
            start = captured
        now = (captured - start) * 1e-9
        if topic == FORCES and len(board.time) < MAX_POINTS:
            board.time.append(now)
            board.force.append(np.asarray(message.force, float).reshape(-1, 3))
            board.latency.append((message.received_ns - captured) * 1e-9)
        elif topic == FEATURES and len(board.feature_time) < MAX_POINTS:
            board.feature_time.append(now)
            board.features.append(message)
        elif topic == AMBIENT and len(board.ambient_time) < MAX_POINTS:
            board.ambient_time.append(now)
            board.ambient.append(message)
    for board in boards.values():
        board.start_ns = start or 0
    boards = {n: b for n, b in boards.items() if b.geometry is not None and b.time}
    if not boards:
        raise LogUnreadableError(
            f"{path} holds no taxel forces: was it written by tactiled? "
            f"`tactile log info {path}` lists what is in it"
        )
    return boards
