"""Output of the log tools: errors with exit status, progress, times and sizes."""

from __future__ import annotations

import errno
import json
import math
import re
import sys
from datetime import UTC, datetime
from typing import Any

from rich.console import Console
from rich.text import Text

from tactile_core.cli import CommandError
from tactile_core.log.records import LogError
from tactile_core.types import NS_PER_S

FAULTY, BAD_ARGUMENT, REFUSED = 1, 2, 3
"""Exit status: the log has faults; an argument cannot be used; the system refused."""

UNITS = ("B", "kB", "MB", "GB", "TB")

PLAIN_WIDTH = 160
"""Width of a table that goes to a pipe or a file."""


class ToolError(CommandError):
    """The tool cannot do what the user asked of a log."""


def shown(text: object, limit: int | None = None) -> str:
    """Make a text from an untrusted source safe to print on one line.

    Control and format characters (which move the cursor, change colours or reverse the direction of
    writing) become escapes such as ``\x1b``. ``limit``: letters after which the text is cut, with a
    mark.
    """
    text = str(text)
    rest = 0 if limit is None else len(text) - limit
    if rest > 0:
        text = text[:limit]
    if not text.isprintable():
        text = "".join(c if c.isprintable() else _escape(c) for c in text)
    return f"{text}… ({rest} more letters)" if rest > 0 else text


def _escape(letter: str) -> str:
    return letter.encode("unicode_escape", "backslashreplace").decode()


NOT_IN_JSON = re.compile("[\x7f-\uffff]|[\U00010000-\U0010ffff]")


def json_text(value: Any, **options: Any) -> str:
    """JSON with letters kept as they are, except those that a terminal takes for a command."""
    text = json.dumps(value, ensure_ascii=False, allow_nan=False, **options)
    if text.isascii() and "\x7f" not in text:
        return text
    return NOT_IN_JSON.sub(lambda m: m[0] if m[0].isprintable() else json.dumps(m[0])[1:-1], text)


def complain(text: str, code: int = BAD_ARGUMENT) -> int:
    """Print what is wrong to stderr; returns the exit status."""
    print(f"tactile log: {shown(text)}", file=sys.stderr)
    return code


def fail(error: LogError) -> int:
    """Print the error of a file that cannot be read; returns the exit status."""
    cause = error.__cause__
    if isinstance(cause, FileNotFoundError):
        return complain(f"{error}; name a file that exists")
    if isinstance(cause, OSError):
        return complain(f"{error}; check the file's permissions and the disk", REFUSED)
    return complain(f"{error}; name a log that tactiled or another MCAP writer made")


def cannot_write(what: object, error: OSError) -> ToolError:
    """Make a `ToolError` for an output that the system refuses, with the remedy."""
    if error.errno == errno.EMFILE:
        remedy = "take fewer topics at a time with --topic"
        return ToolError(f"cannot write {what}: {error.strerror}; {remedy}", REFUSED)
    full = error.errno in (errno.ENOSPC, errno.EDQUOT)
    remedy = "make room, or name a place on another disk" if full else "name a place to write to"
    return ToolError(f"cannot write {what}: {error.strerror or error}; {remedy}", REFUSED)


class PlainConsole(Console):
    """Prints each text on one line without markup or emoji, escapes made visible."""

    def print(self, *objects: Any, **options: Any) -> None:
        """Print; texts may come from a log."""
        safe = (Text(shown(each)) if isinstance(each, str) else each for each in objects)
        super().print(*safe, **options)


def plain_console() -> Console:
    """Console on standard output: wide unless it is a terminal, and safe for texts of a log."""
    width = None if sys.stdout.isatty() else PLAIN_WIDTH
    return PlainConsole(width=width, soft_wrap=True, highlight=False, markup=False, emoji=False)


def clock_text(wall_ns: int) -> str:
    """UTC time with milliseconds; plain nanoseconds beyond the range of the calendar."""
    try:
        moment = datetime.fromtimestamp(wall_ns / NS_PER_S, UTC)
    except (OverflowError, ValueError, OSError):
        return f"{wall_ns} ns"
    return moment.strftime("%Y-%m-%d %H:%M:%S.") + f"{wall_ns // 1_000_000 % 1000:03d}Z"


def seconds_text(ns: int) -> str:
    """Format a duration."""
    return f"{ns / NS_PER_S:.3f} s"


def bytes_text(count: int) -> str:
    """Format a size, in powers of 1000."""
    if count < 1000:
        return f"{count} B"
    power = min(int(math.log10(count) / 3), 4)
    return f"{count / 1000**power:.1f} {UNITS[power]}"
