"""NumPy archives of messages.

Columns grow in files of their own and are packed at the end, so that memory does not depend on the
length of a log.
"""

from __future__ import annotations

import io
import json
import shutil
import zipfile
from array import array
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from tactile_tools.log.columns import Column
from tactile_tools.log.decode import finite
from tactile_tools.log.stream import Record
from tactile_tools.log.tables import NOTES, OWN, Budget

MAX_TEXT_BYTES = 256 << 20
"""Largest column of texts in NumPy's own form, in which all are as long as the longest, bytes.
Larger ones are kept as UTF-8 with offsets."""

PIECE = 1 << 20

HELD = 1 << 16
"""Bytes of a column that are held in memory."""


class _Growing:
    """Raw bytes of one array, in a file that is open only while it is written to."""

    def __init__(self, path: Path, dtype: np.dtype[Any], budget: Budget) -> None:
        self.path = path
        self.dtype = dtype
        self.count = 0
        self._budget = budget
        self._held = bytearray()

    def add(self, values: Any) -> None:
        """Append numbers."""
        data = np.ascontiguousarray(values, self.dtype)
        self.count += data.size
        self.add_bytes(data.tobytes())

    def add_bytes(self, data: bytes) -> None:
        """Append bytes; `add` of another array keeps their lengths."""
        self._held += data
        self._budget.held += len(data)
        if len(self._held) >= HELD:
            self.flush()

    def flush(self) -> None:
        """Write all held bytes to the file."""
        with self.path.open("ab") as file:
            file.write(self._held)
        self._budget.held -= len(self._held)
        self._held.clear()


class NpzTable:
    """One archive.

    Lists of equal length make a matrix; others are stored flat beside their offsets.
    """

    def __init__(
        self, path: Path, columns: list[Column], start_ns: int, scratch: Path, budget: Budget
    ) -> None:
        self.rows = 0
        self._path = path
        self._columns = columns
        self._start_ns = start_ns
        self._scratch = scratch
        self._budget = budget
        scratch.mkdir()
        self._growing: dict[str, _Growing] = {}
        self._lengths: dict[str, tuple[int, bool]] = {}  # of the first list; whether all agree
        self._longest: dict[str, int] = {}
        self._notes: dict[str, str] = dict(NOTES)

    def add(self, record: Record, message: Any) -> None:
        """Add a row."""
        self.rows += 1
        self._numbers(OWN[0], np.float64, (record.log_ns - self._start_ns) / 1e9)
        for name, value in zip(OWN[1:3], (record.log_ns, record.publish_ns), strict=True):
            self._numbers(name, np.uint64, value)
        self._numbers(OWN[3], np.uint32, record.sequence)
        for column in self._columns:
            self._add(column, column.name, message)

    def relieve(self) -> None:
        """Write all held rows to the files."""
        for growing in self._growing.values():
            growing.flush()

    def close(self) -> list[dict[str, str]]:
        """Pack the archive. Returns a description of its arrays."""
        self.relieve()
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
            growing = self._growing[name] = _Growing(path, np.dtype(dtype), self._budget)
        return growing

    def _numbers(self, name: str, dtype: Any, values: Any) -> None:
        self._grow(name, dtype).add(values)

    def _add(self, column: Column, name: str, message: Any) -> None:
        value = column.get(message)
        self._notes.setdefault(name, column.note)
        if column.kind == "number":
            self._numbers(name, column.dtype, value)
        elif column.kind == "text":
            self._text(name, value)
        elif column.kind == "numbers":
            self._numbers(name, column.dtype, value)
            self._length(name, len(value))
        elif column.kind == "texts":
            self._text(name, json.dumps(list(value), ensure_ascii=False))
        else:
            for row in value:
                for inner in column.fields:
                    if inner.kind in ("number", "text"):
                        self._add(inner, f"{name}.{inner.name}", row)
                    else:
                        told = inner.get(row)
                        if inner.kind == "numbers":
                            told = np.asarray(told).tolist()
                        elif inner.kind == "rows":
                            told = [inner.to_plain(each) for each in told]
                        text = json.dumps(finite(list(told)), ensure_ascii=False)
                        self._text(f"{name}.{inner.name}", text)
            self._offset(name, len(value))

    def _text(self, name: str, text: str) -> None:
        data = text.encode("utf-8", "replace")
        growing = self._grow(f"{name}.utf8", np.uint8)
        growing.add_bytes(data)
        growing.count += len(data)
        self._longest[name] = max(self._longest.get(name, 0), len(text))
        self._offset(f"{name}.utf8", len(data))

    def _offset(self, name: str, length: int) -> None:
        growing = self._grow(f"{name}.offsets", np.int64)
        if not growing.count:
            growing.add(0)
            self._lengths[f"{name}.offsets"] = (0, True)
        total = self._lengths[f"{name}.offsets"][0] + length
        self._lengths[f"{name}.offsets"] = (total, True)
        growing.add(total)

    def _length(self, name: str, length: int) -> None:
        first, same = self._lengths.get(name, (length, True))
        self._lengths[name] = (first, same and first == length)
        self._offset(name, length)

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
            _write(archive, name, dtype, (count,), _texts(raw, offsets, dtype))
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


def _texts(raw: _Growing, offsets: _Growing, dtype: np.dtype[Any]) -> Iterator[bytes]:
    with raw.path.open("rb") as texts, offsets.path.open("rb") as places:
        before = array("q", places.read(8))[0]
        while piece := places.read(8 * 4096):
            ends = array("q", piece)
            rows = []
            for end in ends:
                rows.append(texts.read(end - before).decode("utf-8", "replace"))
                before = end
            yield np.array(rows, dtype).tobytes()
