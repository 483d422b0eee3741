"""What a port's pipeline acted on beside the bytes, into the log.

The links are pure: the same chunks, and the same few instants at which they did something of their
own accord, make the same features. `rerun` drives them by this and by the raw chunks.
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

# What every file of a log says of each board, so that a later file can be run by itself.


STATE_PREFIX = "state:"
"""Names of these tables begin so; the name of the board follows."""


@dataclass(frozen=True, slots=True)
class RecordedState:
    """A board as it stood. ``descriptor``: None for boards that have none; ``rest``: None before
    the first tare; ``node``: on its bus, 0 on a serial line."""

    name: str
    node: int = 0
    serial_number: str = ""
    descriptor: Descriptor | None = None
    rest: RecordedRest | None = None


def describe_state(node: int, identity: Identity, rest: RecordedRest | None) -> dict[str, str]:
    """The table of a board: its own words as it sends them, and its rest field in JSON."""
    said = identity.descriptor
    return {
        "node": str(node),
        "serial_number": identity.serial_number,
        "descriptor": "" if said is None else encode_serial(said).hex(),
        "rest": "" if rest is None else msgspec.json.encode(rest).decode(),
    }


def recorded_state(name: str, values: Mapping[str, str]) -> RecordedState | None:
    """The state of board ``name`` in a log; None when its table is spoilt."""
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
"""At least this often it says how far the chunks have been worked off: whoever reads the log holds
chunks back until then."""


class Journal:
    """Of one port; used by the pipeline's thread alone. ``name``: that of its raw chunks."""

    def __init__(self, sink: Sink, name: str, port: str) -> None:
        self._sink = sink
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
        """Say how far the chunks have been worked off, where that was not said for a while."""
        if self._after and (self._said is None or self._after - self._said >= PROGRESS_NS):
            self.note(WORKED, now)
