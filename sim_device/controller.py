"""The program on a board's microcontroller: commands in, messages out, no medium."""

from __future__ import annotations

import math
from collections import Counter, deque
from dataclasses import dataclass, field, replace
from enum import IntEnum

import numpy as np

from sensor_proto.packets import (
    PROTOCOL_MAJOR,
    PROTOCOL_MINOR,
    Ack,
    AckResult,
    ClockPoll,
    ClockReply,
    Descriptor,
    FloatSamples,
    Identify,
    Log,
    Message,
    Reboot,
    Samples,
    SetGain,
    SetRate,
    Start,
    Status,
    Stop,
    TaxelStatus,
)
from sensor_proto.wire import message_type
from sim_device.board_clock import TICK_MASK, BoardClock, ClockParameters
from sim_device.chips import Reading
from sim_device.faults import FaultPlan
from sim_device.registers import Registers
from sim_device.sampler import Sampler
from tactile_bus.instant import Instant, after, seconds_between

FIRMWARE = "sim 1.0"

DEFAULT_RATE = 100.0
"""Hz after a boot."""

BOOT_TIME = 0.15
"""s from reset to the first word: clocks, then the chips' own start-up (assumed)."""

REBOOT_DELAY = 0.02
"""s between the answer to `Reboot` and the reset, so that the answer gets out."""

STATUS_PERIOD = 1.0
"""s between `Status` messages, sent from boot on whether streaming or not."""

MAX_QUEUED_CYCLES = 8
"""Cycles of samples that wait to be sent: 80 ms at 100 Hz and about 5 KiB for 80 taxels, what a
small microcontroller can spare. The oldest are dropped and counted as overruns."""

MAX_QUEUED_REPLIES = 32
"""Replies, status and log lines that wait; more than a host may have outstanding."""

LOG_INFO = 20

HOST_BIT = 0x80
"""Set in the type of everything that a host sends; other unknown types are of newer boards."""


class ResetCause(IntEnum):
    """``reset_cause`` of a `Status`."""

    POWER_ON = 0
    COMMAND = 1
    WATCHDOG = 2
    BROWN_OUT = 3


@dataclass(frozen=True, slots=True)
class Identity:
    """Who a board says it is. ``unique_id``: 8 bytes."""

    unique_id: bytes
    model: str
    firmware: str = FIRMWARE


@dataclass(slots=True)
class _Run:
    """Everything that a reset forgets."""

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

    A host that falls silent changes nothing: the board goes on streaming, for it cannot tell a
    busy host from a dead one, and whoever comes back must not find it stopped.
    """

    def __init__(
        self,
        sampler: Sampler,
        identity: Identity,
        clock: ClockParameters,
        plan: FaultPlan,
        rate: float = DEFAULT_RATE,
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
        match message:
            case Identify():
                self._reply(self.descriptor())
            case ClockPoll(token):
                # The second stamp is put on when the reply leaves.
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
                run.reboot_at = after(now, REBOOT_DELAY)
                self._answer(message, request, AckResult.OK)
            case _:
                # What only boards send, from another board on the bus or echoed by the line.
                self.count_rejected(1)

    def refuse(self, command: int, request: int, now: Instant) -> None:
        """Answer a command of a type that this firmware does not know."""
        self.advance(now)
        if now >= self._run.ready and command & HOST_BIT:
            self._reply(Ack(command, request, AckResult.UNKNOWN_COMMAND))

    def count_rejected(self, frames: int) -> None:
        """Note input that its decoder refused."""
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
        """Next messages to send, replies before samples; empty when there is nothing to send."""
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
        """What the board says of itself with its present settings."""
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
        """What the board did since power-on, resets included."""
        names = ("cycles", "overruns", "chip_errors", "rx_errors", "replies_dropped", "reset")
        return {**{name: self._total[name] for name in names}, **self.sampler.fault_counters}

    # Inside

    def _fresh(self, now: Instant, cause: ResetCause) -> _Run:
        start = self._clock.start_ticks if cause is ResetCause.POWER_ON else 0
        clock = BoardClock(replace(self._clock, start_ticks=start), now)
        clock.warm(now, self.sampler.temperature_c)
        ready = after(now, BOOT_TIME)
        return _Run(clock, cause, now, ready, after(ready, STATUS_PERIOD))

    def _boot(self, now: Instant, cause: ResetCause) -> _Run:
        """Start again with nothing remembered but the skin, which does not know of resets."""
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
        run.next_status = after(due, STATUS_PERIOD)
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
        """After a change of settings: what was measured with the old ones is given up."""
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
