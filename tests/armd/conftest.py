"""A robot of each kind, armd before it, and a commander: real processes, the vendors' clients."""

from __future__ import annotations

import contextlib
import itertools
import math
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from armd.drivers.catalogue import missing
from tactile_core.bus.services import ServiceError
from tactile_core.types import Twist
from tactile_tools.reach.one_reach import ReachRig, ReachScene
from tests.support import arms_report
from tests.support.commander import Commander, Row
from tests.support.waiting import becomes_true, wait_until

SLOW = float(os.environ.get("ARMS_SLOW", "60"))
"""s that anything may take on a busy machine before a test gives it up."""

SPEED = 0.03
EMULATED = ("ur", "xarm", "flexiv")
"""Robots in a process of their own. Of ``flexiv`` the vendor's module is faked as well."""

ALL = ("simulated", "mock", *EMULATED, "franka")
FRANKY_SIM = os.environ.get("FRANKY_SIM")
"""Path of the command franky-sim, in an environment of its own: it pulls another MuJoCo."""

FLEXIV = Path(__file__).with_name("flexiv")
FLEXIV_PORT = 30600
TRIES = 6
STREAMING = Path(__file__).with_name("streaming_commander.py")
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


FRANKA_CONFIG = """\
[robot]
address = "{address}"
simulated = true
[tool]
payload = 0.73
position = [0.0, 0.0, 0.1034]
rotation = [0.0, 0.0, -0.7854]
pivot_rotation = [3.14159265, 0.0, 0.0]
[limits]
f_max = 20.0
[frame]
origin = [0.712, 0.0, 0.521]
inside = [0.912, 0.0, 0.521]
left = [0.712, 0.2, 0.521]
"""
"""Of the pose in which franky-sim begins."""


def until(done: Callable[[], object], what: str, seconds: float = SLOW) -> None:
    wait_until(done, seconds, lambda: f"waited too long for {what}")


def skip_without(driver: str) -> None:
    if driver in ("simulated", "flexiv"):
        return
    problem = missing(driver)
    if problem is None and driver == "franka" and FRANKY_SIM is None:
        problem = "FRANKY_SIM does not name the command franky-sim, see docs/arm.md"
    if problem is not None:
        pytest.skip(problem)


def robot_command(driver: str) -> list[object]:
    if driver == "flexiv":
        return [sys.executable, FLEXIV / "robot.py", "--port", str(FLEXIV_PORT)]
    return [BIN / "simdevice", driver, "--control"]


@dataclass(frozen=True)
class Rest:
    """From a fault to rest: s of the robot's time, and m."""

    seconds: float
    metres: float


def rest_of(rows: list[Row], since: float, within: float) -> Rest:
    moving = [row[0] for row in rows if row[3] > 1e-3]
    seconds = max(0.0, moving[-1] - since) if moving else 0.0
    assert seconds <= within, f"moved until {seconds:.3f} s"
    assert rows[-1][0] - since > within, "not looked at for long enough"
    return Rest(seconds, sum(math.dist(a[1:3], b[1:3]) for a, b in itertools.pairwise(rows)))


