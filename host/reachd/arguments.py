"""The flags of reachd."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path

from reachd.settings import DEFAULT_SET, DEFAULT_STRATEGY, DEFAULT_WAIT
from reachd.strategies.parameters import SETS
from reachd.strategies.runner import BUILT_IN
from tactile_core.arguments import Parser
from tactile_core.options import add_log_and_bus, finite_above_zero

EPILOG = """\
examples:
  reachd --strategy hybrid_event --target 0.358,0.03
  reachd --strategy burrow --set authors_sim --target 0.358,0.03 --seed 7 --log trial.mcap
  reachd --strategy my_package:MyStrategy --serve

The target is in m from the middle of the cupboard's front edge, x into the cupboard, y left.

exit status: 0 target reached (--serve: ended in order); 1 not reached, or failed while running,
or its log did; 2 bad argument or configuration; 3 refused by the environment: no features, no arm,
an arm that refuses its limits or is not fit to be armed, a second reachd on the arm. With 2 and 3
nothing has moved.
"""


def make_parser() -> argparse.ArgumentParser:
    """Parser of the command line."""
    parser = Parser(
        prog="reachd",
        usage="reachd --target X,Y [--strategy S] [option ...] | --serve [option ...]",
        description="Reaches for a target in a cluttered cupboard by touch: runs a strategy on the "
        "contact features, and sends velocities to the arm through a safety gate.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("--version", action="version", version=f"reachd {version('tactile-reach')}")
    add("--config", type=Path, metavar="FILE", help="TOML file; flags win over it")

    add = parser.add_argument_group("reach").add_argument
    add(
        "--strategy",
        metavar="S",
        help=f"{', '.join(BUILT_IN)}, one of an installed package, or module:Class "
        f"(default {DEFAULT_STRATEGY})",
    )
    add("--target", metavar="X,Y", help="reach for this point (m), and start at once")
    add(
        "--set",
        metavar="SET",
        help=f"parameter set: {', '.join(SETS)} (default {DEFAULT_SET}); single values in "
        "[parameters] of the file",
    )
    add(
        "--radius",
        type=_above("m"),
        metavar="M",
        help="distance of tip and target that counts as reached (m; default: the set's, "
        f"{_each_set('goal_radius')})",
    )
    add(
        "--time-limit",
        type=_above("s"),
        metavar="S",
        help=f"time for the reach (s; default: the set's, {_each_set('time_limit')})",
    )
    add("--seed", type=_seed, metavar="N", help="of the strategy's chance (default: drawn, logged)")
    add(
        "--home",
        metavar="X,Y,DEG",
        help="pose of the wrist pivot to start from (m, m, degrees; default: where it is)",
    )
    group = parser.add_mutually_exclusive_group()
    group.add_argument(
        "--once",
        dest="serve",
        action="store_false",
        default=None,
        help="end with the outcome (default with --target)",
    )
    group.add_argument(
        "--serve",
        action="store_true",
        default=None,
        help="wait for goals over the bus (default without --target)",
    )
    add("--json", type=Path, metavar="FILE", help="write the outcome of each reach to this file")

    add = parser.add_argument_group("arm and board").add_argument
    add("--board", metavar="NAME", help="board whose features are used (default board0)")
    add("--arm", metavar="NAME", help="arm that is commanded (default arm)")
    add("--name", metavar="NAME", help="of this reach in keys and logs (default reach)")
    add(
        "--wait",
        type=_above("s"),
        metavar="S",
        help=f"how long to wait for features and arm (s; default {DEFAULT_WAIT:g})",
    )
    add_log_and_bus(parser, "reachd")
    parser.add_argument("--verbose", action="store_true", help="say more")
    return parser


def _each_set(name: str) -> str:
    return ", ".join(f"{key} {getattr(values, name):g}" for key, values in SETS.items())


def _above(unit: str) -> Callable[[str], float]:
    return lambda text: finite_above_zero(text, unit)


def _seed(text: str) -> int:
    if not (text.isascii() and text.isdecimal()) or int(text) >= 1 << 63:
        raise argparse.ArgumentTypeError(f"{text} given; allowed: a whole number from 0 to 2^63-1")
    return int(text)
