"""A USB-CAN adapter that speaks slcan, on top of a serial port.

python-can's own slcan driver reads byte by byte (some 5,000 frames/s with a full core), sleeps 2 s
after opening and lets a second process open the same adapter. This one reads everything available
at once and keeps the properties of `SerialTransport`: exclusive, found again by USB serial number,
woken at once when closed or unplugged.
"""

from __future__ import annotations

import logging
from collections import deque

from sensor_proto import can_transfers, slcan
from sensor_proto.can_transfers import BusState, CanFrame
from tactile_core.can_bus import DEFAULT_BITRATE, DEFAULT_DATA_BITRATE, CanSpec
from tactile_core.types import Instant, after, monotonic_now, seconds_between
from tactiled.blocks import Chunk
from tactiled.transports.base import PortUnsuitable
from tactiled.transports.serial_port import SerialTransport

log = logging.getLogger(__name__)

ANSWER_TIME = 0.4
"""s for an adapter to answer a command; over USB it takes a few milliseconds, on a busy host more.
Some firmware never answers: it is opened so much later, and traffic then shows an adapter."""

MARK = b"N\r"
"""Command with a unique answer: every line before it belongs to earlier commands, however late and
however many."""

SILENCE = 0.08
"""s without a frame after which the adapter's flags are requested: this finds bus-off in 0.1 s even
with adapters that do not report it, and never disturbs a busy one."""


def slcan_commands(spec: CanSpec) -> tuple[bytes, ...]:
    """Commands that set the bit rates of ``spec``; ValueError lists the allowed rates."""
    bitrate = spec.bitrate or DEFAULT_BITRATE
    if bitrate not in slcan.BITRATES:
        raise ValueError(
            f"{spec} asks for {bitrate} bit/s; an slcan adapter has "
            f"{', '.join(map(str, slcan.BITRATES))}"
        )
    if not spec.fd:
        return (slcan.BITRATES[bitrate],)
    data_bitrate = spec.data_bitrate or DEFAULT_DATA_BITRATE
    if data_bitrate not in slcan.DATA_BITRATES:
        raise ValueError(
            f"{spec} asks for {data_bitrate} bit/s of data; an slcan adapter has "
            f"{', '.join(map(str, slcan.DATA_BITRATES))}"
        )
    return slcan.BITRATES[bitrate], slcan.DATA_BITRATES[data_bitrate]


