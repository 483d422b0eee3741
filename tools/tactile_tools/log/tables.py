"""Tables of messages as CSV and Parquet, written in batches of rows."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any, Protocol

import numpy as np

# Arrow's own pool keeps what it was given: 20 to 40 MB more for batches as small as these. The pool
# is chosen when Arrow is first imported.
os.environ.setdefault("ARROW_DEFAULT_MEMORY_POOL", "system")

import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet

from tactile_tools.log.columns import Column
from tactile_tools.log.decode import finite
from tactile_tools.log.stream import Record, Stream

BATCH = 1024
"""Rows per batch: some MB of the widest topic (80 taxels). A Parquet row group has ten batches."""

BATCH_BYTES = 2 << 20
"""Encoded bytes after which a batch is written in any case: as objects they take ten times that."""

HELD_BYTES = 48 << 20
"""Encoded bytes of the messages held by all tables together."""

MESSAGE_BYTES = 500
"""Bytes counted for a message besides its own."""

GROUP = 10
GROUP_BYTES = 1 << 20
"""Encoded bytes after which a row group of a Parquet file is written in any case."""

OWN = ("time_s", "log_time_ns", "publish_time_ns", "log_sequence")
"""Columns in front: seconds since the start of the log, then what the log says of the message."""

NOTES = {
    "time_s": "s since the first message of the log",
    "log_time_ns": "ns since the Unix epoch, when it was logged",
    "publish_time_ns": "ns since the Unix epoch, when it was sent",
    "log_sequence": "number of the message within its stream",
}


class Budget:
    """Memory of all tables of an export; when it is spent, all tables write."""

    def __init__(self, limit: int = HELD_BYTES) -> None:
        self.held = 0
        self._limit = limit

    @property
    def spent(self) -> bool:
        """Whether the tables hold more than the limit."""
        return self.held > self._limit


class Table(Protocol):
    """A table being written. ``rows``: number of rows so far."""

    rows: int

    def add(self, record: Record, message: Any) -> None:
        """Add a row."""

    def relieve(self) -> None:
        """Write all held rows."""

    def close(self) -> list[dict[str, str]]:
        """Write the held rows and finish. Returns a description of the columns."""


class ArrowTable:
    """A CSV or Parquet file. ``widths``: of lists, each of which becomes several columns in CSV."""

    def __init__(
        self,
        path: Path,
        stream: Stream,
        columns: list[Column],
        start_ns: int,
        widths: dict[str, int] | None,
        budget: Budget,
    ) -> None:
        self.rows = 0
        self._budget = budget
        self._path = path
        self._stream = stream
        self._start_ns = start_ns
        self._widths = widths
        taken = {column.name for column in columns}
        self._own = tuple(name + "_" * (name in taken) for name in OWN)
        self._columns = columns
        self._records: list[tuple[int, int, int]] = []
        self._messages: list[Any] = []
        self._bytes = 0
        self._batches: list[pa.RecordBatch] = []
        self._group_bytes = 0
        self._writer: Any = None
        self._schema: pa.Schema | None = None

    def add(self, record: Record, message: Any) -> None:
        """Add a row."""
        self._records.append((record.log_ns, record.publish_ns, record.sequence))
        self._messages.append(message)
        size = len(record.data) + MESSAGE_BYTES
        self._bytes += size
        self._budget.held += size
        self.rows += 1
        if len(self._messages) >= BATCH or self._bytes >= BATCH_BYTES:
            self._flush()

    def relieve(self) -> None:
        """Write all held rows."""
        if self._messages:
            self._flush()
        self._write_group()

    def close(self) -> list[dict[str, str]]:
        """Write the held rows and finish. Returns a description of the columns."""
        if self._messages or self._schema is None:
            self._flush()
        self._write_group()
        if self._writer is not None:
            self._writer.close()
        notes = {name: NOTES[plain] for name, plain in zip(self._own, OWN, strict=True)}
        notes |= {column.name: column.note for column in self._columns}
        assert self._schema is not None
        return [
            {"name": f.name, "type": str(f.type), "note": notes.get(_stem(f.name, notes), "")}
            for f in self._schema
        ]

    def _flush(self) -> None:
        names, arrays = self._own_arrays()
        for column in self._columns:
            for name, values in self._arrays(column):
                names.append(name)
                arrays.append(values)
        batch = pa.RecordBatch.from_arrays(arrays, names=names)
        if self._schema is None:
            self._schema = self._with_notes(batch.schema)
        self._batches.append(batch.replace_schema_metadata(None))
        self._group_bytes += self._bytes
        self._budget.held -= self._bytes
        self._records, self._messages, self._bytes = [], [], 0
        full = len(self._batches) >= GROUP or self._group_bytes >= GROUP_BYTES
        if self._widths is not None or full:
            self._write_group()

    def _write_group(self) -> None:
        schema = self._schema
        if schema is None:
            return
        if self._writer is None:
            if self._widths is not None:
                options = pyarrow.csv.WriteOptions(quoting_style="needed")
                self._writer = pyarrow.csv.CSVWriter(str(self._path), schema, write_options=options)
            else:
                self._writer = pyarrow.parquet.ParquetWriter(
                    str(self._path), schema, compression="zstd"
                )
        if self._batches:
            table = pa.Table.from_batches([b.cast(schema) for b in self._batches], schema)
            self._writer.write_table(table)
        self._batches, self._group_bytes = [], 0

    def _own_arrays(self) -> tuple[list[str], list[pa.Array]]:
        log = np.array([each[0] for each in self._records], np.uint64)
        sent = np.array([each[1] for each in self._records], np.uint64)
        sequence = np.array([each[2] for each in self._records], np.uint32)
        start = self._start_ns  # may be later than a message: no unsigned numbers here
        seconds = np.array([(each[0] - start) / 1e9 for each in self._records])
        return list(self._own), [pa.array(each) for each in (seconds, log, sent, sequence)]

    def _arrays(self, column: Column) -> list[tuple[str, pa.Array]]:
        values = [column.get(message) for message in self._messages]
        if column.kind == "number":
            return [(column.name, pa.array(np.array(values, column.dtype)))]
        if column.kind == "text":
            return [(column.name, pa.array(values, pa.string()))]
        if self._widths is not None:
            return self._spread(column, values)
        if column.kind == "numbers":
            flat = np.concatenate(values) if values else np.zeros(0)
            array = pa.array(np.asarray(flat, column.dtype))
            return [(column.name, pa.ListArray.from_arrays(_offsets(values), array))]
        if column.kind == "texts":
            lists = [list(each) for each in values]
            return [(column.name, pa.array(lists, pa.list_(pa.string())))]
        rows = [row for each in values for row in each]
        parts = {inner.name: _nested(inner, rows) for inner in column.fields}
        struct = pa.StructArray.from_arrays(list(parts.values()), list(parts))
        return [(column.name, pa.ListArray.from_arrays(_offsets(values), struct))]

    def _spread(self, column: Column, values: list[Any]) -> list[tuple[str, pa.Array]]:
        """Make a column for each element of a list; nested tables become one column of JSON."""
        assert self._widths is not None
        if column.kind == "rows":
            return [(column.name, pa.array([_json(column, each) for each in values], pa.string()))]
        width = self._widths.get(column.name, 0)
        if column.kind == "texts":
            return [
                (
                    f"{column.name}.{i}",
                    pa.array([e[i] if i < len(e) else None for e in values], pa.string()),
                )
                for i in range(width)
            ]
        square = np.zeros((len(values), width), column.dtype)
        lengths = np.array([len(each) for each in values], int)
        for row, each in enumerate(values):
            square[row, : len(each)] = each
        return [
            (f"{column.name}.{i}", pa.array(square[:, i], mask=lengths <= i)) for i in range(width)
        ]

    def _with_notes(self, schema: pa.Schema) -> pa.Schema:
        notes = {column.name: column.note for column in self._columns if column.note}
        notes |= {name: NOTES[plain] for name, plain in zip(self._own, OWN, strict=True)}
        fields = [
            field.with_metadata({"comment": notes[field.name]}) if field.name in notes else field
            for field in schema
        ]
        about = {"topic": self._stream.topic, "type": self._stream.msgtype}
        return pa.schema(fields, metadata=about)


def _stem(name: str, notes: dict[str, str]) -> str:
    """Name of the column whose list element ``name`` is."""
    return name if name in notes else name.rpartition(".")[0]


def _offsets(values: list[Any]) -> pa.Array:
    return pa.array(np.concatenate([[0], np.cumsum([len(v) for v in values])]).astype(np.int32))


def _nested(column: Column, rows: list[Any]) -> pa.Array:
    """One field of all rows of a nested table; what is nested again becomes JSON."""
    values = [column.get(row) for row in rows]
    if column.kind == "number":
        return pa.array(np.array(values, column.dtype))
    if column.kind == "text":
        return pa.array(values, pa.string())
    if column.kind == "numbers":
        flat = np.concatenate(values) if values else np.zeros(0)
        array = pa.array(np.asarray(flat, column.dtype))
        return pa.ListArray.from_arrays(_offsets(values), array)
    if column.kind == "texts":
        return pa.array([list(each) for each in values], pa.list_(pa.string()))
    return pa.array([_json(column, each) for each in values], pa.string())


def _json(column: Column, rows: Any) -> str:
    return json.dumps(finite([column.to_plain(row) for row in rows]), ensure_ascii=False)
