"""Messages of the protocol, and their payloads and packets, exactly as in ``PROTOCOL.md``.

Everything is little-endian and packed. Encoding raises ValueError or TypeError on misuse; decoding
never raises: it returns a `Reject` for invalid input.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from enum import IntEnum, IntFlag, StrEnum
from typing import Any, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from sensor_proto.crc import RESIDUE, crc32c, crc32c_each

# Messages as frozen dataclasses; ``PROTOCOL.md`` has their layouts.


PROTOCOL_MAJOR = 1
PROTOCOL_MINOR = 0


class MessageType(IntEnum):
    """Type byte of a message; the high bit is set on everything the host sends."""

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
    """Magnetometer type of the taxels of an array."""

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
    """Description of a board, in answer to `Identify`."""

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
    """Health of a board, sent once a second. Counters have 32 bits; only a reboot resets them."""

    uptime_ms: int
    cycles: int  # sampling cycles completed
    overruns: int  # cycles whose samples the board had to drop before sending
    rx_errors: int  # rejected frames from the host
    chip_errors: int  # failed chip reads
    rate_mhz: int  # present sample rate, millihertz; 0 when stopped
    reset_cause: int  # 0 power-on, 1 command, 2 watchdog, 3 brown-out


@dataclass(frozen=True, slots=True)
class ClockReply:
    """Board clock when it received a `ClockPoll` and when it sent this reply."""

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

    command: int  # a MessageType value; unknown ones are echoed
    request: int
    result: AckResult


@dataclass(frozen=True, slots=True)
class Identify:
    """Request the `Descriptor`. Carries the host's protocol version."""

    request: int
    major: int = PROTOCOL_MAJOR
    minor: int = PROTOCOL_MINOR


@dataclass(frozen=True, slots=True)
class Start:
    """Start streaming samples."""

    request: int


@dataclass(frozen=True, slots=True)
class Stop:
    """Stop streaming samples."""

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
    """Request the board clock; the reply repeats the token."""

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
    """k consecutive frames of a board that sends floats, as arrays, for efficient bulk processing.

    ``values``: (k, n, 4) float32 t °C, x, y, z µT. ``status``: (k, n) uint8 of `TaxelStatus`.
    ``trailing``: per frame, as in `Received`.
    """

    values: NDArray[np.float32]
    status: NDArray[np.uint8]
    trailing: Sequence[int]


@dataclass(frozen=True, slots=True, eq=False)
class Received:
    """A message and its origin.

    ``board``: 7-bit node id (0 on a serial line). ``trailing``: bytes of the same chunk after the
    end of this frame, whose time on the wire the receiver subtracts from the chunk's time stamp; 0
    on CAN.
    """

    message: Message | FloatSamples
    board: int = 0
    trailing: int = field(default=0)


# Interface of all decoders, and the reasons for rejecting input.


Input = TypeVar("Input", contravariant=True)

ACCEPTED = "accepted"
"""Key of the number of accepted messages in every ``counters``."""


class Reject(StrEnum):
    """Why input was refused; the value is the key in ``counters``."""

    COBS = "cobs"  # the blocks of a serial frame do not end where the frame ends
    OVERSIZED = "oversized"  # longer than the longest frame or transfer; dropped to its end
    RUNT = "runt"  # too short for header and CRC
    LENGTH = "length"  # the length in the header does not match
    CRC = "crc"
    BOARD = "board"  # header and medium name different boards
    TYPE_MISMATCH = "type_mismatch"  # header and CAN identifier name different types
    UNKNOWN_TYPE = "unknown_type"  # a whole message of a newer peer, skipped
    SHORT_PAYLOAD = "short_payload"  # a known message with fewer bytes than its layout
    BAD_VALUE = "bad_value"  # a known message whose values make no sense
    EMPTY = "empty"  # surplus delimiters: an idle line, or a port that floods zeros
    FOREIGN = "foreign"  # a CAN frame of another protocol
    ERROR_FRAME = "error_frame"  # the CAN controller reports an error
    BAD_FRAME = "bad_frame"  # a CAN frame of impossible length
    NO_START = "no_start"  # CAN frame of a transfer whose start was missed
    INTERRUPTED = "interrupted"  # a CAN transfer started before the previous one ended
    OUT_OF_ORDER = "out_of_order"  # toggle, transfer id or kind of a CAN frame does not follow
    LOST_LOCK = "lost_lock"  # frames of an unframed stream no longer end where expected
    DISCARDED_BYTES = "discarded_bytes"  # bytes (not frames) that belong to no frame
    DUPLICATE = "duplicate"  # a CAN frame repeated directly; the second was ignored


