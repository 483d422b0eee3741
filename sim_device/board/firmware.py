"""Program on a board's microcontroller: commands in, messages out, whatever the medium."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections import Counter, deque
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from enum import IntEnum
from typing import TypedDict, Unpack

import numpy as np

from sensor_proto.can_transfers import BROADCAST, CanDecoder, CanEncoder, CanFrame
from sensor_proto.framing import SerialDecoder, encode_serial
from sensor_proto.packets import (
    ACCEPTED,
    PROTOCOL_MAJOR,
    PROTOCOL_MINOR,
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
    Reject,
    Samples,
    SetGain,
    SetRate,
    Start,
    Status,
    Stop,
    TaxelStatus,
    message_type,
)
from sim_device.board.wire import CanWire, SerialWire
from sim_device.faults import FaultPlan, TaxelFaultKind
from sim_device.skin.chips import Reading
from sim_device.skin.environment import Environment
from sim_device.skin.parameters import ChipSetting
from sim_device.skin.sampler import Contacts, Sampler, SkinOwner
from sim_device.skin.skin import SkinModel
from tactile_core.geometry import ArrayGeometry
from tactile_core.types import Instant, after, seconds_between

# The oscillator of a board: its ticks never quite match what the descriptor says.


TICK_MASK = 0xFFFF_FFFF
"""Ticks are sent as 32 bits."""


@dataclass(frozen=True, slots=True)
class ClockParameters:
    """Properties of a board's oscillator."""

    tick_hz: int = 1_000_000
    """Nominal frequency, Hz: what the descriptor says."""
    error: float = 30e-6
    """Relative error at 25 °C; a crystal has up to ±50 ppm, an RC oscillator 1 %."""
    error_per_k: float = -0.5e-6
    """Relative error per K: crystals and resonators near room temperature (assumed)."""
    start_ticks: int = 0
    """Ticks at power-on, to bring the wrap of 32 bits near."""


class BoardClock:
    """Unwrapped ticks since power-on or reset; `BoardClock.wire` gives the 32 bits sent."""

    def __init__(self, parameters: ClockParameters, start: Instant) -> None:
        self.parameters = parameters
        self._instant = start
        self._ticks = float(parameters.start_ticks)
        self._hz = parameters.tick_hz * (1 + parameters.error)

    def warm(self, now: Instant, temperature_c: float) -> None:
        """Run at the frequency of ``temperature_c`` from ``now`` on."""
        p = self.parameters
        self._ticks = self.ticks(now)
        self._instant = now
        self._hz = p.tick_hz * (1 + p.error + p.error_per_k * (temperature_c - 25.0))

    def ticks(self, now: Instant) -> float:
        """Ticks at ``now``, fractional and unwrapped."""
        return self._ticks + seconds_between(self._instant, now) * self._hz

    def instant(self, ticks: float) -> Instant:
        """Instant at which the unwrapped count reaches ``ticks``."""
        return Instant(self._instant + round((ticks - self._ticks) / self._hz * 1e9))

    def wire(self, now: Instant) -> int:
        """Count at ``now`` as it is sent: whole and 32 bits."""
        return int(self.ticks(now)) & TICK_MASK


# What a host can set on a board: sample rate, and gain and filter of each array.


ALL_ARRAYS = 255
"""Array number in `SetGain` that stands for all arrays."""

MIN_RATE_MHZ = 100
"""Lowest rate, mHz: less than a sample in ten seconds is not a stream."""


