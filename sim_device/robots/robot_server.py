"""An emulated robot in real time: plant, controller, servers, faults on demand, and its world."""

from __future__ import annotations

import logging
import queue
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, Final, Protocol

import numpy as np
import zenoh

from sim_device.robots.plant import Pace, Plant, Truth
from sim_device.robots.sockets import Servers
from sim_device.world.base import World
from sim_device.world.scene_markers import scene_markers
from tactile_core.bus.messages import codec
from tactile_core.bus.session import BusConfig, close_session, open_session
from tactile_core.bus.streams import Publisher, declare_publisher
from tactile_core.bus.topics import WORLD
from tactile_core.types import NS_PER_S, Instant, WallClock, after

log = logging.getLogger(__name__)

MARKER_PERIOD: Final = 1 / WORLD.rate

MIRRORED: Final = np.diag([-1.0, -1.0, 1.0, 1.0, 1.0, -1.0])
"""What a robot makes of a velocity if its frame is turned about: x and y are reversed."""


COMMON_FAULTS: Final = (
    "freeze S", "slow GROWTH MOST", "mirror", "true", "place X Y H", "mark"
)  # fmt: skip
"""Faults of every emulated robot: those of the network, of its frame, and none."""


class FaultError(ValueError):
    """A fault is unknown or lacks a number; the message says what is allowed."""


class Emulated(Protocol):
    """A vendor's controller, as a server drives it."""

    plant: Plant

    def cycle(self) -> None:
        """One step of robot time."""
        ...

    def spontaneous(self, servers: Servers, now: Instant) -> None:
        """Send states, which nobody asks for."""
        ...

    def befall(self, fault: str, number: float | None, /) -> bool:
        """Apply a fault of this vendor's robots; False if there is none of that name."""
        ...

    @property
    def faults(self) -> tuple[str, ...]:
        """Names of its faults."""
        ...


class WorldOnBus:
    """Objects of the world as markers, for pictures and logs."""

    def __init__(self, world: World, name: str, bus: BusConfig) -> None:
        self._world = world
        self._name = name
        self._bus = bus
        self._wall = WallClock.take()
        self._codec = codec()
        self._session: zenoh.Session | None = None
        self._publisher: Publisher | None = None
        self._next = Instant(0)

    def open(self) -> None:
        """Join the bus; BusError."""
        self._session = open_session(self._bus)
        self._publisher = declare_publisher(self._session, WORLD, self._name)

    def close(self) -> None:
        """Leave the bus."""
        session, self._session = self._session, None
        if session is not None:
            close_session(session)

    def service(self, now: Instant) -> None:
        """Publish when it is time."""
        if self._publisher is None or now < self._next:
            return
        self._next = max(now, after(self._next, MARKER_PERIOD))
        wall_ns = self._wall.wall_ns(now)
        markers = scene_markers(self._world, wall_ns)
        self._publisher.put(self._codec.encode(WORLD, markers), wall_ns)


class RobotServer:
    """A `sim_device.runner.PortServer`. ``control``: take faults from standard input, by line."""

    def __init__(
        self,
        robot: Emulated,
        servers: Servers,
        truth: TruthFile,
        world: WorldOnBus | None,
        *,
        control: bool,
    ) -> None:
        self.robot = robot
        self.servers = servers
        self._truth = truth
        self._world = world
        self._pace = Pace()
        self._lines: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._control = control
        self._thaw: Instant | None = None
        self.sent = 0

    @property
    def finished(self) -> bool:
        """Never."""
        return False

    @property
    def losses(self) -> dict[str, int]:
        """What the network lost, and time in which the process stood still."""
        return self.servers.counters | {"suspended_ms": self._pace.skipped_ns // 1_000_000}

    def fileno(self) -> int:
        """Its sockets are looked at every tick."""
        return -1

    def open(self) -> None:
        """Listen, and join the bus."""
        self._truth.open()
        self.servers.open()
        if self._world is not None:
            self._world.open()
        if self._control:
            threading.Thread(target=self._read_lines, name="control", daemon=True).start()

    def close(self) -> None:
        """Hang up."""
        self.servers.close()
        self._truth.close()
        if self._world is not None:
            self._world.close()

    def service(self, now: Instant) -> None:
        """Obey faults, move the robot on, and answer."""
        with suppress(queue.Empty):
            while True:
                self._say(self.obey(self._lines.get_nowait(), now))
        if self._thaw is not None and now >= self._thaw:
            self.servers.frozen, self._thaw = False, None
        steps = self._pace.due(now)
        self.robot.plant.slipped = self._pace.skipped_ns / NS_PER_S
        for _ in range(steps):
            self.robot.cycle()
            if not self.servers.frozen:
                self.robot.spontaneous(self.servers, now)
        self.servers.serve(now)
        if self._world is not None:
            self._world.service(now)

    def obey(self, line: str, now: Instant) -> str:
        """Let a fault happen; what to answer."""
        word, _, rest = line.strip().partition(" ")
        try:
            numbers = [float(part) for part in rest.split()]
        except ValueError:
            return f"refused: {line.strip()!r} has no numbers after its word"
        plant, truth = self.robot.plant, self._truth
        number = numbers[0] if numbers else None
        if word == "freeze" and number is not None:
            self.servers.frozen, self._thaw = True, after(now, number)
        elif word == "slow" and len(numbers) == 2:
            self.servers.slow(numbers[0], numbers[1], now)
        elif word == "mirror":
            plant.wrong = MIRRORED
        elif word == "true":
            plant.wrong = np.eye(6)
        elif word == "place" and len(numbers) == 3:
            plant.place(*numbers)
        elif word != "mark" and not self.robot.befall(word, number):
            known = ", ".join(COMMON_FAULTS)
            return f"refused: {word!r}; allowed: {known}, {', '.join(self.robot.faults)}"
        truth.truth.event(plant, word)
        truth.flush()
        return f"{word} at {plant.time:.3f}"

    def _read_lines(self) -> None:
        for line in sys.stdin:
            if line.strip():
                self._lines.put(line)

    @staticmethod
    def _say(answer: str) -> None:
        print(answer, flush=True)


class TruthFile:
    """Where the truth is written; nowhere without a path."""

    def __init__(self, path: Path | None) -> None:
        self._path = path
        self._file: Any = None
        self.truth = Truth(None if path is None else self._write)

    def open(self) -> None:
        """Begin the file anew."""
        if self._path is not None:
            self._file = self._path.open("w", encoding="ascii", buffering=1 << 16)

    def flush(self) -> None:
        """Let readers see it."""
        if self._file is not None:
            self._file.flush()

    def close(self) -> None:
        """Close the file."""
        if self._file is not None:
            self._file.close()
            self._file = None

    def _write(self, line: str) -> None:
        if self._file is not None:
            self._file.write(line)


MakeController = Callable[[Plant, Truth], Emulated]
