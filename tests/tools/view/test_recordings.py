"""The record service of a running tactiled: bounds, names, rights."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import tactile_reach as tr
from tactile_core.bus.rights import may_ask
from tests.support.waiting import PATIENCE_S


@pytest.fixture(scope="module")
def board(rig: Any) -> Any:
    with tr.connect(rig.endpoint, find_s=PATIENCE_S) as bus:
        found = bus.board("pad")
        found.newest(PATIENCE_S)
        yield found


@pytest.mark.parametrize(
    "name", ["../up", "/tmp/x", ".hidden", "a/b", "-x", "a b", "x" * 65, "\0", "ä", "..", "a\n"]
)
def test_recording_name_with_a_path_is_refused(board: Any, name: str) -> None:
    with pytest.raises(tr.RefusedError, match="allowed: letters, digits"):
        board.start_recording(name)


@pytest.mark.parametrize("limit_s", [0.0, -1.0, 1e9])
def test_a_limit_out_of_bounds_is_refused(board: Any, limit_s: float) -> None:
    with pytest.raises(tr.RefusedError, match="allowed: above 0"):
        board.start_recording("x", limit_s=limit_s)


def test_one_at_a_time_whole_and_never_over_another(
    rig: Any, board: Any, until: Callable[..., Any], recording_of: Callable[..., Any]
) -> None:
    with board.record("whole") as path:
        with pytest.raises(tr.RefusedError, match=r"already recording to .*whole\.mcap"):
            board.start_recording("other")
        until(lambda: recording_of(board)["messages"] > 500)
    log = tr.read_log(rig.folder / path)
    assert log.closed
    parts = log.board("pad")
    assert {"features", "forces", "geometry", "diagnostics"} <= set(parts)
    assert "raw" not in parts
    numbers = parts["features"]["sequence"].tolist()
    assert numbers == sorted(set(numbers))
    with pytest.raises(tr.RefusedError, match="nothing is being recorded"):
        board.stop_recording()
    with pytest.raises(tr.RefusedError, match="exists and is not overwritten"):
        board.start_recording("whole")
    assert not recording_of(board)["recording"]


def test_it_ends_by_itself(
    rig: Any, board: Any, until: Callable[..., Any], recording_of: Callable[..., Any]
) -> None:
    path = board.start_recording("short", limit_s=0.5)
    until(lambda: not recording_of(board)["recording"])
    until(lambda: tr.read_log(rig.folder / path).closed)


def test_it_is_finished_when_the_daemon_ends(
    make_rig: Callable[[], Any], until: Callable[..., Any], recording_of: Callable[..., Any]
) -> None:
    rig = make_rig()
    with tr.connect(rig.endpoint, find_s=PATIENCE_S) as bus:
        board = bus.board()
        board.newest(PATIENCE_S)
        path = board.start_recording()
        until(lambda: recording_of(board)["messages"] > 20)
    rig.daemon.process.terminate()
    assert rig.daemon.process.wait(PATIENCE_S) == 0
    assert Path(path).name.startswith("recording_")
    assert tr.read_log(rig.folder / path).closed


def test_an_operator_may_record_and_a_viewer_may_not() -> None:
    assert may_ask("operator", "tactile/left/srv/record")
    for role in ("viewer", "arm", "reachd"):
        assert not may_ask(role, "tactile/left/srv/record")
