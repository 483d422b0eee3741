"""``tactile log``: what a log holds and whether it is sound; out of it, into others, and again."""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable
from importlib import import_module
from typing import Any

from tactile_core.log.records import LogError
from tactile_tools.log.terminal import REFUSED, ToolError, complain, fail

COMMANDS = {
    "info": "channels, rates, losses, gaps, outcome, and whether the file is whole",
    "doctor": "what is wrong with a log, what can be had of it, what repairs it",
    "recover": "write a whole log out of one that was cut off or damaged",
    "cat": "print messages, one a line",
    "export": "write messages as CSV, Parquet or NumPy files, one a topic",
    "replay": "publish a log on the bus again, under replay/…",
    "split": "cut a log into several files, by time or size",
    "merge": "several logs into one, in the order of time",
    "reprocess": "run the pipeline again over the raw bytes of a log",
    "rosbag": "make a folder that `ros2 bag play` and `ros2 bag info` take",
}
"""Modules of `tactile_tools.log`, one a subcommand; each defines ``fill(parser)`` and is imported
when its subcommand is used: most need none of what the slowest imports."""


class _Commands(argparse._SubParsersAction):  # type: ignore[type-arg]  # generic in the stubs alone
    """Subcommands that get their arguments when they are used."""

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: Any,
        option_string: str | None = None,
    ) -> None:
        name = values[0]
        if name in COMMANDS:
            chosen = self.choices[name]
            import_module(f"tactile_tools.log.{name}").fill(chosen)
            chosen.set_defaults(func=_guarded(chosen.get_default("func")))
        super().__call__(parser, namespace, values, option_string)


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add ``log`` to the ``tactile`` command."""
    parser = subparsers.add_parser(
        "log",
        help="inspect, repair, convert, replay and reprocess MCAP logs",
        description="Inspect, repair, convert, replay and reprocess MCAP logs of any length. A log "
        "is one file, several of them, a folder, or the name that the files of one log share.",
    )
    commands = parser.add_subparsers(
        dest="command", metavar="COMMAND", required=True, action=_Commands
    )
    for name, text in COMMANDS.items():
        commands.add_parser(name, help=text)


def _guarded(
    run: Callable[[argparse.Namespace], int],
) -> Callable[[argparse.Namespace], int]:
    """Run a subcommand; what cannot be done ends with a message and an exit code."""

    def guarded(options: argparse.Namespace) -> int:
        try:
            return run(options)
        except ToolError as error:
            return complain(str(error), error.code)
        except LogError as error:
            return fail(error)
        except BrokenPipeError:
            raise  # whoever read our output has gone; `tactile` ends quietly
        except OSError as error:
            # The output itself: what a tool writes to files it answers for. Nothing more can be
            # said there, nor may the interpreter try when it ends.
            os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
            return complain(f"cannot write the output: {error.strerror or error}", REFUSED)

    return guarded
