"""What the command lines and configuration files of all daemons have in common."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from pathlib import Path

import msgspec

from tactile_bus.recorder import RecorderSettings
from tactile_bus.session import BusConfig, Role, TlsConfig
from tactile_bus.toml_text import printable

DEFAULT_LOG = "tactile-logs"
"""Folder of the logs, below the folder a daemon was started in."""

DEFAULT_LOG_BYTES = 32 << 30
"""Bytes that the logs of one name may take in a folder before the oldest go: about 18 h of one
board at 100 Hz."""


class LogTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """``[log]``: a folder, or a file that ends in .mcap; ``[log.recorder]``: how it is cut."""

    enabled: bool = True
    destination: str = DEFAULT_LOG
    recorder: RecorderSettings = RecorderSettings(max_bytes=DEFAULT_LOG_BYTES)


class BusTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """``[bus]``: zenoh endpoints."""

    listen: tuple[str, ...] | None = None
    connect: tuple[str, ...] | None = None
    tls: TlsConfig | None = None
    insecure: bool = False


def add_log_and_bus(parser: argparse.ArgumentParser, port: int) -> None:
    """Add --log, --no-log, --listen, --connect and --insecure; ``port``: the role's own."""
    add = parser.add_argument_group("log and bus").add_argument
    add(
        "--log",
        metavar="PATH",
        help=f"MCAP file to write, or folder for dated files (default folder ./{DEFAULT_LOG})",
    )
    add("--no-log", action="store_true", help="log nothing")
    _add_bus(add, port)


def add_bus(parser: argparse.ArgumentParser, port: int | None) -> None:
    """Add --listen, --connect and --insecure; ``port``: the role's own, None for tools."""
    _add_bus(parser.add_argument_group("bus").add_argument, port)


def _add_bus(add: Callable[..., object], port: int | None) -> None:
    default = "nowhere" if port is None else f"tcp/127.0.0.1:{port}"
    add(
        "--listen",
        action="append",
        metavar="ENDPOINT",
        help=f"zenoh endpoint to listen at (default {default}); may be repeated",
    )
    add(
        "--connect",
        action="append",
        metavar="ENDPOINT",
        help="zenoh endpoint of a peer to join; may be repeated",
    )
    add(
        "--insecure",
        action="store_true",
        help="allow endpoints that leave this machine unprotected",
    )


def bus_config(options: argparse.Namespace, table: BusTable, role: Role) -> BusConfig:
    """How to join the bus; flags win over the file."""
    return BusConfig(
        role=role,
        listen=tuple(options.listen) if options.listen else table.listen,
        connect=tuple(options.connect) if options.connect else table.connect,
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
