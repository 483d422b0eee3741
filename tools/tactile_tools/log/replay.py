"""``tactile log replay``: publish a log on the bus again, under keys of its own."""

from __future__ import annotations

import argparse
import math
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import TYPE_CHECKING, Any

from tactile_core.bus.topics import find_topic
from tactile_core.cli import progress
from tactile_core.options import BusTable, bus_config
from tactile_core.types import NS_PER_S
from tactile_tools.log.arguments import Selection, select
from tactile_tools.log.stream import Reading, Record, Stream, read_merged
from tactile_tools.log.terminal import REFUSED, ToolError, complain, plain_console

if TYPE_CHECKING:
    import zenoh

    from tactile_core.bus.streams import Publisher

PREFIX = "replay"
"""First part of every key; nothing that controls an arm listens there."""

LATE_NS = NS_PER_S // 10
"""A replay that was later than this is reported at the end."""

SETTLE = 0.3
"""Time for links to others to come about before the first message, s."""


def run(options: argparse.Namespace) -> int:
    """Replay. Returns 0 at the end, or when a signal stopped it."""
    from tactile_core.bus.session import BusError, close_session, open_session

    chosen = select(options)
    stopping = threading.Event()
    try:
        session = open_session(bus_config(options, BusTable(), "tool"))
    except BusError as error:
        raise ToolError(str(error), REFUSED) from error
    player = Player(session, chosen, options.speed, stopping, bool(options.topic))
    try:
        with _stopped_by_signals(stopping):
            stopping.wait(SETTLE)
            rounds = 0
            while not stopping.is_set():
                with progress("replaying") as report:
                    player.play(report)
                rounds += 1
                if not options.loop or not player.sent:
                    break
    finally:
        player.close()
        close_session(session)
    _report(player, rounds, stopped=stopping.is_set())
    return 0


def _report(player: Player, rounds: int, *, stopped: bool) -> None:
    console = plain_console()
    console.print(
        f"{'stopped: ' if stopped else ''}{player.sent} messages under {PREFIX}/"
        + (f", {rounds} times through" if rounds > 1 else "")
    )
    if player.worst_ns > LATE_NS and not math.isinf(player.speed):
        console.print(f"up to {player.worst_ns / NS_PER_S:.1f} s late: this machine is too slow")
    for topic, why in player.refused.items():
        complain(f"{topic} left out: {why}")
    if remark := player.reading.remark():
        console.print(f"{remark}: replayed what could be read")


@contextmanager
def _stopped_by_signals(stopping: threading.Event) -> Iterator[None]:
    """Let Ctrl-C and SIGTERM end the replay in order; a second one ends it at once."""

    def stop(number: int, _: FrameType | None) -> None:
        stopping.set()
        signal.signal(number, signal.SIG_DFL)

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {n: signal.signal(n, stop) for n in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


class Player:
    """Publishes messages when they are due. ``worst_ns``: greatest delay of a message."""

    def __init__(
        self,
        session: zenoh.Session,
        chosen: Selection,
        speed: float,
        stopping: threading.Event,
        named: bool,
    ) -> None:
        self.sent = 0
        self.speed = speed
        self.worst_ns = 0
        self.refused: dict[str, str] = {}
        self.reading = Reading()
        self._session = session
        self._chosen = chosen
        self._stopping = stopping
        self._named = named
        self._publishers: dict[str, Publisher] = {}
        self._streams: dict[Stream, Publisher | None] = {}

    def play(self, report: Any) -> None:
        """Play the log once."""
        self.reading = Reading()
        chosen = self._chosen
        first: int | None = None
        begun = time.monotonic_ns()
        for _, item in read_merged(chosen.logs, self.reading, report, chosen.wanted, chosen.window):
            if not isinstance(item, Record):
                continue
            publisher = self._publisher(item.stream)
            if publisher is None:
                continue
            if first is None:
                first = item.log_ns
            if not math.isinf(self.speed):
                due = begun + round((item.log_ns - first) / self.speed)
                wait = due - time.monotonic_ns()
                self.worst_ns = max(self.worst_ns, -wait)
                if wait > 0:
                    self._stopping.wait(wait / NS_PER_S)
            if self._stopping.is_set():
                return
            try:
                publisher.put(item.data, item.publish_ns)
                self.sent += 1
            except ValueError as error:
                self.refused[item.stream.topic] = str(error)

    def close(self) -> None:
        """Close the publishers."""
        for publisher in self._publishers.values():
            publisher.close()

    def _publisher(self, stream: Stream) -> Publisher | None:
        if stream in self._streams:
            return self._streams[stream]
        self._streams[stream] = None
        found = find_topic(stream.topic)
        if found is not None and not found[0].published and not self._named:
            return None
        import zenoh

        from tactile_core.bus.streams import Publisher

        key = f"{PREFIX}/{stream.topic.strip('/')}"
        publisher = self._publishers.get(key)
        if publisher is None:
            try:
                if any(c in key for c in "*$?#"):
                    raise ValueError(f"{key} is not a key")
                publisher = Publisher(self._session, key, stream.msgtype or "unknown")
            except (zenoh.ZError, ValueError) as error:
                self.refused[stream.topic] = str(error).partition(" at /")[0]
                return None
            self._publishers[key] = publisher
        self._streams[stream] = publisher
        return publisher
