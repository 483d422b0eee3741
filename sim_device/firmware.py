"""Simulated boards on a serial line and on a CAN bus: what the host sends in, `tick` out.

Boards own no clock, port or thread. Whoever drives one calls `receive` with what arrived and
`tick` at least every few milliseconds, with instants that never go back. Not calling `tick` is
the back-pressure of a full port: the board then overruns, as a real one does.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable
from typing import TypedDict, Unpack

from sensor_proto.canseg import BROADCAST, CanDecoder, CanEncoder, CanFrame
from sensor_proto.decoder import ACCEPTED
from sensor_proto.framing import SerialDecoder, encode_serial
from sensor_proto.packets import Descriptor, Received
from sim_device.board_clock import ClockParameters
from sim_device.controller import DEFAULT_RATE, Controller, Identity
from sim_device.environment import Environment
from sim_device.faults import FaultPlan, TaxelFaultKind
from sim_device.faulty_wire import CanWire, SerialWire
from sim_device.sampler import Contacts, Sampler, SkinOwner
from sim_device.skin import SkinModel
from tactile_bus.instant import Instant, seconds_between

BURST_SECONDS = 0.05
"""s worth of a limited line that may go out at once after it was idle."""


class BoardOptions(TypedDict, total=False):
    """What may be said of any board when it is made; all may be left out."""

    environment: Environment
    contacts: Contacts
    plan: FaultPlan
    clock: ClockParameters
    rate: float  # Hz after a boot
    line_rate: float  # bytes (serial) or bits (CAN) per s that the line carries; no limit if absent


class SimulatedBoard(SkinOwner, ABC):
    """What the boards of both media share; see `SerialBoard` and `CanBoard`."""

    def __init__(
        self, skin: SkinModel, identity: Identity, **options: Unpack[BoardOptions]
    ) -> None:
        """ValueError for a plan or a rate that does not fit the board."""
        self._plan = options.get("plan", FaultPlan())
        if any(fault.kind is TaxelFaultKind.INFINITE for fault in self._plan.taxels):
            raise ValueError("inf: such a board sends counts; allowed on boards that send floats")
        super().__init__(
            Sampler(
                skin,
                options.get("environment", Environment()),
                options.get("contacts", ()),
                self._plan,
            )
        )
        self.controller = Controller(
            self._sampler,
            identity,
            options.get("clock", ClockParameters()),
            self._plan,
            options.get("rate", DEFAULT_RATE),
        )
        self._line_rate = options.get("line_rate")
        self._credit = 0.0
        self._last: Instant | None = None
        self._rejected = 0

    @property
    def serial_number(self) -> str:
        """Unique id as 16 hex digits."""
        return self.controller.identity.unique_id.hex()

    @property
    def descriptor(self) -> Descriptor:
        """What the board says of itself now."""
        return self.controller.descriptor()

    @property
    @abstractmethod
    def counters(self) -> dict[str, int]:
        """Everything counted since power-on: cycles, overruns, faults injected, frames sent."""

    def _counters(self, wire: dict[str, int]) -> dict[str, int]:
        return {**self.controller.counters, **wire}

    def _obey(
        self, received: Iterable[Received], decoder: SerialDecoder | CanDecoder, now: Instant
    ) -> None:
        for item in received:
            self.controller.handle(item.message, now)
        for command, request in decoder.take_unknown():
            self.controller.refuse(command, request, now)
        counters = decoder.counters
        rejected = sum(counters.values()) - counters[ACCEPTED]
        self.controller.count_rejected(rejected - self._rejected)
        self._rejected = rejected

    def _afford(self, now: Instant) -> None:
        """Add what the line could carry since the last call."""
        if self._line_rate is None:
            self._credit = 1.0
            return
        elapsed = 0.0 if self._last is None else seconds_between(self._last, now)
        self._last = now
        self._credit = min(
            self._credit + elapsed * self._line_rate, BURST_SECONDS * self._line_rate
        )

    def _spend(self, amount: float) -> None:
        if self._line_rate is not None:
            self._credit -= amount


class SerialBoard(SimulatedBoard):
    """A board on a serial line."""

    def __init__(
        self, skin: SkinModel, identity: Identity, **options: Unpack[BoardOptions]
    ) -> None:
        super().__init__(skin, identity, **options)
        self._decoder = SerialDecoder()
        self._wire = SerialWire(self._plan)

    @property
    def counters(self) -> dict[str, int]:
        """As of every board; frames are counted whole."""
        return self._counters(self._wire.counters)

    def receive(self, data: bytes, now: Instant) -> None:
        """Take bytes from the host; answers come out of the next `tick`."""
        received = self._decoder.feed(data)
        self.controller.advance(now)
        self._obey(received, self._decoder, now)

    def tick(self, now: Instant) -> bytes:
        """Bytes for the host up to ``now``."""
        self.controller.advance(now)
        self._afford(now)
        frames: list[bytes] = []
        while self._credit > 0:
            messages = self.controller.take(now)
            if not messages:
                break
            encoded = [encode_serial(m) for m in messages]
            self._spend(sum(len(e) for e in encoded))
            frames += encoded
        return b"".join(self._wire.pass_on(frames, self.controller.seconds(now)))


class CanBoard(SimulatedBoard):
    """Board number ``node`` (0 to 126) on a CAN bus; frames hold 8 bytes or, if ``fd``, 64."""

    def __init__(
        self,
        skin: SkinModel,
        identity: Identity,
        node: int = 1,
        fd: bool = False,
        **options: Unpack[BoardOptions],
    ) -> None:
        if not 0 <= node < BROADCAST:
            raise ValueError(f"node {node}: 0 to {BROADCAST - 1}")
        super().__init__(skin, identity, **options)
        self.node = node
        self._decoder = CanDecoder()
        self._encoder = CanEncoder(node, fd)
        self._wire = CanWire(self._plan)

    @property
    def counters(self) -> dict[str, int]:
        """As of every board; CAN frames are counted, not transfers."""
        return self._counters(self._wire.counters)

    def receive(self, frames: Iterable[CanFrame], now: Instant) -> None:
        """Take frames from the bus; those for and of other boards are passed over."""
        mine = [f for f in frames if f.error or f.identifier & 0x7F in (self.node, BROADCAST)]
        received = self._decoder.feed(mine)
        self.controller.advance(now)
        self._obey(received, self._decoder, now)

    def tick(self, now: Instant) -> tuple[CanFrame, ...]:
        """Frames for the host up to ``now``."""
        self.controller.advance(now)
        self._afford(now)
        frames: list[CanFrame] = []
        while self._credit > 0:
            messages = self.controller.take(now)
            if not messages:
                break
            encoded = [frame for m in messages for frame in self._encoder.encode(m)]
            self._spend(sum(frame_bits(f) for f in encoded))
            frames += encoded
        return tuple(self._wire.pass_on(frames, self.controller.seconds(now)))


_CLASSIC_BITS = 67
"""Bits of an extended data frame besides its data, the space between frames included (ISO 11898-1:
1 + 11 + 2 + 18 + 3 + 4 + 16 + 10 + 3, rounded by the stuffing of a fixed header)."""

_STUFFING = 1.1
"""Usual share of stuff bits; 1.25 is the worst."""


def frame_bits(frame: CanFrame) -> float:
    """Nominal bit times of a frame; with ``fd`` the data phase is taken as four times faster."""
    data = 8 * len(frame.data) / (4 if frame.fd else 1)
    return _STUFFING * (_CLASSIC_BITS + data)
