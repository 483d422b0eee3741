"""``tactile list``: what is published on the bus, and which services can be called."""

from __future__ import annotations

import argparse
import time
from collections import Counter

import zenoh

from tactile_core.bus.messages import DecodeError
from tactile_core.bus.rights import READS
from tactile_core.bus.topics import service_key
from tactile_core.options import BusTable, bus_config
from tactile_reach.client import NotThereError, type_of
from tactile_tools import watching

LISTEN_S = 1.5
"""Long enough to hear what is published once a second."""

KEYS = 4096
"""Greatest number of keys that are told apart."""

SERVICES = {
    "tactile": ("status", "tare", "set_rate", "record", "recalibrate", "geometry"),
    "arm": ("status", "limits", "clear", "claim", "release"),
    "reach": ("status", "goal", "arm", "stop", "reset", "clear"),
}
"""Services of each kind of participant."""


def list_bus(options: argparse.Namespace) -> None:
    """Print keys and services; `NotThereError` when nothing is on the bus."""
    counts: Counter[str] = Counter()
    types: dict[str, str] = {}

    def hear(sample: zenoh.Sample) -> None:
        key = str(sample.key_expr)
        if key not in types:
            if len(types) >= KEYS:
                return
            try:
                types[key] = type_of(sample)
            except DecodeError:
                types[key] = "?"
        counts[key] += 1

    with watching.open_bus(options) as bus:
        boards = bus.boards()
        subscribers = [bus.session.declare_subscriber(key, hear) for key in READS]
        time.sleep(LISTEN_S)
        for subscriber in subscribers:
            subscriber.undeclare()
        names = {("tactile", board) for board in boards}
        for kind in ("arm", "reach"):
            for reply in bus.session.liveliness().get(f"{kind}/*/alive", timeout=0.3):
                if reply.ok is not None:
                    names.add((kind, str(reply.ok.key_expr).split("/")[1]))
    if not names and not types:
        where = bus_config(options, BusTable(), "tool").where()
        raise NotThereError(
            f"nothing is on the bus{where}: start a daemon, or name an endpoint with --connect"
        )
    width = max((len(key) for key in types), default=0)
    for key in sorted(types):
        print(f"{key:{width}}  {counts[key] / LISTEN_S:6.1f} Hz  {types[key]}")
    print()
    for kind, name in sorted(names):
        for service in SERVICES[kind]:
            print(f"{service_key(name, service, kind)}  (ask it with `tactile call`)")
