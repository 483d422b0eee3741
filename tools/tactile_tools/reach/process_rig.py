"""Reach as three real processes with an observer, for benchmarks of the daemons."""

from __future__ import annotations

import contextlib
import os
import pty
import select
import signal
import subprocess
import tempfile
import threading
import time
import tty
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Any

from sensor_proto.framing import SerialDecoder
from sensor_proto.packets import Samples
from tactile_core.bus.messages import codec
from tactile_core.bus.services import ServiceError, call
from tactile_core.bus.session import BusConfig, close_session, open_session
from tactile_core.bus.streams import BusSample, Tap
from tactile_core.bus.topics import ARM_STATE, COMMAND, FEATURES, REACH_STATE, Topic, service_key
from tactile_tools.processes import command, socket_at, wait_for

BOARD, ARM, REACH, WORLD = "finger", "arm", "reach", "world"
LOCKS = "TACTILE_RUNTIME_DIR"
WAIT_S = 120.0  # for anything to come about on a busy machine
WATCHED = (FEATURES, ARM_STATE, COMMAND, REACH_STATE)
NAMES = {FEATURES: BOARD, ARM_STATE: ARM, COMMAND: ARM, REACH_STATE: REACH}
MAX_HEARD = 60_000
"""Most samples of each topic that are kept between two `clear`: ten minutes' worth."""


class WatchError(RuntimeError):
    """Something did not happen in time; the text holds what the processes printed."""


