"""Command line of ``tactile log``."""

from __future__ import annotations

import argparse
import os
import re
from collections.abc import Callable
from pathlib import Path

from tactile_core.cli import (
    REFUSED,
    Command,
    CommandError,
    Parser,
    add_bus,
    add_commands,
    add_json,
    add_out,
    count,
    hertz,
    later,
    refuse,
    seconds,
    speed,
    whole,
)
from tactile_tools.options import add_log_files
from tactiled.sensing import METHODS

HERE = "tactile_tools.log.cli"

COMMANDS = {
    "info": Command("channels, rates, losses, gaps, outcome, is it whole", f"{HERE}:_info"),
    "doctor": Command("faults of a log, and the command that repairs them", f"{HERE}:_doctor"),
    "recover": Command("write a whole log out of a damaged one", f"{HERE}:_recover"),
    "cat": Command("print messages, one a line", f"{HERE}:_cat"),
    "export": Command("write CSV, Parquet or NumPy files, one a topic", f"{HERE}:_export"),
    "replay": Command("publish a log on the bus again, under replay/…", f"{HERE}:_replay"),
    "split": Command("cut a log into several files, by time or size", f"{HERE}:_split"),
    "merge": Command("several logs into one, in the order of time", f"{HERE}:_merge"),
    "reprocess": Command("run the pipeline again over the raw bytes", f"{HERE}:_reprocess"),
    "rosbag": Command("make a folder that `ros2 bag` plays", f"{HERE}:_rosbag"),
}

FORMATS = ("csv", "parquet", "npz", "lerobot")

MAX_FPS = 1000
"""Greatest frame rate of a LeRobot data set, Hz."""

_SIZE = re.compile(r"(\d+(?:\.\d+)?)\s*([kMG]i?)?B?", re.IGNORECASE)
_POWERS = {"": 1, "k": 10**3, "m": 10**6, "g": 10**9, "ki": 1 << 10, "mi": 1 << 20, "gi": 1 << 30}


def fill(parser: Parser) -> None:
    """Add the options of ``tactile log``."""
    parser.description = (
        "Inspect, repair, convert, replay and reprocess MCAP logs of any length. A log "
        "is one file, several of them, a folder, or the name that the files of one log share."
    )
    add_commands(parser, COMMANDS)


def _work(name: str) -> Callable[[argparse.Namespace], int]:
    """Make ``run`` of module ``name`` a command; errors of logs and outputs become one sentence."""
    work = later(f"tactile_tools.log.{name}:run")

    def run(options: argparse.Namespace) -> int:
        from tactile_core.log.records import LogError
        from tactile_tools.log.terminal import fail

        try:
            return work(options)
        except LogError as error:
            return fail(error)
        except BrokenPipeError:
            raise  # the reader of our output has gone; `run_command` ends quietly
        except OSError as error:
            # The output itself failed: tools handle errors of the files they write. Nothing more
            # can be printed, and the interpreter must not try when it exits.
            os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
            raise CommandError(
                f"cannot write the output: {error.strerror or error}", REFUSED
            ) from error

    return run


def size_bytes(text: str) -> int:
    """Parse a size in bytes, such as 500MB, 1.5GiB or 4096."""
    match = _SIZE.fullmatch(text.strip())
    if match is not None:
        size = float(match[1]) * _POWERS[(match[2] or "").lower()]
        if 1 <= size < 1 << 60:
            return int(size)
    raise refuse(text, "a size such as 500MB or 2GiB")


def _add_selection(parser: Parser) -> None:
    """Add --topic, --from and --until."""
    parser.add_argument(
        "--topic",
        action="append",
        metavar="PATTERN",
        help="only these, with * and ? (quote them); may be repeated",
    )
    for name, which in (("--from", "first"), ("--until", "last")):
        parser.add_argument(
            name,
            dest=f"{which}_time",
            metavar="TIME",
            help=f"{which} log time: s since the start of the log, or UTC as 2026-01-31T12:00:00",
        )


def _info(parser: Parser) -> None:
    parser.description = (
        "Read a log from end to end and say what it holds: channels and rates, what "
        "was dropped and where, calibration, outcome and software, and whether every byte is "
        "readable. Files of one log are taken together."
    )
    add_log_files(parser)
    add_json(parser)
    parser.add_argument(
        "--quick",
        action="store_true",
        help="only what the summary at the end of each file says: nothing is read or checked",
    )
    parser.set_defaults(func=_work("info"))


def _doctor(parser: Parser) -> None:
    parser.description = (
        "Diagnose a log: read it from end to end, name its faults, what is recoverable all the "
        "same, and which command repairs it. Exit: 0 healthy, 1 it has faults, 2 bad argument or "
        "not a log, 3 refused by the system."
    )
    add_log_files(parser)
    add_json(parser)
    parser.set_defaults(func=_work("doctor"))


def _recover(parser: Parser) -> None:
    parser.description = (
        "Write everything readable of each FILE to a new, finished log. The files are only read."
    )
    parser.add_argument("files", nargs="+", type=Path, metavar="FILE", help="MCAP log, or several")
    add_out(parser, "new log (default: FILE's name with _recovered)")
    parser.add_argument(
        "--keep-suspect",
        action="store_true",
        help="also what looks readable of blocks and attachments whose checksum is wrong, as after "
        "a flipped bit; the new log says which messages these are",
    )
    add_json(parser)
    parser.set_defaults(func=_work("recover"))


