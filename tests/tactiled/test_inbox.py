"""The queue between reader and pipeline: bounded; drops the oldest chunks, never port events."""

from __future__ import annotations

from collections.abc import Callable

from tactile_core.types import Instant
from tactiled.blocks import Chunk
from tactiled.reader import Inbox, PortLost, PortOpened, Wake


def test_oldest_chunks_are_dropped_and_counted(instant: Callable[[float], Instant]) -> None:
    inbox = Inbox(Wake(), limit=10)
    chunks = [Chunk(instant(k), bytes([k])) for k in range(25)]
    inbox.put(PortOpened())
    for chunk in chunks:
        inbox.put(chunk)
    inbox.put(PortLost("gone"))
    assert inbox.full
    assert inbox.dropped == 15
    taken = []
    while (item := inbox.take()) is not None:
        taken.append(item)
    assert taken == [PortOpened(), *chunks[15:], PortLost("gone")]


def test_stale_chunks_are_dropped(instant: Callable[[float], Instant]) -> None:
    inbox = Inbox(Wake(), max_age=0.5)
    for k in range(100):
        inbox.put(Chunk(instant(k / 100), bytes([k])))
    assert inbox.dropped == 49
    first = inbox.take()
    assert isinstance(first, Chunk)
    assert first.payload == bytes([49])


def test_incoming_items_wake_the_pipeline(instant: Callable[[float], Instant]) -> None:
    wake = Wake()
    inbox = Inbox(wake)
    inbox.put(Chunk(instant(0), b"x"))
    wake.wait(60.0)  # returns at once: it was rung before
    assert inbox.take() is not None
    assert inbox.take() is None
