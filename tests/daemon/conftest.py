"""A board of a few lines, so that links are judged without the simulator's firmware; and a lab.

The lab runs simulated boards and daemons as processes, and listens to them on the bus.
"""

from __future__ import annotations

import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zenoh

from sensor_proto.packets import (
    Ack,
    AckResult,
    ArrayDescriptor,
    BoardMessage,
    ChipType,
    ClockPoll,
    ClockReply,
    Descriptor,
    HostMessage,
    Identify,
    Samples,
    SetRate,
    Start,
    Status,
    Stop,
)
from tactile_core.bus.messages import codec
from tactile_core.bus.services import call
from tactile_core.bus.session import BusConfig, close_session, open_session
from tactile_core.bus.topics import FEATURES, service_key
from tactile_core.types import NS_PER_S, Instant

TICK_HZ = 1_000_000

SLOW = 60.0
"""s that anything may take on a busy machine before a test gives it up."""

DESCRIPTOR = Descriptor(
    major=1,
    minor=0,
    unique_id=bytes.fromhex("00000000000000aa"),
    model="pad",
    firmware="1.2.3",
    tick_hz=TICK_HZ,
    max_rate_mhz=493_000,
    arrays=(
        ArrayDescriptor(0, "pad", ChipType.MLX90393, 2, 2, 8000, 150, 242),
        ArrayDescriptor(1, "rim", ChipType.MLX90393, 1, 3, 8000, 150, 242),
    ),
)


def at(seconds: float) -> Instant:
    return Instant(1000 * NS_PER_S + round(seconds * NS_PER_S))


@dataclass
class ScriptedBoard:
    """Answers as a board does; what it does not do is told by its switches."""

    descriptor: Descriptor = DESCRIPTOR
    period: float = 0.01
    error: float = 0.0
    deaf: bool = False
    mute: bool = False
    results: dict[type, AckResult] = field(default_factory=dict)
    heard: list[HostMessage] = field(default_factory=list)
    booted: float = 0.0
    streaming: bool = False
    sequence: int = 0
    rate_mhz: int = 100_000
    _next: float = 0.0
    _status: float = 0.0

    def reboot(self, now: float) -> None:
        self.booted, self.streaming, self.sequence = now, False, 0
        self._status = now + 1.0

    def ticks(self, now: float) -> int:
        return int((now - self.booted) * (1 + self.error) * TICK_HZ) % 2**32

    def hear(self, message: HostMessage, now: float) -> list[BoardMessage]:
        self.heard.append(message)
        if self.deaf or self.mute:
            return []
        match message:
            case Identify():
                return [self.descriptor]
            case ClockPoll():
                return [ClockReply(message.token, self.ticks(now), self.ticks(now))]
            case Start() | Stop() | SetRate():
                result = self.results.get(type(message), AckResult.OK)
                if result is AckResult.OK:
                    self._obey(message, now)
                kind = {Start: 0x82, Stop: 0x83, SetRate: 0x84}[type(message)]
                return [Ack(kind, message.request, result)]
            case _:
                return []

    def _obey(self, message: HostMessage, now: float) -> None:
        if isinstance(message, SetRate):
            self.rate_mhz = message.rate_mhz
            self.period = 1000 / message.rate_mhz
        elif not self.streaming or isinstance(message, Stop):
            self.streaming = isinstance(message, Start)
            self._next = now + self.period

    def speak(self, now: float) -> list[BoardMessage]:
        out: list[BoardMessage] = []
        while self.streaming and self._next <= now:
            out += [self.sample(a.array, self._next) for a in self.descriptor.arrays]
            self.sequence = (self.sequence + 1) % 2**32
            self._next += self.period
        if now >= self._status:
            self._status = now + 1.0
            uptime = round((now - self.booted) * 1000)
            out.append(Status(uptime, self.sequence, 0, 0, 0, self.rate_mhz, 0))
        return [] if self.mute else out

    def sample(self, array: int, when: float) -> Samples:
        taxels = next(a.taxels for a in self.descriptor.arrays if a.array == array)
        counts = np.tile(np.array([100, -200, 300], np.int16), (taxels, 1))
        status = np.zeros(taxels, np.uint8)
        return Samples(array, self.sequence, self.ticks(when), 2512, counts, status)


@pytest.fixture
def descriptor() -> Descriptor:
    return DESCRIPTOR


@pytest.fixture
def board() -> ScriptedBoard:
    return ScriptedBoard()


@pytest.fixture
def make_board() -> Callable[..., ScriptedBoard]:
    def make(serial: str = "00000000000000aa", **options: Any) -> ScriptedBoard:
        return ScriptedBoard(replace(DESCRIPTOR, unique_id=bytes.fromhex(serial)), **options)

    return make


@pytest.fixture
def instant() -> Callable[[float], Instant]:
    return at