def _cat(parser: Parser) -> None:
    parser.description = (
        "Print the messages of a log, one a line: time since its start, topic, fields. "
        "Several logs are printed in the order of time."
    )
    parser.former(to="until")
    add_log_files(parser)
    _add_selection(parser)
    add_json(parser, "print one JSON object a line, complete")
    parser.add_argument(
        "--absolute", action="store_true", help="UTC time instead of seconds since the start"
    )
    parser.add_argument(
        "--limit", type=count, metavar="N", help="stop after N messages (default: all)"
    )
    parser.set_defaults(func=_work("cat"))


def _export(parser: Parser) -> None:
    parser.description = (
        "Write a folder with one table a topic. Nested fields are flattened "
        "(header.stamp_ns, wrench.force.x); columns.json says what each column is. Lists of "
        "numbers are columns name.0, name.1 … in CSV, lists in Parquet, matrices in npz; lists of "
        "messages are JSON in CSV, lists of structures in Parquet, flat arrays with offsets in "
        "npz. Raw bytes of boards are left out unless --topic names them. lerobot: a LeRobot data "
        "set (v3.0) with one episode a log, see docs/lerobot.md."
    )
    parser.former(to="format")
    add_log_files(parser)
    parser.add_argument("--format", choices=FORMATS, required=True, help="of the tables")
    parser.add_argument(
        "--fps",
        type=whole(least=1, most=MAX_FPS),
        default=50,
        metavar="N",
        help="lerobot: frames a second that all streams are brought to (default 50)",
    )
    parser.add_argument(
        "--task",
        default="reach into the cupboard",
        metavar="TEXT",
        help="lerobot: what the robot was doing (default: reach into the cupboard)",
    )
    add_out(parser, "new folder (default: FILE's name and format)")
    _add_selection(parser)
    parser.set_defaults(func=_work("export"))


def _replay(parser: Parser) -> None:
    parser.description = (
        "Publish the messages of a log with the spacing they had, each under "
        "replay/ and its key, never under the live keys. Raw bytes, which were never on the "
        "bus, are left out unless --topic names them. Ctrl-C ends it."
    )
    parser.former(to="until")
    add_log_files(parser)
    _add_selection(parser)
    parser.add_argument(
        "--speed",
        type=speed,
        default=1.0,
        metavar="X",
        help="times real time, or inf for as fast as can be (default 1)",
    )
    parser.add_argument("--loop", action="store_true", help="begin again at the end")
    add_bus(parser, "tool")
    parser.set_defaults(func=_work("replay"))


def _split(parser: Parser) -> None:
    parser.description = (
        "Write a log as several files, which the other tools take as one again, nothing twice. "
        "Each begins with the tables, small attachments and latched messages that hold there, so "
        "that it can be used alone."
    )
    add_log_files(parser)
    how = parser.add_mutually_exclusive_group(required=True)
    how.add_argument("--every", type=seconds, metavar="S", help="s of each file")
    how.add_argument("--size", type=size_bytes, metavar="SIZE", help="of each file, such as 500MB")
    how.add_argument(
        "--at",
        action="append",
        metavar="TIME",
        help="cut there: s since the start, or UTC as 2026-01-31T12:00:00; may be repeated",
    )
    add_out(parser, "folder (default: FILE's name with _split)")
    parser.set_defaults(func=_work("split"))


def _merge(parser: Parser) -> None:
    parser.description = (
        "Write several logs, such as those of both daemons, as one: messages in the "
        "order of time, all attachments and tables. What one daemon logged of what another said, "
        "and that one logged too (same bytes, same stamp of the sender), is kept once."
    )
    add_log_files(parser)
    add_out(parser, "new log", required=True)
    parser.add_argument(
        "--keep-duplicates", action="store_true", help="keep messages that several logs have"
    )
    parser.add_argument(
        "--align",
        action="store_true",
        help="put the clocks of the logs together by the monotonic clock of the machine, if its "
        "clock was set between their starts",
    )
    parser.set_defaults(func=_work("merge"))


def _reprocess(parser: Parser) -> None:
    parser.description = (
        "Run field, compensation, force and features again over the raw bytes of a "
        "log. With the settings and calibration of the log they come out bit for bit the same; "
        "with others, as they would have been. Everything else is copied."
    )
    add_log_files(parser)
    add_out(parser, "new log (default: FILE's name with _reprocessed)")
    parser.add_argument(
        "--calibration",
        action="append",
        type=Path,
        metavar="FILE",
        help="*.cal.toml instead of the one in the log, by serial number; may be repeated",
    )
    parser.add_argument(
        "--config", type=Path, metavar="FILE", help="TOML of tactiled: [sensing], [compensation]"
    )
    parser.add_argument("--compensation", choices=METHODS, help="default: as in the log")
    parser.add_argument(
        "--compensation-rate", type=hertz, metavar="HZ", help="default: as in the log"
    )
    parser.add_argument("--feature-rate", type=hertz, metavar="HZ", help="default: as in the log")
    parser.set_defaults(func=_work("reprocess"))


def _rosbag(parser: Parser) -> None:
    parser.description = (
        "Write metadata.yaml for a log: beside its files, or with --out in a new folder "
        "with the files (hard links where that can be, else copies; files that were cut off, or "
        "have no indexes, which ros2 bag needs, are written anew). Types of tactile_msgs have to "
        "be built in the workspace to be played."
    )
    add_log_files(parser)
    add_out(parser, "new folder (default: beside)", force="overwrite a metadata.yaml")
    parser.set_defaults(func=_work("rosbag"))
