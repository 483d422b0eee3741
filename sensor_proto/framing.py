"""Packets on a serial line: COBS frames, each ended by a zero byte."""

from __future__ import annotations

import re
from collections import deque

from sensor_proto import cobs
from sensor_proto.packets import (
    ACCEPTED,
    HEADER_SIZE,
    MAX_PACKET,
    MAX_UNKNOWN,
    Message,
    Received,
    Reject,
    Tally,
    decode_payload,
    intact,
    pack,
    request_number,
    shape_error,
)

MAX_FRAME = cobs.max_encoded(MAX_PACKET)
"""Size of the longest frame without its zero, and the most bytes held of an unfinished one."""

_RUN = re.compile(rb"[^\0]+")
_REASONS = (
    Reject.COBS,
    Reject.OVERSIZED,
    Reject.RUNT,
    Reject.LENGTH,
    Reject.CRC,
    Reject.BOARD,
    Reject.UNKNOWN_TYPE,
    Reject.SHORT_PAYLOAD,
    Reject.BAD_VALUE,
    Reject.EMPTY,
)


def encode_serial(message: Message) -> bytes:
    """Frame of ``message`` with its ending zero. Raises ValueError if a value does not fit."""
    return cobs.encode(pack(message)) + b"\0"


class SerialDecoder:
    """Decodes the bytes of one serial line, in any chunks; holds at most `MAX_FRAME` bytes."""

    def __init__(self) -> None:
        self._partial = b""
        self._discarding = False
        self._tally = Tally(_REASONS)
        self._unknown: deque[tuple[int, int]] = deque(maxlen=MAX_UNKNOWN)

    def take_unknown(self) -> list[tuple[int, int]]:
        """Return type and request number of the unknown messages skipped since the last call."""
        unknown = list(self._unknown)
        self._unknown.clear()
        return unknown

    @property
    def counters(self) -> dict[str, int]:
        """Frames accepted and refused, by reason. An oversized frame counts once."""
        return self._tally.snapshot()

    def reset(self) -> None:
        """Forget the unfinished frame."""
        self._partial = b""
        self._discarding = False

    def feed(self, data: bytes, /) -> list[Received]:
        """Return the messages whose frames ended in ``data``."""
        last = data.rfind(0)
        if last < 0:
            self._hold(data)
            return []
        size = len(data)
        packets: list[bytes] = []
        trailing: list[int] = []
        first = data.find(0)
        frames = 0
        head = self._partial + data[:first] if self._partial else data[:first]
        if self._discarding:
            self._discarding = False
            frames += 1
        elif head:
            frames += 1
            self._unpack(head, size - first - 1, packets, trailing)
        for run in _RUN.finditer(data, first + 1, last):
            frames += 1
            self._unpack(run[0], size - run.end() - 1, packets, trailing)
        # Counted once per chunk, so that a flood of zeros costs nothing per zero.
        self._tally[Reject.EMPTY] += data.count(0) - frames
        self._partial = b""
        self._hold(data[last + 1 :])
        return self._decode(packets, trailing) if packets else []

    def _hold(self, data: bytes) -> None:
        """Keep the beginning of a frame unless it is already too long."""
        if self._discarding:
            return
        if len(self._partial) + len(data) > MAX_FRAME:
            self._partial = b""
            self._discarding = True
            self._tally[Reject.OVERSIZED] += 1
        else:
            self._partial += data

    def _unpack(self, frame: bytes, after: int, packets: list[bytes], trailing: list[int]) -> None:
        """Append the packet in ``frame`` if its size is right; otherwise count the reason."""
        if len(frame) > MAX_FRAME:
            self._tally[Reject.OVERSIZED] += 1
            return
        raw = cobs.decode(frame)
        if raw is None:
            self._tally[Reject.COBS] += 1
            return
        error = shape_error(raw)
        if error is not None:
            self._tally[error] += 1
            return
        packets.append(raw)
        trailing.append(after)

    def _decode(self, packets: list[bytes], trailing: list[int]) -> list[Received]:
        tally = self._tally
        received = []
        for raw, after, good in zip(packets, trailing, intact(packets), strict=True):
            if not good:
                tally[Reject.CRC] += 1
                continue
            if raw[1]:
                tally[Reject.BOARD] += 1
                continue
            message = decode_payload(raw[0], raw, HEADER_SIZE, len(raw) - 4)
            if isinstance(message, Reject):
                tally[message] += 1
                if message is Reject.UNKNOWN_TYPE:
                    self._unknown.append((raw[0], request_number(raw)))
                continue
            received.append(Received(message, 0, after))
        tally[ACCEPTED] += len(received)
        return received
