"""``tactile log recover``: make a complete log of one that was cut off or damaged."""

from __future__ import annotations

import argparse
import dataclasses
import json

from tactile_core.cli import progress
from tactile_core.log.recovery import RecoveryError, RecoveryReport, recover
from tactile_tools.log.arguments import check_output
from tactile_tools.log.info import show_damages
from tactile_tools.log.sources import Series, find_series
from tactile_tools.log.terminal import (
    REFUSED,
    ToolError,
    bytes_text,
    clock_text,
    plain_console,
    seconds_text,
)


def run(options: argparse.Namespace) -> int:
    """Recover logs. Returns 0 if each was written."""
    sources = [path for series in find_series(options.files) for path in series.paths]
    if options.out is not None and len(sources) > 1:
        raise ToolError(f"--out names one file, but {len(sources)} are to be recovered")
    rows = []
    for source in sources:
        target = options.out or source.with_name(f"{source.stem}_recovered.mcap")
        check_output(target, options.force, [Series((source,))])
        part = target.with_name(f".{target.name}.part")
        try:
            part.unlink(missing_ok=True)
            with progress("recovering") as report:
                result = recover(source, part, report, keep_suspect=options.keep_suspect)
            part.replace(target)
        except OSError as error:
            raise ToolError(
                f"cannot write {target}: {error.strerror}; name a place with room to write to",
                REFUSED,
            ) from error
        except RecoveryError as error:
            raise ToolError(str(error).replace(str(part), str(target)), REFUSED) from error
        result.target = target
        rows.append(dataclasses.asdict(result) | {"source": str(source), "target": str(target)})
        if not options.json:
            _show(result)
    if options.json:
        print(json.dumps(rows[0] if len(rows) == 1 else rows, indent=2))
    return 0


def _show(result: RecoveryReport) -> None:
    console = plain_console()
    whole = result.was_closed and not result.damage_count
    if whole:
        console.print(f"{result.source} was whole; {result.target} is a copy")
    console.print(
        f"{result.target}: {result.messages} messages, {result.attachments} attachments, "
        f"{result.metadata} metadata records"
    )
    if result.start_ns is not None and result.end_ns is not None:
        length = seconds_text(result.end_ns - result.start_ns)
        console.print(f"{clock_text(result.start_ns)} to {clock_text(result.end_ns)}, {length}")
    if result.damage_count:
        text = (
            f"lost: {bytes_text(result.bytes_lost)}, {result.messages_lost} messages by the indexes"
        )
        if result.lost_unknown:
            text += f", and those of {result.lost_unknown} places without one"
        console.print(text)
    if result.suspect:
        console.print(f"{result.suspect} messages are kept of blocks whose checksum is wrong")
    if result.orphans:
        console.print(f"left out: {result.orphans} messages of channels that are defined nowhere")
    show_damages(console, result.damages, result.damage_count)
