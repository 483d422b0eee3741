"""A lab without hardware: an arm that obeys twists, a board's features, and reachd itself."""

from __future__ import annotations

import contextlib
import math
import os
import queue
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest
import zenoh

from reachd.strategies.parameters import SETS
from tactile_core.bus.commanding import (
    CommandDesk,
    LimitsRequest,
    NotGrantedError,
    Order,
    limits_fields,
    serve_desk,
)
from tactile_core.bus.messages import MSG, codec, header
from tactile_core.bus.services import ServiceError, call, declare_service
from tactile_core.bus.session import BusConfig, close_session, open_session
from tactile_core.bus.streams import declare_publisher
from tactile_core.bus.topics import ARM_STATE, COMMAND, REACH_EVENT, REACH_STATE, service_key
from tactile_core.types import ArmLimits, WallClock, monotonic_now

SLOW = 60.0
"""s that anything may take on a busy machine before a test gives it up."""


def until(done: Callable[[], object], seconds: float = SLOW) -> None:
    end = time.monotonic() + seconds
    while not done():
        assert time.monotonic() < end, "waited too long"
        time.sleep(0.01)


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@dataclass(frozen=True)
class Heard:
    """A command and when it came, in s of the monotonic clock."""

    at: float
    vx: float
    vy: float
    omega: float
    order: Order

    @property
    def still(self) -> bool:
        return self.vx == self.vy == self.omega == 0.0


class FakeArm:
    """Obeys twists without inertia, each until it expires; its tip starts at the shelf's edge."""

    def __init__(self, endpoint: str, name: str = "arm") -> None:
        self.name = name
        self.x, self.y, self.heading = -0.158, 0.0, 0.0
        self.force = (0.0, 0.0, 0.0)
        self.mode = "ready"
        self.paused = False
        self.does = lambda speed: speed  # what it makes of the speed that it is told
        self.frozen: Any = None  # a state whose values are repeated under fresh stamps
        self.deaf_to_limits = False
        self.limits = ArmLimits(0.5, 1.0, 100.0, 20.0)
        self.heard: list[Heard] = []
        self.travelled = 0.0
        self.session = open_session(BusConfig(listen=(endpoint,), connect=()))
        self._wall = WallClock.take()
        self._stopping = threading.Event()
        self._key = COMMAND.key(name)
        self.desk = CommandDesk()
        self._subscriber = self.session.declare_subscriber(self._key, self._hear)
        key = service_key(name, "limits", "arm")
        self._services = serve_desk(self.session, name, self.desk)
        self._services.append(declare_service(self.session, key, self._limit, LimitsRequest))
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    @property
    def moving(self) -> bool:
        return self.speed != (0.0, 0.0, 0.0)

    @property
    def speed(self) -> tuple[float, float, float]:
        last = self.heard[-1] if self.heard else None
        if last is None or monotonic_now() >= last.order.expires or self.mode in ("estop", "fault"):
            return (0.0, 0.0, 0.0)
        vx, vy, omega = self.does((last.vx, last.vy, last.omega))
        return (vx, vy, omega)

    def close(self) -> None:
        self._stopping.set()
        self._thread.join()
        close_session(self.session)

    def _hear(self, sample: zenoh.Sample) -> None:
        now = monotonic_now()
        if self.desk.hear(sample.payload.to_bytes(), now) is not None:
            return
        order = self.desk.newest(now)
        if order is None:  # it expired while this thread waited for the machine
            return
        twist = order.twist
        heard = Heard(time.monotonic(), twist.vx, twist.vy, twist.omega, order)
        assert all(math.isfinite(v) for v in (heard.vx, heard.vy, heard.omega))
        self.heard.append(heard)

    def _limit(self, request: LimitsRequest) -> ArmLimits:
        try:
            self.desk.authorise("limits", request, monotonic_now(), **limits_fields(request.limits))
        except NotGrantedError as error:
            raise ServiceError(str(error)) from error
        if not self.deaf_to_limits:
            self.limits = request.limits
        return self.limits

    def _run(self) -> None:
        publisher = declare_publisher(self.session, ARM_STATE, self.name)
        sequence, last = 0, time.monotonic()
        while not self._stopping.wait(0.005):
            now = time.monotonic()
            vx, vy, omega = self.speed
            self.x += vx * (now - last)
            self.y += vy * (now - last)
            self.heading += omega * (now - last)
            self.travelled += math.hypot(vx, vy) * (now - last)
            last = now
            if not self.paused:
                sequence += 1
                data = codec().encode(ARM_STATE, self._state(sequence))
                publisher.put(data, self._wall.wall_ns(monotonic_now()))

    def freeze(self) -> None:
        """Go on reporting what is the case now, whatever happens."""
        self.frozen = self._state(0)

    def _state(self, sequence: int) -> Any:
        now, limits = monotonic_now(), self.limits
        if self.frozen is not None:
            stamp = header(self._wall.wall_ns(now), "cupboard")
            return replace(
                self.frozen, header=stamp, captured_ns=now, sequence=sequence, **self._echo()
            )
        vx, vy, omega = self.speed
        fx, fy, mz = self.force
        return MSG.ArmState(
            header=header(self._wall.wall_ns(now), "cupboard"),
            captured_ns=now,
            sequence=sequence,
            x=self.x,
            y=self.y,
            heading=self.heading,
            twist=MSG.Twist(MSG.Vector3(vx, vy, 0.0), MSG.Vector3(0.0, 0.0, omega)),
            wrench=MSG.Wrench(MSG.Vector3(fx, fy, 0.0), MSG.Vector3(0.0, 0.0, mz)),
            mode=self.mode,
            v_max=limits.v_max,
            omega_max=limits.omega_max,
            f_max=limits.f_max,
            m_max=limits.m_max,
            **self._echo(),
        )

    def _echo(self) -> dict[str, Any]:
        last, commander = (self.heard[-1].order if self.heard else None), self.desk.commander
        mine = last is not None and last.commander == commander
        return {
            "commander": commander,
            "command_sequence": last.sequence if mine else 0,
            "command_ns": last.decided if mine else 0,
        }


