"""Time series of one board out of a log, for plots and summaries."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from mcap.exceptions import McapError
from mcap.reader import NonSeekingReader
from numpy.typing import NDArray

from tactile_bus.messages import codec
from tactile_bus.topics import AMBIENT, FEATURES, FORCES, GEOMETRY, Topic

Float = NDArray[np.float64]

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

    def normal_force(self) -> Float:
        """(cycles, arrays) N: sum of normal forces of each array, pushes only."""
        force = np.asarray(self.force)
        normal = np.clip(np.nan_to_num(-force[..., 2]), 0.0, None)
        return np.stack([normal[:, s].sum(axis=1) for _, s in self.array_slices()], axis=1)


def messages(path: Path) -> Iterator[tuple[str, Any]]:
    """Yield (key, message) of a log in file order, also of one that was cut off."""
    decode = codec().decode
    try:
        with path.open("rb") as stream:
            reader = NonSeekingReader(stream, validate_crcs=False)
            for schema, channel, message in reader.iter_messages(log_time_order=False):
                if schema is not None:
                    yield channel.topic, decode(schema.name, message.data)
    except (McapError, EOFError) as error:
        raise LogUnreadableError(
            f"{path} is damaged or no MCAP log ({error}); try `tactile log recover {path}` first"
        ) from error
    except OSError as error:
        raise LogUnreadableError(f"{path}: {error.strerror}") from error


def read_boards(path: Path) -> dict[str, BoardSeries]:
    """Return the series of every board in a log, by board name; raises LogUnreadableError."""
    boards: dict[str, BoardSeries] = {}
    start: int | None = None

    def board_of(key: str, topic: Topic) -> BoardSeries | None:
        head, _, tail = topic.template.partition("{name}")
        name = key[len(head) : len(key) - len(tail)]
        if not (key.startswith(head) and key.endswith(tail)):
            return None
        return boards.setdefault(name, BoardSeries(name))

    for key, message in messages(path):
        if board := board_of(key, GEOMETRY):
            board.geometry = message
            continue
        captured = getattr(message, "captured_ns", None)
        if captured is None:
            continue
        if start is None:
            start = captured
        now = (captured - start) * 1e-9
        if (board := board_of(key, FORCES)) and len(board.time) < MAX_POINTS:
            board.time.append(now)
            board.force.append(np.asarray(message.force, float).reshape(-1, 3))
            board.latency.append((message.received_ns - captured) * 1e-9)
        elif (board := board_of(key, FEATURES)) and len(board.feature_time) < MAX_POINTS:
            board.feature_time.append(now)
            board.features.append(message)
        elif (board := board_of(key, AMBIENT)) and len(board.ambient_time) < MAX_POINTS:
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
