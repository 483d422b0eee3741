"""Packets as multi-frame transfers on CAN 2.0B and CAN FD, segmented much as in Cyphal/CAN.

Identifier (29 bits): priority 28–26, mark 25–16, message type 15–8, zero 7, board 6–0. Last byte of
each frame (tail): start 0x80, end 0x40, toggle 0x20, transfer id 0x1F.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum

from sensor_proto.packets import (
    ACCEPTED,
    HEADER_SIZE,
    MAX_PACKET,
    MAX_UNKNOWN,
    OVERHEAD,
    Message,
    MessageType,
    Received,
    Reject,
    Tally,
    decode_payload,
    intact,
    message_type,
    pack,
    request_number,
)

# CAN error frames in the layout of SocketCAN (linux/can/error.h).
#
# SocketCAN frames and the ``s`` and ``e`` lines of slcan adapters are all converted to this layout,
# so that errors get their names in one place.


class BusState(StrEnum):
    """Fault confinement state (ISO 11898-1) as reported by the adapter; ACTIVE on a serial line."""

    ACTIVE = "active"
    WARNING = "error-warning"
    PASSIVE = "error-passive"
    BUS_OFF = "bus-off"


TX_TIMEOUT = 0x001
LOST_ARBITRATION = 0x002
CONTROLLER = 0x004
PROTOCOL = 0x008
TRANSCEIVER = 0x010
NO_ACK = 0x020
BUS_OFF = 0x040
BUS_ERROR = 0x080
RESTARTED = 0x100

_CLASSES = {
    TX_TIMEOUT: "tx-timeout",
    LOST_ARBITRATION: "lost-arbitration",
    PROTOCOL: "protocol-violation",
    TRANSCEIVER: "transceiver",
    NO_ACK: "no-acknowledgement",
    BUS_OFF: "bus-off",
    BUS_ERROR: "bus-error",
    RESTARTED: "restarted",
}

_CONTROLLER_BITS = {
    0x01: "rx-overflow",
    0x02: "tx-overflow",
    0x0C: "error-warning",
    0x30: "error-passive",
    0x40: "error-active",
}

_CONTROLLER_STATE = {
    BusState.ACTIVE: 0x40,
    BusState.WARNING: 0x0C,
    BusState.PASSIVE: 0x30,
}


def error_frame(error_class: int, controller: int = 0, protocol: int = 0) -> CanFrame:
    """Error frame with these class bits. ``controller`` becomes data[1], ``protocol`` data[2]."""
    return CanFrame(error_class, bytes([0, controller, protocol, 0, 0, 0, 0, 0]), error=True)


def state_frame(state: BusState) -> CanFrame:
    """Error frame that announces ``state``."""
    if state is BusState.BUS_OFF:
        return error_frame(BUS_OFF)
    return error_frame(CONTROLLER, _CONTROLLER_STATE[state])


def error_names(frame: CanFrame) -> tuple[str, ...]:
    """Names of all errors and states in an error frame; never empty."""
    found = [name for bit, name in _CLASSES.items() if frame.identifier & bit]
    if frame.identifier & CONTROLLER:
        found += [name for bits, name in _CONTROLLER_BITS.items() if _controller(frame) & bits]
    return tuple(found) or ("unspecified",)


def reported_state(frame: CanFrame) -> BusState | None:
    """Bus state announced by an error frame; None if it announces none."""
    if frame.identifier & BUS_OFF:
        return BusState.BUS_OFF
    if frame.identifier & RESTARTED:
        return BusState.ACTIVE
    if frame.identifier & CONTROLLER:
        bits = _controller(frame)
        if bits & 0x30:
            return BusState.PASSIVE
        if bits & 0x0C:
            return BusState.WARNING
        if bits & 0x40:
            return BusState.ACTIVE
    return None


def _controller(frame: CanFrame) -> int:
    return frame.data[1] if len(frame.data) > 1 else 0


MARK = 0x2A5
"""Bits 25–16 of every identifier: separate this protocol from other traffic on the bus."""

BROADCAST = 127
"""Board number with which the host addresses all boards at once; no board has it."""

CLASSIC_SIZE = 8
FD_SIZE = 64
_FD_LENGTHS = (*range(9), 12, 16, 20, 24, 32, 48, 64)
_FD_UP = tuple(next(n for n in _FD_LENGTHS if n >= size) for size in range(FD_SIZE + 1))
_FD_PADDING = 15
"""Largest padding in bytes: a CAN FD frame of 48 bytes and one more is padded to 64."""

_START, _END, _TOGGLE, _ID = 0x80, 0x40, 0x20, 0x1F
_KNOWN = frozenset(int(kind) for kind in MessageType)

PRIORITY: dict[MessageType, int] = {
    MessageType.CLOCK_POLL: 1,
    MessageType.CLOCK_REPLY: 1,
    MessageType.SAMPLES: 3,
    MessageType.STATUS: 5,
    MessageType.LOG: 6,
}
"""Priority of each message type; 0 wins arbitration. Clock frames come first, as their time stamps
must not wait; log text comes last."""

_COMMAND_PRIORITY = 2

_REASONS = (
    Reject.ERROR_FRAME,
    Reject.FOREIGN,
    Reject.BAD_FRAME,
    Reject.UNKNOWN_TYPE,
    Reject.DUPLICATE,
    Reject.NO_START,
    Reject.OUT_OF_ORDER,
    Reject.INTERRUPTED,
    Reject.OVERSIZED,
    Reject.RUNT,
    Reject.LENGTH,
    Reject.CRC,
    Reject.BOARD,
    Reject.TYPE_MISMATCH,
    Reject.SHORT_PAYLOAD,
    Reject.BAD_VALUE,
)


@dataclass(frozen=True, slots=True)
class CanFrame:
    """One CAN frame with a 29-bit identifier. ``error``: a report of the controller, not data."""

    identifier: int
    data: bytes
    fd: bool = False
    error: bool = False


def identifier(kind: MessageType, board: int) -> int:
    """CAN identifier of messages of type ``kind`` from or to ``board``."""
    priority = PRIORITY.get(kind, _COMMAND_PRIORITY)
    return priority << 26 | MARK << 16 | kind << 8 | board


class CanEncoder:
    """Encodes messages to CAN frames.

    ``board``: the sender on a board, the receiver on the host (`BROADCAST` for all boards).
    """

    def __init__(self, board: int, fd: bool) -> None:
        if not 0 <= board <= BROADCAST:
            raise ValueError(f"board {board}: 0 to {BROADCAST}")
        self._board = board
        self._fd = fd
        self._next: dict[MessageType, int] = {}

    def encode(self, message: Message) -> tuple[CanFrame, ...]:
        """Frames of the transfer that carries ``message``.

        Raises ValueError if a value does not fit.
        """
        kind = message_type(message)
        raw = pack(message, self._board)
        transfer = self._next.get(kind, 0)
        self._next[kind] = (transfer + 1) & _ID
        return segment(raw, identifier(kind, self._board), transfer, self._fd)


def segment(raw: bytes, can_id: int, transfer: int, fd: bool) -> tuple[CanFrame, ...]:
    """Split the packet ``raw`` into the frames of transfer number ``transfer`` (0 to 31)."""
    step = (FD_SIZE if fd else CLASSIC_SIZE) - 1
    frames = []
    toggle = _TOGGLE
    for at in range(0, len(raw), step):
        part = raw[at : at + step]
        tail = toggle | transfer
        if at == 0:
            tail |= _START
        if at + step >= len(raw):
            tail |= _END
            if fd:
                part = part.ljust(_FD_UP[len(part) + 1] - 1, b"\0")
        frames.append(CanFrame(can_id, part + bytes((tail,)), fd))
        toggle ^= _TOGGLE
    return tuple(frames)


class _Transfer:
    """Received part of one transfer, and its last frame to detect repetitions."""

    __slots__ = ("expected", "fd", "last", "parts", "size")

    def __init__(self) -> None:
        self.expected = -1  # tail of the next frame without its end bit; -1: waiting for a start
        self.fd = False
        self.last = b""
        self.parts: list[bytes] = []
        self.size = 0

    def drop(self) -> None:
        self.expected = -1
        self.parts = []
        self.size = 0


class CanDecoder:
    """Decodes CAN frames of any number of boards to messages.

    It holds one unfinished transfer per board and known type: at most 128 × 13, each of at most
    `packets.MAX_PACKET` bytes plus one frame.
    """

    def __init__(self) -> None:
        self._transfers: dict[int, _Transfer] = {}
        self._tally = Tally(_REASONS)
        self._unknown: deque[tuple[int, int]] = deque(maxlen=MAX_UNKNOWN)

    def take_unknown(self) -> list[tuple[int, int]]:
        """Return type and request number of the unknown messages skipped since the last call."""
        unknown = list(self._unknown)
        self._unknown.clear()
        return unknown

    @property
    def counters(self) -> dict[str, int]:
        """Messages accepted, and frames or transfers refused, by reason."""
        return self._tally.snapshot()

    def reset(self) -> None:
        """Forget unfinished transfers."""
        self._transfers.clear()

    def feed(self, frames: Iterable[CanFrame], /) -> list[Received]:
        """Return the messages whose transfers ended in ``frames``."""
        packets: list[bytes] = []
        keys: list[int] = []
        for frame in frames:
            raw = self._accept(frame)
            if raw is not None:
                packets.append(raw)
                keys.append(frame.identifier & 0xFFFF)
        return self._decode(packets, keys) if packets else []

    def _accept(self, frame: CanFrame) -> bytes | None:
        """Packet completed by ``frame``, without padding; None if it completes none."""
        can_id, data = frame.identifier, frame.data
        tally = self._tally
        if frame.error:
            tally[Reject.ERROR_FRAME] += 1
            return None
        if (can_id >> 16 & 0x3FF) != MARK or can_id & 0x80 or can_id >> 29:
            tally[Reject.FOREIGN] += 1
            return None
        if not data:
            tally[Reject.BAD_FRAME] += 1
            return None
        tail = data[-1]
        if can_id >> 8 & 0xFF not in _KNOWN:
            if tail & _START:
                tally[Reject.UNKNOWN_TYPE] += 1
                self._unknown.append((can_id >> 8 & 0xFF, request_number(data[:-1])))
            return None
        key = can_id & 0xFFFF
        transfer = self._transfers.get(key)
        if transfer is None:
            transfer = self._transfers[key] = _Transfer()
        if data == transfer.last:
            # A sender that misses the acknowledgement repeats its frame (ISO 11898-1, 10.7).
            tally[Reject.DUPLICATE] += 1
            return None
        transfer.last = data
        return self._append(transfer, frame, tail)

    def _append(self, transfer: _Transfer, frame: CanFrame, tail: int) -> bytes | None:
        tally = self._tally
        full = FD_SIZE if frame.fd else CLASSIC_SIZE
        size = len(frame.data)
        if size > full or (size < full and not tail & _END):
            transfer.drop()
            tally[Reject.BAD_FRAME] += 1
            return None
        if tail & _START:
            if transfer.expected >= 0:
                transfer.drop()
                tally[Reject.INTERRUPTED] += 1
            if not tail & _TOGGLE:
                tally[Reject.OUT_OF_ORDER] += 1
                return None
            transfer.fd = frame.fd
        elif transfer.expected < 0:
            tally[Reject.NO_START] += 1
            return None
        elif tail & ~_END != transfer.expected or frame.fd != transfer.fd:
            transfer.drop()
            tally[Reject.OUT_OF_ORDER] += 1
            return None
        transfer.parts.append(frame.data[:-1])
        transfer.size += size - 1
        if transfer.size > MAX_PACKET + _FD_PADDING:
            transfer.drop()
            tally[Reject.OVERSIZED] += 1
            return None
        if not tail & _END:
            transfer.expected = (tail ^ _TOGGLE) & ~_START
            return None
        raw = b"".join(transfer.parts)
        transfer.drop()
        return self._trim(raw, frame.fd)

    def _trim(self, raw: bytes, fd: bool) -> bytes | None:
        """Packet without the padding of CAN FD; None, and counted, if its length is impossible."""
        if len(raw) < OVERHEAD:
            self._tally[Reject.RUNT] += 1
            return None
        size = OVERHEAD + raw[2] + (raw[3] << 8)
        if not size <= len(raw) <= size + (_FD_PADDING if fd else 0):
            self._tally[Reject.LENGTH] += 1
            return None
        if size > MAX_PACKET:
            self._tally[Reject.OVERSIZED] += 1
            return None
        return raw[:size]

    def _decode(self, packets: list[bytes], keys: list[int]) -> list[Received]:
        tally = self._tally
        received = []
        for raw, key, good in zip(packets, keys, intact(packets), strict=True):
            if not good:
                tally[Reject.CRC] += 1
            elif raw[0] != key >> 8:
                tally[Reject.TYPE_MISMATCH] += 1
            elif raw[1] != key & 0x7F:
                tally[Reject.BOARD] += 1
            else:
                message = decode_payload(raw[0], raw, HEADER_SIZE, len(raw) - 4)
                if isinstance(message, Reject):
                    tally[message] += 1
                else:
                    received.append(Received(message, raw[1], 0))
        tally[ACCEPTED] += len(received)
        return received
