"""Command lines of ``tactile reach``, ``demo`` and ``bench``."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tactile_tools.cli import main
from tests.support import trial_trace

BAD = [
    (["--strategy", "luck"], "available: straight, burrow, excavate, hybrid_clock, hybrid_event"),
    (["--strategy", "nowhere:Mine"], "No module named 'nowhere'"),
    (["--strategy", "json:Mine"], "module 'json' has no class 'Mine'"),
    (["--scene", "attic"], "allowed: authors_sim, hardware"),
    (["--scene", "none.json"], "none.json: cannot be read"),
    (["--scene", "bad.json"], "no JSON"),
    (["--scene", "recorded:none.gz"], "cannot read none.gz"),
    (["--seed", "-1"], "allowed: a whole number from 0"),
    (["--seed", "seven"], "allowed: a whole number from 0"),
    (["--trial-seed", "1e3"], "allowed: a whole number from 0"),
    (["--set", "mine"], "available: hardware, authors_sim"),
    (["--depth", "skin"], "allowed: contacts, taxels"),
    (["--engine", "bullet"], "allowed: mujoco, planar, pymunk"),
    (["--png", "x.png"], "give --log as well"),
    (["--log", "x.mcap", "--png", "nowhere/x.png"], "there is no folder nowhere"),
]


def code_of(words: list[str]) -> int:
    try:
        return main(words)
    except SystemExit as ended:  # argparse
        return int(ended.code or 0)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(("words", "printed"), BAD, ids=[" ".join(words) for words, _ in BAD])
def test_bad_input_is_refused_with_allowed_values(
    words: list[str], printed: str, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    Path("bad.json").write_text("{")
    assert code_of(["reach", *words]) == 2
    errors = capsys.readouterr().err
    assert printed in " ".join(errors.split())
    assert "Traceback" not in errors
    assert [p.name for p in folder.iterdir()] == ["bad.json"], "nothing is left behind"


@pytest.mark.parametrize("log", ["taken.mcap", "/proc/nowhere/x.mcap"])
def test_unwritable_log_is_reported_before_the_trial(
    log: str, folder: Path, scene_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    Path("taken.mcap").write_bytes(b"mine")
    assert code_of(["reach", "--scene", str(scene_file), "--log", log]) == 3
    printed = capsys.readouterr()
    assert str(Path(log).parent if log.startswith("/") else log) in printed.err
    assert "simulated seconds" not in printed.out
    assert Path("taken.mcap").read_bytes() == b"mine"


def test_unwritable_picture_is_reported(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    Path("free.json").write_text(trial_trace.crowded(0).to_json())
    Path("x.png").mkdir()
    words = ["--strategy", "straight", "--log", "x.mcap", "--png", "x.png"]
    assert code_of(["reach", "--scene", "free.json", *words]) == 3
    assert "x.png" in capsys.readouterr().err


def test_exit_code_says_whether_the_target_was_reached(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    free = trial_trace.crowded(0)
    Path("free.json").write_text(free.to_json())
    assert code_of(["reach", "--scene", "free.json", "--strategy", "straight"]) == 0
    assert "straight: reached within" in capsys.readouterr().out
    Path("lazy.py").write_text(
        "from reachd.interfaces import ZERO\n"
        "class Lazy:\n"
        "    activity = 'rest'\n"
        "    def __init__(self, parameters, rng):\n"
        "        pass\n"
        "    def start(self, goal, now):\n"
        "        pass\n"
        "    def step(self, touch, arm, goal, now):\n"
        "        return ZERO\n"
    )
    assert code_of(["reach", "--scene", "free.json", "--strategy", "lazy:Lazy"]) == 1
    assert "not reached within 20 s" in capsys.readouterr().out


def test_own_strategy_in_the_working_folder_may_fail(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Row 18: an exception ends the reach with the zero twist, and is reported."""
    Path("own_strategy.py").write_text(
        "from reachd.interfaces import Twist\n"
        "class Own:\n"
        "    activity = 'own'\n"
        "    def __init__(self, parameters, rng):\n"
        "        self.steps = 0\n"
        "    def start(self, goal, now):\n"
        "        pass\n"
        "    def step(self, touch, arm, goal, now):\n"
        "        self.steps += 1\n"
        "        if self.steps > 30:\n"
        "            raise RuntimeError('lost my way')\n"
        "        return Twist(0.04, 0.0, 0.0)\n"
    )
    Path("free.json").write_text(trial_trace.crowded(0).to_json())
    assert code_of(["reach", "--scene", "free.json", "--strategy", "own_strategy:Own"]) == 1
    printed = capsys.readouterr().out
    assert "lost my way" in printed
    assert "strategy_failed × 1" in printed


@pytest.mark.parametrize(
    ("words", "code", "printed"),
    [
        (["--scene", "attic"], 2, "allowed: authors_sim, hardware"),
        (["--strategy", "luck"], 2, "available: straight, burrow"),
        (["--seed", "-1"], 2, "allowed: a whole number"),
        (["--log", "nowhere/x.mcap"], 2, "no such folder: nowhere"),
        (["--png", "nowhere/x.png"], 2, "no such folder: nowhere"),
    ],
)
def test_demo_refuses_impossible_arguments(
    words: list[str], code: int, printed: str, folder: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    assert code_of(["demo", *words]) == code
    errors = capfd.readouterr().err
    assert printed in errors
    assert not list(folder.iterdir())


def test_demo_never_deletes_a_file_that_is_not_a_log(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    Path("thesis.txt").write_text("years of work")
    assert code_of(["demo", "--log", "thesis.txt"]) == 2
    assert "overwrite it with --force" in capsys.readouterr().err
    assert code_of(["demo", "--log", "thesis.txt", "--force"]) == 2
    assert "thesis.txt exists and is not a log" in capsys.readouterr().err
    assert Path("thesis.txt").read_text() == "years of work"


def test_bench_updates_one_part_and_keeps_the_rest(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    report = Path("bench.json")
    report.write_text(json.dumps({"figures": {"pipeline_ms_p50": 0.5}, "groups": {"old": {}}}))
    assert code_of(["bench", "--quick", "--only", "decode_fps", "--json", "bench.json"]) == 0
    written = json.loads(report.read_text())
    assert set(written["figures"]) == {"pipeline_ms_p50", "decode_fps", "decode_frame_bytes"}
    assert written["aims"]["pipeline_ms_p50"]["met"] is True
    assert set(written["groups"]) == {"old", "decode"}
    assert written["groups"]["decode"]["load_before"] >= 0
    assert code_of(["bench", "--only", "speed"]) == 2
    assert "reach_rtf_taxels" in capsys.readouterr().err
    report.write_text("no report")
    assert code_of(["bench", "--only", "decode", "--json", "bench.json"]) == 2
    assert report.read_text() == "no report"
