"""TOML files from anywhere, read in bounded time and memory, and refused in one sentence.

`tomllib` parses; what it leaves to its caller is done here: what is not a plain file, numbers no
program can hold, keys nested beyond any use. Nothing but `TomlError` is raised.
"""

from __future__ import annotations

import os
import re
import stat
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from tactile_core.toml_lines import Path as KeyPath
from tactile_core.toml_lines import key_lines

MAX_DEPTH = 32
"""Tables and arrays within one another; the deepest of our own files have five."""

MAX_PARTS = 256
"""Parts of a dotted key that are worth parsing, which takes time with the square of them."""

INTEGERS = range(-(1 << 63), 1 << 63)
"""What TOML asks of every reader; longer ones Python would take, up to 4300 digits."""

SHOWN = 60
"""Characters that a message quotes."""

TOML_LINE = re.compile(r" \(at line (\d+), column \d+\)$")
LONG_NUMBER = re.compile(r"[0-9_]{1000,}")
_PART = r"(?:(?<![A-Za-z0-9_-])[A-Za-z0-9_-]++|\"[^\"\n]*+\"|'[^'\n]*+')"
# Possessive, and never begun within a word: else a word of a megabyte is read from each letter on.
DEEP_KEY = re.compile(rf"{_PART}(?:[ \t]*+\.[ \t]*+{_PART}){{{MAX_PARTS}}}")

KINDS = (
    (stat.S_ISDIR, "Is a directory"),
    (stat.S_ISFIFO, "it is a pipe, not a file"),
    (lambda _: True, "it is a device, not a file"),
)
"""What is not a plain file, in words."""


class TomlError(Exception):
    """A file that cannot be used; the message names it, and the line where that is known."""


def read_text(path: Path | str, limit: int) -> str:
    """Text of a file of at most ``limit`` bytes. Never waits: a pipe or a device is refused."""
    path = Path(path)
    try:
        fd = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC | os.O_NOCTTY)
    except (OSError, ValueError) as error:  # ValueError: a zero byte in the name
        why = str(error.strerror) if isinstance(error, OSError) else str(error)
        raise TomlError(_unreadable(path, why)) from error
    mode = os.fstat(fd).st_mode
    if not stat.S_ISREG(mode):
        os.close(fd)
        raise TomlError(_unreadable(path, next(name for test, name in KINDS if test(mode))))
    try:
        with os.fdopen(fd, "rb") as file:
            raw = file.read(limit + 1)
    except OSError as error:
        raise TomlError(_unreadable(path, str(error.strerror))) from error
    if len(raw) > limit:
        raise TomlError(f"{path}: over {limit} bytes, too large for a file of this kind")
    try:
        return raw.decode()
    except UnicodeDecodeError as error:
        line = raw.count(b"\n", 0, error.start) + 1
        raise TomlError(f"{path}:{line}: not UTF-8 text; TOML must be") from error


def parse(text: str, source: str) -> dict[str, Any]:
    """Tables of a TOML text; ``source`` names it in messages."""
    deep = DEEP_KEY.search(text)
    if deep is not None:
        raise TomlError(_too_deep(source, text.count("\n", 0, deep.start()) + 1))
    try:
        data = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        message = str(error)
        match = TOML_LINE.search(message)
        line = match.group(1) if match else str(text.count("\n") + 1)
        raise TomlError(f"{source}:{line}: {printable(TOML_LINE.sub('', message), 200)}") from error
    except RecursionError:
        raise TomlError(_too_deep(source, None)) from None
    except ValueError as error:  # of int(), which reads no more than 4300 digits
        number = LONG_NUMBER.search(text)
        if number is None:
            raise TomlError(f"{source}: {printable(str(error), 200)}") from error
        line = str(text.count("\n", 0, number.start()) + 1)
        raise TomlError(f"{source}:{line}: {_too_long(len(number.group()))}") from None
    for keys, value in leaves(data):
        if len(keys) > MAX_DEPTH:
            raise TomlError(_too_deep(source, None))
        if isinstance(value, int) and value not in INTEGERS:
            line = str(line_of(key_lines(text), keys))
            digits = max(20, value.bit_length() * 3 // 10)
            raise TomlError(f"{source}:{line}: {dotted(keys)} is {_too_long(digits)}")
    return data


def leaves(data: Any) -> Iterator[tuple[KeyPath, Any]]:
    """Every value that is not a table or an array, with its path, in the order of the file.

    Of what is nested too deeply, the first thing too deep.
    """
    waiting: list[tuple[KeyPath, Any]] = [((), data)]
    while waiting:
        keys, value = waiting.pop()
        if len(keys) <= MAX_DEPTH and isinstance(value, dict):
            waiting += [((*keys, key), value[key]) for key in reversed(value)]
        elif len(keys) <= MAX_DEPTH and isinstance(value, list):
            waiting += [((*keys, at), value[at]) for at in reversed(range(len(value)))]
        else:
            yield keys, value


def line_of(lines: dict[KeyPath, int], keys: KeyPath) -> int:
    """Line of a key, or of the nearest thing around it."""
    while keys and keys not in lines:
        keys = keys[:-1]
    return lines.get(keys, 1)


def dotted(keys: KeyPath) -> str:
    """A path of keys as people write it."""
    text = ""
    for key in keys:
        shown = printable(str(key))
        text += f"[{key}]" if isinstance(key, int) else f".{shown}" if text else shown
    return text


def printable(text: str, limit: int = SHOWN) -> str:
    """A text for a message: what a terminal would act on is escaped, and the rest kept short."""
    if len(text) > limit:
        text = text[: limit - 3] + "..."
    return "".join(
        c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in text
    )


def _unreadable(path: Path, why: str) -> str:
    return f"{printable(str(path), 200)}: cannot be read ({why}); name a TOML file that can"


def _too_long(digits: int) -> str:
    return (
        f"a whole number of about {digits} digits; allowed: finite numbers, whole ones of at most "
        "64 bits"
    )


def _too_deep(source: str, line: int | None) -> str:
    where = source if line is None else f"{source}:{line}"
    return f"{where}: nested too deeply; allowed: {MAX_DEPTH} tables and arrays in one another"
