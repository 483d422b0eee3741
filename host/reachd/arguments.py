"""The flags of reachd."""

from __future__ import annotations

import argparse
from pathlib import Path

from tactile_core.cli import (
    DEFAULT_STRATEGY,
    SETS,
    STRATEGIES,
    Parser,
    add_board,
    add_log_and_bus,
    add_path,
    positive,
    seconds,
    seed,
)

DEFAULT_SET = "hardware"
"""The slower set, with every check of the gate on."""

DEFAULT_WAIT_S = 10.0
"""Time for features and arm to appear: a board's first tare takes a few seconds."""

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
    )
    add = parser.add_argument
    parser.show_version()
    parser.former(json="out")
    add("--config", type=Path, metavar="FILE", help="TOML file; flags win over it")

    reach = parser.add_argument_group("reach")
    add = reach.add_argument
    add(
        "--strategy",
        metavar="NAME",
        help=f"{', '.join(STRATEGIES)}, one of an installed package, or module:Class "
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
        type=positive("m"),
        metavar="M",
        help="distance of tip and target that counts as reached (m; default: the set's, "
        "hardware 0.0075, authors_sim 0.001)",
    )
    add(
        "--time-limit",
        type=seconds,
        metavar="S",
        help="time for the reach (s; default: the set's, hardware 40, authors_sim 20)",
    )
    add("--seed", type=seed, metavar="N", help="of the strategy's chance (default: drawn, logged)")
    add(
        "--home",
        metavar="X,Y,DEG",
        help="pose of the wrist pivot to start from (m, m, degrees; default: where it is)",
    )
    either = parser.add_mutually_exclusive_group()
    either.add_argument(
        "--once",
        dest="serve",
        action="store_false",
        default=None,
        help="end with the outcome (default with --target)",
    )
    either.add_argument(
        "--serve",
        action="store_true",
        default=None,
        help="wait for goals over the bus (default without --target)",
    )
    add_path(reach, "--out", "write the outcome of each reach to this file, as JSON")

    group = parser.add_argument_group("arm and board")
    add = group.add_argument
    add_board(group, "whose features are used (default board0)")
    add("--arm", metavar="NAME", help="arm that is commanded (default arm)")
    add("--name", metavar="NAME", help="of this reach in keys and logs (default reach)")
    add(
        "--wait",
        type=seconds,
        metavar="S",
        help=f"how long to wait for features and arm (s; default {DEFAULT_WAIT_S:g})",
    )
    add_log_and_bus(parser, "reachd")
    parser.add_argument("--verbose", action="store_true", help="say more")
    return parser
