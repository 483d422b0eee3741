"""``tactile log``: what a log holds and whether it is sound; out of it, into others, and again."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from importlib import import_module

from tactile_bus.log_records import LogError
from tactile_tools.logs.terminal import ToolError, complain, fail

COMMANDS = (
    "info",
    "doctor",
    "recover",
    "cat",
    "export",
    "reprocess",
)
"""Modules of `tactile_tools.logs` that add a subcommand; each defines ``add(commands)``."""


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add ``log`` to the ``tactile`` command."""
    parser = subparsers.add_parser(
        "log",
        help="inspect, repair, convert, replay and reprocess MCAP logs",
        description="Inspect, repair, convert, replay and reprocess MCAP logs of any length. A log "
        "is one file, several of them, a folder, or the name that the files of one log share.",
    )
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    for name in COMMANDS:
        import_module(f"tactile_tools.logs.{name}").add(commands)
    for sub in commands.choices.values():
        sub.set_defaults(func=_guarded(sub.get_default("func")))


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
        finally:
            sys.stderr.flush()

    return guarded
