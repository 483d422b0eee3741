"""Arguments of ``tactile experiment``; `commands` holds the commands themselves."""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable, Sequence
from pathlib import Path

from sim_device.world.engines import ENGINES
from tactile_core.cli import (
    Command,
    Parser,
    add_commands,
    add_out,
    add_path,
    add_seeds,
    add_strategies,
    count,
    later,
    positive,
    seed,
)
from tactile_tools.options import add_depth, add_engine, add_strategy

AXIS_NAMES = (
    "density", "friction_objects", "friction_all", "force", "width", "time", "noise", "rate", "dead"
)  # fmt: skip
"""Names of `axes`, which takes half a second to import; a test checks that they are equal."""

SCENE_SET_NAMES = ("squeezed", "dense", "high_friction", "narrow", "hardware", "recorded")
ORACLE_SETS = SCENE_SET_NAMES[:-1]
LIMITS_S = (20.0, 40.0)
FIRST_SEED = 700_000
"""As in `benchmark`, likewise; the oracle makes its own scenes."""

HERE = "tactile_tools.experiments.cli"

COMMANDS = {
    "strategies": Command("every strategy in every scene", f"{HERE}:_strategies"),
    "sweep": Command("the paper's 10 × 10 grids of a primitive's parameters", f"{HERE}:_sweep"),
    "robustness": Command(
        "every strategy while one condition at a time is varied", f"{HERE}:_robustness"
    ),
    "oracle": Command(
        "the ceiling of scene sets: a planner that sees every object", f"{HERE}:_oracle"
    ),
    "compare": Command("two runs side by side, trial by trial where paired", f"{HERE}:_compare"),
    "report": Command("report.html and PNGs of a run", f"{HERE}:_report"),
    "trial": Command("any row again, bit for bit, with its log and picture", f"{HERE}:_trial"),
}

EXAMPLES = """\
examples:
  tactile experiment strategies --scenes 300 --set authors_sim --out runs/strategies
  tactile experiment sweep --scenes 50 --primitive burrow --out runs/sweep
  tactile experiment robustness --scenes 30 --axis density width --out runs/robustness
  tactile experiment oracle --scenes 20 --set squeezed dense --scene-seed 710000
  tactile experiment report runs/strategies
  tactile experiment compare runs/contacts runs/taxels
  tactile experiment trial --scene-seed 12 --strategy hybrid_event --log t.mcap --png t.png
  tactile experiment trial --row runs/strategies:17      # that row of trials.csv again, compared

A run that was stopped or killed goes on where it was when the same command is given again;
with more scenes, strategies and the like the same folder grows.
Exit: 0 done, 1 some trials could not be run or a row came out different, 2 bad argument,
3 refused by the system, 130 stopped by Ctrl-C.
"""


NEEDED = ("mujoco", "pyarrow", "scipy", "jinja2", "matplotlib")


def _work(
    word: str, *needed: str, extra: str = "experiments"
) -> Callable[[argparse.Namespace], int]:
    return later(f"tactile_tools.experiments.commands:{word}", *(needed or NEEDED), extra=extra)


def fill(parser: Parser) -> None:
    """Add the options of ``tactile experiment``."""
    parser.description = (
        "Many trials, one row each, on all cores or a Dask cluster; and what the rows "
        "say. The same options give the same rows, whoever runs them."
    )
    parser.epilog = EXAMPLES
    add_commands(parser, COMMANDS)


def _strategies(parser: Parser) -> None:
    _study_options(parser, scenes=300)
    add_strategies(parser, "names or module:Class (default: the paper's five)")
    parser.former(strategies="strategy")
    parser.set_defaults(func=_work("strategies"))


def _sweep(parser: Parser) -> None:
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
    parser.set_defaults(func=_work("sweep"))


def _robustness(parser: Parser) -> None:
    _study_options(parser, scenes=30)
    add_strategies(parser, "names or module:Class (default: the paper's five)")
    parser.former(strategies="strategy")
    parser.add_argument(
        "--axis",
        nargs="+",
        action="extend",
        choices=AXIS_NAMES,
        help="what is varied (default all: %(choices)s)",
        metavar="AXIS",
    )
    parser.set_defaults(func=_work("robustness"))


def _oracle(parser: Parser) -> None:
    parser.description = (
        "The ceiling of scene sets: a privileged planner, which sees every object and tries its "
        "motions out in copies of the cupboard. In simulation only."
    )
    _study_options(parser, scenes=20, sets=ORACLE_SETS)
    parser.set_defaults(func=_work("oracle"))


def _compare(parser: Parser) -> None:
    parser.add_argument("first", type=Path, metavar="RUN_A")
    parser.add_argument("second", type=Path, metavar="RUN_B")
    parser.former(csv="out")
    add_out(parser, "write the table to this file too, as CSV", force="")
    parser.set_defaults(func=_work("compare"))


def _report(parser: Parser) -> None:
    parser.add_argument("run", type=Path, metavar="RUN")
    add_path(
        parser,
        "--out",
        "folder for the report, its PNGs and a small CSV of each table (default: RUN)",
    )
    parser.add_argument(
        "--rows",
        action="store_true",
        help="put the table of trials there too, small, so that --out can be used as RUN",
    )
    parser.set_defaults(func=_work("report"))


