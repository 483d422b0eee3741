"""How a daemon starts, is watched, is told to end, and ends: the same for every daemon.

`run` is the whole process of a command: signals first, then the command, then the end. `serve`
brings a `Service` up, tells the service manager, lets it work, and ends it in order. What the
service manager is told (ready, alive, stopping) follows systemd's sd_notify: lines in a datagram to
the socket that ``NOTIFY_SOCKET`` names; started by hand, there is none and nothing is sent.
"""

from __future__ import annotations

import argparse
import contextlib
import logging
import os
import signal
import socket
import sys
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from types import FrameType
from typing import TYPE_CHECKING, ClassVar, Final, NoReturn

from tactile_core.cli import (
    DONE,
    FAILED,
    REFUSED,
    CommandError,
    complain,
    run_command,
)
from tactile_core.types import NS_PER_S, Instant, monotonic_now

if TYPE_CHECKING:
    from tactile_core.log.recorder import Recorder

log = logging.getLogger(__name__)

SIGNALS: Final = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""They end a daemon in order; a second one ends it at once."""


class StartError(CommandError):
    """The environment does not allow the daemon to start; the text names the remedy."""

    def __init__(self, text: str) -> None:
        super().__init__(text, REFUSED)


class Ending:
    """Whether the process has been told to end. ``told``: set by the first signal.

    Before `orderly` there is nothing to end in order, and a signal ends the process at once.
    """

    def __init__(self) -> None:
        self.told = threading.Event()
        self.orderly = False

    def _hear(self, number: int, _: FrameType | None) -> None:
        self.told.set()
        signal.signal(number, signal.SIG_DFL)
        if not self.orderly:
            os.kill(os.getpid(), number)

    @contextlib.contextmanager
    def listening(self) -> Iterator[Ending]:
        """Hear the signals. A hang-up that the parent ignores (nohup) stays ignored."""
        former = {}
        for number in SIGNALS:
            if number != signal.SIGHUP or signal.getsignal(number) is not signal.SIG_IGN:
                former[number] = signal.signal(number, self._hear)
        try:
            yield self
        finally:
            for number, handler in former.items():
                signal.signal(number, handler)


def run(
    make_parser: Callable[[Ending], argparse.ArgumentParser], argv: Sequence[str] | None
) -> int:
    """Run a daemon's command; the exit status. Without ``argv`` the process ends here."""
    with Ending().listening() as ending:
        code = run_command(make_parser(ending), argv)
    if argv is None:
        leave(code)
    return code


def leave(code: int) -> NoReturn:
    """End the process with ``code``; the last call of a command.

    The interpreter is not taken down piece by piece: a thread of zenoh, or of a driver, that comes
    back into it meanwhile would hang or abort the process after everything was closed in order.
    """
    logging.shutdown()
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError, AttributeError):  # its reader has gone
            stream.flush()
    os._exit(code)


class Service(ABC):
    """What a daemon does between `start` and `stop`; used from the main thread.

    ``failure``: the thread that failed, and of what. ``done``: set when there is nothing more to
    do. ``recorder``: writes the log, None for none. ``prog``: name of the command. ``refusals``:
    errors of `_start` that say in a sentence why the environment does not allow it.
    """

    prog: ClassVar[str]
    refusals: ClassVar[tuple[type[Exception], ...]] = ()

    def __init__(self) -> None:
        self.failure: tuple[str, BaseException] | None = None
        self.done = threading.Event()
        self.recorder: Recorder | None = None
        self.watchdog = Watchdog()

    def start(self) -> None:
        """Bring everything up; `StartError`, and everything down again, when that cannot be."""
        try:
            self._start()
        except StartError:
            self.stop()
            raise
        except self.refusals as error:
            self.stop()
            raise StartError(str(error)) from error

    @abstractmethod
    def _start(self) -> None:
        """Bring everything up."""

    @abstractmethod
    def stop(self) -> bool:
        """End in order what was begun, also half of it; False when a thread must be left behind."""

    def fail(self, error: BaseException) -> None:
        """A thread, the caller's or the one it speaks for, has failed: the daemon must end."""
        if self.failure is None:
            name = threading.current_thread().name
            self.failure = (name, error)
            log.critical("thread %s failed", name, exc_info=error)
        self.done.set()

    def verdict(self, code: int) -> int:
        """Say how it ended, after `stop`; ``code``, or a worse exit status."""
        if self.recorder is not None:
            log.info("log: %s", self.recorder.stats.path)
        if self.failure is not None:
            thread, cause = self.failure
            return complain(self.prog, CommandError(f"thread {thread} failed: {cause}", FAILED))
        if self.recorder is not None and (problem := self.recorder.trouble) is not None:
            complain(self.prog, CommandError(problem, FAILED))
            return FAILED if code == DONE else code
        return code


def serve(service: Service, ending: Ending, status: str, work: Callable[[], int]) -> int:
    """Start ``service``, let it ``work``, end it in order; the exit status.

    ``status``: what the service manager shows once it is ready. `CommandError` in ``work`` is told.
    """
    ending.orderly = True
    service.start()
    service.watchdog.ready(status)
    try:
        code = work()
    except CommandError as error:
        code = complain(service.prog, error)
    finally:
        service.watchdog.stopping("stopping")
        clean = service.stop()
    code = service.verdict(code)
    if not clean:
        log.warning("a thread did not end in time; leaving without it")
        leave(code)
    return code


# What the service manager is told

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
    ``period_s``: between two beats that are passed on, half of what the manager allows; None where
    it asked for none.
    """

    def __init__(self) -> None:
        self.period_s = _period_s()
        self._next = Instant(0)

    def beat(self, now: Instant) -> None:
        """The work has just gone on; cheap, and passed on when it is time to."""
        if self.period_s is None or now < self._next:
            return
        self._next = Instant(now + round(self.period_s * NS_PER_S))
        notify("WATCHDOG=1")

    def ready(self, status: str) -> None:
        """The daemon serves now."""
        self._next = monotonic_now()
        notify("READY=1", f"STATUS={status}")

    @staticmethod
    def stopping(status: str) -> None:
        """The daemon ends in order; beats are not expected any more."""
        notify("STOPPING=1", f"STATUS={status}")


def _period_s() -> float | None:
    """Between beats: half of the time after which systemd takes this process for stuck."""
    if os.environ.get(WATCHDOG_PID_VARIABLE, str(os.getpid())) != str(os.getpid()):
        return None
    try:
        allowed = int(os.environ.get(WATCHDOG_VARIABLE, "")) / 1e6
    except ValueError:
        return None
    return allowed / 2 if allowed > 0 else None
