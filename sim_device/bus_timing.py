"""How long frames take on a CAN bus, and which goes first."""

from __future__ import annotations

import heapq
from collections.abc import Iterable

from sensor_proto.canseg import CanFrame
from tactile_bus.instant import NS_PER_S, Instant

MAX_QUEUED = 512
"""Frames that wait for the bus: some five samples of a whole finger. What comes on top is dropped,
as a board's transmit queue does it."""


def frame_seconds(frame: CanFrame, bitrate: int, data_bitrate: int) -> float:
    """Longest time of a frame on the wire in s, stuff bits and interframe space included.

    Classic, 29-bit: 54 + 8n stuffable bits and 13 more (Davis et al., Real-Time Systems 35, 2007,
    eq. 1). FD: 36 + 9 stuff + 13 bits at ``bitrate``; the rest, with fixed stuff bits in the CRC,
    at ``data_bitrate`` (ISO 11898-1:2015).
    """
    n = len(frame.data)
    if not frame.fd:
        stuffable = 54 + 8 * n
        return (stuffable + 13 + (stuffable - 1) // 4) / bitrate
    crc = 17 + 4 + 6 if n <= 16 else 21 + 4 + 7
    data_bits = 5 + 8 * n + (5 + 8 * n) // 4 + crc
    return 58 / bitrate + data_bits / data_bitrate


class TimedBus:
    """Frames wait here for their turn: lowest identifier first, then first come.

    ``load``: share of time the bus was busy since it was last asked for.
    """

    def __init__(self) -> None:
        self._heap: list[tuple[int, int, CanFrame]] = []
        self._order = 0
        self._free_at = Instant(0)
        self._busy_ns = 0
        self._since = Instant(0)
        self.dropped_frames = 0

    def push(self, frames: Iterable[CanFrame], now: Instant) -> None:
        """Queue frames that belong together; all are dropped when the queue is full."""
        batch = tuple(frames)
        if len(self._heap) >= MAX_QUEUED:
            self.dropped_frames += len(batch)
            return
        if not self._heap and self._free_at < now:
            self._free_at = now
        for frame in batch:
            heapq.heappush(self._heap, (frame.identifier, self._order, frame))
            self._order += 1

    def pop(self, now: Instant, bitrate: int, data_bitrate: int) -> tuple[CanFrame, ...]:
        """Frames whose last bit has gone over the bus by ``now``; rates in bit/s."""
        done = []
        while self._heap:
            frame = self._heap[0][2]
            takes = round(frame_seconds(frame, bitrate, data_bitrate) * NS_PER_S)
            if self._free_at + takes > now:
                break
            heapq.heappop(self._heap)
            self._free_at = Instant(self._free_at + takes)
            self._busy_ns += takes
            done.append(frame)
        return tuple(done)

    @property
    def waiting(self) -> int:
        """Frames not yet on the bus."""
        return len(self._heap)

    def load(self, now: Instant) -> float:
        """Share of time since the last call that the bus was busy, 0 to 1."""
        span = now - self._since
        busy, self._busy_ns, self._since = self._busy_ns, 0, now
        return min(1.0, busy / span) if span > 0 else 0.0