class Registers:
    """Present settings of the chips behind ``skin``; `restore` brings back those of a boot.

    ``conversion_time``: of the slowest array, s.
    """

    def __init__(self, skin: SkinModel, rate: float) -> None:
        """``rate``: Hz after a boot; ValueError if the chips cannot reach it."""
        self._skin = skin
        top = _max_rate_mhz([skin.parameters.chip.setting])
        if not MIN_RATE_MHZ <= rate * 1000 <= top:
            raise ValueError(f"rate {rate:g} Hz: {MIN_RATE_MHZ / 1000} to {top / 1000:.0f} Hz")
        self._boot_rate_mhz = round(rate * 1000)
        self.restore()

    def restore(self) -> None:
        """Set everything as after a boot."""
        skin = self._skin
        self.rate_mhz = self._boot_rate_mhz
        self._use([skin.parameters.chip.setting] * len(skin.geometry.arrays))
        skin.chips.configure(slice(None), skin.parameters.chip.setting)

    @property
    def max_rate_mhz(self) -> int:
        """Highest rate of the slowest array, mHz."""
        return _max_rate_mhz(self._settings)

    def _use(self, settings: list[ChipSetting]) -> None:
        self._settings = settings
        self.conversion_time = max(s.conversion_time for s in settings)

    def set_rate(self, rate_mhz: int) -> AckResult:
        """Set the rate, mHz; refused outside `MIN_RATE_MHZ` to `max_rate_mhz`."""
        if not MIN_RATE_MHZ <= rate_mhz <= self.max_rate_mhz:
            return AckResult.BAD_ARGUMENT
        self.rate_mhz = rate_mhz
        return AckResult.OK

    def set_gain(self, command: SetGain) -> AckResult:
        """Set gain and filter; refused for codes that the chip lacks and for filters too slow for
        the present rate."""
        slices = self._skin.geometry.slices
        if command.array == ALL_ARRAYS:
            chosen = range(len(slices))
        elif command.array < len(slices):
            chosen = range(command.array, command.array + 1)
        else:
            return AckResult.BAD_ARGUMENT
        try:
            setting = ChipSetting(
                command.gain, command.resolution, command.oversampling, command.filter
            )
        except ValueError:
            return AckResult.BAD_ARGUMENT
        settings = [setting if i in chosen else s for i, s in enumerate(self._settings)]
        if self.rate_mhz > _max_rate_mhz(settings):
            return AckResult.BAD_ARGUMENT
        self._use(settings)
        for i in chosen:
            self._skin.chips.configure(slices[i], setting)
        return AckResult.OK

    def arrays(self) -> tuple[ArrayDescriptor, ...]:
        """Arrays as the descriptor lists them, with their present scales."""
        arrays = self._skin.geometry.arrays
        return tuple(
            _describe(number, array, setting)
            for number, (array, setting) in enumerate(zip(arrays, self._settings, strict=True))
        )


def _max_rate_mhz(settings: list[ChipSetting]) -> int:
    return int(min(s.max_rate for s in settings) * 1000)


def _describe(number: int, array: ArrayGeometry, setting: ChipSetting) -> ArrayDescriptor:
    x_ut, _, z_ut = setting.lsb_ut
    return ArrayDescriptor(
        number,
        array.name,
        ChipType.MLX90393,
        array.rows,
        array.columns,
        _pitch_um(array),
        round(x_ut * 1000),
        round(z_ut * 1000),
    )


def _pitch_um(array: ArrayGeometry) -> int:
    """Smallest distance of two taxels on the unrolled skin, µm; 1 for a single taxel."""
    if array.taxels == 1:
        return 1
    difference = array.surface[:, None] - array.surface[None]
    distance = np.linalg.norm(difference, axis=2)
    return round(1e6 * float(distance[np.triu_indices(array.taxels, 1)].min()))


FIRMWARE = "sim 1.0"

DEFAULT_RATE_HZ = 100.0
"""Hz after a boot."""

BOOT_S = 0.15
"""Seconds from reset to the first message: clocks, then the chips' own start-up (assumed)."""

REBOOT_DELAY_S = 0.02
"""Seconds between the answer to `Reboot` and the reset, so that the answer gets out."""

STATUS_PERIOD_S = 1.0
"""Seconds between `Status` messages, sent from boot on whether streaming or not."""

MAX_QUEUED_CYCLES = 8
"""Most cycles of samples that wait to be sent: 80 ms at 100 Hz and about 5 KiB for 80 taxels, what
a small microcontroller can spare. The oldest are dropped and counted as overruns."""