class Decoder(Protocol[Input]):
    """Converts bytes or CAN frames to messages. Never raises on input; counts what it rejects."""

    def feed(self, data: Input, /) -> list[Received]:
        """Return the messages that ``data`` completed, in the order in which they ended."""
        ...

    @property
    def counters(self) -> dict[str, int]:
        """Snapshot: `ACCEPTED` and one count per reason for refusal."""
        ...

    def reset(self) -> None:
        """Forget unfinished input, after a reconnection; the counters continue."""
        ...


class Tally(dict[str, int]):
    """Counters of one decoder."""

    def __init__(self, reasons: Iterable[str]) -> None:
        super().__init__({ACCEPTED: 0, **{str(reason): 0 for reason in reasons}})

    def snapshot(self) -> dict[str, int]:
        """Plain copy, with plain string keys."""
        return dict(self)


MAX_PAYLOAD = 1024
"""Largest payload in bytes. The longest message, samples of 128 taxels, has 908; the rest is room
for newer minor versions."""

MAX_TAXELS = 128
"""Most taxels of one array."""

MAX_ARRAYS = 16
"""Most arrays of one board; their descriptor has 564 bytes."""

MAX_TEXT = 255
"""Most bytes of UTF-8 in a log line: its length is one byte."""

NAME_SIZE = 16
"""Size of a name on the wire in bytes: at most 15 of printable ASCII, then zeros."""

_DESCRIPTOR_FROZEN = struct.Struct("<BB8s16s")
_DESCRIPTOR = struct.Struct("<BB8s16s16sIIBB")
_ARRAY = struct.Struct("<BBBBIII16s")
_SAMPLES = struct.Struct("<BBhII")
_STATUS = struct.Struct("<QIIIIIB")
_CLOCK_REPLY = struct.Struct("<III")
_LOG = struct.Struct("<BBI")
_ACK = struct.Struct("<BBH")
_IDENTIFY = struct.Struct("<HBB")
_REQUEST = struct.Struct("<H")
_SET_RATE = struct.Struct("<HI")
_SET_GAIN = struct.Struct("<HBBBBB")
_CLOCK_POLL = struct.Struct("<I")

_Decode = Callable[[bytes, int, int], Message | Reject]

_COUNTS = np.dtype("<i2")
_BITS = np.dtype(np.uint8)
_NO_ID = bytes(8)
_CHIPS = {int(chip): chip for chip in ChipType}
_RESULTS = {int(result): result for result in AckResult}
_TYPES: dict[type, MessageType] = {
    Descriptor: MessageType.DESCRIPTOR,
    Samples: MessageType.SAMPLES,
    Status: MessageType.STATUS,
    ClockReply: MessageType.CLOCK_REPLY,
    Log: MessageType.LOG,
    Ack: MessageType.ACK,
    Identify: MessageType.IDENTIFY,
    Start: MessageType.START,
    Stop: MessageType.STOP,
    SetRate: MessageType.SET_RATE,
    SetGain: MessageType.SET_GAIN,
    ClockPoll: MessageType.CLOCK_POLL,
    Reboot: MessageType.REBOOT,
}


def message_type(message: Message) -> MessageType:
    """Type of ``message``. Raises TypeError for anything but a message of this protocol."""
    kind = _TYPES.get(type(message))
    if kind is None:
        raise TypeError(f"{type(message).__name__} is not a message of this protocol")
    return kind


