"""``tactile crosscheck``: an engine beside another on the same scenes."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tactile_tools.cli import main
from tactile_tools.dev.crosscheck import summarise
from tactile_tools.dev.fidelity import Trial


def trial(success: bool, strategy: str = "straight") -> Trial:
    return Trial(
        seed=1, strategy=strategy, perturbed=0, success=success, entered=success, distance=0.0,
        time=1.0, excavations=0, ejected=0, peak_load=1.0, mean_load=1.0, simulated_s=1.0,
        cpu_s=0.1,
    )  # fmt: skip


def test_an_engine_is_judged_by_another(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    report = tmp_path / "report.json"
    words = ["crosscheck", "--engine", "mujoco", "--beside", "mujoco", "--scenes", "1"]
    words += ["--strategy", "straight", "--jobs", "1", "--out", str(report)]
    assert main(words) == 0
    written = json.loads(report.read_text())
    # An engine beside itself: alike to the bit, and not the run whose start was moved.
    mine, other, moved = (written["trials"][run][0] for run in ("engine", "beside", "moved"))
    assert mine["distance"] == other["distance"] != moved["distance"]
    assert written["summary"]["all"]["agreement"] == 1.0
    assert written["loads"]["engine"] == written["loads"]["beside"]
    assert "outcomes alike" in capsys.readouterr().out


def test_agreement_stands_beside_its_ceiling() -> None:
    rows = {
        "engine": [trial(True), trial(True), trial(False), trial(False)],
        "beside": [trial(True), trial(False), trial(True), trial(False)],
        "moved": [trial(True), trial(False), trial(True), trial(True)],
    }
    found = summarise(rows, ("straight",))  # type: ignore[arg-type]
    assert found["straight"] == found["all"]
    assert found["all"]["agreement"] == 0.5
    assert found["all"]["ceiling"] == 0.75
    assert (found["all"]["won"], found["all"]["lost"]) == (1, 1)


def test_unknown_scenes_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["crosscheck", "--engine", "mujoco", "--scene", "attic"]) == 2
    assert "no scenes are called 'attic'" in capsys.readouterr().err
