"""Tables of messages as CSV and Parquet, written in batches of rows."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

# Arrow's own pool keeps what it was given: 20 to 40 MB more for batches as small as these. The pool
# is chosen when Arrow is first imported.
os.environ.setdefault("ARROW_DEFAULT_MEMORY_POOL", "system")

import pyarrow as pa

from tactile_tools.log.batches import NOTES, OWN, Budget, Table, own_names
from tactile_tools.log.columns import Column
from tactile_tools.log.decode import list_text
from tactile_tools.log.stream import Record, Stream

GROUP_ROWS = 10_240
GROUP_BYTES = 1 << 20
"""Bytes in Arrow's form after which a row group of a Parquet file is written in any case."""

DICTIONARY_BYTES = 256 << 10
"""Longest list of distinct values of a column in a row group. To find them, Arrow takes ten times
that in memory for each column, and fields of many taxels hardly repeat."""

CSV_ROWS = 128
"""Rows of CSV formatted at once; the widest topics have a thousand columns."""


class ArrowTable(Table):
    """A CSV or Parquet file.

    Batches wait in a file of Arrow's own form, and become the table at the end: then the longest
    list of each column is known, which takes as many columns in CSV, and only one table at a time
    needs the memory of a writer.
    """

    def __init__(
        self,
        path: Path,
        stream: Stream,
        columns: list[Column],
        start_ns: int,
        kind: str,
        decode: Callable[[bytes], Any],
        budget: Budget,
    ) -> None:
        super().__init__(decode, budget)
        self._path = path
        self._scratch = path.with_suffix(".arrow")
        self._stream = stream
        self._start_ns = start_ns
        self._csv = kind == "csv"
        self._widths: dict[str, int] = {}  # longest list by column, for CSV
        self._own = own_names(columns)
        self._columns = columns
        self._file: Any = None
        self._writer: Any = None
        self._schema: pa.Schema | None = None

    def close(self) -> list[dict[str, str]]:
        """Write the table from the batches. Returns a description of the columns."""
        self.flush()
        self._writer.close()
        self._file.close()
        with pa.OSFile(str(self._scratch)) as file, pa.ipc.open_stream(file) as batches:
            schema = self._write_csv(batches) if self._csv else self._write_parquet(batches)
        self._scratch.unlink()
        notes = {name: NOTES[plain] for name, plain in zip(self._own, OWN, strict=True)}
        notes |= {column.name: column.note for column in self._columns}
        return [
            {"name": f.name, "type": str(f.type), "note": notes.get(_stem(f.name, notes), "")}
            for f in schema
        ]

    def write(self, records: list[Record], messages: list[Any]) -> None:
        """Append a batch of rows to the file of batches."""
        names, arrays = self._own_arrays(records)
        for column in self._columns:
            names.append(column.name)
            arrays.append(self._array(column, messages))
        batch = pa.RecordBatch.from_arrays(arrays, names=names)
        if self._schema is None:
            self._schema = self._with_notes(batch.schema)
            self._file = pa.OSFile(str(self._scratch), "wb")
            self._writer = pa.ipc.new_stream(self._file, self._schema)
        self._writer.write_batch(batch.replace_schema_metadata(None).cast(self._schema))

    def _write_parquet(self, batches: Any) -> pa.Schema:
        import pyarrow.parquet

        held: list[pa.RecordBatch] = []
        rows = size = 0
        schema = batches.schema
        with pyarrow.parquet.ParquetWriter(
            str(self._path),
            schema,
            compression="zstd",
            dictionary_pagesize_limit=DICTIONARY_BYTES,
        ) as writer:
            for batch in batches:
                held.append(batch)
                rows, size = rows + batch.num_rows, size + batch.nbytes
                if rows >= GROUP_ROWS or size >= GROUP_BYTES:
                    writer.write_table(pa.Table.from_batches(held, schema))
                    held, rows, size = [], 0, 0
            if held:
                writer.write_table(pa.Table.from_batches(held, schema))
        return schema

    def _write_csv(self, batches: Any) -> pa.Schema:
        import pyarrow.csv

        options = pyarrow.csv.WriteOptions(quoting_style="needed", batch_size=CSV_ROWS)
        writer: Any = None
        schema: pa.Schema | None = None
        for batch in batches:
            spread = self._spread(batch)
            if writer is None:
                schema = spread.schema
                writer = pyarrow.csv.CSVWriter(str(self._path), schema, write_options=options)
            writer.write_batch(spread)
        assert schema is not None  # a table is made with its first row
        writer.close()
        return schema

    def _own_arrays(self, records: list[Record]) -> tuple[list[str], list[pa.Array]]:
        log = np.array([each.log_ns for each in records], np.uint64)
        sent = np.array([each.publish_ns for each in records], np.uint64)
        sequence = np.array([each.sequence for each in records], np.uint32)
        start = self._start_ns  # may be later than a message: no unsigned numbers here
        seconds = np.array([(each.log_ns - start) / 1e9 for each in records])
        return list(self._own), [pa.array(each) for each in (seconds, log, sent, sequence)]

    def _array(self, column: Column, messages: list[Any]) -> pa.Array:
        values = list(map(column.get, messages))
        if column.kind == "number":
            return pa.array(np.array(values, column.dtype))
        if column.kind == "text":
            return pa.array(values, pa.string())
        if column.kind == "rows" and self._csv:
            return pa.array([_json(column, each) for each in values], pa.string())
        if self._csv:
            longest = max(map(len, values))
            self._widths[column.name] = max(self._widths.get(column.name, 0), longest)
        if column.kind == "numbers":
            flat = np.concatenate(values, dtype=column.dtype, casting="unsafe")
            return pa.ListArray.from_arrays(_offsets(values), pa.array(flat))
        if column.kind == "texts":
            return pa.array([list(each) for each in values], pa.list_(pa.string()))
        rows = [row for each in values for row in each]
        parts = {inner.name: _nested(inner, rows) for inner in column.fields}
        struct = pa.StructArray.from_arrays(list(parts.values()), list(parts))
        return pa.ListArray.from_arrays(_offsets(values), struct)

    def _spread(self, batch: pa.RecordBatch) -> pa.RecordBatch:
        """Make a column for each element of the lists of a batch."""
        names: list[str] = []
        arrays: list[pa.Array] = []
        for name, array in zip(batch.schema.names, batch.columns, strict=True):
            if not pa.types.is_list(array.type):
                names.append(name)
                arrays.append(array)
                continue
            width = self._widths[name]
            names += [f"{name}.{i}" for i in range(width)]
            if pa.types.is_string(array.type.value_type):
                lists = array.to_pylist()
                arrays += [
                    pa.array([e[i] if i < len(e) else None for e in lists], pa.string())
                    for i in range(width)
                ]
                continue
            flat = array.flatten().to_numpy(zero_copy_only=False)
            lengths = np.diff(array.offsets.to_numpy())
            there = np.arange(width) < lengths[:, None]
            square = np.zeros((len(array), width), flat.dtype)
            square[there] = flat
            arrays += [pa.array(square[:, i], mask=~there[:, i]) for i in range(width)]
        return pa.RecordBatch.from_arrays(arrays, names=names)

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
    return list_text([column.to_plain(row) for row in rows])
