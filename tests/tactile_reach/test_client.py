"""The client on its own bus: streams, their bounds, services, error messages."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zenoh

import tactile_reach as tr
from tactile_core.bus.messages import MSG, codec, header
from tactile_core.bus.services import ServiceError, declare_service
from tactile_core.bus.session import BusConfig, close_session, open_session
from tactile_core.bus.streams import Publisher, declare_alive, declare_publisher
from tactile_core.bus.topics import ARM_STATE, FEATURES, FORCES, service_key
from tactile_tools.cli import main
from tests.support.waiting import PATIENCE_S, wait_until

SLOW_S = PATIENCE_S
LAST = 1_000_000


def features(sequence: int, normal: float = 1.5) -> bytes:
    zero, here = MSG.Vector3(0.0, 0.0, 0.0), MSG.Point(0.1, 0.2, 0.3)
    out = MSG.Vector3(1.0, 0.0, 0.0)
    patch = MSG.ContactPatch(0, 3, 2, 0.9, 0.6, MSG.Vector3(-0.9, 0.0, 1.2), here, out, 0.25)
    message = MSG.ContactFeatures(
        header=header(5_000_000_007, "ee"), captured_ns=9, received_ns=10, uncertainty=0.0,
        sequence=sequence, valid=False, reasons=["taring"], calibrated=True, peak_force=1.0,
        peak_side=3, peak_position=here, normal_force=normal, wrench=MSG.Wrench(zero, zero),
        tip_force=0.5, tip_contact_time=0.0, taxels_in_contact=4, taxels_masked=1, patches=[patch],
        reason_codes=["taring"], peak_force_bound=0.1, normal_force_bound=0.2, tip_force_bound=0.3,
    )  # fmt: skip
    return codec().encode(FEATURES, message)


class Daemon:
    """Publishes and serves like a tactiled for the boards left and right."""

    def __init__(self, folder: Path) -> None:
        self.endpoint = f"unixsock-stream/{folder}/d.sock"
        self.session = open_session(BusConfig(listen=(self.endpoint,), connect=()))
        self.tokens = [declare_alive(self.session, name) for name in ("left", "right")]
        self.asked: list[tuple[str, Any]] = []
        self.services = [
            declare_service(self.session, service_key("left", name), self._answer(name))
            for name in ("tare", "status", "record", "set_rate")
        ]

    def _answer(self, name: str) -> Any:
        def answer(request: dict[str, Any]) -> Any:
            self.asked.append((name, request))
            if name == "tare" and not request["force"]:
                raise ServiceError("tare refused: the skin is touched")
            return {"message": "rest field set", "path": "/x/a.mcap", "rate_hz": 50.0}

        return answer

    def publisher(self, name: str = "left") -> Publisher:
        return declare_publisher(self.session, FEATURES, name)


@pytest.fixture
def daemon(tmp_path: Path) -> Iterator[Daemon]:
    made = Daemon(tmp_path)
    yield made
    close_session(made.session)


@pytest.fixture
def bus(daemon: Daemon) -> Iterator[tr.Bus]:
    with tr.connect(daemon.endpoint, find_s=SLOW_S) as joined:
        yield joined


def connected(publisher: Publisher, stream: tr.Stream[Any]) -> None:
    """Publish until the stream hears it, then read all that came."""
    while stream.get(0.02) is None:
        publisher.put(features(1), 0)
    publisher.put(features(LAST), 0)
    drain(stream)


def drain(stream: tr.Stream[Any]) -> None:
    """Read up to the last message that `connected` published."""
    while stream.get(SLOW_S).sequence != LAST:
        pass


def test_values_match_the_message(daemon: Daemon, bus: tr.Bus) -> None:
    with bus.board("left").features(timeout_s=SLOW_S) as stream:
        publisher = daemon.publisher()
        connected(publisher, stream)
        publisher.put(features(77, 2.5), 0)
        f = next(stream)
    assert (f.sequence, f.normal_force, f.normal_force_bound) == (77, 2.5, pytest.approx(0.2))
    assert (f.valid, f.reasons, f.peak_side) == (False, ("taring",), "tip")
    assert f.wall_ns == 5_000_000_007
    assert f.patches[0].side == "tip"
    assert f.patches[0].centroid == (0.1, 0.2, 0.3)
    assert (f.patches[0].normal, f.patches[0].normal_force_bound) == ((1.0, 0.0, 0.0), 0.25)
    assert f.shear_force == pytest.approx(1.2)


def test_slow_reader_gets_newest_and_counts_dropped(daemon: Daemon, bus: tr.Bus) -> None:
    board, publisher = bus.board("left"), daemon.publisher()
    with board.features() as newest, board.features(queue=3) as some:
        connected(publisher, newest)
        drain(some)
        before = some.received, newest.dropped, some.dropped
        count = newest.received
        for number in range(100, 110):
            publisher.put(features(number), 0)
        wait_until(
            lambda: some.received == before[0] + 10 and newest.received == count + 10,
        )
        assert next(newest).sequence == 109
        assert [next(some).sequence for _ in range(3)] == [107, 108, 109]
        assert (newest.dropped - before[1], some.dropped - before[2]) == (9, 7)


def test_undecodable_bytes_are_counted_and_skipped(daemon: Daemon, bus: tr.Bus) -> None:
    publisher = daemon.publisher()
    with bus.board("left").features(queue=10) as stream:
        connected(publisher, stream)
        publisher.put(b"\0\1\0\0nonsense", 0)
        publisher.put(features(5), 0)
        assert stream.get(SLOW_S).sequence == 5
        assert stream.refused == 1


def test_silence_raises_error_and_closing_ends_iteration(bus: tr.Bus) -> None:
    with pytest.raises(tr.SilentError, match=r"nothing came on tactile/left/features for 0\.05 s"):
        bus.board("left").newest(0.05)
    stream = bus.board("left").features()
    seen: list[Any] = []
    reader = threading.Thread(target=lambda: seen.extend(stream))
    reader.start()
    stream.close()
    reader.join(SLOW_S)
    assert not reader.is_alive()
    assert seen == []


def test_boards_are_listed_and_chosen(daemon: Daemon, bus: tr.Bus) -> None:
    assert bus.boards() == ["left", "right"]
    with pytest.raises(tr.NotThereError, match=r"no such board: 'up' \(available: left, right\)"):
        bus.board("up")
    with pytest.raises(tr.NotThereError, match="several boards are there, name one: left, right"):
        bus.board()


def test_missing_daemon_error_names_searched_endpoints(tmp_path: Path) -> None:
    with tr.connect(f"unixsock-stream/{tmp_path}/none.sock", find_s=0.1) as bus:
        assert bus.boards() == []
        with pytest.raises(tr.NotThereError, match=r"no tactiled answers .*none\.sock.*start it"):
            bus.board("left")
    with pytest.raises(tr.TactileError, match="certificates"):
        tr.connect("tls/127.0.0.1:1")


def test_services(daemon: Daemon, bus: tr.Bus) -> None:
    board = bus.board("left")
    with pytest.raises(tr.RefusedError, match="the skin is touched"):
        board.tare()
    assert board.tare(force=True) == "rest field set"
    with board.record("press") as path:
        assert str(path) == "/x/a.mcap"
    assert board.set_rate(50.0) == 50.0
    assert [name for name, _ in daemon.asked] == ["tare", "tare", "record", "record", "set_rate"]
    assert daemon.asked[2][1] == {"action": "start", "name": "press", "limit_s": 3600.0}


def test_any_key_is_decoded_by_its_senders_type(daemon: Daemon, bus: tr.Bus) -> None:
    publisher = Publisher(daemon.session, "my/own/key", FEATURES.msgtype)
    with bus.stream("my/own/key") as stream:
        connected(publisher, stream)
        publisher.put(features(3), 0)
        assert stream.get(SLOW_S).sequence == 3


def test_forces_are_arrays(daemon: Daemon, bus: tr.Bus) -> None:
    message = MSG.TaxelForces(
        header=header(0, "ee"), captured_ns=0, received_ns=0, uncertainty=0.0, sequence=1,
        array_taxels=np.array([2], np.uint16), force=np.array([0, 1, -2, 3, 4, -5], np.float32),
        status=np.zeros(2, np.uint8), compensated=True, calibrated=True,
        normal_bound=np.zeros(2, np.float32),
    )  # fmt: skip
    publisher = declare_publisher(daemon.session, FORCES, "left")
    with bus.board("left").forces() as stream:
        found = None
        while found is None:
            publisher.put(codec().encode(FORCES, message), 0)
            found = stream.get(0.05)
    assert found.normal.tolist() == [2.0, 5.0]
    assert found.shear.tolist() == [[0.0, 1.0], [3.0, 4.0]]


def test_plain_zenoh_program_joins_as_documented(
    daemon: Daemon, capsys: pytest.CaptureFixture[str]
) -> None:
    """docs/connecting.md: client of an endpoint, with user and secret of the rig."""
    from tactile_core.bus.runtime import USER, home, token_file

    config = zenoh.Config()
    _, secret = token_file(home())
    for key, value in (
        ("mode", '"client"'), ("connect/endpoints", f'["{daemon.endpoint}"]'),
        ("transport/auth/usrpwd/user", f'"{USER}"'),
        ("transport/auth/usrpwd/password", f'"{secret}"'),
    ):  # fmt: skip
        config.insert_json5(key, value)
    with zenoh.open(config) as session:
        subscriber = session.declare_subscriber("tactile/left/features")
        publisher, heard = daemon.publisher(), None
        while heard is None:
            publisher.put(features(1), 0)
            threading.Event().wait(0.02)
            heard = subscriber.try_recv()
    assert codec().decode(FEATURES, heard.payload.to_bytes()).sequence == 1


def test_the_command_line(daemon: Daemon, capsys: pytest.CaptureFixture[str]) -> None:
    at = ["--connect", daemon.endpoint]
    publisher, stop = daemon.publisher(), threading.Event()

    def publish() -> None:
        number = 0
        while not stop.wait(0.01):
            number += 1
            publisher.put(features(number), 0)

    thread = threading.Thread(target=publish)
    thread.start()
    try:
        assert main(["echo", "/tactile/left/features", "--count", "2", *at]) == 0
        said = capsys.readouterr().out
        assert said.count('"normal_force": 1.5') == 2
        assert main(["hz", "tactile/*/features", "--seconds", "1.5", *at]) == 0
        assert "tactile/left/features" in capsys.readouterr().out
        assert main(["list", *at]) == 0
        said = capsys.readouterr().out
        assert "tactile_msgs/msg/ContactFeatures" in said
        assert "tactile/right/srv/record" in said
        assert main(["call", "tactile/left/srv/tare", '{"force": true}', *at]) == 0
        assert "rest field set" in capsys.readouterr().out
    finally:
        stop.set()
        thread.join()
    assert main(["echo", "tactile/up/features", "--timeout", "0.1", *at]) == 3
    assert "tactile list" in capsys.readouterr().err
    assert main(["call", "tactile/left/srv/tare", '{"force": false}', *at]) == 3
    assert "the skin is touched" in capsys.readouterr().err
    for words in (["call", "tactile/left/srv/tare", "[]"], ["echo", "a//b"]):
        with pytest.raises(SystemExit) as refused:
            main([*words, *at])
        assert refused.value.code == 2


def test_arm_states_have_a_stream(bus: tr.Bus) -> None:
    with bus.arm_states() as stream:
        assert stream.key == ARM_STATE.key("arm")
        assert stream.get(0.01) is None