class SlcanLink:
    """Frames through one adapter; see `CanLink` for the contract."""

    def __init__(self, spec: CanSpec, answer_time: float = ANSWER_TIME) -> None:
        self._spec = spec
        self._answer_time = answer_time
        self._setup = slcan_commands(spec)
        self.port = SerialTransport(spec.channel)
        self._decoder = slcan.SlcanDecoder()
        self._tells_flags = False
        self._told = BusState.ACTIVE
        self._last = Instant(0)
        self._pending: list[CanFrame] = []
        self._asked = Instant(0)
        self._unanswered: deque[bytes] = deque()
        self._marked = False

    @property
    def losses(self) -> dict[str, int]:
        """Counts of bytes not written and lines not understood."""
        return self.port.losses | self._decoder.counters

    def open(self) -> None:
        """Open port and channel; `TransportError`, also when the device is not an adapter.

        An adapter that does not answer is opened all the same.
        """
        self.port.open()
        self._decoder.reset()
        self._pending.clear()
        self._unanswered.clear()
        self._tells_flags = self._marked = False
        self._told = BusState.ACTIVE
        try:
            self._open_channel()
        except BaseException:  # also Ctrl-C must not leave the port open
            self.port.close()
            raise
        self._last = monotonic_now()

    def close(self) -> None:
        """Close the adapter's channel, then the port."""
        if self.port.device is not None:
            self.port.write(b"C\r")
        self.port.close()

    def receive(self, timeout: float) -> tuple[Instant, list[CanFrame]] | None:
        """Instant of the read and its frames, including error frames; None after ``timeout`` s."""
        if self._pending:
            frames, self._pending = self._pending, []
            return monotonic_now(), frames
        start = monotonic_now()
        while True:
            left = timeout - seconds_between(start, monotonic_now())
            wait = min(left, SILENCE) if self._tells_flags else left
            chunk = self.port.read(max(0.0, wait))
            if chunk is not None:
                frames = self._decode(chunk)
                if self._unanswered:
                    self._hear_late(chunk.received)
                if frames:
                    self._last = chunk.received
                    return chunk.received, frames
            now = monotonic_now()
            if self._tells_flags and now >= after(self._last, SILENCE):
                self.port.write(b"F\r")
                self._last = now
            if left <= 0:
                return None

    def send(self, frames: tuple[CanFrame, ...]) -> None:
        """Send frames in order; ValueError for frames that no adapter can send."""
        self.port.write(b"".join(map(slcan.encode_frame, frames)))

    def restart(self) -> None:
        """Leave bus-off by closing and opening the channel."""
        self.port.write(b"C\rO\r")

    def _decode(self, chunk: Chunk) -> list[CanFrame]:
        """Frames of a serial chunk, without repeated reports of a state."""
        if not isinstance(chunk.payload, bytes):
            raise TypeError("a serial chunk holds bytes")
        frames = []
        for frame in self._decoder.feed(chunk.payload):
            state = can_transfers.reported_state(frame) if frame.error else None
            if state is None or state is not self._told:
                frames.append(frame)
            if not frame.error and self._told is BusState.BUS_OFF:
                state = BusState.ACTIVE  # no frames arrive during bus-off
            self._told = state or self._told
        return frames

    def _open_channel(self) -> None:
        known = self._decoder.counters
        # Empty lines end a command left unfinished by a previous owner. A closed channel refuses C.
        self._asked = monotonic_now()
        answers = self._collect(b"\r\rC\r" + MARK, self._answer_time)
        commands = (*self._setup, b"O")
        if answers and answers[-1][:1] == MARK[:1]:
            wait = self._answer_time + 2 * seconds_between(self._asked, monotonic_now())
            for command in commands:
                self._judge(command, self._collect(command + slcan.CR + MARK, wait))
            answers = self._collect(b"F\r" + MARK, wait)
        elif answers:
            # The adapter does not know the command N, so only prompt answers can be matched.
            while self._collect(b"", self._answer_time):
                pass
            for command in commands:
                self._judge(command, self._collect(command + slcan.CR, self._answer_time, 1))
            answers = self._collect(b"F\r", self._answer_time, 1)
        elif self._pending or self._decoder.counters == known:
            log.warning(
                "the adapter on %s answers no command, as some firmware never does; opened as %s "
                "all the same",
                self._spec.channel,
                self._spec,
            )
            self._unanswered.extend(commands)
            for command in commands:
                self.port.write(command + slcan.CR)
        else:
            raise PortUnsuitable(
                f"{self._spec.channel} sends what no slcan adapter sends",
                "give the adapter's port; a board on a serial line is opened with --port",
            )
        self._tells_flags = any(slcan.flags_of(answer) is not None for answer in answers)

    def _judge(self, command: bytes, answers: list[bytes]) -> None:
        """Raise `PortUnsuitable` when the adapter refused ``command``."""
        if slcan.BEL in answers:
            raise PortUnsuitable(self._refused(command), self._remedy())

    def _refused(self, command: bytes) -> str:
        return (
            f"the adapter on {self._spec.channel} refuses the command "
            f"{command.decode('ascii')} of {self._spec}"
        )

    def _remedy(self) -> str:
        fd = ", or leave +fd out" if self._spec.fd else ""
        return f"give a bit rate it has{fd}; plug it out and in when it hangs"

    def _collect(self, command: bytes, wait: float, wanted: int | None = None) -> list[bytes]:
        """Send ``command``; return the answers up to `MARK`'s, to ``wanted`` ones, or in ``wait``
        s."""
        self._decoder.answers.clear()
        if command:
            self.port.write(command)
        answers: list[bytes] = []
        start = monotonic_now()
        while True:
            while self._decoder.answers:
                answers.append(self._decoder.answers.popleft())
                if answers[-1][:1] == MARK[:1] or len(answers) == wanted:
                    return answers
            left = wait - seconds_between(start, monotonic_now())
            chunk = self.port.read(left) if left > 0 else None
            if chunk is None:
                return answers
            self._pending += self._decode(chunk)

    def _hear_late(self, now: Instant) -> None:
        """Match late answers, after opening: first that of the mark, then those of the commands."""
        answers = self._decoder.answers
        while answers and self._unanswered:
            answer = answers.popleft()
            if not self._marked:
                self._marked = answer[:1] == MARK[:1]
                if self._marked:
                    late = seconds_between(self._asked, now)
                    log.warning("the adapter on %s answers %.1f s late", self._spec.channel, late)
                continue
            command = self._unanswered.popleft()
            if answer == slcan.BEL:
                log.error("%s; %s", self._refused(command), self._remedy())
