"""A USB-CAN adapter that speaks slcan, on top of a serial port.

python-can's own slcan driver reads byte by byte (some 5,000 frames/s at a full core), sleeps 2 s
after opening and lets a second process open the same adapter; this one reads all that has come at
once and keeps what `SerialTransport` gives: exclusive, found again by USB serial number, woken at
once when closed or unplugged.
"""

from __future__ import annotations

import logging

from sensor_proto import can_errors, slcan
from sensor_proto.can_errors import BusState
from sensor_proto.canseg import CanFrame
from tactile_bus.can_bus import DEFAULT_BITRATE, DEFAULT_DATA_BITRATE, CanSpec
from tactile_bus.instant import Instant, after, monotonic_now, seconds_between
from tactiled.blocks import Chunk
from tactiled.transports.base import PortUnsuitable
from tactiled.transports.serial_port import SerialTransport

log = logging.getLogger(__name__)

ANSWER_TIME = 0.15
"""s an adapter has to answer a command; those over USB take a few milliseconds."""

SILENCE = 0.08
"""s without a frame after which the adapter is asked for its flags: bus-off is known in 0.1 s even
from adapters that do not tell of it, and a busy one is never asked."""


def slcan_commands(spec: CanSpec) -> tuple[bytes, ...]:
    """Commands that set the bit rates of ``spec``; ValueError names those that adapters have."""
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
    """Frames in both directions through one adapter; see `CanTransport` for the contract."""

    def __init__(self, spec: CanSpec) -> None:
        self._spec = spec
        self._setup = slcan_commands(spec)
        self.port = SerialTransport(spec.channel)
        self._decoder = slcan.SlcanDecoder()
        self._tells_flags = False
        self._told = BusState.ACTIVE
        self._last = Instant(0)
        self._pending: list[CanFrame] = []

    @property
    def losses(self) -> dict[str, int]:
        """Bytes not written and lines not understood."""
        return self.port.losses | self._decoder.counters

    def open(self) -> None:
        """Open port and channel; raises `TransportError`, also when no adapter answers."""
        self.port.open()
        self._decoder.reset()
        self._pending.clear()
        self._told = BusState.ACTIVE
        try:
            self._open_channel()
        except BaseException:
            self.port.close()
            raise
        self._last = monotonic_now()

    def close(self) -> None:
        """Close the adapter's channel, then the port."""
        if self.port.device is not None:
            self.port.write(b"C\r")
        self.port.close()

    def receive(self, timeout: float) -> tuple[Instant, list[CanFrame]] | None:
        """Frames and error frames that have come, and when; None after ``timeout`` s."""
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
        """Send frames in order; ValueError for frames no adapter could send."""
        self.port.write(b"".join(map(slcan.encode_frame, frames)))

    def restart(self) -> None:
        """Leave bus-off: the channel is closed and opened again."""
        self.port.write(b"C\rO\r")

    def _decode(self, chunk: Chunk) -> list[CanFrame]:
        """Frames of a serial chunk, without those that tell a state once more."""
        if not isinstance(chunk.payload, bytes):
            raise TypeError("a serial chunk holds bytes")
        frames = []
        for frame in self._decoder.feed(chunk.payload):
            state = can_errors.told_state(frame) if frame.error else None
            if state is None or state is not self._told:
                frames.append(frame)
            if not frame.error and self._told is BusState.BUS_OFF:
                state = BusState.ACTIVE  # nothing comes in during bus-off
            self._told = state or self._told
        return frames

    def _open_channel(self) -> None:
        # Empty lines end whatever a previous owner left half-written; a closed channel refuses C.
        answered = self._ask(b"\r\rC\r") is not None
        for command in (*self._setup, b"O"):
            answer = self._ask(command + slcan.CR)
            answered |= answer is not None
            if answer == slcan.BEL:
                raise PortUnsuitable(
                    f"the adapter on {self._spec.channel} refuses the command "
                    f"{command.decode('ascii')} of {self._spec}",
                    "give a bit rate it has"
                    + (", or leave +fd out" if self._spec.fd else "")
                    + "; plug it out and in when it hangs",
                )
        answer = self._ask(b"F\r")
        self._tells_flags = answer is not None and answer.startswith(b"F")
        if not answered and answer is None and not self._pending:
            raise PortUnsuitable(
                f"nothing on {self._spec.channel} answers as an slcan adapter",
                "give the adapter's port; a board on a serial line is opened with --port",
            )

    def _ask(self, command: bytes) -> bytes | None:
        """Send ``command``, return its last answer; None when none came in `ANSWER_TIME`."""
        self._decoder.answers.clear()
        self.port.write(command)
        wanted = command.count(slcan.CR)
        start = monotonic_now()
        while len(self._decoder.answers) < wanted:
            left = ANSWER_TIME - seconds_between(start, monotonic_now())
            chunk = self.port.read(left) if left > 0 else None
            if chunk is None:
                break
            self._pending += self._decode(chunk)
        return self._decoder.answers[-1] if self._decoder.answers else None
