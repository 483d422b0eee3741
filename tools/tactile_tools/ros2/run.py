"""Run the bridge as a process: sessions, signals and reports."""

from __future__ import annotations

import argparse
import logging
import signal
import sys
import threading
import time

import zenoh

from tactile_core.bus.session import BusError, close_session, open_session
from tactile_core.options import BusTable, bus_config
from tactile_tools.ros2.bridge import Bridge
from tactile_tools.ros2.node import RosNode, RouterError

log = logging.getLogger(__name__)

TICK_S = 0.02
"""Period at which new streams are looked for, s."""

TELL_S = 10.0
"""Period at which a running bridge reports what it passed on, s."""

QUIET_S = 5.0
"""Silence of the bus after which it is mentioned, once, s."""

DONE, USAGE, REFUSED = 0, 2, 3


def run(options: argparse.Namespace) -> int:
    """Run ``tactile ros2 bridge``; returns the exit status."""
    logging.basicConfig(
        format="%(levelname)s %(message)s",
        level=logging.DEBUG if options.verbose else logging.INFO,
        stream=sys.stderr,
    )
    stopping = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stopping.set())
    config = bus_config(options, BusTable(), "tool")
    try:
        bus = open_session(config)
    except BusError as error:
        print(f"tactile ros2 bridge: {error}", file=sys.stderr)
        return USAGE
    try:
        node = RosNode(
            options.router,
            options.node,
            namespace=options.namespace,
            domain=options.domain,
            distro=options.distro,
        )
    except RouterError as error:
        print(f"tactile ros2 bridge: {error}", file=sys.stderr)
        close_session(bus)
        return REFUSED
    try:
        _serve(options, node, bus, config.where(), stopping)
    finally:
        node.close()
        close_session(bus)
    return DONE


def _serve(
    options: argparse.Namespace,
    node: RosNode,
    bus: zenoh.Session,
    where: str,
    stopping: threading.Event,
) -> None:
    """Bridge until stopped, reporting now and then what was passed on."""
    bridge = Bridge(bus, node, accept=frozenset(options.accept), reach=options.reach)
    print(
        f"bridging to {options.router}, domain {options.domain}, {options.distro}; from ROS: "
        f"{', '.join(sorted(set(options.accept))) or 'nothing (see --accept)'}",
        flush=True,
    )
    start = told = time.monotonic()
    quiet = True
    try:
        while not stopping.wait(TICK_S):
            bridge.tick()
            now = time.monotonic()
            if quiet and bridge.routes:
                quiet = False
            elif quiet and now - start > QUIET_S:
                quiet = False
                log.warning(
                    "nothing on the bus yet%s: is tactiled running, with the same keys and "
                    "TACTILE_RUNTIME_DIR?",
                    where,
                )
            if now - told >= TELL_S:
                told = now
                log.info("%s", _counts(bridge))
    finally:
        bridge.close()
        print(_counts(bridge), flush=True)


def _counts(bridge: Bridge) -> str:
    counts = dict(bridge.counts)
    head = f"to ROS {counts.pop('to_ros', 0)}, from ROS {counts.pop('from_ros', 0)}"
    rest = ", ".join(f"{reason.replace('_', ' ')} {n}" for reason, n in sorted(counts.items()) if n)
    return f"{head}; {rest}" if rest else head