MAX_QUEUED_REPLIES = 32
"""Most replies, status and log lines that wait; more than a host may have outstanding."""

LOG_INFO = 20
"""Level of an informative `Log`."""

HOST_BIT = 0x80
"""Bit set in the type of everything that a host sends. Other unknown types are newer boards'."""


class ResetCause(IntEnum):
    """Values of ``reset_cause`` in a `Status`."""

    POWER_ON = 0
    COMMAND = 1
    WATCHDOG = 2
    BROWN_OUT = 3


@dataclass(frozen=True, slots=True)
class Identity:
    """Identity that a board reports. ``unique_id``: 8 bytes."""

    unique_id: bytes
    model: str
    firmware: str = FIRMWARE


@dataclass(slots=True)
class _Run:
    """All state that a reset clears."""

    clock: BoardClock
    cause: ResetCause
    booted: Instant
    ready: Instant
    next_status: Instant
    streaming: bool = False
    sequence: int = 0
    next_start: float = 0.0  # ticks at which the next conversion begins
    reboot_at: Instant | None = None
    count: Counter[str] = field(default_factory=Counter)
    replies: deque[Message] = field(default_factory=lambda: deque(maxlen=MAX_QUEUED_REPLIES))
    cycles: deque[tuple[Samples, ...]] = field(default_factory=deque)


