"""The interface of all transports, and their errors."""

from __future__ import annotations

import os
from collections import Counter
from enum import StrEnum
from typing import Protocol

from sensor_proto.can_transfers import BusState, CanFrame
from tactiled.blocks import Chunk


class Medium(StrEnum):
    """Content of a transport's chunks: bytes, or tuples of CAN frames."""

    SERIAL = "serial"
    CAN = "can"


class TransportError(Exception):
    """A port failed; the text is the problem, then the remedy."""

    def __init__(self, problem: str, remedy: str = "") -> None:
        super().__init__(f"{problem}; {remedy}" if remedy else problem)
        self.problem = problem
        self.remedy = remedy


class PortMissing(TransportError):  # noqa: N818 - names a state of the port
    """The port, interface or file does not exist (now)."""


class PortBusy(TransportError):  # noqa: N818 - names a state of the port
    """Another process has the port open."""


class PortDenied(TransportError):  # noqa: N818 - names a state of the port
    """The user may not open the port."""


class PortUnsuitable(TransportError):  # noqa: N818 - names a state of the port
    """The path exists, but is not a port of this kind, or cannot do what is asked."""


class PortGone(TransportError):  # noqa: N818 - names a state of the port
    """The port disappeared while open: it was unplugged, or the process behind it ended."""


class PortClosed(TransportError):  # noqa: N818 - names a state of the port
    """This end is closed: `read` after (or woken by) `close`, or before `open`."""


class EndOfLog(TransportError):  # noqa: N818 - names a state of the port
    """A replay has reached the end of its file; not a failure."""


class Transport(Protocol):
    """A port. One thread reads; any thread may write or close."""

    @property
    def name(self) -> str:
        """The port as the user wrote it."""

    @property
    def medium(self) -> Medium:
        """Content of ``Chunk.payload``."""

    @property
    def state(self) -> BusState:
        """State of the bus."""

    @property
    def losses(self) -> dict[str, int]:
        """Snapshot of what could not be delivered or used, one counter per reason."""

    def open(self) -> None:
        """Open the port exclusively; `TransportError` names the remedy."""

    def read(self, timeout: float) -> Chunk | None:
        """Read all data that has arrived, stamped right after; None after ``timeout`` s.

        Raises `PortGone` as soon as the port disappears, and `PortClosed` when this end is closed,
        also by another thread during the wait.
        """

    def write(self, data: bytes | tuple[CanFrame, ...]) -> None:
        """Send; waits at most `WRITE_TIMEOUT` and never raises for failures of the port.

        Data that could not be sent is counted in ``losses``. TypeError for data of the wrong
        medium.
        """

    def close(self) -> None:
        """Close; safe from any thread and repeatedly. A waiting `read` ends at once."""


WRITE_TIMEOUT = 0.02
"""s. Commands are some thirty bytes and a tty takes 4 KiB at once, so a longer wait is a stuck
port."""

READ_LIMIT = 16_384
"""Most bytes of one read: more than a tty's 4 KiB buffer, less than fits into a log message."""


class Losses:
    """Loss counters of one transport; safe from several threads because of the GIL."""

    def __init__(self) -> None:
        self._counts: Counter[str] = Counter()

    def add(self, reason: str, amount: int = 1) -> None:
        """Count ``amount`` losses for ``reason``."""
        self._counts[reason] += amount

    def snapshot(self) -> dict[str, int]:
        """Copy of the counters."""
        return dict(self._counts)


class Waker:
    """A pipe with which another thread ends a poll at once."""

    def __init__(self) -> None:
        self.read_end, self._write_end = os.pipe()
        os.set_blocking(self.read_end, False)
        os.set_blocking(self._write_end, False)

    def wake(self) -> None:
        """End the wait, now and for every later poll."""
        os.write(self._write_end, b"\0")

    def close(self) -> None:
        """Close both ends."""
        os.close(self.read_end)
        os.close(self._write_end)
