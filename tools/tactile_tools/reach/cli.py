"""``tactile reach``: one trial in lockstep, faster than real time."""

from __future__ import annotations

import argparse
import os
import sys
import time
from functools import partial

from tactile_core.cli import require, seeds_of, working
from tactile_core.log.recorder import RecorderError
from tactile_tools.plot.series import LogUnreadableError


def run(options: argparse.Namespace) -> int:
    """Run one trial and print its outcome. Returns the exit status."""
    # Physics and strategies take half a second to import: only when a trial is really run.
    from reachd.strategies import StrategyError
    from sim_device.world.base import WorldError
    from tactile_core.config import ConfigError

    if options.png is not None:
        require("matplotlib", "scipy", extra="plot")
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

            with working("drawing"):
                draw_reach(options.log, options.png)
            print(f"wrote {options.png}")
    except (StrategyError, ConfigError, ValueError) as error:
        print(f"tactile reach: {error}", file=sys.stderr)
        return 2
    except BrokenPipeError:
        raise  # the reader of our output has gone; the command ``tactile`` handles that
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
    from sim_device.world.view import WorldView
    from tactile_tools.reach.lockstep import run_trial
    from tactile_tools.reach.trial_log import TrialLog

    if ":" in options.strategy and os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())  # a user's own strategy may be here
    scene_seed, seed = seeds_of(options)
    if options.trial_seed is not None:
        print("tactile reach: note: --trial-seed is now called --seed", file=sys.stderr)
        seed = options.trial_seed
    scene = load_scene(options.scene, scene_seed)
    parameters = parameter_set(options.set or scene.parameters)
    # Before a log is begun: a strategy that cannot be loaded must not leave a log behind.
    world = make_world(options.engine, scene)
    load_strategy(options.strategy, parameters, np.random.default_rng(0), lambda: WorldView(world))
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
