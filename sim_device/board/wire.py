"""Line from a board to its host, with the faults of a plan: serial bytes and CAN frames."""

from __future__ import annotations

import heapq
from abc import ABC, abstractmethod
from collections import Counter, deque
from collections.abc import Iterable
from dataclasses import replace
from typing import Generic, TypeVar

import numpy as np

from sensor_proto.can_transfers import (
    BUS_OFF,
    CLASSIC_SIZE,
    FD_SIZE,
    RESTARTED,
    CanFrame,
    error_frame,
)
from sim_device.faults import FaultPlan
from tactile_core.types import NS_PER_S, Instant

# How long frames take on a CAN bus, and which goes first.


MAX_QUEUED = 512
"""Most frames that wait for the bus: about five samples of a whole finger. More are dropped, as a
board's transmit queue does."""


def frame_seconds(frame: CanFrame, bitrate: int, data_bitrate: int) -> float:
    """Longest time of a frame on the wire, s, with stuff bits and interframe space; rates in bit/s.

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
    """Queue of frames for a bus: lowest identifier first, then first come."""

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
        """Share of the time since the last call that the bus was busy, 0 to 1."""
        span = now - self._since
        busy, self._busy_ns, self._since = self._busy_ns, 0, now
        return min(1.0, busy / span) if span > 0 else 0.0


Unit = TypeVar("Unit", bytes, CanFrame)

MAX_DELAYED = 4096
"""Most frames held up by delays at once, about 0.5 s of a full CAN bus; the oldest are lost."""


class _Wire(ABC, Generic[Unit]):
    """Frames in, frames out, changed by the faults of ``plan``.

    ``counters``: every fault by name. For the frames, ``sent`` = ``intact`` + ``damaged`` +
    ``lost`` + ``silenced`` + ``held`` - ``duplicated``, where ``held`` are those still inside.
    """

    def __init__(self, plan: FaultPlan) -> None:
        self._plan = plan
        self._rng = np.random.default_rng([plan.seed, 1])
        self._count: Counter[str] = Counter()
        self._waiting: tuple[Unit, str] | None = None
        self._delayed: deque[tuple[float, Unit, tuple[Unit, ...]]] = deque()
        self._release = 0.0

    @property
    def counters(self) -> dict[str, int]:
        """Faults injected so far and what became of the frames."""
        held = len(self._delayed) + (self._waiting is not None)
        return {**{name: self._count[name] for name in COUNTS}, "held": held}

    def pass_on(self, frames: Iterable[Unit], seconds: float) -> list[Unit]:
        """Frames that reach the host ``seconds`` s after power-on when ``frames`` are sent."""
        for frame in frames:
            self._count["sent"] += 1
            self._send(frame, seconds)
        out = []
        while self._delayed and self._delayed[0][0] <= seconds:
            _, frame, originals = self._delayed.popleft()
            self._count["intact" if self._arrives(frame, originals) else "damaged"] += 1
            out.append(frame)
        return out

    def _send(self, frame: Unit, seconds: float) -> None:
        plan, count = self._plan, self._count
        if any(w.covers(seconds) for w in plan.silence):
            count["silenced"] += 1
            return
        if self._chance(plan.loss):
            count["lost"] += 1
            return
        if self._waiting is not None:
            first, why = self._waiting
            self._waiting = None
            if why == "splice":
                count["spliced"] += 1
                # Two frames go in and one comes out; one counts as damaged here. The other may
                # still arrive whole, where both begin alike and are cut within that part.
                count["damaged"] += 1
                self._queue(self._splice(first, frame), seconds, (first, frame))
            else:
                count["reordered"] += 1
                self._deliver(frame, seconds)
                self._deliver(first, seconds)
            return
        for why, chance in (("splice", plan.splice), ("reorder", plan.reorder)):
            if self._chance(chance):
                self._waiting = frame, why
                return
        self._deliver(frame, seconds)
        if self._chance(plan.duplicate):
            count["duplicated"] += 1
            self._deliver(frame, seconds)

    def _deliver(self, frame: Unit, seconds: float) -> None:
        self._queue(self._damage(frame), seconds, (frame,))

    def _queue(self, frame: Unit, seconds: float, originals: tuple[Unit, ...]) -> None:
        due = seconds
        if self._chance(self._plan.delay):
            self._count["delayed"] += 1
            due += self._plan.delay_s
        # A frame that is held up also holds up those behind it: a line keeps the order.
        self._release = max(self._release, due)
        if len(self._delayed) == MAX_DELAYED:
            self._delayed.popleft()
            self._count["lost"] += 1
        self._delayed.append((self._release, frame, originals))

    def _chance(self, probability: float) -> bool:
        return probability > 0 and bool(self._rng.random() < probability)

    def _flip(self, data: bytes) -> bytes:
        """``data`` with some of its bits flipped."""
        bits = 8 * len(data)
        flips = int(self._rng.binomial(bits, self._plan.flip)) if self._plan.flip > 0 else 0
        if not flips:
            return data
        self._count["bits_flipped"] += flips
        changed = bytearray(data)
        for bit in self._rng.choice(bits, size=flips, replace=False).tolist():
            changed[bit >> 3] ^= 1 << (bit & 7)
        return bytes(changed)

    @abstractmethod
    def _damage(self, frame: Unit) -> Unit:
        """``frame`` after the faults inside it."""

    @abstractmethod
    def _splice(self, first: Unit, second: Unit) -> Unit:
        """Head of ``first`` joined to the tail of ``second``."""

    @abstractmethod
    def _arrives(self, frame: Unit, originals: tuple[Unit, ...]) -> bool:
        """Whether the host can make out one of the ``originals`` in ``frame``, which arrives."""


COUNTS = (
    "sent",
    "intact",
    "damaged",
    "lost",
    "silenced",
    "duplicated",
    "reordered",
    "spliced",
    "delayed",
    "bits_flipped",
    "bytes_lost",
    "bytes_inserted",
    "error_frames",
)


class SerialWire(_Wire[bytes]):
    """Frames that each end in a zero byte (for float boards: of fixed size)."""

    def __init__(self, plan: FaultPlan, delimited: bool = True) -> None:
        """``delimited``: frames end in a zero, so a frame that lost it damages the next too."""
        if plan.busoff:
            raise ValueError("busoff is a fault of CAN boards; this board is on a serial line")
        super().__init__(plan)
        self._delimited = delimited
        self._unfinished = False

    def _damage(self, frame: bytes) -> bytes:
        plan, rng = self._plan, self._rng
        data = self._flip(frame)
        if plan.byteloss > 0:
            kept = rng.random(len(data)) >= plan.byteloss
            lost = len(data) - int(kept.sum())
            if lost:
                self._count["bytes_lost"] += lost
                data = np.frombuffer(data, np.uint8)[kept].tobytes()
        if plan.byteinsert > 0:
            extra = int(rng.binomial(len(data), plan.byteinsert))
            if extra:
                self._count["bytes_inserted"] += extra
                values = np.frombuffer(data, np.uint8)
                places = rng.integers(0, len(data), extra)
                data = np.insert(values, places, rng.integers(0, 256, extra)).tobytes()
        return data

    def _splice(self, first: bytes, second: bytes) -> bytes:
        head = int(self._rng.integers(1, len(first)))
        tail = int(self._rng.integers(1, len(second)))
        return first[:head] + second[tail:]

    def _arrives(self, frame: bytes, originals: tuple[bytes, ...]) -> bool:
        if frame is originals[0] and not self._unfinished:
            return True
        if not self._delimited:
            return frame in originals
        segments = frame.split(b"\0")
        # The first continues what came before without its zero; the last has no zero yet.
        whole = segments[self._unfinished : -1]
        self._unfinished = bool(segments[-1]) or (self._unfinished and len(segments) == 1)
        return any(original[:-1] in whole for original in originals)


class CanWire(_Wire[CanFrame]):
    """CAN frames. The bus has its own CRC, so bit flips stand for errors behind it (an adapter)."""

    def __init__(self, plan: FaultPlan) -> None:
        super().__init__(plan)
        if plan.byteloss or plan.byteinsert:
            raise ValueError("byteloss and byteinsert are faults of serial lines, not of CAN")
        self._off = False

    def pass_on(self, frames: Iterable[CanFrame], seconds: float) -> list[CanFrame]:
        """As for any wire. During bus-off nothing passes; an error frame marks each end of it."""
        off = any(w.covers(seconds) for w in self._plan.busoff)
        changed, self._off = off != self._off, off
        if off:
            lost = list(frames)
            self._count["sent"] += len(lost)
            self._count["lost"] += len(lost)
            out = []
        else:
            out = super().pass_on(frames, seconds)
        if changed:
            self._count["error_frames"] += 1
            out.insert(0, error_frame(BUS_OFF if off else RESTARTED))
        return out

    def _damage(self, frame: CanFrame) -> CanFrame:
        data = self._flip(frame.data)
        return frame if data is frame.data else replace(frame, data=data)

    def _splice(self, first: CanFrame, second: CanFrame) -> CanFrame:
        head = int(self._rng.integers(1, max(len(first.data), 2)))
        tail = int(self._rng.integers(1, max(len(second.data), 2)))
        size = FD_SIZE if first.fd else CLASSIC_SIZE
        return replace(first, data=(first.data[:head] + second.data[tail:])[:size])

    def _arrives(self, frame: CanFrame, originals: tuple[CanFrame, ...]) -> bool:
        return frame in originals
