"""Command line of ``tactile calibrate``."""

from __future__ import annotations

import argparse
from pathlib import Path

from tactile_core.cli import (
    KINDS,
    Command,
    Parser,
    add_board,
    add_bus,
    add_commands,
    add_json,
    add_out,
    add_path,
    later,
    seconds,
    shown,
)

HERE = "tactile_tools.calibrate.cli"
ACTIONS = "tactile_tools.calibrate.actions"

COMMANDS = {
    "fit": Command("choose and fit a model, write a calibration file", f"{HERE}:_fit"),
    "evaluate": Command("errors of models on samples they were not fitted to", f"{HERE}:_evaluate"),
    "record": Command("record rest, presses and turns of a board for `fit`", f"{HERE}:_record"),
    "info": Command("what a calibration file says of itself", f"{HERE}:_info"),
}


def fill(parser: Parser) -> None:
    """Add the options of ``tactile calibrate``."""
    parser.description = (
        "Makes calibration files from recordings: a folder with sensor.csv and "
        "states.csv, or a log (.mcap) with a reference force in it, such as `record` writes."
    )
    add_commands(parser, COMMANDS)


def _info(parser: Parser) -> None:
    parser.add_argument("file", type=Path, metavar="FILE", help="a .cal.toml file")
    add_json(parser)
    parser.set_defaults(func=later(f"{ACTIONS}:info"))


def _add_recordings(parser: Parser) -> None:
    parser.former(name="board", target="measured")
    parser.add_argument(
        "recordings", type=Path, nargs="+", metavar="RECORDING", help="log, or folder of a CSV pair"
    )
    add_board(parser, "to read of a log that holds several")
    parser.add_argument(
        "--measured",
        choices=("normal", "shear"),
        help="what the load cell of a CSV pair measured (default: shear if the folder's name "
        "begins so, else normal)",
    )
    add_path(
        parser, "--report", "folder for pictures of what the model does, and a page that shows them"
    )


def _fit(parser: Parser) -> None:
    parser.description = (
        "Chooses among linear, cubic and history-aware models by cross-validation that "
        "leaves out blocks of time and whole recordings, fits the best to everything, and writes "
        "it with its error figures. Recordings of different targets (force, place) make one model "
        "each, in one file."
    )
    _add_recordings(parser)
    add_out(parser, "FILE.cal.toml to write", required=True, force="")
    parser.add_argument(
        "--serial", metavar="HEX", help="serial number of the board (a log has its own)"
    )
    parser.add_argument(
        "--base",
        type=Path,
        metavar="FILE",
        help="calibration to take places and matrices of taxels from (default: what the log was "
        "recorded with, or typical figures)",
    )
    parser.set_defaults(func=later(f"{ACTIONS}:fit_command"))


def _evaluate(parser: Parser) -> None:
    parser.description = (
        "tail20: each recording by itself, chosen and fitted on its first 80 % of "
        "frames, tested on the rest. leave-one-out: each recording whole, by a model of all the "
        "others. Labels of -1 (no reading) are not scored."
    )
    _add_recordings(parser)
    parser.add_argument("--split", choices=("tail20", "leave-one-out"), default="tail20")
    add_json(parser)
    parser.set_defaults(func=later(f"{ACTIONS}:evaluate_command"))


def _record(parser: Parser) -> None:
    parser.description = (
        "Records one board of a running tactiled (or, with --port, of its own) while "
        "you press it with known weights or a force gauge. Answers are read from standard input."
    )
    parser.former(name="board")
    add_out(parser, "FILE.mcap, new", required=True, force="")
    add_board(parser, "as tactiled has it (default board0)", default="board0", type=_not_a_kind)
    parser.add_argument(
        "--port", metavar="P", help="serial port to run tactiled on (default: one that runs)"
    )
    parser.add_argument(
        "--kind", default="auto", metavar="KIND", help="of board on --port (default auto)"
    )
    parser.add_argument(
        "--calibration", type=Path, metavar="FILE", help="what tactiled runs the board with"
    )
    for name, default, what in (
        ("rest", 4.0, "recorded of the untouched skin, before and after each press"),
        ("hold", 2.0, "recorded of each press"),
        ("turn", 20.0, "recorded of the turning board"),
    ):
        parser.add_argument(
            f"--{name}", type=seconds, default=default, metavar="S", help=f"s {what} ({default:g})"
        )
    add_bus(parser, "tool")
    parser.set_defaults(func=later(f"{ACTIONS}:record_command"))


def _not_a_kind(text: str) -> str:
    """Refuse a kind of board: --board took one before it came to mean a name in every command."""
    if text in KINDS or ":" in text:
        raise argparse.ArgumentTypeError(
            f"{shown(text)} is a kind of board, not a name: give it with --kind"
        )
    return text
