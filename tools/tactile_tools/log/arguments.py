"""Arguments that several log tools take, and what they mean."""

from __future__ import annotations

import argparse
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from tactile_core.types import NS_PER_S
from tactile_tools.log.sources import Series, find_series
from tactile_tools.log.stream import Wanted, first_ns, matcher, require_topics
from tactile_tools.log.terminal import ToolError

END_NS = (1 << 64) - 1
"""Later than anything: log times are unsigned 64-bit numbers."""

SIZE = re.compile(r"(\d+(?:\.\d+)?)\s*([kMG]i?)?B?", re.IGNORECASE)
POWERS = {"": 1, "k": 10**3, "m": 10**6, "g": 10**9, "ki": 1 << 10, "mi": 1 << 20, "gi": 1 << 30}


@dataclass(frozen=True, slots=True)
class Selection:
    """What of which logs. ``start_ns``: log time that relative times are counted from."""

    logs: list[Series]
    wanted: Wanted | None
    window: tuple[int, int] | None
    start_ns: int


def add_files(parser: argparse.ArgumentParser) -> None:
    """Add the files: a log may be several."""
    parser.add_argument(
        "files",
        nargs="+",
        type=Path,
        metavar="FILE",
        help="MCAP log, a folder of them, or what the names of the files of one log share",
    )


def add_selection(parser: argparse.ArgumentParser, until: str = "--to") -> None:
    """Add --topic, --from and --to (``until`` where that means something else)."""
    parser.add_argument(
        "--topic",
        action="append",
        metavar="PATTERN",
        help="only these, with * and ? (quote them); may be repeated",
    )
    for name, which in (("--from", "first"), (until, "last")):
        parser.add_argument(
            name,
            dest=f"{which}_time",
            metavar="TIME",
            help=f"{which} log time: s since the start of the log, or UTC as 2026-01-31T12:00:00",
        )


def select(options: argparse.Namespace) -> Selection:
    """What the options of `add_files` and `add_selection` mean; ToolError, LogError."""
    logs = find_series(options.files)
    require_topics(options.topic, logs)
    start = first_ns(logs)
    window = None
    if options.first_time is not None or options.last_time is not None:
        first = 0 if options.first_time is None else moment("--from", options.first_time, start)
        last = END_NS if options.last_time is None else moment("end", options.last_time, start)
        if first > last:
            raise ToolError(
                f"the time {options.first_time} is after {options.last_time}: nothing is between"
            )
        window = (first, last)
    return Selection(logs, matcher(options.topic), window, start)


def moment(flag: str, text: str, start_ns: int) -> int:
    """Log time in ns that ``text`` stands for; ToolError when it is none."""
    try:
        seconds = float(text)
    except ValueError:
        seconds = math.nan
    if math.isfinite(seconds) and abs(seconds) < 1e10:
        return min(max(0, start_ns + round(seconds * NS_PER_S)), END_NS)
    try:
        when = datetime.fromisoformat(text)
    except ValueError:
        raise ToolError(
            f"{flag} {text}; allowed: seconds since the start of the log, or a time such as "
            "2026-01-31T12:00:00.5 (UTC)"
        ) from None
    when = when.replace(tzinfo=UTC) if when.tzinfo is None else when
    whole = when.replace(microsecond=0)
    return max(0, int(whole.timestamp()) * NS_PER_S + when.microsecond * 1000)


def size_bytes(text: str) -> int:
    """Bytes of a size such as 500MB, 1.5GiB or 4096; argparse's error when it is none."""
    match = SIZE.fullmatch(text.strip())
    if match is not None:
        size = float(match[1]) * POWERS[(match[2] or "").lower()]
        if 1 <= size < 1 << 60:
            return int(size)
    raise argparse.ArgumentTypeError(f"{text} given; allowed: a size such as 500MB or 2GiB")


def add_output(parser: argparse.ArgumentParser, what: str, *, required: bool = False) -> None:
    """Add --out and --force."""
    parser.add_argument("--out", type=Path, metavar="OUT", help=what, required=required)
    parser.add_argument("--force", action="store_true", help="overwrite what is there")


def check_output(out: Path, force: bool, sources: Sequence[Series] = ()) -> Path:
    """``out``, to be written; ToolError when it is there already or is one of the sources."""
    if any(out.resolve() == path.resolve() for log in sources for path in log.paths):
        raise ToolError(f"{out} is what is read: name another with --out")
    if out.is_dir():
        raise ToolError(f"{out} is a folder: name a file")
    if out.exists() and not force:
        raise ToolError(f"{out} exists and is not overwritten: name another, or give --force")
    return out
