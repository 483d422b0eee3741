"""What the command lines and configuration files of all daemons have in common."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import msgspec
from msgspec import Meta

from tactile_core.bus.keys import TlsConfig
from tactile_core.bus.session import PORTS, BusConfig, Role
from tactile_core.config import printable
from tactile_core.log.recorder import RecorderSettings

DEFAULT_LOG = "tactile-logs"
"""Folder of the logs, below the folder a daemon was started in."""

DEFAULT_LOG_BYTES = 32 << 30
"""Bytes that the logs of one name may take in a folder before the oldest go: about 18 h of one
board at 100 Hz."""


class LogTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """``[log]``: where the log is written; ``[log.recorder]``: how it is cut."""

    enabled: Annotated[bool, Meta(description="whether a log is written")] = True
    destination: Annotated[
        str, Meta(description="a folder for dated files, or a file that ends in .mcap")
    ] = DEFAULT_LOG
    recorder: RecorderSettings = RecorderSettings(max_bytes=DEFAULT_LOG_BYTES)


class BusTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """``[bus]``: zenoh endpoints, and who is let in (see security.md)."""

    listen: Annotated[
        tuple[str, ...] | None,
        Meta(description="endpoints to listen at; left out: a socket in the runtime folder"),
    ] = None
    connect: Annotated[
        tuple[str, ...] | None,
        Meta(description="endpoints of peers; left out: the others in the runtime folder"),
    ] = None
    keys: Annotated[
        str | None, Meta(description="folder of keys of `tactile bus keys`: join over TLS")
    ] = None
    tls: TlsConfig | None = None
    insecure: Annotated[
        bool,
        Meta(description="ask nobody for a proof; whoever reaches an endpoint may command"),
    ] = False


def add_log_and_bus(parser: argparse.ArgumentParser, role: Role) -> None:
    """Add --log, --no-log, --listen, --connect, --keys and --insecure, for a daemon's ``role``."""
    add = parser.add_argument_group("log and bus").add_argument
    add(
        "--log",
        metavar="PATH",
        help=f"MCAP file to write, or folder for dated files (default folder ./{DEFAULT_LOG})",
    )
    add("--no-log", action="store_true", help="log nothing")
    _add_bus(add, role)


def add_bus(parser: argparse.ArgumentParser, role: Role) -> None:
    """Add --listen, --connect, --keys and --insecure."""
    _add_bus(parser.add_argument_group("bus").add_argument, role)


def _add_bus(add: Callable[..., object], role: Role) -> None:
    tool = role not in PORTS
    default = "nowhere" if tool else f"{role}.sock in the runtime folder"
    add(
        "--listen",
        action="append",
        metavar="ENDPOINT",
        help="zenoh endpoint to listen at: unixsock-stream//FOLDER/NAME.sock, tcp/127.0.0.1:PORT "
        f"or tls/HOST:PORT (default {default}); may be repeated",
    )
    add(
        "--connect",
        action="append",
        metavar="ENDPOINT",
        help="zenoh endpoint of a peer to join (default: the others in the runtime folder); may be "
        "repeated",
    )
    add(
        "--keys",
        metavar="FOLDER",
        help="folder of keys, made by `tactile bus keys`: join over TLS, with the rights of its "
        "certificate",
    )
    add(
        "--insecure",
        action="store_true",
        help="ask nobody who joins for a proof, and allow endpoints that leave this machine: "
        "whoever reaches them may read and command; all of a rig say it, or none",
    )


def bus_config(options: argparse.Namespace, table: BusTable, role: Role) -> BusConfig:
    """How to join the bus; flags win over the file."""
    return BusConfig(
        role=role,
        listen=tuple(options.listen) if options.listen else table.listen,
        connect=tuple(options.connect) if options.connect else table.connect,
        keys=options.keys or table.keys,
        tls=table.tls,
        insecure=options.insecure or table.insecure,
    )


def log_destination(options: argparse.Namespace, table: LogTable) -> Path | None:
    """Folder or file of the log, None for none; flags win over the file."""
    if options.no_log:
        return None
    if options.log is not None:
        return Path(options.log)
    return Path(table.destination) if table.enabled else None


def finite_above_zero(text: str, unit: str) -> float:
    """Number of a flag; `argparse.ArgumentTypeError` unless finite and above 0."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not (math.isfinite(value) and value > 0):
        raise argparse.ArgumentTypeError(
            f"{printable(text)} given; allowed: a finite number of {unit} above 0"
        )
    return value
