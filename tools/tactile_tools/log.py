"""``tactile log info|recover``: what a log holds, and a whole log out of one that was cut off."""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, DownloadColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from tactile_bus.instant import NS_PER_S
from tactile_bus.log_bytes import Progress as Report
from tactile_bus.log_info import LogInfo, info
from tactile_bus.log_records import Damage, LogError
from tactile_bus.recovery import RecoveryError, RecoveryReport, recover

BAD_ARGUMENT = 2
REFUSED = 3

SHOWN = 10
"""Gaps, silences and damaged places listed for people; --json has them all."""


UNITS = ("B", "kB", "MB", "GB", "TB")

PLAIN_WIDTH = 160
"""Columns of a table that goes into a pipe or a file."""


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add ``log`` to the ``tactile`` command."""
    parser = subparsers.add_parser(
        "log",
        help="inspect and recover MCAP logs",
        description="Inspect MCAP logs, and recover those that were cut off or damaged.",
    )
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    shown = commands.add_parser(
        "info",
        help="channels, rates, losses, gaps, and whether the file is whole",
        description="Read a log from end to end and say what it holds: channels and rates, what "
        "was dropped and where, calibration and software, and whether every byte is readable.",
    )
    shown.add_argument("file", type=Path, metavar="FILE", help="MCAP log")
    shown.add_argument("--json", action="store_true", help="machine-readable, on standard output")
    shown.set_defaults(func=run_info)
    recovered = commands.add_parser(
        "recover",
        help="write a whole log out of one that was cut off or damaged",
        description="Write everything readable of FILE to a new, finished log. FILE is only read.",
    )
    recovered.add_argument("file", type=Path, metavar="FILE", help="MCAP log")
    recovered.add_argument(
        "--out", type=Path, metavar="OUT", help="new log (default: FILE's name with _recovered)"
    )
    recovered.add_argument("--json", action="store_true", help="report as JSON")
    recovered.set_defaults(func=run_recover)


def run_info(options: argparse.Namespace) -> int:
    """Show a log; 0 when it could be read (whole or not), 2 when it is none, 3 when refused."""
    try:
        with _progress("reading") as report:
            found = info(options.file, report)
    except LogError as error:
        return _fail(error)
    if options.json:
        print(json.dumps(_as_json(found), indent=2))
    else:
        _show_info(found)
    return 0


def run_recover(options: argparse.Namespace) -> int:
    """Recover a log; 0 when the new log was written, 2 for a bad argument, 3 when refused."""
    source: Path = options.file
    target: Path = options.out or source.with_name(f"{source.stem}_recovered.mcap")
    if target.exists():
        return _complain(f"{target} exists and is not overwritten: name another with --out")
    try:
        with _progress("recovering") as report:
            result = recover(source, target, report)
    except LogError as error:
        return _fail(error)
    except RecoveryError as error:
        return _complain(str(error), REFUSED)
    if options.json:
        values = dataclasses.asdict(result) | {"source": str(source), "target": str(target)}
        print(json.dumps(values, indent=2))
    else:
        _show_report(result)
    return 0


def _complain(text: str, code: int = BAD_ARGUMENT) -> int:
    print(f"tactile log: {text}", file=sys.stderr)
    return code


def _fail(error: LogError) -> int:
    """Message and exit code for a file that cannot be read."""
    cause = error.__cause__
    if isinstance(cause, FileNotFoundError):
        return _complain(f"{error}; name a file that exists")
    if isinstance(cause, IsADirectoryError):
        return _complain(f"{error}; name one .mcap file in it")
    if isinstance(cause, OSError):
        return _complain(f"{error}; check the file's permissions and the disk", REFUSED)
    return _complain(f"{error}; name a log that tactiled or another MCAP writer made")


@contextmanager
def _progress(what: str) -> Iterator[Report]:
    """A progress bar on a terminal; it goes away when done."""
    console = Console(stderr=True)
    columns = (TextColumn(what), BarColumn(), DownloadColumn(), TimeRemainingColumn())
    with Progress(
        *columns, console=console, transient=True, disable=not console.is_terminal
    ) as bar:
        task = bar.add_task(what)
        yield lambda done, size: bar.update(task, completed=done, total=size)


def _console() -> Console:
    width = None if sys.stdout.isatty() else PLAIN_WIDTH
    return Console(width=width, soft_wrap=True, highlight=False, markup=False)


def _time(wall_ns: int) -> str:
    """UTC time with milliseconds; plain nanoseconds where no calendar goes that far."""
    try:
        moment = datetime.fromtimestamp(wall_ns / NS_PER_S, UTC)
    except (OverflowError, ValueError, OSError):
        return f"{wall_ns} ns"
    return moment.strftime("%Y-%m-%d %H:%M:%S.") + f"{wall_ns // 1_000_000 % 1000:03d}Z"


def _seconds(ns: int) -> str:
    return f"{ns / NS_PER_S:.3f} s"


def _bytes(count: int) -> str:
    if count < 1000:
        return f"{count} B"
    power = min(int(math.log10(count) / 3), 4)
    return f"{count / 1000**power:.1f} {UNITS[power]}"


def _show_info(found: LogInfo) -> None:
    console = _console()
    span = found.span_ns
    state = "whole" if found.whole else "not closed: `tactile log recover` makes it whole"
    if found.closed and found.damage_count:
        state = "closed, but damaged: `tactile log recover` keeps what is readable"
    console.print(f"{found.path}  {_bytes(found.size)}  {state}")
    console.print(f"written by {found.library or 'an unknown writer'}, profile {found.profile!r}")
    if span is not None:
        console.print(
            f"{_time(span[0])} to {_time(span[1])}, {_seconds(span[1] - span[0])}, "
            f"{found.messages} messages"
        )
    table = Table(box=None, pad_edge=False)
    for name in ("channel", "type"):
        table.add_column(name, overflow="fold")
    for name in ("messages", "Hz", "dropped", "longest pause"):
        table.add_column(name, justify="right", no_wrap=True)
    for channel in found.channels:
        table.add_row(
            channel.topic,
            channel.msgtype,
            str(channel.messages),
            f"{channel.rate:.2f}",
            str(channel.missing),
            _seconds(channel.longest_ns),
        )
    console.print(table)
    _show_losses(console, found)
    for name, values in found.metadata.items():
        console.print(f"{name}: " + ", ".join(f"{key} {text}" for key, text in values.items()))
    for name, (media_type, size) in found.attachments.items():
        console.print(f"attached: {name} ({media_type}, {_bytes(size)})")


def _show_losses(console: Console, found: LogInfo) -> None:
    """Gaps, silences, drops and damage, each with its place."""
    for gap in found.gaps[:SHOWN]:
        span = f"{_time(gap.first_ns)} for {_seconds(gap.last_ns - gap.first_ns)}"
        console.print(f"gap: {gap.reason}, {gap.messages} messages, {span} {gap.detail}".rstrip())
    _more(console, "gaps", found.gap_count)
    for channel in found.channels:
        for silence in channel.silences[:SHOWN]:
            length = _seconds(silence.last_ns - silence.first_ns)
            console.print(f"silence: {channel.topic}, {_time(silence.first_ns)} for {length}")
        _more(console, f"silences of {channel.topic}", channel.silence_count)
    for source, counts in found.drops.items():
        text = ", ".join(f"{reason} {count}" for reason, count in sorted(counts.items()))
        console.print(f"drops of {source}: {text}")
    if found.orphans:
        console.print(f"{found.orphans} messages belong to channels that are defined nowhere")
    _show_damages(console, found.damages, found.damage_count)


def _show_damages(console: Console, damages: list[Damage], count: int) -> None:
    for damage in damages[:SHOWN]:
        lost = "an unknown number of" if damage.messages is None else str(damage.messages)
        console.print(
            f"damage: {damage.reason}, {_bytes(damage.length)} at byte {damage.offset}, "
            f"{lost} messages"
        )
    _more(console, "damaged places", count)


def _more(console: Console, what: str, count: int) -> None:
    if count > SHOWN:
        console.print(f"… and {count - SHOWN} more {what}")


def _show_report(result: RecoveryReport) -> None:
    console = _console()
    whole = result.was_closed and not result.damage_count
    if whole:
        console.print(f"{result.source} was whole; {result.target} is a copy")
    console.print(
        f"{result.target}: {result.messages} messages, {result.attachments} attachments, "
        f"{result.metadata} metadata records"
    )
    if result.start_ns is not None and result.end_ns is not None:
        length = _seconds(result.end_ns - result.start_ns)
        console.print(f"{_time(result.start_ns)} to {_time(result.end_ns)}, {length}")
    if result.damage_count:
        text = f"lost: {_bytes(result.bytes_lost)}, {result.messages_lost} messages by the indexes"
        if result.lost_unknown:
            text += f", and those of {result.lost_unknown} places without one"
        console.print(text)
    if result.orphans:
        console.print(f"left out: {result.orphans} messages of channels that are defined nowhere")
    _show_damages(console, result.damages, result.damage_count)


def _as_json(found: LogInfo) -> dict[str, Any]:
    values = dataclasses.asdict(found)
    values["path"] = str(found.path)
    for channel, row in zip(found.channels, values["channels"], strict=True):
        row["rate"] = round(channel.rate, 4)
        for key in [key for key in row if key.startswith("_")]:
            del row[key]
    values |= {"messages": found.messages, "span_ns": found.span_ns, "whole": found.whole}
    return values
