"""State machine of one board that speaks our protocol, from the first Identify to streaming.

Pure: messages and instants in; events, and messages to send, out. No data of a board is used before
it has identified itself and was admitted, neither at the start nor after a reset or a silence.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum, auto

import numpy as np

from sensor_proto.packets import (
    PROTOCOL_MAJOR,
    PROTOCOL_MINOR,
    Ack,
    AckResult,
    ArrayDescriptor,
    ClockPoll,
    ClockReply,
    Descriptor,
    HostMessage,
    Identify,
    Log,
    Message,
    Samples,
    SetRate,
    Start,
    Status,
    Stop,
)
from tactile_core.types import Instant, after, seconds_between
from tactiled.blocks import SampleBlock
from tactiled.boards.clock import WORST_ERROR_S, ClockMap, Pace, Stamp, StepWatch
from tactiled.boards.events import (
    RESET_CAUSES,
    Answered,
    BoardLog,
    ClockJudged,
    Event,
    FellSilent,
    Identified,
    Identity,
    Refusal,
    Refused,
    Reported,
    Reset,
    Resumed,
    Sampled,
    Streaming,
)

# Exact count of the frames of one array: received, duplicate and missing.


HISTORY = 64
"""Sequence numbers remembered behind the newest: far more than any medium reorders."""

WRAP = 1 << 32
"""Number of sequence numbers, which are 32 bits."""


class Verdict(Enum):
    """What the sequence number of a frame shows."""

    FRESH = auto()
    DUPLICATE = auto()
    LATE = auto()  # fills a gap, but newer frames have been used already
    FOREIGN = auto()  # further back than reordering explains: the board has restarted


class SequenceTracker:
    """Tracks the 32-bit sequence numbers of one array.

    Counters, which `restart` keeps: ``accepted``, ``missing`` (in a gap and never received),
    ``duplicate``, ``late``; sent = accepted + late + missing.
    """

    def __init__(self) -> None:
        self.accepted = self.missing = self.duplicate = self.late = 0
        self._newest: int | None = None
        self._unsure = False
        self._seen = 0  # bit i: newest - i came

    def restart(self) -> None:
        """Accept any number next; the counters are kept."""
        self._newest = None

    def resume(self) -> None:
        """Note that the board was away: if the next number is not newer, it has restarted."""
        self._unsure = True

    def take(self, sequence: int) -> Verdict:
        """Judge and count one frame; FOREIGN ones are not counted."""
        unsure, self._unsure = self._unsure, False
        if self._newest is None or (unsure and (sequence - self._newest) % WRAP >= WRAP // 2):
            self._newest, self._seen = sequence, (1 << HISTORY) - 1
            self.accepted += 1
            return Verdict.FRESH
        ahead = (sequence - self._newest) % WRAP
        if 0 < ahead < WRAP // 2:
            self.missing += ahead - 1
            self._seen = 1 if ahead >= HISTORY else (self._seen << ahead | 1) & ((1 << HISTORY) - 1)
            self._newest = sequence
            self.accepted += 1
            return Verdict.FRESH
        behind = (self._newest - sequence) % WRAP
        if behind >= HISTORY:
            return Verdict.FOREIGN
        if self._seen >> behind & 1:
            self.duplicate += 1
            return Verdict.DUPLICATE
        self._seen |= 1 << behind
        self.missing -= 1
        self.late += 1
        return Verdict.LATE


# Intake of samples: counts them, scales them to µT, and stamps them in order. Pure.


class ArrayIntake:
    """Intake of one array; survives resets of the board, so that its counts continue."""

    def __init__(self) -> None:
        self.tracker = SequenceTracker()
        self.steps = StepWatch()
        self._index = self._taxels = 0
        self._lsb_ut = (1.0, 1.0)
        self._scale = np.ones(3)
        self._captured = Instant(0)

    def describe(self, index: int, array: ArrayDescriptor) -> None:
        """Take the array's description; ``index``: its position in the descriptor."""
        self._index, self._taxels = index, array.taxels
        self._lsb_ut = array.lsb_xy_nt * 1e-3, array.lsb_z_nt * 1e-3
        self._scale = np.array([self._lsb_ut[0], self._lsb_ut[0], self._lsb_ut[1]])

    def fits(self, message: Samples) -> bool:
        """Whether the message has as many taxels as the descriptor."""
        return len(message.field) == self._taxels

    def block(
        self, message: Samples, stamp: Stamp, arrival: Instant, clock_usable: bool = True
    ) -> SampleBlock:
        """Convert samples to µT. Their stamp is always after that of earlier ones.

        If that moves the stamp, the shift is added to its uncertainty.
        """
        captured = Instant(max(stamp.captured, min(self._captured + 1, arrival)))
        self._captured = captured
        return SampleBlock(
            array=self._index,
            sequence=message.sequence,
            captured=captured,
            received=arrival,
            uncertainty=stamp.uncertainty + seconds_between(stamp.captured, captured),
            clock_usable=clock_usable,
            field_ut=message.field * self._scale,
            temperature_c=np.array([message.temperature_cc / 100]),
            status=message.status,
            lsb_ut=self._lsb_ut,
        )


