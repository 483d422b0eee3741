"""Host side of the text protocol of USB-CAN adapters (slcan).

Frames and answers are as in the LAWICEL CAN232/CANUSB manual; FD lines (``d D b B``) as in the
CANable 2.0 firmware; ``s`` and ``e`` lines as the Linux slcan driver reads them; ``E``, ``L`` and
``#`` lines as in the CANable 2.5 firmware. A frame is ``T``, 8 hex digits of identifier, 1 hex
digit of length code, 2 hex digits per byte, and CR; CANdapter writes ``x`` for ``T``. PROTOCOL.md
has the details.
"""

from __future__ import annotations

import re
from collections import Counter, deque
from enum import StrEnum

from sensor_proto import can_transfers
from sensor_proto.can_transfers import BusState, CanFrame

CR = b"\r"
BEL = b"\a"

BITRATES = {
    10_000: b"S0",
    20_000: b"S1",
    50_000: b"S2",
    83_300: b"S9",
    83_333: b"S9",
    100_000: b"S3",
    125_000: b"S4",
    250_000: b"S5",
    500_000: b"S6",
    750_000: b"S7",
    800_000: b"S7",
    1_000_000: b"S8",
}
"""Command for each bit rate in bit/s (LAWICEL CAN232 manual); S9 (83.3 kbit/s) as in CANable and
Seeed adapters. S7 is 800 kbit/s in that manual but 750 kbit/s with CANable firmware; which one
applies depends on the adapter."""

DATA_BITRATES = {
    500_000: b"Y0",
    1_000_000: b"Y1",
    2_000_000: b"Y2",
    3_000_000: b"Y3",
    4_000_000: b"Y4",
    5_000_000: b"Y5",
    8_000_000: b"Y8",
}
"""Command for each data-phase bit rate in bit/s (CANable 2.0 and successors); few adapters support
all of them."""

LENGTH_OF_CODE = (0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64)
"""Data bytes for each CAN FD length code (ISO 11898-1)."""

CODE_OF_LENGTH = {length: code for code, length in enumerate(LENGTH_OF_CODE)}

MAX_LINE = 1 + 8 + 1 + 2 * 64 + 4
"""Longest line in characters: an FD frame with a time stamp. A longer one is noise."""

MAX_ANSWERS = 64
"""Most answers kept. Each command gets one, and few commands are pending at once."""

_TIMESTAMP_DIGITS = 4  # with Z1, milliseconds follow every frame
_ENDS = re.compile(rb"(\r\n?|\n|\a(?:\r\n)?)")
_STATES = {
    ord("a"): BusState.ACTIVE,
    ord("w"): BusState.WARNING,
    ord("p"): BusState.PASSIVE,
    ord("b"): BusState.BUS_OFF,
}
_FRAME_LETTERS = b"TtRrDdBbx"
_EXTENDED = b"TRDBx"
ACK, NAK = b"\x06", b"\x15"
"""Answers of CANdapter instead of an empty line and BEL."""


class Rejected(StrEnum):
    """Why a frame line was rejected."""

    STANDARD_ID = "standard_id"  # 11-bit identifiers belong to other protocols
    REMOTE = "remote_frame"  # the protocol has none
    MALFORMED = "malformed_line"


def encode_frame(frame: CanFrame) -> bytes:
    """Encode a data frame as a line with CR; FD frames use the data bit rate.

    Raises ValueError for an invalid frame.
    """
    code = CODE_OF_LENGTH.get(len(frame.data))
    if code is None or (code > 8 and not frame.fd):
        raise ValueError(f"a CAN frame cannot have {len(frame.data)} data bytes (fd={frame.fd})")
    if frame.error or not 0 <= frame.identifier < 1 << 29:
        raise ValueError("only data frames with 29-bit identifiers can be sent")
    letter = "B" if frame.fd else "T"
    return f"{letter}{frame.identifier:08X}{code:X}{frame.data.hex().upper()}\r".encode("ascii")


def decode_frame(line: bytes) -> CanFrame | Rejected:
    """Decode a line without its CR: the frame, or why it was rejected.

    Ignores a time stamp at the end.
    """
    letter = line[:1]
    if letter not in _EXTENDED or not letter:
        return Rejected.STANDARD_ID if letter and letter in b"tdb" else _not_data(letter)
    if letter == b"R":
        return Rejected.REMOTE
    fd = letter in b"DB"
    try:
        identifier = int(line[1:9], 16)
        length = LENGTH_OF_CODE[int(line[9:10], 16)]
        digits = line[10:]
        if len(digits) == 2 * length + _TIMESTAMP_DIGITS:
            digits = digits[: 2 * length]
        data = bytes.fromhex(digits.decode("ascii"))
    except ValueError:  # includes UnicodeDecodeError
        return Rejected.MALFORMED
    if len(data) != length or len(digits) != 2 * length or identifier >> 29:
        return Rejected.MALFORMED
    if length > 8 and not fd:
        return Rejected.MALFORMED
    return CanFrame(identifier, data, fd)