class Controller:
    """Boots at the first instant it is given and streams nothing until `Start`.

    If the host falls silent, the board goes on streaming: it cannot tell a busy host from a dead
    one, and a host that comes back must not find it stopped.
    """

    def __init__(
        self,
        sampler: Sampler,
        identity: Identity,
        clock: ClockParameters,
        plan: FaultPlan,
        rate: float = DEFAULT_RATE_HZ,
    ) -> None:
        self.sampler = sampler
        self.identity = identity
        self.registers = Registers(sampler.skin, rate)
        self._clock = clock
        self._resets = deque(sorted(plan.reset))
        self._power_on: Instant | None = None
        self._now = Instant(0)
        self._total: Counter[str] = Counter()
        self._run = self._fresh(Instant(0), ResetCause.POWER_ON)

    # Inputs

    def seconds(self, now: Instant) -> float:
        """Seconds since power-on."""
        return 0.0 if self._power_on is None else seconds_between(self._power_on, now)

    def handle(self, message: Message | FloatSamples, now: Instant) -> None:
        """Obey a command that arrived at ``now``; the answer waits for `take`."""
        self.advance(now)
        run = self._run
        if now < run.ready:
            return
        if len(run.replies) == MAX_QUEUED_REPLIES:
            # No room for an answer: the command is not obeyed either, so the host repeats it.
            self.count_rejected(1)
            return
        match message:
            case Identify():
                self._reply(self.descriptor())
            case ClockPoll(token):
                # The second stamp is set when the reply leaves.
                self._reply(ClockReply(token, run.clock.wire(now), 0))
            case Start(request):
                if not run.streaming:
                    run.streaming = True
                    run.next_start = run.clock.ticks(now)
                self._answer(message, request, AckResult.OK)
            case Stop(request):
                run.streaming = False
                self._answer(message, request, AckResult.OK)
            case SetRate(request, rate_mhz):
                result = self.registers.set_rate(rate_mhz)
                self._answer(message, request, result)
                self._restart_conversion(result, now)
            case SetGain(request):
                result = self.registers.set_gain(message)
                self._answer(message, request, result)
                self._restart_conversion(result, now)
            case Reboot(request):
                run.reboot_at = after(now, REBOOT_DELAY_S)
                self._answer(message, request, AckResult.OK)
            case _:
                # Only boards send these: another board on the bus, or an echo of the line.
                self.count_rejected(1)

    def refuse(self, command: int, request: int, now: Instant) -> None:
        """Answer a command of a type that this firmware does not know."""
        self.advance(now)
        room = len(self._run.replies) < MAX_QUEUED_REPLIES
        if now >= self._run.ready and command & HOST_BIT and room:
            self._reply(Ack(command, request, AckResult.UNKNOWN_COMMAND))

    def count_rejected(self, frames: int) -> None:
        """Count input that the decoder refused."""
        self._note("rx_errors", frames)

    # Outputs

    def advance(self, now: Instant) -> None:
        """Do everything that is due up to ``now``, in order; ValueError if time goes back."""
        if self._power_on is None:
            self._power_on = self._now = now
            self._run = self._boot(now, ResetCause.POWER_ON)
        if now < self._now:
            raise ValueError(f"time went back by {seconds_between(now, self._now)} s")
        while True:
            reset, cause = self._next_reset()
            cycle = self._cycle_end()
            due = min(reset, cycle, self._run.next_status)
            if due > now:
                break
            self._now = Instant(int(due))
            if due == reset:
                if cause is ResetCause.WATCHDOG:
                    self._resets.popleft()
                self._total["reset"] += 1
                self._run = self._boot(self._now, cause)
            elif due == cycle:
                self._cycle(self._now, now)
            else:
                self._status(self._now)
        self._now = now

    def take(self, now: Instant) -> list[Message]:
        """Next messages to send, replies before samples; empty if there is nothing to send."""
        run = self._run
        if now < run.ready:
            return []
        if run.replies:
            message = run.replies.popleft()
            if isinstance(message, ClockReply):
                message = replace(message, ticks_sent=run.clock.wire(now))
            return [message]
        return list(run.cycles.popleft()) if run.cycles else []

    def descriptor(self) -> Descriptor:
        """Descriptor of the board with its present settings."""
        return Descriptor(
            PROTOCOL_MAJOR,
            PROTOCOL_MINOR,
            self.identity.unique_id,
            self.identity.model,
            self.identity.firmware,
            self._clock.tick_hz,
            self.registers.max_rate_mhz,
            self.registers.arrays(),
        )

    @property
    def counters(self) -> dict[str, int]:
        """Counts by name since power-on, across resets."""
        names = ("cycles", "overruns", "chip_errors", "rx_errors", "replies_dropped", "reset")
        return {**{name: self._total[name] for name in names}, **self.sampler.fault_counters}

    # Inside

    def _fresh(self, now: Instant, cause: ResetCause) -> _Run:
        start = self._clock.start_ticks if cause is ResetCause.POWER_ON else 0
        clock = BoardClock(replace(self._clock, start_ticks=start), now)
        clock.warm(now, self.sampler.temperature_c)
        ready = after(now, BOOT_S)
        return _Run(clock, cause, now, ready, after(ready, STATUS_PERIOD_S))

    def _boot(self, now: Instant, cause: ResetCause) -> _Run:
        """Start again with nothing kept but the skin, which a reset does not touch."""
        self.registers.restore()
        run = self._fresh(now, cause)
        text = f"{self.identity.model} {self.identity.firmware} up, reset: {cause.name.lower()}"
        run.replies.append(Log(LOG_INFO, run.clock.wire(run.ready), text))
        return run

    def _next_reset(self) -> tuple[float, ResetCause]:
        commanded = self._run.reboot_at
        planned = math.inf
        if self._resets and self._power_on is not None:
            planned = after(self._power_on, self._resets[0])
        if commanded is None or planned <= commanded:
            return planned, ResetCause.WATCHDOG
        return commanded, ResetCause.COMMAND

    def _cycle_end(self) -> float:
        """Instant at which the present conversion ends; inf while stopped."""
        run = self._run
        if not run.streaming:
            return math.inf
        ticks = self.registers.conversion_time * self._clock.tick_hz
        return max(run.clock.instant(run.next_start + ticks), self._now)

    def _cycle(self, end: Instant, now: Instant) -> None:
        """Finish the conversion that ends at ``end`` and queue its samples."""
        run = self._run
        started = int(run.next_start) & TICK_MASK
        period = self._clock.tick_hz * 1000.0 / self.registers.rate_mhz
        run.next_start += period
        sequence = run.sequence
        run.sequence = (sequence + 1) & 0xFFFF_FFFF
        self._note("cycles")
        if run.clock.ticks(now) - run.clock.ticks(end) >= MAX_QUEUED_CYCLES * period:
            # Nobody took samples for so long that these would be dropped before being sent.
            self._note("overruns")
            return
        reading = self.sampler.read(end, self.seconds(end))
        run.clock.warm(end, self.sampler.temperature_c)
        self._note("chip_errors", int(np.count_nonzero(reading.status & TaxelStatus.READ_FAILED)))
        if len(run.cycles) == MAX_QUEUED_CYCLES:
            run.cycles.popleft()
            self._note("overruns")
        run.cycles.append(self._samples(reading, sequence, started))

    def _samples(self, reading: Reading, sequence: int, ticks: int) -> tuple[Samples, ...]:
        out = []
        for number, taxels in enumerate(self.sampler.skin.geometry.slices):
            mean_c = float(reading.temperature_c[taxels].mean())
            out.append(
                Samples(
                    number,
                    sequence,
                    ticks,
                    min(max(round(mean_c * 100), -32768), 32767),
                    reading.counts[taxels],
                    reading.status[taxels],
                )
            )
        return tuple(out)

    def _status(self, due: Instant) -> None:
        run = self._run
        run.next_status = after(due, STATUS_PERIOD_S)
        self._reply(
            Status(
                uptime_ms=int(1000 * seconds_between(run.booted, due)),
                cycles=run.count["cycles"],
                overruns=run.count["overruns"],
                rx_errors=run.count["rx_errors"],
                chip_errors=run.count["chip_errors"],
                rate_mhz=self.registers.rate_mhz if run.streaming else 0,
                reset_cause=run.cause,
            )
        )

    def _restart_conversion(self, result: AckResult, now: Instant) -> None:
        """After a change of settings, drop what was measured with the old ones."""
        if result is not AckResult.OK:
            return
        run = self._run
        run.next_start = run.clock.ticks(now)
        # Waiting samples have the old scale; sent after the answer they would be misread.
        self._note("overruns", len(run.cycles))
        run.cycles.clear()

    def _note(self, name: str, amount: int = 1) -> None:
        self._run.count[name] += amount
        self._total[name] += amount

    def _reply(self, message: Message) -> None:
        if len(self._run.replies) == MAX_QUEUED_REPLIES:
            self._note("replies_dropped")
        self._run.replies.append(message)

    def _answer(self, command: Message, request: int, result: AckResult) -> None:
        self._reply(Ack(message_type(command), request, result))


# Simulated boards on a serial line and on a CAN bus: `receive` takes what the host sends, `tick`
# gives what the board sends.
#
# Boards own no clock, port or thread. Whoever drives one calls `receive` with what arrived and
# `tick` at least every few milliseconds, with instants that never go back. Not calling `tick` is
# the back-pressure of a full port: the board then overruns, as a real one does.


BURST_SECONDS = 0.05
"""Seconds' worth of a limited line that may go out at once after it was idle."""


class BoardOptions(TypedDict, total=False):
    """Options of any board when it is made; all may be left out."""

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
            options.get("rate", DEFAULT_RATE_HZ),
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
        """Descriptor of the board with its present settings."""
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
        # An idle line, and what others send on the bus, are not frames from the host.
        passed = (
            counters[ACCEPTED] + counters.get(Reject.EMPTY, 0) + counters.get(Reject.FOREIGN, 0)
        )
        rejected = sum(counters.values()) - passed
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
        """As for every board; frames are counted whole."""
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
        """As for every board; CAN frames are counted, not transfers."""
        return self._counters(self._wire.counters)

    def receive(self, frames: Iterable[CanFrame], now: Instant) -> None:
        """Take frames from the bus; those to and from other boards are ignored."""
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
