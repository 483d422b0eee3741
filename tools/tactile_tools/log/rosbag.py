"""``tactile log rosbag``: write the ``metadata.yaml`` that ``ros2 bag`` wants beside the files."""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import shutil
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rosbags.rosbag2.errors import ReaderError
from rosbags.rosbag2.metadata import dump_qos_v8, parse_qos
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from tactile_core.cli import progress
from tactile_core.log.info import LogInfo, info
from tactile_core.log.recorder import LATCHED_QOS, QOS, is_latched
from tactile_core.log.records import ChannelRecord, LogError
from tactile_core.log.recovery import RecoveryError, recover
from tactile_tools.log.sources import Series, find_series
from tactile_tools.log.stream import Reading, Stream, read_series
from tactile_tools.log.terminal import (
    REFUSED,
    ToolError,
    cannot_write,
    plain_console,
)

METADATA = "metadata.yaml"

VERSION = 5
"""Version of the file: the newest whose fields every ROS 2 since Galactic reads the same way."""


def run(options: argparse.Namespace) -> int:
    """Write the folder. Returns 0 if ros2 bag can read it."""
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
        fresh = not folder.exists()
        try:
            paths = _copy_files(series, folder)
        except (ToolError, LogError):
            if fresh:
                shutil.rmtree(folder, ignore_errors=True)
            raise
    bag = _survey(paths, beside=options.out is None)
    try:
        part = folder / f".{METADATA}.part"
        part.write_text(bag.yaml(), encoding="utf-8")
        part.replace(folder / METADATA)
    except OSError as error:
        raise cannot_write(folder / METADATA, error) from error
    plain_console().print(
        f"{folder}: {len(paths)} files, {bag.messages} messages; ros2 bag play {folder}"
    )
    if bag.unsaid:
        plain_console().print(
            f"not latched when played, for the file does not say so: {', '.join(bag.unsaid)}; "
            "--out FOLDER writes files that do"
        )
    return 0


def _copy_files(series: Series, folder: Path) -> list[Path]:
    """Put the files of a log into a new folder, each of them complete."""
    paths = []
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for path in series.paths:
            target = folder / path.name
            with progress("reading") as report:
                found = info(path, report)
            _check_stamps(path, found)
            streams = _streams(path)
            same = all(dict(s.metadata).get(QOS, "") == _qos(s.topic, s.metadata) for s in streams)
            if found.whole and found.indexed and same:
                _link(path, target)
            else:
                recover(path, target, mend=_with_qos)
            paths.append(target)
    except RecoveryError as error:
        raise ToolError(str(error), REFUSED) from error
    except OSError as error:
        raise cannot_write(folder, error) from error
    return paths


def _check_stamps(path: Path, found: LogInfo) -> None:
    """ToolError for times that ROS 2 cannot represent."""
    beyond = [channel for channel in found.channels if channel.impossible]
    if beyond:
        raise ToolError(
            f"{path} has messages stamped 2^63 ns or later, on {beyond[0].topic}: ROS 2 has no "
            "such time; tactile log export reads them"
        )


def _link(path: Path, target: Path) -> None:
    with contextlib.suppress(OSError):  # another file system, or one without hard links
        os.link(path.resolve(), target)
        return
    shutil.copyfile(path, target)


@dataclass(slots=True)
class _Bag:
    """Contents of the metadata: files with start and end, topics with type and count."""

    files: list[tuple[str, int, int, int]] = field(default_factory=list)
    topics: dict[tuple[str, str], int] = field(default_factory=dict)
    encodings: dict[tuple[str, str], str] = field(default_factory=dict)
    qos: dict[tuple[str, str], str] = field(default_factory=dict)
    unsaid: dict[str, None] = field(default_factory=dict)  # latched topics not described as such

    @property
    def messages(self) -> int:
        """Number of messages in all files."""
        return sum(count for *_, count in self.files)

    def add(self, path: Path, found: LogInfo, streams: Iterable[Stream]) -> None:
        """Add one file, which has ``streams``."""
        start, end = found.span_ns or (0, 0)
        self.files.append((path.name, start, end, found.messages))
        for channel in found.channels:
            key = channel.topic, channel.msgtype
            self.topics[key] = self.topics.get(key, 0) + channel.messages
        for stream in streams:
            key = stream.topic, stream.msgtype
            self.encodings[key] = stream.encoding
            qos = _qos(stream.topic, stream.metadata)
            if qos and not dict(stream.metadata).get(QOS):
                # Readers that compare file and metadata would skip a topic whose QoS differed here
                # alone.
                self.unsaid[stream.topic] = None
                qos = ""
            self.qos[key] = self.qos.get(key) or qos

    def yaml(self) -> str:
        """Return the text of ``metadata.yaml``; texts are quoted as in JSON, which YAML accepts."""
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
                f"        offered_qos_profiles: {json.dumps(self.qos[topic, msgtype])}",
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


NAMED = ("history", "reliability", "durability", "liveliness")
"""Policies that were numbers before ROS 2 Jazzy and are names since."""

DEFAULT: Any = {
    "history": "keep_last",
    "depth": 10,
    "reliability": "reliable",
    "durability": "volatile",
    "deadline": {"sec": 0, "nsec": 0},
    "lifespan": {"sec": 0, "nsec": 0},
    "liveliness": "system_default",
    "liveliness_lease_duration": {"sec": 0, "nsec": 0},
    "avoid_ros_namespace_conventions": False,
}
"""Defaults of ROS 2, for what a profile leaves out."""


def _with_qos(channel: ChannelRecord) -> dict[str, str]:
    """Metadata of a channel with the QoS of ``metadata.yaml``: readers compare the two."""
    qos = _qos(channel.topic, channel.metadata.items())
    if not qos and QOS not in channel.metadata:
        return channel.metadata
    return channel.metadata | {QOS: qos}


def _qos(topic: str, pairs: Iterable[tuple[str, str]]) -> str:
    """QoS of a topic's publishers as in version 5: YAML within a text, numbers for names."""
    metadata = dict(pairs)
    text = metadata.get(QOS, "")
    try:
        recorded = YAML(typ="safe").load(text) or []
        profiles = parse_qos([DEFAULT | each for each in recorded])
        numbers = all(isinstance(each.get(key), int) for each in recorded for key in NAMED)
        if recorded and numbers and all(each.keys() >= DEFAULT.keys() for each in recorded):
            return text  # unchanged
    except (ReaderError, YAMLError, LookupError, TypeError, ValueError, AttributeError):
        profiles = []  # ros2 bag could not read it either, and would not play the topic
    if not profiles and is_latched(topic, metadata):
        return LATCHED_QOS
    return dump_qos_v8(profiles) if profiles else ""


def _streams(path: Path) -> list[Stream]:
    """All streams of a file; its summary need not name all of them."""
    reading = Reading()
    for _ in read_series(Series((path,)), reading, None, lambda _: False):
        pass
    return list(reading.seen)


def _survey(paths: list[Path], *, beside: bool) -> _Bag:
    bag = _Bag()
    for path in paths:
        with progress("counting") as report:
            found = info(path, report)
        how = "give --out FOLDER" if beside else f"tactile log recover {path}"
        if not found.whole:
            raise ToolError(f"{path} is not whole, and ros2 bag reads whole files alone: {how}")
        if found.messages and not found.indexed:
            raise ToolError(f"{path} lacks indexes, which ros2 bag needs: {how}")
        _check_stamps(path, found)
        bag.add(path, found, _streams(path))
    return bag