class Wire:
    """A TCP connection to ``target`` that can be cut so that neither end is told.

    ``delay``: s that what goes towards ``target`` takes; the other way is as quick as ever.
    """

    def __init__(self, target: str) -> None:
        self.delay = 0.0
        self._target = int(target.rpartition(":")[2])
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.endpoint = f"tcp/127.0.0.1:{self._listener.getsockname()[1]}"
        self._whole = threading.Event()
        self._whole.set()
        self._ends: list[socket.socket] = [self._listener]
        threading.Thread(target=self._accept, daemon=True).start()

    def cut(self) -> None:
        """Pass nothing on; what is sent stays under way."""
        self._whole.clear()

    def mend(self) -> None:
        """Pass everything on again, and first what was under way."""
        self._whole.set()

    def close(self) -> None:
        self._whole.set()
        for end in self._ends:
            with contextlib.suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)
            end.close()

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                near, _ = self._listener.accept()
                far = self._far()
                if far is None:
                    near.close()
                    continue
                self._ends += [near, far]
                waiting: queue.SimpleQueue[tuple[float, bytes]] = queue.SimpleQueue()
                for work, args in (
                    (self._hold, (near, waiting)),
                    (self._let_go, (waiting, far)),
                    (self._pump, (far, near)),
                ):
                    threading.Thread(target=work, args=args, daemon=True).start()

    def _far(self) -> socket.socket | None:
        try:
            return socket.create_connection(("127.0.0.1", self._target), timeout=SLOW)
        except OSError:
            return None  # nobody listens yet; whoever connects tries again

    def _hold(self, source: socket.socket, waiting: queue.SimpleQueue[tuple[float, bytes]]) -> None:
        with contextlib.suppress(OSError):
            while data := source.recv(65536):
                waiting.put((time.monotonic() + self.delay, data))
        waiting.put((0.0, b""))

    def _let_go(self, waiting: queue.SimpleQueue[tuple[float, bytes]], sink: socket.socket) -> None:
        with contextlib.suppress(OSError):
            while (item := waiting.get())[1]:
                time.sleep(max(0.0, item[0] - time.monotonic()))
                self._whole.wait()
                sink.sendall(item[1])
            sink.shutdown(socket.SHUT_RDWR)

    def _pump(self, source: socket.socket, sink: socket.socket) -> None:
        with contextlib.suppress(OSError):
            while data := source.recv(65536):
                self._whole.wait()
                sink.sendall(data)
        for end in (source, sink):
            with contextlib.suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)


