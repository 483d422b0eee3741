"""NumPy archives of messages.

Columns grow in files of their own, batch by batch, and are packed at the end, so that memory does
not depend on the length of a log.
"""

from __future__ import annotations

import io
import shutil
import sys
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from tactile_tools.log.batches import NOTES, OWN, Budget, Table, own_names
from tactile_tools.log.columns import Column
from tactile_tools.log.decode import list_text
from tactile_tools.log.stream import Record

MAX_TEXT_BYTES = 256 << 20
"""Largest column of texts in NumPy's own form, in which all are as long as the longest, bytes.
Larger ones are kept as UTF-8 with offsets."""

PIECE = 1 << 18
"""Bytes packed at once."""


class _Growing:
    """Raw bytes of one array, in a file that is open only while it is written to."""

    def __init__(self, path: Path, dtype: np.dtype[Any]) -> None:
        self.path = path
        self.dtype = dtype
        self.count = 0

    def add(self, values: np.ndarray[Any, Any]) -> None:
        """Append numbers."""
        self.add_bytes(values.astype(self.dtype, copy=False).tobytes(), values.size)

    def add_bytes(self, data: bytes, count: int) -> None:
        """Append the bytes of ``count`` numbers."""
        self.count += count
        with self.path.open("ab") as file:
            file.write(data)


class NpzTable(Table):
    """One archive.

    Lists of equal length make a matrix; others are stored flat beside their offsets.
    """

    def __init__(
        self,
        path: Path,
        columns: list[Column],
        start_ns: int,
        scratch: Path,
        decode: Callable[[bytes], Any],
        budget: Budget,
    ) -> None:
        super().__init__(decode, budget)
        self._path = path
        self._columns = columns
        self._start_ns = start_ns
        self._scratch = scratch
        scratch.mkdir()
        self._growing: dict[str, _Growing] = {}
        self._ends: dict[str, int] = {}  # last offset by name
        self._lengths: dict[str, tuple[int, bool]] = {}  # of the first list; whether all agree
        self._longest: dict[str, int] = {}
        self._own = own_names(columns)
        self._notes = {name: NOTES[plain] for name, plain in zip(self._own, OWN, strict=True)}

    def write(self, records: list[Record], messages: list[Any]) -> None:
        """Append rows to the files of the columns."""
        own = self._own
        start = self._start_ns  # may be later than a message: no unsigned numbers here
        self._numbers(own[0], np.float64, [(each.log_ns - start) / 1e9 for each in records])
        self._numbers(own[1], np.uint64, [each.log_ns for each in records])
        self._numbers(own[2], np.uint64, [each.publish_ns for each in records])
        self._numbers(own[3], np.uint32, [each.sequence for each in records])
        for column in self._columns:
            self._add(column, column.name, messages)

    def close(self) -> list[dict[str, str]]:
        """Pack the archive. Returns a description of its arrays."""
        self.flush()
        told = []
        with zipfile.ZipFile(
            self._path, "w", zipfile.ZIP_DEFLATED, allowZip64=True, compresslevel=1
        ) as archive:
            for name in [n for n in self._growing if not n.endswith((".offsets", ".utf8"))]:
                told.append(self._pack(archive, name))
            for name in [n for n in self._growing if n.endswith(".utf8")]:
                told += self._pack_texts(archive, name.removesuffix(".utf8"))
            for column in self._columns:
                if column.kind == "rows":
                    told.append(self._pack(archive, f"{column.name}.offsets"))
        shutil.rmtree(self._scratch)
        return told

    def _grow(self, name: str, dtype: Any) -> _Growing:
        growing = self._growing.get(name)
        if growing is None:
            path = self._scratch / str(len(self._growing))
            growing = self._growing[name] = _Growing(path, np.dtype(dtype))
        return growing

    def _numbers(self, name: str, dtype: Any, values: list[Any]) -> None:
        self._grow(name, dtype).add(np.array(values, dtype))

    def _add(self, column: Column, name: str, messages: list[Any]) -> None:
        """Append a column of several messages, or of several rows of a nested table."""
        values = list(map(column.get, messages))
        self._notes.setdefault(name, column.note)
        if column.kind == "number":
            self._numbers(name, column.dtype, values)
        elif column.kind == "text":
            self._texts(name, values)
        elif column.kind == "numbers":
            growing = self._grow(name, column.dtype)
            growing.add(np.concatenate(values, dtype=growing.dtype, casting="unsafe"))
            self._list_lengths(name, list(map(len, values)))
        elif column.kind == "texts":
            self._texts(name, [list_text(list(each)) for each in values])
        else:
            if rows := [row for each in values for row in each]:
                for inner in column.fields:
                    if inner.kind in ("number", "text"):
                        self._add(inner, f"{name}.{inner.name}", rows)
                    else:
                        self._texts(f"{name}.{inner.name}", _as_json(inner, rows))
            self._offsets(name, list(map(len, values)))

    def _texts(self, name: str, texts: list[str]) -> None:
        parts = [text.encode("utf-8", "replace") for text in texts]
        data = b"".join(parts)
        self._grow(f"{name}.utf8", np.uint8).add_bytes(data, len(data))
        self._longest[name] = max(self._longest.get(name, 0), max(map(len, texts)))
        self._offsets(f"{name}.utf8", list(map(len, parts)))

    def _offsets(self, name: str, lengths: list[int]) -> None:
        growing = self._grow(f"{name}.offsets", np.int64)
        if not growing.count:
            growing.add(np.zeros(1, np.int64))
        ends = np.cumsum(lengths, dtype=np.int64) + self._ends.get(name, 0)
        self._ends[name] = int(ends[-1])
        growing.add(ends)

    def _list_lengths(self, name: str, lengths: list[int]) -> None:
        first, same = self._lengths.get(name, (lengths[0], True))
        self._lengths[name] = (first, same and lengths.count(first) == len(lengths))
        self._offsets(name, lengths)

    def _pack(self, archive: zipfile.ZipFile, name: str) -> dict[str, str]:
        growing = self._growing[name]
        length, same = self._lengths.get(name, (0, True))
        shape: tuple[int, ...] = (growing.count,)
        offsets = self._growing.get(f"{name}.offsets")
        if offsets is not None and same and name in self._lengths:
            shape = (self.rows, length)
        elif offsets is not None:
            _write(archive, f"{name}.offsets", offsets.dtype, (offsets.count,), _pieces(offsets))
        _write(archive, name, growing.dtype, shape, _pieces(growing))
        note = self._notes.get(name, "")
        return {"name": name, "type": f"{growing.dtype} {shape}", "note": note}

    def _pack_texts(self, archive: zipfile.ZipFile, name: str) -> list[dict[str, str]]:
        raw, offsets = self._growing[f"{name}.utf8"], self._growing[f"{name}.utf8.offsets"]
        count = offsets.count - 1
        width = max(1, self._longest.get(name, 1))
        note = self._notes.get(name, "")
        if count * width * 4 <= MAX_TEXT_BYTES:
            dtype = np.dtype(f"<U{width}")
            _write(archive, name, dtype, (count,), _square(raw, offsets, dtype))
            return [{"name": name, "type": f"{dtype} ({count},)", "note": note}]
        _write(archive, f"{name}.utf8", raw.dtype, (raw.count,), _pieces(raw))
        _write(archive, f"{name}.utf8.offsets", offsets.dtype, (offsets.count,), _pieces(offsets))
        return [{"name": f"{name}.utf8", "type": "UTF-8 with .offsets", "note": note}]


