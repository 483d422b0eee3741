"""Publish reachd's state and events, and write everything about a trial into the log.

This has a thread of its own, so that the control loop only puts values into a queue.
"""

from __future__ import annotations

import json
import logging
import math
import queue
import threading
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import zenoh
from rich.console import Console
from rich.table import Table

from reachd.control import Cycle
from reachd.interfaces import Goal, Twist
from reachd.trial import Outcome, State
from tactile_core.bus.commanding import FRAME
from tactile_core.bus.messages import MSG, codec, header
from tactile_core.bus.streams import BusSample, Tap, declare_publisher
from tactile_core.bus.topics import (
    ARM_STATE,
    COMMAND,
    NAME,
    REACH_EVENT,
    REACH_STATE,
    TF,
    WORLD,
    Topic,
    find_topic,
    service_key,
)
from tactile_core.config import printable
from tactile_core.log.recorder import Recorder
from tactile_core.throttle import Throttle
from tactile_core.types import Instant, WallClock, monotonic_now

# Logs everything on the bus that concerns a trial, as received.


MAX_NAMES = 16
"""Most names of streams that are logged, for board, arm, world and some to spare, so that a
publisher that invents names cannot fill the log with channels."""

ANSWER = 5.0
"""s for the board's answer."""


class TopicLogger:
    """Logs all streams of ``board``, the state of ``arm``, frames, and the objects of every world.

    ``refused``: count of samples with topics or names that are not logged.
    """

    def __init__(
        self, session: zenoh.Session, recorder: Recorder, wall: WallClock, board: str, arm: str
    ) -> None:
        self.refused = 0
        self._session = session
        self._geometry = service_key(board, "geometry")
        self._asked = False
        self._recorder = recorder
        self._wall = wall
        self._names: set[str] = set()
        keys = (
            f"tactile/{board}/*",
            ARM_STATE.key(arm),
            TF.template,
            WORLD.template.format(name="*"),
        )
        self._taps = [Tap(session, key, self._take) for key in keys]

    def ask_geometry(self) -> None:
        """Ask the board, once, to publish its geometry again: the log may have begun after it did.

        Call this when features come, which shows that the board answers. Does not wait.
        """
        if not self._asked:
            self._asked = True
            self._session.get(self._geometry, lambda _: None, timeout=ANSWER)

    def close(self) -> None:
        """Stop listening."""
        for tap in self._taps:
            tap.close()

    def _take(self, sample: BusSample) -> None:
        found = find_topic(sample.key)
        if found is None or not self._known(found[1]):
            self.refused += 1
            return
        topic, name = found
        now_ns = self._wall.wall_ns(monotonic_now())
        stamp_ns = now_ns if sample.wall_ns is None else sample.wall_ns
        self._recorder.write(topic, name, sample.data, now_ns, stamp_ns)

    def _known(self, name: str) -> bool:
        if name in self._names:
            return True
        if len(self._names) >= MAX_NAMES or not NAME.fullmatch(name):
            return False
        self._names.add(name)
        return True


# The outcome of a reach, for people and for programs.


DIRECTIONS = ("ccw", "cw")


def as_json(outcome: Outcome, goal: Goal, about: dict[str, Any]) -> str:
    """One JSON object of ``about`` (strategy, set, seed), goal and outcome, in m, s and N."""
    values = about | {
        "goal": {"x": goal.x, "y": goal.y, "radius": goal.radius, "time_limit": goal.time_limit},
        "success": outcome.success,
        "reason": str(outcome.reason),
        "text": outcome.text,
        "distance": _finite(outcome.distance),
        "closest": _finite(outcome.closest),
        "time": outcome.time,
        "peak_force": outcome.peak_force,
        "peak_load": outcome.peak_load,
        "excavations": [
            {"direction": e.direction, "trigger": e.trigger, "at": e.at}
            for e in outcome.excavations
        ],
        "interventions": outcome.interventions,
    }
    return json.dumps(values)


def excavations(outcome: Outcome) -> str:
    """Text of excavations by direction and trigger."""
    count = len(outcome.excavations)
    if not count:
        return "none"
    directions = [f"{outcome.count(direction=d)} {d}" for d in DIRECTIONS]
    names = dict.fromkeys(e.trigger for e in outcome.excavations)
    triggers = [f"{outcome.count(trigger=t)} by {t}" for t in names]
    return f"{count} ({', '.join(directions)}; {', '.join(triggers)})"


