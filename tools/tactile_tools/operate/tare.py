"""``tactile tare``: what the untouched skin reads now becomes its rest."""

from __future__ import annotations

import argparse
import sys

from tactile_core.bus.services import ServiceError, call
from tactile_core.bus.topics import service_key
from tactile_tools.operate import boards
from tactile_tools.operate.boards import BoardError

TARE_S = 120.0
"""s to wait for the end of a tare: eight frames of a board at 0.5 Hz, several times over."""

REFUSED = "tare refused"
"""Beginning of what tactiled says of a tare that it did not take."""


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add ``tare`` to the umbrella command."""
    parser = subparsers.add_parser(
        "tare",
        help="take what the untouched skin reads now for its rest",
        description="Tares a board of a running tactiled. Lift the skin off everything and keep it "
        "still. A tare that is refused changes nothing and says what to do.",
        epilog="exit status: 0 tared; 2 no such board; 3 no tactiled, or refused.",
    )
    boards.add_board(parser, "to tare (may be left out where there is only one)")
    parser.add_argument(
        "--force",
        action="store_true",
        help="tare whatever speaks against it: what is on the skin now will read as no force",
    )
    parser.set_defaults(func=boards.run("tare", tare))


def tare(options: argparse.Namespace) -> None:
    """Tare and say what came of it; `BoardError` when it was refused."""
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
            if str(error).startswith(REFUSED) and not options.force:
                text += ". Try again, or take it as it is with --force"
            raise BoardError(text, boards.REFUSED) from error
        print(f"{name}: {report['message']}")
