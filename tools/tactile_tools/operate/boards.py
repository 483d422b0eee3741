"""Boards of running tactileds, for tools that send them requests over the bus."""

from __future__ import annotations

import argparse
import contextlib
import time
from collections.abc import Callable, Iterator

import zenoh

from tactile_core.bus.services import ServiceError
from tactile_core.bus.session import BusError, close_session, open_session
from tactile_core.bus.streams import list_alive
from tactile_core.cli import DONE, REFUSED, USAGE, CommandError
from tactile_core.options import BusTable, bus_config

FIND_S = 3.0
"""Seconds to find a tactiled on the bus."""

GATHER_S = 0.2
"""Extra seconds to find others, once one has been found."""

STATUS_S = 3.0
"""Seconds for a tactiled to answer a request that takes it no time."""


class BoardError(CommandError):
    """A request to a board failed."""


def as_command(work: Callable[[argparse.Namespace], None]) -> Callable[[argparse.Namespace], int]:
    """``work`` as a command: what the bus or a daemon refuses becomes a `CommandError`."""

    def command(options: argparse.Namespace) -> int:
        try:
            work(options)
        except BusError as error:
            raise BoardError(str(error), USAGE) from error
        except ServiceError as error:
            raise BoardError(str(error), REFUSED) from error
        return DONE

    return command


@contextlib.contextmanager
def bus(options: argparse.Namespace) -> Iterator[zenoh.Session]:
    """Open a session as the options ask for."""
    session = open_session(bus_config(options, BusTable(), "tool"))
    try:
        yield session
    finally:
        close_session(session)


def find(session: zenoh.Session, options: argparse.Namespace) -> list[str]:
    """Names of all boards, at least one; `BoardError` if there is no tactiled."""
    names = set(list_alive(session, FIND_S))
    if names:
        time.sleep(GATHER_S)
        names |= set(list_alive(session, GATHER_S))
    if not names:
        where = ", ".join(bus_config(options, BusTable(), "tool").connect_endpoints()[:1])
        if options.connect:
            where = ", ".join(options.connect)
        raise BoardError(
            f"no tactiled answers at {where}: start it, or name its endpoint with --connect",
            REFUSED,
        )
    return sorted(names)


def choose(wanted: str | None, names: list[str]) -> str:
    """Name of the board that is meant; `BoardError` if it is not in ``names`` or ambiguous."""
    there = ", ".join(names)
    if wanted is None and len(names) == 1:
        return names[0]
    if wanted is None:
        raise BoardError(f"there are several boards; name one: {there}", USAGE)
    if wanted not in names:
        raise BoardError(f"no such board: {wanted!r}; available: {there}", USAGE)
    return wanted
