"""``tactile log doctor``: faults of a log, what can be recovered, and how to repair it."""

from __future__ import annotations

import argparse
import dataclasses
import fcntl
import json
import os
import re
import shlex
from collections import Counter
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

from tactile_core.bus.messages import DecodeError
from tactile_core.cli import progress
from tactile_core.log.info import LogInfo, info_of
from tactile_core.log.records import ChannelRecord, Message, SchemaRecord
from tactile_core.types import NS_PER_S
from tactile_tools.log.decode import Decoder
from tactile_tools.log.sources import Series, find_series
from tactile_tools.log.stream import Stream, stream_of
from tactile_tools.log.terminal import (
    FAULTY,
    bytes_text,
    clock_text,
    plain_console,
    seconds_text,
    shown,
)

PROFILES = ("ros2", "ros1", "")
"""Profiles that MCAP names; only messages of the first are decoded."""

AT_START = frozenset({"backlog", "discarded_bytes", "unidentified"})
"""Drops that come with joining a running stream: they are in every log, and not faults."""

LONGEST = 2000
"""Letters of a finding that are printed; --json prints all."""

OUR_LIBRARY = re.compile(r"tactile-reach (\d+(?:\.\d+)*)")


@dataclass(frozen=True, slots=True)
class Finding:
    """A fault, or with ``fault`` False something worth knowing. ``remedy``: what to do about it."""

    code: str
    fault: bool
    text: str
    remedy: str = ""


def run(options: argparse.Namespace) -> int:
    """Examine logs. Returns 0 if none has a fault, 1 if one has."""
    rows, sick = [], False
    for number, series in enumerate(find_series(options.files)):
        with progress("examining") as report:
            watch = _DecodeCheck()
            found = info_of(series.paths, report, watch.take)
        findings = examine(found, series, watch)
        sick |= any(finding.fault for finding in findings)
        if options.json:
            rows.append(_as_json(found, series, findings))
        else:
            if number:
                print()
            _show(found, series, findings)
    if options.json:
        print(json.dumps(rows[0] if len(rows) == 1 else rows, indent=2))
    return FAULTY if sick else 0


class _DecodeCheck:
    """Tries to decode the first message of every channel."""

    def __init__(self) -> None:
        self.troubles: dict[str, str] = {}
        self._decoder = Decoder()

    def take(self, channel: ChannelRecord, schema: SchemaRecord | None, message: Message) -> None:
        """Try to decode a message; keep the error."""
        stream: Stream = stream_of(channel, schema)
        try:
            self._decoder.decode(stream, message.data)
        except DecodeError as error:
            self.troubles[channel.topic] = str(error)


def examine(found: LogInfo, series: Series, watch: _DecodeCheck) -> list[Finding]:
    """Return all findings, faults first."""
    findings = [*_file_findings(found, series), *_content_findings(found, watch)]
    return sorted(findings, key=lambda finding: not finding.fault)


def _file_findings(found: LogInfo, series: Series) -> list[Finding]:
    """Findings about the files themselves."""
    out = []
    names = " ".join(shlex.quote(str(path)) for path in series.paths)
    repair = f"tactile log recover {names}"
    written = [path for path in series.paths if _being_written(path)]
    if written:
        text = f"{written[0]} is being written just now: it ends where its writer has got to"
        out.append(Finding("being_written", False, text, "stop its writer first"))
    elif not found.closed:
        text = "not closed: footer and summary are missing, its writer was killed or cut off"
        out.append(Finding("not_closed", True, text, repair))
    elsewhere = "read it with the tools of its writer: recover leaves out what is not read here"
    by_reason: dict[str, list[Any]] = {}
    for damage in found.damages:
        by_reason.setdefault(damage.reason, []).append(damage)
    for reason, damages in by_reason.items():
        if written and reason.startswith("cut off"):
            continue
        lost = sum(d.messages or 0 for d in damages)
        unknown = any(d.messages is None for d in damages)
        size = bytes_text(sum(d.length for d in damages))
        places = f"{len(damages)} places, the first" if len(damages) > 1 else "one place,"
        text = (
            f"{reason}: {places} at byte {damages[0].offset}; {size} unreadable, "
            f"{lost} messages lost" + (" and an unknown number more" if unknown else "")
        )
        unread = reason.startswith("a chunk compressed with")
        out.append(Finding("damaged", True, text, elsewhere if unread else repair))
    if found.damage_count > len(found.damages):
        text = f"{found.damage_count - len(found.damages)} more damaged places"
        out.append(Finding("damaged", True, text, repair))
    if found.missing_files:
        numbers = ", ".join(map(str, found.missing_files))
        text = f"files of this log are not here: number {numbers}"
        out.append(Finding("missing_files", True, text, "give them as well, if they still exist"))
    if found.profile not in PROFILES:
        text = f"profile {found.profile!r} is not known here: only ros2 is, and json messages"
        out.append(Finding("unknown_profile", True, text, "read it with the tools of its writer"))
    match = OUR_LIBRARY.fullmatch(found.library)
    if match is not None and _numbers(match[1]) > _numbers(version("tactile-reach")):
        text = f"written by {found.library}, newer than this one ({version('tactile-reach')})"
        out.append(Finding("newer_version", True, text, "update tactile-reach to read all of it"))
    return out


