"""Life cycle shared by all daemons: start, supervision, signals, orderly end.

`run` is the whole process of a command: it installs signal handlers, runs the command and ends the
process. `serve` starts a `Service`, notifies the service manager, lets the service work and stops
it in order. Notifications (ready, alive, stopping) follow systemd's sd_notify: lines in a datagram
to the socket named by ``NOTIFY_SOCKET``; without that variable nothing is sent.
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
"""Signals that end a daemon in order; a second one ends it at once."""


class StartError(CommandError):
    """The environment does not allow the daemon to start; the text names the remedy."""

    def __init__(self, text: str) -> None:
        super().__init__(text, REFUSED)


class Shutdown:
    """Tracks whether a signal asked the process to end; the first one sets ``requested``.

    Until ``orderly`` is set there is nothing to stop in order, and a signal ends the process at
    once.
    """

    def __init__(self) -> None:
        self.requested = threading.Event()
        self.orderly = False

    def _on_signal(self, number: int, _: FrameType | None) -> None:
        self.requested.set()
        signal.signal(number, signal.SIG_DFL)
        if not self.orderly:
            os.kill(os.getpid(), number)

    @contextlib.contextmanager
    def listening(self) -> Iterator[Shutdown]:
        """Handle the signals. A hang-up that the parent ignores (nohup) stays ignored."""
        former = {}
        for number in SIGNALS:
            if number != signal.SIGHUP or signal.getsignal(number) is not signal.SIG_IGN:
                former[number] = signal.signal(number, self._on_signal)
        try:
            yield self
        finally:
            for number, handler in former.items():
                signal.signal(number, handler)


def run(
    make_parser: Callable[[Shutdown], argparse.ArgumentParser], argv: Sequence[str] | None
) -> int:
    """Run a daemon's command and return the exit status. Without ``argv`` the process ends here."""
    with Shutdown().listening() as shutdown:
        code = run_command(make_parser(shutdown), argv)
    if argv is None:
        exit_process(code)
    return code


def request_real_time(priority: int) -> bool:
    """Give the calling thread, and those it starts, real-time priority; False when refused.

    Python's interpreter lock has no priorities: a thread that holds it while other programs use the
    processor delays the control loop. So a daemon that controls requests it for all of its threads.
    """
    if not hasattr(os, "sched_setscheduler"):  # macOS
        return False
    try:
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(priority))
    except OSError as error:
        log.info(
            "no real-time priority (%s): allow it with `ulimit -r` or LimitRTPRIO= if the control "
            "loop is late under load",
            error.strerror,
        )
        return False
    return True


def exit_process(code: int) -> NoReturn:
    """End the process with ``code``; the last call of a command.

    The interpreter is not shut down step by step: a thread of zenoh or of a driver that re-enters
    it meanwhile would hang or abort the process after everything was closed in order.
    """
    logging.shutdown()
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError, AttributeError):  # the reader is gone
            stream.flush()
    os._exit(code)


class Service(ABC):
    """Work of a daemon between `start` and `stop`; used from the main thread.

    ``failure``: the thread that failed, and the error. ``done``: set when there is nothing left to
    do. ``recorder``: writes the log; None for no log. ``prog``: name of the command. ``refusals``:
    errors of `_start` whose text already tells users why the environment does not allow it.
    """

    prog: ClassVar[str]
    refusals: ClassVar[tuple[type[Exception], ...]] = ()

    def __init__(self) -> None:
        self.failure: tuple[str, BaseException] | None = None
        self.done = threading.Event()
        self.recorder: Recorder | None = None
        self.watchdog = Watchdog()

    def start(self) -> None:
        """Start everything. If that fails, stop everything again and raise `StartError`."""
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
        """Start everything."""

    @abstractmethod
    def stop(self) -> bool:
        """Stop in order, also after a partial start; False if a thread had to be left running."""

    def fail(self, error: BaseException) -> None:
        """Report that the current thread has failed; the daemon must end."""
        if self.failure is None:
            name = threading.current_thread().name
            self.failure = (name, error)
            log.critical("thread %s failed", name, exc_info=error)
        self.done.set()

    def verdict(self, code: int) -> int:
        """Report after `stop` how the daemon ended; returns ``code`` or a worse exit status."""
        if self.recorder is not None:
            log.info("log: %s", self.recorder.stats.path)
        if self.failure is not None:
            thread, cause = self.failure
            return complain(self.prog, CommandError(f"thread {thread} failed: {cause}", FAILED))
        if self.recorder is not None and (problem := self.recorder.trouble) is not None:
            complain(self.prog, CommandError(problem, FAILED))
            return FAILED if code == DONE else code
        return code


def serve(service: Service, shutdown: Shutdown, status: str, work: Callable[[], int]) -> int:
    """Start ``service``, run ``work``, stop it in order; returns the exit status.

    ``status``: text for the service manager once ready. A `CommandError` from ``work`` is reported.
    """
    shutdown.orderly = True
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
        exit_process(code)
    return code


# Notifications to the service manager

SOCKET_VARIABLE = "NOTIFY_SOCKET"
WATCHDOG_VARIABLE = "WATCHDOG_USEC"
WATCHDOG_PID_VARIABLE = "WATCHDOG_PID"


def notify(*lines: str) -> bool:
    """Notify the service manager without waiting; False if there is none or it is busy."""
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
    """Watchdog notifications. Call ``beat`` only from the thread that does the work.

    If that thread is stuck, the beats stop, and the service manager kills and restarts the daemon.
    ``period_s``: between two forwarded beats, half of what the manager allows; None if it requested
    none.
    """

    def __init__(self) -> None:
        self.period_s = _period_s()
        self._next = Instant(0)

    def beat(self, now: Instant) -> None:
        """Report that the work goes on; cheap, and forwarded only when due."""
        if self.period_s is None or now < self._next:
            return
        self._next = Instant(now + round(self.period_s * NS_PER_S))
        notify("WATCHDOG=1")

    def ready(self, status: str) -> None:
        """Report that the daemon is ready."""
        self._next = monotonic_now()
        notify("READY=1", f"STATUS={status}")

    @staticmethod
    def stopping(status: str) -> None:
        """Report that the daemon is stopping; no further beats are expected."""
        notify("STOPPING=1", f"STATUS={status}")


def _period_s() -> float | None:
    """Time between beats: half of the time after which systemd considers this process stuck."""
    if os.environ.get(WATCHDOG_PID_VARIABLE, str(os.getpid())) != str(os.getpid()):
        return None
    try:
        allowed = int(os.environ.get(WATCHDOG_VARIABLE, "")) / 1e6
    except ValueError:
        return None
    return allowed / 2 if allowed > 0 else None
