"""The flags of tactiled."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from tactile_core.cli import (
    KINDS,
    Parser,
    add_log_and_bus,
    hertz,
    loaded,
    seconds,
    speed,
    whole,
)
from tactiled.sensing import METHODS

DEFAULT_BAUD = 115_200

EPILOG = """\
examples:
  tactiled --port /dev/ttyACM0
  tactiled --port /dev/ttyACM0 --name left --port /dev/ttyACM1 --name right
  tactiled --can slcan:/dev/ttyACM1@1000000
  tactiled --can socketcan:can0 --calibration left.cal.toml --calibration right.cal.toml
  tactiled --mcap tactile-logs/board0_20250101T120000Z_0000.mcap

boards that write in a way of their own are declared with
--kind KIND:nFIELDS[,OPTION...]:
  KIND     floats, doubles (IEEE), int16, uint16 (less 32768), int32, text
  n        chips (magnetometers), 1 to 20
  FIELDS   order of each chip's numbers: x y z in uT, t in C (may be left
           out), _ for one that is not used
  big      high byte first
  scale=XY/Z  uT a count (default 0.15/0.242)
  start=HEX, skip=BYTES, check=xor|sum, tail=BYTES, end=crlf|lf|cr|none|HEX
           what stands round the numbers of a binary frame; without any of
           them it is found out
  lead=N   numbers of a text line before those of the chips
  lines=N  lines of one frame of text

exit status: 0 done; 1 failed while running, or the log did; 2 bad argument or configuration;
3 refused by the environment: port missing, busy or not permitted, no board or the wrong one, log
not writable.
"""


VIEW_PORT = 8420
"""Default TCP port of the live page."""


class _Port(argparse.Action):
    """Collects --port and --can in one list, in the order given."""

    def __call__(
        self,
        parser: argparse.ArgumentParser,  # noqa: ARG002 - argparse passes it
        namespace: argparse.Namespace,
        values: str | Sequence[Any] | None,
        option_string: str | None = None,
    ) -> None:
        """Append (medium, spec)."""
        ports = list(getattr(namespace, "ports", None) or [])
        medium = "can" if option_string == "--can" else "serial"
        namespace.ports = [*ports, (medium, values)]


def make_parser() -> argparse.ArgumentParser:
    """Parser of the command line."""
    parser = Parser(
        prog="tactiled",
        usage="tactiled --port P | --can SPEC | --mcap FILE | --config FILE [option ...]",
        description="Reads taxel boards and publishes and logs calibrated forces and contact "
        "features.",
        epilog=EPILOG,
    )
    add = parser.add_argument
    parser.show_version()
    parser.former(board="kind")
    add("--list-ports", action="store_true", help="list serial ports and CAN interfaces, and exit")
    add("--config", type=Path, metavar="FILE", help="TOML file; flags win over it")

    group = parser.add_argument_group("boards")
    add = group.add_argument
    add(
        "--port",
        dest="ports",
        action=_Port,
        metavar="P",
        help="serial port, or usb:SERIAL_NUMBER; may be repeated",
    )
    add(
        "--can",
        dest="ports",
        action=_Port,
        metavar="SPEC",
        help="CAN bus INTERFACE:CHANNEL[@BITRATE][+fd], any python-can interface; may be repeated",
    )
    add(
        "--kind",
        action="append",
        type=loaded("tactiled.boards.line:kind_text"),
        metavar="KIND",
        help=f"what is on a serial port: {', '.join(KINDS)} (default auto: found out), or how it "
        "writes, as in floats:5xyz, text:5txyz, int16:5xyz,big,scale=0.15/0.242 (see below); once "
        "for all ports, or for each",
    )
    add(
        "--arrays",
        action="append",
        type=loaded("tactiled.settings:array_sizes"),
        metavar="N+N",
        help="magnetometers of each AnySkin board on one controller, as in 5+5 (default: as the "
        "calibration file says, else fives)",
    )
    add(
        "--name",
        action="append",
        metavar="NAME",
        help="name of each port's board in keys and logs (default board0, board1, ...)",
    )
    add(
        "--baud",
        action="append",
        type=whole("bit/s", least=1),
        metavar="BIT/S",
        help=f"of a serial port with a UART (default {DEFAULT_BAUD}); USB boards ignore it",
    )
    add(
        "--rate",
        type=hertz,
        metavar="HZ",
        help="sample rate to set (default: the board's own)",
    )
    add(
        "--calibration",
        action="append",
        type=Path,
        metavar="FILE",
        help="*.cal.toml, matched to boards by serial number; may be repeated (default: nominal "
        "figures, tared at the start)",
    )
    add(
        "--wait",
        action="store_true",
        help="wait for ports and boards that are not there instead of exiting with 3",
    )

    group = parser.add_argument_group("sensing")
    add = group.add_argument
    add(
        "--compensation",
        choices=METHODS,
        help="how the earth's field is removed (default consensus)",
    )
    add(
        "--compensation-rate",
        type=hertz,
        metavar="HZ",
        help="new fits a second (default: every frame; 3 Hz for ransac, as in the paper)",
    )
    add(
        "--feature-rate",
        type=hertz,
        metavar="HZ",
        help="contact features a second (default: every frame; the paper has 15 Hz)",
    )

    add_log_and_bus(parser, "tactiled")

    group = parser.add_argument_group("running")
    add = group.add_argument
    add("--duration", type=seconds, metavar="S", help="stop after this many seconds")
    add(
        "--mcap",
        type=Path,
        metavar="FILE",
        help="replay the raw data of a log, published under replay/...",
    )
    add(
        "--speed",
        type=speed,
        default=1.0,
        metavar="X",
        help="of a replay: times real time, or inf (default 1)",
    )
    add(
        "--view",
        type=whole(most=65_535),
        nargs="?",
        const=VIEW_PORT,
        metavar="PORT",
        help=f"open the live page, too: http://127.0.0.1:PORT (default {VIEW_PORT}; 0: any)",
    )
    add("--verbose", action="store_true", help="say more")
    return parser