def _content_findings(found: LogInfo, watch: _DecodeCheck) -> list[Finding]:
    """Findings about what the files hold."""
    out = []
    gone = "what was not written cannot be had again"
    if not found.channels:
        text = "it holds no channel at all"
        out.append(Finding("empty", True, text, "its writer ended before anything came"))
    reasons: Counter[str] = Counter()
    for gap in found.gaps:
        reasons[gap.reason] += gap.messages
    for reason, count in reasons.items():
        first = next(gap for gap in found.gaps if gap.reason == reason)
        text = f"gap: {reason}, {count} messages not written, first at {clock_text(first.first_ns)}"
        out.append(Finding("gap", True, f"{text} {first.detail}".rstrip(), gone))
    if found.one_counter and found.numbers_missing:
        text = (
            f"one counter numbers the messages of all channels, and {found.numbers_missing} of its "
            "numbers are missing: of messages that were lost, or of channels that are not in here"
        )
        out.append(Finding("missing_messages", True, text, gone))
    elif found.one_counter:
        text = "one counter numbers the messages of all channels; none is missing"
        out.append(Finding("one_counter", False, text))
    missing = {c.topic: c.missing for c in found.channels if c.missing}
    if missing:
        worst = max(missing, key=lambda topic: missing[topic])
        text = f"{sum(missing.values())} messages are missing by their numbers, most of {worst}"
        out.append(Finding("missing_messages", True, text, gone))
    for channel in found.channels:
        if channel.backwards:
            text = (
                f"{channel.topic}: time goes backwards {channel.backwards} times, by up to "
                f"{seconds_text(channel.furthest_back_ns)}"
            )
            remedy = "tactile log merge FILE --out OUT writes the messages in the order of time"
            out.append(Finding("time_backwards", True, text, remedy))
        if channel.impossible:
            many = (
                "one message is"
                if channel.impossible == 1
                else f"{channel.impossible} messages are"
            )
            text = (
                f"{channel.topic}: {many} stamped later than any clock "
                f"goes, the first {channel.impossible_ns} ns: beyond 2^63, in the year "
                f"{1970 + channel.impossible_ns // (NS_PER_S * 31_556_952)}"
            )
            remedy = "they are read and exported as they are; ROS 2 cannot play them"
            out.append(Finding("impossible_stamps", True, text, remedy))
        for when, change in channel.clock_steps[:1]:
            text = (
                f"{channel.topic}: at {clock_text(when)} its stamps and the log's clock part by "
                f"{change / NS_PER_S:+.3f} s, {len(channel.clock_steps)} times in all: a clock was "
                "set, or the sender is another machine"
            )
            out.append(Finding("clock_step", True, text, "go by captured_ns, which no clock moves"))
    if found.orphans:
        text = f"{found.orphans} messages belong to channels that are defined nowhere"
        out.append(
            Finding("orphans", True, text, "they cannot be decoded; recover leaves them out")
        )
    for topic, trouble in sorted(watch.troubles.items()):
        out.append(Finding("unknown_schema", True, trouble, f"{topic} can be copied, not read"))
    for source, counts in found.drops.items():
        lost = {reason: n for reason, n in counts.items() if n}
        if lost:
            text = ", ".join(f"{reason} {n}" for reason, n in sorted(lost.items()))
            fault = bool(set(lost) - AT_START)
            remedy = "see the wiring and load of that port" if fault else "usual at the start"
            out.append(Finding("drops", fault, f"drops of {source}: {text}", remedy))
    silent = [channel.topic for channel in found.channels if not channel.messages]
    if silent:
        text = f"channels without a message: {', '.join(silent)}"
        out.append(Finding("empty_channels", False, text))
    silences = sum(channel.silence_count for channel in found.channels)
    if silences:
        pausing = [channel for channel in found.channels if channel.silence_count]
        longest = max(pausing, key=lambda channel: channel.longest_ns)
        text = (
            f"{silences} silences in streams of a steady rate, the longest "
            f"{seconds_text(longest.longest_ns)} on {longest.topic}"
        )
        out.append(Finding("silences", False, text, "tactile log info lists them"))
    return out


def _being_written(path: Path) -> bool:
    """Return whether a recorder holds the lock of a file."""
    try:
        fd = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    except OSError:
        return False
    try:
        fcntl.flock(fd, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError:
        return True
    finally:
        os.close(fd)
    return False


def _numbers(text: str) -> tuple[int, ...]:
    return tuple(int(part) for part in re.findall(r"\d+", text))


def _show(found: LogInfo, series: Series, findings: list[Finding]) -> None:
    console = plain_console()
    faults = sum(finding.fault for finding in findings)
    verdict = f"{faults} faults" if faults > 1 else "one fault" if faults else "healthy"
    console.print(f"{series.name}  {bytes_text(found.size)}  {verdict}")
    for finding in findings:
        console.print(f"{'FAULT' if finding.fault else 'note '} {shown(finding.text, LONGEST)}")
        if finding.remedy:
            console.print(f"      → {finding.remedy}")
    span = found.span_ns
    if span is None:
        console.print("no message can be had of it")
        return
    console.print(
        f"{'readable all the same' if faults else 'readable'}: {found.messages} messages, "
        f"{clock_text(span[0])} to {clock_text(span[1])} ({seconds_text(span[1] - span[0])}), "
        f"{found.attachment_count} attachments, {found.table_count} tables"
    )


def _as_json(found: LogInfo, series: Series, findings: list[Finding]) -> dict[str, Any]:
    return {
        "paths": [str(path) for path in series.paths],
        "healthy": not any(finding.fault for finding in findings),
        "findings": [dataclasses.asdict(finding) for finding in findings],
        "messages": found.messages,
        "span_ns": found.span_ns,
        "messages_lost": found.messages_lost,
        "places_of_unknown_loss": found.lost_unknown,
        "attachments": found.attachment_count,
        "tables": found.table_count,
    }
