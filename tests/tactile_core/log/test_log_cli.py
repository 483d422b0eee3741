"""``tactile log``: output, exit codes, and never a traceback."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from tactile_core.bus import topics
from tactile_core.bus.messages import MSG, codec, diagnostic_status, header
from tactile_tools.cli import main

BASE_NS = 1_700_000_000_000_000_000


@dataclass(frozen=True)
class Outcome:
    returncode: int
    stdout: str
    stderr: str


@pytest.fixture
def tactile(capsys: pytest.CaptureFixture[str]) -> Callable[..., Outcome]:
    """``tactile("info", path)``: run `tactile log` within this process."""

    def run(*words: str | Path) -> Outcome:
        capsys.readouterr()
        code = main(["log", *map(str, words)])
        return Outcome(code, *capsys.readouterr())

    return run


@pytest.fixture
def path(tmp_path: Path, record: Any, payloads: Any) -> Path:
    path = tmp_path / "log.mcap"
    recorder = record(path)
    recorder.attach("b0.cal.toml", "application/toml", b"version = 1\n")
    recorder.metadata("board:b0", {"serial_number": "0011", "hash": "abcd"})
    for i in range(100):
        at = BASE_NS + i * 10_000_000
        recorder.write(topics.FORCES, "b0", payloads[topics.FORCES], at, at)
    for count in (3, 5):
        values = {"drops.crc": count, "rate_hz": 100}
        array = MSG.DiagnosticArray(
            header(BASE_NS, ""), [diagnostic_status("tactiled/b0", 0, "ok", "0011", values)]
        )
        data = codec().encode(topics.DIAGNOSTICS, array)
        recorder.write(topics.DIAGNOSTICS, "b0", data, BASE_NS, BASE_NS)
    assert recorder.close(60)
    return path


def test_info_shows_contents_of_log(tactile: Any, path: Path) -> None:
    result = tactile("info", path)
    assert result.returncode == 0, result.stderr
    for text in (
        "whole",
        "/tactile/b0/forces",
        "tactile_msgs/msg/TaxelForces",
        "100.00",
        "drops of tactiled/b0: crc 5",
        "serial_number 0011, hash abcd",
        "b0.cal.toml (application/toml, 12 B)",
        "tactile-reach",
        "2023-11-14 22:13:20.000Z",
    ):
        assert text in result.stdout


def test_info_in_json_is_complete(tactile: Any, path: Path) -> None:
    result = tactile("info", path, "--json")
    found = json.loads(result.stdout)
    assert found["whole"] is True
    assert found["messages"] == 102
    rows = {row["topic"]: row for row in found["channels"]}
    assert rows["/tactile/b0/forces"]["rate"] == pytest.approx(100.0)
    assert rows["/tactile/b0/forces"]["missing"] == 0
    assert found["drops"] == {"tactiled/b0": {"crc": 5}}
    assert found["metadata"]["board:b0"]["hash"] == "abcd"


def test_truncated_log_is_recovered_to_a_new_file(tactile: Any, path: Path) -> None:
    data = path.read_bytes()
    path.write_bytes(data[: len(data) * 2 // 3])
    assert "not closed" in tactile("info", path).stdout
    before = path.read_bytes()
    result = tactile("recover", path)
    assert result.returncode == 0, result.stderr
    target = path.with_name("log_recovered.mcap")
    assert str(target) in result.stdout
    assert path.read_bytes() == before
    assert json.loads(tactile("info", target, "--json").stdout)["whole"] is True
    again = tactile("recover", path)
    assert again.returncode == 2
    assert "exists and is not overwritten: name another" in again.stderr
    same = tactile("recover", path, "--out", path)
    assert same.returncode == 2
    assert path.read_bytes() == before


def test_recover_reports_in_json(tactile: Any, path: Path, tmp_path: Path) -> None:
    result = tactile("recover", path, "--out", tmp_path / "o.mcap", "--json")
    found = json.loads(result.stdout)
    assert found["messages"] == 102
    assert found["damages"] == []


@pytest.mark.parametrize(
    ("content", "text"),
    [
        (b"", "is empty"),
        (b"\x89MC", "cut off after 3 bytes"),
        (b"\x7fELF" + bytes(5000), "is not an MCAP file"),
        (os.urandom(200_000), "is not an MCAP file"),
    ],
)
def test_non_log_file_exits_with_2(tactile: Any, tmp_path: Path, content: bytes, text: str) -> None:
    path = tmp_path / "x.mcap"
    path.write_bytes(content)
    for command in ("info", "recover"):
        result = tactile(command, path)
        assert result.returncode == 2
        assert text in result.stderr
        assert "name a log" in result.stderr
        assert "Traceback" not in result.stderr
        assert result.stdout == ""
    assert list(tmp_path.iterdir()) == [path]


def test_missing_files_directories_and_devices_are_refused(tactile: Any, tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    for place, text in (
        (tmp_path / "none.mcap", "none.mcap does not exist; name a file, a folder of logs"),
        (tmp_path, "is a folder without a readable .mcap file"),
        (Path("/dev/zero"), "is a device or a pipe, not a file"),
        (tmp_path / "pipe", "is a device or a pipe, not a file"),
    ):
        result = tactile("info", place)
        assert result.returncode == 2
        assert text in result.stderr


def test_unwritable_target_exits_with_3(tactile: Any, path: Path) -> None:
    result = tactile("recover", path, "--out", "/proc/none/out.mcap")
    assert result.returncode == 3
    assert "name a place with room to write to" in result.stderr


def test_names_with_markup_are_shown_verbatim(tactile: Any, path: Path, tmp_path: Path) -> None:
    odd = tmp_path / "[bold]x.mcap"
    odd.write_bytes(path.read_bytes())
    assert "[bold]x.mcap" in tactile("info", odd).stdout


def test_command_exits_with_the_same_code_without_traceback(path: Path) -> None:
    for place, code in ((path, 0), (path.with_name("none.mcap"), 2)):
        command = [sys.executable, "-m", "tactile_tools.cli", "log", "info", str(place)]
        done = subprocess.run(command, capture_output=True, text=True, timeout=240, check=False)
        assert done.returncode == code
        assert "Traceback" not in done.stderr
