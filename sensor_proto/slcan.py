"""The text lines of USB-CAN adapters that speak slcan; the host's half of the dialogue.

Frames and answers as in the LAWICEL CAN232/CANUSB manual; FD lines (``d D b B``) as the CANable 2.0
firmware adds them; ``s`` and ``e`` lines as the Linux slcan driver reads them. A frame is
``T`` + 8 hex digits of identifier + 1 hex digit of length code + 2 hex digits a byte + CR.
"""

from __future__ import annotations

import re
from collections import Counter, deque
from enum import StrEnum

from sensor_proto import can_errors
from sensor_proto.can_errors import BusState
from sensor_proto.canseg import CanFrame

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
"""bit/s → command, LAWICEL CAN232 manual; S9 (83.3 kbit/s) as CANable and Seeed add it. S7 is
800 kbit/s by that manual and 750 with CANable's firmware: the adapter makes of it what it does."""

DATA_BITRATES = {
    500_000: b"Y0",
    1_000_000: b"Y1",
    2_000_000: b"Y2",
    3_000_000: b"Y3",
    4_000_000: b"Y4",
    5_000_000: b"Y5",
    8_000_000: b"Y8",
}
"""bit/s of the data phase → command, CANable 2.0 and its successors; few adapters have all."""

LENGTH_OF_CODE = (0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64)
"""Data bytes for each length code of CAN FD, ISO 11898-1."""

CODE_OF_LENGTH = {length: code for code, length in enumerate(LENGTH_OF_CODE)}

MAX_LINE = 1 + 8 + 1 + 2 * 64 + 4
"""Characters of the longest line: an FD frame with a time stamp. A longer one is noise."""

MAX_ANSWERS = 64
"""Answers kept for whoever asked; each command brings one, and few are asked at once."""

_TIMESTAMP_DIGITS = 4  # Z1 puts milliseconds behind every frame
_ENDS = re.compile(rb"([\r\a])")
_STATES = {
    ord("a"): BusState.ACTIVE,
    ord("w"): BusState.WARNING,
    ord("p"): BusState.PASSIVE,
    ord("b"): BusState.BUS_OFF,
}
_FRAME_LETTERS = b"TtRrDdBb"
_EXTENDED = b"TRDB"


class Rejected(StrEnum):
    """Why a frame line gave no frame."""

    STANDARD_ID = "standard_id"  # 11-bit identifiers are other people's traffic
    REMOTE = "remote_frame"  # the protocol has none
    MALFORMED = "malformed_line"


def encode_frame(frame: CanFrame) -> bytes:
    """Line for a data frame, CR included; FD frames switch bit rate. ValueError: no such frame."""
    code = CODE_OF_LENGTH.get(len(frame.data))
    if code is None or (code > 8 and not frame.fd):
        raise ValueError(f"no CAN frame has {len(frame.data)} data bytes (fd={frame.fd})")
    if frame.error or not 0 <= frame.identifier < 1 << 29:
        raise ValueError("only data frames with 29-bit identifiers can be sent")
    letter = "B" if frame.fd else "T"
    return f"{letter}{frame.identifier:08X}{code:X}{frame.data.hex().upper()}\r".encode("ascii")


def decode_frame(line: bytes) -> CanFrame | Rejected:
    """Frame of a line without its CR, or why there is none. A time stamp behind it is ignored."""
    letter = line[:1]
    if letter not in _EXTENDED or not letter:
        return Rejected.STANDARD_ID if letter and letter in b"tdb" else _not_data(letter)
    if letter == b"R":
        return Rejected.REMOTE
    fd = letter != b"T"
    try:
        identifier = int(line[1:9], 16)
        length = LENGTH_OF_CODE[int(line[9:10], 16)]
        digits = line[10:]
        if len(digits) == 2 * length + _TIMESTAMP_DIGITS:
            digits = digits[: 2 * length]
        data = bytes.fromhex(digits.decode("ascii"))
    except ValueError:  # UnicodeDecodeError is one
        return Rejected.MALFORMED
    if len(data) != length or len(digits) != 2 * length or identifier >> 29:
        return Rejected.MALFORMED
    if length > 8 and not fd:
        return Rejected.MALFORMED
    return CanFrame(identifier, data, fd)


def _not_data(letter: bytes) -> Rejected:
    return Rejected.REMOTE if letter == b"r" else Rejected.MALFORMED


class SlcanDecoder:
    """What an adapter sends, any chunking: frames, error frames and answers. Never raises."""

    def __init__(self) -> None:
        self._buffer = bytearray()
        self._counts: Counter[str] = Counter()
        self.answers: deque[bytes] = deque(maxlen=MAX_ANSWERS)
        """Lines that answer commands, without their CR; a refusal is a single BEL."""

    @property
    def counters(self) -> dict[str, int]:
        """Rejected lines, one counter per reason."""
        return dict(self._counts)

    def reset(self) -> None:
        """Forget a broken line and all answers; counters stay."""
        self._buffer.clear()
        self.answers.clear()

    def feed(self, data: bytes) -> list[CanFrame]:
        """Frames completed by ``data``, in order.

        Errors, states and answers to ``F`` are SocketCAN error frames among them.
        """
        parts = _ENDS.split(bytes(self._buffer) + data)
        frames: list[CanFrame] = []
        for line, end in zip(parts[:-1:2], parts[1::2], strict=True):
            self._line(line, end, frames)
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
            frames.append(can_errors.state_frame(_STATES[line[1]]))
        elif line[:1] == b"e" and len(line) >= 3:
            frames.append(_error_of(line))
        elif line in (b"z", b"Z"):
            pass  # "sent", of adapters with automatic polling
        elif not line or line[:1] in b"VvNF":
            self.answers.append(line)
            state = state_of_flags(line)
            if state is not None:  # in its place among the lines, or an old answer would undo news
                frames.append(can_errors.state_frame(state))
        else:
            self._counts[Rejected.MALFORMED] += 1


def _error_of(line: bytes) -> CanFrame:
    """Error frame for ``e`` + count + one letter each: a ack, b/B bit 0/1, c CRC, f form, s stuff,
    o/O receive/transmit overrun (Linux slcan driver)."""
    error_class = controller = protocol = 0
    for letter in line[2:].decode("ascii", "replace"):
        if letter == "a":
            error_class |= can_errors.NO_ACK
        elif letter in "oO":
            error_class |= can_errors.CONTROLLER
            controller |= 0x01 if letter == "o" else 0x02
        else:
            error_class |= can_errors.PROTOCOL | can_errors.BUS_ERROR
            protocol |= {"f": 0x02, "s": 0x04, "b": 0x08, "B": 0x10}.get(letter, 0)
    return can_errors.error_frame(error_class, controller, protocol)


FLAG_WARNING = 0x04
FLAG_PASSIVE = 0x20
FLAG_BUS_ERROR = 0x80
BUS_OFF_FLAGS = FLAG_WARNING | FLAG_PASSIVE | FLAG_BUS_ERROR
"""The flags have no bit for bus-off; a controller in it shows these three together."""


def state_of_flags(answer: bytes) -> BusState | None:
    """State told by the answer ``Fxx`` to the command ``F``; None when it is none."""
    try:
        flags = int(answer[1:3], 16) if answer[:1] == b"F" and len(answer) == 3 else None
    except ValueError:
        return None
    if flags is None:
        return None
    if flags & BUS_OFF_FLAGS == BUS_OFF_FLAGS:
        return BusState.BUS_OFF
    if flags & FLAG_PASSIVE:
        return BusState.PASSIVE
    return BusState.WARNING if flags & FLAG_WARNING else BusState.ACTIVE