class Relay:
    """Passes bytes between the simulated board and tactiled, and notes when they were sent.

    ``written``: by sequence of a cycle, the monotonic ns at which the write of its last bytes
    returned. ``path``: the port for tactiled.
    """

    def __init__(self, board: Path) -> None:
        self.written: dict[int, int] = {}
        self._board = os.open(board, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        self._master, self._slave = pty.openpty()
        tty.setraw(self._board)
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self.path = os.ttyname(self._slave)
        self._decoder = SerialDecoder()
        self._stopping = False
        self._thread = threading.Thread(target=self._run, name="relay", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop passing data on."""
        self._stopping = True
        self._thread.join()
        for end in (self._board, self._master, self._slave):
            os.close(end)

    def _run(self) -> None:
        while not self._stopping:
            ready, _, _ = select.select([self._board, self._master], [], [], 0.1)
            if self._master in ready:
                self._pass(self._master, self._board)
            if self._board in ready:
                data = self._pass(self._board, self._master)
                now = time.monotonic_ns()
                for received in self._decoder.feed(data):
                    if isinstance(received.message, Samples):
                        self.written[received.message.sequence] = now

    @staticmethod
    def _pass(source: int, target: int) -> bytes:
        try:
            data = os.read(source, 4096)
            os.write(target, data)
        except BlockingIOError:
            return b""  # nobody reads yet
        return data


class LiveReach:
    """``simdevice cupboard``, ``tactiled`` and ``reachd --serve``, each with its own endpoint.

    A context manager; `WatchError` if something does not happen in time. ``heard``: arrival
    (monotonic ns) and bytes of every sample of the topics in `WATCHED`, since `clear`.
    """

    def __init__(
        self,
        folder: Path,
        scene: Sequence[str],
        *,
        strategy: str,
        relay: bool = False,
        real_time: bool = True,
    ) -> None:
        self.folder = folder
        self.heard: dict[Topic, list[tuple[int, bytes]]] = {t: [] for t in WATCHED}
        self.relay: Relay | None = None
        self._with_relay = relay
        self._scene = scene
        self._strategy = strategy
        # A further setting of reachd: no priority even where the system would grant it.
        self._config: list[str] = []
        if not real_time:
            (folder / "ordinary.toml").write_text("[loop]\npriority = 0\n", encoding="utf-8")
            self._config = ["--config", "ordinary.toml"]
        self._stack = contextlib.ExitStack()
        # Not in ``folder``: the user chose that path, and a socket's path has at most ~100 bytes.
        place = Path(self._stack.enter_context(tempfile.TemporaryDirectory(prefix="tactile-bus-")))
        self._ends = {n: socket_at(place, n) for n in ("cupboard", "tactiled", "reachd")}
        self._started = 0
        self._running: dict[str, subprocess.Popen[bytes]] = {}

    def __enter__(self) -> LiveReach:
        """Start all three, and wait until features and states come."""
        try:
            self._session = open_session(BusConfig(listen=(), connect=tuple(self._ends.values())))
            self._stack.callback(close_session, self._session)
            for topic in WATCHED:
                tap = Tap(self._session, topic.key(NAMES[topic]), self._taker(topic))
                self._stack.callback(tap.close)
            self.start("cupboard")
            if self._with_relay:
                self.relay = Relay(self.folder / BOARD)
                self._stack.callback(self.relay.close)
            self.start("tactiled")
            self.start("reachd")
            self.wait_ready()
        except BaseException:
            self._close()
            raise
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """End all that runs."""
        self._close()

    def _close(self) -> None:
        for name in ("reachd", "tactiled", "cupboard"):
            process = self._running.get(name)
            if process is None or process.poll() is not None:
                continue
            process.send_signal(signal.SIGCONT)
            process.send_signal(signal.SIGTERM)
            try:
                process.wait(timeout=5)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        self._stack.close()

    def _taker(self, topic: Topic) -> Callable[[BusSample], None]:
        into = self.heard[topic]

        def take(sample: BusSample) -> None:
            if len(into) < MAX_HEARD:
                into.append((time.monotonic_ns(), sample.data))

        return take

    def start(self, name: str) -> None:
        """Start one of "cupboard", "tactiled", "reachd"."""
        self._started += 1
        path = self.folder / f"{name}.txt"
        with path.open("ab") as output:
            self._running[name] = subprocess.Popen(
                self._words(name),
                stdout=output,
                stderr=subprocess.STDOUT,
                cwd=self.folder,
                env=os.environ | {LOCKS: str(self.folder)},
            )
        if name == "cupboard":
            wait_for(self.folder / BOARD, self._running[name], path)

    def _words(self, name: str) -> list[str]:
        log = f"{name}-{self._started}.mcap"  # a new one after every start
        arm, skin, reach = (self._ends[n] for n in ("cupboard", "tactiled", "reachd"))
        if name == "cupboard":
            return [
                *(command("simdevice"), "cupboard", *self._scene, "--arm-rate", "200"),
                *("--pty", BOARD, "--listen", arm, "--connect", skin),
            ]
        if name == "tactiled":
            port = BOARD if self.relay is None else self.relay.path
            return [
                *(command("tactiled"), "--port", port, "--name", BOARD, "--log", log),
                *("--listen", skin, "--connect", arm),
            ]
        return [
            *(command("reachd"), "--serve", "--strategy", self._strategy, "--set", "authors_sim"),
            *("--board", BOARD, "--seed", "1", "--log", log, *self._config),
            *("--listen", reach, "--connect", arm, "--connect", skin),
        ]

    def signal(self, name: str, number: signal.Signals) -> int:
        """Signal one of the three. Returns the instant just before, monotonic ns."""
        now = time.monotonic_ns()
        self._running[name].send_signal(number)
        if number == signal.SIGKILL:
            self._running[name].wait()
        return now

    def ask(self, service: str, request: object = None, kind: str = REACH) -> Any:
        """Call a service of reachd, or of "arm" or "world"; ServiceError."""
        name = {REACH: REACH, "arm": ARM, "world": WORLD}[kind]
        return call(self._session, service_key(name, service, kind), request, WAIT_S)

    def clear(self) -> None:
        """Forget what was heard."""
        for kept in self.heard.values():
            kept.clear()

    def decoded(self, topic: Topic) -> list[tuple[int, Any]]:
        """Arrival, monotonic ns, and message of what was heard."""
        decode = codec().decode
        return [(at, decode(topic, data)) for at, data in list(self.heard[topic])]

    def until(self, done: Callable[[], object], what: str, seconds: float = WAIT_S) -> None:
        """Wait until ``done()``; WatchError says that ``what`` did not come."""
        end = time.monotonic() + seconds
        while not done():
            for name, process in self._running.items():
                if process.poll() not in (None, -signal.SIGKILL):
                    raise WatchError(f"{name} ended: {self._output_of(name)}")
            if time.monotonic() > end:
                raise WatchError(f"{what} did not come: {self._output_of('reachd')}")
            time.sleep(0.005)

    def _output_of(self, name: str) -> str:
        return (self.folder / f"{name}.txt").read_text(errors="replace")[-800:]

    def wait_ready(self) -> None:
        """Wait until all three send, and the features are valid."""
        self.clear()
        for topic in (ARM_STATE, FEATURES, REACH_STATE):
            self.until(partial(self._has_heard, topic), f"the first {topic.template}")
        self.until(lambda: self.last(FEATURES).valid, "valid features")

    def _has_heard(self, topic: Topic) -> bool:
        return bool(self.heard[topic])

    def last(self, topic: Topic) -> Any:
        """Newest message of a topic."""
        return codec().decode(topic, self.heard[topic][-1][1])

    def begin(self, seed: int | None = None) -> None:
        """Put world and arm back (as scene ``seed``, if given) and begin a reach."""
        if self.ask("status")["state"] in ("homing", "reaching"):
            self.ask("stop")
        if self.ask("status")["state"] == "resetting":
            self.ask("reset")
        end = time.monotonic() + WAIT_S
        goal = None
        while True:  # granted once the arm has come to rest and faults are over
            try:
                if goal is None:
                    goal = self.ask("reset", {"seed": seed}, "world")["goal"]
                    time.sleep(0.3)  # until skin and state show it
                self.ask("arm")
                self.ask("goal", {"x": goal[0], "y": goal[1]})
                return
            except ServiceError as error:
                if time.monotonic() > end:
                    raise WatchError(f"no reach could be begun: {error}") from error
                time.sleep(0.05)

    def ended(self) -> bool:
        """Whether the last state heard says that the reach has ended."""
        return bool(self.heard[REACH_STATE]) and self.last(REACH_STATE).state == "resetting"

    def moving(self) -> bool:
        """Whether the arm moves."""
        states = self.heard[ARM_STATE]
        return bool(states) and is_moving(self.last(ARM_STATE).twist)


def is_moving(twist: Any, at_rest: float = 1e-4) -> bool:
    """Whether a twist of a message is above ``at_rest`` (m/s, rad/s) in any part."""
    linear, angular = twist.linear, twist.angular
    return bool(max(abs(linear.x), abs(linear.y), abs(angular.z)) > at_rest)
