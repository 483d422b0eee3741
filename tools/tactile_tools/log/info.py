"""``tactile log info``: say what a log holds."""

from __future__ import annotations

import argparse
import dataclasses
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table
from rich.text import Text

from tactile_core.cli import progress
from tactile_core.log.info import AttachmentInfo, LogInfo, info_of
from tactile_core.log.reader import LogReader
from tactile_core.log.records import Damage
from tactile_tools.log.sources import Series, find_series, siblings
from tactile_tools.log.terminal import (
    bytes_text,
    clock_text,
    complain,
    plain_console,
    seconds_text,
    shown,
)

SHOWN = 10
"""Gaps, silences and damaged places that are printed; --json prints all."""

TEXT_SHOWN = 400
"""Letters of a text in a table that are printed; --json prints all."""

FEW = 200
"""With more channels than these they are printed without a table: laying one out takes long."""


def run(options: argparse.Namespace) -> int:
    """Print what logs hold. Returns 0 if they could be read, complete or not."""
    rows = []
    for number, series in enumerate(find_series(options.files)):
        quick = _quick(series) if options.quick else None
        if quick is not None:
            rows.append(dataclasses.asdict(quick))
            if not options.json:
                _show_quick(quick, series)
            continue
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
    _show_channels(console, found)
    show_losses(console, found)
    for outcome in found.outcomes:
        console.print(f"outcome: {outcome}")
    for table in found.tables:
        pairs = (f"{key} {shown(text, TEXT_SHOWN)}" for key, text in table.values.items())
        console.print(shown(f"{table.name}: " + ", ".join(pairs), 10 * TEXT_SHOWN))
    listed = len(found.tables) + found.gap_count
    if found.table_count > listed:
        console.print(f"… and {found.table_count - listed} more tables")
    _show_attachments(console, found.files_within, found.attachment_count)
    others = siblings(series)
    if others:
        names = ", ".join(path.name for path in others[:3]) + (" …" if len(others) > 3 else "")
        console.print(f"the same log goes on in {names}: give all of them, or their folder")


def _show_channels(console: Console, found: LogInfo) -> None:
    """Print one line per channel; without alignment where there are very many."""
    rows = [
        (
            shown(channel.topic, TEXT_SHOWN),
            shown(channel.msgtype, TEXT_SHOWN),
            str(channel.messages),
            f"{channel.rate:.2f}",
            str(channel.missing),
            seconds_text(channel.longest_ns),
        )
        for channel in found.channels
    ]
    names = ("channel", "type", "messages", "Hz", "dropped", "longest pause")
    if len(rows) > FEW:
        for row in (names, *rows):
            console.out("  ".join(row), highlight=False)
        return
    table = Table(box=None, pad_edge=False)
    for name in names[:2]:
        table.add_column(name, overflow="fold")
    for name in names[2:]:
        table.add_column(name, justify="right", no_wrap=True)
    for row in rows:
        table.add_row(*map(Text, row))
    console.print(table)


def _show_attachments(console: Console, attached: list[AttachmentInfo], count: int) -> None:
    for each in attached:
        name, kind = shown(each.name, TEXT_SHOWN), shown(each.media_type, TEXT_SHOWN)
        console.print(f"attached: {name} ({kind}, {bytes_text(each.size)})")
    if count > len(attached):
        console.print(f"… and {count - len(attached)} more attachments")


@dataclass(slots=True)
class QuickInfo:
    """What the summaries say of a log. ``channels``: topic, type and number of messages of each."""

    path: str
    files: int
    size: int = 0
    quick: bool = True
    messages: int = 0
    span_ns: tuple[int, int] | None = None
    channels: list[dict[str, Any]] = field(default_factory=list)
    files_within: list[AttachmentInfo] = field(default_factory=list)
    tables: list[str] = field(default_factory=list)


def _quick(series: Series) -> QuickInfo | None:
    """Read the summaries of a log's files; None, with a note, if one is missing or incomplete."""
    found = QuickInfo(str(series.paths[0]), len(series.paths))
    counts: dict[tuple[str, str], int] = {}
    for path in series.paths:
        if not _take_summary(found, counts, path):
            complain(f"{path} has no summary that counts its messages: read from end to end")
            return None
    found.channels = [
        {"topic": topic, "msgtype": msgtype, "messages": count}
        for (topic, msgtype), count in sorted(counts.items())
    ]
    return found


def _take_summary(found: QuickInfo, counts: dict[tuple[str, str], int], path: Path) -> bool:
    with LogReader(path) as reader:
        summary = reader.summarize()
        if summary is None or summary.statistics is None or not summary.knows_all_channels:
            return False
        statistics = summary.statistics
        if sum(statistics.channel_message_counts.values()) != statistics.message_count:
            return False
        if (len(summary.attachments), len(summary.metadata)) != (
            statistics.attachment_count,
            statistics.metadata_count,
        ):
            return False
        found.size += reader.size
        for channel in reader.channels.values():
            schema = reader.schemas.get(channel.schema)
            key = channel.topic, schema.name if schema else ""
            number = statistics.channel_message_counts.get(channel.number, 0)
            counts[key] = counts.get(key, 0) + number
    found.messages += statistics.message_count
    if statistics.message_count:
        first, last = statistics.message_start_time, statistics.message_end_time
        before = found.span_ns or (first, last)
        found.span_ns = min(before[0], first), max(before[1], last)
    found.files_within += [
        AttachmentInfo(each.name, each.media_type, each.data_size) for each in summary.attachments
    ]
    found.tables += [each.name for each in summary.metadata]
    return True


def _show_quick(found: QuickInfo, series: Series) -> None:
    console = plain_console()
    console.print(f"{series.name}  {bytes_text(found.size)}  by its summary, unchecked")
    if found.span_ns is not None:
        first, last = found.span_ns
        console.print(
            f"{clock_text(first)} to {clock_text(last)}, {seconds_text(last - first)}, "
            f"{found.messages} messages"
        )
    for row in found.channels:
        topic, msgtype = shown(row["topic"], TEXT_SHOWN), shown(row["msgtype"], TEXT_SHOWN)
        console.print(f"{topic}  {msgtype}  messages: {row['messages']}")
    for name in found.tables:
        console.print(f"table: {shown(name, TEXT_SHOWN)}")
    _show_attachments(console, found.files_within, len(found.files_within))


def show_losses(console: Console, found: LogInfo) -> None:
    """Print gaps, silences, drops and damage, each with its place."""
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
    if found.one_counter:
        console.print(
            "one counter numbers the messages of all channels"
            + (f": {found.numbers_missing} numbers are missing" if found.numbers_missing else "")
        )
    if found.orphans:
        console.print(f"{found.orphans} messages belong to channels that are defined nowhere")
    if found.missing_files:
        numbers = ", ".join(map(str, found.missing_files))
        console.print(f"files of the log that are not here: number {numbers}")
    show_damages(console, found.damages, found.damage_count)


def show_damages(console: Console, damages: list[Damage], count: int) -> None:
    """Print damaged places, the first ones singly."""
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
    """Return everything for --json."""
    values = dataclasses.asdict(found)
    values["path"] = str(found.path)
    for channel, row in zip(found.channels, values["channels"], strict=True):
        row["rate"] = round(channel.rate, 4)
        for key in [key for key in row if key.startswith("_")]:
            del row[key]
    values |= {"messages": found.messages, "span_ns": found.span_ns, "whole": found.whole}
    return values
