from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tactile_tools.experiments.backends import Processes
from tactile_tools.experiments.journal import Journal
from tactile_tools.experiments.rows import NAMES, Row
from tactile_tools.experiments.runner import run_study
from tactile_tools.experiments.spec import IDENTITY, TrialSpec
from tactile_tools.experiments.studies import Options, Study, strategies_study

QUICK = {"time_limit": 1.5}
"""Long enough to drive into the first objects, and a fiftieth of a whole trial's work."""


def quick_options(scenes: int = 3, **changed: Any) -> Options:
    """Grid scenes are made in 3 ms; those of the authors' simulator take a hundred times that."""
    settings: dict[str, Any] = {
        "scenes": scenes,
        "seed": 5,
        "sets": ("hardware",),
        "engines": ("mujoco",),
        "depths": ("contacts",),
        "source": None,
        "parameters": QUICK,
    }
    return Options(**{**settings, **changed})


def silent(finished: int, total: int, row: Row | None) -> None:
    """Show no progress."""


@pytest.fixture(scope="session")
def options_of() -> Callable[..., Options]:
    return quick_options


@pytest.fixture(scope="session")
def study() -> Study:
    return strategies_study(quick_options(), ("straight", "burrow", "hybrid_event"))


@pytest.fixture(scope="session")
def run_of() -> Callable[..., dict[str, Any]]:
    """Run a study, given study, folder and workers."""

    def run(study: Study, folder: Path, jobs: int = 1, **more: Any) -> dict[str, Any]:
        return run_study(study, folder, Processes(jobs), silent, **more)

    return run


@pytest.fixture(scope="session")
def alone(
    study: Study,
    run_of: Callable[..., dict[str, Any]],
    tmp_path_factory: pytest.TempPathFactory,
) -> Path:
    """A run by one worker, not interrupted."""
    folder = tmp_path_factory.mktemp("alone") / "run"
    run_of(study, folder)
    return folder


@pytest.fixture
def command() -> Callable[..., subprocess.CompletedProcess[str]]:
    """Run ``tactile experiment`` as a separate process."""

    def call(*words: object, **more: Any) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, "-m", "tactile_tools.cli", "experiment", *map(str, words)],
            capture_output=True,
            text=True,
            timeout=100,
            check=False,
            **more,
        )

    return call


@pytest.fixture(scope="session")
def made_row() -> Callable[..., Row]:
    """Make a row without a trial, from a given outcome."""

    def make(spec: TrialSpec, **outcome: Any) -> Row:
        row: Row = dict.fromkeys(NAMES)
        row.update({name: getattr(spec, name) for name in IDENTITY})
        row.update(
            objects=18,
            fill=0.3,
            success=False,
            reason="timeout",
            entered=False,
            distance_m=0.1,
            closest_m=0.1,
            normalized_distance=0.25,
            normalized_closest=0.25,
            time_s=20.0,
            time_limit_s=20.0,
            normalized_time=1.0,
            excavations=0,
            peak_contact_n=5.0,
            peak_load_n=8.0,
            mean_load_n=2.0,
            peak_arm_n=9.0,
            ejected=0,
            interventions=0,
            interventions_by_code="{}",
            simulated_s=20.0,
            version="1",
            wall_s=0.3,
            cpu_s=0.2,
            scene_cpu_s=0.1,
            memory_mb=80.0,
            worker="here:1",
            worker_trials=1,
        )
        row.update({n: 0 for n in NAMES if n.startswith("excavations_")})
        row.update(outcome)
        return row

    return make


@pytest.fixture(scope="session")
def filled(made_row: Callable[..., Row]) -> Callable[..., Path]:
    """Make a run with made-up rows, given study, folder, and a function from trial to outcome."""

    def fill(
        study: Study,
        folder: Path,
        outcome: Callable[[TrialSpec, np.random.Generator], dict[str, Any]],
    ) -> Path:
        rng = np.random.default_rng(7)
        with Journal(folder, study.definition) as journal:
            journal.load()
            for index, spec in enumerate(study.specs):
                row = made_row(spec, worker_trials=index + 1)
                row.update(outcome(spec, rng))
                journal.append(row)
        return folder

    return fill
