"""Long runs, shortened: they find nothing, repeat by seed, and tell where to continue."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tactile_tools.cli import main
from tactile_tools.dev.fuzz import PIPELINE_KINDS, run_pipeline
from tactile_tools.dev.fuzzers import pipeline


def test_arbitrary_frames_with_valid_crcs_break_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("tactile_tools.dev.fuzz.PIPELINE_BLOCK", 150)
    done = run_pipeline(450, seed=11)
    assert done["failures"] == []
    assert done["mutated"] >= 450
    assert done["media"]["serial"]["features"] > 0
    assert done["media"]["serial"]["oversized"] == 0


def test_fuzz_block_repeats_by_number_and_a_run_resumes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tactile_tools.dev.fuzz.PIPELINE_BLOCK", 100)
    whole = run_pipeline(300, seed=5)
    assert sorted(whole["media"]) == sorted(PIPELINE_KINDS)
    assert whole["failures"] == []
    first = run_pipeline(100, seed=5)
    rest = run_pipeline(200, seed=5, first=first["next_block"])
    for kind in PIPELINE_KINDS:
        part = first["media"].get(kind) or rest["media"].get(kind)
        assert part == whole["media"][kind]
    assert run_pipeline(300, seed=5, seconds=1e-9)["next_block"] <= 1


def test_fuzz_failure_names_its_block(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, tmp_path: Path
) -> None:
    """A pipeline that never serves a correct board again is detected."""
    monkeypatch.setattr(pipeline, "RECOVERY_S", 0.0)
    out = tmp_path / "f.json"
    words = ["fuzz", "--through", "pipeline", "--frames", "50", "--jobs", "1", "--json", str(out)]
    assert main([*words, "--from-block", "3"]) == 1
    assert "block 3 (serial): " in capsys.readouterr().out
    (failure,) = json.loads(out.read_text(encoding="utf-8"))["failures"]
    assert "no honest board in service" in failure["failure"]


def test_killed_process_stops_the_arm_and_its_log_is_readable(
    tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    out = tmp_path / "kills.json"
    words = ["crash", "--processes", "--seed", "4", "--out", str(out)]
    assert main([*words, "--kills", "1"]) == 0
    told = json.loads(out.read_text(encoding="utf-8"))
    assert told["summary"]["kills"] == 1
    assert told["summary"]["problems"] == []
    # The same command goes on, and with another seed it does not mix two runs.
    before = out.read_bytes()
    assert main([*words, "--kills", "1"]) == 0
    assert out.read_bytes() == before
    assert main(["crash", "--processes", "--seed", "5", "--out", str(out)]) == 2
    assert "--seed 4" in capsys.readouterr().err
    assert out.read_bytes() == before


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["soak", "--boards", "0"], "from 1 to 16"),
        (["soak", "--minutes", "nan"], "above 0"),
        (["crash", "--processes", "--rigs", "x"], "a whole number"),
        (["fuzz", "--through", "disk"], "pipeline"),
    ],
)
def test_bad_input_is_refused(words: list[str], said: str, capsys: pytest.CaptureFixture) -> None:
    with pytest.raises(SystemExit) as ended:
        main(words)
    assert ended.value.code == 2
    assert said in capsys.readouterr().err


def test_soak_with_a_board_mostly_unplugged_is_refused(
    capsys: pytest.CaptureFixture, tmp_path: Path
) -> None:
    assert main(["soak", "--replug", "0.1"]) == 2
    assert "allowed: above 0.2 s" in capsys.readouterr().err
    assert main(["soak", "--json", str(tmp_path / "none" / "x.json")]) == 2
