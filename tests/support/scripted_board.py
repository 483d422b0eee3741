"""A minimal board, to test links independently of the simulator's firmware."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from sensor_proto.packets import (
    Ack,
    AckResult,
    ArrayDescriptor,
    BoardMessage,
    ChipType,
    ClockPoll,
    ClockReply,
    Descriptor,
    HostMessage,
    Identify,
    Samples,
    SetRate,
    Start,
    Status,
    Stop,
)
from tactile_core.types import NS_PER_S, Instant

TICK_HZ = 1_000_000

DESCRIPTOR = Descriptor(
    major=1,
    minor=0,
    unique_id=bytes.fromhex("00000000000000aa"),
    model="pad",
    firmware="1.2.3",
    tick_hz=TICK_HZ,
    max_rate_mhz=493_000,
    arrays=(
        ArrayDescriptor(0, "pad", ChipType.MLX90393, 2, 2, 8000, 150, 242),
        ArrayDescriptor(1, "rim", ChipType.MLX90393, 1, 3, 8000, 150, 242),
    ),
)


def at(seconds: float) -> Instant:
    return Instant(1000 * NS_PER_S + round(seconds * NS_PER_S))


@dataclass
class ScriptedBoard:
    """Answers like a board; its switches turn answers off."""

    descriptor: Descriptor = DESCRIPTOR
    period: float = 0.01
    error: float = 0.0
    deaf: bool = False
    mute: bool = False
    results: dict[type, AckResult] = field(default_factory=dict)
    heard: list[HostMessage] = field(default_factory=list)
    booted: float = 0.0
    streaming: bool = False
    sequence: int = 0
    rate_mhz: int = 100_000
    _next: float = 0.0
    _status: float = 0.0

    def reboot(self, now: float) -> None:
        self.booted, self.streaming, self.sequence = now, False, 0
        self._status = now + 1.0

    def ticks(self, now: float) -> int:
        return int((now - self.booted) * (1 + self.error) * TICK_HZ) % 2**32

    def hear(self, message: HostMessage, now: float) -> list[BoardMessage]:
        self.heard.append(message)
        if self.deaf or self.mute:
            return []
        match message:
            case Identify():
                return [self.descriptor]
            case ClockPoll():
                return [ClockReply(message.token, self.ticks(now), self.ticks(now))]
            case Start() | Stop() | SetRate():
                result = self.results.get(type(message), AckResult.OK)
                if result is AckResult.OK:
                    self._obey(message, now)
                kind = {Start: 0x82, Stop: 0x83, SetRate: 0x84}[type(message)]
                return [Ack(kind, message.request, result)]
            case _:
                return []

    def _obey(self, message: HostMessage, now: float) -> None:
        if isinstance(message, SetRate):
            self.rate_mhz = message.rate_mhz
            self.period = 1000 / message.rate_mhz
        elif not self.streaming or isinstance(message, Stop):
            self.streaming = isinstance(message, Start)
            self._next = now + self.period

    def speak(self, now: float) -> list[BoardMessage]:
        out: list[BoardMessage] = []
        while self.streaming and self._next <= now:
            out += [self.sample(a.array, self._next) for a in self.descriptor.arrays]
            self.sequence = (self.sequence + 1) % 2**32
            self._next += self.period
        if now >= self._status:
            self._status = now + 1.0
            uptime = round((now - self.booted) * 1000)
            out.append(Status(uptime, self.sequence, 0, 0, 0, self.rate_mhz, 0))
        return [] if self.mute else out

    def sample(self, array: int, when: float) -> Samples:
        taxels = next(a.taxels for a in self.descriptor.arrays if a.array == array)
        counts = np.tile(np.array([100, -200, 300], np.int16), (taxels, 1))
        status = np.zeros(taxels, np.uint8)
        return Samples(array, self.sequence, self.ticks(when), 2512, counts, status)
