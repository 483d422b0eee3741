"""USB-CAN adapter that speaks slcan, as pure state: host bytes in, frames and answers out.

Commands and answers follow the LAWICEL CAN232/CANUSB manual, FD frames the CANable 2.0 firmware,
and state and error lines (``sb128256``, ``e1a``) are those that the Linux slcan driver reads.
"""

from __future__ import annotations

import re
from collections import Counter, deque
from dataclasses import dataclass

from sensor_proto.can_transfers import BusState, CanFrame
from sensor_proto.slcan import (
    BEL,
    BITRATES,
    BUS_OFF_FLAGS,
    CR,
    DATA_BITRATES,
    FLAG_PASSIVE,
    FLAG_WARNING,
    MAX_LINE,
    Rejected,
    decode_frame,
    encode_frame,
)
from tactile_core.types import Instant, after

VERSION = b"V1013"
"""Hardware 1.0, software 1.3: two digits each, LAWICEL manual."""

SERIAL = b"NA123"

SJA1000_CLOCK_HZ = 8_000_000
"""Hz behind the prescaler; the two registers of command ``s`` divide it."""

TIMESTAMP_WRAP_MS = 60_000
"""Time stamps count milliseconds and wrap after a minute (LAWICEL manual)."""

MAX_HELD = 1000
"""Most late answers that wait; further answers are given at once."""

MAX_OUTPUT = 65_536
"""Most bytes kept for a host that does not read: half a second of a full bus."""


@dataclass(frozen=True, slots=True)
class Dialect:
    """What differs between the firmware of adapters.

    ``answers``: whether it answers commands. ``end``: end of every line. ``late_s``: s until an
    answer. ``letter``: letter of frames with 29-bit identifiers. ``lower``: hex digits in lower
    case. ``stamps``: time stamps on without being asked. ``number``: whether it knows the command
    ``N``. ``reports``: ``#`` for answers, ``E`` and ``L`` lines once a second. ``flags``: added to
    the answer to ``F``.
    """

    answers: bool = True
    end: bytes = CR
    late_s: float = 0.0
    letter: bytes = b"T"
    lower: bool = False
    stamps: bool = False
    number: bool = True
    reports: bool = False
    flags: int = 0


DIALECTS = {
    "lawicel": Dialect(),
    "canable": Dialect(answers=False),
    "println": Dialect(end=b"\r\n"),
    "late": Dialect(late_s=1.0),
    "candapter": Dialect(letter=b"x"),
    "lower": Dialect(lower=True),
    "stamps": Dialect(stamps=True),
    "plain": Dialect(number=False),
    "canable2.5": Dialect(reports=True),
    "overrun": Dialect(flags=0x08),
    "buserror": Dialect(flags=0x80),
}
"""Adapters by name: the one in the LAWICEL manual, and what is sold."""

REPORT_PERIOD_S = 1.0
"""Seconds between the ``E`` and ``L`` lines of firmware that reports by itself."""

_RATE_OF = {command: rate for rate, command in BITRATES.items()}
_DATA_RATE_OF = {command: rate for rate, command in DATA_BITRATES.items()}
_BTR = re.compile(rb"s([0-9A-Fa-f]{2})([0-9A-Fa-f]{2})")
_STATE_LINES = {
    BusState.ACTIVE: b"sa000000",
    BusState.WARNING: b"sw096096",
    BusState.PASSIVE: b"sp128128",
    BusState.BUS_OFF: b"sb128256",
}
_STATE_FLAGS = {
    BusState.ACTIVE: 0,
    BusState.WARNING: FLAG_WARNING,
    BusState.PASSIVE: FLAG_WARNING | FLAG_PASSIVE,
    BusState.BUS_OFF: BUS_OFF_FLAGS,
}


