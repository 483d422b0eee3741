"""The command ``tactiled``."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from tactile_core.cli import DONE, REFUSED, USAGE, CommandError, set_up_logging
from tactile_core.daemon import Shutdown, run, serve
from tactiled.arguments import make_parser

if TYPE_CHECKING:
    from tactiled.daemon import Daemon
    from tactiled.status import StatusLines

ARPHRD_CAN = "280"
"""Type of a CAN network in Linux (if_arp.h)."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run tactiled and return the exit status: 0 done, 1 failed, 2 usage, 3 refused.

    Without ``argv`` the arguments are those of the process, which ends here.
    """

    def parser(shutdown: Shutdown) -> argparse.ArgumentParser:
        parser = make_parser()
        parser.set_defaults(func=partial(_run, shutdown))
        return parser

    return run(parser, argv)


def _run(shutdown: Shutdown, options: argparse.Namespace) -> int:
    from rich.console import Console

    console = Console(stderr=True)
    set_up_logging(console, verbose=options.verbose)
    if options.list_ports:
        return _list_ports()

    from tactiled.daemon import Daemon
    from tactiled.settings import SettingsError, make_settings
    from tactiled.status import StatusLines

    try:
        daemon = Daemon(make_settings(options))
    except SettingsError as error:
        raise CommandError(str(error), USAGE) from error

    def work() -> int:
        with StatusLines(console, daemon.ports, daemon.recorder) as status:
            trouble = _watch(daemon, status, shutdown)
        if trouble is not None and daemon.failure is None:
            raise CommandError(trouble, REFUSED)
        return DONE

    def work_with_page() -> int:
        from tactiled.page import PageError, PageProcess

        if options.view is None:
            return work()
        try:
            page = PageProcess(options.view, daemon.settings.bus)
        except (PageError, OSError) as error:
            raise CommandError(str(error), REFUSED) from error
        try:
            return work()
        finally:
            page.close()

    return serve(daemon, shutdown, "running", work_with_page)


def _watch(daemon: Daemon, status: StatusLines, shutdown: Shutdown) -> str | None:
    """Run until the end; returns what went wrong, or None."""
    from tactile_core.types import monotonic_now, seconds_between
    from tactiled.status import REFRESH

    settings = daemon.settings
    start = monotonic_now()
    while not shutdown.requested.is_set() and not daemon.done.is_set():
        shutdown.requested.wait(REFRESH)
        status.show()
        trouble = None if settings.wait else daemon.trouble()
        if trouble is not None:
            return trouble
        elapsed = seconds_between(start, monotonic_now())
        if settings.duration is not None and elapsed >= settings.duration:
            return _unserved(daemon)
    return _unserved(daemon) if daemon.done.is_set() else None


def _unserved(daemon: Daemon) -> str | None:
    """Names the ports from which no samples came; None when there are none."""
    missing = [port.name for port in daemon.ports if not port.served]
    if not missing:
        return None
    return f"no samples came from {', '.join(missing)}; see the messages above"


def _list_ports() -> int:
    from tactiled.transports import list_ports

    ports = list_ports()
    for port in ports:
        print(port)
    buses = can_networks()
    for bus in buses:
        print(f"socketcan:{bus}")
    if not ports and not buses:
        print("no serial port and no CAN network found", file=sys.stderr)
    return DONE


def can_networks(folder: Path = Path("/sys/class/net")) -> list[str]:
    """CAN interfaces of this machine, found by their type in sysfs."""
    found = []
    for entry in sorted(folder.iterdir()) if folder.is_dir() else ():
        try:
            if (entry / "type").read_text().strip() == ARPHRD_CAN:
                found.append(entry.name)
        except OSError:
            continue  # it disappeared meanwhile
    return found


if __name__ == "__main__":
    sys.exit(main())
