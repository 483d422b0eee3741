"""Commands of ``tactile experiment``, and their messages when they fail."""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Callable, Mapping, Sequence
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

from sim_device.world.engines import ENGINES
from tactile_core.cli import PAPER_STRATEGIES, REFUSED, CommandError, require, working
from tactile_tools.experiments.arguments import named_values
from tactile_tools.experiments.backends import Backend, BackendError, Processes
from tactile_tools.experiments.cli import AXIS_NAMES
from tactile_tools.experiments.dask_backend import DaskCluster
from tactile_tools.experiments.document import percent, slug
from tactile_tools.experiments.journal import DiskError, FolderError
from tactile_tools.experiments.rows import Row, TableError, describe
from tactile_tools.experiments.runner import check, run_study
from tactile_tools.experiments.statistics import Rate
from tactile_tools.experiments.studies import (
    READINGS,
    Options,
    Study,
    robustness_study,
    strategies_study,
    sweep_study,
)
from tactile_tools.experiments.tables import load_run

SETS, DEPTHS = ("authors_sim",), ("contacts",)
"""Defaults of a study that names none."""

BENCHMARK_ENGINES = ("mujoco", "pymunk")

STOPPED = 130
"""Exit status after Ctrl-C."""

REPORT_EVERY_S = 30.0
"""Seconds between lines of progress where there is no terminal for a bar."""


def _as_command(work: Callable[[argparse.Namespace], int]) -> Callable[[argparse.Namespace], int]:
    """``work`` as a command: every failure that a user can cause becomes a `CommandError`."""

    def command(options: argparse.Namespace) -> int:
        try:
            return work(options)
        except (FolderError, TableError, ValueError) as error:
            # Invalid settings, strategies and scenes raise ValueError, with their remedy.
            raise CommandError(str(error)) from error
        except (DiskError, BackendError) as error:
            raise CommandError(str(error), REFUSED) from error

    return command


def _common(options: argparse.Namespace) -> Options:
    return Options(
        scenes=options.scenes,
        seed=options.scene_seed,
        sets=tuple(dict.fromkeys(options.set or SETS)),
        engines=tuple(dict.fromkeys(options.engine or ENGINES[:1])),
        depths=tuple(dict.fromkeys(options.depth or DEPTHS)),
        source=options.source,
        parameters=named_values("--param", options.param),
    )


def _study_command(make: Callable[[argparse.Namespace], Study], word: str) -> Any:
    """A study as a command."""

    def run(options: argparse.Namespace) -> int:
        return _study(make(options), options, word)

    return _as_command(run)


def _sweep(options: argparse.Namespace) -> Study:
    both = options.primitive == "both"
    return sweep_study(
        _common(options),
        ("burrow", "excavate") if both else (options.primitive,),
        tuple(READINGS) if options.frequency == "both" else (options.frequency,),
    )


def _chosen(options: argparse.Namespace) -> tuple[str, ...]:
    return tuple(options.strategy or PAPER_STRATEGIES)


strategies = _study_command(lambda o: strategies_study(_common(o), _chosen(o)), "strategies")
sweep = _study_command(_sweep, "sweep")
robustness = _study_command(
    lambda o: robustness_study(_common(o), _chosen(o), tuple(o.axis or AXIS_NAMES)), "robustness"
)


def _study(study: Study, options: argparse.Namespace, word: str) -> int:
    """Run ``study``, show progress and print the result. Returns the exit status."""
    check(study)
    directory: Path = options.out or Path("runs") / word
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
    reporter = _Reporter(console, bar)
    try:
        with bar:
            summary = run_study(study, directory, backend, reporter, retry=options.retry)
    except KeyboardInterrupt:
        console.print(
            f"stopped: {reporter.finished} of {reporter.total} trials are finished and kept; "
            "the same command runs the rest"
        )
        return STOPPED
    _print_summary(console, summary, reporter, directory)
    return 1 if summary["errors"] else 0


class _Reporter:
    """Prints how far a run is, and keeps the first failures."""

    def __init__(self, console: Console, bar: Progress) -> None:
        self._console, self._bar = console, bar
        self._task: Any = None
        self._began = self._last = time.monotonic()
        self._before = 0
        self.finished = self.total = 0
        self.failed: list[str] = []

    def __call__(self, finished: int, total: int, row: Row | None) -> None:
        """Report progress; see `runner.Progress`."""
        self.finished, self.total = finished, total
        if row is None:
            self._before = finished
            # Only trials of this session say how fast it goes.
            self._task = self._bar.add_task("trials", total=total - finished)
            if finished:
                self._console.print(f"resuming: {finished} of {total} trials are finished")
            return
        self._bar.update(self._task, completed=finished - self._before)
        if row["error"] is not None and len(self.failed) < 3:
            self.failed.append(f"{describe(row)}: {row['error']}")
        now = time.monotonic()
        if not self._console.is_terminal and now - self._last > REPORT_EVERY_S:
            self._last = now
            left = (now - self._began) / (finished - self._before) * (total - finished)
            self._console.print(f"{finished} of {total} trials, {left / 60:.1f} min left")


def _print_summary(
    console: Console, summary: dict[str, Any], reporter: _Reporter, directory: Path
) -> None:
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
        for text in reporter.failed:
            console.print(f"  {text}", markup=False)
    console.print(f"wrote {directory}/trials.parquet, trials.csv and summary.json")


