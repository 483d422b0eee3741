"""A robot of each kind, armd before it, and a commander: real processes, the vendors' clients."""

from __future__ import annotations

import contextlib
import itertools
import json
import math
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest

from armd.drivers.catalogue import missing
from tactile_core.bus.commanding import ClaimRequest, Grant, Signer, clock_domain, limits_fields
from tactile_core.bus.messages import codec
from tactile_core.bus.services import ServiceError, call
from tactile_core.bus.session import BusConfig, close_session, open_session
from tactile_core.bus.streams import BusSample, Tap, declare_publisher
from tactile_core.bus.topics import ARM_STATE, COMMAND, service_key
from tactile_core.types import ArmLimits, Twist, WallClock, monotonic_now
from tests.support.waiting import wait_until

SLOW = float(os.environ.get("ARMS_SLOW", "60"))
"""s that anything may take on a busy machine before a test gives it up."""

SPEED = 0.03
LIMITS = ArmLimits(v_max=0.045, omega_max=0.1, f_max=10.0, m_max=4.5)
EMULATED = ("ur", "xarm")
BIN = Path(sys.executable).parent

CONFIG = """\
[robot]
address = "{address}"
{port}
[tool]
payload = 0.8
position = [0.0, 0.0, 0.1]
pivot = [0.0, 0.03, 0.02]
pivot_rotation = [0.0, -1.5707963, 0.0]

[limits]
f_max = 20.0

[frame]
origin = [0.4, -0.2, 0.3]
inside = [0.4, -0.5, 0.3]
left = [0.6, -0.2, 0.3]
"""


def until(done: Callable[[], object], what: str, seconds: float = SLOW) -> None:
    wait_until(done, seconds, lambda: f"waited too long for {what}")


def skip_without(driver: str) -> None:
    problem = missing(driver)
    if problem is not None:
        pytest.skip(problem)


class Robot:
    """An emulated robot in a process of its own, that takes faults a line each."""

    def __init__(self, driver: str, folder: Path, address: str) -> None:
        self.config = folder / "arm.toml"
        port = "port = 30502" if driver == "xarm" else ""
        self.config.write_text(CONFIG.format(address=address, port=port))
        self.truth_file = folder / "truth.txt"
        self.process = subprocess.Popen(
            [
                *(BIN / "simdevice", driver, "--config", self.config, "--address", address),
                *("--truth", self.truth_file, "--control"),
            ],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        )
        assert self.process.stdout is not None
        assert "emulated" in self.process.stdout.readline()

    def fault(self, line: str) -> float:
        """Let it happen; the robot's time when it did."""
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.write(line + "\n")
        self.process.stdin.flush()
        answer = self.process.stdout.readline()
        assert " at " in answer, answer
        return float(answer.rsplit(" ", 1)[1])

    def truth(self) -> list[tuple[float, float, float, float]]:
        """Robot's s, m, m and m/s, up to now."""
        self.fault("mark")
        rows = []
        for line in self.truth_file.read_text().splitlines():
            parts = line.split()
            if len(parts) == 5:
                rows.append((float(parts[0]), float(parts[1]), float(parts[2]), float(parts[4])))
        return rows

    def stopped(self, since: float, within: float) -> float:
        """m that it went from ``since`` on; it rested ``within`` s of its time, and stayed."""
        rows = [row for row in self.truth() if row[0] >= since]
        moving = [row[0] for row in rows if row[3] > 1e-3]
        assert not moving or moving[-1] - since <= within, f"moved until {moving[-1] - since:.3f} s"
        assert rows[-1][0] - since > within, "not looked at for long enough"
        return sum(math.dist(a[1:3], b[1:3]) for a, b in itertools.pairwise(rows))

    def close(self) -> None:
        self.process.send_signal(signal.SIGCONT)
        self.process.kill()
        self.process.communicate()


