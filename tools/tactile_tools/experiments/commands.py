"""What each word of ``tactile experiment`` does, and what is said when it cannot be done."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from tactile_tools.experiments.arguments import named_values
from tactile_tools.experiments.backends import Backend, BackendError, Processes
from tactile_tools.experiments.dask_backend import DaskCluster
from tactile_tools.experiments.journal import DiskError, FolderError
from tactile_tools.experiments.rows import Row, TableError, describe
from tactile_tools.experiments.runner import check, run_study
from tactile_tools.experiments.studies import (
    READINGS,
    Options,
    Study,
    robustness_study,
    strategies_study,
    sweep_study,
)

TOLD_EVERY_S = 30.0
"""s between lines of progress where there is no terminal to draw a bar on."""


def run_command(word: str, options: argparse.Namespace) -> int:
    """Do ``word``; its exit code. Every failure that a user can cause is one line on stderr."""
    commands: dict[str, Callable[[argparse.Namespace], int]] = {
        "strategies": lambda o: _study(strategies_study(_common(o), tuple(o.strategies)), o),
        "sweep": lambda o: _study(
            sweep_study(
                _common(o),
                ("burrow", "excavate") if o.primitive == "both" else (o.primitive,),
                tuple(READINGS) if o.frequency == "both" else (o.frequency,),
            ),
            o,
        ),
        "robustness": lambda o: _study(
            robustness_study(_common(o), tuple(o.strategies), tuple(o.axis)), o
        ),
        "trial": _trial,
        "report": _report,
        "compare": _compare,
    }
    try:
        return commands[word](options)
    except (FolderError, TableError, ValueError) as error:
        # Settings, strategies and scenes that cannot be are ValueErrors, each with its remedy.
        print(f"tactile experiment {word}: {error}", file=sys.stderr)
        return 2
    except (DiskError, BackendError) as error:
        print(f"tactile experiment {word}: {error}", file=sys.stderr)
        return 3


def _common(options: argparse.Namespace) -> Options:
    if options.seed < 0:
        raise ValueError(f"--seed is {options.seed}; seeds are 0 or above")
    return Options(
        scenes=options.scenes,
        seed=options.seed,
        sets=tuple(dict.fromkeys(options.set)),
        engines=tuple(dict.fromkeys(options.engine)),
        depths=tuple(dict.fromkeys(options.depth)),
        source=options.source,
        parameters=named_values("--param", options.param),
    )


def _study(study: Study, options: argparse.Namespace) -> int:
    """Run ``study``, tell how it goes and what came out."""
    check(study)
    directory: Path = options.out or Path("runs") / options.experiment
    backend: Backend = DaskCluster(options.dask) if options.dask else Processes(options.jobs)
    console = Console()
    bar = Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        console=console,
        disable=not console.is_terminal,
    )
    told = _Told(console, bar)
    try:
        with bar:
            summary = run_study(study, directory, backend, told, retry=options.retry)
    except KeyboardInterrupt:
        console.print(
            f"stopped: {told.finished} of {told.total} trials are finished and kept; "
            "the same command runs the rest"
        )
        return 130
    _say(console, summary, told, directory)
    return 1 if summary["errors"] else 0


class _Told:
    """Tells how far a run is, and remembers the first failures."""

    def __init__(self, console: Console, bar: Progress) -> None:
        self._console, self._bar = console, bar
        self._task: Any = None
        self._began = self._last = time.monotonic()
        self._before = 0
        self.finished = self.total = 0
        self.failed: list[str] = []

    def __call__(self, finished: int, total: int, row: Row | None) -> None:
        """As `runner.Progress`."""
        self.finished, self.total = finished, total
        if row is None:
            self._before = finished
            # Only what is run now says how fast it goes.
            self._task = self._bar.add_task("trials", total=total - finished)
            if finished:
                self._console.print(f"resuming: {finished} of {total} trials are finished")
            return
        self._bar.update(self._task, completed=finished - self._before)
        if row["error"] is not None and len(self.failed) < 3:
            self.failed.append(f"{describe(row)}: {row['error']}")
        now = time.monotonic()
        if not self._console.is_terminal and now - self._last > TOLD_EVERY_S:
            self._last = now
            left = (now - self._began) / (finished - self._before) * (total - finished)
            self._console.print(f"{finished} of {total} trials, {left / 60:.1f} min left")


def _say(console: Console, summary: dict[str, Any], told: _Told, directory: Path) -> None:
    session = summary["this_session"]
    if session["damaged_lines"]:
        console.print(
            f"{session['damaged_lines']} torn or damaged lines in trials.jsonl: those trials were "
            "run again"
        )
    if len(summary["versions_of_rows"]) > 1:
        console.print(
            "the rows come from several versions of the software: "
            + ", ".join(summary["versions_of_rows"])
        )
    console.print(
        f"{summary['trials']} trials, {session['trials']} of them now in {session['wall_s']:.0f} s "
        f"by {session['workers']} workers"
    )
    if summary["trials_per_core_minute"] is not None:
        console.print(
            f"trials_per_core_minute {summary['trials_per_core_minute']:.1f}, "
            f"speedup_vs_reference {summary['speedup_vs_reference']:.1f} "
            f"({summary['cpu_s_per_simulated_s']:.4f} CPU-s a simulated second, theirs 0.30)"
        )
    memory = summary["memory"]
    if memory["peak_mb"] is not None:
        growth = memory["growth_mb_per_1000"]
        console.print(
            f"memory of a worker: {memory['peak_mb']:.0f} MB at most"
            + ("" if growth is None else f", {growth:+.1f} MB in 1,000 trials")
        )
    if summary["errors"]:
        console.print(f"{summary['errors']} trials could not be run; the first:")
        for text in told.failed:
            console.print(f"  {text}", markup=False)
    console.print(f"wrote {directory}/trials.parquet, trials.csv and summary.json")


def _trial(options: argparse.Namespace) -> int:
    from tactile_tools.experiments.rerun_trial import run_again

    return run_again(options)


def _report(options: argparse.Namespace) -> int:
    from tactile_tools.experiments.report import write_report

    try:
        path = write_report(options.run, options.out or options.run, rows=options.rows)
    except OSError as error:
        raise DiskError(f"cannot write the report: {error}") from error
    print(f"wrote {path}")
    return 0


def _compare(options: argparse.Namespace) -> int:
    from tactile_tools.experiments.compare import compare_runs

    return compare_runs(options.first, options.second, options.csv)
