"""What reachd says: state and events on the bus, and everything into the log.

A thread of its own does it, so that the control loop only ever drops a value into a queue.
"""

from __future__ import annotations

import logging
import math
import queue
import threading
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import zenoh

from reachd.cycle import Cycle
from reachd.outcome import Outcome
from reachd.seam import Twist
from reachd.supervisor import State
from tactile_bus.commanding import FRAME
from tactile_bus.instant import Instant, WallClock, monotonic_now
from tactile_bus.messages import MSG, codec, header
from tactile_bus.recorder import Recorder
from tactile_bus.streams import declare_publisher
from tactile_bus.throttle import Throttle
from tactile_bus.toml_text import printable
from tactile_bus.topics import COMMAND, REACH_EVENT, REACH_STATE, Topic

log = logging.getLogger(__name__)

MAX_WAITING = 1000
"""Cycles and events that may wait for the thread: ten seconds' worth; then the oldest go."""

MAX_TEXT = 1000
"""Characters of an event's text; some of it comes from whoever asks for a stop."""

NO_TWIST = Twist(math.nan, math.nan, math.nan)
"""Shown as wanted where the strategy gave none."""


@dataclass(frozen=True, slots=True)
class Event:
    """Something that happened once; see ``ReachEvent.msg``."""

    at: Instant
    kind: str
    code: str
    text: str


class Reporter:
    """Publishes and logs for the reach called ``name``. ``recorder`` None: nothing is logged."""

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
        """Messages that could not be encoded, or that the bus did not take."""
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
        """Report a cycle and the command that was sent in it, empty for none.

        Called by the control loop alone. Never blocks.
        """
        self._sequence = (self._sequence + 1) & 0xFFFFFFFF
        self._put((self._sequence, cycle, sent))

    def event(self, kind: str, code: str, text: str, at: Instant | None = None) -> None:
        """Report something that happened; from any thread. Never blocks."""
        self._put(Event(monotonic_now() if at is None else at, kind, code, text))

    def close(self, timeout: float = 0.5) -> bool:
        """Report what waits and end; False when that takes longer than ``timeout`` s.

        Either way nothing is published after it.
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
            except queue.Empty:  # the thread has just taken it
                pass
        self._queue.put(item)

    # What follows runs in the reporter's thread.

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
            self._send_event(Event(event.at, "excavation", event.kind, text))
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
