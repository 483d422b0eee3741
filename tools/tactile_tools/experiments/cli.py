"""Arguments of ``tactile experiment``; what each word does is in `commands`."""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable
from pathlib import Path

from sim_device.world.engines import ENGINES

STRATEGY_NAMES = "straight burrow excavate hybrid_clock hybrid_event"
AXIS_NAMES = (
    "density", "friction_objects", "friction_all", "force", "width", "time", "noise", "rate", "dead"
)  # fmt: skip
"""As in `axes`, which takes half a second to import: a test holds them equal."""

EXAMPLES = """\
examples:
  tactile experiment strategies --scenes 300 --set authors_sim --out runs/strategies
  tactile experiment sweep --scenes 50 --primitive burrow --out runs/sweep
  tactile experiment robustness --scenes 30 --axis density width --out runs/robustness
  tactile experiment report runs/strategies
  tactile experiment compare runs/contacts runs/taxels
  tactile experiment trial --scene-seed 12 --strategy hybrid_event --log t.mcap --png t.png
  tactile experiment trial --row runs/strategies:17      # that row of trials.csv again, compared

A run that was stopped or killed goes on where it was when the same command is given again;
with more scenes, strategies and the like the same folder grows.
Exit: 0 done, 1 some trials could not be run or a row came out different, 2 bad argument,
3 refused by the system, 130 stopped by Ctrl-C.
"""


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add ``experiment`` to the umbrella command."""
    parser = subparsers.add_parser(
        "experiment",
        help="repeat the paper's studies: strategies, sweep, robustness, statistics, report",
        description="Many trials, one row each, on all cores or a Dask cluster; and what the rows "
        "say. The same options give the same rows, whoever runs them.",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    words = parser.add_subparsers(dest="experiment", metavar="WORD", required=True)
    _strategies(words)
    _sweep(words)
    _robustness(words)
    _compare(words)
    _report(words)
    _trial(words)


Words = argparse._SubParsersAction


def _strategies(words: Words[argparse.ArgumentParser]) -> None:
    parser = words.add_parser("strategies", help="every strategy in every scene")
    _study_options(parser, scenes=300)
    _strategy_option(parser)
    parser.set_defaults(func=_call("strategies"))


def _sweep(words: Words[argparse.ArgumentParser]) -> None:
    parser = words.add_parser(
        "sweep", help="the paper's 10 × 10 grids of a primitive's parameters, beside straight"
    )
    _study_options(parser, scenes=50)
    parser.add_argument(
        "--primitive",
        choices=("burrow", "excavate", "both"),
        default="both",
        help="whose parameters (default both)",
    )
    parser.add_argument(
        "--frequency",
        choices=("rad", "hz", "both"),
        default="both",
        help="how the paper's f_bur is read: rad/s, as its simulator takes it, Hz, as it is "
        "printed, or both (default)",
    )
    parser.set_defaults(func=_call("sweep"))


def _robustness(words: Words[argparse.ArgumentParser]) -> None:
    parser = words.add_parser(
        "robustness", help="success of every strategy while one condition at a time is varied"
    )
    _study_options(parser, scenes=30)
    _strategy_option(parser)
    parser.add_argument(
        "--axis",
        nargs="+",
        choices=AXIS_NAMES,
        default=list(AXIS_NAMES),
        help="what is varied (default all: %(choices)s)",
        metavar="AXIS",
    )
    parser.set_defaults(func=_call("robustness"))


def _compare(words: Words[argparse.ArgumentParser]) -> None:
    parser = words.add_parser("compare", help="two runs side by side, trial by trial where paired")
    parser.add_argument("first", type=Path, metavar="RUN_A")
    parser.add_argument("second", type=Path, metavar="RUN_B")
    parser.add_argument("--csv", type=Path, metavar="FILE", help="write the table there too")
    parser.set_defaults(func=_call("compare"))


def _report(words: Words[argparse.ArgumentParser]) -> None:
    parser = words.add_parser("report", help="report.html and PNGs of a run")
    parser.add_argument("run", type=Path, metavar="RUN")
    parser.add_argument(
        "--out",
        type=Path,
        metavar="DIR",
        help="where the report, its PNGs and a small CSV of each table go (default: RUN)",
    )
    parser.add_argument(
        "--rows",
        action="store_true",
        help="put the table of trials there too, small, so that --out can be used as RUN",
    )
    parser.set_defaults(func=_call("report"))


def _trial(words: Words[argparse.ArgumentParser]) -> None:
    parser = words.add_parser("trial", help="any row again, bit for bit, with its log and picture")
    parser.add_argument(
        "--row", metavar="RUN:N", help="row N (0 is the first) of a run's table; says if it differs"
    )
    parser.add_argument("--scene-seed", type=int, default=0)
    parser.add_argument("--trial-seed", type=int, help="(default: --scene-seed)")
    parser.add_argument("--strategy", default="hybrid_event", help="name or module:Class")
    parser.add_argument("--set", default="authors_sim")
    parser.add_argument(
        "--source", help="scenes (default: those of --set): authors_sim_recorded, recorded:FILE"
    )
    parser.add_argument("--engine", choices=ENGINES, default=ENGINES[0])
    parser.add_argument("--depth", choices=("contacts", "taxels"), default="contacts")
    _param_option(parser)
    parser.add_argument(
        "--condition",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="a condition of the robustness map, such as finger_width=0.04",
    )
    parser.add_argument("--log", type=Path, metavar="FILE", help="MCAP file of the trial")
    parser.add_argument("--png", type=Path, metavar="FILE", help="picture of it; needs --log")
    parser.set_defaults(func=_call("trial"))


def _study_options(parser: argparse.ArgumentParser, *, scenes: int) -> None:
    parser.add_argument(
        "--scenes", type=_count, default=scenes, metavar="N", help=f"how many (default {scenes})"
    )
    parser.add_argument(
        "--seed", type=int, default=0, help="of the first scene; the others follow (default 0)"
    )
    parser.add_argument(
        "--set",
        nargs="+",
        default=["authors_sim"],
        metavar="SET",
        help="parameter sets: authors_sim (default), hardware, or both",
    )
    parser.add_argument(
        "--engine",
        nargs="+",
        choices=ENGINES,
        default=[ENGINES[0]],
        help=f"physics (default {ENGINES[0]})",
    )
    parser.add_argument(
        "--depth",
        nargs="+",
        choices=("contacts", "taxels"),
        default=["contacts"],
        help="what is felt: the engine's contacts (default), or the whole chain of taxels",
    )
    parser.add_argument(
        "--source",
        help="scenes of another generator, authors_sim_recorded or recorded:FILE "
        "(default: the set's)",
    )
    _param_option(parser)
    where = parser.add_mutually_exclusive_group()
    where.add_argument(
        "--jobs", type=_count, default=os.cpu_count() or 1, help="processes (default %(default)s)"
    )
    where.add_argument("--dask", metavar="ADDRESS", help="run on the cluster of this scheduler")
    parser.add_argument(
        "--out", type=Path, metavar="DIR", help="folder of the run (default runs/WORD)"
    )
    parser.add_argument(
        "--retry", action="store_true", help="when resuming, run trials again that failed"
    )


def _strategy_option(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--strategies",
        nargs="+",
        default=STRATEGY_NAMES.split(),
        metavar="NAME",
        help="names or module:Class (default: the paper's five)",
    )


def _param_option(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--param",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="a parameter that differs from the set's, such as time_limit=30; may be repeated",
    )


def _count(text: str) -> int:
    """A whole number above 0."""
    try:
        value = int(text)
    except ValueError:
        value = 0
    if value < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number of at least 1")
    return value


def _call(word: str) -> Callable[[argparse.Namespace], int]:
    """The command ``word``, imported when it is wanted: physics and plots take their time."""

    def run(options: argparse.Namespace) -> int:
        from tactile_tools.experiments.commands import run_command

        return run_command(word, options)

    return run
