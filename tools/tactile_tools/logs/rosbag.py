"""``tactile log rosbag``: what ``ros2 bag`` wants beside the files: ``metadata.yaml``."""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import shutil
from dataclasses import dataclass, field
from pathlib import Path

from tactile_bus.log_info import LogInfo, info
from tactile_bus.recovery import RecoveryError, recover
from tactile_tools.logs.arguments import add_files
from tactile_tools.logs.sources import Series, find_series
from tactile_tools.logs.stream import Reading, read_series
from tactile_tools.logs.terminal import (
    REFUSED,
    ToolError,
    cannot_write,
    plain_console,
    progress,
)

METADATA = "metadata.yaml"

VERSION = 5
"""Of the file: the newest whose fields every ROS 2 since Galactic reads the same way."""


def fill(parser: argparse.ArgumentParser) -> None:
    """Give ``tactile log rosbag`` its arguments."""
    parser.description = (
        f"Write {METADATA} for a log: beside its files, or with --out in a new folder "
        "with the files (hard links where that can be, else copies; files that were cut off are "
        "recovered). Types of tactile_msgs have to be built in the workspace to be played."
    )
    add_files(parser)
    parser.add_argument("--out", type=Path, metavar="FOLDER", help="new folder (default: beside)")
    parser.add_argument("--force", action="store_true", help=f"overwrite a {METADATA}")
    parser.set_defaults(func=run)


def run(options: argparse.Namespace) -> int:
    """Write; 0 when the folder can be taken by ros2 bag."""
    logs = find_series(options.files)
    if len(logs) != 1:
        raise ToolError(f"{len(logs)} logs given: a bag is one; merge them first")
    series = logs[0]
    if options.out is None:
        folder = series.paths[0].parent
        paths = list(series.paths)
        if any(path.parent.resolve() != folder.resolve() for path in paths):
            raise ToolError("the files lie in several folders: give --out")
        if (folder / METADATA).exists() and not options.force:
            raise ToolError(f"{folder / METADATA} exists and is not overwritten: give --force")
    else:
        folder = options.out
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise ToolError(f"{folder} is there already: name a new folder with --out")
        paths = _bring(series, folder)
    bag = _survey(paths, beside=options.out is None)
    try:
        part = folder / f".{METADATA}.part"
        part.write_text(bag.yaml(), encoding="utf-8")
        part.replace(folder / METADATA)
    except OSError as error:
        raise cannot_write(folder / METADATA, error) from error
    plain_console().print(
        f"{folder}: {len(paths)} files, {bag.messages} messages; ros2 bag play it"
    )
    return 0


def _bring(series: Series, folder: Path) -> list[Path]:
    """The files of a log in a new folder, all of them whole."""
    paths = []
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for path in series.paths:
            target = folder / path.name
            reading = Reading()
            with progress("reading") as report:
                for _ in read_series(Series((path,)), reading, report, lambda _: False):
                    pass
                if reading.unclosed or reading.damages:
                    recover(path, target)
                else:
                    _link(path, target)
            paths.append(target)
    except RecoveryError as error:
        raise ToolError(str(error), REFUSED) from error
    except OSError as error:
        raise cannot_write(folder, error) from error
    return paths


def _link(path: Path, target: Path) -> None:
    with contextlib.suppress(OSError):  # another file system, or one without hard links
        os.link(path.resolve(), target)
        return
    shutil.copyfile(path, target)


@dataclass(slots=True)
class _Bag:
    """What the metadata tell: of each file name, start and end; of each topic type and count."""

    files: list[tuple[str, int, int, int]] = field(default_factory=list)
    topics: dict[tuple[str, str], int] = field(default_factory=dict)
    encodings: dict[tuple[str, str], str] = field(default_factory=dict)

    @property
    def messages(self) -> int:
        """Of all files."""
        return sum(count for *_, count in self.files)

    def add(self, path: Path, found: LogInfo, encodings: dict[str, str]) -> None:
        """Take one file."""
        start, end = found.span_ns or (0, 0)
        self.files.append((path.name, start, end, found.messages))
        for channel in found.channels:
            key = channel.topic, channel.msgtype
            self.topics[key] = self.topics.get(key, 0) + channel.messages
            self.encodings[key] = encodings.get(channel.topic, "cdr")

    def yaml(self) -> str:
        """Text of ``metadata.yaml``; texts are quoted as JSON, which YAML takes."""
        full = [file for file in self.files if file[3]] or self.files
        start, end = min(file[1] for file in full), max(file[2] for file in full)
        lines = [
            "rosbag2_bagfile_information:",
            f"  version: {VERSION}",
            "  storage_identifier: mcap",
            f"  duration: {{nanoseconds: {end - start}}}",
            f"  starting_time: {{nanoseconds_since_epoch: {start}}}",
            f"  message_count: {self.messages}",
            "  topics_with_message_count:",
        ]
        for (topic, msgtype), count in self.topics.items():
            lines += [
                "    - topic_metadata:",
                f"        name: {json.dumps(topic)}",
                f"        type: {json.dumps(msgtype)}",
                f"        serialization_format: {json.dumps(self.encodings[topic, msgtype])}",
                '        offered_qos_profiles: ""',
                f"      message_count: {count}",
            ]
        lines += ['  compression_format: ""', '  compression_mode: ""', "  relative_file_paths:"]
        lines += [f"    - {json.dumps(name)}" for name, *_ in self.files]
        lines.append("  files:")
        for name, first, last, count in self.files:
            lines += [
                f"    - path: {json.dumps(name)}",
                f"      starting_time: {{nanoseconds_since_epoch: {first}}}",
                f"      duration: {{nanoseconds: {last - first}}}",
                f"      message_count: {count}",
            ]
        return "\n".join(lines) + "\n"


def _survey(paths: list[Path], *, beside: bool) -> _Bag:
    bag = _Bag()
    for path in paths:
        with progress("counting") as report:
            found = info(path, report)
        if not found.whole:
            how = "give --out FOLDER" if beside else f"tactile log recover {path}"
            raise ToolError(f"{path} is not whole, and ros2 bag reads whole files alone: {how}")
        reading = Reading()
        for _ in read_series(Series((path,)), reading, None, lambda _: False, (0, 0)):
            pass
        bag.add(path, found, {stream.topic: stream.encoding for stream in reading.seen})
    return bag
