"""The journal in the log: what a port's pipeline acted on besides the bytes.

Links are pure: the same chunks, and the same instants at which they acted on their own, give the
same features. `rerun` drives them with the journal and the raw chunks.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import msgspec

from sensor_proto.framing import SerialDecoder, encode_serial
from sensor_proto.packets import Descriptor
from tactile_core.bus.messages import MSG, header
from tactile_core.bus.topics import PORT
from tactile_core.types import NS_PER_S, Instant
from tactiled.boards.events import Identity
from tactiled.publisher import Sink
from tactiled.sensing.rest import RecordedRest

# State of each board, kept in every file of a log so that a later file can be reprocessed alone.


STATE_PREFIX = "state:"
"""Prefix of the names of these tables; the name of the board follows."""


@dataclass(frozen=True, slots=True)
class RecordedState:
    """State of a board. ``descriptor``: None for boards that have none; ``rest``: None before the
    first tare; ``node``: on its CAN bus, 0 on a serial line."""

    name: str
    node: int = 0
    serial_number: str = ""
    descriptor: Descriptor | None = None
    rest: RecordedRest | None = None


def describe_state(node: int, identity: Identity, rest: RecordedRest | None) -> dict[str, str]:
    """Metadata table of a board: its descriptor as sent, in hex, and its rest field in JSON."""
    said = identity.descriptor
    return {
        "node": str(node),
        "serial_number": identity.serial_number,
        "descriptor": "" if said is None else encode_serial(said).hex(),
        "rest": "" if rest is None else msgspec.json.encode(rest).decode(),
    }


def recorded_state(name: str, values: Mapping[str, str]) -> RecordedState | None:
    """The state of board ``name`` in a log; None when its table is damaged."""
    try:
        descriptor: Descriptor | None = None
        if values["descriptor"]:
            found = SerialDecoder().feed(bytes.fromhex(values["descriptor"]))
            said = [r.message for r in found if isinstance(r.message, Descriptor)]
            if not said:
                return None
            descriptor = said[0]
        rest = msgspec.json.decode(values["rest"], type=RecordedRest) if values["rest"] else None
        return RecordedState(name, int(values["node"]), values["serial_number"], descriptor, rest)
    except (KeyError, ValueError):
        return None


OPENED, LOST, TICK, SKIPPED, WORKED, ENDED = "opened", "lost", "tick", "skipped", "worked", "ended"
TARE, SET_RATE, RECALIBRATE = "tare", "set_rate", "recalibrate"
"""Kinds of a ``PortEvent``."""

PROGRESS_NS = NS_PER_S // 4
"""Longest time between notes of how far the chunks have been processed: `rerun` holds chunks back
until then."""


class Journal:
    """Journal of one port; used only by the pipeline's thread. ``name``: of its raw chunks."""

    def __init__(self, sink: Sink, name: str, port: str) -> None:
        self._sink = sink
        self._name = name
        self._port = port
        self._after = Instant(0)
        self._said: Instant | None = None

    def processed(self, received: Instant) -> None:
        """Note that the chunk received then has been processed."""
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
        """Write that ``kind`` was acted on at ``now``; see ``PortEvent.msg``."""
        self._said = self._after
        wall_ns = self._sink.wall.wall_ns(now)
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
        self._sink.send(PORT, self._name, message, wall_ns)

    def progress(self, now: Instant) -> None:
        """Write how far the chunks have been processed, if the last note is a while ago."""
        if self._after and (self._said is None or self._after - self._said >= PROGRESS_NS):
            self.note(WORKED, now)
