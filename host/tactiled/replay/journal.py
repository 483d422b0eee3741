"""What a port's pipeline acted on beside the bytes, into the log.

The links are pure: the same chunks, and the same few instants at which they did something of their
own accord, make the same features. `rerun` drives them by this and by the raw chunks.
"""

from __future__ import annotations

from tactile_bus.instant import NS_PER_S, Instant
from tactile_bus.messages import MSG, header
from tactile_bus.topics import PORT
from tactiled.outlet import Sink

OPENED, LOST, TICK, SKIPPED, WORKED, ENDED = "opened", "lost", "tick", "skipped", "worked", "ended"
TARE, SET_RATE, RECALIBRATE = "tare", "set_rate", "recalibrate"
"""Kinds of a ``PortEvent``."""

PROGRESS_NS = NS_PER_S // 4
"""At least this often it says how far the chunks have been worked off: whoever reads the log holds
chunks back until then."""


class Journal:
    """Of one port; used by the pipeline's thread alone. ``name``: that of its raw chunks."""

    def __init__(self, outlet: Sink, name: str, port: str) -> None:
        self._outlet = outlet
        self._name = name
        self._port = port
        self._after = Instant(0)
        self._said: Instant | None = None

    def worked(self, received: Instant) -> None:
        """The chunk that came at ``received`` has been worked off."""
        self._after = received

    def note(
        self,
        kind: str,
        now: Instant,
        *,
        node: int = 0,
        until: Instant | None = None,
        value: float = 0.0,
        text: str = "",
    ) -> None:
        """Something of ``kind`` was acted on at ``now``; see ``PortEvent.msg``."""
        self._said = self._after
        wall_ns = self._outlet.wall.wall_ns(now)
        message = MSG.PortEvent(
            header=header(wall_ns, self._port),
            now_ns=now,
            after_ns=self._after,
            kind=kind,
            node=node,
            until_ns=until or 0,
            value=value,
            text=text,
        )
        self._outlet.send(PORT, self._name, message, wall_ns)

    def progress(self, now: Instant) -> None:
        """Say how far the chunks have been worked off, where that was not said for a while."""
        if self._after and (self._said is None or self._after - self._said >= PROGRESS_NS):
            self.note(WORKED, now)
