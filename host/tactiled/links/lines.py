"""The line of a port by its medium, and the names of the boards behind it."""

from __future__ import annotations

from tactiled.links.can_line import CanLine
from tactiled.links.line import Admit, Line, SerialLine
from tactiled.transports.base import Medium


def make_line(
    port: str,
    admit: Admit,
    medium: Medium,
    *,
    kind: str,
    rate: float | None,
    baud: int,
    fd: bool,
    nodes: frozenset[int] | None,
    listen_only: bool,
    arrays: tuple[int, ...] | None = None,
) -> Line:
    """The line of ``port``; ``nodes``: boards wanted on a CAN bus, None for all.

    ``arrays``: magnetometers of each board of a controller that does not say it.
    """
    if medium is Medium.CAN:
        return CanLine(port, admit, fd, rate, nodes, listen_only)
    return SerialLine(port, admit, kind, rate, baud, listen_only, arrays)


def bus_names(
    stem: str, given: dict[int, str], nodes: tuple[int, ...], late: bool
) -> dict[int, str]:
    """Names of boards on a CAN bus: as given by node; the stem for a lone board, else stem-node."""
    if given:
        return {node: given[node] for node in nodes if node in given}
    if len(nodes) == 1 and not late:
        return {nodes[0]: stem}
    return {node: f"{stem}-{node}" for node in nodes}
