"""Every message of the protocol as a frozen dataclass; layouts are in ``PROTOCOL.md``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import IntEnum, IntFlag

import numpy as np
from numpy.typing import NDArray

PROTOCOL_MAJOR = 1
PROTOCOL_MINOR = 0


class MessageType(IntEnum):
    """One byte on the wire; the high bit is set on everything the host sends."""

    DESCRIPTOR = 0x01
    SAMPLES = 0x02
    STATUS = 0x03
    CLOCK_REPLY = 0x04
    LOG = 0x05
    ACK = 0x06
    IDENTIFY = 0x81
    START = 0x82
    STOP = 0x83
    SET_RATE = 0x84
    SET_GAIN = 0x85
    CLOCK_POLL = 0x86
    REBOOT = 0x87


class ChipType(IntEnum):
    """Magnetometer behind each taxel of an array."""

    UNKNOWN = 0
    MLX90393 = 1


class TaxelStatus(IntFlag):
    """Per-taxel status bits of a samples message."""

    OK = 0
    SATURATED = 1  # a count at either end of int16, or the chip said so
    STALE = 2  # the chip had no new conversion: the previous value is repeated
    READ_FAILED = 4  # the chip did not answer; the counts mean nothing


class AckResult(IntEnum):
    """Answer of a board to a command."""

    OK = 0
    UNKNOWN_COMMAND = 1
    BAD_ARGUMENT = 2
    BUSY = 3
    FAILED = 4


@dataclass(frozen=True, slots=True)
class ArrayDescriptor:
    """One array of taxels on a board. Scales in nT per LSB, pitch in µm."""

    array: int
    name: str  # ASCII, at most 15 bytes
    chip: ChipType
    rows: int
    columns: int
    pitch_um: int
    lsb_xy_nt: int
    lsb_z_nt: int

    @property
    def taxels(self) -> int:
        """Number of taxels, numbered row by row."""
        return self.rows * self.columns


@dataclass(frozen=True, slots=True)
class Descriptor:
    """What a board says of itself in answer to `Identify`."""

    major: int
    minor: int
    unique_id: bytes  # 8 bytes; written as hex it is the serial number
    model: str  # ASCII, at most 15 bytes
    firmware: str  # ASCII, at most 15 bytes
    tick_hz: int
    max_rate_mhz: int  # highest sample rate, millihertz
    arrays: tuple[ArrayDescriptor, ...]

    @property
    def serial_number(self) -> str:
        """Unique id as 16 lower-case hex digits."""
        return self.unique_id.hex()


@dataclass(frozen=True, slots=True, eq=False)
class Samples:
    """One conversion of every taxel of one array.

    ``field``: (n, 3) int16 counts x, y, z in each chip's own axes. ``ticks``: board clock,
    32 bits, at the start of the conversion. ``sequence``: 32 bits, one step a sampling cycle and
    the same for all arrays sampled in that cycle. ``temperature_cc``: hundredths of a °C.
    ``status``: (n,) uint8 of `TaxelStatus`.
    """

    array: int
    sequence: int
    ticks: int
    temperature_cc: int
    field: NDArray[np.int16]
    status: NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class Status:
    """Health of a board, sent once a second. Counters are 32 bits and never reset but by reboot."""

    uptime_ms: int
    cycles: int  # sampling cycles completed
    overruns: int  # cycles whose samples the board had to drop before sending
    rx_errors: int  # frames from the host it rejected
    chip_errors: int  # failed chip reads
    rate_mhz: int  # present sample rate, millihertz; 0 when stopped
    reset_cause: int  # 0 power-on, 1 command, 2 watchdog, 3 brown-out


@dataclass(frozen=True, slots=True)
class ClockReply:
    """Board clock at the receipt of a `ClockPoll` and at the sending of this reply."""

    token: int
    ticks_received: int
    ticks_sent: int


@dataclass(frozen=True, slots=True)
class Log:
    """A line of text from the firmware. ``level``: 10 debug, 20 info, 30 warning, 40 error."""

    level: int
    ticks: int
    text: str


@dataclass(frozen=True, slots=True)
class Ack:
    """Answer to the command ``command`` that carried ``request``."""

    command: int  # a MessageType value; unknown ones are echoed as they came
    request: int
    result: AckResult


@dataclass(frozen=True, slots=True)
class Identify:
    """Ask for the `Descriptor`. Carries the host's protocol version."""

    request: int
    major: int = PROTOCOL_MAJOR
    minor: int = PROTOCOL_MINOR


@dataclass(frozen=True, slots=True)
class Start:
    """Begin streaming samples."""

    request: int


@dataclass(frozen=True, slots=True)
class Stop:
    """Cease streaming samples."""

    request: int


@dataclass(frozen=True, slots=True)
class SetRate:
    """Sample rate in millihertz, for every array."""

    request: int
    rate_mhz: int


@dataclass(frozen=True, slots=True)
class SetGain:
    """Gain and filter of one array (255: all), in the chip's own codes (MLX90393 tables)."""

    request: int
    array: int
    gain: int
    resolution: int
    oversampling: int
    filter: int


@dataclass(frozen=True, slots=True)
class ClockPoll:
    """Ask for the board clock; the token comes back in the reply."""

    token: int


@dataclass(frozen=True, slots=True)
class Reboot:
    """Restart the firmware."""

    request: int


BoardMessage = Descriptor | Samples | Status | ClockReply | Log | Ack
HostMessage = Identify | Start | Stop | SetRate | SetGain | ClockPoll | Reboot
Message = BoardMessage | HostMessage


@dataclass(frozen=True, slots=True, eq=False)
class FloatSamples:
    """One frame of a board that sends floats (AnySkin, ReSkin, eFlesh): no sequence, no clock.

    ``field_ut``: (n, 3) float32 µT in each chip's own axes; ``temperature_c``: (n,) float32 °C;
    ``status``: (n,) uint8 of `TaxelStatus`, with READ_FAILED where the temperature is impossible.
    """

    field_ut: NDArray[np.float32]
    temperature_c: NDArray[np.float32]
    status: NDArray[np.uint8]


@dataclass(frozen=True, slots=True, eq=False)
class FloatBurst:
    """k consecutive frames of a board that sends floats, as arrays: for whoever reads many at once.

    ``values``: (k, n, 4) float32 t °C, x, y, z µT. ``status``: (k, n) uint8 of `TaxelStatus`.
    ``trailing``: per frame, as in `Received`.
    """

    values: NDArray[np.float32]
    status: NDArray[np.uint8]
    trailing: Sequence[int]


@dataclass(frozen=True, slots=True, eq=False)
class Received:
    """A message and where it came from.

    ``board``: 7-bit node id (0 on a serial line). ``trailing``: bytes of the same chunk that came
    after the end of this frame, so that the receiver can take their time on the wire off its
    stamp; 0 on CAN.
    """

    message: Message | FloatSamples
    board: int = 0
    trailing: int = field(default=0)
