"""Options that several tools share: files of a log, scenes, strategies, engines."""

from __future__ import annotations

import os

from sim_device.world.engines import ENGINES
from tactile_core.cli import (
    DEFAULT_STRATEGY,
    Adding,
    Parser,
    add_out,
    count,
)


def add_log_files(parser: Adding) -> None:
    """Add the files of a log, which may be several."""
    from pathlib import Path

    parser.add_argument(
        "files",
        nargs="+",
        type=Path,
        metavar="FILE",
        help="MCAP log, a folder of them, or what the names of the files of one log share",
    )


def add_scene(parser: Adding) -> None:
    """Add --scene: a scene, or a set of scenes by name."""
    parser.add_argument(
        "--scene",
        default="authors_sim",
        metavar="SCENE",
        help="authors_sim, hardware, authors_sim_recorded or recorded:FILE.json.gz (scene "
        "--scene-seed of it), or FILE.json (default authors_sim)",
    )


def add_strategy(parser: Adding) -> None:
    """Add --strategy."""
    parser.add_argument(
        "--strategy",
        default=DEFAULT_STRATEGY,
        metavar="NAME",
        help="name or module:Class (default %(default)s)",
    )


def add_engine(parser: Adding) -> None:
    """Add --engine."""
    parser.add_argument(
        "--engine",
        choices=ENGINES,
        default=ENGINES[0],
        help=f"physics engine (default {ENGINES[0]})",
    )


def add_depth(parser: Adding) -> None:
    """Add --depth."""
    parser.add_argument(
        "--depth",
        choices=("contacts", "taxels"),
        default="contacts",
        help="what is felt: the engine's contacts, or the whole chain of taxels (default contacts)",
    )


def add_jobs(parser: Adding) -> None:
    """Add --jobs."""
    cores = os.cpu_count() or 1
    parser.add_argument(
        "--jobs", type=count, default=cores, metavar="N", help=f"processes (default {cores})"
    )


def add_report(parser: Parser) -> None:
    """Add --out for a report as JSON; its former name is --json."""
    parser.former(json="out")
    add_out(parser, "write the result to this file, as JSON", force="")
