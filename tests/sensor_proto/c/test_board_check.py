"""``tactile board-check`` passes boards that follow PROTOCOL.md and names others' mistakes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest

from sensor_proto.packets import Ack, AckResult, Samples, Status
from sim_device.board.catalogue import build_skin, identity
from sim_device.board.firmware import CanBoard, SerialBoard
from tactile_tools.cli import main

Judge = Callable[..., list[tuple[str, str, str]]]


def unhappy(found: list[tuple[str, str, str]]) -> list[tuple[str, str, str]]:
    return [row for row in found if row[1] != "pass"]


def test_c_board_passes_on_a_serial_line(judge: Judge, c_board: Any) -> None:
    found = judge(c_board)
    assert unhappy(found) == []
    assert len(found) == 25


@pytest.mark.parametrize("fd", [False, True])
def test_c_board_passes_on_a_can_bus(
    judge: Judge, c_can_board: Callable[..., Any], fd: bool
) -> None:
    assert unhappy(judge(c_can_board(9, fd), 9, fd)) == []


def test_simulated_board_passes(judge: Judge) -> None:
    skin, who = build_skin("anyskin", 1), identity("anyskin", 1)
    assert unhappy(judge(SerialBoard(skin, who))) == []
    skin = build_skin("anyskin", 1)
    assert unhappy(judge(CanBoard(skin, who, 3, True), 3, True)) == []


class Wrong(SerialBoard):
    """A faulty board: ``mistake`` changes a message or drops it (None)."""

    def __init__(self, mistake: Callable[[Any], Any]) -> None:
        super().__init__(build_skin("anyskin", 1), identity("anyskin", 1))
        take = self.controller.take

        def faulty_take(now: Any) -> list[Any]:
            said = [mistake(m) for m in take(now)]
            return [m for m in said if m is not None] if said else []

        self.controller.take = faulty_take  # type: ignore[method-assign]


@pytest.mark.parametrize(
    ("mistake", "title", "said"),
    [
        (
            lambda m: replace(m, result=AckResult.OK) if isinstance(m, Ack) else m,
            "refuses rates of 0 and above its highest",
            "Set rate 0 mHz was answered with OK",
        ),
        (
            lambda m: replace(m, request=m.request ^ 1) if isinstance(m, Ack) else m,
            "obeys Start while streaming",
            "Start was not acknowledged",
        ),
        (
            lambda m: replace(m, ticks=m.ticks // 2) if isinstance(m, Samples) else m,
            "keeps the rates that it takes",
            "ticks instead of",
        ),
        (
            lambda m: replace(m, rx_errors=0) if isinstance(m, Status) else m,
            "counts frames that it refuses, and only those",
            "rx_errors grew by 0",
        ),
        (
            lambda m: None if isinstance(m, Samples) and m.sequence % 9 == 5 else m,
            "counts every cycle that it drops",
            "cycles never came",
        ),
    ],
)
def test_board_mistake_is_named(
    judge: Judge, mistake: Callable[[Any], Any], title: str, said: str
) -> None:
    found = {t: (verdict, text) for t, verdict, text in judge(Wrong(mistake))}
    assert found[title][0] == "FAIL"
    assert said in found[title][1]
    assert found["describes itself"][0] == "pass"


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        (["--port", "/dev/nothing"], 3, "there is no port /dev/nothing"),
        (["--port", "/dev/nothing", "--node", "3"], 2, "--node 3: a number from 0 to 126"),
        (["--port", "/dev/nothing", "--baud", "0"], 2, "a whole number of at least 1"),
        (["--can", "nonsense"], 2, "INTERFACE:CHANNEL"),
        (["--can", "socketcan:nothing0"], 3, "nothing0"),
    ],
)
def test_board_check_refuses_bad_input_with_remedy(
    words: list[str], code: int, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    try:
        ended = main(["board-check", *words])
    except SystemExit as parser:
        ended = parser.code  # type: ignore[assignment]
    assert ended == code
    told = capsys.readouterr().err
    assert said in told
    assert "Traceback" not in told
