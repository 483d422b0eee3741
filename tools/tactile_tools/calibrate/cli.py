"""``tactile calibrate``: fit, evaluate, info, record."""

from __future__ import annotations

import argparse
from pathlib import Path

from tactile_core.options import add_bus, finite_above_zero
from tactile_tools.calibrate import actions


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add ``calibrate`` to the umbrella command."""
    parser = subparsers.add_parser(
        "calibrate",
        help="fit models of a board's own force to recordings, and judge them",
        description="Makes calibration files from recordings: a folder with sensor.csv and "
        "states.csv, or a log (.mcap) with a reference force in it, such as `record` writes.",
    )
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    _add_fit(commands)
    _add_evaluate(commands)
    _add_record(commands)
    info = commands.add_parser("info", help="what a calibration file says of itself")
    info.add_argument("file", type=Path, metavar="FILE", help="a .cal.toml file")
    info.add_argument("--json", action="store_true", help="as JSON on standard output")
    info.set_defaults(func=actions.info)


def _add_recordings(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "recordings", type=Path, nargs="+", metavar="RECORDING", help="log, or folder of a CSV pair"
    )
    parser.add_argument("--name", help="board to read of a log that holds several")
    parser.add_argument(
        "--target",
        choices=("normal", "shear"),
        help="what the load cell of a CSV pair measured (default: shear if the folder's name "
        "begins so, else normal)",
    )
    parser.add_argument(
        "--report",
        type=Path,
        metavar="FOLDER",
        help="write pictures of what the model does, and a page that shows them, to FOLDER",
    )


def _add_fit(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = commands.add_parser(
        "fit",
        help="choose and fit a model, write a calibration file",
        description="Chooses among linear, cubic and history-aware models by cross-validation that "
        "leaves out blocks of time and whole recordings, fits the best to everything, and writes "
        "it with its error figures. Recordings of different targets (force, place) make one model "
        "each, in one file.",
    )
    _add_recordings(parser)
    parser.add_argument("--out", type=Path, required=True, metavar="FILE", help="FILE.cal.toml")
    parser.add_argument("--serial", help="serial number of the board (a log has its own)")
    parser.add_argument(
        "--base",
        type=Path,
        metavar="FILE",
        help="calibration to take places and matrices of taxels from (default: what the log was "
        "recorded with, or typical figures)",
    )
    parser.set_defaults(func=actions.fit_command)


def _add_evaluate(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = commands.add_parser(
        "evaluate",
        help="errors of models on samples they were not fitted to",
        description="tail20: each recording by itself, chosen and fitted on its first 80 % of "
        "frames, tested on the rest. leave-one-out: each recording whole, by a model of all the "
        "others. Labels of -1 (no reading) are not scored.",
    )
    _add_recordings(parser)
    parser.add_argument("--split", choices=("tail20", "leave-one-out"), default="tail20")
    parser.add_argument("--json", action="store_true", help="as JSON on standard output")
    parser.set_defaults(func=actions.evaluate_command)


def _add_record(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = commands.add_parser(
        "record",
        help="ask for rest, presses and turns, and record them for `fit`",
        description="Records one board of a running tactiled (or, with --port, of its own) while "
        "you press it with known weights or a force gauge. Answers are read from standard input.",
    )
    parser.add_argument("--out", type=Path, required=True, metavar="FILE", help="FILE.mcap, new")
    parser.add_argument("--name", default="board0", help="board, as tactiled names it (board0)")
    parser.add_argument("--port", help="serial port to run tactiled on (default: one that runs)")
    parser.add_argument("--board", default="auto", help="kind of board on --port (auto)")
    parser.add_argument(
        "--calibration", type=Path, metavar="FILE", help="what tactiled runs the board with"
    )
    for name, default, what in (
        ("rest", 4.0, "recorded of the untouched skin, before and after each press"),
        ("hold", 2.0, "recorded of each press"),
        ("turn", 20.0, "recorded of the turning board"),
    ):
        parser.add_argument(
            f"--{name}", type=_seconds, default=default, metavar="S", help=f"s {what} ({default:g})"
        )
    add_bus(parser, "tool")
    parser.set_defaults(func=actions.record_command)


def _seconds(text: str) -> float:
    return finite_above_zero(text, "s")
