"""Decode messages with wide strings, which rosbags does not read, field by field.

Writers encode wide strings in three ways. The number in front counts letters of four bytes or of
two bytes (DDS implementations with the old encoding), or it counts bytes (the new encoding).
Nothing in a message says which; only the right one ends exactly where the message ends.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np

BASE, NAME, ARRAY, SEQUENCE = 1, 2, 3, 4
"""Kinds of a field in rosbags' definitions (its ``Nodetype``)."""

NUMBERS = {
    "bool": "?", "byte": "u1", "octet": "u1", "char": "u1", "int8": "i1", "uint8": "u1",
    "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4", "int64": "i8", "uint64": "u8",
    "float32": "f4", "float64": "f8",
}  # fmt: skip

MAX_NESTED = 64

PADDING = 7
"""Bytes that a writer may leave at the end, to align the next message."""

Fields = dict[str, Any]


class CdrError(ValueError):
    """The bytes are not a message of this type."""


class WideDecoder:
    """Decodes messages of one type; remembers which encoding of wide strings was right."""

    def __init__(self, fields: Fields, msgtype: str) -> None:
        self._fields = fields
        self._msgtype = msgtype
        self._ways = [_quads, _bytes, _pairs]

    def __call__(self, data: bytes) -> Any:
        """Decode the message in ``data``; `CdrError` when it is not one."""
        trouble: Exception | None = None
        # Bytes skipped for alignment are nearly always 0; others suggest a wrong encoding, so
        # encodings that skip only zeros are tried first.
        for strict, way in ((strict, way) for strict in (True, False) for way in self._ways):
            try:
                found = _Cursor(data, self._fields, way, strict).message(self._msgtype)
            except (CdrError, UnicodeDecodeError, struct.error, KeyError) as error:
                trouble = trouble or error
                continue
            if way is not self._ways[0]:
                self._ways = [way, *(other for other in self._ways if other is not way)]
            return found
        raise CdrError(str(trouble))


class _Cursor:
    """Reads values from the bytes of one message."""

    def __init__(
        self, data: bytes, fields: Fields, wide: Callable[[_Cursor, int], str], strict: bool
    ) -> None:
        if len(data) < 4 or data[0] != 0 or data[1] not in (0, 1):
            raise CdrError("its first bytes name no encoding that is read here")
        self.order = "<" if data[1] == 1 else ">"
        self.data = data[4:]
        self.at = 0
        self._fields = fields
        self._wide = wide
        self._strict = strict

    def message(self, msgtype: str) -> Any:
        """Read the whole message."""
        found = self._struct(msgtype, 0)
        left = self.data[self.at :]
        if len(left) > PADDING or any(left):
            raise CdrError(f"{len(left)} bytes are left over")
        return found

    def take(self, size: int) -> bytes:
        """Return the next ``size`` bytes."""
        if size > len(self.data) - self.at:
            raise CdrError("it is shorter than its fields")
        self.at += size
        return self.data[self.at - size : self.at]

    def align(self, size: int) -> None:
        """Skip to the next multiple of ``size``."""
        skipped = -self.at % size
        if self._strict and any(self.data[self.at : self.at + skipped]):
            raise CdrError("there is something between its fields")
        self.at += skipped

    def length(self) -> int:
        """Read the number of elements of a sequence."""
        self.align(4)
        (count,) = struct.unpack(f"{self.order}I", self.take(4))
        return int(count)

    def _struct(self, msgtype: str, depth: int) -> Any:
        if depth > MAX_NESTED:
            raise CdrError("its definition contains itself")
        values = {
            name: self._value(kind, arguments, depth)
            for name, (kind, arguments) in self._fields[msgtype][1]
        }
        return SimpleNamespace(**values)

    def _value(self, kind: int, arguments: Any, depth: int) -> Any:
        if kind == NAME:
            return self._struct(arguments, depth + 1)
        if kind == BASE:
            return self._single(arguments[0])
        (inner, inner_arguments), size = arguments
        count = size if kind == ARRAY else self.length()
        if inner == BASE and inner_arguments[0] in NUMBERS:
            dtype = np.dtype(self.order + NUMBERS[inner_arguments[0]])
            if count:
                self.align(dtype.itemsize)
            raw = self.take(count * dtype.itemsize)
            return np.frombuffer(raw, dtype).astype(dtype.newbyteorder("="))
        if count > len(self.data):
            raise CdrError("it has more elements than bytes")
        return [self._value(inner, inner_arguments, depth) for _ in range(count)]

    def _single(self, base: str) -> Any:
        if base in NUMBERS:
            dtype = np.dtype(self.order + NUMBERS[base])
            self.align(dtype.itemsize)
            return np.frombuffer(self.take(dtype.itemsize), dtype)[0].item()
        count = self.length()
        if base == "wstring":
            return self._wide(self, count)
        text = self.take(count)
        return text[:-1].decode() if text.endswith(b"\0") else text.decode()


def _quads(cursor: _Cursor, count: int) -> str:
    """``count`` letters of four bytes."""
    raw = cursor.take(4 * count)
    return raw.decode("utf-32-le" if cursor.order == "<" else "utf-32-be").removesuffix("\0")


def _pairs(cursor: _Cursor, count: int) -> str:
    """``count`` letters of two bytes."""
    return _bytes(cursor, 2 * count)


def _bytes(cursor: _Cursor, count: int) -> str:
    """``count`` bytes of letters of two bytes."""
    raw = cursor.take(count)
    return raw.decode("utf-16-le" if cursor.order == "<" else "utf-16-be").removesuffix("\0")
