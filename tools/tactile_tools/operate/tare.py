"""``tactile tare``: take what the untouched skin reads now as its rest field."""

from __future__ import annotations

import argparse
import sys

from tactile_core.bus.services import ServiceError, call
from tactile_core.bus.topics import service_key
from tactile_core.cli import REFUSED
from tactile_tools.operate import boards
from tactile_tools.operate.boards import BoardError

TARE_S = 120.0
"""Seconds to wait for the end of a tare: eight frames of a board at 0.5 Hz, several times over."""

NOT_TAKEN = "tare refused"
"""Beginning of tactiled's message when it refuses a tare."""


def tare(options: argparse.Namespace) -> None:
    """Tare and print the result; `BoardError` if it was refused."""
    with boards.bus(options) as session:
        name = boards.choose(options.board, boards.find(session, options))
        if sys.stderr.isatty():  # a slow board takes a quarter of a minute
            print(f"taring {name}: leave the skin untouched ...", file=sys.stderr)
        try:
            report = call(
                session, service_key(name, "tare"), {"force": options.force}, timeout=TARE_S
            )
        except ServiceError as error:
            text = f"{name}: {error}"
            if str(error).startswith(NOT_TAKEN) and not options.force:
                text += ". Try again, or take it as it is with --force"
            raise BoardError(text, REFUSED) from error
        print(f"{name}: {report['message']}")


run = boards.as_command(tare)