def _write(
    archive: zipfile.ZipFile,
    name: str,
    dtype: np.dtype[Any],
    shape: tuple[int, ...],
    pieces: Iterator[bytes],
) -> None:
    head = io.BytesIO()
    described = np.lib.format.dtype_to_descr(dtype)
    np.lib.format.write_array_header_2_0(
        head, {"descr": described, "fortran_order": False, "shape": shape}
    )
    with archive.open(f"{name}.npy", "w", force_zip64=True) as entry:
        entry.write(head.getvalue())
        for piece in pieces:
            entry.write(piece)


def _pieces(growing: _Growing) -> Iterator[bytes]:
    with growing.path.open("rb") as file:
        while piece := file.read(PIECE):
            yield piece


def _as_json(column: Column, rows: list[Any]) -> list[str]:
    """Lists within the rows of a nested table as JSON."""
    texts = []
    for value in map(column.get, rows):
        told = value
        if column.kind == "numbers":
            told = np.asarray(value).tolist()
        elif column.kind == "rows":
            told = [column.to_plain(each) for each in value]
        texts.append(list_text(list(told)))
    return texts


def _square(raw: _Growing, offsets: _Growing, dtype: np.dtype[Any]) -> Iterator[bytes]:
    """Texts of equal width, some at a time: all as long as the longest."""
    rows_at_once = max(1, PIECE // dtype.itemsize)
    with raw.path.open("rb") as texts, offsets.path.open("rb") as places:
        before = int.from_bytes(places.read(8), sys.byteorder)
        while piece := places.read(8 * rows_at_once):
            ends = np.frombuffer(piece, np.int64).tolist()
            data, start = texts.read(ends[-1] - before), before
            rows = []
            for end in ends:
                rows.append(data[before - start : end - start].decode("utf-8", "replace"))
                before = end
            yield np.array(rows, dtype).tobytes()
