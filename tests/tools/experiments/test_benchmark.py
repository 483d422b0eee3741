"""tactile benchmark: the same fixed scenes for everybody, resumable, and entries for a page."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from sim_device.world.scene_loading import FOLDER_VARIABLE
from tactile_tools.cli import main
from tactile_tools.dev import leaderboard
from tactile_tools.experiments import benchmark as board
from tactile_tools.experiments.benchmark import SCENE_SETS, benchmark_study, read_entry
from tactile_tools.experiments.cli import LIMITS_S, SCENE_SET_NAMES
from tactile_tools.experiments.rows import Row
from tactile_tools.experiments.studies import rebuild
from tests.support.paths import ROOT

SHORT = ("--sets", "hardware", "--engine", "mujoco", "--depth", "contacts", "--jobs", "1")


def run(capsys: pytest.CaptureFixture[str], *words: object) -> tuple[int, str, str]:
    try:
        code = main(["benchmark", *map(str, words)])
    except SystemExit as stop:
        code = int(stop.code or 0)
    told = capsys.readouterr()
    assert "Traceback" not in told.err
    return code, told.out, told.err


def test_names_in_help_match_available_names() -> None:
    assert tuple(SCENE_SETS) == SCENE_SET_NAMES
    assert board.LIMITS_S == LIMITS_S


def test_everybody_is_judged_on_the_same_scenes(options_of: Callable[..., Any]) -> None:
    options = options_of(scenes=70, sets=tuple(SCENE_SETS), parameters={})
    one = benchmark_study(options, "burrow").specs
    other = benchmark_study(options, "mine:Own").specs
    assert [(s.source, s.scene_seed, s.conditions) for s in one] == [
        (s.source, s.scene_seed, s.conditions) for s in other
    ]
    generated = {s.scene_seed for s in one if s.source != "authors_sim_recorded"}
    assert generated == set(range(board.FIRST_SEED, board.FIRST_SEED + 70))
    assert max(generated) < board.FIRST_SEED + 10_000
    recorded = {s.scene_seed for s in one if s.source == "authors_sim_recorded"}
    assert recorded == set(range(1, 61)), "there are no more"
    assert {s.resolved().time_limit for s in one} == {20.0, 40.0}


def test_a_set_s_own_time_limit_is_the_trial_that_other_studies_run(
    options_of: Callable[..., Any],
) -> None:
    study = benchmark_study(options_of(scenes=1, sets=("squeezed",), parameters={}), "burrow")
    assert [s.parameters for s in study.specs] == ["{}", '{"time_limit":40.0}']


def test_definition_rebuilds_the_study(options_of: Callable[..., Any], tmp_path: Path) -> None:
    study = benchmark_study(
        options_of(seed=board.FIRST_SEED, sets=("dense", "hardware")), "burrow", (20.0,)
    )
    assert rebuild(tmp_path, json.loads(json.dumps(study.definition)))[0] == study


def test_entry_grows_with_more_scenes_and_limits(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    words = ("burrow", *SHORT, "--param", "v_max=0.04", "--out", tmp_path / "run")
    entry = tmp_path / "entry.json"
    code, out, _ = run(capsys, *words, "--scenes", 1, "--time-limit", 1, "--entry", entry)
    assert code == 0
    assert "hardware" in out
    first = read_entry(entry)
    assert [(c["limit_s"], c["scenes"], c["errors"]) for c in first["cases"]] == [(1.0, 1, 0)]
    assert first["commands"] == [
        "tactile benchmark burrow --sets hardware --engine mujoco --depth contacts --time-limit 1 "
        "--scenes 1 --param v_max=0.04"
    ]
    code, out, _ = run(capsys, *words, "--scenes", 2, "--time-limit", 1, 1.5, "--entry", entry)
    assert code == 0
    assert "resuming: 1 of 4" in out
    grown = read_entry(entry)
    assert [(c["limit_s"], c["scenes"]) for c in grown["cases"]] == [(1.0, 2), (1.5, 2)]
    case = grown["cases"][0]
    assert case["success"][:2] == [0, 2]
    assert case["time_s"] == {"mean": 1.0, "median_of_reached": None}
    assert case["cpu_s_per_trial"] > 0
    words = ("straight", *SHORT, "--scenes", 1, "--time-limit", 1, "--entry", entry)
    code, _, err = run(capsys, *words, "--out", tmp_path / "other")
    assert code == 2
    assert "choose another --entry" in err


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("no_such_strategy", *SHORT), "unknown strategy 'no_such_strategy'"),
        (("burrow", "--sets", "foggy"), "foggy"),
        (("burrow", "--time-limit", "-1"), "above 0"),
        (("burrow", *SHORT, "--param", "v_maxx=1"), "v_maxx"),
    ],
)
def test_bad_arguments_are_named(
    words: tuple[str, ...], says: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    code, _, err = run(capsys, *words, "--out", tmp_path / "run")
    assert code == 2
    assert says in err


def test_recorded_scenes_that_are_absent_are_said_to_be(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(FOLDER_VARIABLE, str(tmp_path))
    code, _, err = run(capsys, "burrow", "--sets", "recorded", "--out", tmp_path / "run")
    assert code == 2
    assert FOLDER_VARIABLE in err


# The page.


def entry_file(
    folder: Path, name: str, arrived: int, made_row: Callable[..., Row], options: Any
) -> None:
    study = benchmark_study(options, name, (20.0,))
    rows = [
        made_row(spec, success=i < arrived, time_s=5.0 + i) for i, spec in enumerate(study.specs)
    ]
    board.write_entry(
        board.entry_of(study, rows, name, "tuned on nothing"), folder / f"{name}.json"
    )


def test_page_orders_entries_by_success(
    made_row: Callable[..., Row], options_of: Callable[..., Any], tmp_path: Path
) -> None:
    options = options_of(scenes=4, sets=("squeezed",), parameters={})
    for name, arrived in (("weak", 1), ("strong", 4), ("middling", 2)):
        entry_file(tmp_path, name, arrived, made_row, options)
    page = tmp_path / "page.md"
    assert leaderboard.main([str(tmp_path), str(page)]) == 0
    text = page.read_text(encoding="utf-8")
    rows = [line for line in text.splitlines() if line.startswith("| ")]
    assert [row.split(" | ")[0] for row in rows[2:5]] == ["| strong", "| middling", "| weak"]
    assert "50 % [15, 85] of 4" in text
    assert "tuned on nothing" in text
    assert leaderboard.main([str(tmp_path), str(page), "--check"]) == 0
    entry_file(tmp_path, "weak", 3, made_row, options)
    assert leaderboard.main([str(tmp_path), str(page), "--check"]) == 1


@pytest.mark.parametrize("text", ["", "[]", '{"format": 1}', '{"format": 99}'])
def test_a_file_that_is_not_an_entry_is_named(
    text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "bad.json").write_text(text, encoding="utf-8")
    assert leaderboard.main([str(tmp_path), str(tmp_path / "page.md")]) == 2
    assert "bad.json" in capsys.readouterr().err


def test_the_page_in_the_documents_is_up_to_date(capsys: pytest.CaptureFixture[str]) -> None:
    folder = ROOT / "docs" / "results" / "benchmark"
    words = [str(folder), str(ROOT / "docs" / "leaderboard.md"), "--check"]
    assert leaderboard.main(words) == 0, capsys.readouterr().err
