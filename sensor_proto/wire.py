"""Payload of every message to and from bytes, exactly as ``PROTOCOL.md`` lays them out.

Everything is little-endian and packed. Encoding refuses local misuse with ValueError or
TypeError; decoding never raises: it returns a `Reject` for what makes no sense.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any

import numpy as np

from sensor_proto.decoder import Reject
from sensor_proto.packets import (
    PROTOCOL_MAJOR,
    Ack,
    AckResult,
    ArrayDescriptor,
    ChipType,
    ClockPoll,
    ClockReply,
    Descriptor,
    Identify,
    Log,
    Message,
    MessageType,
    Reboot,
    Samples,
    SetGain,
    SetRate,
    Start,
    Status,
    Stop,
)

MAX_PAYLOAD = 1024
"""Bytes. The longest message, samples of 128 taxels, is 908; the rest is room for newer minors."""

MAX_TAXELS = 128
"""Taxels of one array."""

MAX_ARRAYS = 16
"""Arrays of one board; their descriptor is 564 bytes."""

MAX_TEXT = 255
"""Bytes of UTF-8 in a log line: its length is one byte."""

NAME_SIZE = 16
"""Bytes of a name on the wire: at most 15 of printable ASCII, then zeros."""

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
    """Type byte of ``message``; TypeError for what is no message of this protocol."""
    kind = _TYPES.get(type(message))
    if kind is None:
        raise TypeError(f"{type(message).__name__} is no message of this protocol")
    return kind


def encode_payload(message: Message) -> bytes:
    """Payload of ``message``; ValueError for a value that its field cannot hold."""
    message_type(message)
    try:
        return _ENCODERS[type(message)](message)
    except struct.error as error:
        raise ValueError(f"{type(message).__name__}: {error}") from error


def decode_payload(kind: int, packet: bytes, start: int, end: int) -> Message | Reject:
    """Message of type ``kind`` whose payload is ``packet[start:end]``."""
    decoder = _DECODERS.get(kind)
    if decoder is None:
        return Reject.UNKNOWN_TYPE
    return decoder(packet, start, end)


def _name(label: str, text: str) -> bytes:
    """Name for the wire; ValueError unless it is at most 15 bytes of printable ASCII."""
    if len(text) >= NAME_SIZE or not (text.isascii() and text.isprintable()):
        raise ValueError(f"{label} {text!r}: at most {NAME_SIZE - 1} printable ASCII characters")
    return text.encode("ascii")


def _read_name(raw: bytes) -> str | None:
    """Name from the wire; None unless it is printable ASCII and ended by zeros."""
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
        # Only these fields are the same in every major version: enough to refuse it by name.
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
    # Views of the packet: bytes never change, so numpy makes them read-only.
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
        # What a board says ends up in terminals and logs: no control character may pass.
        text = "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in text)
    return Log(level, ticks, text)


def _decode_ack(packet: bytes, start: int, end: int) -> Ack | Reject:
    if end - start < _ACK.size:
        return Reject.SHORT_PAYLOAD
    command, result, request = _ACK.unpack_from(packet, start)
    return Ack(command, request, _RESULTS.get(result, AckResult.FAILED))


def _plain(layout: struct.Struct, make: Callable[..., Message]) -> _Decode:
    """Decoder of a message whose fields are those of ``layout`` in the same order."""
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
