"""Rerun one row: with its log and picture, and a check that it is the same bit for bit."""

from __future__ import annotations

import argparse
from pathlib import Path

from tactile_core.cli import seeds_of
from tactile_core.log.recorder import RecorderError
from tactile_tools.experiments.arguments import named_values
from tactile_tools.experiments.conditions import scene_of
from tactile_tools.experiments.journal import DiskError
from tactile_tools.experiments.rows import Row, outcome_of
from tactile_tools.experiments.runner import check
from tactile_tools.experiments.spec import Conditions, TrialSpec, canonical, spec_of
from tactile_tools.experiments.studies import Study
from tactile_tools.experiments.tables import load_run
from tactile_tools.experiments.trial import run_one


def rerun(options: argparse.Namespace) -> int:
    """Run the trial that ``options`` name. Returns 0 if it ran and, for a row, came out the
    same."""
    if options.png is not None and options.log is None:
        raise ValueError("--png is drawn from the log: give --log as well")
    recorded = None if options.row is None else _recorded(options.row)
    spec = _spec(options) if recorded is None else spec_of(recorded)
    check(Study({}, (spec,)))
    row = _run(spec, options.log)
    if row["error"] is not None:
        print(f"{spec.strategy}: {row['error']}")
        return 0 if recorded is not None and recorded["error"] == row["error"] else 1
    print(
        f"{spec.strategy} in scene {spec.scene_seed} of {spec.source}: {row['reason']}, "
        f"{row['distance_m'] * 1e3:.1f} mm from the goal after {row['simulated_s']:.2f} s, "
        f"{row['excavations']} excavations, {row['ejected']} objects pushed out"
    )
    if options.log is not None:
        print(f"wrote {options.log}")
    if options.png is not None:
        from tactile_tools.plot.reach import draw_reach

        draw_reach(options.log, options.png)
        print(f"wrote {options.png}")
    if recorded is None:
        return 0
    return _compare(recorded, row)


def _compare(recorded: Row, row: Row) -> int:
    """Print whether the row came out the same. Returns the exit status."""
    before, now = outcome_of(recorded), outcome_of(row)
    different = [name for name in before if before[name] != now[name]]
    if not different:
        print("the same as its row, bit for bit")
        return 0
    for name in different:
        print(f"  {name}: {before[name]!r} in the row, {now[name]!r} now")
    if recorded["version"] != row["version"]:
        print(f"  the row is of version {recorded['version']}, this is {row['version']}")
    return 1


def _recorded(text: str) -> Row:
    """Row that RUN:N names; ValueError."""
    run, colon, number = text.rpartition(":")
    if not colon or not number.isdigit():
        raise ValueError(f"--row {text!r} is not RUN:N, a run's folder and a row's number")
    rows = load_run(Path(run)).rows
    index = int(number)
    if index >= len(rows):
        raise ValueError(f"--row {text}: {run} has rows 0 to {len(rows) - 1}")
    return rows[index]


def _spec(options: argparse.Namespace) -> TrialSpec:
    """Trial that the options describe, by the columns' names."""
    conditions = canonical(named_values("--condition", options.condition))
    scene_seed, seed = seeds_of(options)
    return TrialSpec(
        source=options.source or options.set,
        scene_seed=scene_seed,
        set=options.set,
        engine=options.engine,
        depth=options.depth,
        strategy=options.strategy,
        trial_seed=seed,
        parameters=canonical(named_values("--param", options.param)),
        conditions=Conditions.from_json(conditions).to_json(),
    )


def _run(spec: TrialSpec, path: Path | None) -> Row:
    """Run ``spec`` and return its row, with a log at ``path`` unless None; DiskError."""
    if path is None:
        return run_one(spec)
    # Imported only now: a log's messages and its writer take a quarter of a second.
    from tactile_tools.reach.trial_log import TrialLog

    try:
        with TrialLog(path, scene_of(spec), spec.strategy, spec.trial_seed) as log:
            return run_one(spec, watch=log, done=log.outcome)
    except (RecorderError, OSError, RuntimeError) as error:
        # An incomplete log raises RuntimeError; errors of the trial itself are in its row.
        raise DiskError(f"cannot write {path}: {error}") from error