def encode_payload(message: Message) -> bytes:
    """Encode the payload of ``message``. Raises ValueError if a field cannot hold its value."""
    message_type(message)
    try:
        return _ENCODERS[type(message)](message)
    except struct.error as error:
        raise ValueError(f"{type(message).__name__}: {error}") from error


def decode_payload(kind: int, packet: bytes, start: int, end: int) -> Message | Reject:
    """Decode the message of type ``kind`` whose payload is ``packet[start:end]``."""
    decoder = _DECODERS.get(kind)
    if decoder is None:
        return Reject.UNKNOWN_TYPE
    return decoder(packet, start, end)


def _name(label: str, text: str) -> bytes:
    """Encode a name. Raises ValueError unless it is at most 15 bytes of printable ASCII."""
    if len(text) >= NAME_SIZE or not (text.isascii() and text.isprintable()):
        raise ValueError(f"{label} {text!r}: at most {NAME_SIZE - 1} printable ASCII characters")
    return text.encode("ascii")


def _read_name(raw: bytes) -> str | None:
    """Decode a name; None unless it is printable ASCII padded with zeros."""
    name, _, padding = raw.partition(b"\0")
    if len(name) == NAME_SIZE or padding.strip(b"\0") or not name.isascii():
        return None
    text = name.decode("ascii")
    return text if text.isprintable() else None


# Descriptor


def _encode_descriptor(message: Descriptor) -> bytes:
    if len(message.unique_id) != len(_NO_ID):
        raise ValueError(f"unique_id: {len(message.unique_id)} bytes, not {len(_NO_ID)}")
    if len(message.arrays) > MAX_ARRAYS:
        raise ValueError(f"{len(message.arrays)} arrays; at most {MAX_ARRAYS}")
    head = _DESCRIPTOR.pack(
        message.major,
        message.minor,
        message.unique_id,
        _name("model", message.model),
        _name("firmware", message.firmware),
        message.tick_hz,
        message.max_rate_mhz,
        len(message.arrays),
        _ARRAY.size,
    )
    return head + b"".join(
        _ARRAY.pack(
            a.array,
            a.chip,
            a.rows,
            a.columns,
            a.pitch_um,
            a.lsb_xy_nt,
            a.lsb_z_nt,
            _name("array name", a.name),
        )
        for a in message.arrays
    )


def _decode_descriptor(packet: bytes, start: int, end: int) -> Descriptor | Reject:
    if end - start < _DESCRIPTOR_FROZEN.size:
        return Reject.SHORT_PAYLOAD
    major, minor, unique_id, raw_model = _DESCRIPTOR_FROZEN.unpack_from(packet, start)
    model = _read_name(raw_model)
    if model is None:
        return Reject.BAD_VALUE
    if major != PROTOCOL_MAJOR:
        # Only these fields are the same in every major version; they suffice to reject it by name.
        return Descriptor(major, minor, unique_id, model, "", 0, 0, ())
    if end - start < _DESCRIPTOR.size:
        return Reject.SHORT_PAYLOAD
    *_, raw_firmware, tick_hz, max_rate, count, stride = _DESCRIPTOR.unpack_from(packet, start)
    firmware = _read_name(raw_firmware)
    if firmware is None or not (tick_hz and max_rate and 1 <= count <= MAX_ARRAYS):
        return Reject.BAD_VALUE
    if stride < _ARRAY.size:
        return Reject.BAD_VALUE
    first = start + _DESCRIPTOR.size
    if end < first + count * stride:
        return Reject.SHORT_PAYLOAD
    arrays = []
    for at in range(first, first + count * stride, stride):
        array, chip, rows, columns, pitch, lsb_xy, lsb_z, raw = _ARRAY.unpack_from(packet, at)
        name = _read_name(raw)
        if name is None or not (1 <= rows * columns <= MAX_TAXELS and pitch and lsb_xy and lsb_z):
            return Reject.BAD_VALUE
        known = _CHIPS.get(chip, ChipType.UNKNOWN)
        arrays.append(ArrayDescriptor(array, name, known, rows, columns, pitch, lsb_xy, lsb_z))
    if len({a.array for a in arrays}) != count:
        return Reject.BAD_VALUE
    return Descriptor(major, minor, unique_id, model, firmware, tick_hz, max_rate, tuple(arrays))


