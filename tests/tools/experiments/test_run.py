"""A run gives the same rows whoever runs it, and whatever interrupts it."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import psutil
import pytest

from tactile_tools.experiments.journal import Journal, parse_lines
from tactile_tools.experiments.rows import Row, outcome_of, read_table
from tactile_tools.experiments.spec import TrialSpec, canonical, spec_of
from tactile_tools.experiments.studies import Study, strategies_study
from tactile_tools.experiments.tables import load_run

Run = Callable[..., dict[str, Any]]


def outcomes(folder: Path) -> list[Row]:
    return [outcome_of(row) for row in read_table(folder / "trials.parquet")]


def test_two_workers_give_the_same_rows_as_one(
    study: Study, alone: Path, run_of: Run, tmp_path: Path
) -> None:
    summary = run_of(study, tmp_path / "two", jobs=2)
    rows = outcomes(tmp_path / "two")
    assert rows == outcomes(alone)
    assert len(rows) == len(study.specs) == summary["trials"] == 9
    assert summary["errors"] == 0
    assert summary["this_session"]["workers"] == 2
    assert summary["trials_per_core_minute"] > 0
    assert summary["speedup_vs_reference"] > 0
    table = read_table(tmp_path / "two" / "trials.parquet")
    assert len({row["worker"] for row in table}) == 2
    assert all(row["memory_mb"] > 10 and row["cpu_s"] > 0 for row in table)


def test_csv_holds_the_same_table(alone: Path) -> None:
    import csv

    with (alone / "trials.csv").open(newline="") as stream:
        texts = list(csv.DictReader(stream))
    rows = read_table(alone / "trials.parquet")
    assert [t["strategy"] for t in texts] == [r["strategy"] for r in rows]
    assert [float(t["distance_m"]) for t in texts] == [r["distance_m"] for r in rows]
    assert all(t["error"] == "" for t in texts)


def test_extended_run_keeps_finished_trials(
    study: Study, alone: Path, run_of: Run, options_of: Callable[..., Any], tmp_path: Path
) -> None:
    folder = tmp_path / "grown"
    run_of(strategies_study(options_of(scenes=2), ("straight", "hybrid_event")), folder)
    summary = run_of(study, folder)
    assert summary["this_session"]["resumed"] == 4
    assert summary["this_session"]["trials"] == 5
    assert outcomes(folder) == outcomes(alone)
    assert load_run(folder).missing == 0


@pytest.mark.random
def test_run_killed_at_random_and_resumed_gives_the_same_table(
    alone: Path, run_of: Run, study: Study, tmp_path: Path, fresh_seed: int
) -> None:
    folder = tmp_path / "killed"
    words = [
        "strategies", "--set", "hardware", "--scenes", "3", "--seed", "5", "--jobs", "2",
        "--strategies", "straight", "burrow", "hybrid_event", "--param", "time_limit=1.5",
        "--out", str(folder),
    ]  # fmt: skip
    command = [sys.executable, "-m", "tactile_tools.cli", "experiment", *words]
    whole = len(study.specs)
    rng = random.Random(fresh_seed)
    kills = 0
    for _ in range(2):
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        journal = folder / "trials.jsonl"
        # At a random number of finished trials, and then at a random time from there.
        wanted = finished(journal) + rng.randrange(1, 4)
        deadline = time.monotonic() + 90
        while finished(journal) < min(wanted, whole) and process.poll() is None:
            assert time.monotonic() < deadline
            time.sleep(0.002)
        time.sleep(rng.uniform(0, 0.05))
        children = psutil.Process(process.pid).children(recursive=True) if alive(process) else []
        process.kill()
        kills += process.wait() == -signal.SIGKILL
        # Workers end by themselves once the parent has gone.
        _, left = psutil.wait_procs(children, timeout=60)
        assert not left
    assert kills
    done = finished(folder / "trials.jsonl")
    summary = run_of(study, folder)
    assert summary["this_session"]["resumed"] == done
    assert outcomes(folder) == outcomes(alone)


def alive(process: subprocess.Popen[bytes]) -> bool:
    return process.poll() is None


def finished(journal: Path) -> int:
    return len(parse_lines(journal.read_bytes())[0]) if journal.exists() else 0


def test_finished_run_reruns_nothing(
    study: Study, run_of: Run, alone: Path, tmp_path: Path
) -> None:
    before = (alone / "trials.jsonl").read_bytes()
    summary = run_of(study, alone)
    assert summary["this_session"]["trials"] == 0
    assert (alone / "trials.jsonl").read_bytes() == before


def test_scene_that_cannot_be_made_is_a_failed_row(
    options_of: Callable[..., Any], run_of: Run, tmp_path: Path
) -> None:
    study = strategies_study(options_of(scenes=1), ("straight",))
    full = replace(study.specs[0], conditions=canonical({"objects": [34, 35]}))
    too_many = replace(study.specs[0], conditions=canonical({"objects": [36, 36]}))
    mixed = Study({"study": "strategies"}, (too_many, full, *study.specs))
    summary = run_of(mixed, tmp_path / "run")
    rows = {row["conditions"]: row for row in read_table(tmp_path / "run" / "trials.parquet")}
    assert "36 objects on 35 cells" in rows[too_many.conditions]["error"]
    assert rows[too_many.conditions]["success"] is None
    assert rows["{}"]["error"] is None
    assert summary["errors"] >= 1
    # A failure stays when a run is resumed, and is tried again only when asked for.
    assert run_of(mixed, tmp_path / "run")["this_session"]["trials"] == 0
    again = run_of(mixed, tmp_path / "run", retry=True)
    assert again["this_session"]["trials"] == again["errors"] == summary["errors"]


KILLER = """
import os
from reachd.interfaces import Twist

