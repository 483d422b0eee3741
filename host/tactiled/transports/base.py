"""What every way to a board has in common: one interface and one family of errors."""

from __future__ import annotations

import os
from collections import Counter
from enum import StrEnum
from typing import Protocol

from sensor_proto.can_transfers import BusState, CanFrame
from tactiled.blocks import Chunk


class Medium(StrEnum):
    """What a transport's chunks hold: bytes, or tuples of CAN frames."""

    SERIAL = "serial"
    CAN = "can"


class TransportError(Exception):
    """What went wrong with a port, and after it what the user can do about it."""

    def __init__(self, problem: str, remedy: str = "") -> None:
        super().__init__(f"{problem}; {remedy}" if remedy else problem)
        self.problem = problem
        self.remedy = remedy


class PortMissing(TransportError):  # noqa: N818 - names a state of the port
    """There is no such port, interface or file (now)."""


class PortBusy(TransportError):  # noqa: N818 - names a state of the port
    """Somebody else has the port open."""


class PortDenied(TransportError):  # noqa: N818 - names a state of the port
    """The user may not open the port."""


class PortUnsuitable(TransportError):  # noqa: N818 - names a state of the port
    """It is there, but is no port of this kind, or cannot do what is asked of it."""


class PortGone(TransportError):  # noqa: N818 - names a state of the port
    """The port vanished while open: unplugged, or the process behind it ended."""


class PortClosed(TransportError):  # noqa: N818 - names a state of the port
    """This end is closed: `read` after (or woken by) `close`, or before `open`."""


class EndOfLog(TransportError):  # noqa: N818 - names a state of the port
    """A replay has come to the end of its file; nothing went wrong."""


class Transport(Protocol):
    """One port. One thread reads; any thread may write or close.

    ``losses``: snapshot of what this end could not deliver or use, one counter per reason.
    """

    @property
    def name(self) -> str:
        """The port as the user wrote it."""

    @property
    def medium(self) -> Medium:
        """What ``Chunk.payload`` holds."""

    @property
    def state(self) -> BusState:
        """What the medium says of itself."""

    @property
    def losses(self) -> dict[str, int]:
        """Counters, one per reason."""

    def open(self) -> None:
        """Open the port for this process alone; raises `TransportError` with the remedy."""

    def read(self, timeout: float) -> Chunk | None:
        """Everything that has come, stamped right after the read; None after ``timeout`` s.

        Raises `PortGone` when the port has vanished (at once, not after the timeout) and
        `PortClosed` when this end is closed, also by another thread during the wait.
        """

    def write(self, data: bytes | tuple[CanFrame, ...]) -> None:
        """Send; never waits longer than `WRITE_TIMEOUT` and never raises for what the port does.

        What could not be sent is counted in ``losses``. TypeError for the wrong medium's data.
        """

    def close(self) -> None:
        """Close; safe from any thread and more than once. A waiting `read` ends at once."""


WRITE_TIMEOUT = 0.02
"""s. Commands are some thirty bytes and a tty takes 4 KiB at once: who waits longer is stuck."""

READ_LIMIT = 16_384
"""Bytes one read may return: more than a tty's 4 KiB buffer, less than a log message may have."""


class Losses:
    """Counters of one transport. Written by its reader and its writers under the GIL."""

    def __init__(self) -> None:
        self._counts: Counter[str] = Counter()

    def add(self, reason: str, amount: int = 1) -> None:
        """Count ``amount`` losses for ``reason``."""
        self._counts[reason] += amount

    def snapshot(self) -> dict[str, int]:
        """Counters so far."""
        return dict(self._counts)


class Waker:
    """A pipe that another thread writes to, so that a poll on it ends at once."""

    def __init__(self) -> None:
        self.read_end, self._write_end = os.pipe()
        os.set_blocking(self.read_end, False)
        os.set_blocking(self._write_end, False)

    def wake(self) -> None:
        """End the wait, now and for every later poll."""
        os.write(self._write_end, b"\0")

    def close(self) -> None:
        """Give both ends back."""
        os.close(self.read_end)
        os.close(self._write_end)