# Commands to a board: sent one at a time, repeated until answered or given up. Pure.


COMMAND_RETRY = 0.2
"""s to wait for an answer: longer than any answer takes over a 115 200 baud line."""

COMMAND_TRIES = 5
"""Times that a command is sent before it is given up."""

COMMANDS = 8
"""Most commands that may wait: what a person can request within a second."""

REQUESTS = 1 << 16
"""Number of request numbers, which are 16 bits on the wire."""


@dataclass(slots=True)
class Command:
    """A command under way. ``own``: sent by the link itself, not requested from outside."""

    message: HostMessage
    request: int
    own: bool
    due: Instant
    tries: int = 0


class CommandQueue:
    """Sends commands in order and matches answers; ``send`` is called with each message."""

    def __init__(self, send: Callable[[HostMessage], None]) -> None:
        self._send = send
        self._waiting: deque[Command] = deque()
        self._request = 0

    @property
    def full(self) -> bool:
        """Whether no further command may be pushed."""
        return len(self._waiting) >= COMMANDS

    def next_request(self) -> int:
        """Next request number."""
        self._request = (self._request + 1) % REQUESTS
        return self._request

    def push(self, make: Callable[[int], HostMessage], now: Instant, own: bool) -> int:
        """Queue a command and return its number; ValueError when the queue is full."""
        if self.full:
            raise ValueError(f"{COMMANDS} commands are waiting for the board already")
        number = self.next_request()
        self._waiting.append(Command(make(number), number, own, now))
        self._start(now)
        return number

    def clear(self) -> list[Command]:
        """Remove all commands and return them."""
        dropped = list(self._waiting)
        self._waiting.clear()
        return dropped

    def answered(self, ack: Ack, now: Instant) -> Command | None:
        """Remove and return the command that ``ack`` answers; None if repeated or late."""
        if not self._waiting or ack.request != self._waiting[0].request:
            return None
        head = self._waiting.popleft()
        self._start(now)
        return head

    def drive(self, now: Instant) -> Command | None:
        """Repeat the command under way when due; returns it when it is given up."""
        if not self._waiting or now < self._waiting[0].due:
            return None
        head = self._waiting[0]
        if head.tries < COMMAND_TRIES:
            head.tries, head.due = head.tries + 1, after(now, COMMAND_RETRY)
            self._send(head.message)
            return None
        self._waiting.popleft()
        self._start(now)
        return head

    def _start(self, now: Instant) -> None:
        if self._waiting and self._waiting[0].tries == 0:
            head = self._waiting[0]
            head.tries, head.due = 1, after(now, COMMAND_RETRY)
            self._send(head.message)


IDENTIFY_FIRST = 0.1
"""s from the first Identify to the second; doubles up to `IDENTIFY_SLOWEST`."""

IDENTIFY_SLOWEST = 1.0
"""s between attempts to reach a silent board: data must be back 2 s after a replug."""

REFUSED_RETRY = 2.0
"""s between questions to a refused board, which may have been exchanged for the right one."""

KEEPALIVE = 10.0
"""s between questions to a board in service. They reveal an exchanged board, and put a descriptor
into every log file so that it can be replayed alone."""

POLL_AT_ONCE = 0.02
"""s between clock polls while the map is new or in doubt; one answer settles most doubts."""

POLL_FAST = 0.1
"""s between clock polls at first."""

POLL_FAST_FOR = 2.0
"""s for which polls are fast: long enough for the regression to settle."""

POLL_SLOW = 0.25
"""s between clock polls afterwards: two for every bucket of the regression."""

RELINK = 1.0
"""s without samples (or three periods, if longer) after which the board is identified again."""

JUDGE_CLOCK = 0.25
"""s between checks whether the clock is usable."""

Admission = Callable[[Identity], Refusal | None]
"""Judges a board by its identity; None: admitted."""


class State(Enum):
    """State of a link."""

    DOWN = auto()
    IDENTIFYING = auto()
    CONFIGURING = auto()
    STREAMING = auto()
    REFUSED = auto()


