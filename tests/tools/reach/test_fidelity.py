"""``tactile fidelity`` on one of the recorded scenes."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tactile_tools.cli import main
from tests.support.paths import DATA

RECORDED = DATA / "recorded_scenes"


def test_missing_recordings_are_reported(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["fidelity", "--recorded", str(tmp_path / "none.gz")]) == 3
    assert "none.gz" in capsys.readouterr().err


def test_scenes_are_compared_outcome_by_outcome(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The outcomes are our own, so they agree unless another machine calculates differently."""
    report = tmp_path / "fidelity.json"
    words = ["fidelity", "--recorded", str(RECORDED / "scenes_5_8.json.gz"), "--limit", "1"]
    assert main([*words, "--repeats", "1", "--jobs", "2", "--json", str(report)]) == 0
    written = json.loads(report.read_text())
    assert len(written["trials"]) == 5 * 2
    assert {t["strategy"] for t in written["trials"]} == set(written["summary"])
    for one in written["summary"].values():
        assert 0.0 <= one["own_agreement"] <= 1.0
    assert sum(one["agreement"] for one in written["summary"].values()) >= 4
    for wrong in (["--repeats", "-1"], ["--jobs", "0"], ["--limit", "0"]):
        with pytest.raises(SystemExit) as refused:
            main([*words, *wrong])
        assert refused.value.code == 2
        assert "a whole number of at least" in capsys.readouterr().err
    stranger = tmp_path / "scenes_of_mine.json.gz"
    stranger.write_bytes((RECORDED / "scenes_5_8.json.gz").read_bytes())
    assert main(["fidelity", "--recorded", str(stranger)]) == 3
    assert "outcomes_of_mine.csv" in capsys.readouterr().err
