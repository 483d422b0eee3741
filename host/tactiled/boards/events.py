"""Events from the links to the daemon; frozen values."""

from __future__ import annotations

from dataclasses import dataclass

from sensor_proto.packets import Ack, Descriptor, Status
from tactile_core.types import Instant
from tactiled.blocks import SampleBlock

RESET_CAUSES = {0: "power-on", 1: "command", 2: "watchdog", 3: "brown-out"}
"""Meaning of a status message's ``reset_cause`` (PROTOCOL.md)."""


@dataclass(frozen=True, slots=True)
class Identity:
    """Identity of a board. ``serial_number``: empty when neither board nor port has one.

    ``shapes``: rows and columns of each array. ``max_rate``: Hz; None when not reported.
    ``descriptor``: None for boards that have none. Such boards send all their taxels as one array;
    ``arrays``: taxels of each array, if the user gave them. ``layout``: how such a board writes its
    samples; empty for the usual floats.
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
        """Make the identity from a board's descriptor."""
        return cls(
            serial_number=descriptor.serial_number,
            model=descriptor.model,
            firmware=descriptor.firmware,
            shapes=tuple((a.rows, a.columns) for a in descriptor.arrays),
            max_rate=descriptor.max_rate_mhz / 1000,
            descriptor=descriptor,
        )

    def __str__(self) -> str:
        """Name of the board in messages."""
        number = f" {self.serial_number}" if self.serial_number else " without a serial number"
        return f"{self.model} board{number}"


@dataclass(frozen=True, slots=True)
class Refusal:
    """Why a board is not used, and the remedy."""

    problem: str
    remedy: str


@dataclass(frozen=True, slots=True)
class Identified:
    """The board answered and was admitted. ``rebooted``: its clock and sequence have restarted."""

    identity: Identity
    rebooted: bool


@dataclass(frozen=True, slots=True)
class Streaming:
    """The board has started to stream. ``rate``: as set, Hz; None: the board's own."""

    rate: float | None


@dataclass(frozen=True, slots=True)
class Refused:
    """The board was not admitted."""

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
    """The board has restarted, or its sequence shows that it must have."""

    reason: str


@dataclass(frozen=True, slots=True)
class ClockJudged:
    """The board's clock is unusable because of ``trouble``; empty: it is usable again."""

    trouble: str


@dataclass(frozen=True, slots=True)
class BoardLog:
    """A text of the firmware; levels as in `sensor_proto.packets.Log`."""

    level: int
    captured: Instant
    text: str


@dataclass(frozen=True, slots=True)
class Reported:
    """The board sent its status."""

    status: Status


@dataclass(frozen=True, slots=True)
class Answered:
    """A command was answered, or given up if ``ack`` is None."""

    request: int
    ack: Ack | None


@dataclass(frozen=True, slots=True)
class Diagnosed:
    """No board was found on the port, and why that seems to be."""

    problem: str
    remedy: str


@dataclass(frozen=True, slots=True)
class Waiting:
    """The diagnosis of the port takes longer than usual, and why."""

    text: str


@dataclass(frozen=True, slots=True)
class Found:
    """Boards were found on a bus. ``late``: after the others had been gathered."""

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
