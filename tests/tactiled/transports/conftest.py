from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from sensor_proto.can_transfers import CanFrame
from sim_device.ports import PtyPort, SlcanPort
from tactiled.transports.base import Transport
from tests.support.slcan_adapter import AdapterThread
from tests.support.waiting import PATIENCE_S


@pytest.fixture
def pty(tmp_path: Path) -> Iterator[PtyPort]:
    port = PtyPort(tmp_path / "board0")
    port.open()
    yield port
    port.close()


@pytest.fixture
def adapter(tmp_path: Path) -> Iterator[AdapterThread]:
    thread = AdapterThread(SlcanPort(tmp_path / "can0"))
    yield thread
    thread.stop()


@pytest.fixture
def adapter_of(tmp_path: Path) -> Iterator[Callable[[str], AdapterThread]]:
    """``adapter_of(dialect)``: makes an adapter with that firmware."""
    made: list[AdapterThread] = []

    def make(dialect: str) -> AdapterThread:
        made.append(AdapterThread(SlcanPort(tmp_path / f"can{len(made)}", dialect=dialect)))
        return made[-1]

    yield make
    for thread in made:
        thread.stop()


def read_payload(transport: Transport, wanted: int, seconds: float = PATIENCE_S) -> bytes:
    """Read ``wanted`` bytes, or those that come within ``seconds``."""
    data = b""
    end = time.monotonic() + seconds
    while len(data) < wanted and time.monotonic() < end:
        chunk = transport.read(0.1)
        if chunk is not None:
            assert isinstance(chunk.payload, bytes)
            data += chunk.payload
    return data


def read_frames(transport: Transport, wanted: int, seconds: float = PATIENCE_S) -> list[CanFrame]:
    """Read ``wanted`` frames, or those that come within ``seconds``."""
    frames: list[CanFrame] = []
    end = time.monotonic() + seconds
    while len(frames) < wanted and time.monotonic() < end:
        chunk = transport.read(0.1)
        if chunk is not None:
            assert isinstance(chunk.payload, tuple)
            frames += chunk.payload
    return frames


@pytest.fixture
def read_bytes() -> Callable[..., bytes]:
    return read_payload


@pytest.fixture
def read_can() -> Callable[..., list[CanFrame]]:
    return read_frames


@pytest.fixture
def run_in_background() -> Iterator[Callable[[Callable[[], object]], Outcome]]:
    started: list[Outcome] = []

    def run(function: Callable[[], object]) -> Outcome:
        outcome = Outcome(function)
        started.append(outcome)
        return outcome

    yield run
    for outcome in started:
        outcome.join()


class Outcome:
    """Result or error of a function run in another thread."""

    def __init__(self, function: Callable[[], object]) -> None:
        self._function = function
        self.value: object = None
        self.error: Exception | None = None
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        try:
            self.value = self._function()
        except Exception as error:  # noqa: BLE001 - kept for the test to judge
            self.error = error

    @property
    def ended(self) -> bool:
        """Whether the function has returned or raised."""
        return not self._thread.is_alive()

    def join(self) -> None:
        self._thread.join(PATIENCE_S)
        assert not self._thread.is_alive()