class Killer:
    activity = "killing"

    def __init__(self, parameters, rng):
        pass

    def start(self, goal, now):
        pass

    def step(self, touch, arm, goal, now):
        os.kill(os.getpid(), 9)
"""


def test_crashing_trial_is_a_failed_row_and_others_continue(
    options_of: Callable[..., Any],
    run_of: Run,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    (tmp_path / "killer.py").write_text(KILLER)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.syspath_prepend(str(tmp_path))
    study = strategies_study(options_of(scenes=1), ("killer:Killer", "straight"))
    summary = run_of(study, tmp_path / "run", jobs=2)
    rows = read_table(tmp_path / "run" / "trials.parquet")
    for row in rows:
        if row["strategy"] == "straight":
            assert row["error"] is None
        else:
            assert "SIGKILL" in row["error"]
    assert (summary["trials"], summary["errors"]) == (2, 1)


def test_torn_and_damaged_lines_are_rerun(
    study: Study, alone: Path, run_of: Run, tmp_path: Path
) -> None:
    folder = tmp_path / "torn"
    folder.mkdir()
    (folder / "experiment.json").write_bytes((alone / "experiment.json").read_bytes())
    lines = (alone / "trials.jsonl").read_bytes().splitlines(keepends=True)
    lines[3] = b"\x00" * 40 + b"\n"
    (folder / "trials.jsonl").write_bytes(b"".join(lines)[:-25])
    summary = run_of(study, folder)
    session = summary["this_session"]
    assert (session["damaged_lines"], session["trials"], session["resumed"]) == (2, 2, 7)
    assert outcomes(folder) == outcomes(alone)
    with Journal(folder, study.definition) as journal:
        assert len(journal.load()) == 9
        assert journal.damaged == 0


@pytest.mark.parametrize("engine", ["mujoco", "pymunk"])
def test_row_is_independent_of_earlier_trials_in_the_process(
    engine: str, options_of: Callable[..., Any]
) -> None:
    from tactile_tools.experiments.trial import run_one

    options = options_of(scenes=2, engines=(engine,), parameters={"time_limit": 4.0})
    first, other = strategies_study(options, ("burrow",)).specs
    row = outcome_of(run_one(first))
    run_one(other)
    assert outcome_of(run_one(first)) == row
    assert row["peak_load_n"] > 0


def test_run_has_exactly_the_rows_of_its_study(alone: Path, study: Study) -> None:
    run = load_run(alone)
    assert {spec_of(row) for row in run.rows} == set(study.specs)
    assert run.missing == 0
    assert run.study == study


def test_workers_are_single_threaded_and_the_parent_is_unchanged(
    study: Study, monkeypatch: pytest.MonkeyPatch
) -> None:
    from tactile_tools.experiments import backends

    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    worker = backends._start_worker()
    try:
        assert "OMP_NUM_THREADS" not in os.environ
        environment: dict[str, str] = {}
        deadline = time.monotonic() + 30
        while "PATH" not in environment:  # it has none in the moment of its start
            assert time.monotonic() < deadline
            environment = psutil.Process(worker.process.pid).environ()
        assert environment["OMP_NUM_THREADS"] == "1"
    finally:
        worker.end()


def test_each_batch_holds_one_scene() -> None:
    from tactile_tools.experiments.backends import batches

    specs = [
        TrialSpec("hardware", seed, "hardware", "mujoco", "contacts", f"s{i}", seed)
        for seed in range(3)
        for i in range(5)
    ]
    made = batches(specs, 4)
    assert [len(b) for b in made] == [4, 1, 4, 1, 4, 1]
    assert [s for b in made for s in b] == specs
    assert all(len({s.scene_seed for s in b}) == 1 for b in made)
