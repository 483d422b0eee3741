"""Reading what a user wrote for the simulator, with errors that say where, what and what else."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import NoReturn

from tactile_core.toml_text import TomlError, parse, printable, read_text

MAX_SCRIPT = 1 << 20
"""Bytes of a script: real ones have a few kB."""


class ScriptError(ValueError):
    """A script or fault specification that cannot be used; the message is for its author."""


class Table:
    """One table of a TOML script; every value is taken once, with its limits.

    ``where``: file (and line, where known) for messages. `finish` refuses keys never asked for.
    """

    def __init__(
        self, values: Mapping[str, object], where: str, lines: Mapping[str, int] | None = None
    ) -> None:
        self._values = values
        self._where = where
        self._lines = lines or {}
        self._known: set[str] = set()

    def __contains__(self, key: str) -> bool:
        return key in self._values

    def fail(self, key: str, problem: str) -> NoReturn:
        """Raise a `ScriptError` about ``key``."""
        line = self._lines.get(key, self._lines.get("", 0))
        place = f"{self._where}:{line}" if line else self._where
        raise ScriptError(f"{place}: {printable(key)}: {printable(problem, 300)}")

    def take(self, key: str) -> object:
        """Raw value of ``key``; None when absent."""
        self._known.add(key)
        return self._values.get(key)

    def number(
        self,
        key: str,
        default: float | None = None,
        low: float = -math.inf,
        high: float = math.inf,
        above: bool = False,
    ) -> float:
        """Finite number from ``low`` (beyond it if ``above``) to ``high``."""
        value = self.take(key)
        allowed = f"a number {_range(low, high, above)}"
        if value is None:
            if default is None:
                self.fail(key, f"is missing; give {allowed}")
            return default
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            self.fail(key, f"given {value!r}; allowed: {allowed}")
        if not math.isfinite(value) or not low <= value <= high or (above and value == low):
            self.fail(key, f"given {value!r}; allowed: {allowed}")
        return float(value)

    def integer(self, key: str, default: int, low: int, high: int) -> int:
        """Whole number from ``low`` to ``high``."""
        value = self.take(key)
        if value is None:
            return default
        if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
            self.fail(key, f"given {value!r}; allowed: a whole number from {low} to {high}")
        return value

    def vector(
        self, key: str, size: int, bound: float, default: tuple[float, ...] | None = None
    ) -> tuple[float, ...]:
        """List of ``size`` numbers, each at most ``bound`` in size."""
        value = self.take(key)
        allowed = f"a list of {size} numbers from {-bound:g} to {bound:g}"
        if value is None:
            if default is None:
                self.fail(key, f"is missing; give {allowed}")
            return default
        if not isinstance(value, list) or len(value) != size:
            self.fail(key, f"given {value!r}; allowed: {allowed}")
        for item in value:
            if (
                isinstance(item, bool)
                or not isinstance(item, (int, float))
                or not abs(item) <= bound
            ):
                self.fail(key, f"given {value!r}; allowed: {allowed}")
        return tuple(float(item) for item in value)

    def choice(self, key: str, options: tuple[str, ...]) -> str:
        """One of ``options``; required."""
        value = self.take(key)
        allowed = ", ".join(repr(o) for o in options)
        if value is None:
            self.fail(key, f"is missing; give one of {allowed}")
        if not isinstance(value, str) or value not in options:
            self.fail(key, f"given {value!r}; allowed: {allowed}")
        return value

    def finish(self) -> None:
        """Refuse keys that nothing asked for."""
        for key in self._values:
            if key not in self._known:
                self.fail(key, f"is not known; allowed: {', '.join(sorted(self._known))}")


def read_toml(path: Path) -> tuple[dict[str, object], str]:
    """Parsed TOML and its text; ScriptError for what cannot be read or parsed."""
    try:
        text = read_text(path, MAX_SCRIPT)
        return parse(text, str(path)), text
    except TomlError as error:
        raise ScriptError(str(error)) from error


_HEADER = re.compile(r"\s*\[+\s*([A-Za-z0-9_.-]+)\s*\]+")
_KEY = re.compile(r"\s*([A-Za-z0-9_-]+)\s*=")


def key_lines(text: str, header: str) -> list[dict[str, int]]:
    """Line of every key of each table called ``header``, in order; ``""`` is the header's own.

    ``header`` "" is the part above all headers.
    """
    tables: list[dict[str, int]] = [{"": 1}] if header == "" else []
    inside = header == ""
    for number, line in enumerate(text.splitlines(), 1):
        start = _HEADER.match(line)
        if start:
            inside = start[1] == header
            if inside:
                tables.append({"": number})
            continue
        key = _KEY.match(line)
        if inside and key:
            tables[-1].setdefault(key[1], number)
    return tables


def _range(low: float, high: float, above: bool) -> str:
    if low == -math.inf and high == math.inf:
        return "(finite)"
    if high == math.inf:
        return f"above {low:g}" if above else f"of at least {low:g}"
    return f"above {low:g} up to {high:g}" if above else f"from {low:g} to {high:g}"
