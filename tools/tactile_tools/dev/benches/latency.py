"""Latency from the last byte written to a tty to features in another process, beside a minimum."""

from __future__ import annotations

import json
import os
import pty
import select
import sys
import tempfile
import time
import tty
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from sensor_proto.framing import SerialDecoder
from sensor_proto.packets import Samples
from sim_device.board.catalogue import build_skin, identity
from sim_device.board.firmware import SerialBoard
from tactile_core.bus.messages import codec
from tactile_core.bus.session import BusConfig, open_session
from tactile_core.bus.topics import FEATURES
from tactile_core.types import Instant, monotonic_now
from tactile_tools.processes import command, running, socket_at

PERIOD_S = 0.010  # 100 Hz, the finger's usual rate
FLOOR_KEY = "bench/floor"
FLOOR_BYTES = 700  # about what the finger's three arrays send in a cycle
SETTLE_S = 6.0  # identification, clock and tare come first
NAME = "latency"

FLOOR = """
import serial, sys, zenoh
config = zenoh.Config()
for key, value in (("mode", '"peer"'), ("scouting/multicast/enabled", "false"),
                   ("scouting/gossip/enabled", "false"), ("listen/endpoints", sys.argv[2])):
    config.insert_json5(key, value)
with zenoh.open(config) as session, serial.Serial(sys.argv[1]) as port:
    publisher = session.declare_publisher("bench/floor")
    while True:
        publisher.put(port.read(port.in_waiting or 1))
"""
"""The minimum: bytes from the tty, as they come, to zenoh."""


def bench_latency(*, quick: bool = False) -> dict[str, float]:
    """Return ``wire_to_feature_ms_*`` and ``floor_ms_*``, measured in turn, 5 ms apart, at 100 Hz.

    ``wire``: from the return of the write of a cycle's last byte to the arrival of its features
    in this process. ``floor``: the same for raw bytes through a pty and a bare zenoh put.
    """
    seconds = 8.0 if quick else 60.0
    with tempfile.TemporaryDirectory(prefix="tactile-latency-") as name:
        folder = Path(name)
        floor_at = socket_at(folder, "floor")
        with _tty() as (board_end, board_path), _tty() as (floor_end, floor_path):
            endpoint = socket_at(folder, "tactiled")
            daemon = [
                *(command("tactiled"), "--port", board_path, "--name", NAME),
                *("--listen", endpoint, "--log", str(folder / "latency.mcap")),
            ]
            floor = [
                *(sys.executable, "-c", FLOOR, floor_path),
                json.dumps([floor_at]),
            ]
            with (
                running(daemon, folder / "tactiled.txt"),
                running(floor, folder / "floor.txt"),
            ):
                run = _Run(board_end, floor_end, endpoint, floor_at)
                try:
                    run.drive(seconds)
                finally:
                    run.close()
            wire, bare = run.results()
            if len(wire) < seconds / PERIOD_S / 2 or len(bare) < seconds / PERIOD_S / 2:
                output = (folder / "tactiled.txt").read_text(errors="replace")[-1500:]
                raise RuntimeError(
                    f"only {len(wire)} features and {len(bare)} bare messages came; "
                    f"tactiled output: {output}"
                )
    return {
        "wire_to_feature_ms_p50": float(np.percentile(wire, 50)),
        "wire_to_feature_ms_p99": float(np.percentile(wire, 99)),
        "floor_ms_p50": float(np.percentile(bare, 50)),
        "floor_ms_p99": float(np.percentile(bare, 99)),
        "wire_to_feature_floor_ratio": float(np.percentile(wire, 50) / np.percentile(bare, 50)),
        "wire_to_feature_cycles": float(len(wire)),
    }


@contextmanager
def _tty() -> Iterator[tuple[int, str]]:
    """Yield our end of a raw pseudo-terminal, non-blocking, and the path of the other."""
    master, slave = pty.openpty()
    try:
        tty.setraw(slave)
        os.set_blocking(master, False)
        yield master, os.ttyname(slave)
    finally:
        os.close(master)
        os.close(slave)


class _Run:
    """Simulates the board, sends the bare bytes, and times what comes back."""

    def __init__(self, board_end: int, floor_end: int, tactiled: str, floor: str) -> None:
        self._board_end, self._floor_end = board_end, floor_end
        self._board = SerialBoard(build_skin("finger", 1), identity("finger", 1))
        self._own = SerialDecoder()
        self._sent: dict[int, int] = {}
        self._floor_sent: list[int] = []
        self._floor_bytes = 0
        self._wire: list[float] = []
        self._bare: list[float] = []
        self._counting = False
        self._session = open_session(BusConfig(listen=(), connect=(tactiled,)))
        # The bare program does not check who reads it, so this reader presents no keys.
        self._bare_session = open_session(BusConfig(listen=(), connect=(floor,), insecure=True))
        self._subscribers = (
            self._session.declare_subscriber(FEATURES.key(NAME), self._on_features),
            self._bare_session.declare_subscriber(FLOOR_KEY, self._on_floor),
        )

    def _on_features(self, sample: Any) -> None:
        now = time.monotonic_ns()
        sequence = codec().decode(FEATURES, sample.payload.to_bytes()).sequence
        sent = self._sent.pop(sequence, None)
        if sent is not None and self._counting:
            self._wire.append((now - sent) * 1e-6)

    def _on_floor(self, sample: Any) -> None:
        now = time.monotonic_ns()
        self._floor_bytes += len(sample.payload)
        turn, rest = divmod(self._floor_bytes, FLOOR_BYTES)
        if rest == 0 and self._counting:
            self._bare.append((now - self._floor_sent[turn - 1]) * 1e-6)

    def drive(self, seconds: float) -> None:
        """Send both, 5 ms apart, for the settling time and then ``seconds`` more."""
        start = monotonic_now()
        due, turn = start, 0
        while (elapsed := (monotonic_now() - start) * 1e-9) < SETTLE_S + seconds:
            self._counting = elapsed > SETTLE_S
            due = Instant(due + round(PERIOD_S * 0.5e9))
            self._serve_until(due)
            if turn % 2 and elapsed < SETTLE_S / 2:
                pass  # nobody reads yet: the tty would fill up
            elif turn % 2:
                self._floor_sent.append(0)
                os.write(self._floor_end, b"\x55" * FLOOR_BYTES)
                self._floor_sent[-1] = time.monotonic_ns()
            else:
                self._cycle()
            turn += 1

    def _cycle(self) -> None:
        data = self._board.tick(monotonic_now())
        if not data:
            return
        os.write(self._board_end, data)
        written = time.monotonic_ns()
        for received in self._own.feed(data):
            if isinstance(received.message, Samples):
                self._sent[received.message.sequence] = written

    def _serve_until(self, due: Instant) -> None:
        """Pass what the host sends to the board, as soon as it comes, until ``due``."""
        while (left := (due - monotonic_now()) * 1e-9) > 0:
            if select.select([self._board_end], [], [], left)[0]:
                self._board.receive(os.read(self._board_end, 4096), monotonic_now())

    def results(self) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
        """Return both latencies, ms."""
        return np.asarray(self._wire), np.asarray(self._bare)

    def close(self) -> None:
        """Leave the bus; otherwise the process would hang at exit."""
        self._session.close()
        self._bare_session.close()