def _not_data(letter: bytes) -> Rejected:
    return Rejected.REMOTE if letter == b"r" else Rejected.MALFORMED


class SlcanDecoder:
    """Decodes an adapter's output, in any chunks, to frames, error frames and answers.

    Never raises.
    """

    def __init__(self) -> None:
        self._buffer = bytearray()
        self._counts: Counter[str] = Counter()
        self._last_end = b""
        self._ends_crlf = False
        self._reported_errors = 0
        self.answers: deque[bytes] = deque(maxlen=MAX_ANSWERS)
        """Answers to commands, without their CR; a refusal is a single BEL."""

    @property
    def counters(self) -> dict[str, int]:
        """Rejected lines by reason."""
        return dict(self._counts)

    def reset(self) -> None:
        """Forget an unfinished line and all answers; the counters continue."""
        self._buffer.clear()
        self._last_end, self._ends_crlf, self._reported_errors = b"", False, 0
        self.answers.clear()

    def feed(self, data: bytes) -> list[CanFrame]:
        """Return the frames completed by ``data``, in order.

        They include error frames (SocketCAN layout) for errors, states and answers to ``F``.
        """
        if self._last_end == b"\r" and not self._buffer and data.startswith(b"\n"):
            data = data[1:]  # second half of the previous line end
            self._ends_crlf = True
        parts = _ENDS.split(bytes(self._buffer) + data)
        frames: list[CanFrame] = []
        for line, end in zip(parts[:-1:2], parts[1::2], strict=True):
            refused, self._last_end = self._last_end[:1] == BEL, end
            self._ends_crlf |= end.endswith(b"\r\n")
            if refused and not line and self._ends_crlf and end[:1] == CR:
                continue  # some adapters end a refusal (BEL) with CR LF
            self._line(line, end[:1], frames)
        self._buffer = bytearray(parts[-1])
        if len(self._buffer) > MAX_LINE:
            self._counts[Rejected.MALFORMED] += 1
            self._buffer.clear()
        return frames

    def _line(self, line: bytes, end: bytes, frames: list[CanFrame]) -> None:
        if end == BEL:
            self.answers.append(BEL)
        elif line and line[0] in _FRAME_LETTERS:
            frame = decode_frame(line)
            if isinstance(frame, CanFrame):
                frames.append(frame)
            else:
                self._counts[frame] += 1
        elif line[:1] == b"s" and len(line) == 8 and line[1] in _STATES:
            frames.append(can_transfers.state_frame(_STATES[line[1]]))
        elif line[:1] == b"e" and len(line) >= 3:
            frames.append(_error_of(line))
        elif _REPORT.fullmatch(line):
            frames += _report_of(line)
        elif line in (b"z", b"Z") or _BUS_LOAD.fullmatch(line):
            pass  # "sent", from adapters with automatic polling; or bus load in percent
        elif line in (ACK, b"#"):
            self.answers.append(b"")
        elif line == NAK or (line[:1] == b"#" and len(line) < 4):
            self.answers.append(BEL)
        elif not line or line[:1] in b"VvNF":
            self.answers.append(line)
            # Keep the order of the lines, or an old answer would override newer state.
            frames += self._flags_of(line)
        else:
            self._counts[Rejected.MALFORMED] += 1

    def _flags_of(self, answer: bytes) -> list[CanFrame]:
        """Error frames for the answer to ``F``: the state, and errors once while they persist."""
        flags = flags_of(answer)
        state = state_of_flags(answer)
        if flags is None or state is None:
            return []
        frames = [can_transfers.state_frame(state)]
        errors = flags & ERROR_FLAGS
        if errors and errors != self._reported_errors:
            frames.append(_errors_of_flags(errors))
        self._reported_errors = errors
        return frames


_REPORT = re.compile(rb"E[0-9A-Fa-f]{8}")
_BUS_LOAD = re.compile(rb"L[0-9]{1,3}")
_REPORT_STATES = (BusState.ACTIVE, BusState.WARNING, BusState.PASSIVE, BusState.BUS_OFF)
_REPORT_PROTOCOL = (
    0,
    0x04,
    0x02,
    0,
    0x10,
    0x08,
    0x00,
)  # none stuff form ack recessive dominant CRC


