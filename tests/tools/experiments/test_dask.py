"""Same rows from a Dask cluster of two worker processes."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tactile_tools.experiments.backends import BackendError
from tactile_tools.experiments.dask_backend import DaskCluster
from tactile_tools.experiments.rows import Row, outcome_of, read_table
from tactile_tools.experiments.runner import run_study
from tactile_tools.experiments.studies import Study, strategies_study

distributed = pytest.importorskip("distributed", reason="Dask is an optional extra")


def silent(finished: int, total: int, row: Row | None) -> None:
    """Show no progress."""


KILLER = """
import os

class Killer:
    activity = "killing"

    def __init__(self, parameters, rng):
        pass

    def start(self, goal, now):
        pass

    def step(self, touch, arm, goal, now):
        os.kill(os.getpid(), 9)
"""


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    import dask

    folder = tmp_path_factory.mktemp("plugin")
    (folder / "killer.py").write_text(KILLER)
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(folder))  # which the workers' processes inherit
        # One dead worker is enough to give up a task: each takes seconds to start again.
        with dask.config.set({"distributed.scheduler.allowed-failures": 0}):
            yield from started()


def started() -> Iterator[Any]:
    with distributed.LocalCluster(
        n_workers=2,
        threads_per_worker=1,
        processes=True,
        dashboard_address=None,
        silence_logs=logging.CRITICAL,
    ) as made:
        yield made


def test_two_dask_workers_give_the_same_rows_as_one_process(
    cluster: Any, study: Study, alone: Path, tmp_path: Path
) -> None:
    backend = DaskCluster(cluster.scheduler_address)
    summary = run_study(study, tmp_path / "run", backend, silent)
    rows = read_table(tmp_path / "run" / "trials.parquet")
    assert [outcome_of(r) for r in rows] == [
        outcome_of(r) for r in read_table(alone / "trials.parquet")
    ]
    assert summary["this_session"]["workers"] == 2
    assert len({row["worker"] for row in rows}) == 2


def test_crashing_trial_is_recorded_without_affecting_others_on_dask(
    cluster: Any, options_of: Callable[..., Any], tmp_path: Path
) -> None:
    study = strategies_study(options_of(scenes=1), ("killer:Killer", "straight"))
    run_study(study, tmp_path / "run", DaskCluster(cluster.scheduler_address), silent)
    rows = {row["strategy"]: row for row in read_table(tmp_path / "run" / "trials.parquet")}
    assert "workers that ran it died" in rows["killer:Killer"]["error"]
    assert rows["straight"]["error"] is None


def test_missing_scheduler_is_reported_with_a_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tactile_tools.experiments.dask_backend.CONNECT_S", 0.3)
    with (
        pytest.raises(BackendError, match=r"tcp://127\.0\.0\.1:1 .*start `dask scheduler`"),
        DaskCluster("tcp://127.0.0.1:1"),
    ):
        pass
