"""The flags of tactiled."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

from tactile_core.arguments import Parser
from tactile_core.options import add_log_and_bus, finite_above_zero
from tactiled.boards.line import KINDS, board_kind
from tactiled.sensing.settings import METHODS
from tactiled.settings import DEFAULT_BAUD, array_sizes

EPILOG = """\
examples:
  tactiled --port /dev/ttyACM0
  tactiled --port /dev/ttyACM0 --name left --port /dev/ttyACM1 --name right
  tactiled --can slcan:/dev/ttyACM1@1000000
  tactiled --can socketcan:can0 --calibration left.cal.toml --calibration right.cal.toml
  tactiled --mcap tactile-logs/board0_20250101T120000Z_0000.mcap

boards that write in a way of their own are declared with
--board KIND:nFIELDS[,OPTION...]:
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


class _Port(argparse.Action):
    """Collects --port and --can in one list, in the order in which they were given."""

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
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("--version", action="version", version=f"tactiled {version('tactile-reach')}")
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
        "--board",
        action="append",
        type=_kind,
        metavar="KIND",
        help=f"what is on a serial port: {', '.join(KINDS)} (default auto: found out), or how it "
        "writes, as in floats:5xyz, text:5txyz, int16:5xyz,big,scale=0.15/0.242 (see below); once "
        "for all ports, or for each",
    )
    add(
        "--arrays",
        action="append",
        type=_arrays,
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
        type=_whole("bit/s"),
        metavar="BIT/S",
        help=f"of a serial port with a UART (default {DEFAULT_BAUD}); USB boards ignore it",
    )
    add(
        "--rate",
        type=_above("Hz"),
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
        help="how the earth's field is taken off (default consensus)",
    )
    add(
        "--compensation-rate",
        type=_above("Hz"),
        metavar="HZ",
        help="new fits a second (default: every frame; 3 Hz for ransac, as in the paper)",
    )
    add(
        "--feature-rate",
        type=_above("Hz"),
        metavar="HZ",
        help="contact features a second (default: every frame; the paper has 15 Hz)",
    )

    add_log_and_bus(parser, "tactiled")

    group = parser.add_argument_group("running")
    add = group.add_argument
    add("--duration", type=_above("s"), metavar="S", help="stop after this many seconds")
    add(
        "--mcap",
        type=Path,
        metavar="FILE",
        help="replay the raw data of a log, published under replay/...",
    )
    add(
        "--speed",
        type=_speed,
        default=1.0,
        metavar="X",
        help="of a replay: times real time, or inf (default 1)",
    )
    add("--verbose", action="store_true", help="say more")
    return parser


def _kind(text: str) -> str:
    try:
        board_kind(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from error
    return text


def _arrays(text: str) -> tuple[int, ...]:
    try:
        return array_sizes(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from error


def _above(unit: str) -> Callable[[str], float]:
    return lambda text: finite_above_zero(text, unit)


def _whole(unit: str) -> Callable[[str], int]:
    def parse(text: str) -> int:
        if not text.isdecimal() or int(text) == 0:
            raise argparse.ArgumentTypeError(
                f"{text} given; allowed: a whole number of {unit} above 0"
            )
        return int(text)

    return parse


def _speed(text: str) -> float:
    return math.inf if text.lower() == "inf" else finite_above_zero(text, "times real time")
