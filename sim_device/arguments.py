"""What ``simdevice`` can be told: options, units, defaults, and what is refused."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Mapping
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING

from sensor_proto.anyskin import MAX_MAGNETOMETERS
from sim_device.board.anyskin import SKETCHES
from sim_device.board.slcan_adapter import DIALECTS
from sim_device.world.engines import ENGINES
from tactile_core.arguments import Parser

if TYPE_CHECKING:
    Commands = argparse._SubParsersAction[argparse.ArgumentParser]

Handler = Callable[[argparse.Namespace], int]

ARM_HELP = """\
faults of the arm, parted by commas: silent, frozen, stale, biased, refuses_limits, backwards,
sideways, fast (it moves so, or 5 times as fast as it is told), fault, estop; each from the start,
@Ts or @Ts+Ds (T s after the start, for D s), such as silent@5s+1s,estop@8s.
fault and estop are given for 0.2 s where D is left out, and hold the arm until it is cleared.
noise of the arm, parted by commas: position (m), heading (rad), speed (m/s), turn (rad/s),
force (N), moment (N·m), each =STD, such as position=1e-4,force=0.1

services, JSON: arm/NAME/srv/claim {name, clock} and release grant who commands the arm;
arm/NAME/srv/limits {v_max, omega_max, f_max, m_max} (m/s, rad/s, N, N·m) and clear are its
commander's while it has one (reachd clears it for an operator: reach/NAME/srv/clear);
arm/NAME/srv/status; world/WORLD/srv/reset {seed} (left out: the same scene),
world/WORLD/srv/status. Objects, finger and goal are at world/WORLD/objects at 10 Hz.
"""

MAX_SPEED = 1000.0
"""Times real time; beyond, the terminal and not the recording sets the pace."""

FAULTS_HELP = """\
faults, parted by commas: flip=1e-5 (per bit), byteloss, byteinsert (per byte), loss, duplicate,
reorder, splice (per frame), delay=0.01:0.02s, silence@5s+2s, reset@8s, busoff@5s+1s (CAN),
copy@5s+2s (every third frame an old one), seed=N (default: the board's).
Chips: WHAT=ARRAY:TAXEL@Ts+Ds, TAXEL * for all, such as zeros=left:3@2s+5s; with :SHARE only that
share of readings, such as zeros=skin:*:0.05@4s. WHAT: stuck, saturated, failed (flagged, where the
board can); zeros, ones (failed reads), rail, wrap (over the end of 16 bits under a press), jump,
twin (another chip's bits), dither (dead but for the last bits), hot (99 °C), inf (anyskin only),
loose (its magnet has come off).
The whole skin: skinoff@4s+2s, newskin@6s (another skin is on from then), gain=1.67@4s (of all
chips), leap=2000@4s+2s (µT of a field that leaps: a magnet near)."""


def make_parser(handlers: Mapping[str, Handler]) -> argparse.ArgumentParser:
    """Parser whose result has the ``handler`` of its command, from ``handlers`` by name."""
    parser: argparse.ArgumentParser = Parser(
        "simdevice",
        description="Simulated taxel boards on pseudo-terminals and CAN buses, on their own or on "
        "the finger of a simulated arm in a cupboard.",
        epilog="Exit: 0 done (also on Ctrl-C, SIGTERM), 2 bad argument, 3 refused by the system.",
    )
    parser.add_argument(
        "--version", action="version", version=f"simdevice {version('tactile-reach')}"
    )
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")
    _add_boards(commands).set_defaults(handler=handlers["boards"])
    _add_cupboard(commands).set_defaults(handler=handlers["cupboard"])
    _add_replay(commands).set_defaults(handler=handlers["replay"])
    _add_calibration(commands).set_defaults(handler=handlers["calibration"])
    shown = commands.add_parser("version", help="print the version")
    shown.set_defaults(handler=handlers["version"])
    return parser


def _add_boards(commands: Commands) -> argparse.ArgumentParser:
    boards = commands.add_parser(
        "boards",
        help="simulate taxel boards",
        description="Simulate one board on every --pty and one for every --node on every bus. "
        "Board number k (from 0, in this order) has seed SEED + k.",
        epilog=FAULTS_HELP,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    ports = boards.add_argument_group("ports, each more than once")
    ports.add_argument(
        "--pty", action="append", default=[], type=Path, metavar="LINK",
        help="serial board on a pseudo-terminal; LINK becomes a symbolic link to it",
    )  # fmt: skip
    ports.add_argument(
        "--slcan", action="append", default=[], type=Path, metavar="LINK",
        help="boards behind a simulated USB-CAN adapter (slcan) on a pseudo-terminal",
    )  # fmt: skip
    ports.add_argument(
        "--can", action="append", default=[], type=_bus, metavar="BUS",
        help="boards on a bus of python-can: socketcan:vcan0, virtual:0 (same process only), "
        "with +fd for CAN FD",
    )  # fmt: skip
    ports.add_argument(
        "--node", action="append", default=[], type=_node, metavar="ID",
        help="node id of a board on every bus, 0 to 126; once for each board (default 1)",
    )  # fmt: skip
    ports.add_argument(
        "--fd", action="store_true",
        help="CAN FD on --slcan (default CAN 2.0B, which at 1 Mbit/s carries one finger at 60 Hz)",
    )  # fmt: skip
    ports.add_argument(
        "--adapter", choices=DIALECTS, default="lawicel", metavar="DIALECT",
        help=f"firmware of the --slcan adapters: {', '.join(DIALECTS)} (default lawicel)",
    )  # fmt: skip
    who = boards.add_argument_group("boards")
    _add_identity(who)
    who.add_argument(
        "--format", default="", metavar="FORMAT",
        help=f"how anyskin boards write: {', '.join(SKETCHES)} (default anyskin), or a layout such "
        "as floats:5xyz,end=lf (see tactiled --help)",
    )  # fmt: skip
    who.add_argument(
        "--banner", action="store_true",
        help="anyskin boards print text at the start and now and then between their frames",
    )  # fmt: skip
    who.add_argument(
        "--rate", type=_number(0.1, 1000), metavar="HZ",
        help="sample rate after power-on in Hz (default 100; anyskin: its loop, 115)",
    )  # fmt: skip
    world = boards.add_argument_group("surroundings and faults")
    world.add_argument("--press", type=Path, metavar="FILE.toml", help="script of an indenter")
    world.add_argument(
        "--rotate", type=_rotation, metavar="ANGLE/TIME[@AXIS]",
        help="steady turn in the earth's field, such as 90deg/10s or 0.2rad/s@y (default none)",
    )  # fmt: skip
    world.add_argument(
        "--temperature", type=_number(-40, 85), default=23.0, metavar="C",
        help="room temperature in °C (default 23); boards warm 4 K above it",
    )  # fmt: skip
    world.add_argument(
        "--field", type=_number(0, 1000), default=50.0, metavar="UT",
        help="magnitude of the earth's field in µT (default 50)",
    )  # fmt: skip
    world.add_argument("--faults", default="", metavar="SPEC", help="faults to inject, see below")
    world.add_argument(
        "--unplug", action="append", default=[], type=_window, metavar="Ts+Ds",
        help="take --pty boards away T s after the start for D s, such as 5s+1s; more than once",
    )  # fmt: skip
    _add_duration(boards)
    return boards


def _add_cupboard(commands: Commands) -> argparse.ArgumentParser:
    from tactile_core.options import add_bus

    cupboard = commands.add_parser(
        "cupboard",
        help="simulate a cluttered cupboard with an arm and its finger boards",
        description="Simulate a cluttered cupboard and an arm whose finger reaches into it, in "
        "real time: the taxels of the finger's boards on --pty and --slcan, the arm over zenoh.",
        epilog=ARM_HELP + FAULTS_HELP,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = cupboard.add_argument_group("world").add_argument
    add(
        "--scene", default="authors_sim", metavar="SCENE",
        help="authors_sim, hardware, authors_sim_recorded, recorded:FILE.json.gz, or FILE.json "
        "(default authors_sim)",
    )  # fmt: skip
    add(
        "--seed", type=_whole, default=0, metavar="N",
        help="of scene (its number, of recorded ones), boards and noise (default 0); board number "
        "k has N + k",
    )  # fmt: skip
    add(
        "--engine", choices=ENGINES, default=ENGINES[0],
        help=f"physics engine (default {ENGINES[0]})",
    )  # fmt: skip
    add(
        "--world", default="world", metavar="WORLD",
        help="name of the world on the bus (default world)",
    )  # fmt: skip
    add("--print-goal", action="store_true", help="print the scene's goal as X,Y in m, and end")
    boards = cupboard.add_argument_group("boards of the finger, each more than once")
    boards.add_argument(
        "--pty", action="append", default=[], type=Path, metavar="LINK",
        help="board on a pseudo-terminal; LINK becomes a symbolic link to it",
    )  # fmt: skip
    boards.add_argument(
        "--slcan", action="append", default=[], type=Path, metavar="LINK",
        help="board behind a simulated USB-CAN adapter (slcan) on a pseudo-terminal",
    )  # fmt: skip
    boards.add_argument(
        "--fd", action="store_true",
        help="CAN FD on --slcan (default CAN 2.0B, which at 1 Mbit/s carries one finger at 60 Hz)",
    )  # fmt: skip
    boards.add_argument(
        "--rate", type=_number(0.1, 1000), metavar="HZ",
        help="sample rate after power-on in Hz (default 100)",
    )  # fmt: skip
    boards.add_argument("--faults", default="", metavar="SPEC", help="faults to inject, see below")
    add = cupboard.add_argument_group("arm").add_argument
    add("--arm", default="arm", metavar="NAME", help="its name on the bus (default arm)")
    add(
        "--arm-rate", type=int, choices=(100, 200), default=100,
        help="states a second (default 100)",
    )  # fmt: skip
    add(
        "--arm-latency", type=_number(0, 10), default=0.0, metavar="S",
        help="s each way: from a command's receipt to its effect, and from a state's capture to "
        "its sending (default 0)",
    )  # fmt: skip
    add("--arm-noise", default="", metavar="SPEC", help="noise of its sensors, see below")
    add("--arm-fault", default="", metavar="SPEC", help="faults to inject, see below")
    add_bus(cupboard, "arm")
    _add_duration(cupboard)
    return cupboard


def _add_replay(commands: Commands) -> argparse.ArgumentParser:
    replay = commands.add_parser(
        "replay",
        help="send a recording of a real board again",
        description="Send a recorded CSV (plain or .gz: time in s, then x, y, z in µT for each of\n"
        "1 to 20 magnetometers) as the frames of an AnySkin board, at the recorded times. It\n"
        "begins when a host reads, so that nothing is lost. Recordings hold no temperatures:\n"
        "25 °C is sent for all.",
        epilog=FAULTS_HELP,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    replay.add_argument("recording", type=Path, metavar="RECORDING.csv")
    replay.add_argument(
        "--as", dest="kind", choices=["anyskin"], default="anyskin",
        help="board to play (default anyskin)",
    )  # fmt: skip
    replay.add_argument(
        "--pty", type=Path, required=True, metavar="LINK",
        help="symbolic link to make to the pseudo-terminal",
    )  # fmt: skip
    replay.add_argument(
        "--speed", type=_number(1 / MAX_SPEED, MAX_SPEED), default=1.0, metavar="N",
        help="times real time, 0.001 to 1000 (default 1)",
    )  # fmt: skip
    replay.add_argument("--loop", action="store_true", help="begin again at the end (default: end)")
    replay.add_argument(
        "--faults", default="", metavar="SPEC",
        help="faults to inject, at times of the recording, see below; its chips are skin:0 and so "
        "on",
    )  # fmt: skip
    _add_duration(replay)
    return replay


def _add_calibration(commands: Commands) -> argparse.ArgumentParser:
    calibration = commands.add_parser(
        "calibration",
        help="write the calibration that belongs to a simulated board",
        description="Write the factory calibration of exactly the board that `simdevice boards` "
        "simulates with the same --board and --seed (its first one; the k-th has SEED + k).",
    )
    calibration.add_argument(
        "--out", type=Path, required=True, metavar="FILE.cal.toml", help="file to write"
    )
    calibration.add_argument(
        "--force", action="store_true", help="replace a file that is no calibration of this board"
    )
    _add_identity(calibration)
    return calibration


def _add_identity(group: argparse._ActionsContainer) -> None:
    group.add_argument(
        "--board", choices=["finger", "anyskin"], default="finger",
        help="finger: 80 taxels, our protocol; anyskin: 5 magnetometers, floats (default finger)",
    )  # fmt: skip
    group.add_argument(
        "--arrays", type=_arrays, metavar="N+N",
        help="magnetometers of each board on one anyskin controller, as in 5+5 (default 5)",
    )  # fmt: skip
    group.add_argument(
        "--seed", type=_whole, default=0, metavar="N",
        help="which board: tolerances, noise and faults follow from it (default 0)",
    )  # fmt: skip
    group.add_argument(
        "--serial", action="append", default=[], type=_serial, metavar="HEX",
        help="serial number, up to 16 hex digits; once for each board (default: from the seed)",
    )  # fmt: skip


def _add_duration(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--duration", type=_number(0.001, 1e9), metavar="S", help="end after S s (default: never)"
    )


def _checked(parse: Callable[[str], object]) -> Callable[[str], object]:
    """``parse`` for argparse, which shows the message of this error only."""

    def convert(text: str) -> object:
        try:
            return parse(text)
        except ValueError as error:
            raise argparse.ArgumentTypeError(str(error)) from error

    return convert


def _number(low: float, high: float) -> Callable[[str], object]:
    def parse(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not low <= value <= high:
            raise ValueError(f"{text!r} given; allowed: a number from {low:g} to {high:g}")
        return value

    return _checked(parse)


def _parse_whole(text: str, high: float = 2**32) -> int:
    if not text.isdecimal() or int(text) > high:
        raise ValueError(f"{text!r} given; allowed: a whole number from 0 to {high}")
    return int(text)


def _parse_bus(text: str) -> object:
    from tactile_core.can_bus import CanSpec

    spec = CanSpec.parse(text)
    if spec.interface == "slcan":
        raise ValueError(f"{text!r} given; to play an slcan adapter use --slcan LINK")
    return spec


def _parse_rotation(text: str) -> str:
    from sim_device.skin.environment import parse_rotation

    parse_rotation(text)
    return text


def _parse_window(text: str) -> object:
    from sim_device.ports_plan import parse_window

    return parse_window(text)


def _parse_serial(text: str) -> bytes:
    from sim_device.ports_plan import parse_serial

    return parse_serial(text)


def _parse_arrays(text: str) -> tuple[int, ...]:
    words = text.split("+")
    if not all(word.isdecimal() and int(word) for word in words):
        raise ValueError(f"{text!r} given; allowed: numbers above 0 joined by +, as in 5+5")
    sizes = tuple(int(word) for word in words)
    if sum(sizes) > MAX_MAGNETOMETERS:
        raise ValueError(f"{text!r} given; allowed: at most {MAX_MAGNETOMETERS} magnetometers")
    return sizes


_arrays = _checked(_parse_arrays)
_whole = _checked(_parse_whole)
_node = _checked(lambda text: _parse_whole(text, 126))
_bus = _checked(_parse_bus)
_rotation = _checked(_parse_rotation)
_window = _checked(_parse_window)
_serial = _checked(_parse_serial)
