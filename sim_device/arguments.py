"""Command line of ``simdevice``: options, units, defaults and checks."""

from __future__ import annotations

import argparse
from pathlib import Path

from sim_device.world.engines import ENGINES
from tactile_core.cli import (
    Command,
    Parser,
    add_bus,
    add_commands,
    add_out,
    add_path,
    add_seeds,
    later,
    loaded,
    number,
    seconds,
    whole,
)
from tactile_core.daemon import Shutdown

DIALECTS = (
    "lawicel",
    "canable",
    "println",
    "late",
    "candapter",
    "lower",
    "stamps",
    "plain",
    "canable2.5",
    "overrun",
    "buserror",
)
"""Firmware of CAN adapters. Repeats the names in `sim_device.board.slcan_adapter`, so that parsing
need not import it; a test compares the two. The same holds for `SKETCHES`."""

SKETCHES = (
    "anyskin",
    "anyskin-text",
    "reskin-text",
    "eflesh-text",
    "touch-text",
    "labels-text",
    "adafruit-text",
)
"""Output formats of published sketches, as in `sim_device.board.anyskin`."""

COMMANDS = {
    "boards": Command("simulate taxel boards", "sim_device.arguments:_fill_boards"),
    "cupboard": Command(
        "simulate a cupboard with an arm and its finger boards",
        "sim_device.arguments:_fill_cupboard",
    ),
    "ur": Command(
        "emulate a robot of Universal Robots that holds the finger",
        "sim_device.arguments:_fill_ur",
    ),
    "xarm": Command(
        "emulate an xArm of UFACTORY that holds the finger", "sim_device.arguments:_fill_xarm"
    ),
    "replay": Command(
        "send a recording of a real board again", "sim_device.arguments:_fill_replay"
    ),
    "calibration": Command(
        "write the calibration that belongs to a simulated board",
        "sim_device.arguments:_fill_calibration",
    ),
    "version": Command("print the version", "sim_device.arguments:_fill_version"),
}

ARM_HELP = """\
faults of the arm, separated by commas: silent, frozen, stale, biased, refuses_limits, backwards,
sideways (it moves that way), fast (5 times as fast as commanded), fault, estop; each from the
start, @Ts or @Ts+Ds (T s after the start, for D s), such as silent@5s+1s,estop@8s.
fault and estop last 0.2 s without +Ds, and hold the arm until it is cleared.
noise of the arm, separated by commas: position (m), heading (rad), speed (m/s), turn (rad/s),
force (N), moment (N·m), each =STD, such as position=1e-4,force=0.1

services, JSON: arm/NAME/srv/claim {name, clock} and release take and give up command of the arm;
arm/NAME/srv/limits {v_max, omega_max, f_max, m_max} (m/s, rad/s, N, N·m) and clear are for its
commander only, if it has one (reachd clears it for an operator: reach/NAME/srv/clear);
arm/NAME/srv/status; world/WORLD/srv/reset {seed} (left out: the same scene),
world/WORLD/srv/status. Objects, finger and goal are at world/WORLD/objects at 10 Hz.
"""

MAX_SPEED = 1000.0
"""Times real time; beyond this, the terminal limits the speed."""

FAULTS_HELP = """\
faults, separated by commas: flip=1e-5 (per bit), byteloss, byteinsert (per byte), loss, duplicate,
reorder, splice (per frame), delay=0.01:0.02s, silence@5s+2s, reset@8s, busoff@5s+1s (CAN),
copy@5s+2s (every third frame an old one), seed=N (default: the board's).
Chips: WHAT=ARRAY:TAXEL@Ts+Ds, TAXEL * for all, such as zeros=left:3@2s+5s; with :SHARE only that
share of readings, such as zeros=skin:*:0.05@4s. WHAT: stuck, saturated, failed (flagged, where the
board can); zeros, ones (failed reads), rail, wrap (over the end of 16 bits under a press), jump,
twin (another chip's bits), dither (dead but for the last bits), hot (99 °C), inf (anyskin only),
loose (its magnet has come off).
The whole skin: skinoff@4s+2s, newskin@6s (another skin is on from then), gain=1.67@4s (of all
chips), leap=2000@4s+2s (µT of a field that leaps: a magnet near)."""


def make_parser(shutdown: Shutdown | None = None) -> argparse.ArgumentParser:
    """Parser of the command line; ``shutdown``: whether the process is told to end."""
    parser = Parser(
        "simdevice",
        description="Simulated taxel boards on pseudo-terminals and CAN buses, on their own or on "
        "the finger of a simulated arm in a cupboard.",
        epilog="Exit: 0 done (also on Ctrl-C, SIGTERM), 2 bad argument, 3 refused by the system.",
    )
    parser.show_version()
    add_commands(parser, COMMANDS)
    parser.set_defaults(shutdown=shutdown)
    return parser


