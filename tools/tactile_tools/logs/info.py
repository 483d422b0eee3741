"""``tactile log info``: what a log holds."""

from __future__ import annotations

import argparse
import dataclasses
import json
from typing import Any

from rich.console import Console
from rich.table import Table

from tactile_bus.log_info import LogInfo, info_of
from tactile_bus.log_records import Damage
from tactile_tools.logs.arguments import add_files
from tactile_tools.logs.sources import Series, find_series, siblings
from tactile_tools.logs.terminal import (
    bytes_text,
    clock_text,
    plain_console,
    progress,
    seconds_text,
)

SHOWN = 10
"""Gaps, silences and damaged places listed for people; --json has them all."""

OUTCOME = "outcome"


def fill(parser: argparse.ArgumentParser) -> None:
    """Give ``tactile log info`` its arguments."""
    parser.description = (
        "Read a log from end to end and say what it holds: channels and rates, what "
        "was dropped and where, calibration, outcome and software, and whether every byte is "
        "readable. Files of one log are taken together."
    )
    add_files(parser)
    parser.add_argument("--json", action="store_true", help="machine-readable, on standard output")
    parser.set_defaults(func=run)


def run(options: argparse.Namespace) -> int:
    """Show logs; 0 when they could be read, whole or not."""
    rows = []
    for number, series in enumerate(find_series(options.files)):
        with progress("reading") as report:
            found = info_of(series.paths, report)
        if options.json:
            rows.append(as_json(found))
            continue
        if number:
            print()
        _show(found, series)
    if options.json:
        print(json.dumps(rows[0] if len(rows) == 1 else rows, indent=2))
    return 0


def _show(found: LogInfo, series: Series) -> None:
    console = plain_console()
    span = found.span_ns
    state = "whole" if found.whole else "not closed: `tactile log recover` makes it whole"
    if found.closed and found.damage_count:
        state = "closed, but damaged: `tactile log recover` keeps what is readable"
    files = f" and {found.files - 1} more files" if found.files > 1 else ""
    console.print(f"{found.path}{files}  {bytes_text(found.size)}  {state}")
    console.print(f"written by {found.library or 'an unknown writer'}, profile {found.profile!r}")
    if span is not None:
        console.print(
            f"{clock_text(span[0])} to {clock_text(span[1])}, {seconds_text(span[1] - span[0])}, "
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
            seconds_text(channel.longest_ns),
        )
    console.print(table)
    show_losses(console, found)
    for outcome in found.outcomes:
        console.print(f"outcome: {outcome}")
    for name, values in found.metadata.items():
        console.print(f"{name}: " + ", ".join(f"{key} {text}" for key, text in values.items()))
    for name, (media_type, size) in found.attachments.items():
        console.print(f"attached: {name} ({media_type}, {bytes_text(size)})")
    others = siblings(series)
    if others:
        names = ", ".join(path.name for path in others[:3]) + (" …" if len(others) > 3 else "")
        console.print(f"the same log goes on in {names}: give all of them, or their folder")


def show_losses(console: Console, found: LogInfo) -> None:
    """Gaps, silences, drops and damage, each with its place."""
    for gap in found.gaps[:SHOWN]:
        span = f"{clock_text(gap.first_ns)} for {seconds_text(gap.last_ns - gap.first_ns)}"
        console.print(f"gap: {gap.reason}, {gap.messages} messages, {span} {gap.detail}".rstrip())
    _more(console, "gaps", found.gap_count)
    for channel in found.channels:
        for silence in channel.silences[:SHOWN]:
            length = seconds_text(silence.last_ns - silence.first_ns)
            console.print(f"silence: {channel.topic}, {clock_text(silence.first_ns)} for {length}")
        _more(console, f"silences of {channel.topic}", channel.silence_count)
    for source, counts in found.drops.items():
        text = ", ".join(f"{reason} {count}" for reason, count in sorted(counts.items()))
        console.print(f"drops of {source}: {text}")
    if found.orphans:
        console.print(f"{found.orphans} messages belong to channels that are defined nowhere")
    if found.missing_files:
        numbers = ", ".join(map(str, found.missing_files))
        console.print(f"files of the log that are not here: number {numbers}")
    show_damages(console, found.damages, found.damage_count)


def show_damages(console: Console, damages: list[Damage], count: int) -> None:
    """Damaged places, the first of them one by one."""
    for damage in damages[:SHOWN]:
        lost = "an unknown number of" if damage.messages is None else str(damage.messages)
        console.print(
            f"damage: {damage.reason}, {bytes_text(damage.length)} at byte {damage.offset}, "
            f"{lost} messages"
        )
    _more(console, "damaged places", count)


def _more(console: Console, what: str, count: int) -> None:
    if count > SHOWN:
        console.print(f"… and {count - SHOWN} more {what}")


def as_json(found: LogInfo) -> dict[str, Any]:
    """Everything, for machines."""
    values = dataclasses.asdict(found)
    values["path"] = str(found.path)
    for channel, row in zip(found.channels, values["channels"], strict=True):
        row["rate"] = round(channel.rate, 4)
        for key in [key for key in row if key.startswith("_")]:
            del row[key]
    values |= {"messages": found.messages, "span_ns": found.span_ns, "whole": found.whole}
    return values