# Samples


def _encode_samples(message: Samples) -> bytes:
    counts, status = message.field, message.status
    n = len(status)
    if not 1 <= n <= MAX_TAXELS or counts.shape != (n, 3) or status.shape != (n,):
        raise ValueError(
            f"field {counts.shape} and status {status.shape}: (n, 3) and (n,), n 1 to {MAX_TAXELS}"
        )
    if not np.can_cast(counts.dtype, _COUNTS) or not np.can_cast(status.dtype, _BITS):
        raise TypeError(f"field {counts.dtype} and status {status.dtype}: int16 and uint8")
    head = _SAMPLES.pack(message.array, n, message.temperature_cc, message.sequence, message.ticks)
    return head + counts.astype(_COUNTS).tobytes() + status.astype(_BITS).tobytes()


def _decode_samples(packet: bytes, start: int, end: int) -> Samples | Reject:
    body = start + 12
    if end < body:
        return Reject.SHORT_PAYLOAD
    array, n, temperature, sequence, ticks = _SAMPLES.unpack_from(packet, start)
    if not 1 <= n <= MAX_TAXELS:
        return Reject.BAD_VALUE
    bits = body + 6 * n
    if end < bits + n:
        return Reject.SHORT_PAYLOAD
    # Views of the packet; numpy makes them read-only as bytes are immutable.
    field = np.ndarray((n, 3), _COUNTS, packet, body)
    status = np.ndarray(n, _BITS, packet, bits)
    return Samples(array, sequence, ticks, temperature, field, status)


# The others


def _encode_status(message: Status) -> bytes:
    return _STATUS.pack(
        message.uptime_ms,
        message.cycles,
        message.overruns,
        message.rx_errors,
        message.chip_errors,
        message.rate_mhz,
        message.reset_cause,
    )


def _encode_log(message: Log) -> bytes:
    text = message.text.encode("utf-8")
    if len(text) > MAX_TEXT or not message.text.isprintable():
        raise ValueError(f"log text: at most {MAX_TEXT} bytes of UTF-8, no control characters")
    return _LOG.pack(message.level, len(text), message.ticks) + text


def _decode_log(packet: bytes, start: int, end: int) -> Log | Reject:
    body = start + _LOG.size
    if end < body:
        return Reject.SHORT_PAYLOAD
    level, size, ticks = _LOG.unpack_from(packet, start)
    if end < body + size:
        return Reject.SHORT_PAYLOAD
    text = packet[body : body + size].decode("utf-8", errors="replace")
    if not text.isprintable():
        # A board's text ends up in terminals and logs, so control characters are replaced.
        text = "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in text)
    return Log(level, ticks, text)


def _decode_ack(packet: bytes, start: int, end: int) -> Ack | Reject:
    if end - start < _ACK.size:
        return Reject.SHORT_PAYLOAD
    command, result, request = _ACK.unpack_from(packet, start)
    return Ack(command, request, _RESULTS.get(result, AckResult.FAILED))


def _plain(layout: struct.Struct, make: Callable[..., Message]) -> _Decode:
    """Decoder for a message whose fields are those of ``layout`` in the same order."""
    size = layout.size

    def decode(packet: bytes, start: int, end: int) -> Message | Reject:
        if end - start < size:
            return Reject.SHORT_PAYLOAD
        return make(*layout.unpack_from(packet, start))

    return decode


def _request(message: Start | Stop | Reboot) -> bytes:
    return _REQUEST.pack(message.request)


def _encode_clock_reply(message: ClockReply) -> bytes:
    return _CLOCK_REPLY.pack(message.token, message.ticks_received, message.ticks_sent)