class SlcanAdapter:
    """One adapter. ``fd``: it takes FD frames. ``tells_state``: it sends ``s`` lines by itself.

    ``dialect``: a name from `DIALECTS`; ValueError for another. ``bitrate`` and ``data_bitrate``
    are in bit/s, as the host set them. Nothing that a host sends raises.
    """

    def __init__(self, fd: bool = True, tells_state: bool = True, dialect: str = "lawicel") -> None:
        if dialect not in DIALECTS:
            raise ValueError(f"adapter {dialect!r} given; allowed: {', '.join(DIALECTS)}")
        self.dialect = DIALECTS[dialect]
        self._held: deque[tuple[Instant | None, bytes]] = deque()
        self._report_due: Instant | None = None
        self._fd = fd
        self._tells_state = tells_state
        self.bitrate: int | None = None
        self.data_bitrate = min(DATA_BITRATES)
        self.is_open = False
        self._listen_only = False
        self._timestamps = self.dialect.stamps
        self._state = BusState.ACTIVE
        self._fault = False
        self._line = bytearray()
        self._overlong = False
        self._output = bytearray()
        self._counts: Counter[str] = Counter()

    @property
    def state(self) -> BusState:
        """Error state of the adapter's CAN controller."""
        return self._state

    @property
    def losses(self) -> dict[str, int]:
        """Frames and answers that were dropped, by reason."""
        return dict(self._counts)

    def feed(self, data: bytes) -> list[CanFrame]:
        """Carry out the host's bytes, in any chunking. Returns frames for the bus, in order."""
        frames: list[CanFrame] = []
        for piece in re.split(rb"(\r)", data):
            if piece != CR:
                self._line += piece
                if len(self._line) > MAX_LINE:
                    self._overlong = True
                    self._line.clear()
                continue
            line = bytes(self._line)
            self._line.clear()
            if self._overlong:
                self._overlong = False
                self._answer(BEL)
            else:
                self._answer(self._carry_out(line, frames))
        return frames

    def deliver(self, frames: tuple[CanFrame, ...], now: Instant) -> None:
        """Pass frames from the bus to the host; lost while the channel is closed or in bus-off."""
        if not self.is_open or self._state is BusState.BUS_OFF:
            self._counts["rx_channel_closed" if not self.is_open else "rx_bus_off"] += len(frames)
            return
        stamp = b"%04X" % (now // 1_000_000 % TIMESTAMP_WRAP_MS) if self._timestamps else b""
        for frame in frames:
            line = encode_frame(frame)[:-1]
            if line[:1] == b"T":
                line = self.dialect.letter + line[1:]
            if self.dialect.lower:
                line = line[:1] + line[1:].lower()
            self._put(line + stamp + CR)

    def set_bus_off(self, fault: bool) -> None:
        """Begin or end a fault that keeps the controller in bus-off.

        As with a real one, bus-off outlasts the fault until the host closes and reopens the
        channel.
        """
        self._fault = fault
        if fault and self.is_open:
            self._enter(BusState.BUS_OFF)

    def set_state(self, state: BusState) -> None:
        """Enter error-warning, error-passive or active, as error counters would cause."""
        if self.is_open and self._state is not BusState.BUS_OFF:
            self._enter(state)

    def report_error(self, letters: str) -> None:
        """Tell the host of bus errors: a ack, b/B bit, c CRC, f form, s stuff, o/O overrun."""
        if self.is_open and self._tells_state:
            self._put(b"e%d%s\r" % (len(letters), letters.encode("ascii")))

    def take_output(self) -> bytes:
        """Bytes for the host since the last call."""
        taken = bytes(self._output)
        self._output.clear()
        return taken

    def pass_time(self, now: Instant) -> None:
        """Give the answers that are due; send reports if the firmware does so by itself."""
        late = after(now, self.dialect.late_s)
        self._held = deque((late if due is None else due, answer) for due, answer in self._held)
        while self._held and (self._held[0][0] or now) <= now:
            self._put(self._held.popleft()[1])
        if not (self.dialect.reports and self.is_open):
            return
        if self._report_due is None or now >= self._report_due:
            self._report_due = after(now, REPORT_PERIOD_S)
            state = list(_STATE_LINES).index(self._state)
            self._put(b"E%d0000000\r" % state + b"L34\r")

    def _answer(self, data: bytes) -> None:
        """Answer a command in the way of the dialect."""
        dialect = self.dialect
        if not data or not dialect.answers:
            return
        if dialect.reports and data in (CR, BEL):
            data = b"#\r" if data == CR else b"#1\r"
        if dialect.late_s and len(self._held) < MAX_HELD:
            self._held.append((None, data))
        else:
            self._put(data)

    def _put(self, data: bytes) -> None:
        if self.dialect.end != CR:
            data = data.replace(CR, self.dialect.end)
        if len(self._output) + len(data) > MAX_OUTPUT:
            self._counts["tx_host_stalled_bytes"] += len(data)
        else:
            self._output += data

    def _enter(self, state: BusState) -> None:
        if state is not self._state:
            self._state = state
            if self._tells_state:
                self._put(_STATE_LINES[state] + CR)

    def _carry_out(self, line: bytes, frames: list[CanFrame]) -> bytes:
        """Carry out one command and return the answer."""
        letter = line[:1]
        if not line:
            return CR
        if letter in b"tTrRdDbBx":
            return self._transmit(line, frames)
        if letter in b"SsYZ":
            return CR if not self.is_open and self._configure(line) else BEL
        if line in (b"O", b"L"):
            return self._open(line == b"L")
        if line == b"C":
            was_open, self.is_open = self.is_open, False
            return CR if was_open else BEL
        if line == b"F":
            flags = _STATE_FLAGS[self._state] | self.dialect.flags
            return b"F%02X\r" % flags if self.is_open else BEL
        if line in (b"V", b"v") or (line == b"N" and self.dialect.number):
            return {b"V": VERSION, b"v": b"v1013", b"N": SERIAL}[line] + CR
        self._counts["unknown_command"] += 1
        return BEL

    def _configure(self, line: bytes) -> bool:
        if line in _RATE_OF:
            self.bitrate = _RATE_OF[line]
        elif line in _DATA_RATE_OF and self._fd:
            self.data_bitrate = _DATA_RATE_OF[line]
        elif match := _BTR.fullmatch(line):
            btr0, btr1 = int(match[1], 16), int(match[2], 16)
            quanta = 3 + (btr1 & 0x0F) + (btr1 >> 4 & 0x07)
            self.bitrate = SJA1000_CLOCK_HZ // ((1 + (btr0 & 0x3F)) * quanta)
        elif line in (b"Z0", b"Z1"):
            self._timestamps = line == b"Z1"
        else:
            self._counts["unknown_command"] += 1
            return False
        return True

    def _open(self, listen_only: bool) -> bytes:
        if self.is_open or self.bitrate is None:
            return BEL
        self.is_open, self._listen_only = True, listen_only
        self._state = BusState.ACTIVE
        if self._fault:
            # The answer comes before the state line, as the controller first has to fail.
            self._put(CR)
            self._enter(BusState.BUS_OFF)
            return b""
        return CR

    def _transmit(self, line: bytes, frames: list[CanFrame]) -> bytes:
        if not self.is_open or self._listen_only or self._state is BusState.BUS_OFF:
            self._counts["tx_refused"] += 1
            return BEL
        frame = decode_frame(line)
        if frame is Rejected.MALFORMED or (line[:1] in b"dDbB" and not self._fd):
            self._counts["tx_malformed"] += 1
            return BEL
        if isinstance(frame, CanFrame):
            frames.append(frame)
        else:
            self._counts[f"tx_{frame}"] += 1  # it goes onto the bus, but no board listens to it
        return (b"Z" if line[:1].isupper() else b"z") + CR
