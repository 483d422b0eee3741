"""Chunks as ``tactile_msgs/RawChunk`` messages, and back."""

from __future__ import annotations

from typing import Any

import numpy as np

from sensor_proto.canseg import CanFrame
from tactile_bus.instant import Instant, WallClock
from tactile_bus.messages import MSG, DecodeError, header
from tactiled.blocks import Chunk

SERIAL, CAN = 0, 1
FD_BIT = 1 << 31
ERROR_BIT = 1 << 29
ID_MASK = ERROR_BIT - 1


def to_raw(chunk: Chunk, port: str, wall: WallClock) -> Any:
    """RawChunk message of a chunk read from ``port``."""
    payload = chunk.payload
    if isinstance(payload, bytes):
        ids, lengths, data, medium = [], [], payload, SERIAL
    else:
        ids = [f.identifier | FD_BIT * f.fd | ERROR_BIT * f.error for f in payload]
        lengths = [len(f.data) for f in payload]
        data, medium = b"".join(f.data for f in payload), CAN
    return MSG.RawChunk(
        header(wall.wall_ns(chunk.received), port),
        received_ns=chunk.received,
        medium=medium,
        can_id=np.array(ids, np.uint32),
        can_length=np.array(lengths, np.uint8),
        data=np.frombuffer(data, np.uint8),
    )


def from_raw(message: Any) -> Chunk:
    """Chunk of a RawChunk message; raises `DecodeError` when its parts disagree."""
    data = np.asarray(message.data, np.uint8).tobytes()
    received = Instant(int(message.received_ns))
    if message.medium == SERIAL:
        return Chunk(received, data)
    if message.medium != CAN:
        raise DecodeError(f"RawChunk of medium {message.medium}: 0 serial, 1 CAN")
    ids, lengths = message.can_id.tolist(), message.can_length.tolist()
    if len(ids) != len(lengths) or sum(lengths) != len(data):
        raise DecodeError(
            f"RawChunk with {len(ids)} identifiers, {len(lengths)} lengths and {len(data)} bytes"
        )
    frames, at = [], 0
    for can_id, length in zip(ids, lengths, strict=True):
        part = data[at : at + length]
        at += length
        frames.append(
            CanFrame(can_id & ID_MASK, part, bool(can_id & FD_BIT), bool(can_id & ERROR_BIT))
        )
    return Chunk(received, tuple(frames))
