"""The reader's thread with a scripted transport."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from tactile_core.types import Instant
from tactiled.blocks import Chunk
from tactiled.reader import Inbox, PortEnded, PortLost, PortOpened, PortReader, Wake, byte_time
from tactiled.transports import (
    BusState,
    EndOfLog,
    Medium,
    PortBusy,
    PortClosed,
    PortGone,
    PortMissing,
)


class ScriptedTransport:
    """Takes the results of reads, and of openings, from queues of chunks or errors to raise."""

    name = "scripted"
    medium = Medium.SERIAL
    state = BusState.ACTIVE
    losses: dict[str, int] = {}  # noqa: RUF012 - never changed

    def __init__(self) -> None:
        self.reads: queue.Queue[Chunk | Exception] = queue.Queue()
        self.openings: list[Exception] = []
        self.opened = 0
        self._closed = threading.Event()

    def open(self) -> None:
        if self.openings:
            raise self.openings.pop(0)
        self.opened += 1

    def read(self, timeout: float) -> Chunk | None:
        if self._closed.is_set() or not self.opened:
            raise PortClosed("closed")
        try:
            item = self.reads.get(timeout=timeout)
        except queue.Empty:
            return None
        if isinstance(item, Exception):
            raise item
        return item

    def write(self, data: Any) -> None:
        raise AssertionError("a reader does not write")

    def close(self) -> None:
        self._closed.set()


class RawLog:
    """Stand-in for the publisher that keeps what a reader logs."""

    def __init__(self) -> None:
        self.chunks: list[Chunk] = []

    def raw(self, name: str, port: str, chunk: Chunk) -> None:
        self.chunks.append(chunk)


class Rig:
    def __init__(self, paced: bool = False, limit: int = 100) -> None:
        self.transport = ScriptedTransport()
        self.inbox = Inbox(Wake(), limit)
        self.log = RawLog()
        self.failures: list[BaseException] = []
        publisher: Any = self.log
        self.reader = PortReader(
            self.transport, self.inbox, publisher, "b", self.failures.append, paced
        )

    def next(self) -> Any:
        end = time.monotonic() + 60
        while (item := self.inbox.take()) is None:
            assert time.monotonic() < end
            time.sleep(0.002)
        return item


@pytest.fixture
def rig() -> Iterator[Rig]:
    made = Rig()
    yield made
    made.reader.stop()


def test_chunks_are_handed_over_and_logged(rig: Rig, instant: Callable[[float], Instant]) -> None:
    chunks = [Chunk(instant(k), bytes([k])) for k in range(100)]
    for chunk in chunks:
        rig.transport.reads.put(chunk)
    rig.reader.open(wait=False)
    rig.reader.start()
    assert rig.next() == PortOpened()
    assert [rig.next() for _ in chunks] == chunks
    assert rig.reader.stop()
    assert rig.log.chunks == chunks


def test_vanished_port_is_reported_and_reopened(rig: Rig) -> None:
    rig.reader.open(wait=False)
    rig.reader.start()
    assert rig.next() == PortOpened()
    rig.transport.openings = [PortMissing("not yet"), PortBusy("not yet")]
    rig.transport.reads.put(PortGone("unplugged", "plug it in"))
    assert rig.next() == PortLost("unplugged; plug it in")
    assert rig.next() == PortOpened()
    assert rig.reader.reopened == 1
    assert not rig.failures


def test_port_missing_at_start_is_an_error_or_waited_for(rig: Rig) -> None:
    rig.transport.openings = [PortMissing("no port"), PortMissing("no port")]
    with pytest.raises(PortMissing):
        rig.reader.open(wait=False)
    rig.reader.open(wait=True)
    rig.reader.start()
    assert rig.next() == PortOpened()


def test_reader_failure_is_reported(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    rig.reader.open(wait=False)

    def put(item: Any) -> None:
        raise RuntimeError("no inbox")

    monkeypatch.setattr(rig.inbox, "put", put)
    rig.transport.reads.put(RuntimeError("driver"))
    rig.reader.start()
    end = time.monotonic() + 60
    while not rig.failures:
        assert time.monotonic() < end
        time.sleep(0.002)
    assert str(rig.failures[0]) == "no inbox"


def test_failing_driver_counts_as_lost_port_and_is_reopened(
    rig: Rig, instant: Callable[[float], Instant]
) -> None:
    rig.reader.open(wait=False)
    rig.transport.reads.put(ZeroDivisionError("a driver's mistake"))
    rig.transport.reads.put(Chunk(instant(0), b"x"))
    rig.reader.start()
    assert isinstance(rig.next(), PortOpened)
    lost = rig.next()
    assert isinstance(lost, PortLost)
    assert lost.reason == "scripted failed: a driver's mistake"
    assert isinstance(rig.next(), PortOpened)
    assert rig.next() == Chunk(instant(0), b"x")
    assert rig.reader.stop()
    assert rig.failures == []


def test_recording_waits_for_the_pipeline_and_ends(instant: Callable[[float], Instant]) -> None:
    rig = Rig(paced=True, limit=4)
    chunks = [Chunk(instant(k), bytes([k])) for k in range(50)]
    for chunk in chunks:
        rig.transport.reads.put(chunk)
    rig.transport.reads.put(EndOfLog("end"))
    rig.reader.open(wait=False)
    rig.reader.start()
    items = [rig.next() for _ in range(52)]
    assert items == [PortOpened(), *chunks, PortEnded()]
    assert rig.inbox.dropped == 0
    rig.reader.stop()


def test_only_a_uart_has_wire_time() -> None:
    assert byte_time("/dev/ttyUSB0", 115_200) == pytest.approx(86.8e-6, rel=1e-3)
    assert byte_time("/dev/ttyACM0", 115_200) == 0
    assert byte_time("/dev/pts/3", 115_200) == 0
    assert byte_time(None, 115_200) == 0