def _report_of(line: bytes) -> list[CanFrame]:
    """Error frames for an ``E`` line of CANable 2.5.

    ``E`` is followed by one digit of state, one of the last protocol error, two of firmware errors,
    and counts. Protocol errors: 1 stuff, 2 form, 3 no acknowledgement, 4 recessive bit, 5 dominant
    bit, 6 CRC. Firmware errors: 0x04 transmit and 0x08 receive overflow.
    """
    state, last, firmware = int(line[1:2], 16), int(line[2:3], 16), int(line[3:5], 16)
    frames = []
    if state < len(_REPORT_STATES):
        frames.append(can_transfers.state_frame(_REPORT_STATES[state]))
    error_class = controller = protocol = 0
    if last == 3:
        error_class |= can_transfers.NO_ACK
    elif 0 < last < len(_REPORT_PROTOCOL):
        error_class |= can_transfers.PROTOCOL | can_transfers.BUS_ERROR
        protocol = _REPORT_PROTOCOL[last]
    if firmware & 0x0C:
        error_class |= can_transfers.CONTROLLER
        controller = (0x02 if firmware & 0x04 else 0) | (0x01 if firmware & 0x08 else 0)
    if error_class:
        frames.append(can_transfers.error_frame(error_class, controller, protocol))
    return frames


def _error_of(line: bytes) -> CanFrame:
    """Error frame for an ``e`` line (Linux slcan driver): ``e``, a count, then one letter per
    error.

    Letters: a acknowledgement, b/B bit 0/1, c CRC, f form, s stuff, o/O receive/transmit overrun.
    """
    error_class = controller = protocol = 0
    for letter in line[2:].decode("ascii", "replace"):
        if letter == "a":
            error_class |= can_transfers.NO_ACK
        elif letter in "oO":
            error_class |= can_transfers.CONTROLLER
            controller |= 0x01 if letter == "o" else 0x02
        else:
            error_class |= can_transfers.PROTOCOL | can_transfers.BUS_ERROR
            protocol |= {"f": 0x02, "s": 0x04, "b": 0x08, "B": 0x10}.get(letter, 0)
    return can_transfers.error_frame(error_class, controller, protocol)


FLAG_RX_FULL = 0x01
FLAG_TX_FULL = 0x02
FLAG_WARNING = 0x04
FLAG_OVERRUN = 0x08
FLAG_PASSIVE = 0x20
FLAG_ARBITRATION = 0x40
FLAG_BUS_ERROR = 0x80
"""Bits of the answer to ``F`` (LAWICEL CAN232 manual); 0x10 is unused."""

ERROR_FLAGS = FLAG_RX_FULL | FLAG_TX_FULL | FLAG_OVERRUN | FLAG_ARBITRATION | FLAG_BUS_ERROR
"""Flags that report errors; the others report a state."""

BUS_OFF_FLAGS = FLAG_WARNING | FLAG_PASSIVE | FLAG_BUS_ERROR
"""Bus-off: it has no flag of its own, but a controller in it sets these three."""


def flags_of(answer: bytes) -> int | None:
    """Flags in the answer ``Fxx`` to the command ``F``; None for any other answer."""
    try:
        return int(answer[1:3], 16) if answer[:1] == b"F" and len(answer) == 3 else None
    except ValueError:
        return None


def state_of_flags(answer: bytes) -> BusState | None:
    """Bus state in the answer ``Fxx`` to the command ``F``; None for any other answer."""
    flags = flags_of(answer)
    if flags is None:
        return None
    if flags & BUS_OFF_FLAGS == BUS_OFF_FLAGS:
        return BusState.BUS_OFF
    if flags & FLAG_PASSIVE:
        return BusState.PASSIVE
    return BusState.WARNING if flags & FLAG_WARNING else BusState.ACTIVE


def _errors_of_flags(errors: int) -> CanFrame:
    """Error frame for these `ERROR_FLAGS`."""
    error_class = controller = 0
    if errors & (FLAG_RX_FULL | FLAG_OVERRUN):
        controller |= 0x01
    if errors & FLAG_TX_FULL:
        controller |= 0x02
    if controller:
        error_class |= can_transfers.CONTROLLER
    if errors & FLAG_ARBITRATION:
        error_class |= can_transfers.LOST_ARBITRATION
    if errors & FLAG_BUS_ERROR:
        error_class |= can_transfers.BUS_ERROR
    return can_transfers.error_frame(error_class, controller)
