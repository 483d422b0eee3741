"""One robot on the bus: a thread that reads it, a thread that moves it, and one that watches both.

Apart from `Driver.read`, only the moving thread calls the robot; services hand it jobs. Nobody
waits for a robot that does not answer: it is latched, and its own watchdog stops it.
"""

from __future__ import annotations

import gc
import logging
import queue
import threading
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Final

import numpy as np

from armd.config import ArmConfig, check_facts
from armd.driver import Driver, DriverError, RobotFacts, SetupError
from armd.frames import Plane
from armd.guard import Guard
from armd.port import ArmPort, Job
from tactile_core.bus.services import ServiceError
from tactile_core.bus.session import BusConfig, BusError
from tactile_core.cli import REFUSED, CommandError
from tactile_core.daemon import Service, request_real_time
from tactile_core.types import ArmLimits, ArmState, Instant, after, monotonic_now, seconds_between

log = logging.getLogger(__name__)

LOOK: Final = 0.02
"""Period of the watching thread, s."""

ASKED: Final = 0.8
"""Time for which a service waits for the robot, s; its caller waits for 1 s."""

FIRST_STATE: Final = 3.0
"""Time in which a connected robot must send its first state, s."""

CONNECTING: Final = 30.0
"""s in which a robot must be connected; releasing brakes takes some of it."""

LOST: Final = 5.0
"""Time for which a library may hang before the process gives up, s: nothing else frees it."""

PUBLISH_AT_MOST: Final = 1 / 250
"""s between two states on the bus at least: a robot may send a thousand a second."""

RECOVERING: Final = 20.0
"""s that an operator's request may keep the robot busy before it counts as hanging."""

LATENCIES: Final = 4096
"""Latencies kept for `status`."""