def interventions(outcome: Outcome) -> str:
    """Text of interventions by code, most frequent first."""
    ordered = sorted(outcome.interventions.items(), key=lambda item: -item[1])
    return ", ".join(f"{code} {n}" for code, n in ordered) or "none"


def last_line(outcome: Outcome) -> str:
    """Summary of an outcome in one line."""
    word = "REACHED" if outcome.success else f"NOT REACHED ({outcome.reason})"
    return (
        f"{word}: {_mm(outcome.distance)} from the target, {outcome.time:.2f} s, peak force "
        f"{outcome.peak_force:.1f} N, excavations {excavations(outcome)}, interventions "
        f"{interventions(outcome)}"
    )


def show(console: Console, outcome: Outcome, goal: Goal, about: dict[str, Any]) -> None:
    """Print the table and the last line."""
    table = Table(show_header=False, box=None, padding=(0, 2), title_justify="left")
    table.add_row("strategy", f"{about['strategy']}, set {about['set']}, seed {about['seed']}")
    table.add_row("target", f"{goal.x:g}, {goal.y:g} m, radius {_mm(goal.radius)}")
    table.add_row("ended", outcome.text or str(outcome.reason))
    table.add_row("distance", f"{_mm(outcome.distance)}, closest {_mm(outcome.closest)}")
    table.add_row("time", f"{outcome.time:.2f} s of {goal.time_limit:g}")
    table.add_row(
        "peak force", f"{outcome.peak_force:.1f} N at a taxel, {outcome.peak_load:.1f} N at the arm"
    )
    if about.get("note"):
        table.add_row("", about["note"])
    table.add_row("excavations", excavations(outcome))
    table.add_row("interventions", interventions(outcome))
    console.print(table, highlight=False, markup=False)
    console.print(last_line(outcome), highlight=False, markup=False, soft_wrap=True)


def _mm(metres: float) -> str:
    return f"{metres * 1e3:.1f} mm" if math.isfinite(metres) else "unknown distance"


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


log = logging.getLogger(__name__)

MAX_WAITING = 1000
"""Most cycles and events that wait for the thread, ten seconds' worth; the oldest are dropped."""

MAX_TEXT = 1000
"""Most characters of an event's text, part of which may come from a request."""

NO_TWIST = Twist(math.nan, math.nan, math.nan)
"""Published as wanted when the strategy gave no twist."""


@dataclass(frozen=True, slots=True)
class Event:
    """A single event; see ``ReachEvent.msg``."""

    at: Instant
    kind: str
    code: str
    text: str


