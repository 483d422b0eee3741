"""Tables of messages as CSV and Parquet, written in batches of rows."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

# Arrow's own pool keeps what it was given: 20 to 40 MB more for batches as small as these. The pool
# is chosen when Arrow is first imported.
os.environ.setdefault("ARROW_DEFAULT_MEMORY_POOL", "system")

import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet

from tactile_tools.log.batches import NOTES, OWN, Budget, Table
from tactile_tools.log.columns import Column
from tactile_tools.log.decode import finite
from tactile_tools.log.stream import Record, Stream

GROUP = 10
GROUP_BYTES = 1 << 20
"""Bytes in Arrow's form after which a row group of a Parquet file is written in any case."""


class ArrowTable(Table):
    """A CSV or Parquet file. ``widths``: of lists, each of which becomes several columns in CSV."""

    def __init__(
        self,
        path: Path,
        stream: Stream,
        columns: list[Column],
        start_ns: int,
        widths: dict[str, int] | None,
        decode: Callable[[bytes], Any],
        budget: Budget,
    ) -> None:
        super().__init__(decode, budget)
        self._path = path
        self._stream = stream
        self._start_ns = start_ns
        self._widths = widths
        taken = {column.name for column in columns}
        self._own = tuple(name + "_" * (name in taken) for name in OWN)
        self._columns = columns
        self._batches: list[pa.RecordBatch] = []
        self._group_bytes = 0
        self._writer: Any = None
        self._schema: pa.Schema | None = None

    def relieve(self) -> None:
        """Write all held rows."""
        self.flush()
        self._write_group()

    def close(self) -> list[dict[str, str]]:
        """Write the held rows and finish. Returns a description of the columns."""
        self.flush()
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

    def write(self, records: list[Record], messages: list[Any]) -> None:
        """Make a batch of rows; a group of batches is written together."""
        names, arrays = self._own_arrays(records)
        for column in self._columns:
            for name, values in self._arrays(column, messages):
                names.append(name)
                arrays.append(values)
        batch = pa.RecordBatch.from_arrays(arrays, names=names)
        if self._schema is None:
            self._schema = self._with_notes(batch.schema)
        self._batches.append(batch.replace_schema_metadata(None))
        self._group_bytes += batch.nbytes
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

    def _own_arrays(self, records: list[Record]) -> tuple[list[str], list[pa.Array]]:
        log = np.array([each.log_ns for each in records], np.uint64)
        sent = np.array([each.publish_ns for each in records], np.uint64)
        sequence = np.array([each.sequence for each in records], np.uint32)
        start = self._start_ns  # may be later than a message: no unsigned numbers here
        seconds = np.array([(each.log_ns - start) / 1e9 for each in records])
        return list(self._own), [pa.array(each) for each in (seconds, log, sent, sequence)]

    def _arrays(self, column: Column, messages: list[Any]) -> list[tuple[str, pa.Array]]:
        values = list(map(column.get, messages))
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
