"""Tables shared by the configuration files of all daemons, and their combination with options."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Annotated

import msgspec
from msgspec import Meta

from tactile_core.bus.keys import TlsConfig
from tactile_core.bus.session import BusConfig, Role
from tactile_core.cli import DEFAULT_LOG
from tactile_core.log.recorder import RecorderSettings

DEFAULT_LOG_BYTES = 32 << 30
"""Default limit in bytes for the logs of one name in a folder; beyond it the oldest are deleted.
About 18 h of one board at 100 Hz."""


class LogTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """``[log]``: where the log is written; ``[log.recorder]``: how it is split."""

    enabled: Annotated[bool, Meta(description="whether a log is written")] = True
    destination: Annotated[
        str, Meta(description="a folder for dated files, or a file that ends in .mcap")
    ] = DEFAULT_LOG
    recorder: RecorderSettings = RecorderSettings(max_bytes=DEFAULT_LOG_BYTES)


class BusTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """``[bus]``: zenoh endpoints, and who may join (see security.md)."""

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
        Meta(description="no authentication: whoever reaches an endpoint may command"),
    ] = False


def bus_config(options: argparse.Namespace, table: BusTable, role: Role) -> BusConfig:
    """Bus configuration of ``role``; options override the file."""
    return BusConfig(
        role=role,
        listen=tuple(options.listen) if options.listen else table.listen,
        connect=tuple(options.connect) if options.connect else table.connect,
        keys=options.keys or table.keys,
        tls=table.tls,
        insecure=options.insecure or table.insecure,
    )


def log_destination(options: argparse.Namespace, table: LogTable) -> Path | None:
    """Folder or file of the log, None for no log; options override the file."""
    if options.no_log:
        return None
    if options.log is not None:
        return Path(options.log)
    return Path(table.destination) if table.enabled else None
