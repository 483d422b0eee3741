"""Other boards and adapters, with real processes: simulated, then detected or declared."""

from __future__ import annotations

import signal
from typing import Any

import pytest

from tactile_core.bus.messages import codec
from tactile_core.bus.topics import GEOMETRY
from tactile_core.log.info import info
from tests.support.tactiled_lab import FeatureListener
from tests.support.waiting import wait_until


def test_text_board_and_declared_board_stream_and_replay(lab: Any) -> None:
    lab.boards(
        "--pty", "text", "--board", "anyskin", "--arrays", "5+5", "--format", "anyskin-text",
        "--banner", link="text",
    )  # fmt: skip
    lab.boards(
        "--pty", "bare", "--board", "anyskin",
        "--format", "floats:5xyz,start=aa55,skip=1,check=xor,end=none", link="bare",
    )  # fmt: skip
    daemon = lab.tactiled(
        "--port", "text", "--name", "jaws", "--board", "auto", "--arrays", "5+5",
        "--port", "bare", "--name", "pad", "--board", "floats:5xyz", "--arrays", "5",
        "--log", "run.mcap",
    )  # fmt: skip
    session = lab.listen()
    shapes: list[Any] = []
    subscriber = session.declare_subscriber(
        GEOMETRY.key("jaws"),
        lambda sample: shapes.append(codec().decode(GEOMETRY, sample.payload.to_bytes())),
    )
    listeners = {name: FeatureListener(session, name) for name in ("jaws", "pad")}
    for listener in listeners.values():
        listener.wait(20)
    wait_until(lambda: "read as text:10txyz" in daemon.said)
    daemon.process.send_signal(signal.SIGINT)
    assert daemon.wait() == 0, daemon.said
    subscriber.undeclare()
    for geometry in shapes:
        assert geometry.array_columns.tolist() == [5, 5]
        assert geometry.array_posed.tolist() == [False, False]
    # The log states how the board was read, so that a replay reads it the same way.
    replay = lab.tactiled(
        "--mcap", "run.mcap", "--name", "pad", "--speed", "inf", "--log", "a.mcap"
    )
    assert replay.wait() == 0, replay.said
    again = {c.topic: c.messages for c in info(lab.folder / "a.mcap").channels}
    assert again["/tactile/pad/features"] > 20


def test_adapter_that_answers_no_command_streams(lab: Any) -> None:
    # Eighty frames a cycle: more often than this, a starved machine cannot take them all.
    lab.boards("--slcan", "can0", "--adapter", "canable", "--rate", "5", link="can0")
    daemon = lab.tactiled("--can", "slcan:can0@1000000", "--name", "hand", "--no-log")
    FeatureListener(lab.listen(), "hand").wait(10)
    assert "answers no command" in daemon.said


@pytest.mark.parametrize(
    ("sent", "words", "said"),
    [
        (("--format", "floats:5xyz"), (), "--kind floats:5xyz"),
        (("--arrays", "5+5"), ("--arrays", "5+4"), "5+4 names 9 magnetometers"),
    ],
)
def test_unreadable_stream_ends_with_a_remedy(
    lab: Any, sent: tuple[str, ...], words: tuple[str, ...], said: str
) -> None:
    lab.boards("--pty", "skin", "--board", "anyskin", *sent, link="skin")
    daemon = lab.tactiled("--port", "skin", "--no-log", *words)
    assert daemon.wait() == 3
    assert said in daemon.said
    assert "baud" not in daemon.said


def test_unsupported_bit_rate_is_a_bad_argument(lab: Any) -> None:
    daemon = lab.tactiled("--can", "slcan:can0@123456", "--no-log")
    assert daemon.wait() == 2
    assert "83333" in daemon.said
    assert "1000000" in daemon.said
