"""What the links tell the daemon: a few frozen events, each one thing that happened."""

from __future__ import annotations

from dataclasses import dataclass

from sensor_proto.packets import Ack, Descriptor, Status
from tactile_core.types import Instant
from tactiled.blocks import SampleBlock

RESET_CAUSES = {0: "power-on", 1: "command", 2: "watchdog", 3: "brown-out"}
"""What a status message's ``reset_cause`` means (PROTOCOL.md)."""


@dataclass(frozen=True, slots=True)
class Identity:
    """What is known of a board. ``serial_number`` is empty where neither board nor port has one.

    ``shapes``: rows and columns of each array. ``max_rate``: Hz, None where the board does not
    say. ``descriptor``: the board's own words, None where it has none. Boards without one send all
    their taxels as one array; ``arrays`` says how many each of them has, where the user said it.
    ``layout``: how such a board writes its samples, empty for the usual floats.
    """

    serial_number: str
    model: str
    firmware: str
    shapes: tuple[tuple[int, int], ...]
    max_rate: float | None
    descriptor: Descriptor | None = None
    arrays: tuple[int, ...] | None = None
    layout: str = ""

    @property
    def taxels(self) -> int:
        """Number of taxels of the whole board."""
        return sum(rows * columns for rows, columns in self.shapes)

    @classmethod
    def of(cls, descriptor: Descriptor) -> Identity:
        """Identity of a board that described itself."""
        return cls(
            serial_number=descriptor.serial_number,
            model=descriptor.model,
            firmware=descriptor.firmware,
            shapes=tuple((a.rows, a.columns) for a in descriptor.arrays),
            max_rate=descriptor.max_rate_mhz / 1000,
            descriptor=descriptor,
        )

    def __str__(self) -> str:
        """As messages name it."""
        number = f" {self.serial_number}" if self.serial_number else " without a serial number"
        return f"{self.model} board{number}"


@dataclass(frozen=True, slots=True)
class Refusal:
    """Why a board is not used, and what to do about it."""

    problem: str
    remedy: str


@dataclass(frozen=True, slots=True)
class Identified:
    """The board answered and was admitted. ``rebooted``: its clock and sequence start anew."""

    identity: Identity
    rebooted: bool


@dataclass(frozen=True, slots=True)
class Streaming:
    """The board took the order to stream; ``rate`` in Hz as it was set, None: the board's own."""

    rate: float | None


@dataclass(frozen=True, slots=True)
class Refused:
    """The board is not used."""

    refusal: Refusal


@dataclass(frozen=True, slots=True, eq=False)
class Sampled:
    """One array's samples in physical units, on host time."""

    block: SampleBlock


@dataclass(frozen=True, slots=True)
class FellSilent:
    """No samples for ``seconds``."""

    seconds: float


@dataclass(frozen=True, slots=True)
class Resumed:
    """Samples came again after ``seconds`` of silence."""

    seconds: float


@dataclass(frozen=True, slots=True)
class Reset:
    """The board restarted by itself, or its sequence shows that it must have."""

    reason: str


@dataclass(frozen=True, slots=True)
class ClockJudged:
    """The board's clock cannot be used, for the reason ``trouble``; empty: it can again."""

    trouble: str


@dataclass(frozen=True, slots=True)
class BoardLog:
    """A line of text from the firmware, levels as in `sensor_proto.packets.Log`."""

    level: int
    captured: Instant
    text: str


@dataclass(frozen=True, slots=True)
class Reported:
    """The board's own account of its health."""

    status: Status


@dataclass(frozen=True, slots=True)
class Answered:
    """A command was answered, or given up (``ack`` None)."""

    request: int
    ack: Ack | None


@dataclass(frozen=True, slots=True)
class Diagnosed:
    """The port carries something, or nothing, but no board: what seems to be wrong."""

    problem: str
    remedy: str


@dataclass(frozen=True, slots=True)
class Waiting:
    """What is on the port cannot be told yet, and why that takes longer than usual."""

    text: str


@dataclass(frozen=True, slots=True)
class Found:
    """Boards on a bus, by node. ``late``: they came after the others had been gathered."""

    nodes: tuple[int, ...]
    late: bool


Event = (
    Identified
    | Streaming
    | Refused
    | Sampled
    | FellSilent
    | Resumed
    | Reset
    | ClockJudged
    | BoardLog
    | Reported
    | Answered
    | Diagnosed
    | Waiting
    | Found
)