def _describe(
    parser: argparse.ArgumentParser, handler: str, description: str, epilog: str | None = None
) -> None:
    parser.description, parser.epilog = description, epilog
    parser.set_defaults(func=later(f"sim_device.cli:{handler}"))


def _fill_version(parser: argparse.ArgumentParser) -> None:
    parser.set_defaults(func=later("sim_device.cli:print_version"))


def _fill_boards(boards: Parser) -> None:
    _describe(
        boards,
        "boards",
        "Simulate one board on every --pty and one for every --node on every bus. "
        "Board number k (from 0, in this order) has seed SEED + k.",
        FAULTS_HELP,
    )
    boards.former(board="kind", format="layout")
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
        "--can", action="append", default=[], metavar="SPEC",
        type=loaded("sim_device.ports_plan:parse_bus"),
        help="boards on a bus of python-can: socketcan:vcan0, virtual:0 (same process only), "
        "with +fd for CAN FD",
    )  # fmt: skip
    ports.add_argument(
        "--node", action="append", default=[], type=whole(most=126), metavar="ID",
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
        "--layout", default="", metavar="LAYOUT",
        help=f"how anyskin boards write: {', '.join(SKETCHES)} (default anyskin), or a layout such "
        "as floats:5xyz,end=lf (see tactiled --help)",
    )  # fmt: skip
    who.add_argument(
        "--banner", action="store_true",
        help="anyskin boards print text at the start and now and then between their frames",
    )  # fmt: skip
    who.add_argument(
        "--rate", type=number("Hz", least=0.1, most=1000), metavar="HZ",
        help="sample rate after power-on in Hz (default 100; anyskin: its loop, 115)",
    )  # fmt: skip
    world = boards.add_argument_group("surroundings and faults")
    add_path(world, "--press", "script of an indenter, TOML")
    world.add_argument(
        "--rotate", metavar="ANGLE/TIME[@AXIS]",
        type=loaded("sim_device.skin.environment:check_rotation"),
        help="steady turn in the earth's field, such as 90deg/10s or 0.2rad/s@y (default none)",
    )  # fmt: skip
    world.add_argument(
        "--temperature", type=number("°C", least=-40, most=85), default=23.0, metavar="C",
        help="room temperature in °C (default 23); boards warm 4 K above it",
    )  # fmt: skip
    world.add_argument(
        "--field", type=number("µT", least=0, most=1000), default=50.0, metavar="UT",
        help="magnitude of the earth's field in µT (default 50)",
    )  # fmt: skip
    world.add_argument("--faults", default="", metavar="SPEC", help="faults to inject, see below")
    world.add_argument(
        "--unplug", action="append", default=[], metavar="Ts+Ds",
        type=loaded("sim_device.ports_plan:parse_window"),
        help="take --pty boards away T s after the start for D s, such as 5s+1s; more than once",
    )  # fmt: skip
    _add_duration(boards)


def _fill_cupboard(cupboard: Parser) -> None:
    _describe(
        cupboard,
        "cupboard",
        "Simulate a cluttered cupboard and an arm whose finger reaches into it, in real "
        "time: the taxels of the finger's boards on --pty and --slcan, the arm over zenoh.",
        ARM_HELP + FAULTS_HELP,
    )
    world = cupboard.add_argument_group("world")
    add = world.add_argument
    add(
        "--scene", default="authors_sim", metavar="SCENE",
        help="authors_sim, hardware, authors_sim_recorded, recorded:FILE.json.gz, or FILE.json "
        "(default authors_sim)",
    )  # fmt: skip
    add_seeds(world, what="of boards and noise, board number k has N + k")
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
        "--rate", type=number("Hz", least=0.1, most=1000), metavar="HZ",
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
        "--arm-latency", type=number("s", least=0, most=10), default=0.0, metavar="S",
        help="s each way: from a command's receipt to its effect, and from a state's capture to "
        "its sending (default 0)",
    )  # fmt: skip
    add("--arm-noise", default="", metavar="SPEC", help="noise of its sensors, see below")
    add("--arm-fault", default="", metavar="SPEC", help="faults to inject, see below")
    add_bus(cupboard, "arm")
    _add_duration(cupboard)


def _fill_ur(robot: Parser) -> None:
    _fill_robot(robot, "ur", "a robot of Universal Robots")


def _fill_xarm(robot: Parser) -> None:
    _fill_robot(robot, "xarm", "an xArm of UFACTORY")


