"""Latency of the live page beside the raw bus, and cost of the client above the codec."""

from __future__ import annotations

import contextlib
import json
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import psutil
import zenoh
from websockets.sync.client import ClientConnection, connect

from tactile_core.bus.messages import codec
from tactile_core.bus.session import BusConfig, close_session, open_session
from tactile_core.bus.topics import FEATURES
from tactile_reach.client import Bus
from tactile_tools.processes import command, free_port, running, socket_at, wait_for

NAME = "view"
SETTLE_S = 8.0  # imports, identification, tare
SAMPLES = 2000
WAIT_S = 120.0


@contextlib.contextmanager
def _finger(folder: Path) -> Iterator[str]:
    """Simulated finger at 100 Hz and its tactiled; yields the endpoint."""
    board, endpoint = folder / "b", socket_at(folder, "tactiled")
    daemon = [command("tactiled"), "--port", str(board), "--name", NAME, "--no-log"]
    with running(
        [command("simdevice"), "boards", "--seed", "1", "--pty", str(board)], folder / "sim.txt"
    ) as simulator:
        wait_for(board, simulator, folder / "sim.txt")
        with running([*daemon, "--listen", endpoint], folder / "tactiled.txt"):
            yield endpoint


def bench_view(*, quick: bool = False) -> dict[str, float]:
    """Return ``view_latency_ms_p50``, ``_p99`` and ``view_cpu_pct`` with one viewer.

    Latency: from the arrival of features at a raw subscriber in this process to that of the first
    frame that holds them or later ones, over all features. ``view_cpu_pct``: percent of one core,
    for the page's whole process.
    """
    seconds = 8.0 if quick else 40.0
    with tempfile.TemporaryDirectory(prefix="tactile-view-") as name:
        folder = Path(name)
        with _finger(folder) as endpoint:
            port = free_port()
            words = [command("tactile"), "view", "--port", str(port), "--connect", endpoint]
            with running(words, folder / "view.txt") as page:
                return _watch(port, endpoint, page.pid, seconds)


def _watch(port: int, endpoint: str, pid: int, seconds: float) -> dict[str, float]:
    bus: list[tuple[int, int]] = []
    shown: list[tuple[int, int]] = []

    def hear(sample: zenoh.Sample) -> None:
        now = time.monotonic_ns()
        bus.append((now, codec().decode(FEATURES, sample.payload.to_bytes()).sequence))

    session = open_session(BusConfig(listen=(), connect=(endpoint,)))
    try:
        subscriber = session.declare_subscriber(FEATURES.key(NAME), hear)
        _wait_for_port(port)
        with connect(f"ws://127.0.0.1:{port}/live") as socket:
            _take(socket, shown, SETTLE_S)
            bus.clear()
            shown.clear()
            watched = psutil.Process(pid)
            before, started = watched.cpu_times(), time.monotonic()
            _take(socket, shown, seconds)
            after, elapsed = watched.cpu_times(), time.monotonic() - started
        subscriber.undeclare()
    finally:
        close_session(session)
    if len(shown) < 2 or len(bus) < 10:
        raise RuntimeError(f"only {len(shown)} frames and {len(bus)} features came")
    # Both are in the order of their sequence numbers, except for a tare, which starts again.
    late, at = [], 0
    for came, sequence in bus:
        while at < len(shown) and shown[at][1] < sequence:
            at += 1
        if at < len(shown):
            late.append((shown[at][0] - came) * 1e-6)
    spent = (after.user + after.system) - (before.user + before.system)
    return {
        "view_latency_ms_p50": float(np.percentile(late, 50)),
        "view_latency_ms_p99": float(np.percentile(late, 99)),
        "view_frames_per_s": len(shown) / elapsed,
        "view_cpu_pct": 100.0 * spent / elapsed,
    }


def _wait_for_port(port: int) -> None:
    deadline = time.monotonic() + WAIT_S
    while True:
        try:
            with connect(f"ws://127.0.0.1:{port}/live"):
                return
        except OSError:
            if time.monotonic() > deadline:
                raise
            time.sleep(0.1)


def _take(socket: ClientConnection, shown: list[tuple[int, int]], seconds: float) -> None:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        data = socket.recv(timeout=WAIT_S)
        now = time.monotonic_ns()
        frame = json.loads(data).get("frame")
        if frame is None:
            continue
        socket.send(json.dumps({"ack": frame["n"]}))
        board = frame["boards"].get(NAME)
        if board is not None and board["force"] is not None:
            shown.append((now, board["force"]["seq"]))


def bench_client(*, quick: bool = False) -> dict[str, float]:
    """Return ``client_us``, ``codec_us`` and ``client_overhead_us``, medians per features message.

    ``client``: from a sample in zenoh's callback to typed features at the reader.
    ``codec``: decoding of the same bytes alone, measured alternately.
    """
    rounds = 3 if quick else 10
    with tempfile.TemporaryDirectory(prefix="tactile-client-") as name:
        folder = Path(name)
        samples: list[zenoh.Sample] = []
        enough = threading.Event()

        def hear(sample: zenoh.Sample) -> None:
            samples.append(sample)
            if len(samples) >= SAMPLES // 10:
                enough.set()

        with _finger(folder) as endpoint, Bus(BusConfig(connect=(endpoint,))) as bus:
            subscriber = bus.session.declare_subscriber(FEATURES.key(NAME), hear)
            if not enough.wait(WAIT_S):
                raise RuntimeError(f"only {len(samples)} features came")
            subscriber.undeclare()
            stream = bus.board(NAME).features()
            stream.close()  # from here on it gets the samples kept, one by one
            stream._closed = False
            client, bare = [], []
            for _ in range(rounds):
                for sample in samples:
                    start = time.perf_counter_ns()
                    codec().decode(FEATURES, sample.payload.to_bytes())
                    middle = time.perf_counter_ns()
                    stream._on_sample(sample)
                    next(stream)
                    client.append(time.perf_counter_ns() - middle)
                    bare.append(middle - start)
    whole, alone = float(np.median(client)) * 1e-3, float(np.median(bare)) * 1e-3
    return {
        "client_us": whole,
        "codec_us": alone,
        "client_overhead_us": whole - alone,
    }
