"""Logs cut off at every byte, or with any byte changed: a clear outcome, never a traceback."""

from __future__ import annotations

import argparse
import contextlib
import io
import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tactile_core.log.mcap_file import DiskStorage
from tactile_core.log.records import LogError
from tactile_tools.cli import make_parser
from tactile_tools.log import cat, doctor, export, info, recover
from tactile_tools.log.terminal import ToolError, fail

READ = 6


def options(tool: Any, *words: str) -> argparse.Namespace:
    return make_parser().parse_args(["log", tool.__name__.rpartition(".")[2], *words])


def outcome(run: Callable[[argparse.Namespace], int], given: argparse.Namespace) -> int:
    """Exit status, as `tactile log` makes it of the two errors that tools may raise."""
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        try:
            return run(given)
        except ToolError as error:
            return error.code
        except LogError as error:
            return fail(error)


@pytest.fixture
def tools(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Callable[[Path], int]]:
    out = tmp_path / "out"
    monkeypatch.setattr(DiskStorage, "sync", lambda *_: None)  # not thousands of flushes

    def fixed(module: Any, *words: str) -> Callable[[Path], int]:
        given = options(module, "x", *words)

        def run(path: Path) -> int:
            given.files = [path]
            return outcome(module.run, given)

        return run

    target = str(out / "new.mcap")
    out.mkdir()
    return {
        "info": fixed(info, "--json"),
        "doctor": fixed(doctor, "--json"),
        "recover": fixed(recover, "--out", target, "--force", "--json"),
        "cat": fixed(cat),
        "export": fixed(export, "--to", "npz", "--out", str(out / "tables"), "--force"),
    }


def test_log_cut_at_any_byte_is_read_up_to_the_cut(
    tools: Any, tmp_path: Path, tiny_log: Any
) -> None:
    whole = tiny_log(tmp_path / "whole.mcap")
    cut = tmp_path / "cut.mcap"
    codes: dict[str, list[int]] = {name: [] for name in tools}
    for size in range(len(whole) + 1):
        cut.write_bytes(whole[:size])
        for name, run in tools.items():
            codes[name].append(run(cut))
    for name, found in codes.items():
        assert found[-1] == 0, name
        assert set(found) <= {0, 1, 2}, name
        # Without its first eight bytes it is not a log; with them it is one, though incomplete.
        assert set(found[:8]) == {2}, name
    assert set(codes["doctor"][8:-1]) == {1}
    assert set(codes["info"][8:]) == {0}


def test_corrupted_byte_is_noticed_or_harmless(tools: Any, tmp_path: Path, tiny_log: Any) -> None:
    whole = tiny_log(tmp_path / "whole.mcap")
    rng = random.Random(2)
    path = tmp_path / "spoilt.mcap"
    for place in rng.sample(range(len(whole)), 150):
        data = bytearray(whole)
        data[place] ^= 1 << rng.randrange(8)
        path.write_bytes(data)
        for name, run in tools.items():
            assert run(path) in (0, 1, 2), (name, place)
