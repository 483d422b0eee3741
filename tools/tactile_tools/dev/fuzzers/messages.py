"""Messages that the fuzzers send, and the judge of what is decoded from them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Hashable, Iterable
from dataclasses import astuple

import numpy as np

from sensor_proto.packets import (
    Ack,
    AckResult,
    ArrayDescriptor,
    ChipType,
    ClockPoll,
    ClockReply,
    Descriptor,
    FloatSamples,
    Identify,
    Log,
    Message,
    Reboot,
    Received,
    Samples,
    SetGain,
    SetRate,
    Start,
    Status,
    Stop,
)

TEXTS = ("chip 3 does not answer", "up, reset: watchdog", "9 µT", "")
TAXELS = (1, 2, 4, 9, 16, 32)
_LARGE = 60  # one samples message in so many has the greatest length


def random_samples(rng: np.random.Generator) -> Samples:
    """Samples like those of a real board: quiet high bytes, mostly clear status."""
    n = 128 if rng.integers(_LARGE) == 0 else int(rng.choice(TAXELS))
    counts = rng.normal((0, 0, 9000), 400, (n, 3)).astype(np.int16)
    status = (rng.random(n) < 0.03).astype(np.uint8)
    array, sequence, ticks = int(rng.integers(4)), _u32(rng), _u32(rng)
    return Samples(array, sequence, ticks, int(rng.integers(1500, 4500)), counts, status)


def random_descriptor(rng: np.random.Generator) -> Descriptor:
    """Descriptor of a board with one to four arrays."""
    arrays = tuple(
        ArrayDescriptor(i, f"a{i}", ChipType.MLX90393, 4, int(rng.integers(1, 9)), 8000, 150, 242)
        for i in range(int(rng.integers(1, 5)))
    )
    return Descriptor(1, 0, rng.bytes(8), "finger", "1.0", 1_000_000, 400_000, arrays)


def _u8(rng: np.random.Generator) -> int:
    return int(rng.integers(1 << 8))


def _u16(rng: np.random.Generator) -> int:
    return int(rng.integers(1 << 16))


def _u32(rng: np.random.Generator) -> int:
    return int(rng.integers(1 << 32))


_MAKERS: tuple[Callable[[np.random.Generator], Message], ...] = (
    random_descriptor,
    lambda r: Status(_u32(r), _u32(r), _u16(r), _u16(r), _u16(r), 100_000, 0),
    lambda r: ClockReply(_u32(r), _u32(r), _u32(r)),
    lambda r: Log(20, _u32(r), TEXTS[int(r.integers(len(TEXTS)))]),
    lambda r: Ack(0x82, _u16(r), AckResult.OK),
    lambda r: Identify(_u16(r)),
    lambda r: Start(_u16(r)),
    lambda r: Stop(_u16(r)),
    lambda r: SetRate(_u16(r), _u32(r)),
    lambda r: SetGain(_u16(r), 255, _u8(r), _u8(r), _u8(r), _u8(r)),
    lambda r: ClockPoll(_u32(r)),
    lambda r: Reboot(_u16(r)),
)


def random_messages(rng: np.random.Generator, count: int) -> list[Message]:
    """``count`` messages of every type; two in three are samples."""
    return [
        random_samples(rng) if i % 3 else _MAKERS[i // 3 % len(_MAKERS)](rng) for i in range(count)
    ]


def key(message: Message | FloatSamples, board: int) -> Hashable:
    """Everything in a message, hashable."""
    if isinstance(message, Samples):
        head = (message.array, message.sequence, message.ticks, message.temperature_cc)
        return board, head, message.field.tobytes(), message.status.tobytes()
    if isinstance(message, FloatSamples):
        raise TypeError("the framed protocol has no FloatSamples")
    return board, type(message), astuple(message)


class Judge:
    """Compares what was sent with what was accepted; each copy sent may come out once."""

    def __init__(self) -> None:
        self._open: Counter[Hashable] = Counter()
        self.sent = self.accepted = self.wrong = 0

    def send(self, sent: Hashable) -> None:
        """Note a message as sent."""
        self._open[sent] += 1
        self.sent += 1

    def receive(self, received: Iterable[Received]) -> None:
        """Count as wrong every message that was not sent, or came out more often than sent."""
        for item in received:
            found = key(item.message, item.board)
            if self._open[found] > 0:
                self._open[found] -= 1
                self.accepted += 1
            else:
                self.wrong += 1

    @property
    def lost(self) -> int:
        """Messages sent that never came out."""
        return self.sent - self.accepted
