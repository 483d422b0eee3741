"""The command ``tactiled``."""

from __future__ import annotations

import logging
import signal
import sys
import threading
from collections.abc import Sequence
from pathlib import Path
from types import FrameType

from rich.console import Console

from tactile_core.ending import leave
from tactile_core.terminal import set_up_logging
from tactile_core.types import monotonic_now, seconds_between
from tactiled.arguments import make_parser
from tactiled.daemon import Daemon, StartError
from tactiled.settings import Settings, SettingsError, make_settings
from tactiled.status import REFRESH, StatusLines
from tactiled.transports import list_ports

log = logging.getLogger(__name__)

ARPHRD_CAN = "280"
"""Type of a CAN network in Linux (if_arp.h)."""

DONE, FAILED, USAGE, REFUSED = range(4)


def main(argv: Sequence[str] | None = None) -> int:
    """Run tactiled; the exit status: 0 done, 1 failed, 2 usage, 3 refused.

    Without ``argv`` this is the whole process, which then ends here.
    """
    code = _main(argv)
    if argv is None:
        leave(code)
    return code


def _main(argv: Sequence[str] | None) -> int:
    options = make_parser().parse_args(argv)
    console = Console(stderr=True)
    set_up_logging(console, verbose=options.verbose)
    if options.list_ports:
        return _list_ports()
    try:
        settings = make_settings(options)
    except SettingsError as error:
        print(f"tactiled: {error}", file=sys.stderr)
        return USAGE
    stopping = threading.Event()

    def stop(number: int, _: FrameType | None) -> None:
        stopping.set()
        signal.signal(number, signal.SIG_DFL)  # a second one ends it at once

    before = {n: signal.signal(n, stop) for n in (signal.SIGINT, signal.SIGTERM)}
    try:
        return _run(settings, console, stopping)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _run(settings: Settings, console: Console, stopping: threading.Event) -> int:
    daemon = Daemon(settings)
    try:
        daemon.start()
    except StartError as error:
        print(f"tactiled: {error}", file=sys.stderr)
        return REFUSED
    daemon.watchdog.ready("running")
    try:
        with StatusLines(console, daemon.ports, daemon.recorder) as status:
            trouble = _watch(daemon, status, stopping)
    finally:
        clean = daemon.stop()
    code = _conclude(daemon, trouble)
    if not clean:
        log.warning("a thread did not end in time; leaving without it")
        leave(code)
    return code


def _conclude(daemon: Daemon, trouble: str | None) -> int:
    """Say how it ended; the exit status."""
    if daemon.failure is not None:
        thread, cause = daemon.failure
        print(f"tactiled: thread {thread} failed: {cause}", file=sys.stderr)
        return FAILED
    if trouble is not None:
        print(f"tactiled: {trouble}", file=sys.stderr)
        return REFUSED
    if daemon.recorder is not None:
        log.info("log: %s", daemon.recorder.stats.path)
        problem = daemon.recorder.trouble
        if problem is not None:
            print(f"tactiled: {problem}", file=sys.stderr)
            return FAILED
    return DONE


def _watch(daemon: Daemon, status: StatusLines, stopping: threading.Event) -> str | None:
    """Wait for the end; what kept the job from being done, None when it was."""
    settings = daemon.settings
    start = monotonic_now()
    while not stopping.is_set() and not daemon.done.is_set():
        stopping.wait(REFRESH)
        status.show()
        trouble = None if settings.wait else daemon.trouble()
        if trouble is not None:
            return trouble
        elapsed = seconds_between(start, monotonic_now())
        if settings.duration is not None and elapsed >= settings.duration:
            return _unserved(daemon)
    return _unserved(daemon) if daemon.done.is_set() else None


def _unserved(daemon: Daemon) -> str | None:
    """Ports of which no board ever came into service."""
    missing = [port.name for port in daemon.ports if not port.served]
    if not missing:
        return None
    return f"no samples came from {', '.join(missing)}; see the messages above"


def _list_ports() -> int:
    ports = list_ports()
    for port in ports:
        print(port)
    buses = can_networks()
    for bus in buses:
        print(f"socketcan:{bus}")
    if not ports and not buses:
        print("no serial port and no CAN network is there", file=sys.stderr)
    return DONE


def can_networks(folder: Path = Path("/sys/class/net")) -> list[str]:
    """CAN networks of this machine, by what Linux says of each network."""
    found = []
    for entry in sorted(folder.iterdir()) if folder.is_dir() else ():
        try:
            if (entry / "type").read_text().strip() == ARPHRD_CAN:
                found.append(entry.name)
        except OSError:
            continue  # it went away meanwhile
    return found


if __name__ == "__main__":
    sys.exit(main())