class Served:
    """armd before a robot."""

    def __init__(self, driver: str, config: Path, endpoint: str, folder: Path) -> None:
        self.log = folder / "armd.txt"
        with self.log.open("wb") as out:
            self.process = subprocess.Popen(
                [
                    *(BIN / "armd", "--driver", driver, "--config", config),
                    *("--listen", endpoint, "--connect", endpoint + ".none"),
                ],
                stdout=out,
                stderr=subprocess.STDOUT,
            )
        until(
            lambda: b"ready for" in self.log.read_bytes() or self.process.poll() is not None, "armd"
        )
        assert self.process.poll() is None, self.log.read_text()

    def close(self) -> None:
        self.process.send_signal(signal.SIGCONT)
        self.process.kill()
        self.process.wait()


class Commander:
    """Commands the arm a hundred times a second, as reachd does."""

    def __init__(self, endpoint: str, name: str = "reach") -> None:
        self.session = open_session(BusConfig(connect=(endpoint,), listen=()))
        self.name = name
        self.state: Any = None
        self.heard = 0.0
        self.signer: Signer | None = None
        self.twist = Twist(0.0, 0.0, 0.0)
        self.silent = False
        self._wall = WallClock.take()
        self._codec = codec()
        self._publisher = declare_publisher(self.session, COMMAND, "arm")
        self._tap = Tap(self.session, ARM_STATE.key("arm"), self._hear)
        self._signing = threading.Lock()
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _hear(self, sample: BusSample) -> None:
        self.state, self.heard = self._codec.decode(ARM_STATE, sample.data), time.monotonic()

    def _run(self) -> None:
        while not self._stopping.wait(0.01):
            with self._signing:
                signer = self.signer
                if signer is None or self.silent:
                    continue
                now = monotonic_now()
                wall_ns = self._wall.wall_ns(now)
                self._publisher.put(signer.command(self.twist, now, 0.06, wall_ns), wall_ns)

    def ask(self, service: str, **fields: object) -> Any:
        assert self.signer is not None
        with self._signing:
            request = self.signer.sign(service, **fields)
        return call(self.session, service_key("arm", service, "arm"), request, 2.0)

    def claim(self) -> None:
        request = ClaimRequest(self.name, clock_domain())
        reply = call(self.session, service_key("arm", "claim", "arm"), request, SLOW)
        self.signer = Signer(msgspec.convert(reply, Grant))

    def limit(self, limits: ArmLimits = LIMITS) -> ArmLimits:
        return msgspec.convert(self.ask("limits", **limits_fields(limits)), ArmLimits)

    def status(self) -> dict[str, Any]:
        found: dict[str, Any] = call(self.session, service_key("arm", "status", "arm"), None, SLOW)
        return found

    def clear(self) -> None:
        """As an operator does, again and again until the robot is ready."""

        def cleared() -> bool:
            try:
                return self.ask("clear")["mode"] in ("ready", "moving", "stopped")
            except ServiceError:
                return False

        until(cleared, "clear")

    @property
    def mode(self) -> str:
        return "" if self.state is None else str(self.state.mode)

    def close(self) -> None:
        self._stopping.set()
        self._thread.join()
        close_session(self.session)


