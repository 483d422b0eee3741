"""Logs as a LeRobot data set (format v3.0): one episode per log, all streams on one clock.

Files: ``meta/info.json`` (features), ``meta/stats.json``, ``meta/tasks.parquet``,
``meta/episodes/*/*.parquet``, ``data/*/*.parquet``. A frame holds what was known at its time: the
newest message of each stream that had been logged by then, as a policy would have seen it.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from tactile_core.bus.messages import DecodeError
from tactile_core.bus.topics import (
    ARM_STATE,
    COMMAND,
    FEATURES,
    FORCES,
    GEOMETRY,
    REACH_STATE,
    Topic,
    find_topic,
)
from tactile_core.cli import progress
from tactile_core.types import NS_PER_S
from tactile_tools.log.decode import Decoder
from tactile_tools.log.sources import Series
from tactile_tools.log.stream import Reading, Record, read_series
from tactile_tools.log.terminal import (
    FAULTY,
    ToolError,
    cannot_write,
    complain,
    plain_console,
)

Float32 = NDArray[np.float32]

VERSION: Final = "v3.0"
INFO: Final = "meta/info.json"
CHUNK_FILES: Final = 1000
FILE_MB: Final = 100
DATA_PATH: Final = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
EPISODES_PATH: Final = "meta/episodes/chunk-000/file-000.parquet"
DEFAULT_FPS: Final = 50
MAX_FPS: Final = 1000
DEFAULT_TASK: Final = "reach into the cupboard"
QUANTILES: Final = (0.01, 0.10, 0.50, 0.90, 0.99)

STALE_S: Final = FEATURES.stale_after or 0.2
"""Age from which touch is marked as not valid, s."""

CONTACT: Final = (
    "valid", "normal_force", "peak_force", "tip_force", "peak_x", "peak_y",
    "wrench.fx", "wrench.fy", "wrench.fz", "wrench.mx", "wrench.my", "wrench.mz",
)  # fmt: skip
STATE: Final = ("x", "y", "heading", "vx", "vy", "omega", "fx", "fy", "mz")
ACTION: Final = ("vx", "vy", "omega")
GOAL: Final = ("x", "y", "distance")

TACTILE, CONTACTS, ARM, TARGET, ACTIONS = (
    "observation.tactile",
    "observation.contact",
    "observation.state",
    "observation.goal",
    "action",
)
INDICES: Final = ("timestamp", "frame_index", "episode_index", "index", "task_index")
_TAKEN: Final = (FEATURES, FORCES, GEOMETRY, ARM_STATE, COMMAND, REACH_STATE)


def run(logs: Sequence[Series], out: Path, *, fps: int, task: str, force: bool) -> int:
    """Export ``logs`` to folder ``out``. Returns 1 if some messages could not be read, else 0.

    ToolError when there is nothing to export, when the logs hold different streams, or when ``out``
    exists.
    """
    _check_folder(out, force)
    part = out.with_name(f".{out.name}.{os.getpid()}.part")
    try:
        shutil.rmtree(part, ignore_errors=True)
        writer = _Writer(part, fps, task)
        lossy: list[str] = []
        for series in logs:
            reading = Reading()
            episode = _read(series, reading, fps)
            writer.add(series.name, episode)
            if reading.lossy or episode.undecoded:
                lossy.append(series.name)
        writer.close()
        if out.exists():
            shutil.rmtree(out)
        part.replace(out)
    except OSError as error:
        raise cannot_write(out, error) from error
    finally:
        with contextlib.suppress(OSError):
            shutil.rmtree(part)
    console = plain_console()
    console.print(
        f"{out}: {writer.episodes} episodes, {writer.frames} frames at {fps} Hz, "
        f"{', '.join(f'{k} {len(v)}' for k, v in writer.names.items())}"
    )
    if writer.not_finite:
        console.print(f"{writer.not_finite} values that were not finite (masked taxels) became 0")
    for name in lossy:
        complain(f"{name} is not whole, or holds messages that cannot be read; exported the rest")
    return FAULTY if lossy else 0


def _check_folder(out: Path, force: bool) -> None:
    if not out.exists():
        return
    if not out.is_dir() or (any(out.iterdir()) and not (out / INFO).exists()):
        raise ToolError(f"{out} is there already and not a LeRobot data set: name another --out")
    if any(out.iterdir()) and not force:
        raise ToolError(f"{out} exists and is not overwritten: name another, or give --force")


@dataclass(slots=True)
class _Episode:
    """Frames of one log. ``names``: of the elements, by feature. ``rows``: arrays (n, elements)."""

    names: dict[str, list[str]]
    rows: dict[str, Float32]
    undecoded: int = 0
    not_finite: int = 0


@dataclass(slots=True)
class _Newest:
    """The newest message of each stream, and when it was logged."""

    messages: dict[tuple[Topic, str], Any] = field(default_factory=dict)
    log_ns: dict[tuple[Topic, str], int] = field(default_factory=dict)


def _read(series: Series, reading: Reading, fps: int) -> _Episode:
    """Read the frames of a log, from when every stream has begun until touch ends."""
    streams = _streams(series)
    boards = [name for topic, name in streams if topic in (FEATURES, FORCES)]
    if not boards:
        raise ToolError(f"{series.name} holds no forces or features of a board: nothing to export")
    needed = [key for key in streams if key[0] is not GEOMETRY]
    newest, decoder = _Newest(), Decoder()
    undecoded = 0
    tick_ns: int | None = None
    number, frames = 0, []
    with progress("exporting") as report:
        for item in read_series(series, reading, report, _wanted):
            if not isinstance(item, Record):
                continue
            found = find_topic(item.stream.topic)
            if found is None or found not in streams:
                continue
            if tick_ns is None and all(key in newest.messages for key in needed):
                tick_ns = item.log_ns
            # What is logged exactly at a tick belongs to the next frame, so it is not taken in yet.
            while tick_ns is not None and found[0] in (FEATURES, FORCES) and tick_ns <= item.log_ns:
                at_ns = tick_ns + round(number * NS_PER_S / fps)
                if at_ns > item.log_ns:
                    break
                frames.append(_frame(streams, newest, at_ns))
                number += 1
            try:
                newest.messages[found] = decoder.decode(item.stream, item.data)
                newest.log_ns[found] = item.log_ns
            except DecodeError:
                undecoded += 1
    if not frames:
        missing = [t.channel(n) for t, n in needed if (t, n) not in newest.messages]
        why = f"no message on {', '.join(missing)}" if missing else "it is too short"
        raise ToolError(f"{series.name} gives no frame: {why}")
    names = _names(streams, newest)
    rows, not_finite = {}, 0
    for feature, elements in names.items():
        values = np.array([_row(frame[feature], len(elements), series) for frame in frames])
        finite = np.isfinite(values)
        not_finite += int((~finite).sum())
        rows[feature] = np.where(finite, values, 0.0).astype(np.float32)
    return _Episode(names, rows, undecoded, not_finite)


def _row(values: list[float], length: int, series: Series) -> list[float]:
    if len(values) != length:
        raise ToolError(
            f"{series.name}: a board has {len(values)} values once and {length} later; split the "
            "log where the board changed (tactile log split)"
        )
    return values


def _wanted(topic: str) -> bool:
    found = find_topic(topic)
    return found is not None and found[0] in _TAKEN and not topic.startswith("/replay/")


def _streams(series: Series) -> list[tuple[Topic, str]]:
    """Streams of a log with at least one message, in a fixed order."""
    seen: dict[tuple[Topic, str], None] = {}
    for item in read_series(series, Reading(), None, _wanted):
        if isinstance(item, Record):
            found = find_topic(item.stream.topic)
            if found is not None:
                seen[found] = None
    return sorted(seen, key=lambda key: (_TAKEN.index(key[0]), key[1]))


def _frame(
    streams: Sequence[tuple[Topic, str]], newest: _Newest, at_ns: int
) -> dict[str, list[float]]:
    """Elements of each feature as known at ``at_ns``."""
    frame: dict[str, list[float]] = {}
    for key in streams:
        made = _FEATURES.get(key[0])
        if made is not None:
            age_s = (at_ns - newest.log_ns[key]) / NS_PER_S
            frame.setdefault(made[0], []).extend(made[1](newest.messages[key], age_s))
    return frame


def _names(streams: Sequence[tuple[Topic, str]], newest: _Newest) -> dict[str, list[str]]:
    """Names of the elements of each feature, in the order of `_frame`."""
    names: dict[str, list[str]] = {}
    for key in streams:
        topic, name = key
        made = _FEATURES.get(topic)
        if made is None:
            continue
        if topic is FORCES:
            elements = list(_taxels(newest.messages[key], newest.messages.get((GEOMETRY, name))))
        else:
            elements = list(made[2])
        lead = f"{name}." if topic in (FORCES, FEATURES) else ""
        names.setdefault(made[0], []).extend(lead + element for element in elements)
    return names


def _taxels(forces: Any, geometry: Any) -> Iterator[str]:
    """Yield ``array.taxel.axis`` for each number of a ``TaxelForces``."""
    counts = [int(n) for n in forces.array_taxels]
    called = list(getattr(geometry, "array_name", ()))
    for index, count in enumerate(counts):
        array = called[index] if len(called) == len(counts) else f"array{index}"
        for taxel in range(count):
            yield from (f"{array}.{taxel}.{axis}" for axis in "xyz")


def _forces(message: Any, age_s: float) -> list[float]:
    del age_s
    return [float(value) for value in message.force]


def _features(message: Any, age_s: float) -> list[float]:
    force, torque = message.wrench.force, message.wrench.torque
    valid = bool(message.valid) and age_s <= STALE_S
    place = message.peak_position
    return [
        float(valid), message.normal_force, message.peak_force, message.tip_force,
        place.x, place.y, force.x, force.y, force.z, torque.x, torque.y, torque.z,
    ]  # fmt: skip


def _arm(message: Any, age_s: float) -> list[float]:
    del age_s
    twist, wrench = message.twist, message.wrench
    return [
        message.x, message.y, message.heading, twist.linear.x, twist.linear.y, twist.angular.z,
        wrench.force.x, wrench.force.y, wrench.torque.z,
    ]  # fmt: skip


def _command(message: Any, age_s: float) -> list[float]:
    if age_s > message.expiry:
        return [0.0, 0.0, 0.0]  # the command has expired: the arm does not follow it any more
    return [message.twist.linear.x, message.twist.linear.y, message.twist.angular.z]


def _reach(message: Any, age_s: float) -> list[float]:
    del age_s
    return [message.goal.x, message.goal.y, message.distance]


_FEATURES: Final[dict[Topic, tuple[str, Callable[[Any, float], list[float]], tuple[str, ...]]]] = {
    FORCES: (TACTILE, _forces, ()),
    FEATURES: (CONTACTS, _features, CONTACT),
    ARM_STATE: (ARM, _arm, STATE),
    REACH_STATE: (TARGET, _reach, GOAL),
    COMMAND: (ACTIONS, _command, ACTION),
}


class _Writer:
    """Writes a data set: `add` each episode, then `close`."""

    def __init__(self, folder: Path, fps: int, task: str) -> None:
        self.episodes = 0
        self.frames = 0
        self.not_finite = 0
        self.names: dict[str, list[str]] = {}
        self._first = ""
        self._folder = folder
        self._fps = fps
        self._task = task
        self._file = 0
        self._parquet: pq.ParquetWriter | None = None
        self._written = 0
        self._metadata: list[dict[str, Any]] = []
        self._stats: list[dict[str, dict[str, NDArray[np.float64]]]] = []

    def add(self, name: str, episode: _Episode) -> None:
        """Write one episode; ToolError when its streams differ from those of the others."""
        if not self.names:
            self.names, self._first = episode.names, name
        elif episode.names != self.names:
            raise ToolError(_difference(self._first, self.names, name, episode.names))
        count = len(next(iter(episode.rows.values())))
        steps = np.arange(count)
        columns: dict[str, NDArray[Any]] = dict(episode.rows) | {
            "timestamp": (steps / self._fps).astype(np.float32),
            "frame_index": steps.astype(np.int64),
            "episode_index": np.full(count, self.episodes, np.int64),
            "index": (self.frames + steps).astype(np.int64),
            "task_index": np.zeros(count, np.int64),
        }
        self._write(pa.table({key: _arrow(values) for key, values in columns.items()}))
        stats = {key: _statistics(values) for key, values in columns.items()}
        self._stats.append(stats)
        row: dict[str, Any] = {
            "episode_index": self.episodes,
            "tasks": [self._task],
            "length": count,
            "data/chunk_index": self._file // CHUNK_FILES,
            "data/file_index": self._file % CHUNK_FILES,
            "dataset_from_index": self.frames,
            "dataset_to_index": self.frames + count,
            "meta/episodes/chunk_index": 0,
            "meta/episodes/file_index": 0,
        }
        for key, measures in stats.items():
            for measure, values in measures.items():
                row[f"stats/{key}/{measure}"] = values.tolist()
        self._metadata.append(row)
        self.episodes += 1
        self.frames += count
        self.not_finite += episode.not_finite

    def close(self) -> None:
        """Write the files that describe the data."""
        if self._parquet is not None:
            self._parquet.close()
        meta = self._folder / "meta"
        episodes = self._folder / EPISODES_PATH
        episodes.parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(pa.Table.from_pylist(self._metadata), episodes)
        pq.write_table(_tasks(self._task), meta / "tasks.parquet")
        totals = {key: _together([s[key] for s in self._stats]) for key in self._stats[0]}
        plain = {k: {m: v.tolist() for m, v in measures.items()} for k, measures in totals.items()}
        (meta / "stats.json").write_text(json.dumps(plain, indent=1) + "\n", encoding="utf-8")
        (self._folder / INFO).write_text(json.dumps(self._info(), indent=1) + "\n", "utf-8")

    def _write(self, table: pa.Table) -> None:
        if self._parquet is not None and self._written >= FILE_MB << 20:
            self._parquet.close()
            self._parquet, self._written = None, 0
            self._file += 1
        if self._parquet is None:
            path = self._folder / DATA_PATH.format(
                chunk_index=self._file // CHUNK_FILES, file_index=self._file % CHUNK_FILES
            )
            path.parent.mkdir(parents=True, exist_ok=True)
            self._parquet = pq.ParquetWriter(path, table.schema, compression="snappy")
        self._parquet.write_table(table)
        self._written += table.nbytes

    def _info(self) -> dict[str, Any]:
        features: dict[str, Any] = {
            key: {"dtype": "float32", "shape": [len(names)], "names": names}
            for key, names in self.names.items()
        }
        for key in INDICES:
            dtype = "float32" if key == "timestamp" else "int64"
            features[key] = {"dtype": dtype, "shape": [1], "names": None}
        return {
            "codebase_version": VERSION,
            "robot_type": "tactile-reach",
            "total_episodes": self.episodes,
            "total_frames": self.frames,
            "total_tasks": 1,
            "chunks_size": CHUNK_FILES,
            "data_files_size_in_mb": FILE_MB,
            "video_files_size_in_mb": 200,
            "fps": self._fps,
            "splits": {"train": f"0:{self.episodes}"},
            "data_path": DATA_PATH,
            "video_path": None,
            "features": features,
        }


def _arrow(values: NDArray[Any]) -> pa.Array:
    """Make a column: numbers, or lists of fixed length."""
    if values.ndim == 1:
        return pa.array(values)
    return pa.FixedSizeListArray.from_arrays(pa.array(values.reshape(-1)), values.shape[1])


def _tasks(task: str) -> pa.Table:
    """Make the table of tasks, as pandas writes a frame indexed by task."""
    index = "__index_level_0__"
    table = pa.table({"task_index": pa.array([0], pa.int64()), index: pa.array([task])})
    about = {
        "index_columns": [index],
        "column_indexes": [],
        "columns": [
            {"name": "task_index", "field_name": "task_index", "pandas_type": "int64",
             "numpy_type": "int64", "metadata": None},
            {"name": None, "field_name": index, "pandas_type": "unicode",
             "numpy_type": "object", "metadata": None},
        ],
    }  # fmt: skip
    return table.replace_schema_metadata({b"pandas": json.dumps(about).encode()})


def _statistics(values: NDArray[Any]) -> dict[str, NDArray[np.float64]]:
    """Statistics of one episode by element: arrays (elements,), and ``count`` (1,)."""
    table = values.reshape(len(values), -1).astype(np.float64)
    found = {
        "min": table.min(axis=0),
        "max": table.max(axis=0),
        "mean": table.mean(axis=0),
        "std": table.std(axis=0),
        "count": np.array([len(table)], np.int64),
    }
    for q, row in zip(QUANTILES, np.quantile(table, QUANTILES, axis=0), strict=True):
        found[f"q{round(q * 100):02d}"] = row
    return found


def _together(
    stats: Sequence[dict[str, NDArray[np.float64]]],
) -> dict[str, NDArray[np.float64]]:
    """Combine the statistics of episodes. Quantiles are averaged by length, as LeRobot does it."""
    weight = np.array([s["count"][0] for s in stats], np.float64)
    weight /= weight.sum()
    means = np.array([s["mean"] for s in stats])
    mean = weight @ means
    variance = weight @ (np.array([s["std"] for s in stats]) ** 2 + (means - mean) ** 2)
    total = {
        "min": np.min([s["min"] for s in stats], axis=0),
        "max": np.max([s["max"] for s in stats], axis=0),
        "mean": mean,
        "std": np.sqrt(variance),
        "count": np.array([sum(int(s["count"][0]) for s in stats)], np.int64),
    }
    for key in stats[0]:
        if key not in total:
            total[key] = weight @ np.array([s[key] for s in stats])
    return total


def _difference(
    first: str, has: dict[str, list[str]], second: str, other: dict[str, list[str]]
) -> str:
    """Say why two logs cannot be episodes of one data set."""
    for key in sorted({*has, *other}):
        ours, theirs = has.get(key, []), other.get(key, [])
        if ours != theirs:
            extra = sorted(set(ours) ^ set(theirs))[:3]
            return (
                f"{second} does not hold what {first} does: {key} has {len(theirs)} values, not "
                f"{len(ours)} ({', '.join(extra) or 'in another order'}); export them apart"
            )
    raise ValueError("the logs hold the same")
