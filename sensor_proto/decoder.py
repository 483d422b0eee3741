"""What every decoder is, and the reasons for which wire input is refused."""

from __future__ import annotations

from collections.abc import Iterable
from enum import StrEnum
from typing import Protocol, TypeVar

from sensor_proto.packets import Received

Input = TypeVar("Input", contravariant=True)

ACCEPTED = "accepted"
"""Key of the count of accepted messages in every ``counters``."""


class Reject(StrEnum):
    """Why input was refused; the value is the key in ``counters``."""

    COBS = "cobs"  # the blocks of a serial frame do not end where the frame ends
    OVERSIZED = "oversized"  # more bytes than the longest frame or transfer: dropped to its end
    RUNT = "runt"  # too short for header and CRC
    LENGTH = "length"  # the header's length is not what came
    CRC = "crc"
    BOARD = "board"  # header names another board than the medium does
    TYPE_MISMATCH = "type_mismatch"  # header names another type than the CAN identifier does
    UNKNOWN_TYPE = "unknown_type"  # a whole message of a newer peer, skipped
    SHORT_PAYLOAD = "short_payload"  # a known message with fewer bytes than its layout
    BAD_VALUE = "bad_value"  # a known message whose values make no sense
    EMPTY = "empty"  # surplus delimiters: an idle line, or a port that floods zeros
    FOREIGN = "foreign"  # a CAN frame that is not of this protocol
    ERROR_FRAME = "error_frame"  # the CAN controller reports an error
    BAD_FRAME = "bad_frame"  # a CAN frame of impossible length
    NO_START = "no_start"  # CAN frame of a transfer whose start was not seen
    INTERRUPTED = "interrupted"  # a CAN transfer begun before the last one ended
    OUT_OF_ORDER = "out_of_order"  # toggle, transfer id or kind of a CAN frame does not follow
    LOST_LOCK = "lost_lock"  # an unframed stream no longer ends its frames where expected
    DISCARDED_BYTES = "discarded_bytes"  # bytes, not frames, that belong to no frame
    DUPLICATE = "duplicate"  # a CAN frame came twice running; the second was ignored


class Decoder(Protocol[Input]):
    """Bytes or CAN frames in, messages out. Never raises on wire input; counts what it refuses."""

    def feed(self, data: Input, /) -> list[Received]:
        """Messages that ``data`` completed, in the order in which they ended."""
        ...

    @property
    def counters(self) -> dict[str, int]:
        """Snapshot: `ACCEPTED` and one count per reason for refusal."""
        ...

    def reset(self) -> None:
        """Forget unfinished input (after a reconnection); the counters go on."""
        ...


class Tally(dict[str, int]):
    """Counters of one decoder."""

    def __init__(self, reasons: Iterable[str]) -> None:
        super().__init__({ACCEPTED: 0, **{str(reason): 0 for reason in reasons}})

    def snapshot(self) -> dict[str, int]:
        """Plain copy, with plain string keys."""
        return dict(self)
