"""One table of a calibration file: written as exact decimals, read with every value checked."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from tactile_core.calibration.types import CalibrationError
from tactile_core.toml_text import printable

Float = NDArray[np.float64]


def matrix_lines(key: str, values: Float, remark: str) -> Iterable[str]:
    """Lines of a list of rows."""
    yield f"{key} = [  # {remark}"
    for row in values:
        yield f"  [{numbers(row)}],"
    yield "]"


def numbers(values: Float) -> str:
    """Exact decimals of a row, without brackets."""
    return ", ".join(number(v) for v in values.tolist())


def number(value: float) -> str:
    """Shortest exact decimal."""
    return repr(float(value))


def quoted(value: str) -> str:
    """Quoted, escaped text."""
    escaped = "".join(
        f"\\u{ord(c):04x}" if c in '"\\' or ord(c) < 32 or ord(c) == 127 else c for c in value
    )
    return f'"{escaped}"'


class Table:
    """One TOML table being read: every refusal names file, key, what was given and allowed."""

    def __init__(self, source: str, prefix: str, values: object) -> None:
        if not isinstance(values, Mapping):
            raise CalibrationError(f"{source}: {prefix.rstrip('.')} must be a table")
        self._source, self._prefix, self._values = source, prefix, dict(values)

    def wrong(self, key: str, given: object, allowed: str) -> CalibrationError:
        """What to raise for ``key``."""
        shown = repr(given) if not isinstance(given, str) or not given else given
        shown = printable(shown, 80)
        return CalibrationError(
            f"{self._source}: {self._prefix}{key} is {shown}; allowed: {allowed}"
        )

    def take(self, key: str) -> object:
        """Value of ``key``, which must be there."""
        if key not in self._values:
            raise CalibrationError(f"{self._source}: {self._prefix}{key} is missing")
        return self._values.pop(key)

    def done(self) -> None:
        """Refuse keys that nobody took."""
        if self._values:
            unknown = printable(", ".join(f"{self._prefix}{key}" for key in self._values), 200)
            raise CalibrationError(
                f"{self._source}: unknown key {unknown}; no calibration file has one of that name"
            )

    def text(self, key: str) -> str:
        """A text that is not empty."""
        value = self.take(key)
        if not isinstance(value, str) or not value:
            raise self.wrong(key, value, "a text that is not empty")
        return value

    def word(self, key: str) -> str:
        """A text that is not empty and can be shown: messages name boards by such."""
        value = self.text(key)
        if not value.isprintable():
            raise self.wrong(key, value, "printable characters")
        return value

    def integer(self, key: str, low: int, high: int) -> int:
        """A whole number from ``low`` to ``high``."""
        value = self.take(key)
        if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
            raise self.wrong(key, value, f"a whole number from {low} to {high}")
        return value

    def number(self, key: str) -> float:
        """A finite number."""
        return self._finite(key, self.take(key))

    def vector(self, key: str, length: int) -> Float:
        """(length,) finite numbers."""
        return self._row(key, self.take(key), length)

    def matrix(self, key: str, rows: int, columns: int) -> Float:
        """(rows, columns) finite numbers."""
        value = self.take(key)
        if not isinstance(value, list) or len(value) != rows:
            given = f"{len(value)} rows" if isinstance(value, list) else repr(value)
            raise self.wrong(key, given, f"{rows} rows of {columns} numbers")
        out = [self._row(f"{key}[{i}]", row, columns) for i, row in enumerate(value)]
        return np.array(out).reshape(rows, columns)

    def table(self, key: str) -> Table:
        """The table within this one."""
        return Table(self._source, f"{self._prefix}{key}.", self.take(key))

    def coupling(self, key: str, taxels: int) -> Iterable[tuple[str, int, int, Float]]:
        """Place in the file, two taxels and their (3, 3) block, for each row."""
        value = self.take(key)
        if not isinstance(value, list):
            raise self.wrong(key, value, "a list of [taxel, taxel, 9 numbers]")
        for k, row in enumerate(value):
            at = f"{key}[{k}]"
            if not isinstance(row, list) or len(row) != 11:
                raise self.wrong(at, row, "[taxel, taxel, 9 numbers]")
            i, j = row[:2]
            for index in (i, j):
                if type(index) is not int or not 0 <= index < taxels:
                    raise self.wrong(at, index, f"taxels from 0 to {taxels - 1}")
            yield at, i, j, self._row(at, row[2:], 9).reshape(3, 3)

    def _row(self, key: str, value: object, length: int) -> Float:
        if not isinstance(value, Sequence) or isinstance(value, str) or len(value) != length:
            given = f"{len(value)} numbers" if isinstance(value, list) else repr(value)
            raise self.wrong(key, given, f"{length} numbers")
        return np.array([self._finite(key, v) for v in value])

    def _finite(self, key: str, value: object) -> float:
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise self.wrong(key, value, "a number")
        try:
            number = float(value)
        except OverflowError:
            number = math.inf
        if not math.isfinite(number):
            raise self.wrong(key, value, "a finite number")
        return number

    def has(self, key: str) -> bool:
        """Whether ``key`` is there and has not been taken."""
        return key in self._values

    def rows(self, key: str, columns: int, limit: int) -> Float:
        """(rows, columns) finite numbers, 0 to ``limit`` rows."""
        value = self._values.get(key)
        if not isinstance(value, list) or len(value) > limit:
            raise self.wrong(key, self.take(key), f"a list of at most {limit} rows")
        return self.matrix(key, len(value), columns)

    def numbers(self, key: str, limit: int) -> Float:
        """(n,) finite numbers, 0 to ``limit`` of them."""
        value = self._values.get(key)
        if not isinstance(value, list) or len(value) > limit:
            raise self.wrong(key, self.take(key), f"a list of at most {limit} numbers")
        return self.vector(key, len(value))

    def tables(self, key: str, limit: int) -> list[Table]:
        """Tables ``[[key]]`` within this one, 1 to ``limit`` of them."""
        value = self.take(key)
        if not isinstance(value, list) or not 1 <= len(value) <= limit:
            raise self.wrong(key, value, f"1 to {limit} tables [[{self._prefix}{key}]]")
        return [
            Table(self._source, f"{self._prefix}{key}[{i}].", each) for i, each in enumerate(value)
        ]

    def boolean(self, key: str) -> bool:
        """True or false."""
        value = self.take(key)
        if not isinstance(value, bool):
            raise self.wrong(key, value, "true or false")
        return value

    def unfit(self, problem: str) -> CalibrationError:
        """What to raise when values of this table do not fit together."""
        return CalibrationError(f"{self._source}: {self._prefix.rstrip('.')}: {problem}")
