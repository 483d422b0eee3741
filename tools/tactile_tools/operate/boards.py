"""The boards of running tactileds, for tools that ask them something over the bus."""

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
"""s for a tactiled to be found on the bus."""

GATHER_S = 0.2
"""s more for others, once one has been found."""

STATUS_S = 3.0
"""s for a tactiled to answer what takes it no time."""


class BoardError(CommandError):
    """What was asked of a board cannot be done."""


def told(work: Callable[[argparse.Namespace], None]) -> Callable[[argparse.Namespace], int]:
    """``work`` as a command: what the bus or a daemon refuses is a `CommandError`."""

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
    """A session as the flags ask for."""
    session = open_session(bus_config(options, BusTable(), "tool"))
    try:
        yield session
    finally:
        close_session(session)


def find(session: zenoh.Session, options: argparse.Namespace) -> list[str]:
    """Names of all boards, at least one; `BoardError` when no tactiled is there."""
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
    """The board that is meant; `BoardError` when that is not one of ``names``, or not clear."""
    there = ", ".join(names)
    if wanted is None and len(names) == 1:
        return names[0]
    if wanted is None:
        raise BoardError(f"there are several boards; name one of them: {there}", USAGE)
    if wanted not in names:
        raise BoardError(f"there is not a board {wanted!r}; there is {there}", USAGE)
    return wanted
