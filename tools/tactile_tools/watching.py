"""Keys, errors and bus session of ``tactile list``, ``echo``, ``hz`` and ``call``."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable

import tactile_reach as tr
from tactile_core.options import BusTable, bus_config
from tactile_reach.client import Bus

DONE, FAILED, USAGE, REFUSED = range(4)

QUIET_S = 3.0
"""Seconds without a message after which a command says that it is waiting."""


def key_of(text: str) -> str:
    """Parse a key expression; slashes at its ends, as topics in logs have them, are dropped."""
    import zenoh

    try:
        return str(zenoh.KeyExpr(text.strip("/")))
    except zenoh.ZError as error:
        raise argparse.ArgumentTypeError(
            f"{text!r} is not a key; expected one as in tactile/left/features, or with wildcards "
            "as in tactile/*/features"
        ) from error


def open_bus(options: argparse.Namespace) -> Bus:
    """Join the bus as the options say; `tactile_reach.TactileError` when it cannot be joined."""
    return Bus(bus_config(options, BusTable(), "tool"))


def run(name: str, work: Callable[[argparse.Namespace], int | None]) -> Callable[..., int]:
    """Make ``work`` the command ``tactile name``: an error becomes a sentence and exit status 3."""

    def command(options: argparse.Namespace) -> int:
        try:
            return work(options) or DONE
        except tr.TactileError as error:
            print(f"tactile {name}: {error}", file=sys.stderr)
            return REFUSED

    return command


def report_silence(name: str, key: str) -> None:
    """Tell a waiting user that nothing has come yet."""
    print(
        f"tactile {name}: nothing on {key} yet; `tactile list` shows what is published",
        file=sys.stderr,
    )
