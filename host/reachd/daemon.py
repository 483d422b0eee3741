"""The daemon: threads and I/O around the pure core.

Threads: the control loop's (`control`), the reporter's (`publish`), the log's writer (`recorder`),
zenoh's own for services and for logged topics, and the main thread, which watches. If one dies,
the daemon ends with an error; the arm then stops by itself because commands cease.
"""

from __future__ import annotations

import dataclasses
import gc
import json
import logging
import math
import platform
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import zenoh

from reachd.arms import Arm, ArmError, BusArm
from reachd.control import Controller, ControlLoop, Cycle, Inputs
from reachd.gate.gate import SafetyGate
from reachd.gate.settings import Check, SafetySettings
from reachd.inputs import TouchInput
from reachd.interfaces import Goal, Strategy
from reachd.lock import ArmLock, LockError
from reachd.publish import Reporter, TopicLogger, as_json
from reachd.services import OperatorRequests, ReachServices, RefusedError
from reachd.settings import Settings
from reachd.trial import Outcome, State, Supervisor
from tactile_core.bus.messages import codec
from tactile_core.bus.session import BusError, close_session, open_session
from tactile_core.bus.streams import list_alive
from tactile_core.bus.topics import ARM_STATE, FEATURES, alive_key, commander_key, service_key
from tactile_core.daemon import Service, StartError, request_real_time
from tactile_core.log.recorder import Recorder, RecorderError
from tactile_core.log.retention import DiskWatch
from tactile_core.types import Echo, Instant, WallClock, monotonic_now, seconds_between

log = logging.getLogger(__name__)

SWITCH_INTERVAL = 0.0002
"""s after which Python switches threads: the control loop must run soon after it wakes."""

ASK_COMMANDERS = 0.5
"""s to find out whether another reachd commands the arm; part of it is needed to connect."""

ASK_AGAIN = 0.02
"""s between queries meanwhile."""

ARM_TRIES = 3
"""Times that the gate is asked to arm before a reach is given up."""

ARM_AGAIN_S = 0.3
"""s between these."""

STOP_TIMEOUT = 0.3
"""s for the control loop to end; a cycle takes 10 ms."""

COLLECT_EVERY = 10.0
"""s between collections of garbage while nothing moves."""

NAMES_TIMEOUT = 0.5
"""s to query the names of boards, for an error message."""


