"""``tactile log export``: write the messages of a log as tables for other programs."""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import resource
import shutil
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tactile_core.bus.messages import DecodeError
from tactile_core.bus.topics import RAW, find_topic
from tactile_core.cli import progress, require
from tactile_tools.log.arguments import Selection, select
from tactile_tools.log.batches import REFUSED
from tactile_tools.log.sources import find_series
from tactile_tools.log.stream import Reading, Record, Stream, read_merged
from tactile_tools.log.terminal import (
    FAULTY,
    ToolError,
    bytes_text,
    cannot_write,
    complain,
    plain_console,
)

if TYPE_CHECKING:
    from tactile_tools.log.batches import Table
    from tactile_tools.log.columns import Column
    from tactile_tools.log.decode import Decoder

FORMATS = ("csv", "parquet", "npz", "lerobot")

MAX_FILES = 65_536

CONTENTS = "columns.json"
"""File that describes the columns of every table, with units from the definitions. It marks a
folder as made by this tool, which --force may overwrite."""


def run(options: argparse.Namespace) -> int:
    """Export.

    Returns 0 if every message was written, 1 if some were lost or could not be decoded.
    """
    if options.format == "lerobot":
        return _lerobot(options)
    if options.format != "npz":
        require("pyarrow", extra="export")
    chosen = select(options)
    left_out: set[str] = set()
    if chosen.wanted is None:
        chosen = replace(chosen, wanted=partial(_is_exported, left_out))
    _raise_file_limit()
    source = chosen.logs[0].paths[0]
    out: Path = options.out or source.with_name(f"{source.stem}_{options.format}")
    _check_folder(out, options.force)
    part = out.with_name(f".{out.name}.{os.getpid()}.part")
    try:
        shutil.rmtree(part, ignore_errors=True)
        part.mkdir()
        result = _export(chosen, options.format, part)
        if out.exists():
            shutil.rmtree(out)
        part.replace(out)
    except OSError as error:
        raise cannot_write(out, error) from error
    finally:
        with contextlib.suppress(OSError):
            shutil.rmtree(part)
    return _report(result, out, left_out)


def _lerobot(options: argparse.Namespace) -> int:
    from tactile_tools.log import lerobot

    if options.topic or options.first_time is not None or options.last_time is not None:
        raise ToolError(
            "--to lerobot takes whole logs: cut them first (tactile log split), and leave --topic, "
            "--from and --until out"
        )
    logs = find_series(options.files)
    source = logs[0].paths[0]
    out = options.out or source.with_name(f"{source.stem}_lerobot")
    return lerobot.run(logs, out, fps=options.fps, task=options.task, force=options.force)


def _is_exported(left_out: set[str], topic: str) -> bool:
    """Return whether a topic is to be exported; topics of boards' raw bytes go to ``left_out``."""
    found = find_topic(topic)
    if found is None or found[0] != RAW:
        return True
    left_out.add(topic)
    return False


def _raise_file_limit() -> None:
    """Raise our limit of open files as far as the system allows: there is one file per topic."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    most = MAX_FILES if hard == resource.RLIM_INFINITY else min(hard, MAX_FILES)
    if soft != resource.RLIM_INFINITY and soft < most:
        with contextlib.suppress(ValueError, OSError):
            resource.setrlimit(resource.RLIMIT_NOFILE, (most, hard))


def _check_folder(out: Path, force: bool) -> None:
    if not out.exists():
        return
    if not out.is_dir():
        raise ToolError(f"{out} is a file: name a folder with --out")
    if not any(out.iterdir()):
        return
    if not (out / CONTENTS).exists():
        raise ToolError(f"{out} is there already and no export: name another folder with --out")
    if not force:
        raise ToolError(f"{out} exists and is not overwritten: name another, or give --force")


class _Export:
    """Tables by stream, each made with the first message of the stream."""

    def __init__(self, folder: Path, kind: str, start_ns: int, decoder: Decoder) -> None:
        self.folder = folder
        self.tables: dict[Stream, Table] = {}
        self.refused: dict[str, str] = {}
        self.undecoded: dict[str, int] = {}
        self.decoder = decoder
        self.reading = Reading()
        from tactile_tools.log.batches import Budget
        from tactile_tools.log.columns import FileNames

        self._kind = kind
        self._start_ns = start_ns
        self._files = FileNames(f".{kind}")
        self._budget = Budget()

    @property
    def names(self) -> dict[Stream, str]:
        """File names by stream."""
        return self._files.names

    def take(self, record: Record) -> None:
        """Write one message."""
        stream = record.stream
        table = self.tables.get(stream)
        if table is None:
            if self.decode(stream, record.data) is REFUSED:
                return  # only a stream that can be read gets a table
            table = self.tables[stream] = self._make(stream)
        table.add(record)
        if self._budget.spent:
            for each in self.tables.values():
                each.flush()

    def decode(self, stream: Stream, data: bytes) -> Any:
        """Decode a message; `REFUSED`, and counted, where that is not possible."""
        try:
            return self.decoder.decode(stream, data)
        except DecodeError as error:
            self.refused.setdefault(stream.topic, str(error))
            self.undecoded[stream.topic] = self.undecoded.get(stream.topic, 0) + 1
            return REFUSED

    def columns(self, stream: Stream) -> list[Column]:
        """Columns of the table of a stream."""
        from tactile_tools.log.columns import plan

        return plan(stream, self.decoder.reader(stream))

    def close(self) -> None:
        """Finish all tables, and write the description of their columns."""
        for table in self.tables.values():
            table.flush()  # before the first of them is closed, which takes memory too
        contents = []
        for stream, table in self.tables.items():
            columns = table.close()
            contents.append(
                {
                    "file": self.names[stream],
                    "topic": stream.topic,
                    "type": stream.msgtype,
                    "rows": table.rows,
                    "columns": columns,
                }
            )
        text = json.dumps(contents, indent=1, ensure_ascii=False)
        (self.folder / CONTENTS).write_text(text + "\n", encoding="utf-8")

    def _make(self, stream: Stream) -> Table:
        decode = partial(self.decode, stream)
        path, columns = self.folder / self._files.add(stream), self.columns(stream)
        if self._kind == "npz":
            from tactile_tools.log.npz import NpzTable

            scratch = path.with_suffix(".parts")
            return NpzTable(path, columns, self._start_ns, scratch, decode, self._budget)
        from tactile_tools.log.tables import ArrowTable

        return ArrowTable(path, stream, columns, self._start_ns, self._kind, decode, self._budget)


def _export(chosen: Selection, kind: str, folder: Path) -> _Export:
    from tactile_tools.log.decode import Decoder

    result = _Export(folder, kind, chosen.start_ns, Decoder())
    with progress("exporting") as report:
        for _, item in read_merged(
            chosen.logs, result.reading, report, chosen.wanted, chosen.window
        ):
            if isinstance(item, Record):
                result.take(item)
    result.close()
    return result


def _report(result: _Export, out: Path, left_out: set[str]) -> int:
    console = plain_console()
    for stream, table in result.tables.items():
        size = bytes_text((out / result.names[stream]).stat().st_size)
        console.print(f"{out / result.names[stream]}: {table.rows} messages, {size}")
    if not result.tables:
        console.print(f"{out}: no message in what was asked for")
    for topic in sorted(left_out):
        console.print(f"left out: {topic}, the bytes of a board; --topic {topic} exports them")
    if remark := result.reading.remark():
        complain(f"{remark}; exported what could be read")
    for topic, reason in result.refused.items():
        complain(f"{result.undecoded[topic]} messages of {topic} left out: {reason}")
    return FAULTY if result.refused or result.reading.lossy else 0
