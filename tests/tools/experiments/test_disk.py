"""Folders that cannot be used and disks that fill up: a clear message, finished trials kept."""

from __future__ import annotations

import errno
import json
import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tactile_tools.experiments import journal as journal_module
from tactile_tools.experiments.journal import DiskError, FolderError, Journal, parse_lines
from tactile_tools.experiments.rows import Row, outcome_of, read_table
from tactile_tools.experiments.studies import Study, strategies_study

Run = Callable[..., dict[str, Any]]

QUICK = settings(
    max_examples=60,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)


@pytest.fixture
def rows(alone: Path) -> list[Row]:
    return list(parse_lines((alone / "trials.jsonl").read_bytes())[0].values())


def test_folder_of_another_experiment_is_refused_naming_the_difference(
    study: Study, alone: Path, options_of: Callable[..., Any], run_of: Run
) -> None:
    other = strategies_study(options_of(scenes=2), ("straight",))
    before = (alone / "trials.jsonl").read_bytes()
    with pytest.raises(FolderError) as caught:
        run_of(other, alone)
    text = str(caught.value)
    assert "holds another experiment" in text
    assert "scenes is 3 there and 2 here" in text
    assert "strategies is" in text
    assert "choose another --out" in text
    assert (alone / "trials.jsonl").read_bytes() == before


def test_folder_with_other_files_is_left_alone(study: Study, tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("years of work")
    with pytest.raises(FolderError, match=r"not empty \(it has thesis.tex\)"):
        Journal(tmp_path, study.definition)
    assert sorted(p.name for p in tmp_path.iterdir()) == [".lock", "thesis.tex"]


def test_folder_in_use_is_refused(study: Study, tmp_path: Path) -> None:
    with (
        Journal(tmp_path / "run", study.definition),
        pytest.raises(FolderError, match="another run is writing"),
    ):
        Journal(tmp_path / "run", study.definition)
    Journal(tmp_path / "run", study.definition).close()


@pytest.mark.parametrize("text", ["", "{", "[]", '{"format": 99}', '{"format": 1}'])
def test_damaged_definition_is_refused(text: str, study: Study, tmp_path: Path) -> None:
    (tmp_path / "experiment.json").write_text(text)
    with pytest.raises(FolderError):
        Journal(tmp_path, study.definition)


def test_full_disk_keeps_finished_trials(
    study: Study, alone: Path, run_of: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real, left = os.write, 3

    def write(descriptor: int, data: bytes) -> int:
        nonlocal left
        if not data.startswith(b'{"source"'):
            return real(descriptor, data)
        left -= 1
        # The last line for which there is any room is written in part, as the kernel does.
        if left < 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return real(descriptor, data if left else data[:100])

    monkeypatch.setattr(journal_module.os, "write", write)
    with pytest.raises(DiskError, match=r"is full: make room; finished trials are kept"):
        run_of(study, tmp_path / "run")
    monkeypatch.undo()
    assert len((tmp_path / "run" / "trials.jsonl").read_bytes().splitlines()) == 2
    summary = run_of(study, tmp_path / "run")
    assert (summary["this_session"]["resumed"], summary["this_session"]["damaged_lines"]) == (2, 0)
    assert [outcome_of(r) for r in read_table(tmp_path / "run" / "trials.parquet")] == [
        outcome_of(r) for r in read_table(alone / "trials.parquet")
    ]


def test_full_disk_while_writing_tables_keeps_the_old_ones(
    study: Study, alone: Path, run_of: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = (alone / "trials.parquet").read_bytes()

    def full(descriptor: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr("tactile_tools.experiments.rows.os.fsync", full)
    with pytest.raises(DiskError, match="is full"):
        run_of(study, alone)
    monkeypatch.undo()
    assert (alone / "trials.parquet").read_bytes() == before
    assert not list(alone.glob("*.part"))


LIMITED = """
import resource, sys, json
from pathlib import Path
from tactile_tools.experiments.journal import DiskError, Journal, parse_lines
resource.setrlimit(resource.RLIMIT_FSIZE, (4000, 4000))
folder, rows = Path(sys.argv[1]), parse_lines(Path(sys.argv[2]).read_bytes())[0].values()
with Journal(folder, {"study": "x"}) as journal:
    journal.load()
    try:
        for row in rows:
            journal.append(row)
    except DiskError as error:
        print(error)
"""


def test_short_write_leaves_whole_lines(alone: Path, tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", LIMITED, str(tmp_path / "run"), str(alone / "trials.jsonl")],
        capture_output=True,
        text=True,
        check=True,
        timeout=240,
    )
    assert "finished trials are kept" in done.stdout
    found, damaged = parse_lines((tmp_path / "run" / "trials.jsonl").read_bytes())
    assert damaged == 0
    assert 1 <= len(found) < 9


def test_folder_that_cannot_be_created_is_reported(study: Study, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(DiskError, match="cannot write to"):
        Journal(tmp_path / "file" / "run", study.definition)


def test_run_killed_before_its_definition_can_be_restarted(study: Study, tmp_path: Path) -> None:
    (tmp_path / ".lock").touch()
    (tmp_path / "experiment.json.part").write_text("{")
    with Journal(tmp_path, study.definition) as journal:
        assert journal.load() == {}


@QUICK
@given(data=st.data())
def test_truncated_journal_keeps_its_whole_lines(rows: list[Row], data: Any) -> None:
    whole = b"".join(json.dumps(row).encode() + b"\n" for row in rows)
    cut = whole[: data.draw(st.integers(0, len(whole)))]
    found, damaged = parse_lines(cut)
    assert list(found.values()) == rows[: cut.count(b"\n")]
    assert damaged == (not cut.endswith(b"\n") and bool(cut))


@QUICK
@given(data=st.data())
def test_damaged_journal_never_invents_a_trial(rows: list[Row], data: Any) -> None:
    lines = [json.dumps(row).encode() + b"\n" for row in rows]
    hit = data.draw(st.integers(0, len(lines) - 1))
    at = data.draw(st.integers(0, len(lines[hit]) - 1))
    damaged = bytearray(lines[hit])
    damaged[at] = data.draw(st.integers(0, 255).filter(lambda b: b not in b"0123456789."))
    lines[hit] = bytes(damaged)
    found, damaged = parse_lines(b"".join(lines))
    assert len(found) + damaged >= len(rows) - 1
    kept = [row for i, row in enumerate(rows) if i not in (hit, hit + 1)]
    assert all(row in found.values() for row in kept)


def test_lines_that_are_not_trials_are_counted(rows: list[Row]) -> None:
    lines = [
        b"null\n",
        b'{"source": "hardware"}\n',
        b"\xff\xfe\n",
        b"[1]\n",
        b"torn",
    ]
    assert parse_lines(b"".join(lines)) == ({}, 5)
    assert parse_lines(b"") == ({}, 0)


def test_row_of_the_wrong_type_is_not_a_trial(rows: list[Row]) -> None:
    wrong = {**rows[0], "distance_m": "near"}
    assert parse_lines(json.dumps(wrong).encode() + b"\n")[1] == 1
    wrong = {k: v for k, v in rows[0].items() if k != "ejected"}
    assert parse_lines(json.dumps(wrong).encode() + b"\n")[1] == 1


def test_equal_specifications_are_equal_trials(study: Study) -> None:
    spec = study.specs[0]
    assert replace(spec) in {spec}
