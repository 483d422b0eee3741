"""The packet that both media carry: header, payload, CRC-32C.

Header: type (1 byte), board (1), payload length (2, little-endian). The CRC covers header and
payload and follows them, least significant byte first.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence

from sensor_proto.crc import RESIDUE, crc32c, crc32c_each
from sensor_proto.decoder import Reject
from sensor_proto.packets import Message
from sensor_proto.wire import MAX_PAYLOAD, encode_payload, message_type

_HEADER = struct.Struct("<BBH")
_CRC = struct.Struct("<I")
HEADER_SIZE = _HEADER.size
OVERHEAD = HEADER_SIZE + _CRC.size
MAX_PACKET = MAX_PAYLOAD + OVERHEAD
"""Bytes of the longest packet; decoders hold no more than this of one that is not yet whole."""

MAX_UNKNOWN = 8
"""Messages of unknown type that a decoder remembers so that a board can refuse them by number."""


def request_number(packet: bytes) -> int:
    """Request that the command in ``packet`` carries, for every command begins with it; else 0."""
    return int.from_bytes(packet[HEADER_SIZE : HEADER_SIZE + 2], "little")


def pack(message: Message, board: int = 0) -> bytes:
    """Packet of ``message`` from or to ``board``; ValueError for values that do not fit."""
    payload = encode_payload(message)
    if len(payload) > MAX_PAYLOAD:
        raise ValueError(f"payload of {len(payload)} bytes; at most {MAX_PAYLOAD}")
    body = _HEADER.pack(message_type(message), board, len(payload)) + payload
    return body + _CRC.pack(crc32c(body))


def shape_error(packet: bytes) -> Reject | None:
    """Reason to refuse ``packet`` by its size alone, before its CRC is worked out."""
    size = len(packet)
    if size < OVERHEAD:
        return Reject.RUNT
    if packet[2] + (packet[3] << 8) != size - OVERHEAD:
        return Reject.LENGTH
    return None


def intact(packets: Sequence[bytes]) -> list[bool]:
    """Whether the CRC of each packet (8 to `MAX_PACKET` bytes) is right; cheapest for many."""
    if len(packets) == 1:
        return [crc32c(packets[0]) == RESIDUE]
    good: list[bool] = (crc32c_each(packets) == RESIDUE).tolist()
    return good