class BoardLink:
    """State machine of one board. ``rate``: Hz; None: the board's own.

    ``listen_only``: for recordings, which do not answer: a descriptor is enough to bring the board
    into service, and its clock is mapped by arrivals alone.
    ``counters``: samples dropped here, by reason. ``arrays``: intakes by array number.
    """

    def __init__(
        self, admit: Admission, rate: float | None = None, listen_only: bool = False
    ) -> None:
        self._admit = admit
        self.rate = None if listen_only else rate
        self._listen_only = listen_only
        self.state = State.DOWN
        self.identity: Identity | None = None
        self.descriptor: Descriptor | None = None
        self.status: Status | None = None
        self.clock: ClockMap | None = None
        self.arrays: dict[int, ArrayIntake] = {}
        self.counters: Counter[str] = Counter()
        self._out: list[HostMessage] = []
        self._commands = CommandQueue(lambda message: self._out.append(message))
        self._token = 0
        self._refusal: Refusal | None = None
        self._identify_due = self._poll_due = self._poll_fast_until = Instant(0)
        self._identify_wait = IDENTIFY_FIRST
        self._last_sample = self._started = Instant(0)
        self._silent = False
        self._resuming = False
        self._pace = Pace()
        self._clock_trouble = ""
        self._judge_due = Instant(0)

    @property
    def silence_limit(self) -> float:
        """Silence considered normal, s."""
        said = None if self.status is None else self.status.rate_mhz / 1000
        return self._pace.silence_limit(self.rate, said)

    @property
    def relink_limit(self) -> float:
        """Silence after which the board is identified again, s."""
        return max(RELINK, self._pace.silence_limit(self.rate))

    @property
    def clock_trouble(self) -> str:
        """Why the board's clock is unusable; empty while it is usable."""
        return self._clock_trouble

    # Inputs

    def connect(self, now: Instant) -> None:
        """Start: the line is open. Asks the board to identify itself."""
        self._identify(now)

    def disconnect(self) -> list[Event]:
        """Stop: the line is closed. Gives up waiting commands."""
        self.state = State.DOWN
        self._out.clear()
        return self._drop_commands()

    def retry(self, now: Instant) -> None:
        """Judge a refused board again, at once."""
        if self.state is State.REFUSED:
            self._refusal = None
            self._identify_due = now

    def request(self, make: Callable[[int], HostMessage], now: Instant) -> int:
        """Queue a command and return its number, which `Answered` will repeat.

        ValueError when the board is not in service or too many commands are waiting.
        """
        if self.state not in (State.CONFIGURING, State.STREAMING):
            raise ValueError(f"the board is {self.state.name.lower()}, not in service")
        return self._commands.push(make, now, own=False)

    def stop_streaming(self) -> None:
        """Tell the board to stop streaming, without waiting for an answer."""
        if self.state in (State.CONFIGURING, State.STREAMING):
            self._out.append(Stop(self._commands.next_request()))

    def outgoing(self) -> list[HostMessage]:
        """Remove and return the messages to send."""
        out, self._out = self._out, []
        return out

    def receive(self, message: Message, arrival: Instant) -> list[Event]:
        """Process a message whose last byte came at ``arrival``."""
        match message:
            case Samples():
                return self._on_samples(message, arrival)
            case ClockReply():
                if self.clock is not None:
                    self.clock.replied(message, arrival)
            case Descriptor():
                return self._on_descriptor(message, arrival)
            case Status():
                return self._on_status(message, arrival)
            case Ack():
                return self._on_ack(message, arrival)
            case Log():
                captured = arrival
                if self.clock is not None:
                    captured = self.clock.place(message.ticks, arrival)
                return [BoardLog(message.level, captured, message.text)]
            case _:
                self.counters["from_host"] += 1  # an echo: only hosts send such messages
        return []

    def tick(self, now: Instant) -> list[Event]:
        """Do what is due: repeat questions and commands, poll the clock, notice silence."""
        if self.state is State.DOWN:
            return []
        if self._listen_only:
            return self._watch_silence(now) if self.state is State.STREAMING else []
        if now >= self._identify_due:
            self._ask(now)
        if self.state not in (State.CONFIGURING, State.STREAMING):
            return []
        if self.clock is not None and now >= self._poll_due:
            fast = now < self._poll_fast_until
            pause = POLL_FAST if fast else POLL_SLOW
            self._poll_due = after(now, POLL_AT_ONCE if self.clock.unsettled else pause)
            self._token = (self._token + 1) % (1 << 32)
            self.clock.polled(self._token, now)
            self._out.append(ClockPoll(self._token))
        events = self._drive_commands(now)
        if self.state is State.STREAMING:
            events += self._watch_silence(now)
        return events

    # Identification

    def _identify(self, now: Instant) -> list[Event]:
        self.state = State.IDENTIFYING
        self._identify_wait = IDENTIFY_FIRST
        self._ask(now)
        return self._drop_commands()

    def _ask(self, now: Instant) -> None:
        if self._listen_only:
            return
        self._out.append(Identify(self._commands.next_request()))
        if self.state is State.IDENTIFYING:
            wait = self._identify_wait
            self._identify_wait = min(2 * wait, IDENTIFY_SLOWEST)
        else:
            wait = REFUSED_RETRY if self.state is State.REFUSED else KEEPALIVE
        self._identify_due = after(now, wait)

    def _on_descriptor(self, message: Descriptor, now: Instant) -> list[Event]:
        refusal = self._judge(message)
        if refusal is not None:
            return self._refuse(refusal, now)
        events: list[Event] = []
        in_service = self.state in (State.CONFIGURING, State.STREAMING)
        if in_service:
            if message == self.descriptor and not self._has_stopped_streaming(now):
                return []  # the answer to the keepalive or to another host
            events = [Reset(self._describe_change(message)), *self._drop_commands()]
        identity = self._put_into_service(message, now, rebooted=in_service)
        events.append(Identified(identity, rebooted=in_service))
        if self._listen_only:
            self.state, self._refusal, self._started = State.STREAMING, None, now
            events.append(Streaming(None))
        return events

    def _has_stopped_streaming(self, now: Instant) -> bool:
        """Whether a board that still answers has stopped streaming, and is not just slow."""
        quiet = seconds_between(max(self._last_sample, self._started), now)
        return self._silent and (self._pace.period is not None or quiet >= self.relink_limit)

    def _describe_change(self, message: Descriptor) -> str:
        before = self.descriptor
        if message == before or before is None:
            return "it answers, but has ceased to stream"
        if message.tick_hz != before.tick_hz:
            return (
                f"it describes itself anew, its clock at {message.tick_hz} ticks a second "
                f"(before: {before.tick_hz})"
            )
        return "it describes itself anew"

    def _judge(self, message: Descriptor) -> Refusal | None:
        serial = message.serial_number
        if message.major != PROTOCOL_MAJOR:
            return Refusal(
                f"{message.model} board {serial} speaks protocol {message.major}.{message.minor}, "
                f"this host {PROTOCOL_MAJOR}.{PROTOCOL_MINOR}",
                "update the older of the two: firmware or host",
            )
        if self.identity is not None and self.identity.serial_number != serial:
            return Refusal(
                f"{message.model} board {serial} answers where {self.identity} was before",
                f"plug {self.identity.serial_number} in again, or restart tactiled for {serial}",
            )
        identity = Identity.of(message)
        if (
            self.rate is not None
            and identity.max_rate is not None
            and self.rate > identity.max_rate
        ):
            return Refusal(
                f"{identity} takes at most {identity.max_rate:g} Hz, not {self.rate:g} Hz",
                f"give --rate {identity.max_rate:g} or less",
            )
        return self._admit(identity)

    def _put_into_service(self, message: Descriptor, now: Instant, rebooted: bool) -> Identity:
        identity = Identity.of(message)
        self.descriptor, self.identity = message, identity
        if self.clock is None:
            self.clock = ClockMap(message.tick_hz)
        else:
            self.clock.restart(message.tick_hz)
        self._pace.restart()
        for number in set(self.arrays) - {a.array for a in message.arrays}:
            del self.arrays[number]
        for index, a in enumerate(message.arrays):
            intake = self.arrays.setdefault(a.array, ArrayIntake())
            intake.describe(index, a)
            intake.steps.restart()
            if rebooted:
                intake.tracker.restart()
            else:
                intake.tracker.resume()
        self.status = None
        self.state, self._silent = State.CONFIGURING, False
        self._identify_due = after(now, KEEPALIVE)
        self._poll_due, self._poll_fast_until = now, after(now, POLL_FAST_FOR)
        if self._listen_only:
            return identity
        if self.rate is not None:
            mhz = round(self.rate * 1000)
            self._commands.push(lambda n: SetRate(n, mhz), now, own=True)
        self._commands.push(Start, now, own=True)
        return identity

    # Commands

    def _drop_commands(self) -> list[Event]:
        return [Answered(c.request, None) for c in self._commands.clear() if not c.own]

    def _drive_commands(self, now: Instant) -> list[Event]:
        given_up = self._commands.drive(now)
        if given_up is None:
            return []
        self.counters["unanswered_commands"] += 1
        if given_up.own:
            return self._identify(now)
        return [Answered(given_up.request, None)]

    def _on_ack(self, ack: Ack, now: Instant) -> list[Event]:
        command = self._commands.answered(ack, now)
        if command is None:
            return []
        message, good = command.message, ack.result is AckResult.OK
        if not command.own:
            if good and isinstance(message, SetRate):
                self.rate = message.rate_mhz / 1000
                self._pace.restart()
                self._started = now  # the first sample at a slow rate takes a while
                for array in self.arrays.values():
                    array.steps.restart()
            return [Answered(command.request, ack)]
        if good:
            if not isinstance(message, Start):
                return []
            self.state, self._refusal = State.STREAMING, None
            self._started = now
            return [Streaming(self.rate)]
        remedy = "give another --rate" if isinstance(message, SetRate) else "power-cycle the board"
        problem = f"{self.identity} answers {type(message).__name__} with {ack.result.name}"
        return self._refuse(Refusal(problem, remedy), now)

    def _refuse(self, refusal: Refusal, now: Instant) -> list[Event]:
        self.state = State.REFUSED
        self._identify_due = after(now, REFUSED_RETRY)
        events = self._drop_commands()
        if refusal != self._refusal:
            self._refusal = refusal
            events.append(Refused(refusal))
        return events

    # Data

    def _on_samples(self, message: Samples, arrival: Instant) -> list[Event]:
        if self.state not in (State.CONFIGURING, State.STREAMING) or self.clock is None:
            self.counters["unidentified"] += 1
            if self.state is State.IDENTIFYING:
                # The board is there: do not wait for the back-off.
                self._identify_due = min(self._identify_due, after(arrival, IDENTIFY_FIRST))
            return []
        array = self.arrays.get(message.array)
        if array is None or not array.fits(message):
            self.counters["wrong_shape"] += 1
            return []
        verdict = array.tracker.take(message.sequence)
        if verdict is Verdict.FOREIGN:
            reset = Reset(f"its sequence fell back to {message.sequence}")
            return [reset, *self._identify(arrival)]
        if verdict is not Verdict.FRESH:
            return []
        clock = self.clock
        odd = array.steps.take(message.sequence, message.ticks)
        if odd > 0:
            clock.doubt(odd, arrival)
        clock.arrived(message.ticks, arrival)
        stamp = clock.stamp(message.ticks, arrival)
        if clock.unsettled:
            self._poll_due = min(self._poll_due, after(arrival, POLL_AT_ONCE))
        events: list[Event] = []
        if self._silent or self._resuming:
            events.append(Resumed(seconds_between(self._last_sample, arrival)))
            self._pace.restart()
        self._silent, self._resuming, self._last_sample = False, False, arrival
        if message.array == next(iter(self.arrays)):
            self._pace.heard(arrival, array.tracker.accepted + array.tracker.missing)
        events += self._judge_clock(clock, arrival)
        usable = not self._clock_trouble and stamp.uncertainty <= WORST_ERROR_S
        events.append(Sampled(array.block(message, stamp, arrival, usable)))
        return events

    def _judge_clock(self, clock: ClockMap, now: Instant) -> list[Event]:
        """Report when the clock becomes unusable or usable again."""
        if now < self._judge_due:
            return []
        self._judge_due = after(now, JUDGE_CLOCK)
        trouble = clock.trouble(now) or ""
        before, self._clock_trouble = self._clock_trouble, trouble
        return [ClockJudged(trouble)] if bool(trouble) != bool(before) else []

    def _on_status(self, message: Status, now: Instant) -> list[Event]:
        before, self.status = self.status, message
        events: list[Event] = [Reported(message)]
        if before is not None and message.uptime_ms < before.uptime_ms:
            cause = RESET_CAUSES.get(message.reset_cause, f"cause {message.reset_cause}")
            events.append(Reset(f"its uptime fell to {message.uptime_ms / 1000:g} s ({cause})"))
            for array in self.arrays.values():
                array.tracker.restart()
            if self.state in (State.CONFIGURING, State.STREAMING):
                events += self._identify(now)
        return events

    def _watch_silence(self, now: Instant) -> list[Event]:
        quiet = seconds_between(max(self._last_sample, self._started), now)
        limit = self.silence_limit
        if quiet < limit:
            return []
        events: list[Event] = []
        if not self._silent:
            self._silent = self._resuming = True
            events.append(FellSilent(quiet))
            self._ask(now)
        if quiet >= max(self.relink_limit, limit):
            events += self._identify(now)
        return events
