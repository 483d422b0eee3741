"""zenoh sessions: secure by default, never blocking, bounded."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import textwrap
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import zenoh

from tactile_core.bus import topics
from tactile_core.bus.keys import Roles, TlsConfig
from tactile_core.bus.messages import MAX_PAYLOAD
from tactile_core.bus.session import (
    PORTS,
    BusConfig,
    BusError,
    close_session,
    open_session,
)
from tactile_core.bus.streams import (
    BusSample,
    Tap,
    declare_alive,
    declare_publisher,
    latest,
    list_alive,
)
from tests.support.network import free_port
from tests.support.waiting import PATIENCE_S, wait_until

SUBSCRIBER = textwrap.dedent("""
    import sys, time
    from tactile_core.bus.session import BusConfig, open_session
    from tactile_core.bus.streams import latest
    config = BusConfig(listen=(), connect=(f"tcp/127.0.0.1:{sys.argv[1]}",))
    stream = latest(open_session(config), sys.argv[2])
    print("ready", flush=True)
    while True:
        sample = stream.newest()
        if sample is not None:
            print(sample.sequence, stream.skipped, flush=True)
        time.sleep(float(sys.argv[3]))
""")


@pytest.fixture
def subscriber() -> Iterator[Any]:
    """``subscriber(port, key, pause)``: a real process that prints the samples it processes."""
    processes = []

    def start(port: int, key: str, pause: float) -> subprocess.Popen[str]:
        command = [sys.executable, "-c", SUBSCRIBER, str(port), key, str(pause)]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        processes.append(process)
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        return process

    yield start
    for process in processes:
        process.kill()
        process.wait()
        process.stdout.close()


def test_default_endpoints_are_local_only() -> None:
    roles: Any = (*PORTS, "tool")
    for role in roles:
        config = BusConfig(role=role)
        for endpoint in (*config.listen_endpoints(), *config.connect_endpoints()):
            assert endpoint.startswith("unixsock-stream//")
    assert BusConfig(role="tool").listen_endpoints() == ()
    # Each pair of roles connects in one direction only.
    assert BusConfig(role="tactiled").connect_endpoints() == ()
    names = [Path(e).stem for e in BusConfig(role="arm").connect_endpoints()]
    assert names == ["tactiled", "reachd"]


@pytest.mark.parametrize(
    "endpoint",
    ["tcp/0.0.0.0:0", "tcp/[::]:0", "tcp/192.168.1.5:7447", "udp/10.0.0.1:1", "tcp/robot.local:1"],
)
def test_off_host_endpoints_are_refused(endpoint: str) -> None:
    for config in (BusConfig(listen=(endpoint,)), BusConfig(connect=(endpoint,))):
        with pytest.raises(BusError, match="--insecure"):
            open_session(config)


def test_off_host_endpoints_are_accepted_when_explicit(caplog: Any) -> None:
    session = open_session(BusConfig(listen=("tcp/0.0.0.0:0",), connect=(), insecure=True))
    assert "without protection" in caplog.text
    close_session(session)


def test_tls_without_keys_or_names_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BusError, match=r"--keys FOLDER"):
        open_session(BusConfig(listen=("tls/0.0.0.0:0",)))
    for name in ("a", "b", "c"):
        (tmp_path / name).write_text("x", encoding="ascii")
        (tmp_path / name).chmod(0o600)
    files = [str(tmp_path / name) for name in ("a", "b", "c")]
    tls = TlsConfig(root_ca=files[0], certificate=files[1], private_key=files[2], roles=Roles())
    with pytest.raises(BusError, match="roles is empty"):
        open_session(BusConfig(listen=("tls/0.0.0.0:0",), connect=(), tls=tls))


def test_invalid_endpoint_is_named() -> None:
    with pytest.raises(BusError, match="robot"):
        open_session(BusConfig(listen=(), connect=("robot",), insecure=True))


def test_busy_port_is_named_with_a_remedy(bus: Any) -> None:
    port = free_port()
    bus(listen=port)
    with pytest.raises(BusError, match=rf"127.0.0.1:{port} is in use.*--listen"):
        bus(listen=port)


def test_samples_carry_sequence_stamp_and_source(bus: Any) -> None:
    port = free_port()
    publisher = declare_publisher(bus(listen=port), topics.FEATURES, "b0")
    stream = latest(bus(connect=port), "tactile/*/features")
    wait_until(lambda: publisher.put(b"x", 1) or stream.newest())
    publisher.put(b"data", 123)
    sample = stream.wait(PATIENCE_S)
    while sample.data != b"data":
        sample = stream.wait(PATIENCE_S)
    assert sample.key == "tactile/b0/features"
    assert (sample.wall_ns, sample.source) == (123, publisher.source)
    assert sample.sequence == publisher.sequence


def test_slow_reader_gets_newest_and_counts_skipped(bus: Any) -> None:
    port = free_port()
    publisher = declare_publisher(bus(listen=port), topics.FEATURES, "b0")
    session = bus(connect=port)
    stream = latest(session, publisher.key)
    wait_until(lambda: publisher.put(b"x", 1) or stream.newest())
    publisher.put(b"now", 1)
    wait_until(lambda: (sample := stream.newest()) is not None and sample.data == b"now")
    received, skipped, sent = stream.received, stream.skipped, publisher.sequence
    heard = threading.Event()
    tap = Tap(session, publisher.key, lambda s: s.sequence == sent + 500 and heard.set())
    for _ in range(500):
        publisher.put(b"x", 1)
        time.sleep(0.0005)
    assert heard.wait(PATIENCE_S)
    sample = stream.wait(PATIENCE_S)
    assert sample.sequence == sent + 500
    assert stream.received == received + 1
    assert stream.skipped == skipped + 499
    tap.close()
    assert stream.newest() is None


def test_no_sample_is_taken_once_a_tap_is_closed(bus: Any) -> None:
    """So a log that is closed after its tap has every sample that its owner was given."""
    port = free_port()
    publisher = declare_publisher(bus(listen=port), topics.FEATURES, "b0")
    taking, finish, taken = threading.Event(), threading.Event(), []

    def take(sample: BusSample) -> None:
        taking.set()
        finish.wait(PATIENCE_S)
        taken.append(sample.sequence)

    tap = Tap(bus(connect=port), publisher.key, take)
    wait_until(lambda: publisher.put(b"x", 1) or taking.is_set())
    closer = threading.Thread(target=tap.close)
    closer.start()
    for _ in range(20):
        publisher.put(b"x", 1)
    assert taken == []
    assert closer.is_alive()
    finish.set()
    closer.join(PATIENCE_S)
    seen = list(taken)
    assert seen
    late = latest(bus(connect=port), publisher.key)
    wait_until(lambda: publisher.put(b"x", 1) or late.newest())
    assert taken == seen


@pytest.mark.parametrize("kind", ["publisher", "reader"])
def test_any_thread_may_close_what_another_uses(bus: Any, kind: str) -> None:
    """zenoh itself raises RuntimeError in one of the two threads."""
    session = bus(listen=free_port())
    for _ in range(30):
        publisher = declare_publisher(session, topics.FEATURES, "b0")
        stream = latest(session, publisher.key)
        use = partial(publisher.put, bytes(2000), 1) if kind == "publisher" else stream.newest
        used, ended = threading.Event(), threading.Event()
        with ThreadPoolExecutor(1) as other:
            using = other.submit(call_until, ended, use, used)
            wait_until(lambda used=used, using=using: used.is_set() or using.done())
            try:
                publisher.close()
                stream.close()
            finally:
                ended.set()
            using.result(PATIENCE_S)  # raises what was raised there
    publisher.put(b"x", 1)
    assert stream.newest() is None


def call_until(ended: threading.Event, use: Callable[[], object], used: threading.Event) -> None:
    while not ended.is_set():
        use()
        used.set()


def test_slow_process_acts_on_newest_sample(bus: Any, subscriber: Any) -> None:
    """Row 21: a reader that needs 0.2 s per sample does not fall behind."""
    port = free_port()
    publisher = declare_publisher(bus(listen=port), topics.FEATURES, "b0")
    process = subscriber(port, publisher.key, 0.2)
    seen = []

    def read() -> None:
        for line in process.stdout:
            seen.append(int(line.split()[0]))

    reader = threading.Thread(target=read)
    reader.start()
    while publisher.sequence < 1000 or len(seen) < 5:
        publisher.put(bytes(1000), 1)
        time.sleep(0.002)
    # With a queue it would arrive only after 200 s.
    wait_until(lambda: seen[-1] == publisher.sequence)
    process.kill()
    reader.join()
    assert seen == sorted(set(seen))
    assert len(seen) < publisher.sequence


def test_stopped_subscriber_blocks_nobody(bus: Any, subscriber: Any) -> None:
    """Row 20: with one reader under SIGSTOP, publishing continues and others get everything."""
    port = free_port()
    session = bus(listen=port)
    publisher = declare_publisher(session, topics.FEATURES, "b0")
    stopped = subscriber(port, publisher.key, 0.01)
    stream = latest(bus(connect=port), publisher.key)
    wait_until(lambda: publisher.put(b"x", 1) or stream.newest())
    os.kill(stopped.pid, signal.SIGSTOP)
    try:
        # Far more than sockets and queues hold. A publisher that blocks would wait 5 s for each,
        # and this test would not end.
        for _ in range(3000):
            publisher.put(bytes(20_000), 1)
            time.sleep(0.0003)
        wait_until(lambda: (stream.newest() or publisher.put(b"last", 1)) is not None)
    finally:
        os.kill(stopped.pid, signal.SIGCONT)
    assert stream.received > 0


def test_oversized_payloads_are_refused(bus: Any) -> None:
    port = free_port()
    session = bus(listen=port)
    publisher = declare_publisher(session, topics.FEATURES, "b0")
    with pytest.raises(ValueError, match="65536 allowed"):
        publisher.put(bytes(MAX_PAYLOAD + 1), 1)
    stream = latest(bus(connect=port), publisher.key)
    wait_until(lambda: publisher.put(bytes(MAX_PAYLOAD), 1) or stream.newest())

    def heard_now() -> bool:
        publisher.put(b"now", 1)  # again and again: zenoh may drop it behind the large ones
        return (sample := stream.newest()) is not None and sample.data == b"now"

    wait_until(heard_now)
    # A sender that ignores the limit: slightly above it we count, far above zenoh drops.
    block = zenoh.CongestionControl.BLOCK
    session.put(publisher.key, bytes(MAX_PAYLOAD + 100), congestion_control=block)
    wait_until(lambda: stream.newest() is None and stream.refused == 1)
    session.put(publisher.key, bytes(4 << 20))
    wait_until(lambda: publisher.put(b"still here", 1) or stream.newest() is not None)
    assert stream.refused <= 2  # counted, or dropped on its way


def test_plain_zenoh_publisher_is_understood(bus: Any) -> None:
    port = free_port()
    session = bus(listen=port)
    stream = latest(bus(connect=port), "arm/a/state")
    wait_until(lambda: session.put("arm/a/state", b"x") or stream.newest())
    session.put("arm/a/state", b"y", attachment=b"odd")
    sample = stream.wait(PATIENCE_S)
    assert sample.data in (b"x", b"y")
    assert (sample.sequence, sample.wall_ns, sample.source) == (None, None, None)


def test_daemons_connect_in_any_start_order(bus: Any) -> None:
    port = free_port()
    early = bus(connect=port)
    assert list_alive(early, 0.2) == []
    late = bus(listen=port)
    token = declare_alive(late, "b0")
    wait_until(lambda: list_alive(early, 1) == ["b0"])
    token.undeclare()
    wait_until(lambda: list_alive(early, 0.1) == [])
    close_session(late)
    again = bus(listen=port)  # restarted: found again automatically
    _token = declare_alive(again, "b0")
    wait_until(lambda: list_alive(early, 1) == ["b0"])


@pytest.mark.parametrize(
    "way", ["", "close_session(session)", "session.close()", "raise SystemExit(7)"]
)
def test_process_that_used_the_bus_exits(way: str) -> None:
    """With a subscriber callback and a service, which run on zenoh's own threads."""
    code = textwrap.dedent(f"""
        from tactile_core.bus.session import BusConfig, open_session, close_session
        from tactile_core.bus.services import declare_service
        session = open_session(BusConfig(listen=("tcp/127.0.0.1:{free_port()}",), connect=()))
        session.declare_subscriber("a/b", lambda sample: None)
        declare_service(session, "tactile/b0/srv/status", lambda request: request)
        {way}
    """)
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, timeout=240, check=False
    )
    assert result.returncode == (7 if "SystemExit" in way else 0)
    assert b"Traceback" not in result.stderr


def test_closing_does_not_wait_for_a_stopped_peer(subscriber: Any) -> None:
    port = free_port()
    session = open_session(BusConfig(listen=(f"tcp/127.0.0.1:{port}",), connect=()))
    publisher = declare_publisher(session, topics.FEATURES, "b0")
    process = subscriber(port, publisher.key, 0.01)
    wait_until(lambda: session.info.peers_zid())
    os.kill(process.pid, signal.SIGSTOP)
    for _ in range(3000):
        publisher.put(bytes(20_000), 1)
    assert not close_session(session, 0.5)  # zenoh by itself waits 10 s, and says that it closed
    os.kill(process.pid, signal.SIGCONT)