class Robot:
    """An emulated robot in a process of its own, that takes faults a line each."""

    def __init__(self, driver: str, folder: Path, address: str) -> None:
        self.config = folder / "arm.toml"
        port = "port = 30502" if driver == "xarm" else ""
        self.config.write_text(CONFIG.format(address=address, port=port))
        self.truth_file = folder / "truth.txt"
        self.process = subprocess.Popen(
            [
                *robot_command(driver),
                *("--config", self.config, "--address", address, "--truth", self.truth_file),
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

    def truth(self) -> list[Row]:
        """Robot's s, m, m and m/s, up to now."""
        self.fault("mark")
        rows = []
        for line in self.truth_file.read_text().splitlines():
            parts = line.split()
            if len(parts) == 5:
                rows.append((float(parts[0]), float(parts[1]), float(parts[2]), float(parts[4])))
        return rows

    def stopped(self, since: float, within: float) -> Rest:
        """It rested ``within`` s of its time after ``since``, and stayed."""
        rows = [row for row in self.truth() if row[0] >= since]
        return rest_of(rows, since, within)

    def close(self) -> None:
        self.process.send_signal(signal.SIGCONT)
        self.process.kill()
        self.process.communicate()


class Simulator:
    """franky-sim, somebody else's simulator of Franka's controller, slower than real time."""

    def __init__(self, address: str, folder: Path) -> None:
        said = folder / "franky-sim.txt"
        with said.open("wb") as out:
            self.process = subprocess.Popen(
                [str(FRANKY_SIM), "-s", "mujoco", "--hostname", address],
                stdout=out, stderr=subprocess.STDOUT, env=os.environ | {"PYTHONUNBUFFERED": "1"},
            )  # fmt: skip
        until(lambda: "Press Ctrl+C" in said.read_text(), "franky-sim")

    def close(self) -> None:
        self.process.kill()
        self.process.wait()


class Served:
    """armd before a robot; the simulated arm needs none."""

    def __init__(self, driver: str, config: Path, endpoint: str, folder: Path) -> None:
        self.log = folder / "armd.txt"
        bus = ("--listen", endpoint, "--connect", endpoint + ".none")
        environment = dict(os.environ)
        if driver == "simulated":
            words: tuple[object, ...] = (BIN / "simdevice", "cupboard", *bus)
        else:
            words = (BIN / "armd", "--driver", driver, "--config", config, *bus)
        if driver == "flexiv":
            environment |= {
                "PYTHONPATH": str(FLEXIV), "FLEXIV_ROBOT_PORT": str(FLEXIV_PORT)
            }  # fmt: skip
        with self.log.open("wb") as out:
            self.process = subprocess.Popen(
                [str(word) for word in words], stdout=out, stderr=subprocess.STDOUT, env=environment
            )
        ready = b"arm" if driver == "simulated" else b"ready for"
        until(lambda: ready in self.log.read_bytes() or self.process.poll() is not None, "the arm")
        assert self.process.poll() is None, self.log.read_text()

    def close(self) -> None:
        self.process.send_signal(signal.SIGCONT)
        self.process.kill()
        self.process.wait()


class Rig:
    """Robot, armd and commander of one kind; `moving` gets it going whatever befell it before."""

    def __init__(self, driver: str, folder: Path, address: str) -> None:
        self.driver = driver
        self.folder = folder
        self.endpoint = f"unixsock-stream/{folder / 'arm.sock'}"
        self.address = address
        self.robot: Robot | None = None
        self.simulator: Simulator | None = None
        if driver in EMULATED:
            self.robot = Robot(driver, folder, address)
            self.config = self.robot.config
            if driver == "ur":
                self.robot.fault("unlock_after 0.1")
        else:
            self.config = folder / "arm.toml"
            text = FRANKA_CONFIG if driver == "franka" else CONFIG
            self.config.write_text(text.format(address=address, port=""))
        if driver == "franka":
            self.simulator = Simulator(address, folder)
        # The simulated arm has no file: its limits are its own.
        self.f_max = 50.0 if driver == "simulated" else 20.0
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
                if commander.mode != "stopped" or commander.status().get("reason"):
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

    def mark(self) -> float:
        """The robot's time, now; the arm's own clock where it is not a process of its own."""
        return time.monotonic() if self.robot is None else self.robot.fault("mark")

    def stopped(self, since: float, within: float) -> Rest:
        """See `Robot.stopped`; without a robot's own truth the states tell it."""
        if self.robot is not None:
            return self.robot.stopped(since, within)
        return rest_of([row for row in list(self.commander.rows) if row[0] >= since], since, within)

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
        if self.simulator is not None:
            self.simulator.close()


_numbers = iter(range(40, 250))


@contextlib.contextmanager
def rig_of(driver: str, folder: Path) -> Iterator[Rig]:
    skip_without(driver)
    worker = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0")[2:])
    address = f"127.0.{worker + 1}.{next(_numbers)}"
    made = Rig(driver, folder, address)
    try:
        yield made
        with contextlib.suppress(ServiceError):
            arms_report.note_latencies(driver, made.commander.status())
    finally:
        made.close()


Note = Callable[..., None]


@pytest.fixture
def note() -> Note:
    """``note(driver, fault, rest)``: kept where ARMS_JSON names a file; see `arms_report`."""
    return arms_report.note


@pytest.fixture(scope="module", params=ALL)
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


@pytest.fixture(scope="module", params=[d for d in ALL if d != "simulated"])
def served(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Any]:
    """One of each driver that armd serves."""
    with rig_of(request.param, tmp_path_factory.mktemp("a")) as made:
        yield made


@pytest.fixture
def flexiv_rig(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    with rig_of("flexiv", tmp_path_factory.mktemp("a")) as made:
        yield made


@pytest.fixture
def commanding() -> Iterator[Callable[[Rig], subprocess.Popen[str]]]:
    """``commanding(rig)``: a process that streams commands until it is killed; it moves."""
    made: list[subprocess.Popen[str]] = []

    def start(rig: Rig) -> subprocess.Popen[str]:
        for _ in range(TRIES):
            rig.moving()
            rig.resting()
            rig.commander.silent = True
            rig.commander.ask("release")
            speed = SPEED if rig.commander.state.x < -0.1 else -SPEED
            process = subprocess.Popen(
                [sys.executable, str(STREAMING), rig.endpoint, str(speed)],
                stdout=subprocess.PIPE, text=True,
            )  # fmt: skip
            made.append(process)
            assert process.stdout is not None
            assert "streaming" in process.stdout.readline()
            if becomes_true(lambda: abs(rig.commander.state.twist.linear.x) > 0.8 * SPEED, 3.0):
                return process
            end(process)  # a busy machine has stopped the robot, and this process clears nothing
            rig.claim()
        raise AssertionError("the arm did not move")

    yield start
    for process in made:
        end(process)


def end(process: subprocess.Popen[str]) -> None:
    process.kill()
    process.wait()


class Reaching:
    """A whole rig with reachd, which is under way; its states are listened to."""

    def __init__(self, arm: str, folder: Path, stack: contextlib.ExitStack) -> None:
        rig = stack.enter_context(ReachRig(ReachScene(arm, "authors_sim", 36, 36), folder))
        self.said = folder / "reachd.txt"
        self.listener = Commander(rig.arm, "listener")
        stack.callback(self.listener.close)
        self.rows = self.listener.rows
        self.reachd = rig.reachd("hybrid_event", 30.0, "--no-log", said=self.said)
        stack.callback(self._end)
        wait_until(lambda: self.reachd.poll() is not None or self.under_way, SLOW)

    @property
    def under_way(self) -> bool:
        recent = self.rows[-20:]
        return len(recent) == 20 and all(row[3] > 0.01 for row in recent)

    def stopped(self, since: float, within: float) -> Rest:
        return rest_of([row for row in list(self.rows) if row[0] >= since], since, within)

    def _end(self) -> None:
        self.reachd.send_signal(signal.SIGCONT)
        self.reachd.kill()
        self.reachd.wait()


@pytest.fixture
def reaching() -> Iterator[Callable[[str], Reaching]]:
    """``reaching(arm)``: a reach under way."""
    with contextlib.ExitStack() as stack:

        def start(arm: str) -> Reaching:
            skip_without(arm)
            for _ in range(TRIES):
                # A socket's path may have a hundred bytes.
                folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="arms-"))
                made = Reaching(arm, Path(folder), stack)
                if made.reachd.poll() is None:
                    return made
                # On a busy machine the gate refuses to begin: that is not in question here.
                stack.close()
            pytest.fail("no reach began: reachd refused each time, see docs/safety.md")

        yield start


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
