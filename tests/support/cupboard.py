"""`simdevice cupboard` as a real process, and a commander of its arm."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import msgspec
import zenoh

from sim_device.world.scenes import Pose, Scene, SceneObject, Shape
from tactile_core.bus.commanding import ClaimRequest, Grant, Signer, clock_domain
from tactile_core.bus.messages import codec
from tactile_core.bus.services import ServiceError, call
from tactile_core.bus.session import BusConfig, close_session, open_session
from tactile_core.bus.streams import BusSample, Publisher, Tap, declare_publisher
from tactile_core.bus.topics import ARM_STATE, COMMAND, service_key
from tactile_core.types import NS_PER_S, Twist, WallClock, monotonic_now
from tests.support.network import free_port
from tests.support.waiting import wait_until

RADIUS = 0.04
DISC_X = 0.02
TIP_START = -0.042
WAY = DISC_X - RADIUS - TIP_START  # m that the finger moves until it touches
LIMITS = {"v_max": 0.05, "omega_max": 0.35, "f_max": 10.0, "m_max": 1.5}
EXPIRY = 0.06


def disc_scene(mass: float = 2.0) -> Scene:
    disc = SceneObject(
        Shape.DISC, 2 * RADIUS, 2 * RADIUS, height=0.08, mass=mass, x=DISC_X, y=0.01, yaw=0.0
    )
    return Scene("test", "authors_sim", 5, 0.375, 0.55, Pose(-0.2, 0.0, 0.0), (0.358, 0.1), (disc,))


class Commander:
    """Sends ``twist`` 100 times a second until stopped; after that nothing, not even a zero.

    It claims the arm (ServiceError if refused), or sends under the given ``grant``.
    """

    def __init__(
        self, session: zenoh.Session, twist: Twist, grant: Grant | None = None, name: str = "test"
    ) -> None:
        self._publisher = declare_publisher(session, COMMAND, "arm")
        self.grant = claim(session, name) if grant is None else grant
        self.signer = Signer(self.grant)
        self._twist = twist
        self._delay = 0.0
        self._queue: list[tuple[float, bytes]] = []
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def delay(self, seconds: float) -> None:
        """Delay commands from now on; those already queued are still sent."""
        self._delay = seconds

    def stop(self) -> None:
        """Decide nothing more; queued commands are still sent. Harmless when stopped already."""
        if self._stop.is_set():
            return
        self._stop.set()
        self._thread.join()
        self._publisher.close()

    def _run(self) -> None:
        wall = WallClock.take()
        while not self._stop.wait(0.01) or self._queue:
            now = monotonic_now()
            if not self._stop.is_set():
                data = self.signer.command(self._twist, now, EXPIRY, wall.wall_ns(now))
                self._queue.append((time.monotonic() + self._delay, data))
            else:
                time.sleep(0.01)
            while self._queue and self._queue[0][0] <= time.monotonic():
                self._publisher.put(self._queue.pop(0)[1], wall.wall_ns(now))


def claim(session: zenoh.Session, name: str = "test", clock: str | None = None) -> Grant:
    """Claim the command of the arm. Raises ServiceError if another commander has it."""
    request = ClaimRequest(name, clock_domain() if clock is None else clock)
    return msgspec.convert(call(session, service_key("arm", "claim", "arm"), request, 20), Grant)


class Cupboard:
    """A running ``simdevice cupboard`` and a session on its bus.

    ``states``: all received states.
    """

    def __init__(self, folder: Path, scene: str, *arguments: str) -> None:
        self.folder = folder
        self.port = free_port()
        self.process = subprocess.Popen(
            [sys.executable, "-m", "sim_device", "cupboard", "--scene", scene, "--seed", "3",
             "--pty", "board0", "--listen", f"tcp/127.0.0.1:{self.port}",
             "--connect", f"tcp/127.0.0.1:{free_port()}", *arguments],
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=folder,
        )  # fmt: skip
        assert self.process.stdout is not None
        self.said = [self.process.stdout.readline() for _ in range(2)]
        self.session = open_session(BusConfig(listen=(), connect=(f"tcp/127.0.0.1:{self.port}",)))
        self.states: list[Any] = []
        self._commanders: list[Commander] = []
        self._tap = Tap(self.session, ARM_STATE.key("arm"), self._take)
        self.call("status")

    def _take(self, sample: BusSample) -> None:
        self.states.append(codec().decode(ARM_STATE, sample.data))

    def call(self, service: str, request: object = None, kind: str = "arm") -> Any:
        key = service_key("arm" if kind == "arm" else "world", service, kind)
        return call(self.session, key, request, timeout=60)

    def publisher(self) -> Publisher:
        return declare_publisher(self.session, COMMAND, "arm")

    def commander(self, twist: Twist, **how: Any) -> Commander:
        self._commanders.append(Commander(self.session, twist, **how))
        return self._commanders[-1]

    def claim(self, name: str = "test") -> Signer:
        return Signer(claim(self.session, name))

    def rest(self) -> None:
        """Wait until no command is queued, as a late one would move an arm that had stopped."""
        since = monotonic_now()
        wait_until(
            lambda: (
                self.states
                and self.states[-1].captured_ns > since + 0.15 * NS_PER_S
                and self.states[-1].mode != "moving"
            )
        )

    def reset(self) -> None:
        """Bring the arm to rest, free its command, and put everything back in place."""
        self.dismiss()
        self.rest()
        wait_until(lambda: not self.owned())
        self.call("reset", kind="world")
        self.call("limits", LIMITS)

    def dismiss(self) -> None:
        """Stop the commanders that a failed test has left."""
        while self._commanders:
            self._commanders.pop().stop()

    def owned(self) -> bool:
        """Whether the arm still has a commander, who must fall silent first."""
        try:
            self.call("limits", LIMITS)
        except ServiceError:
            return True
        return False

    def end(self) -> tuple[int, str]:
        self.process.send_signal(signal.SIGINT)
        _, errors = self.process.communicate(timeout=120)
        return self.process.returncode, errors

    def close(self) -> None:
        self.dismiss()
        close_session(self.session)
        if self.process.poll() is None:
            os.kill(self.process.pid, 9)
            self.process.communicate()