class Daemon(Service):
    """reachd between `start` and `stop`; used from the main thread."""

    prog = "reachd"
    refusals = (LockError, BusError, RecorderError, ArmError)

    def __init__(self, settings: Settings, strategy: Strategy) -> None:
        super().__init__()
        self.settings = settings
        self._wall = WallClock.take()
        self._lock = ArmLock(settings.arm)
        self._session: zenoh.Session | None = None
        self._arm: Arm | None = None
        self._touch: TouchInput | None = None
        self._reporter: Reporter | None = None
        self._topic_logger: TopicLogger | None = None
        self._services: ReachServices | None = None
        self._requests: OperatorRequests | None = None
        self._tokens: list[zenoh.LivelinessToken] = []
        self._log_state = "recording"
        self._disk: DiskWatch | None = None
        self._commanded = False  # whether we have ever commanded the arm
        self._collected = monotonic_now()
        p = settings.parameters
        supervisor = Supervisor(strategy, p, settings.home, auto_reset=settings.auto_reset)
        self.loop = ControlLoop(
            Controller(supervisor, SafetyGate(p.safety), p.safety),
            p.safety.period,
            p.safety.command_expiry,
            self._sense,
            self._act,
            self._report,
            self.fail,
            settings.priority,
        )

    @property
    def about(self) -> dict[str, Any]:
        """Settings that describe a reach in logs and outcomes."""
        s = self.settings
        return {
            "strategy": s.strategy,
            "set": s.parameters.name,
            "seed": s.seed,
            "note": s.parameters.note,
        }

    def _start(self) -> None:
        if self._wall.problem:
            log.warning("%s", self._wall.problem)
        try:
            self._open()
        except zenoh.ZError as error:
            raise BusError(f"the bus has closed by itself: {error}") from error

    def _open(self) -> None:
        settings, safety = self.settings, self.settings.parameters.safety
        self._lock.acquire(settings.name)
        sys.setswitchinterval(SWITCH_INTERVAL)
        if settings.priority > 1:
            self.loop.real_time = request_real_time(settings.priority - 1)
        codec()
        self._session = session = open_session(settings.bus)
        self._claim(session)
        if settings.log is not None:
            self.recorder = recorder = self._open_log(settings.log)
            self._disk = DiskWatch(lambda: Path(recorder.stats.path).parent)
            self._disk.start()
            self._topic_logger = TopicLogger(
                session, self.recorder, self._wall, settings.board, settings.arm
            )
        self._touch = TouchInput(
            session, settings.board, safety.features_age, remote=settings.remote_board
        )
        self._arm = BusArm(
            session,
            settings.arm,
            self._wall,
            safety.arm_age,
            reach=settings.name,
            remote=settings.remote_arm,
        )
        self._arm.open()
        self._reporter = Reporter(
            session,
            self.recorder,
            self._wall,
            settings.name,
            settings.arm,
            settings.strategy,
            self.fail,
        )
        self._requests = OperatorRequests(
            self.loop, self._arm, settings.parameters, self._reporter, self._log_trouble
        )
        for caution in safety.cautions:
            log.warning("safety: %s", caution)
            self._reporter.event("safety", "caution", caution)
        if settings.parameters.note:
            log.info("set %s: %s", settings.parameters.name, settings.parameters.note)
            self._reporter.event("safety", "note", settings.parameters.note)
        # Objects alive now are exempted from garbage collection, which would stop the loop.
        gc.collect()
        gc.freeze()
        gc.disable()
        self.loop.start()
        self._services = ReachServices(session, settings.name, self._requests, self.summary)

    def _claim(self, session: zenoh.Session) -> None:
        """Declare that we command the arm; `StartError` when another reachd on the bus does."""
        arm, name = self.settings.arm, self.settings.name
        mine = commander_key(arm, f"{name}-{str(session.zid())[:32]}")
        self._tokens = [
            session.liveliness().declare_token(key) for key in (mine, alive_key(name, "reach"))
        ]
        deadline = time.monotonic() + ASK_COMMANDERS
        others: set[str] = set()
        while not others and (left := deadline - time.monotonic()) > 0:
            replies = session.liveliness().get(f"arm/{arm}/commander/*", timeout=left)
            others = {str(reply.ok.key_expr) for reply in replies if reply.ok is not None} - {mine}
            time.sleep(ASK_AGAIN)
        if others:
            who = others.pop().rsplit("/", 1)[1].rpartition("-")[0]
            raise StartError(
                f"arm {arm!r} is commanded by another reachd (reach {who!r}) on this bus: stop "
                "that one, or name another --arm"
            )

    def wait_ready(self, stopping: threading.Event) -> None:
        """Wait for valid features and the arm's state; `StartError` when they do not come."""
        safety = self.settings.parameters.safety
        deadline = time.monotonic() + self.settings.wait
        while not (stopping.is_set() or self.done.is_set()):
            self.check_arm()
            cycle = self.loop.last
            if cycle is not None and _inputs_ready(cycle, safety):
                return
            if time.monotonic() >= deadline:
                raise StartError(self._missing())
            stopping.wait(0.02)

    def check_arm(self) -> None:
        """Raise `StartError` when we never commanded the arm and another commander has it."""
        if self._arm is not None and self._arm.denied is not None and not self._commanded:
            raise StartError(self._arm.denied)
        cycle = self.loop.last
        arm = None if cycle is None else cycle.inputs.arm
        self._commanded |= arm is not None and arm.echo is not None and arm.echo.own

    def reach(self, goal: Goal) -> None:
        """Arm the gate and begin a reach; `StartError` when either is refused."""
        requests, touch = self._requests, self._touch
        if requests is None or touch is None:
            raise RuntimeError("reach() before start()")
        try:
            self._arm_gate(requests)
            if not touch.calibrated:
                log.warning("board %s is not calibrated: its forces are rough", self.settings.board)
            requests.reach(goal.x, goal.y, goal.radius, goal.time_limit)
        except RefusedError as error:
            raise StartError(f"nothing moves: {error}") from error

    @staticmethod
    def _arm_gate(requests: OperatorRequests) -> None:
        """Arm the gate; again where it is refused, for an input may be late on a busy machine."""
        for left in reversed(range(ARM_TRIES)):
            try:
                requests.arm()
                return
            except RefusedError as error:
                if not left:
                    raise
                log.info("not armed yet: %s", error)
                time.sleep(ARM_AGAIN_S)

    def cancel(self, text: str) -> None:
        """Stop a reach under way and give it an outcome; the next cycle sends the zero twist."""
        if self._requests is None or not self.moving:
            return
        try:
            self._requests.stop(text)
        except RefusedError as error:
            log.debug("%s", error)
            return
        cycles, deadline = self.loop.lateness.cycles, time.monotonic() + STOP_TIMEOUT
        while self.loop.lateness.cycles == cycles and time.monotonic() < deadline:
            time.sleep(0.001)

    @property
    def moving(self) -> bool:
        """Whether a trial is under way."""
        return self.loop.controller.supervisor.state in (State.HOMING, State.REACHING)

    def conclude(self, outcome: Outcome, goal: Goal) -> str:
        """Write an outcome into the log and return it as JSON."""
        text = as_json(outcome, goal, self.about)
        if self.recorder is not None:
            self.recorder.metadata("outcome", {"json": text})
        return text

    def watch(self) -> None:
        """Watch the log, request the geometry, collect garbage; called a few times a second."""
        if self.recorder is not None:
            stats = self.recorder.stats
            if stats.state != self._log_state:
                self._log_state = stats.state
                level = logging.INFO if stats.state == "recording" else logging.ERROR
                log.log(level, "log %s: %s %s", stats.path, stats.state, stats.last_error)
        cycle, now = self.loop.last, monotonic_now()
        if self._topic_logger is not None and cycle is not None and cycle.inputs.touch is not None:
            try:
                self._topic_logger.ask_geometry()
            except zenoh.ZError as error:  # the log only lacks a picture
                log.debug("the geometry of the board cannot be asked for: %s", error)
        if not self.moving and seconds_between(self._collected, now) > COLLECT_EVERY:
            self._collected = now
            gc.collect()

    def _log_trouble(self) -> str | None:
        """Why a requested log is not being written, or None."""
        if self.recorder is None:
            return None
        stats = self.recorder.stats
        if stats.state == "recording":
            return None
        return (
            f"the log {stats.path} is not being written ({stats.state}: {stats.last_error}): mend "
            "that, or start reachd with --no-log"
        )

    def stop(self) -> bool:
        """End in order: zero twist, services, reports, log (at most 1 s), arm, bus, lock.

        The session closes after everything that publishes. False when a thread is still inside
        other code, such as the strategy's: it must be left behind.
        """
        clean = ended = self.loop.stop(STOP_TIMEOUT)
        if self._disk is not None:
            self._disk.stop()
        if self._services is not None:
            self._services.close()
        if self._topic_logger is not None:
            self._topic_logger.close()
        if self._reporter is not None:
            clean &= self._reporter.close()
        if self.recorder is not None:
            self.recorder.metadata("lateness", _texts(self.loop.lateness.summary()))
            if not self.recorder.close():
                log.error("the log was not closed in time; see `tactile log recover`")
                clean = False
        for part in (self._arm if ended else None, self._touch):
            with suppress(zenoh.ZError):  # the session has closed by itself
                if part is not None:
                    part.close()
        if self._session is not None:
            clean &= close_session(self._session)
            self._session = None
        self._lock.release()
        return clean

    def summary(self) -> dict[str, Any]:
        """State for the status service, in s, m and N."""
        cycle, touch, arm = self.loop.last, self._touch, self._arm
        values: dict[str, Any] = self.about | {
            "board": self.settings.board,
            "arm": self.settings.arm,
            "cycles": self.loop.lateness.cycles,
            "deadlines_missed": self.loop.missed,
            "real_time": self.loop.real_time,
            "lateness_s": self.loop.lateness.summary(),
            "features": {} if touch is None else touch.counters(),
            "arm_state": {} if arm is None else arm.counters(),
            "alarms": self._alarms(),
            "cautions": self.settings.parameters.safety.cautions,
            "note": self.settings.parameters.note,
            "reports_dropped": 0 if self._reporter is None else self._reporter.dropped,
            "reports_unsent": 0 if self._reporter is None else self._reporter.unsent,
            "clock_problem": self._wall.problem,
        }
        # Not from the last cycle, which may be older than a request that was just granted.
        status = self.loop.controller.supervisor.status(monotonic_now())
        held = self.loop.controller.gate.held
        values |= {
            "state": str(status.state),
            "activity": status.activity,
            "text": status.text,
            "elapsed": status.elapsed,
            "distance": None if math.isnan(status.distance) else status.distance,
            "goal": None if status.goal is None else dataclasses.asdict(status.goal),
            "armed": held is None,
            "held": None if held is None else str(held.code),
            "interventions": []
            if cycle is None
            else [i.text for i in cycle.decision.interventions],
            "outcome": status.outcome,
        }
        if self.recorder is not None:
            values["log"] = dataclasses.asdict(self.recorder.stats)
        return values

    def _alarms(self) -> list[str]:
        disk = None if self._disk is None else self._disk.alarm(monotonic_now())
        return [] if disk is None else [disk]

    # Called by the control loop

    def _sense(self, now: Instant) -> Inputs:
        touch, arm = self._touch, self._arm
        if touch is None or arm is None:
            return Inputs(None, None)
        newest, state = touch.newest(now), arm.state(now)
        duplicate = touch.duplicated(now) or arm.duplicated(now)
        return Inputs(newest, state, duplicate, arm.rivalled(now))

    def _act(self, twist: Any, expiry: float, now: Instant) -> bytes:
        return b"" if self._arm is None else self._arm.command(twist, expiry, now)

    def _report(self, cycle: Cycle, sent: bytes) -> None:
        self.watchdog.beat(monotonic_now())  # on the control loop's thread, after its command
        if self._reporter is not None:
            self._reporter.cycle(cycle, sent)

    def _open_log(self, destination: Path) -> Recorder:
        settings = self.settings
        recorder = Recorder(destination, settings.recorder, prefix=settings.name, clock=self._wall)
        about = {key: str(value) for key, value in self.about.items()}
        machine = {"python": platform.python_version(), "host": platform.platform()}
        names = {"board": settings.board, "arm": settings.arm, "reach": settings.name}
        recorder.metadata("reachd", about | names | machine)
        values = json.dumps(dataclasses.asdict(settings.parameters), default=sorted, indent=1)
        recorder.attach("parameters.json", "application/json", values.encode())
        if settings.config_path is not None:
            text = settings.config_path.read_bytes()
            recorder.attach(settings.config_path.name, "application/toml", text)
        return recorder

    def _missing(self) -> str:
        """Which inputs are missing or unusable, and the remedy."""
        s, cycle, touch = self.settings, self.loop.last, self._touch
        safety = s.parameters.safety
        seen = None if cycle is None else cycle.inputs.touch
        problems = []
        if cycle is None or seen is None or touch is None:
            names = [] if self._session is None else list_alive(self._session, NAMES_TIMEOUT)
            there = f"boards on the bus: {', '.join(names)}" if names else "no board is on the bus"
            problems.append(
                f"no features came on {FEATURES.key(s.board)} within {s.wait:g} s: is tactiled "
                f"running, and is this the board's name (--board)? {there}"
            )
        elif not seen.valid:
            problems.append(f"the features of {s.board} are not valid: {', '.join(touch.reasons)}")
        elif not -safety.future <= cycle.touch_age < safety.features_age:
            problems.append(
                f"the features of {s.board} are {cycle.touch_age:.3f} s old: has tactiled stopped? "
                'If it runs on another machine, set [inputs] board_clock = "remote"'
            )
        if cycle is None or cycle.inputs.arm is None:
            problems.append(
                f"no state came on {ARM_STATE.key(s.arm)} within {s.wait:g} s: is the arm's driver "
                "running, and is this its name (--arm)?"
            )
        elif not -safety.future <= cycle.arm_age < safety.arm_age:
            problems.append(
                f"the state of arm {s.arm!r} is {cycle.arm_age:.3f} s old: has its driver stopped? "
                'If it runs on another machine, set [inputs] arm_clock = "remote"'
            )
        elif cycle.inputs.arm.echo is not None and not cycle.inputs.arm.echo.own:
            problems.append(
                f"arm {s.arm!r} has not granted its command within {s.wait:g} s: does its driver "
                f"serve {service_key(s.arm, 'claim', 'arm')}?"
            )
        return "; ".join(problems) or "features and arm come too seldom to start"


def _inputs_ready(cycle: Cycle, safety: SafetySettings) -> bool:
    """Whether both inputs are present, valid and fresh."""
    touch = cycle.inputs.touch
    return (
        touch is not None
        and touch.valid
        and cycle.inputs.arm is not None
        and all(i.code is not Check.FEATURES_SPARSE for i in cycle.decision.interventions)
        and (cycle.inputs.arm.echo is None or _has_obeyed(cycle.inputs.arm.echo))
        and -safety.future <= cycle.touch_age < safety.features_age
        and -safety.future <= cycle.arm_age < safety.arm_age
    )


def _has_obeyed(echo: Echo) -> bool:
    """Whether the arm has obeyed one of our commands."""
    return echo.own and echo.sequence > 0


def _texts(values: dict[str, float]) -> dict[str, str]:
    return {key: f"{value:.6f}" for key, value in values.items()}
