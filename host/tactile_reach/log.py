"""Logs as numpy arrays: each topic is a table of columns."""

from __future__ import annotations

import struct
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.base import TypesysError

from tactile_core.bus.messages import codec
from tactile_core.bus.topics import RAW, find_topic
from tactile_core.log.reader import LogReader
from tactile_core.log.records import Block, LogError, SchemaRecord
from tactile_reach.client import TactileError

if TYPE_CHECKING:
    import pandas

NAME = 2
"""Kind of a field that is a nested message, in rosbags' numbering."""

TIME = "builtin_interfaces/msg/Time"


@dataclass(frozen=True, slots=True, eq=False)
class Table(Mapping[str, NDArray[Any]]):
    """One topic: columns by name, all of the same length.

    ``time_s``: when each message was logged, s since the log's first message of any topic. Nested
    fields have dotted names (``wrench.force.x``), stamps end in ``_ns`` (int64 ns). A list field is
    (n, k) if every message has k elements, otherwise an array of arrays; a list of nested messages
    (``patches``) is an array of lists of messages. ``undecodable``: number of messages left out.
    """

    topic: str
    msgtype: str
    time_s: NDArray[np.float64]
    columns: dict[str, NDArray[Any]]
    undecodable: int = 0

    def __getitem__(self, column: str) -> NDArray[Any]:
        try:
            return self.columns[column]
        except KeyError:
            raise KeyError(
                f"no column {column!r} in {self.topic} (available: {', '.join(self.columns)})"
            ) from None

    def __iter__(self) -> Iterator[str]:
        return iter(self.columns)

    def __len__(self) -> int:
        return len(self.columns)

    def to_pandas(self) -> pandas.DataFrame:
        """Convert to a DataFrame indexed by ``time_s``; lists of k numbers become ``name[0]`` and
        so on.

        Needs pandas, which is not installed with this package.
        """
        try:
            import pandas as pd
        except ImportError as error:
            raise TactileError("to_pandas needs pandas: pip install pandas") from error
        wide: dict[str, Any] = {}
        for name, values in self.columns.items():
            if values.ndim == 2:
                wide |= {f"{name}[{i}]": values[:, i] for i in range(values.shape[1])}
            else:
                wide[name] = values
        return pd.DataFrame(wide, index=pd.Index(self.time_s, name="time_s"))


@dataclass(frozen=True, slots=True, eq=False)
class Log(Mapping[str, Table]):
    """A log: its topics by name. ``start_ns``: Unix time of its first message.

    ``closed``: the log was finished in order. ``left_out``: topics of unknown types, with the
    reason.
    """

    path: Path
    start_ns: int
    closed: bool
    tables: dict[str, Table]
    left_out: dict[str, str] = field(default_factory=dict)

    def __getitem__(self, topic: str) -> Table:
        name = topic if topic.startswith("/") else "/" + topic
        try:
            return self.tables[name]
        except KeyError:
            raise KeyError(
                f"no topic {topic!r} in {self.path} (available: {', '.join(self.tables)})"
            ) from None

    def __iter__(self) -> Iterator[str]:
        return iter(self.tables)

    def __len__(self) -> int:
        return len(self.tables)

    def board(self, name: str) -> dict[str, Table]:
        """Tables of one board by the last word of their topic, such as features or forces."""
        head = f"/tactile/{name}/"
        found = {t.removeprefix(head): table for t, table in self.tables.items() if head in t}
        if not found:
            boards = sorted({t.split("/")[2] for t in self.tables if t.startswith("/tactile/")})
            raise KeyError(f"no board {name!r} in {self.path} (available: {', '.join(boards)})")
        return found


def read_log(path: str | Path, topics: Collection[str] | None = None) -> Log:
    """Read a log into memory: all topics except the raw bytes, or those named.

    Raises `TactileError` if the file cannot be read, is not a log, or holds nothing requested.
    Damaged parts are skipped (`tactile log doctor` reports them).
    """
    wanted = None if topics is None else {t if t.startswith("/") else f"/{t}" for t in topics}
    path = Path(path)
    taken: dict[str, _Rows] = {}
    left_out: dict[str, str] = {}
    first_ns: int | None = None
    try:
        with LogReader(path) as reader:
            for event in reader.events():
                if not isinstance(event, Block):
                    continue
                for message in reader.messages(event):
                    channel = reader.channels.get(message.channel)
                    if channel is None:
                        continue
                    if first_ns is None or message.log_ns < first_ns:
                        first_ns = message.log_ns
                    topic = channel.topic
                    if topic in left_out or not _is_wanted(topic, wanted):
                        continue
                    rows = taken.get(topic)
                    if rows is None:
                        schema = reader.schemas.get(channel.schema)
                        try:
                            rows = taken[topic] = _Rows(schema)
                        except ValueError as error:
                            left_out[topic] = str(error)
                            continue
                    rows.add(message.log_ns, message.data)
            closed = reader.closed
    except LogError as error:
        raise TactileError(str(error)) from error
    if first_ns is None:
        raise TactileError(f"{path} holds no messages; `tactile log doctor` says why")
    if not taken:
        what = "of those topics" if wanted else "of a type that is known here"
        raise TactileError(f"{path} holds nothing {what}; `tactile log info` lists its topics")
    start_ns = first_ns
    tables = {topic: rows.table(topic, start_ns) for topic, rows in sorted(taken.items())}
    return Log(path, start_ns, closed, tables, left_out)


