"""Arguments of ``tactile train``."""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from tactile_core.cli import USAGE, CommandError, Parser, add_path, count, later, positive

DEVICES = ("cpu", "cuda")

EXAMPLES = """\
examples:
  tactile train --out runs/mine --minutes 480
  tactile train --out runs/mine --minutes 480        # again: goes on where it was
  tactile train --out runs/gpu --config train.toml --device cuda --minutes 8
  tactile benchmark learned --param learned_weights=runs/mine/learned.npz --scenes 50

The folder holds the settings, a checkpoint of every minute, progress.jsonl and curve.png (how the
share that arrives grew), and learned.npz, the best weights so far. Ctrl-C and a kill lose a minute
at most. Exit: 0 done, 2 bad argument or another run's folder, 3 refused by the system.
"""


def fill(parser: Parser) -> None:
    """Add the options of ``tactile train``."""
    parser.description = (
        "Trains the residual of the strategy `learned` in thousands of cupboards of the planar "
        "engine (docs/learned.md). Without a GPU it takes a night on two cores."
    )
    parser.epilog = EXAMPLES
    add_path(parser, "--out", "folder of the run (default runs/train)")
    parser.add_argument(
        "--config", type=Path, metavar="FILE", help="settings (docs/configuration.md, Training)"
    )
    add_path(
        parser,
        "--start-from",
        "folder of another run, whose networks a new one begins with; layers may be wider here",
    )
    parser.add_argument(
        "--minutes",
        type=positive("minutes"),
        default=480.0,
        metavar="MIN",
        help="train for so long now (default %(default)g)",
    )
    parser.add_argument(
        "--device",
        choices=DEVICES,
        default="cpu",
        help="where cupboards move and the network learns (default %(default)s)",
    )
    cores = os.cpu_count() or 1
    parser.add_argument(
        "--jobs",
        type=count,
        default=cores,
        metavar="N",
        help=f"threads of the processor (default {cores})",
    )
    parser.set_defaults(
        func=later("tactile_tools.train.cli:train", "torch", "numba", "mujoco", extra="learn")
    )


def train(options: argparse.Namespace) -> int:
    """Train as ``options`` say."""
    from tactile_core.config import ConfigError, load_toml
    from tactile_tools.train.run import Run, RunError
    from tactile_tools.train.settings import Settings

    out: Path = options.out or Path("runs/train")
    try:
        settings = Settings() if options.config is None else load_toml(options.config, Settings)
        run = Run(out, settings, options.device, options.jobs, _say, options.start_from)
        run.go(options.minutes * 60.0)
    except (ConfigError, RunError) as error:
        raise CommandError(str(error), USAGE) from error
    _say(f"weights: {out / 'learned.npz'}; to judge them on other scenes:")
    _say(f"  tactile benchmark learned --param learned_weights={out / 'learned.npz'} --scenes 50")
    return 0


def _say(text: str) -> None:
    print(text, flush=True)