def _trial(parser: Parser) -> None:
    parser.add_argument(
        "--row", metavar="RUN:N", help="row N (0 is the first) of a run's table; says if it differs"
    )
    parser.former(trial_seed="seed")
    add_seeds(parser)
    add_strategy(parser)
    parser.add_argument(
        "--set", default="authors_sim", metavar="SET", help="parameter set (default %(default)s)"
    )
    parser.add_argument(
        "--source",
        metavar="SCENE",
        help="scenes (default: those of --set): authors_sim_recorded, recorded:FILE",
    )
    add_engine(parser)
    add_depth(parser)
    _param_option(parser)
    parser.add_argument(
        "--condition",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="a condition of the robustness map, such as finger_width=0.04",
    )
    add_path(parser, "--log", "MCAP file of the trial")
    add_path(parser, "--png", "picture of the trial; needs --log")
    parser.set_defaults(func=_work("trial", "mujoco", extra="sim"))


BENCHMARK_EXAMPLES = """\
examples:
  tactile benchmark quick_sweep                          # everything: about two hours of CPU time
  tactile benchmark my_strategies:Wiggle --sets squeezed --engine mujoco --time-limit 20
  tactile benchmark quick_sweep --out runs/quick_sweep --entry quick_sweep.json

A run that was stopped or killed goes on where it was when the same command is given again; with
more scenes, sets, engines, depths and limits the same folder grows. Rules for entries:
docs/leaderboard.md.
Exit: 0 done, 1 some trials could not be run, 2 bad argument, 3 refused by the system,
130 stopped by Ctrl-C.
"""


def fill_benchmark(parser: Parser) -> None:
    """Add the options of ``tactile benchmark``."""
    parser.description = (
        "Run one strategy on fixed scene sets, in each engine, depth of sensing and time limit; "
        "print success, time, forces, objects pushed out and CPU time, and write them as JSON."
    )
    parser.epilog = BENCHMARK_EXAMPLES
    parser.add_argument("strategy", metavar="STRATEGY", help="name or module:Class")
    parser.add_argument(
        "--sets",
        nargs="+",
        action="extend",
        choices=SCENE_SET_NAMES,
        metavar="SET",
        help="scene sets (default all: %(choices)s)",
    )
    parser.add_argument(
        "--scenes", type=count, default=100, metavar="N", help="of each set (default 100)"
    )
    parser.add_argument(
        "--engine",
        nargs="+",
        action="extend",
        choices=ENGINES,
        help="physics engines (default mujoco and pymunk)",
    )
    parser.add_argument(
        "--depth",
        nargs="+",
        action="extend",
        choices=("contacts", "taxels"),
        help="what is felt (default both)",
    )
    parser.add_argument(
        "--time-limit",
        dest="limit",
        nargs="+",
        action="extend",
        type=positive("s"),
        metavar="S",
        help="time limits, s (default 20 and 40)",
    )
    _param_option(parser)
    cores = os.cpu_count() or 1
    parser.add_argument(
        "--jobs",
        "--workers",
        type=count,
        default=cores,
        metavar="N",
        help=f"processes (default {cores})",
    )
    add_path(parser, "--out", "folder of the run (default runs/benchmark-STRATEGY)")
    add_path(parser, "--entry", "entry to write (default: entry.json in the folder of the run)")
    parser.add_argument(
        "--name", metavar="TEXT", help="name on the leaderboard (default: the strategy's)"
    )
    parser.add_argument(
        "--note",
        default="",
        metavar="TEXT",
        help="where the code is, what it was tuned on and what that took, for the leaderboard",
    )
    parser.add_argument("--retry", action="store_true", help="run trials again that failed")
    parser.set_defaults(func=_work("benchmark"))


def _study_options(parser: Parser, *, scenes: int, sets: Sequence[str] = ()) -> None:
    """Options of a study; with ``sets`` over scene sets of the benchmark instead of any source."""
    parser.former(seed="scene-seed")
    parser.add_argument(
        "--scenes", type=count, default=scenes, metavar="N", help=f"how many (default {scenes})"
    )
    first = FIRST_SEED if sets else 0
    parser.add_argument(
        "--scene-seed",
        type=seed,
        default=first,
        metavar="N",
        help=f"of the first scene; the others follow (default {first})",
    )
    parser.add_argument(
        "--set",
        nargs="+",
        action="extend",
        choices=sets or None,
        metavar="SET",
        help=f"scene sets: {', '.join(sets)} (default {sets[0]})"
        if sets
        else "parameter sets: authors_sim (default), hardware, or both",
    )
    parser.add_argument(
        "--engine",
        nargs="+",
        action="extend",
        choices=ENGINES,
        help=f"physics engines (default {ENGINES[0]})",
    )
    if not sets:
        parser.add_argument(
            "--depth",
            nargs="+",
            action="extend",
            choices=("contacts", "taxels"),
            help="what is felt: the engine's contacts (default), or the whole chain of taxels",
        )
        parser.add_argument(
            "--source",
            metavar="SCENE",
            help="scenes of another generator, authors_sim_recorded or recorded:FILE "
            "(default: the set's)",
        )
    _param_option(parser)
    where = parser.add_mutually_exclusive_group()
    cores = os.cpu_count() or 1
    where.add_argument(
        "--jobs", type=count, default=cores, metavar="N", help=f"processes (default {cores})"
    )
    where.add_argument("--dask", metavar="ADDRESS", help="run on the cluster of this scheduler")
    add_path(parser, "--out", "folder of the run (default runs/WORD)")
    parser.add_argument(
        "--retry", action="store_true", help="when resuming, run trials again that failed"
    )


def _param_option(parser: Parser) -> None:
    parser.add_argument(
        "--param",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="a parameter that differs from the set's, such as time_limit=30; may be repeated",
    )