def _encode_set_gain(m: SetGain) -> bytes:
    return _SET_GAIN.pack(m.request, m.array, m.gain, m.resolution, m.oversampling, m.filter)


_ENCODERS: dict[type, Callable[[Any], bytes]] = {
    Descriptor: _encode_descriptor,
    Samples: _encode_samples,
    Status: _encode_status,
    ClockReply: _encode_clock_reply,
    Log: _encode_log,
    Ack: lambda m: _ACK.pack(m.command, m.result, m.request),
    Identify: lambda m: _IDENTIFY.pack(m.request, m.major, m.minor),
    Start: _request,
    Stop: _request,
    SetRate: lambda m: _SET_RATE.pack(m.request, m.rate_mhz),
    SetGain: _encode_set_gain,
    ClockPoll: lambda m: _CLOCK_POLL.pack(m.token),
    Reboot: _request,
}

_DECODERS: dict[int, _Decode] = {
    MessageType.DESCRIPTOR: _decode_descriptor,
    MessageType.SAMPLES: _decode_samples,
    MessageType.STATUS: _plain(_STATUS, Status),
    MessageType.CLOCK_REPLY: _plain(_CLOCK_REPLY, ClockReply),
    MessageType.LOG: _decode_log,
    MessageType.ACK: _decode_ack,
    MessageType.IDENTIFY: _plain(_IDENTIFY, Identify),
    MessageType.START: _plain(_REQUEST, Start),
    MessageType.STOP: _plain(_REQUEST, Stop),
    MessageType.SET_RATE: _plain(_SET_RATE, SetRate),
    MessageType.SET_GAIN: _plain(_SET_GAIN, SetGain),
    MessageType.CLOCK_POLL: _plain(_CLOCK_POLL, ClockPoll),
    MessageType.REBOOT: _plain(_REQUEST, Reboot),
}


# Packets, the same on both media: header, payload, CRC-32C.
#
# Header: type (1 byte), board (1), payload length (2, little-endian). The CRC covers header and
# payload and follows them, least significant byte first.


_HEADER = struct.Struct("<BBH")
_CRC = struct.Struct("<I")
HEADER_SIZE = _HEADER.size
OVERHEAD = HEADER_SIZE + _CRC.size
MAX_PACKET = MAX_PAYLOAD + OVERHEAD
"""Size of the longest packet in bytes; decoders hold at most this much of an unfinished one."""

MAX_UNKNOWN = 8
"""Unknown messages that a decoder remembers, so that a board can refuse them by number."""


def request_number(packet: bytes) -> int:
    """Request number of the command in ``packet`` (every command begins with it)."""
    return int.from_bytes(packet[HEADER_SIZE : HEADER_SIZE + 2], "little")


def pack(message: Message, board: int = 0) -> bytes:
    """Packet of ``message`` from or to ``board``. Raises ValueError if a value does not fit."""
    payload = encode_payload(message)
    if len(payload) > MAX_PAYLOAD:
        raise ValueError(f"payload of {len(payload)} bytes; at most {MAX_PAYLOAD}")
    body = _HEADER.pack(message_type(message), board, len(payload)) + payload
    return body + _CRC.pack(crc32c(body))


def shape_error(packet: bytes) -> Reject | None:
    """Reason to reject ``packet`` by its size, before its CRC is computed; None if there is
    none."""
    size = len(packet)
    if size < OVERHEAD:
        return Reject.RUNT
    if packet[2] + (packet[3] << 8) != size - OVERHEAD:
        return Reject.LENGTH
    if size > MAX_PACKET:
        return Reject.OVERSIZED
    return None


def intact(packets: Sequence[bytes]) -> list[bool]:
    """Whether the CRC of each packet (8 to `MAX_PACKET` bytes) is right; cheapest in bulk."""
    if len(packets) == 1:
        return [crc32c(packets[0]) == RESIDUE]
    good: list[bool] = (crc32c_each(packets) == RESIDUE).tolist()
    return good
