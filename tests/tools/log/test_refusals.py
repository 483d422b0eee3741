"""What the log tools say when they cannot do something."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tactile_core.log.mcap_file import DiskStorage

FEATURES, COMMAND, EVENT = "/tactile/finger/features", "/arm/arm/cmd_vel", "/reach/reach/event"


def test_bad_arguments_are_named_with_allowed_values(
    log_tool: Any, recorded: Any, tmp_path: Path, counts: Any
) -> None:
    path = recorded(tmp_path / "run.mcap", 0.1)
    (tmp_path / "file").touch()
    for words, text in (
        (("cat", path, "--topic", "/nope*"), "no topic '/nope*'"),
        (("cat", path, "--topic", "/nope"), f"it holds {COMMAND}, {EVENT}, {FEATURES}"),
        (("cat", path, "--from", "soon"), "allowed: seconds since the start"),
        (("cat", path, "--from", "3", "--to", "2"), "nothing is between"),
        (("export", path, "--format", "xls"), "allowed: csv, parquet, npz"),
        (("export", path, "--to", "csv", "--out", tmp_path / "file"), "is a file"),
        (("split", path, "--every", "0"), "above 0"),
        (("split", path, "--size", "big"), "a size such as 500MB"),
        (("split", path), "one of the arguments"),
        (("merge", path, "--out", path), "is what is read"),
        (("merge", path, "--out", tmp_path), "is a folder"),
        (("merge", path), "--out"),
        (("replay", path, "--speed", "-1"), "above 0"),
        (("replay", path, "--topic", "x"), "no topic 'x'"),
        (("rosbag", path, tmp_path / "nothing"), "does not exist"),
        (("recover", path, "--out", path), "is what is read"),
        (("cat", tmp_path / "run_9"), "does not exist"),
    ):
        outcome = log_tool(*words)
        assert outcome.code == 2, (words, outcome)
        assert text in outcome.err, words
    assert counts(path)[FEATURES] == 10


@pytest.mark.parametrize("content", [b"", b"\x89MCAP0", b"GIF89a" + bytes(3000)])
def test_every_tool_refuses_a_non_log_file(log_tool: Any, tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "x.mcap"
    path.write_bytes(content)
    out = ("--out", tmp_path / "o.mcap")
    for words in (
        ("info",), ("doctor",), ("recover",), ("cat",), ("export", "--to", "csv"), ("replay",),
        ("split", "--every", "1"), ("merge", *out), ("reprocess",), ("rosbag",),
    ):  # fmt: skip
        outcome = log_tool(words[0], path, *words[1:])
        assert outcome.code == 2, words
        assert str(path) in outcome.err
    assert [p.name for p in tmp_path.iterdir()] == ["x.mcap"]


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read everything")
def test_unreadable_files_are_refused(log_tool: Any, recorded: Any, tmp_path: Path) -> None:
    path = recorded(tmp_path / "run.mcap", 0.1)
    path.chmod(0)
    outcome = log_tool("info", path)
    assert outcome.code == 3
    assert "permissions" in outcome.err


def test_file_system_errors_are_reported(
    log_tool: Any, recorded: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = recorded(tmp_path / "run.mcap", 0.1)

    def refuse(*_: Any, **__: Any) -> Any:
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr("tactile_core.log.records.open", refuse, raising=False)
    for command in ("info", "cat", "doctor"):
        outcome = log_tool(command, path)
        assert outcome.code == 3
        assert "check the file's permissions" in outcome.err


def test_full_disk_ends_with_a_message_and_no_file(
    log_tool: Any, recorded: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = recorded(tmp_path / "run.mcap", 0.3)

    def full(*_: Any) -> int:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(DiskStorage, "write", full)
    for words in (
        ("recover", path), ("split", path, "--every", "0.1"), ("merge", path, "--out", "m.mcap"),
    ):  # fmt: skip
        monkeypatch.chdir(tmp_path)
        outcome = log_tool(*words)
        assert outcome.code == 3, outcome
        assert "No space left on device" in outcome.err
    left = {p.name for p in tmp_path.rglob("*") if p.is_file()}
    assert left == {"run.mcap"}


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no /dev/full here")
def test_output_to_a_full_device_is_reported(recorded: Any, tmp_path: Path) -> None:
    path = recorded(tmp_path / "run.mcap", 1.0)
    with open("/dev/full", "w") as full:
        done = subprocess.run(
            [sys.executable, "-m", "tactile_tools.cli", "log", "cat", str(path)],
            stdout=full, stderr=subprocess.PIPE, text=True, check=False,
        )  # fmt: skip
    assert done.returncode == 3
    assert "Traceback" not in done.stderr
    assert "cannot write" in done.stderr


def test_export_to_a_missing_place_is_refused(log_tool: Any, recorded: Any, tmp_path: Path) -> None:
    path = recorded(tmp_path / "run.mcap", 0.1)
    for words in (
        ("export", path, "--to", "csv", "--out", "/proc/none/x"),
        ("merge", path, "--out", "/proc/none/x.mcap"),
        ("split", path, "--every", "1", "--out", "/proc/none/x"),
        ("rosbag", path, "--out", "/proc/none/x"),
    ):
        outcome = log_tool(*words)
        assert outcome.code == 3, words
        assert "name a place" in outcome.err
