"""``tactile fidelity`` on one of the recorded scenes."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tactile_tools.cli import main

RECORDED = Path(__file__).parents[2].parent / "shared" / "data" / "authors_scenes"


def test_without_recordings_it_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["fidelity", "--scenes", str(tmp_path / "none.gz")]) == 3
    assert "none.gz" in capsys.readouterr().err


@pytest.mark.skipif(not RECORDED.is_dir(), reason=f"the recordings are not at {RECORDED}")
def test_a_scene_is_compared_outcome_by_outcome(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    report = tmp_path / "fidelity.json"
    scenes, outcomes = RECORDED / "scenes_1_60.json.gz", RECORDED / "outcomes_1_60.csv"
    words = ["fidelity", "--scenes", str(scenes), "--outcomes", str(outcomes), "--most", "1"]
    assert main([*words, "--repeats", "1", "--jobs", "2", "--json", str(report)]) == 0
    written = json.loads(report.read_text())
    assert len(written["trials"]) == 5 * 2
    assert {t["strategy"] for t in written["trials"]} == set(written["summary"])
    for one in written["summary"].values():
        assert 0.0 <= one["agreement"] <= 1.0
    assert main([*words, "--repeats", "-1"]) == 2
