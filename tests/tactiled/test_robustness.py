"""Links never raise on any input at any time, and stamps stay monotonic."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sensor_proto.framing import encode_serial
from sensor_proto.packets import (
    Ack,
    AckResult,
    ClockReply,
    Descriptor,
    Log,
    Samples,
    SetRate,
    Status,
)
from tactile_core.types import NS_PER_S, Instant
from tactiled.blocks import Chunk
from tactiled.boards.board import COMMANDS, BoardLink
from tactiled.boards.events import Sampled
from tactiled.boards.line import SerialLine
from tactiled.reader import Inbox, Wake

TICKS = st.integers(0, 2**32 - 1)


def samples(array: int, sequence: int, ticks: int, taxels: int) -> Samples:
    return Samples(
        array, sequence, ticks, 2500, np.zeros((taxels, 3), np.int16), np.zeros(taxels, np.uint8)
    )


MESSAGES = st.one_of(
    st.builds(samples, st.integers(0, 2), TICKS, TICKS, st.integers(1, 5)),
    st.builds(samples, st.just(0), st.integers(0, 300), TICKS, st.just(4)),
    st.builds(ClockReply, st.integers(0, 20), TICKS, TICKS),
    st.builds(
        Status, st.integers(0, 10**7), TICKS, TICKS, TICKS, TICKS,
        st.integers(0, 10**6), st.integers(0, 9),
    ),
    st.builds(Ack, st.integers(0, 255), st.integers(0, 12), st.sampled_from(AckResult)),
    st.builds(Log, st.integers(0, 255), TICKS, st.text(max_size=5)),
    st.sampled_from(["descriptor", "stranger", "future", "connect", "disconnect", "command"]),
)  # fmt: skip


@given(st.lists(st.tuples(MESSAGES, st.floats(0, 1.5)), max_size=120))
@settings(max_examples=60, deadline=None)
def test_link_accepts_any_message_at_any_time(script: list[tuple[Any, float]]) -> None:
    from_board = _descriptor()
    now, last = 1000.0, {0: 0, 1: 0}
    link = BoardLink(lambda identity: None)
    link.connect(Instant(1000 * NS_PER_S))
    for message, pause in script:
        now += pause
        instant = Instant(round(now * NS_PER_S))
        events: list[Any] = []
        match message:
            case "descriptor":
                events = link.receive(from_board, instant)
            case "stranger":
                events = link.receive(replace(from_board, unique_id=bytes(8)), instant)
            case "future":
                events = link.receive(replace(from_board, major=9), instant)
            case "connect":
                link.connect(instant)
            case "disconnect":
                link.disconnect()
            case "command":
                try:
                    link.request(lambda n: SetRate(n, 1000), instant)
                except ValueError:
                    continue
            case _:
                events = link.receive(message, instant)
        events += link.tick(instant)
        assert len(link.outgoing()) <= COMMANDS + 4
        for event in events:
            if isinstance(event, Sampled):
                block = event.block
                assert block.captured <= instant
                assert block.captured >= last[block.array]
                assert block.uncertainty > 0
                last[block.array] = block.captured


@given(
    st.lists(st.one_of(st.binary(max_size=300), st.just("frame"), st.just("zeros")), max_size=40)
)
@settings(max_examples=40, deadline=None)
def test_line_accepts_any_bytes(script: list[Any]) -> None:
    line = SerialLine("p", lambda node, identity: None)
    line.connect(Instant(0))
    for step, item in enumerate(script):
        now = Instant(step * NS_PER_S // 5)
        data = {"frame": encode_serial(_descriptor()), "zeros": b"\0" * 300}.get(item, item)
        if data:
            line.receive(Chunk(now, data))
        line.tick(now)
        line.outgoing()


def test_chunks_dropped_on_overflow_are_counted_as_gaps(
    board: Any, instant: Callable[[float], Instant]
) -> None:
    line = SerialLine("p", lambda node, identity: None)
    line.connect(instant(0.0))
    line.receive(Chunk(instant(0.0), encode_serial(board.descriptor)))
    inbox = Inbox(Wake(), limit=10)
    for k in range(60):
        if k in (20, 40):
            # The pipeline runs only now and then.
            work_off(line, inbox)
        frames = [encode_serial(board.sample(a.array, k / 100)) for a in board.descriptor.arrays]
        board.sequence += 1
        inbox.put(Chunk(instant(k / 100), b"".join(frames)))
    work_off(line, inbox)
    link = line.links[0]
    assert isinstance(link, BoardLink)
    assert inbox.dropped == 30
    missing = [array.tracker.missing for array in link.arrays.values()]
    # The first ten were dropped before any was used, so they do not count as missing.
    assert missing == [20, 20]


def work_off(line: SerialLine, inbox: Inbox) -> None:
    while (item := inbox.take()) is not None:
        assert isinstance(item, Chunk)
        line.receive(item)


@pytest.fixture(autouse=True)
def _keep_descriptor(descriptor: Descriptor) -> None:
    _KEPT[:] = [descriptor]


_KEPT: list[Descriptor] = []


def _descriptor() -> Descriptor:
    return _KEPT[0]
