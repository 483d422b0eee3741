"""``tactile reach``: one trial in lockstep, faster than real time."""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

from tactile_bus.recorder import RecorderError


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
    parser.add_argument("--seed", type=int, default=0, help="of scene and trial (default 0)")
    parser.add_argument("--trial-seed", type=int, help="of the trial alone (default: --seed)")
    parser.add_argument(
        "--scene",
        default="authors_sim",
        help="authors_sim, hardware, recorded:FILE.json.gz (scene --seed of it), or FILE.json",
    )
    parser.add_argument("--set", help="parameter set (default: that of the scene)")
    parser.add_argument(
        "--depth",
        choices=("contacts", "taxels"),
        default="contacts",
        help="what is felt: the engine's contacts, or the whole chain of taxels (default contacts)",
    )
    parser.add_argument("--engine", choices=("mujoco", "pymunk"), default="mujoco")
    parser.add_argument("--log", type=Path, metavar="FILE", help="MCAP file of the trial")
    parser.add_argument("--png", type=Path, metavar="FILE", help="picture of the trial")
    parser.add_argument(
        "--headless", action="store_true", help="accepted for clarity: there is no window"
    )
    parser.set_defaults(func=run)


def run(options: argparse.Namespace) -> int:
    """Run one trial and print what became of it."""
    # Physics and strategies take half a second to import: not before a trial is really wanted.
    from reachd.fields import SettingError
    from reachd.parameters import parameters as parameter_set
    from reachd.strategies import StrategyError
    from sim_device.world.base import WorldError
    from tactile_tools.lockstep import run_trial
    from tactile_tools.trial_log import TrialLog
    from tactile_tools.worlds import load_scene, make_world

    if options.png is not None and options.log is None:
        print("tactile reach: --png is drawn from the log: give --log as well", file=sys.stderr)
        return 2
    seed = options.seed if options.trial_seed is None else options.trial_seed
    try:
        scene = load_scene(options.scene, options.seed)
        parameters = parameter_set(options.set or scene.parameters)
        world = make_world(options.engine, scene)
        began = time.process_time()
        if options.log is None:
            result = run_trial(
                scene, options.strategy, parameters, seed, depth=options.depth, world=world
            )
        else:
            with TrialLog(options.log, scene, options.strategy, seed) as log:
                result = run_trial(
                    scene,
                    options.strategy,
                    parameters,
                    seed,
                    depth=options.depth,
                    world=world,
                    watch=log,
                )
                log.outcome(result)
        spent = time.process_time() - began
    except (StrategyError, SettingError, ValueError) as error:
        print(f"tactile reach: {error}", file=sys.stderr)
        return 2
    except (WorldError, RecorderError, OSError, RuntimeError) as error:
        print(f"tactile reach: {error}", file=sys.stderr)
        return 3
    o = result.outcome
    print(f"{options.strategy}: {o.text}")
    print(
        f"closest {o.closest * 1e3:.1f} mm, peak force {o.peak_force:.1f} N, "
        f"excavations {len(o.excavations)}, objects pushed out {result.ejected}, "
        f"{result.cycles * 0.01 / spent:.0f} simulated seconds a CPU-second"
    )
    for name, count in o.interventions.items():
        print(f"  the safety gate intervened: {name} × {count}")
    if options.log is not None:
        print(f"wrote {options.log}")
    if options.png is not None:
        from tactile_tools.plot_reach import draw_reach

        draw_reach(options.log, options.png)
        print(f"wrote {options.png}")
    return 0 if o.success else 1
