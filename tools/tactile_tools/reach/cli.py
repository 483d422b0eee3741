"""``tactile reach``: one trial in lockstep, faster than real time."""

from __future__ import annotations

import argparse
import os
import sys
import time
from functools import partial
from pathlib import Path

from sim_device.world.engines import ENGINES
from tactile_core.log.recorder import RecorderError
from tactile_tools.plot.series import LogUnreadableError

MAX_SEED = 2**63 - 1


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add ``reach`` to the umbrella command."""
    parser = subparsers.add_parser(
        "reach",
        help="run one reach in lockstep, faster than real time",
        description="World, arm, touch, strategy and safety gate in one process on virtual time: "
        "the daemons' own objects. The same scene, strategy and seed give the same trial. "
        "Exit: 0 reached, 1 not reached, 2 bad argument, 3 refused by the system.",
    )
    parser.add_argument("--strategy", default="hybrid_event", help="name or module:Class")
    parser.add_argument(
        "--seed", type=_seed, default=0, metavar="N", help="of scene and trial (default 0)"
    )
    parser.add_argument(
        "--trial-seed", type=_seed, metavar="N", help="of the trial alone (default: --seed)"
    )
    parser.add_argument(
        "--scene",
        default="authors_sim",
        help="authors_sim, hardware, authors_sim_recorded or recorded:FILE.json.gz (scene --seed "
        "of it), or FILE.json",
    )
    parser.add_argument("--set", help="parameter set (default: that of the scene)")
    parser.add_argument(
        "--depth",
        choices=("contacts", "taxels"),
        default="contacts",
        help="what is felt: the engine's contacts, or the whole chain of taxels (default contacts)",
    )
    parser.add_argument("--engine", choices=ENGINES, default=ENGINES[0])
    parser.add_argument("--log", type=Path, metavar="FILE", help="MCAP file of the trial")
    parser.add_argument("--png", type=Path, metavar="FILE", help="picture of the trial")
    parser.add_argument(
        "--headless", action="store_true", help="accepted for clarity: there is no window"
    )
    parser.set_defaults(func=run)


def _seed(text: str) -> int:
    if not (text.isascii() and text.isdecimal()) or int(text) > MAX_SEED:
        raise argparse.ArgumentTypeError(
            f"{text!r} given; allowed: a whole number from 0 to {MAX_SEED}"
        )
    return int(text)


def run(options: argparse.Namespace) -> int:
    """Run one trial and print what became of it."""
    # Physics and strategies take half a second to import: not before a trial is really wanted.
    from reachd.strategies import StrategyError
    from sim_device.world.base import WorldError
    from tactile_core.config import ConfigError

    if options.png is not None and options.log is None:
        print("tactile reach: --png is drawn from the log: give --log as well", file=sys.stderr)
        return 2
    if options.png is not None and not options.png.resolve().parent.is_dir():
        print(
            f"tactile reach: --png {options.png}: there is no folder {options.png.parent}; create "
            "it or name another",
            file=sys.stderr,
        )
        return 2
    try:
        code = _run(options)
        if options.png is not None:
            from tactile_tools.plot.reach import draw_reach

            draw_reach(options.log, options.png)
            print(f"wrote {options.png}")
    except (StrategyError, ConfigError, ValueError) as error:
        print(f"tactile reach: {error}", file=sys.stderr)
        return 2
    except BrokenPipeError:
        raise  # whoever read our words has gone, which is the umbrella's affair
    except (WorldError, RecorderError, LogUnreadableError, OSError, RuntimeError) as error:
        print(f"tactile reach: {error}", file=sys.stderr)
        return 3
    return code


def _run(options: argparse.Namespace) -> int:
    import numpy as np

    from reachd.strategies import load_strategy
    from reachd.strategies.parameters import parameters as parameter_set
    from sim_device.world.engines import make_world
    from sim_device.world.scene_loading import load_scene
    from tactile_tools.reach.lockstep import run_trial
    from tactile_tools.reach.trial_log import TrialLog

    if ":" in options.strategy and os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())  # one of the user's own may lie here
    seed = options.seed if options.trial_seed is None else options.trial_seed
    scene = load_scene(options.scene, options.seed)
    parameters = parameter_set(options.set or scene.parameters)
    # Before a log is begun, for one that cannot be loaded must not leave one behind.
    load_strategy(options.strategy, parameters, np.random.default_rng(0))
    world = make_world(options.engine, scene)
    trial = partial(
        run_trial, scene, options.strategy, parameters, seed, depth=options.depth, world=world
    )
    began = time.process_time()
    if options.log is None:
        result = trial()
    else:
        with TrialLog(options.log, scene, options.strategy, seed) as log:
            result = trial(watch=log)
            log.outcome(result)
    spent = time.process_time() - began
    o = result.outcome
    print(f"{options.strategy}: {o.text}")
    print(
        f"closest {o.closest * 1e3:.1f} mm, peak force {o.peak_force:.1f} N, "
        f"excavations {len(o.excavations)}, objects pushed out {result.ejected}, "
        f"{result.simulated_s / spent:.0f} simulated seconds a CPU-second"
    )
    for name, count in o.interventions.items():
        print(f"  the safety gate intervened: {name} × {count}")
    if options.log is not None:
        print(f"wrote {options.log}")
    return 0 if o.success else 1