class Rig:
    """Robot, armd and commander of one kind; `moving` gets it going whatever befell it before."""

    def __init__(self, driver: str, folder: Path, address: str) -> None:
        self.driver = driver
        self.folder = folder
        self.endpoint = f"unixsock-stream/{folder / 'arm.sock'}"
        self.address = address
        self.robot: Robot | None = None
        if driver in EMULATED:
            self.robot = Robot(driver, folder, address)
            self.config = self.robot.config
            if driver == "ur":
                self.robot.fault("unlock_after 0.1")
        else:
            self.config = folder / "arm.toml"
            self.config.write_text(CONFIG.format(address=address, port=""))
        self.armd = Served(driver, self.config, self.endpoint, folder)
        self.commander = Commander(self.endpoint)
        self.claim()

    def claim(self) -> None:
        until(self._claimed, "the arm's command")

    def _claimed(self) -> bool:
        try:
            self.commander.claim()
            self.commander.limit()
        except ServiceError:
            return False
        return True

    def moving(self) -> None:
        """Be under way for a fifth of a second, inwards and outwards in turn."""
        commander = self.commander
        commander.silent = False

        def going() -> bool:
            x = commander.state.x if commander.state is not None else 0.0
            commander.twist = Twist(SPEED if x < -0.1 else -SPEED, 0.0, 0.0)
            if commander.mode in ("fault", "estop", "stopped"):
                commander.twist = Twist(0.0, 0.0, 0.0)
                if commander.mode != "stopped" or commander.status()["reason"]:
                    commander.clear()
                return False
            end = time.monotonic() + 0.2
            while time.monotonic() < end:
                if commander.mode != "moving" or abs(commander.state.twist.linear.x) < 0.8 * SPEED:
                    time.sleep(0.02)
                    return False
                time.sleep(0.01)
            return True

        until(going, f"motion: {commander.state}")

    def unlatched(self) -> bool:
        """Whether nothing is latched; clears what a busy machine made the robot stop for."""
        if self.commander.mode in ("fault", "estop", "stopped"):
            self.commander.clear()
            return False
        return True

    def resting(self) -> None:
        """Be ready and at rest."""
        self.commander.twist = Twist(0.0, 0.0, 0.0)
        until(lambda: self.unlatched() and self.commander.mode == "ready", "rest")

    def restart(self) -> None:
        """Another armd after one that was killed."""
        self.armd.close()
        self.armd = Served(self.driver, self.config, self.endpoint, self.folder)
        self.claim()

    def close(self) -> None:
        self.commander.close()
        self.armd.close()
        if self.robot is not None:
            self.robot.close()


_numbers = iter(range(40, 250))


@contextlib.contextmanager
def rig_of(driver: str, folder: Path) -> Iterator[Rig]:
    skip_without(driver)
    worker = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0")[2:])
    address = f"127.0.{worker + 1}.{next(_numbers)}"
    made = Rig(driver, folder, address)
    try:
        yield made
    finally:
        made.close()


@pytest.fixture
def distances(request: pytest.FixtureRequest) -> Callable[[str, str, float], None]:
    """``distances(driver, fault, m)``: kept where ARMS_JSON names a file, a line each."""

    def keep(driver: str, fault: str, metres: float) -> None:
        path = os.environ.get("ARMS_JSON")
        if path:
            row = {"driver": driver, "fault": fault, "mm": round(metres * 1e3, 2)}
            with open(path, "a", encoding="utf-8") as file:
                file.write(json.dumps(row) + "\n")

    return keep


@pytest.fixture(scope="module", params=["mock", "ur", "xarm"])
def rig(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """One of each driver, for all tests of a module."""
    with rig_of(request.param, tmp_path_factory.mktemp("a")) as made:
        yield made


@pytest.fixture(scope="module", params=EMULATED)
def robot_rig(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Any]:
    """One of each driver whose robot is a process of its own."""
    with rig_of(request.param, tmp_path_factory.mktemp("a")) as made:
        yield made


@pytest.fixture
def second(rig: Any) -> Iterator[Any]:
    """Another commander on the same bus."""
    made = Commander(rig.endpoint, "other")
    try:
        yield made
    finally:
        made.close()


@pytest.fixture
def wait() -> Callable[..., None]:
    """`until`."""
    return until


@pytest.fixture
def armd_command() -> Callable[..., subprocess.CompletedProcess[str]]:
    """Run ``armd`` with words to its end, ``lines`` on its standard input."""

    def run(*words: object, lines: str = "") -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [BIN / "armd", *map(str, words)],
            input=lines, capture_output=True, text=True, timeout=SLOW, check=False,
        )  # fmt: skip

    return run


@pytest.fixture
def skip() -> Callable[[str], None]:
    """Skip where a driver's library is not installed, with the reason."""
    return skip_without


@pytest.fixture
def robot(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Callable[[str], Robot]]:
    """``robot(driver)``: an emulated one, without armd."""
    made: list[Robot] = []

    def make(driver: str) -> Robot:
        skip_without(driver)
        worker = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0")[2:])
        address = f"127.0.{worker + 1}.{next(_numbers)}"
        made.append(Robot(driver, tmp_path_factory.mktemp("r"), address))
        return made[-1]

    yield make
    for one in made:
        one.close()
