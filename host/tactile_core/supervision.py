"""What a daemon tells the service manager: that it is ready, alive, stopping (sd_notify).

The protocol is systemd's: lines in a datagram to the socket that ``NOTIFY_SOCKET`` names; started
by hand, there is none and nothing is sent.
"""

from __future__ import annotations

import contextlib
import os
import socket

from tactile_core.types import NS_PER_S, Instant, monotonic_now

SOCKET_VARIABLE = "NOTIFY_SOCKET"
WATCHDOG_VARIABLE = "WATCHDOG_USEC"
WATCHDOG_PID_VARIABLE = "WATCHDOG_PID"


def notify(*lines: str) -> bool:
    """Tell the service manager, never waiting for it; False where there is none, or it is busy."""
    place = os.environ.get(SOCKET_VARIABLE)
    if not place:
        return False
    address = "\0" + place[1:] if place.startswith("@") else place
    with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as end:
        end.setblocking(False)
        end.sendto("\n".join(lines).encode(), address)
        return True
    return False


class Watchdog:
    """Says that the work goes on. ``beat`` it from the thread that does the work, nowhere else.

    When that thread is stuck the beats end, and the service manager kills and restarts the daemon.
    ``period``: s between two beats that are passed on, half of what the manager allows; None where
    it asked for none.
    """

    def __init__(self) -> None:
        self.period = _period()
        self._next = Instant(0)

    def beat(self, now: Instant) -> None:
        """The work has just gone on; cheap, and passed on when it is time to."""
        if self.period is None or now < self._next:
            return
        self._next = Instant(now + round(self.period * NS_PER_S))
        notify("WATCHDOG=1")

    def ready(self, status: str) -> None:
        """The daemon serves now."""
        self._next = monotonic_now()
        notify("READY=1", f"STATUS={status}")

    @staticmethod
    def stopping(status: str) -> None:
        """The daemon ends in order; beats are not expected any more."""
        notify("STOPPING=1", f"STATUS={status}")


def _period() -> float | None:
    """s between beats: half of the time after which systemd takes this process for stuck."""
    if os.environ.get(WATCHDOG_PID_VARIABLE, str(os.getpid())) != str(os.getpid()):
        return None
    try:
        allowed = int(os.environ.get(WATCHDOG_VARIABLE, "")) / 1e6
    except ValueError:
        return None
    return allowed / 2 if allowed > 0 else None