class Reporter:
    """Publishes and logs the state of the reach ``name``. ``recorder`` None: nothing is logged.

    ``dropped``: cycles and events that found the queue full.
    """

    def __init__(
        self,
        session: zenoh.Session,
        recorder: Recorder | None,
        wall: WallClock,
        name: str,
        arm: str,
        strategy: str,
        failed: Callable[[BaseException], None],
    ) -> None:
        self.dropped = 0
        self.unsent = 0
        """Messages that could not be encoded or that the bus did not take."""
        self._ended = False
        self._publishing = threading.Lock()
        self._complaints = Throttle(rate=0.1, burst=3)
        self._recorder = recorder
        self._wall = wall
        self._name = name
        self._arm = arm
        self._strategy = strategy
        self._failed = failed
        self._codec = codec()
        self._sequence = 0
        self._state: State | None = None
        self._outcome: Outcome | None = None
        self._publishers = {
            topic.template: declare_publisher(session, topic, name)
            for topic in (REACH_STATE, REACH_EVENT)
        }
        self._queue: queue.SimpleQueue[tuple[int, Cycle, bytes] | Event | None] = (
            queue.SimpleQueue()
        )
        self._thread = threading.Thread(target=self._run, name="reporter", daemon=True)
        self._thread.start()

    def cycle(self, cycle: Cycle, sent: bytes) -> None:
        """Report a cycle and the command sent in it, which may be empty.

        Only the control loop calls this. Never blocks.
        """
        self._sequence = (self._sequence + 1) & 0xFFFFFFFF
        self._put((self._sequence, cycle, sent))

    def event(self, kind: str, code: str, text: str, at: Instant | None = None) -> None:
        """Report an event, from any thread. Never blocks."""
        self._put(Event(monotonic_now() if at is None else at, kind, code, text))

    def close(self, timeout: float = 0.5) -> bool:
        """Report what is waiting and end; False when that takes longer than ``timeout`` s.

        In either case nothing is published afterwards.
        """
        self._queue.put(None)
        self._thread.join(timeout)
        with self._publishing:
            self._ended = True
        if self._thread.is_alive():
            return False
        for publisher in self._publishers.values():
            with suppress(zenoh.ZError):  # the session has closed by itself
                publisher.close()
        return True

    def _put(self, item: tuple[int, Cycle, bytes] | Event) -> None:
        if self._queue.qsize() >= MAX_WAITING:
            try:
                self._queue.get_nowait()
                self.dropped += 1
            except queue.Empty:  # the thread has just emptied it
                pass
        self._queue.put(item)

    # Everything below runs on the reporter's thread.

    def _run(self) -> None:
        try:
            while (item := self._queue.get()) is not None:
                try:
                    if isinstance(item, Event):
                        self._send_event(item)
                    else:
                        self._send_cycle(*item)
                except Exception as error:  # noqa: BLE001 - one report must not end the others
                    self._note_unsent(error)
        except BaseException as error:  # noqa: BLE001 - thread boundary: the daemon must end loudly
            self._failed(error)

    def _note_unsent(self, error: Exception) -> None:
        self.unsent += 1
        if self._complaints.allow(monotonic_now()):
            log.error("a report could not be sent, %d so far", self.unsent, exc_info=error)

    def _send_cycle(self, sequence: int, cycle: Cycle, sent: bytes) -> None:
        now, status = cycle.now, cycle.status
        wall_ns = self._wall.wall_ns(now)
        if sent:
            self._record(COMMAND, self._arm, sent, wall_ns)
        if status.state is not self._state:
            self._state = status.state
            self._send_event(Event(now, "state", status.state, status.text))
        for event in cycle.events:
            text = f"{event.direction} {event.trigger}"
            self._send_event(Event(event.at, event.family, event.kind, text))
        for onset in cycle.onsets:
            text = f"{onset.effect}: {onset.text}"
            self._send_event(Event(now, "intervention", onset.code, text))
        if status.outcome is not self._outcome:
            self._outcome = status.outcome
            if status.outcome is not None:
                outcome = status.outcome
                self._send_event(Event(now, "outcome", outcome.reason, outcome.text))
        self._send(REACH_STATE, self._state_message(sequence, cycle, wall_ns), wall_ns)

    def _state_message(self, sequence: int, cycle: Cycle, wall_ns: int) -> Any:
        status, decision, goal = cycle.status, cycle.decision, cycle.status.goal
        nowhere = goal is None
        return MSG.ReachState(
            header=header(wall_ns, FRAME),
            stamped_ns=cycle.now,
            sequence=sequence,
            state=str(status.state),
            activity=status.activity,
            strategy=self._strategy,
            goal=MSG.Point(
                math.nan if goal is None else goal.x, math.nan if goal is None else goal.y, 0.0
            ),
            goal_radius=math.nan if goal is None else goal.radius,
            distance=math.nan if nowhere else status.distance,
            elapsed=status.elapsed,
            wanted=_twist(NO_TWIST if cycle.wanted is None else cycle.wanted),
            commanded=_twist(decision.twist),
            armed=decision.held is None,
            held="" if decision.held is None else str(decision.held),
            interventions=[str(i.code) for i in decision.interventions],
            features_age=cycle.touch_age,
            arm_age=cycle.arm_age,
            lateness=cycle.lateness,
        )

    def _send_event(self, event: Event) -> None:
        wall_ns = self._wall.wall_ns(event.at)
        text = printable(event.text, MAX_TEXT)
        message = MSG.ReachEvent(header(wall_ns, FRAME), event.at, event.kind, event.code, text)
        self._send(REACH_EVENT, message, wall_ns)
        log.debug("%s %s %s", event.kind, event.code, event.text)

    def _send(self, topic: Topic, message: Any, wall_ns: int) -> None:
        data = self._codec.encode(topic, message)
        self._record(topic, self._name, data, wall_ns)
        with self._publishing:
            if not self._ended:
                self._publishers[topic.template].put(data, wall_ns)

    def _record(self, topic: Topic, name: str, data: bytes, wall_ns: int) -> None:
        if self._recorder is not None:
            now_ns = self._wall.wall_ns(monotonic_now())
            self._recorder.write(topic, name, data, now_ns, wall_ns)


def _twist(twist: Twist) -> Any:
    return MSG.Twist(MSG.Vector3(twist.vx, twist.vy, 0.0), MSG.Vector3(0.0, 0.0, twist.omega))
