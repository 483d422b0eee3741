"""``tactile log split``: split a log into several files, by time or size."""

from __future__ import annotations

import argparse
import uuid
from pathlib import Path
from types import TracebackType
from typing import Any

from tactile_core.cli import progress
from tactile_core.log.recorder import is_latched
from tactile_core.log.records import MetadataRecord
from tactile_core.log.writer import GAP
from tactile_core.types import NS_PER_S
from tactile_tools.log.arguments import check_output, moment
from tactile_tools.log.sources import FILE, find_series
from tactile_tools.log.stream import (
    Attachment,
    Item,
    Reading,
    Record,
    Stream,
    common_profile,
    first_ns,
    read_series,
)
from tactile_tools.log.terminal import ToolError, bytes_text, cannot_write, plain_console
from tactile_tools.log.writing import LogOutput

REPEATED_BYTES = 1 << 20
"""Attachments up to this size are repeated in every part, so that each part can be used alone;
calibrations and configurations have kilobytes."""

MAX_PARTS = 9999


def run(options: argparse.Namespace) -> int:
    """Split a log. Returns 0 if every part was written."""
    logs = find_series(options.files)
    if len(logs) != 1:
        raise ToolError(f"{len(logs)} logs given: split them one by one, or merge them first")
    source = logs[0].paths[0]
    folder: Path = options.out or source.with_name(f"{source.stem}_split")
    start = first_ns(logs)
    cuts = sorted(moment("--at", text, start) for text in options.at or ())
    step = None if options.every is None else round(options.every * NS_PER_S)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise cannot_write(folder, error) from error

    def place(number: int) -> Path:
        path = folder / f"{source.stem}_{number:04d}.mcap"
        return check_output(path, options.force, logs)

    reading = Reading()
    with progress("splitting") as report, Parts(place, common_profile(logs)) as parts:
        for item in read_series(logs[0], reading, report):
            if isinstance(item, Record):
                while cuts and item.log_ns >= cuts[0]:
                    cuts.pop(0)
                    parts.cut(item.log_ns)
                if step is not None and item.log_ns - start >= step * (parts.number + 1):
                    parts.cut(item.log_ns)
                if options.size is not None and parts.size >= options.size:
                    parts.cut(item.log_ns)
            parts.take(item)
    console = plain_console()
    for path, messages in parts.made:
        console.print(f"{path}: {messages} messages, {bytes_text(path.stat().st_size)}")
    if remark := reading.remark():
        console.print(f"{remark}: split what could be read")
    return 0


class Parts:
    """Files of a split; each later file begins with what still holds. A context manager."""

    def __init__(self, place: Any, profile: str) -> None:
        self.made: list[tuple[Path, int]] = []
        self.number = 0
        self._place = place
        self._profile = profile
        self._identity = uuid.uuid4().hex
        self._tables: dict[str, MetadataRecord] = {}
        self._files: dict[str, Attachment] = {}
        self._last_latched: dict[Stream, Record] = {}
        self._latched: dict[Stream, bool] = {}
        self._output = self._open()

    def __enter__(self) -> Parts:
        """Return the object itself."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Finish the last file; after an error, delete it."""
        self._end(kind, error, trace)

    @property
    def size(self) -> int:
        """Bytes of the present file."""
        return self._output.size

    def take(self, item: Item) -> None:
        """Write one item to the present file."""
        output = self._output
        if isinstance(item, MetadataRecord):
            if item.name == FILE:
                return
            output.metadata(item.name, item.values)
            if item.name != GAP:
                self._tables[item.name] = item
        elif isinstance(item, Attachment):
            output.attach(item)
            if item.size <= REPEATED_BYTES:
                self._files[item.name] = Attachment.of(*item[:4], item.read())
        else:
            output.write(item)
            if self._is_latched(item.stream):
                self._last_latched[item.stream] = item

    def cut(self, log_ns: int) -> None:
        """Continue in a new file, which begins at ``log_ns``, unless the present one is empty."""
        if not self._output.messages:
            return
        self._end(None, None, None)
        self.number += 1
        if self.number > MAX_PARTS:
            raise ToolError(f"more than {MAX_PARTS} files: give larger parts")
        self._output = self._open()
        for table in self._tables.values():
            self._output.metadata(table.name, table.values)
        for each in self._files.values():
            self._output.attach(each)
        for record in self._last_latched.values():
            self._output.write(record._replace(log_ns=log_ns))

    def _open(self) -> LogOutput:
        output = LogOutput(self._place(self.number), self._profile)
        output.metadata(FILE, {"set": self._identity, "file": str(self.number)})
        return output

    def _end(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        output = self._output
        output.__exit__(kind, error, trace)
        if error is None:
            self.made.append((output.path, output.messages))

    def _is_latched(self, stream: Stream) -> bool:
        latched = self._latched.get(stream)
        if latched is None:
            latched = self._latched[stream] = is_latched(stream.topic, dict(stream.metadata))
        return latched
