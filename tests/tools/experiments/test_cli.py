"""Mistakes of a user and their messages; and the commands themselves."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from tactile_core import cli as names
from tactile_tools.cli import main
from tactile_tools.experiments.axes import AXES
from tactile_tools.experiments.cli import AXIS_NAMES
from tactile_tools.experiments.rows import read_table
from tactile_tools.experiments.spec import STRATEGIES

Command = Callable[..., subprocess.CompletedProcess[str]]

QUICK = ("--param", "time_limit=0.5", "--set", "hardware")


def run(capsys: pytest.CaptureFixture[str], *words: object) -> tuple[int, str, str]:
    try:
        code = main(["experiment", *map(str, words)])
    except SystemExit as stop:
        code = int(stop.code or 0)
    printed = capsys.readouterr()
    assert "Traceback" not in printed.err
    return code, printed.out, printed.err


def test_names_in_help_match_available_names() -> None:
    assert tuple(AXES) == AXIS_NAMES
    assert names.PAPER_STRATEGIES == STRATEGIES


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("strategies", "--scenes", "0"), "'0' given; allowed: a whole number of at least 1"),
        (("strategies", "--scenes", "many"), "'many' given; allowed: a whole number"),
        (("strategies", "--jobs", "-2"), "'-2' given; allowed: a whole number"),
        (("strategies", "--scene-seed", "-1"), "a whole number from 0 to"),
        (("strategies", "--set", "kitchen"), "unknown parameter set 'kitchen'; available:"),
        (("strategies", "--strategies", "teleport"), "unknown strategy 'teleport'; available:"),
        (("strategies", "--source", "attic"), "no scenes are called 'attic'"),
        (("strategies", "--source", "recorded:none.gz"), "cannot read none.gz"),
        (("strategies", "--param", "time_limit"), "'time_limit' is not NAME=VALUE"),
        (("strategies", "--param", "time_limt=3"), "did you mean time_limit?"),
        (("strategies", "--param", "time_limit=-3"), "a finite number above 0 s"),
        (("robustness", "--axis", "luck"), "'luck' given; allowed: density, friction_objects"),
        (("sweep", "--primitive", "dig"), "'dig' given; allowed: burrow"),
        (
            ("trial", "--condition", "finger_width=3"),
            "finger_width = 3; allowed: a finite number from 0.02 to 0.12 m",
        ),
        (("trial", "--condition", "fingers=3"), "unknown key fingers (did you mean finger_width?)"),
        (("trial", "--condition", "objects=5"), "objects = 5; allowed: an array of 2"),
        (("trial", "--png", "x.png"), "give --log as well"),
        (("trial", "--row", "somewhere"), "is not RUN:N"),
        (("trial", "--row", "nowhere:3"), "nowhere is not a folder of an experiment"),
        (("report", "nowhere"), "nowhere is not a folder of an experiment"),
        (("compare", "nowhere", "elsewhere"), "nowhere is not a folder of an experiment"),
    ],
)
def test_bad_argument_is_named_with_allowed_values(
    words: tuple[str, ...],
    message: str,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    code, _, error = run(capsys, *words)
    assert code == 2
    assert message in error
    assert not list(tmp_path.iterdir()), "nothing is begun with a bad argument"


def test_study_runs_from_command_line_to_report(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    words = ("strategies", "--scenes", 2, *QUICK, "--jobs", 1, "--strategies", "straight", "burrow")
    code, out, _ = run(capsys, *words)
    assert code == 0
    assert "trials_per_core_minute" in out
    assert "speedup_vs_reference" in out
    folder = tmp_path / "runs" / "strategies"
    assert {"trials.parquet", "trials.csv", "summary.json"} <= {p.name for p in folder.iterdir()}

    code, out, _ = run(capsys, *words)
    assert code == 0
    assert "resuming: 4 of 4 trials are finished" in out

    assert run(capsys, "report", folder, "--out", tmp_path / "report")[0] == 0
    assert (tmp_path / "report" / "report.html").stat().st_size > 10_000

    row = read_table(folder / "trials.parquet")[3]
    code, out, _ = run(capsys, "trial", "--row", f"{folder}:3")
    assert code == 0
    assert f"{row['strategy']} in scene {row['scene_seed']}" in out
    assert "the same as its row, bit for bit" in out
    code, _, error = run(capsys, "trial", "--row", f"{folder}:4")
    assert code == 2
    assert "has rows 0 to 3" in error


def test_rerun_with_a_different_row_is_reported(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, alone: Path
) -> None:
    (tmp_path / "experiment.json").write_bytes((alone / "experiment.json").read_bytes())
    text = (alone / "trials.jsonl").read_text()
    (tmp_path / "trials.jsonl").write_text(text.replace('"ejected":0', '"ejected":7'))
    code, out, _ = run(capsys, "trial", "--row", f"{tmp_path}:0")
    assert code == 1
    assert "ejected: 7 in the row, 0 now" in out


def test_trial_is_rerun_from_its_columns_with_log_and_picture(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    log, png = tmp_path / "t.mcap", tmp_path / "t.png"
    code, out, _ = run(
        capsys, "trial", "--scene-seed", 5, "--strategy", "burrow", *QUICK[2:],
        "--param", "time_limit=0.6", "--condition", "finger_width=0.04",
        "--log", log, "--png", png,
    )  # fmt: skip
    assert code == 0
    assert "burrow in scene 5 of hardware: timeout" in out
    assert log.stat().st_size > 1000
    assert png.read_bytes().startswith(b"\x89PNG")


def test_comparing_runs_pairs_their_trials(
    capsys: pytest.CaptureFixture[str],
    alone: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # Wide enough that no line of the table is broken.
    monkeypatch.setenv("COLUMNS", "160")
    code, out, _ = run(capsys, "compare", alone, alone, "--csv", tmp_path / "c.csv")
    assert code == 0
    line = next(line for line in out.splitlines() if "straight" in line)
    assert "100 %" in line
    assert "+0 [" in line
    head = (tmp_path / "c.csv").read_text().splitlines()[0]
    assert head == "strategy,A [95 %],B [95 %],B − A [95 %],p,paired,same"


def test_ctrl_c_keeps_finished_trials(command: Command, tmp_path: Path) -> None:
    import signal
    import sys
    import time

    folder = tmp_path / "run"
    process = subprocess.Popen(
        [
            sys.executable, "-m", "tactile_tools.cli", "experiment", "strategies",
            "--scenes", "30", "--set", "hardware", "--param", "time_limit=2",
            "--jobs", "1", "--out", str(folder),
        ],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        # A shell gives its background jobs an ignored SIGINT, and so would the tests be.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )  # fmt: skip
    deadline = time.monotonic() + 90
    journal = folder / "trials.jsonl"
    while not (journal.exists() and journal.stat().st_size):
        assert time.monotonic() < deadline
        assert process.poll() is None
        time.sleep(0.02)
    os.killpg(process.pid, signal.SIGINT)  # as a terminal does: to the workers too
    out, error = process.communicate(timeout=120)
    assert process.returncode == 130
    assert "are finished and kept; the same command runs the rest" in " ".join(out.split())
    assert "Traceback" not in out + error
