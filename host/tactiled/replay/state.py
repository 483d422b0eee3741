"""What every file of a log says of each board, so that a later file can be run by itself."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import msgspec

from sensor_proto.framing import SerialDecoder, encode_serial
from sensor_proto.packets import Descriptor
from tactiled.links.events import Identity
from tactiled.sensing.rest_state import RecordedRest

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