def _is_wanted(topic: str, wanted: set[str] | None) -> bool:
    if wanted is not None:
        return topic in wanted
    found = find_topic(topic)
    return found is None or found[0] != RAW


class _Rows:
    """Collects the messages of one topic into columns."""

    def __init__(self, schema: SchemaRecord | None) -> None:
        """Raises ValueError if the type cannot be read."""
        if schema is None:
            raise ValueError("no definition of its type in the log")
        self.msgtype = schema.name
        self._decode, fields = _reader_of(schema)
        self._getters = dict(_columns(fields, self.msgtype, "", ""))
        self._values: dict[str, list[Any]] = {name: [] for name in self._getters}
        self._times: list[int] = []
        self._undecodable = 0

    def add(self, log_ns: int, data: bytes) -> None:
        try:
            message = self._decode(data)
        except (SerdeError, ValueError, struct.error, IndexError, OverflowError):
            self._undecodable += 1
            return
        self._times.append(log_ns)
        for name, get in self._getters.items():
            self._values[name].append(get(message))

    def table(self, topic: str, start_ns: int) -> Table:
        time_s = np.array([ns - start_ns for ns in self._times], np.float64) * 1e-9
        columns = {name: _column(values) for name, values in self._values.items()}
        return Table(topic, self.msgtype, time_s, columns, self._undecodable)


Fields = Callable[[str], tuple[tuple[str, Any], ...]]
"""Names and rosbags descriptions of the fields of a type."""


def _reader_of(schema: SchemaRecord) -> tuple[Callable[[bytes], Any], Fields]:
    """Decoder and fields of a type: ours if the log has the same, otherwise as the log defines it.

    Logs of earlier versions lack fields added since.
    """
    name = schema.name
    try:
        if schema.data == codec().schema(name).data:
            return (lambda data: codec().decode(name, data)), codec().fields
    except ValueError:
        pass  # a type of another program
    if schema.encoding != "ros2msg":
        raise ValueError(f"{name} is defined in {schema.encoding or 'nothing'}, not in ros2msg")
    try:
        store = get_typestore(Stores.EMPTY)
        types = get_types_from_msg(schema.data.decode(), name)
        store.register({k: v for k, v in types.items() if k not in store.fielddefs})
        store.fielddefs[name]
    except (TypesysError, UnicodeDecodeError, KeyError, ValueError, RecursionError) as error:
        raise ValueError(f"the definition of {name} cannot be read: {error}") from error

    def fields(msgtype: str) -> tuple[tuple[str, Any], ...]:
        return tuple(store.fielddefs[msgtype][1])

    return (lambda data: store.deserialize_cdr(data, name)), fields


def _columns(
    fields: Fields, msgtype: str, path: str, prefix: str
) -> Iterator[tuple[str, Callable[[Any], Any]]]:
    """Yield name and getter of every column of a type."""
    for name, (kind, arguments) in fields(msgtype):
        here = f"{path}.{name}" if path else name
        get = attrgetter(here)
        if kind == NAME and arguments == TIME:
            yield f"{prefix}{name}_ns", _time(get)
        elif kind == NAME:
            yield from _columns(fields, arguments, here, f"{prefix}{name}.")
        else:
            yield prefix + name, get


def _time(get: Callable[[Any], Any]) -> Callable[[Any], int]:
    def nanoseconds(message: Any) -> int:
        time = get(message)
        return int(time.sec) * 1_000_000_000 + int(time.nanosec)

    return nanoseconds


def _column(values: list[Any]) -> NDArray[Any]:
    """Build a column: plain values, stacked lists of equal length, or an array of objects."""
    if values and isinstance(values[0], np.ndarray):
        if len({len(each) for each in values}) == 1:
            return np.stack(values)
    elif not values or not isinstance(values[0], list):
        return np.array(values)
    apart = np.empty(len(values), object)
    for i, each in enumerate(values):
        apart[i] = each
    return apart
