"""``tactile tare`` and ``tactile status`` on real daemons."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from tactile_tools.cli import main
from tests.support.tactiled_lab import FeatureListener
from tests.support.waiting import wait_until

PRESS = """
[[press]]
array = "skin"
normal_n = 6.0
start_s = 6.0
ramp_s = 0.2
hold_s = 100000.0
"""


@pytest.mark.parametrize("words", [["tare"], ["status", "--json"]])
def test_missing_daemon_is_reported_in_one_sentence(
    words: list[str], lab: Any, capsys: Any
) -> None:
    assert main([*words, "--connect", lab.endpoint]) == 3
    said = capsys.readouterr()
    assert not said.out
    assert len(said.err.splitlines()) == 1
    assert lab.endpoint in said.err
    assert "--connect" in said.err


def test_tare_under_a_press_is_refused_and_can_be_forced(
    lab: Any, tmp_path: Path, capsys: Any
) -> None:
    (tmp_path / "press.toml").write_text(PRESS)
    daemon = lab.tactiled("--port", "skin0", "--no-log", "--wait")
    # It is ready before the board is there: that is tared long before the press begins.
    daemon.wait_for_text("waiting for it")
    lab.boards("--board", "anyskin", "--pty", "skin0", "--press", "press.toml", link="skin0")
    listener = FeatureListener(lab.listen())
    wait_until(lambda: any(m.normal_force > 2.0 for _, m in list(listener.heard)))
    words = ["--connect", lab.endpoint]
    assert main(["tare", *words]) == 3
    error = capsys.readouterr().err
    assert error.startswith("tactile tare: board0: tare refused: ")
    assert "--force" in error
    assert len(error.splitlines()) == 1
    assert main(["tare", "board0", "--force", *words]) == 0
    assert "tared over" in capsys.readouterr().out
    wait_until(lambda: abs(listener.heard[-1][1].normal_force) < 0.5)
    assert "tare refused" in daemon.said


def test_command_needs_a_board_name_when_there_are_several(running: Any, capsys: Any) -> None:
    lab, _, _ = running
    words = ["--connect", lab.endpoint]
    assert main(["tare", *words]) == 2
    assert "board0, skin0" in capsys.readouterr().err
    assert main(["tare", "bord0", *words]) == 2
    error = capsys.readouterr().err
    assert "'bord0'" in error
    assert "board0, skin0" in error
    assert main(["tare", "skin0", *words]) == 0
    assert "skin0: tared over" in capsys.readouterr().out


def test_status_of_all_boards_fits_the_terminal(
    running: Any, capsys: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    lab, _, _ = running
    monkeypatch.setenv("COLUMNS", "80")
    assert main(["status", "--connect", lab.endpoint]) == 0
    shown = capsys.readouterr().out
    assert max(len(line) for line in shown.splitlines()) <= 80
    for word in ("board0: streaming", "skin0: streaming", "nominal", "board0.cal.toml", "run.mcap"):
        assert word in shown
    assert main(["status", "none", "--connect", lab.endpoint]) == 2
    assert "board0, skin0" in capsys.readouterr().err


def test_status_for_programs_is_json_by_board(running: Any, capsys: Any) -> None:
    lab, _, _ = running
    told: dict[str, Any] = {}

    def streaming() -> bool:  # on a busy machine a board may seem silent for a moment
        assert main(["status", "--json", "--connect", lab.endpoint]) == 0
        told.update(json.loads(capsys.readouterr().out))
        return bool(told["board0"]["state"] == "streaming")

    wait_until(streaming)
    assert sorted(told) == ["board0", "skin0"]
    assert told["board0"]["clock_trouble"] == ""