class Daemon(Service):
    """Serve ``driver`` as the arm called ``name``. `start`, then `watch` until told to stop."""

    prog = "armd"
    refusals = (DriverError, BusError)

    def __init__(
        self, driver: Driver, config: ArmConfig, plane: Plane, bus: BusConfig, name: str
    ) -> None:
        super().__init__()
        self.driver = driver
        self._config = config
        self._guard = Guard(plane, config.caps, steady=not config.robot.simulated)
        self._lock = threading.Lock()
        self._publishing = threading.Lock()
        self._wake = threading.Event()
        self._stopping = threading.Event()
        self._jobs: queue.SimpleQueue[Job] = queue.SimpleQueue()
        self._clearing: Job | None = None
        self._call_since: Instant | None = None
        self._busy_until: Instant | None = None
        self._facts = RobotFacts("")
        self._on_wire: deque[int] = deque(maxlen=LATENCIES)
        self._reading: deque[int] = deque(maxlen=LATENCIES)
        self._published = Instant(0)
        self._connecting = False
        self._real_time = False
        self._threads: list[threading.Thread] = []
        self.port = ArmPort(
            name,
            bus,
            set_limits=self._set_limits,
            clear=self._clear,
            status=self._status,
            heard=self._wake.set,
        )

    def _start(self) -> None:
        """Connect, check, join the bus and serve."""
        priority = self._config.robot.priority
        if priority > 1:
            # Of the threads of the vendor's library, too: the robot's own watchdog stops a robot
            # whose commands are 50 ms late, and only an operator gets it going again.
            self._real_time = request_real_time(priority - 1)
        self.port.open()
        self._connecting = True
        try:
            self._facts = self._connect()
            unchecked = check_facts(self._config, self._facts)
            if unchecked:
                log.warning(
                    "the robot does not say its %s: look at it yourself", " and ".join(unchecked)
                )
            if self._config.robot.zero_force:
                self.driver.zero_force()
            self._await_state()
        except SetupError as error:
            self.stop()
            raise CommandError(str(error)) from error
        own = sorted(self._facts.enforces)
        log.info("%s; %s", self._facts.model, self.driver.note)
        log.info("limits are kept here%s", f", {', '.join(own)} by the robot, too" if own else "")
        self.port.begin()
        gc.collect()
        gc.freeze()  # what is there now lives as long as the process
        for work in (self._read, self._move):
            thread = threading.Thread(
                target=self._guarded, args=(work,), name=work.__name__.strip("_"), daemon=True
            )
            thread.start()
            self._threads.append(thread)

    def _connect(self) -> RobotFacts:
        """Connect; DriverError where the library does not return, as with a silent robot."""
        facts: list[RobotFacts] = []
        job = Job(lambda: facts.append(self.driver.connect()))
        threading.Thread(target=job.run, name="connect", daemon=True).start()
        if not job.wait(CONNECTING):
            self._connecting = False  # a library that hangs is not to be closed either
            raise DriverError(
                f"the robot at {self._config.robot.address} takes connections and does not answer "
                f"within {CONNECTING:g} s: look at [robot] address and start the robot again"
            )
        if job.error is not None:
            raise job.error
        return facts[0]

    def _guarded(self, work: Callable[[], None]) -> None:
        """Run a thread; what it raises ends the daemon, and the robot's own watchdog stops it."""
        try:
            if self._real_time:
                request_real_time(self._config.robot.priority)
            work()
        except Exception as error:  # noqa: BLE001 - kept for the verdict
            self.fail(error)

    def watch(self, stopping: Callable[[], bool]) -> None:
        """Look after the threads until ``stopping()``; `CommandError` when it cannot go on."""
        while not stopping() and not self.done.is_set():
            self._stopping.wait(LOOK)
            now = monotonic_now()
            with self._lock:
                call = self._call_since
                lasts = 0.0 if call is None else seconds_between(call, now)
                if self._busy_until is not None and now < self._busy_until:
                    lasts = 0.0
                news = self._guard.check(now, lasts)
                latch, state = self._guard.latch, self._guard.state
            if news and latch is not None:
                log.error("%s: %s", latch.mode, latch.reason)
            if state is not None and latch is not None:
                self._tell(replace(state, mode=latch.mode), now, again=True)
            if lasts > LOST:
                raise CommandError(
                    f"the robot's library has not returned for {lasts:.0f} s: start armd again",
                    REFUSED,
                )
            self.watchdog.beat(now)

    def stop(self) -> bool:
        """Rest, and let go of robot and bus; False where a thread does not end."""
        self._stopping.set()
        self._wake.set()
        for thread in self._threads:
            thread.join(1.0)
        ended = not any(thread.is_alive() for thread in self._threads)
        if ended and self._connecting:
            try:
                self.driver.close()
            except DriverError as error:
                log.warning("%s", error)
        self.port.close()
        return ended

    def _await_state(self) -> None:
        deadline = after(monotonic_now(), FIRST_STATE)
        while monotonic_now() < deadline:
            robot = self.driver.read()
            if robot is not None:
                with self._lock:
                    self._guard.see(robot, monotonic_now())
                    problem, latch = self._guard.out_of_plane(), self._guard.latch
                if latch is not None:
                    log.warning("%s: %s; clear it when its cause is gone", latch.mode, latch.reason)
                elif problem is not None:
                    raise SetupError(problem)
                return
        raise DriverError(
            f"{self._facts.model} was connected and sends no states within {FIRST_STATE:g} s: "
            "look at its network and start it again"
        )

    # The reading thread.

    def _read(self) -> None:
        while not self._stopping.is_set():
            try:
                robot = self.driver.read()
            except DriverError as error:
                self._latch("fault", str(error))
                self._stopping.wait(LOOK)
                continue
            if robot is None:
                continue
            now = monotonic_now()
            with self._lock:
                before = self._guard.latch
                state = self._guard.see(robot, now)
                latch = self._guard.latch
            if latch is not None and latch is not before:
                self._wake.set()  # rest at once
                log.error("%s: %s", latch.mode, latch.reason)
            if state is not None:
                self._tell(state, now)

    def _tell(self, state: ArmState, now: Instant, *, again: bool = False) -> None:
        """Publish; ``again``: although it was told, for its mode has changed since."""
        with self._publishing:
            if not again and seconds_between(self._published, now) < PUBLISH_AT_MOST:
                return
            self._published = now
            self.port.publish(state)
            if not again:
                self._reading.append(monotonic_now() - state.captured)

    # The moving thread.

    def _move(self) -> None:
        period = 1 / self.driver.rate
        resting = False
        while not self._stopping.is_set():
            self._wake.wait(period)
            self._wake.clear()
            self._do_jobs()
            now = monotonic_now()
            with self._lock:
                order = self.port.arbiter.newest(now)
                if order is not None:
                    self._guard.obey(order, now)
                velocity, echo = self._guard.velocity(now)
                self._call_since = now
            try:
                if velocity is None:
                    self.driver.halt()
                else:
                    self.driver.move(velocity)
            except DriverError as error:
                self._latch("fault", str(error))
                self._stopping.wait(LOOK)
                echo = None
            resting = velocity is None
            done = monotonic_now()
            with self._lock:
                self._call_since = None
                self._guard.sent(echo)
            if order is not None and not resting:
                # Of another machine's clock it says nothing, but then it is far from this.
                took = done - order.decided
                if 0 <= took < 10**9:
                    self._on_wire.append(took)
        try:
            self.driver.halt()
        except DriverError as error:
            log.debug("no rest was confirmed: %s", error)

    def _do_jobs(self) -> None:
        while True:
            try:
                job = self._jobs.get_nowait()
            except queue.Empty:
                return
            with self._lock:
                self._busy_until = after(monotonic_now(), RECOVERING)
                self._call_since = monotonic_now()
            job.run()
            with self._lock:
                self._busy_until = self._call_since = None

    def _latch(self, mode: str, reason: str) -> None:
        with self._lock:
            news = self._guard.stop(mode, reason)
        if news:
            log.error("%s: %s", mode, reason)

    # Services, on zenoh's threads.

    def _ask(self, job: Job) -> None:
        self._jobs.put(job)
        self._wake.set()

    def _set_limits(self, limits: ArmLimits) -> ArmLimits:
        with self._lock:
            kept = self._guard.request_limits(limits, self.port.arbiter.commander)
        job = Job(lambda: self.driver.limit(kept))
        self._ask(job)
        if not job.wait(ASKED) or job.error is not None:
            with self._lock:
                self._guard.forget_limits()
            if job.error is None:
                raise ServiceError("the robot takes its time with the limits: ask again")
            raise ServiceError(f"the robot refuses the limits: {job.error}")
        return kept

    def _clear(self) -> str:
        job = self._clearing
        if job is None:
            job = self._clearing = Job(self._recover)
            self._ask(job)
        if not job.wait(ASKED):
            raise ServiceError("the robot is being recovered: ask again in a second")
        self._clearing = None
        if job.error is not None:
            raise ServiceError(str(job.error))
        with self._lock:
            return self._guard.mode

    def _recover(self) -> None:
        """Have the robot ready again, then the guard."""
        with self._lock:
            if self._guard.latch is None:
                return
        self.driver.recover()
        deadline = after(monotonic_now(), FIRST_STATE)
        problem: str | None = "the robot sends no states"
        while problem is not None and monotonic_now() < deadline:
            self._stopping.wait(LOOK)
            self.driver.halt()  # the robot's own watchdog runs again
            with self._lock:
                problem = self._guard.clear(monotonic_now())
        if problem is not None:
            raise DriverError(f"not cleared: {problem}")
        log.info("cleared by an operator")

    def _status(self) -> Mapping[str, object]:
        with self._lock:
            guard = self._guard
            counters = dict(guard.counters) | self.port.refused
            latch, mode, limits = guard.latch, guard.mode, guard.limits
        facts = self._facts
        return {
            "mode": mode,
            "reason": None if latch is None else latch.reason,
            "limits": limits,
            "enforced_by_robot": sorted(facts.enforces),
            "robot": facts.model,
            "note": self.driver.note,
            "decided_to_wire_ms": _percentiles(self._on_wire),
            "state_to_bus_ms": _percentiles(self._reading),
            "counters": counters,
        }


def _percentiles(nanoseconds: deque[int]) -> dict[str, float]:
    """p50 and p99 in ms; empty where there are none."""
    values = np.array(list(nanoseconds), dtype=np.float64) / 1e6
    if not values.size:
        return {}
    p50, p99 = np.percentile(values, [50, 99])
    return {"p50": round(float(p50), 2), "p99": round(float(p99), 2), "n": int(values.size)}