@_as_command
def benchmark(options: argparse.Namespace) -> int:
    """``tactile benchmark``."""
    from reachd.strategies.runner import is_privileged
    from tactile_tools.experiments import benchmark as board

    _look_here(options.strategy)
    sets = tuple(dict.fromkeys(options.sets or board.SCENE_SETS))
    missing = board.recorded_missing() if "recorded" in sets else None
    if missing and not options.sets:
        print(f"note: without the set recorded: {missing}")
        sets = tuple(name for name in sets if name != "recorded")
    elif missing:
        raise ValueError(missing)
    common = Options(
        scenes=options.scenes,
        seed=board.FIRST_SEED,
        sets=sets,
        engines=tuple(dict.fromkeys(options.engine or BENCHMARK_ENGINES)),
        depths=tuple(dict.fromkeys(options.depth or ("contacts", "taxels"))),
        source=None,
        parameters=named_values("--param", options.param),
    )
    limits = tuple(sorted(dict.fromkeys(options.limit or board.LIMITS_S)))
    study = board.benchmark_study(common, options.strategy, limits)
    name = options.name or options.strategy
    if is_privileged(options.strategy) and "privileged" not in name.lower():
        raise ValueError(
            f"--name {name!r}: strategy {options.strategy!r} is told where the objects are, so its "
            "name on the leaderboard must contain 'privileged'"
        )
    options.out = options.out or Path("runs") / f"benchmark-{slug(name)}"
    options.dask = None
    code = _study(study, options, "benchmark")
    if code == STOPPED:
        return code
    entry = board.entry_of(study, load_run(options.out).rows, name, options.note)
    path = options.entry or options.out / "entry.json"
    try:
        if path.exists():
            entry = board.merged(board.read_entry(path), entry)
        board.write_entry(entry, path)
    except OSError as error:
        raise DiskError(f"cannot write {path}: {error.strerror}") from error
    _show_entry(entry)
    print(f"wrote {path}")
    return code


@_as_command
def oracle(options: argparse.Namespace) -> int:
    """``tactile experiment oracle``."""
    from tactile_tools.experiments import benchmark as board

    require("numba", extra="train", what="the privileged planner")
    study = board.oracle_study(
        Options(
            scenes=options.scenes,
            seed=options.scene_seed,
            sets=tuple(dict.fromkeys(options.set or ("squeezed",))),
            engines=tuple(dict.fromkeys(options.engine or ENGINES[:1])),
            depths=DEPTHS,
            source=None,
            parameters=named_values("--param", options.param),
        )
    )
    options.out = options.out or Path("runs") / "oracle"
    code = _study(study, options, "oracle")
    if code != STOPPED:
        _show_cases(board.oracle_summaries(study, load_run(options.out).rows))
    return code


def _look_here(strategy: str) -> None:
    """Let a strategy module:Class lie in the current folder, here and in the workers."""
    here = os.getcwd()
    if ":" in strategy and here not in sys.path:
        sys.path.append(here)


def _show_entry(entry: dict[str, Any]) -> None:
    """Print an entry, a line a case."""
    print(entry["name"])
    _show_cases(entry["cases"])


def _show_cases(cases: Sequence[Mapping[str, Any]]) -> None:
    """Print a line a case."""
    form = "{:13} {:7} {:8} {:>5} {:>17} {:>6} {:>13} {:>4} {:>5}"
    heads = (
        "set",
        "engine",
        "depth",
        "limit",
        "success [95 %]",
        "time",
        "force, p90",
        "out",
        "CPU",
    )
    print(form.format(*heads))
    for case in cases:
        cells = [f"{case['errors']} errors", "", "", "", ""]
        if "success" in case:
            force = case["peak_contact_n"]
            cells = [
                percent(Rate(*case["success"][:2])),
                f"{case['time_s']['mean']:.1f} s",
                f"{force['median']:.1f}, {force['p90']:.1f} N",
                f"{case['ejected_per_trial']:.2f}",
                f"{case['cpu_s_per_trial']:.1f} s",
            ]
        limit = f"{case['limit_s']:g} s"
        print(form.format(case["set"], case["engine"], case["depth"], limit, *cells))
    print(
        "time, out (objects pushed out) and CPU: means of a trial; force: greatest contact, median"
    )


@_as_command
def trial(options: argparse.Namespace) -> int:
    """``tactile experiment trial``."""
    if options.png is not None:
        require("matplotlib", "scipy", extra="plot")
    from tactile_tools.experiments.rerun_trial import rerun

    return rerun(options)


@_as_command
def report(options: argparse.Namespace) -> int:
    """``tactile experiment report``."""
    from tactile_tools.experiments.report import write_report

    try:
        with working("drawing the report"):
            path = write_report(options.run, options.out or options.run, rows=options.rows)
    except OSError as error:
        raise DiskError(f"cannot write the report: {error}") from error
    print(f"wrote {path}")
    return 0


@_as_command
def compare(options: argparse.Namespace) -> int:
    """``tactile experiment compare``."""
    from tactile_tools.experiments.compare import compare_runs

    return compare_runs(options.first, options.second, options.out)