def _fill_robot(robot: Parser, kind: str, words: str) -> None:
    _describe(
        robot,
        "robot",
        f"Emulate the controller of {words}, as its vendor's client sees it on the network, for "
        "armd to drive. It holds the finger, whose taxels are on --pty, in the cupboard of --scene "
        "or in free air. It proves nothing about the safety of a real robot.",
        "With --control a line on standard input lets something happen: freeze S (of the network), "
        "mirror, true, place X Y H, mark, and what the answer to help lists. Each is answered with "
        "the robot's time.",
    )
    robot.set_defaults(kind=kind)
    group = robot.add_argument_group("robot")
    group.add_argument(
        "--config", type=Path, required=True, metavar="FILE",
        help="that of armd: tool, payload and where the cupboard is",
    )  # fmt: skip
    group.add_argument(
        "--address", default="127.0.0.1", metavar="IP",
        help="loopback address to listen at: 127.0.0.2 and so on for more (default 127.0.0.1)",
    )  # fmt: skip
    group.add_argument(
        "--latency", type=number("s", least=0, most=1), default=0.0, metavar="S",
        help="s a message takes each way (default 0)",
    )  # fmt: skip
    group.add_argument(
        "--loss", type=number(least=0, most=0.5), default=0.0, metavar="P",
        help="share of messages that are lost and sent again 0.2 s later (default 0)",
    )  # fmt: skip
    group.add_argument(
        "--stop-force", type=number("N", least=1, most=1000), default=100.0, metavar="N",
        help="N at which it stops for protection (default 100)",
    )  # fmt: skip
    add_path(group, "--truth", "file: where the tool really was is written to it, each cycle")
    group.add_argument("--control", action="store_true", help="take faults from standard input")
    world = robot.add_argument_group("world")
    world.add_argument(
        "--scene", metavar="SCENE",
        help="authors_sim, hardware, recorded:FILE.json.gz or FILE.json (default: free air)",
    )  # fmt: skip
    add_seeds(world, what="of boards, board number k has N + k")
    world.add_argument(
        "--engine", choices=ENGINES, default=ENGINES[0],
        help=f"physics engine (default {ENGINES[0]})",
    )  # fmt: skip
    world.add_argument(
        "--world", metavar="WORLD",
        help="publish its objects on the bus, as world/WORLD/objects (default: no bus is joined)",
    )  # fmt: skip
    boards = robot.add_argument_group("boards of the finger, each more than once")
    boards.add_argument(
        "--pty", action="append", default=[], type=Path, metavar="LINK",
        help="board on a pseudo-terminal; LINK becomes a symbolic link to it",
    )  # fmt: skip
    add_bus(robot, "tool")
    _add_duration(robot)


def _fill_replay(replay: argparse.ArgumentParser) -> None:
    _describe(
        replay,
        "replay",
        "Send a recorded CSV (plain or .gz: time in s, then x, y, z in µT for each of "
        "1 to 20 magnetometers) as the frames of an AnySkin board, at the recorded times. It "
        "begins when a host reads, so that nothing is lost. Recordings hold no temperatures: "
        "25 °C is sent for all.",
        FAULTS_HELP,
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
        "--speed", metavar="X", type=number(least=1 / MAX_SPEED, most=MAX_SPEED), default=1.0,
        help="times real time, 0.001 to 1000 (default 1)",
    )  # fmt: skip
    replay.add_argument("--loop", action="store_true", help="begin again at the end (default: end)")
    replay.add_argument(
        "--faults", default="", metavar="SPEC",
        help="faults to inject, at times of the recording, see below; its chips are skin:0 and so "
        "on",
    )  # fmt: skip
    _add_duration(replay)


def _fill_calibration(calibration: Parser) -> None:
    _describe(
        calibration,
        "calibration",
        "Write the factory calibration of exactly the board that `simdevice boards` "
        "simulates with the same --kind and --seed (its first one; the k-th has SEED + k).",
    )
    calibration.former(board="kind")
    add_out(
        calibration,
        "FILE.cal.toml to write",
        required=True,
        force="replace a file that is not a calibration of this board",
    )
    _add_identity(calibration)


def _add_identity(group: argparse._ActionsContainer) -> None:
    group.add_argument(
        "--kind", choices=["finger", "anyskin"], default="finger",
        help="finger: 80 taxels, our protocol; anyskin: 5 magnetometers, floats (default finger)",
    )  # fmt: skip
    group.add_argument(
        "--arrays", type=loaded("sim_device.ports_plan:parse_arrays"), metavar="N+N",
        help="magnetometers of each board on one anyskin controller, as in 5+5 (default 5)",
    )  # fmt: skip
    add_seeds(group, what="which board: tolerances, noise and faults follow from it", scene=False)
    group.add_argument(
        "--serial", action="append", default=[], metavar="HEX",
        type=loaded("sim_device.ports_plan:parse_serial"),
        help="serial number, up to 16 hex digits; once for each board (default: from the seed)",
    )  # fmt: skip


def _add_duration(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--duration", type=seconds, metavar="S", help="end after S s (default: never)"
    )
