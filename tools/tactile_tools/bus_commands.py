"""Options of the tools that watch the bus: view, list, echo, hz, call, cpp-header."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

from tactile_core.cli import Parser, add_bus, add_out, checked, count, later, positive, whole

VIEW_PORT = 8420
"""TCP port of the live page, as in `tactile_tools.view.cli`; a test compares them."""

VIEW_EPILOG = f"""\
examples:
  tactile view                       the boards of this machine, at http://127.0.0.1:{VIEW_PORT}
  tactile view FILE.mcap             a log, with a slider
  tactile view --bind 0.0.0.0        for other machines, with a token in the address
  ssh -L {VIEW_PORT}:127.0.0.1:{VIEW_PORT} robot    the page of another machine, without opening it
"""

KEYS = "as in tactile/left/features, or with wildcards: tactile/*/features"


def _watching(name: str, place: str) -> Callable[[argparse.Namespace], int]:
    """Make a command of ``place`` ("module:function"); errors become a sentence and a status."""

    def call(options: argparse.Namespace) -> int:
        from tactile_tools import watching

        module, _, function = place.partition(":")
        return watching.run(name, getattr(import_module(module), function))(options)

    return call


def _key(text: str) -> str:
    from tactile_tools.watching import key_of

    return key_of(text)


def _json(text: str) -> dict[str, Any]:
    try:
        found = json.loads(text)
    except ValueError as error:
        raise ValueError(f"{text!r} is not JSON: {error}") from error
    if not isinstance(found, dict):
        raise ValueError(f"{text!r} is not a JSON object, as in '{{\"force\": true}}'")
    return found


def _add_key(parser: Parser, what: str = KEYS) -> None:
    parser.add_argument("key", metavar="KEY", type=checked(_key), help=what)
    add_bus(parser, "tool")


def fill_view(parser: Parser) -> None:
    """Options of ``tactile view``."""
    parser.description = (
        "Serves a page that shows the boards of running tactileds, and a reach, as they are now; "
        "or a log. Tare, record and set the rate by button."
    )
    parser.epilog = VIEW_EPILOG
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    add = parser.add_argument
    add("log", nargs="*", type=Path, metavar="FILE.mcap", help="log to play (all files of it)")
    add(
        "--port",
        type=whole(most=65_535),
        default=VIEW_PORT,
        metavar="N",
        help=f"0: any (default {VIEW_PORT})",
    )
    add(
        "--bind",
        default="127.0.0.1",
        metavar="ADDRESS",
        help="address to serve at (default 127.0.0.1, which only this machine reaches); any other "
        "needs a token, which is made and printed",
    )
    add("--token", metavar="TEXT", help="the token to ask for, at least 16 characters")
    add(
        "--host-name",
        action="append",
        default=[],
        metavar="NAME",
        help="another name under which browsers reach this machine; may be repeated",
    )
    add("--read-only", action="store_true", help="show, but let nobody tare, record or stop")
    add("--until-stdin-ends", action="store_true", help=argparse.SUPPRESS)
    add_bus(parser, "tool")
    parser.set_defaults(func=later("tactile_tools.view.cli:run"))


def fill_list(parser: Parser) -> None:
    """Options of ``tactile list``."""
    parser.description = (
        "Listens for a moment and lists every key with its message type and rate, and the services "
        "of the daemons that are there."
    )
    parser.epilog = "exit status: 0 told; 3 nothing is there, or the bus cannot be joined."
    add_bus(parser, "tool")
    parser.set_defaults(func=_watching("list", "tactile_tools.list:list_bus"))


def fill_echo(parser: Parser) -> None:
    """Options of ``tactile echo``."""
    parser.description = "Prints every message of a key as one line of JSON with its key."
    parser.epilog = (
        "exit status: 0 ended; 2 bad argument; 3 the bus cannot be joined, or nothing came."
    )
    _add_key(parser)
    parser.add_argument("--count", type=count, metavar="N", help="end after so many messages")
    parser.add_argument(
        "--timeout", type=positive("s"), metavar="S", help="end, with 3, after so long a silence"
    )
    parser.add_argument(
        "--cdr",
        action="store_true",
        help="write the bytes of each message (CDR, as ROS 2 has them) after their length as four "
        "bytes, little-endian: for programs in other languages",
    )
    parser.set_defaults(func=_watching("echo", "tactile_tools.echo:echo"))


def fill_hz(parser: Parser) -> None:
    """Options of ``tactile hz``."""
    parser.description = (
        "Prints once a second, for each key: messages a second, the longest and the usual time "
        "between two, kB/s, and messages lost on the bus by their numbers."
    )
    parser.epilog = (
        "exit status: 0 ended; 2 bad argument; 3 the bus cannot be joined, or nothing came."
    )
    _add_key(parser)
    parser.add_argument(
        "--seconds", type=positive("s"), metavar="S", help="end after so long (default: Ctrl-C)"
    )
    parser.set_defaults(func=_watching("hz", "tactile_tools.hz:hz"))


def fill_call(parser: Parser) -> None:
    """Options of ``tactile call``."""
    parser.description = "Asks a service and prints its reply as JSON."
    parser.epilog = (
        "examples: tactile call tactile/left/srv/status; tactile call tactile/left/srv/tare "
        "'{\"force\": true}' --timeout 30. exit status: 0 answered; 2 bad argument; 3 nobody "
        "answered, or the service refused."
    )
    _add_key(parser, "of the service, as in tactile/left/srv/status (`tactile list`)")
    parser.add_argument(
        "request",
        nargs="?",
        type=checked(_json),
        default={},
        metavar="JSON",
        help="what is asked (an object)",
    )
    parser.add_argument(
        "--timeout", type=positive("s"), default=5.0, metavar="S", help="default 5 s"
    )
    parser.set_defaults(func=_watching("call", "tactile_tools.call:call"))


def fill_cpp_header(parser: Parser) -> None:
    """Options of ``tactile cpp-header``."""
    parser.description = (
        "Writes a header without dependencies: a struct for each message type of this project, "
        "and `tactile::decode<T>(bytes, size)`, which throws on bytes that are not one."
    )
    add_out(parser, "header to write (default: standard output)")
    parser.set_defaults(func=later("tactile_tools.cpp_header:run"))