class Program:
    """A process with its output in a file."""

    def __init__(self, folder: Path, words: list[str], **environment: str) -> None:
        self.output = folder / f"{time.monotonic_ns()}.txt"
        with self.output.open("wb") as file:
            self.process = subprocess.Popen(
                [sys.executable, *words],
                stdout=file, stderr=subprocess.STDOUT, cwd=folder,
                env=os.environ
                | {"TACTILE_RUNTIME_DIR": str(folder), "COLUMNS": "200"}
                | environment,
            )  # fmt: skip

    @property
    def said(self) -> str:
        return self.output.read_text(errors="replace")

    def signal(self, number: signal.Signals) -> None:
        self.process.send_signal(number)

    def wait(self) -> int:
        return self.process.wait(SLOW)

    def end(self) -> None:
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait()


class Lab:
    """Starts what a test needs, and hears what reachd says."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.reachd_at = f"tcp/127.0.0.1:{free_port()}"
        self.arm_at = f"tcp/127.0.0.1:{free_port()}"
        self.events: list[Any] = []
        self.states: list[Any] = []
        self._arm: FakeArm | None = None
        self._programs: list[Program] = []
        self._wires: list[Wire] = []

    @property
    def arm(self) -> FakeArm:
        if self._arm is None:
            self._arm = FakeArm(self.arm_at)
            session = self._arm.session
            for topic, into in ((REACH_EVENT, self.events), (REACH_STATE, self.states)):
                session.declare_subscriber(topic.key("reach"), _into(topic, into))
        return self._arm

    def wire(self, target: str) -> Wire:
        """A way to ``target`` that can be cut."""
        self._wires.append(Wire(target))
        return self._wires[-1]

    def board(
        self,
        name: str = "board0",
        ahead: float = 0.0,
        prefix: str = "",
        via: str | None = None,
    ) -> Program:
        script = str(Path(__file__).with_name("board_process.py"))
        return self._start([script, via or self.reachd_at, name, str(ahead), prefix])

    def reachd(
        self, *words: str, listen: str | None = None, via: str | None = None, **environment: str
    ) -> Program:
        bus = ["--listen", listen or self.reachd_at, "--connect", via or self.arm_at]
        return self._start(["-m", "reachd", *bus, *words], **environment)

    def ask(self, service: str, request: object = None) -> Any:
        return call(self.arm.session, service_key("reach", service, "reach"), request, SLOW)

    def arms(self) -> bool:
        """Ask to arm; False as long as it is refused, as before the arm has granted its command."""
        try:
            return bool(self.ask("arm")["armed"])
        except ServiceError:
            return False

    def codes(self, kind: str) -> list[str]:
        return [event.code for event in list(self.events) if event.kind == kind]

    def reaching(self, program: Program) -> None:
        """Wait until the arm moves."""
        until(lambda: self.arm.moving or program.process.poll() is not None)
        assert program.process.poll() is None, program.said

    def told_to_stand(self) -> None:
        """Wait until the last word to the arm is zero: it may be on its way when reachd is gone."""
        until(lambda: bool(self.arm.heard) and all(h.still for h in self.arm.heard[-3:]))

    def close(self) -> None:
        for program in self._programs:
            program.end()
        for wire in self._wires:
            wire.close()
        if self._arm is not None:
            self._arm.close()

    def _start(self, words: list[str], **environment: str) -> Program:
        program = Program(self.folder, words, **environment)
        self._programs.append(program)
        return program


def _into(topic: Any, into: list[Any]) -> Callable[[zenoh.Sample], None]:
    return lambda sample: into.append(codec().decode(topic, sample.payload.to_bytes()))


@pytest.fixture
def lab(tmp_path: Path) -> Iterator[Lab]:
    made = Lab(tmp_path)
    try:
        yield made
    finally:
        made.close()


@pytest.fixture
def wait_until() -> Callable[..., None]:
    return until


@pytest.fixture
def hardware_limits() -> ArmLimits:
    return replace(SETS["hardware"].safety.arm_limits)
