"""Arguments that several log tools share, and their meaning."""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from tactile_core.types import NS_PER_S
from tactile_tools.log.sources import Series, find_series
from tactile_tools.log.stream import Wanted, first_ns, matcher, require_topics
from tactile_tools.log.terminal import ToolError

END_NS = (1 << 64) - 1
"""Later than every log time: log times are unsigned 64-bit numbers."""


@dataclass(frozen=True, slots=True)
class Selection:
    """Selected messages of selected logs. ``start_ns``: log time at which relative times begin."""

    logs: list[Series]
    wanted: Wanted | None
    window: tuple[int, int] | None
    start_ns: int


def select(options: argparse.Namespace) -> Selection:
    """Make a selection of the options of `add_files` and `add_selection`; ToolError, LogError."""
    logs = find_series(options.files)
    require_topics(options.topic, logs)
    start = first_ns(logs)
    window = None
    if options.first_time is not None or options.last_time is not None:
        first = 0 if options.first_time is None else moment("--from", options.first_time, start)
        last = END_NS if options.last_time is None else moment("--until", options.last_time, start)
        if first > last:
            raise ToolError(
                f"the time {options.first_time} is after {options.last_time}: nothing is between"
            )
        window = (first, last)
    return Selection(logs, matcher(options.topic), window, start)


def moment(flag: str, text: str, start_ns: int) -> int:
    """Log time, ns, that ``text`` stands for; ToolError naming ``flag`` when it is not a time."""
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


def check_output(out: Path, force: bool, sources: Sequence[Series] = ()) -> Path:
    """Return ``out``; ToolError when it exists without ``force``, or is one of the sources."""
    if any(out.resolve() == path.resolve() for log in sources for path in log.paths):
        raise ToolError(f"{out} is what is read: name another with --out")
    if out.is_dir():
        raise ToolError(f"{out} is a folder: name a file")
    if out.exists() and not force:
        raise ToolError(f"{out} exists and is not overwritten: name another, or give --force")
    return out
