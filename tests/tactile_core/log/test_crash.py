"""Row 29: every file of a process killed while logging is readable and recoverable."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from tactile_tools.cli import main

KILLS = 12


def test_kill_9_loses_only_unflushed_messages(tmp_path: Path) -> None:
    """The time this spans depends on the machine; `make crash` measures it."""
    result = tmp_path / "crash.json"
    command = [sys.executable, "-m", "tactile_tools.cli", "crash", "--kills", str(KILLS)]
    command += ["--writers", "4", "--seed", "1234", "--json", str(result)]
    done = subprocess.run(command, capture_output=True, timeout=280, check=False)
    found = json.loads(result.read_text())
    assert found["problems"] == []
    assert done.returncode == 0, done.stderr
    assert found["kills"] == KILLS
    assert found["messages_written"] > 500
    assert found["messages_lost"] < found["messages_written"] / 2


@pytest.mark.parametrize("words", [["--kills", "0"], ["--kills", "many"], ["--writers", "-1"]])
def test_wrong_arguments_are_refused(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["crash", *words])
    assert ended.value.code == 2
    assert "allowed: a whole number of at least 1" in capsys.readouterr().err