def wait_until(done: Callable[[], bool], seconds: float = SLOW) -> None:
    end = time.monotonic() + seconds
    while not done():
        assert time.monotonic() < end, "waited too long"
        time.sleep(0.02)


class Program:
    """One of our commands with its output in a file."""

    def __init__(self, folder: Path, name: str, *words: str) -> None:
        self.output = folder / f"{name}-{time.monotonic_ns()}.txt"
        with self.output.open("wb") as file:
            self.process = subprocess.Popen(
                [str(Path(sys.executable).with_name(name)), *words],
                stdout=file, stderr=subprocess.STDOUT, cwd=folder,
            )  # fmt: skip

    @property
    def said(self) -> str:
        return self.output.read_text(errors="replace")

    def wait(self, seconds: float = SLOW) -> int:
        return self.process.wait(seconds)

    def wait_for(self, text: str) -> None:
        wait_until(lambda: text in self.said or self.process.poll() is not None)
        assert text in self.said, self.said

    def end(self) -> None:
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait()


class Lab:
    """Starts simulated boards and daemons, and listens to them."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.endpoint = self.free_endpoint()
        self._programs: list[Program] = []
        self._sessions: list[zenoh.Session] = []

    def boards(self, *words: str, link: str) -> Program:
        program = self._start("simdevice", "boards", *words)
        wait_until(lambda: (self.folder / link).exists() or program.process.poll() is not None)
        assert program.process.poll() is None, program.said
        return program

    def tactiled(self, *words: str, endpoint: str | None = None) -> Program:
        return self._start("tactiled", "--listen", endpoint or self.endpoint, *words)

    def calibration(self, *words: str) -> None:
        """What `simdevice calibration` writes is there."""
        made = self._start("simdevice", "calibration", *words)
        assert made.wait() == 0, made.said

    @staticmethod
    def free_endpoint() -> str:
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            return f"tcp/127.0.0.1:{probe.getsockname()[1]}"

    def listen(self) -> zenoh.Session:
        session = open_session(BusConfig(listen=(), connect=(self.endpoint,)))
        self._sessions.append(session)
        return session

    def close(self) -> None:
        for session in self._sessions:
            close_session(session)
        for program in self._programs:
            program.end()

    def _start(self, name: str, *words: str) -> Program:
        program = Program(self.folder, name, *words)
        self._programs.append(program)
        return program


class Ear:
    """Every features message of a board, with the instant at which it came."""

    def __init__(self, session: zenoh.Session, name: str = "board0", prefix: str = "") -> None:
        self.heard: list[tuple[float, Any]] = []
        self._subscriber = session.declare_subscriber(FEATURES.key(name, prefix), self._take)

    def _take(self, sample: zenoh.Sample) -> None:
        message = codec().decode(FEATURES, sample.payload.to_bytes())
        self.heard.append((time.monotonic(), message))

    def wait(self, count: int = 1, after: float = 0.0) -> Any:
        """The last of ``count`` valid features that came after an instant."""
        fresh: list[Any] = []

        def enough() -> bool:
            fresh[:] = [m for at, m in list(self.heard) if at > after and m.valid]
            return len(fresh) >= count

        wait_until(enough)
        return fresh[-1]


@contextmanager
def a_lab(folder: Path) -> Iterator[Lab]:
    lab = Lab(folder)
    try:
        yield lab
    finally:
        lab.close()


@pytest.fixture
def lab(tmp_path: Path) -> Iterator[Lab]:
    with a_lab(tmp_path) as made:
        yield made


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Lab, Program, Any]]:
    """A finger and an AnySkin board under one daemon, for tests that only ask and listen."""
    with a_lab(tmp_path_factory.mktemp("running")) as lab:
        lab.boards("--pty", "board0", "--seed", "1", link="board0")
        lab.boards("--pty", "skin0", "--board", "anyskin", "--seed", "2", link="skin0")
        lab.calibration("--seed", "1", "--out", "board0.cal.toml")
        daemon = lab.tactiled(
            "--port", "board0", "--name", "board0", "--port", "skin0", "--name", "skin0",
            "--calibration", "board0.cal.toml", "--log", "run.mcap",
        )  # fmt: skip
        session = lab.listen()
        Ear(session).wait(20)
        yield lab, daemon, session


@pytest.fixture
def until() -> Callable[..., None]:
    """``until(done)``: wait for it, or fail."""
    return wait_until


@pytest.fixture
def hear() -> type[Ear]:
    """``hear(session, name)``: listen to the features of a board from now on."""
    return Ear


@pytest.fixture
def ask() -> Callable[..., Any]:
    """``ask(session, service)``: what the service of a board answers."""

    def question(
        session: zenoh.Session,
        service: str,
        payload: object = None,
        name: str = "board0",
        timeout: float = SLOW,
    ) -> Any:
        return call(session, service_key(name, service), payload, timeout)

    return question
