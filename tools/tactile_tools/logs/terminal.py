"""What the log tools say: errors with their exit codes, progress, times and sizes."""

from __future__ import annotations

import errno
import math
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime

from rich.console import Console
from rich.progress import BarColumn, DownloadColumn, Progress, TextColumn, TimeRemainingColumn

from tactile_bus.instant import NS_PER_S
from tactile_bus.log_bytes import Progress as Report
from tactile_bus.log_records import LogError

FAULTY, BAD_ARGUMENT, REFUSED = 1, 2, 3
"""Exit codes: the log has faults; an argument cannot be used; the system does not let us."""

UNITS = ("B", "kB", "MB", "GB", "TB")

PLAIN_WIDTH = 160
"""Columns of a table that goes into a pipe or a file."""


class ToolError(Exception):
    """What the user asked for cannot be done; the text names the remedy."""

    def __init__(self, text: str, code: int = BAD_ARGUMENT) -> None:
        super().__init__(text)
        self.code = code


def complain(text: str, code: int = BAD_ARGUMENT) -> int:
    """Say what is wrong; returns the exit code."""
    print(f"tactile log: {text}", file=sys.stderr)
    return code


def fail(error: LogError) -> int:
    """Message and exit code for a file that cannot be read."""
    cause = error.__cause__
    if isinstance(cause, FileNotFoundError):
        return complain(f"{error}; name a file that exists")
    if isinstance(cause, OSError):
        return complain(f"{error}; check the file's permissions and the disk", REFUSED)
    return complain(f"{error}; name a log that tactiled or another MCAP writer made")


def cannot_write(what: object, error: OSError) -> ToolError:
    """`ToolError` for an output that the system refuses, with the remedy."""
    full = error.errno in (errno.ENOSPC, errno.EDQUOT)
    remedy = "make room, or name a place on another disk" if full else "name a place to write to"
    return ToolError(f"cannot write {what}: {error.strerror or error}; {remedy}", REFUSED)


@contextmanager
def progress(what: str) -> Iterator[Report | None]:
    """A progress bar in bytes, on a terminal alone (else None); it goes away when done."""
    if not sys.stderr.isatty():
        yield None
        return
    console = Console(stderr=True)
    columns = (TextColumn(what), BarColumn(), DownloadColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task(what)
        yield lambda done, size: bar.update(task, completed=done, total=size)


def plain_console() -> Console:
    """Standard output; wide where it is no terminal, and texts of a log as they are."""
    width = None if sys.stdout.isatty() else PLAIN_WIDTH
    return Console(width=width, soft_wrap=True, highlight=False, markup=False)


def clock_text(wall_ns: int) -> str:
    """UTC time with milliseconds; plain nanoseconds where no calendar goes that far."""
    try:
        moment = datetime.fromtimestamp(wall_ns / NS_PER_S, UTC)
    except (OverflowError, ValueError, OSError):
        return f"{wall_ns} ns"
    return moment.strftime("%Y-%m-%d %H:%M:%S.") + f"{wall_ns // 1_000_000 % 1000:03d}Z"


def seconds_text(ns: int) -> str:
    """Duration."""
    return f"{ns / NS_PER_S:.3f} s"


def bytes_text(count: int) -> str:
    """Size, in powers of 1000."""
    if count < 1000:
        return f"{count} B"
    power = min(int(math.log10(count) / 3), 4)
    return f"{count / 1000**power:.1f} {UNITS[power]}"
