"""Access to the bus and rights on it: folder, secret, certificates, session limits."""

from __future__ import annotations

import datetime
import json
import os
import signal
import socket
import stat
import subprocess
import sys
import textwrap
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import zenoh

from tactile_core.bus import runtime, topics
from tactile_core.bus.rights import CERTIFICATE_ROLES
from tactile_core.bus.services import NoAnswerError, ServiceError, call, declare_service
from tactile_core.bus.session import (
    PORTS,
    BusConfig,
    BusError,
    certificate_names,
    close_session,
    open_session,
)
from tactile_core.bus.streams import declare_alive, declare_publisher, latest, list_alive
from tests.support.network import free_port
from tests.support.waiting import PATIENCE_S, wait_until

STRANGERS = 100

PEER = textwrap.dedent("""
    import sys, time
    from tactile_core.bus.session import BusConfig, open_session
    from tactile_core.bus.streams import declare_publisher, latest
    from tactile_core.bus.topics import FEATURES
    session = open_session(BusConfig(role=sys.argv[1]))
    publisher = declare_publisher(session, FEATURES, sys.argv[1])
    stream = latest(session, "tactile/*/features")
    print("ready", flush=True)
    while True:
        publisher.put(b"x", 1)
        if stream.newest() is not None and not sys.argv[2:]:
            print("heard", flush=True)
            sys.argv.append("said")
        time.sleep(0.01)
""")


@pytest.fixture
def rig(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A runtime folder for this test, used by this process and its children."""
    folder = tmp_path / "rig"
    monkeypatch.setenv(runtime.RUNTIME_VARIABLE, str(folder))
    monkeypatch.delenv(runtime.SYSTEMD_VARIABLE, raising=False)
    return folder


@pytest.fixture
def join() -> Iterator[Callable[..., zenoh.Session]]:
    """``join(role=..., listen=...)``: a session, closed after the test."""
    sessions: list[zenoh.Session] = []

    def start(**words: Any) -> zenoh.Session:
        sessions.append(open_session(BusConfig(**words)))
        return sessions[-1]

    yield start
    for session in reversed(sessions):
        close_session(session)


@pytest.fixture
def plain() -> Iterator[Callable[..., zenoh.Session]]:
    """``plain(endpoint, **settings)``: a plain zenoh session without our defaults."""
    sessions: list[zenoh.Session] = []

    def start(endpoint: str, **settings: Any) -> zenoh.Session:
        config = zenoh.Config()
        values = {
            "mode": "peer",
            "listen/endpoints": [],
            "connect/endpoints": [endpoint],
            "connect/timeout_ms": -1,
            "connect/exit_on_failure": False,
            "scouting/multicast/enabled": False,
            "scouting/gossip/enabled": False,
            "scouting/delay": 0,
        }
        for key, value in (values | settings).items():
            config.insert_json5(key, json.dumps(value))
        sessions.append(zenoh.open(config))
        return sessions[-1]

    yield start
    for session in sessions:
        close_session(session)


@pytest.fixture
def peer() -> Iterator[Callable[..., subprocess.Popen[str]]]:
    """``peer(role)``: a process that publishes and listens at its default endpoints."""
    processes = []

    def start(role: str) -> subprocess.Popen[str]:
        process = subprocess.Popen(
            [sys.executable, "-c", PEER, role], stdout=subprocess.PIPE, text=True
        )
        processes.append(process)
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        return process

    yield start
    for process in processes:
        process.kill()
        process.wait()
        if process.stdout is not None:
            process.stdout.close()


def hears(stream: Any, send: Callable[[], object]) -> None:
    wait_until(lambda: send() or stream.newest() is not None)


# The folder and its sockets


def test_default_sockets_are_closed_to_other_users(rig: Path, join: Any) -> None:
    for role in PORTS:
        join(role=role)
    assert sorted(p.name for p in (rig / "bus").glob("*.sock")) == [
        "arm.sock",
        "reachd.sock",
        "tactiled.sock",
    ]
    assert stat.S_IMODE((rig / "bus").stat().st_mode) == 0o750
    for path in (rig / "bus").iterdir():
        assert stat.S_IMODE(path.stat().st_mode) & 0o077 == 0, path
    listening = Path("/proc/net/tcp").read_text(encoding="ascii")
    inodes = {os.readlink(f"/proc/self/fd/{fd}") for fd in _descriptors()}
    ports = [line for line in listening.splitlines()[1:] if f"socket:[{line.split()[9]}]" in inodes]
    assert ports == []


def _descriptors() -> list[str]:
    found = []
    for fd in os.listdir("/proc/self/fd"):
        try:
            os.readlink(f"/proc/self/fd/{fd}")
        except OSError:
            continue
        found.append(fd)
    return found


def test_daemons_and_tools_connect_via_runtime_folder_in_any_order(
    rig: Path, peer: Any, join: Any
) -> None:
    tool = join(role="tool")  # before any daemon
    streams = {role: latest(tool, f"tactile/{role}/features") for role in PORTS}
    processes = [peer(role) for role in reversed(list(PORTS))]
    wait_until(lambda: all(stream.received for stream in map(_drained, streams.values())))
    for process in processes:  # each receives from the other two
        assert process.stdout.readline() == "heard\n"


def _drained(stream: Any) -> Any:
    stream.newest()
    return stream


def test_killed_daemon_restarts_despite_its_stale_socket(rig: Path, peer: Any, join: Any) -> None:
    stream = latest(join(role="tool"), "tactile/tactiled/features")
    for _ in range(3):
        process = peer("tactiled")
        wait_until(lambda: stream.newest() is not None)
        process.kill()
        process.wait()
        assert (rig / "bus" / "tactiled.sock").exists()
        stream.newest()
    peer("tactiled")
    wait_until(lambda: stream.newest() is not None)


def test_separate_rigs_do_not_hear_each_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, join: Any
) -> None:
    streams, publishers = [], []
    for name in ("one", "two"):
        monkeypatch.setenv(runtime.RUNTIME_VARIABLE, str(tmp_path / name))
        publishers.append(declare_publisher(join(role="tactiled"), topics.FEATURES, name))
        streams.append(latest(join(role="tool"), "tactile/*/features"))
    for publisher, stream in zip(publishers, streams, strict=True):
        hears(stream, lambda p=publisher: p.put(b"x", 1))
    for publisher in publishers:
        publisher.put(b"last", 1)
    for name, stream in zip(("one", "two"), streams, strict=True):
        sample = stream.wait(PATIENCE_S)
        assert sample.key == f"tactile/{name}/features"


def test_second_daemon_of_a_role_is_told_who_holds_it(rig: Path, peer: Any) -> None:
    process = peer("arm")
    with pytest.raises(BusError, match=rf"another arm runs.*process {process.pid}.*--listen"):
        open_session(BusConfig(role="arm"))


def test_stopped_reader_on_a_socket_blocks_nobody(rig: Path, peer: Any, join: Any) -> None:
    session = join(role="tactiled")
    publisher = declare_publisher(session, topics.FEATURES, "b0")
    stopped = peer("reachd")
    stream = latest(join(role="tool"), publisher.key)
    hears(stream, lambda: publisher.put(b"x", 1))
    os.kill(stopped.pid, signal.SIGSTOP)
    try:
        # Blocking waits 5 s for each message, and this test would never end.
        for _ in range(2000):
            publisher.put(bytes(20_000), 1)
            time.sleep(0.0003)
        wait_until(lambda: (stream.newest() or publisher.put(b"last", 1)) is not None)
    finally:
        os.kill(stopped.pid, signal.SIGCONT)


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda bus: bus.chmod(0o755), "open to every user"),
        (lambda bus: (bus.rmdir(), bus.write_text("")), "not a folder"),
        (lambda bus: os.chown(bus, 12345, -1), "another user"),
        (lambda bus: bus.parent.chmod(0o777), "may write to"),
    ],
)
def test_unsafe_folder_is_refused(rig: Path, spoil: Any, said: str) -> None:
    if os.getuid() != 0 and "user" in said:
        pytest.skip("only root can give a folder away")
    (rig / "bus").mkdir(parents=True, mode=0o750)
    spoil(rig / "bus")
    with pytest.raises(BusError, match=said):
        open_session(BusConfig(role="tactiled"))


def test_path_too_long_for_a_socket_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for folder, said in (("d" * 120, "107"), ("a b", "no space"), ("a#b", "none of")):
        monkeypatch.setenv(runtime.RUNTIME_VARIABLE, str(tmp_path / folder))
        with pytest.raises(BusError, match=said):
            open_session(BusConfig(role="tactiled"))
    with pytest.raises(BusError, match="from /"):
        open_session(BusConfig(listen=("unixsock-stream/here.sock",), connect=()))


# The secret


def test_plain_tcp_requires_the_secret(join: Any, plain: Any) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    arm = join(role="arm", listen=(endpoint,), connect=())
    obeyed: list[str] = []
    declare_service(arm, "arm/arm/srv/limits", lambda request: obeyed.append("limits") or {})
    _tap = arm.declare_subscriber("arm/arm/cmd_vel", lambda s: obeyed.append("command"))
    states = declare_publisher(arm, topics.ARM_STATE, "arm")
    wrong = {"transport/auth/usrpwd/user": "rig", "transport/auth/usrpwd/password": "0" * 64}
    evil = [plain(endpoint), plain(endpoint, **wrong)]
    with pytest.raises(zenoh.ZError):
        plain(endpoint, mode="client", **{"connect/timeout_ms": 500})
    spying = [latest(session, states.key) for session in evil]
    friend = latest(join(listen=(), connect=(endpoint,)), states.key)
    hears(friend, lambda: states.put(b"x", 1))
    for _ in range(100):
        states.put(b"x", 1)
        for session in evil:
            session.put("arm/arm/cmd_vel", b"go")
        time.sleep(0.005)
    for session in evil:
        assert list(session.get("arm/arm/srv/limits", timeout=0.3)) == []
        assert list(session.info.peers_zid()) == []
    assert [stream.newest() for stream in spying] == [None] * 2
    assert obeyed == []
    friend_session = join(listen=(), connect=(endpoint,))
    assert call(friend_session, "arm/arm/srv/limits", timeout=PATIENCE_S) == {}


def test_unix_socket_requires_the_secret(rig: Path, join: Any, plain: Any) -> None:
    """A stranger who reached the socket (by its group, or a folder opened by mistake)."""
    arm = join(role="arm", connect=())
    endpoint = f"unixsock-stream/{rig / 'bus' / 'arm.sock'}"
    obeyed: list[bytes] = []
    _tap = arm.declare_subscriber("arm/arm/cmd_vel", lambda s: obeyed.append(s.payload.to_bytes()))
    wrong = {"transport/auth/usrpwd/user": "rig", "transport/auth/usrpwd/password": "0" * 64}
    evil = [plain(endpoint), plain(endpoint, **wrong)]
    friend = join(connect=(endpoint,), listen=())

    def send() -> None:
        for session in evil:
            session.put("arm/arm/cmd_vel", b"evil")
        friend.put("arm/arm/cmd_vel", b"friend")

    wait_until(lambda: send() or len(obeyed) > 50)
    assert set(obeyed) == {b"friend"}
    assert [list(session.info.peers_zid()) for session in evil] == [[], []]
    for session in evil:
        assert list(session.get("arm/arm/srv/limits", timeout=0.3)) == []


def test_explicit_insecure_mode_admits_everyone(join: Any, plain: Any) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    stream = latest(join(listen=(endpoint,), connect=(), insecure=True), "tactile/*/features")
    stranger = plain(endpoint)
    wait_until(lambda: stranger.put("tactile/b0/features", b"x") or stream.newest())


def test_secret_is_created_once_and_private(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    place = runtime.Runtime(tmp_path / "home")
    path, secret = runtime.token_file(place)
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert runtime.token_file(place) == (path, secret)
    assert len(secret) == 64
    path.chmod(0o644)
    with pytest.raises(runtime.RuntimeFolderError, match="read by others"):
        runtime.token_file(place)
    path.chmod(0o600)
    path.write_text("rig:short\n", encoding="ascii")
    with pytest.raises(runtime.RuntimeFolderError, match="delete it"):
        runtime.token_file(place)


def test_secret_folder_of_another_user_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another user may have created it first; the error names the variable to use."""
    monkeypatch.delenv(runtime.SYSTEMD_VARIABLE, raising=False)
    monkeypatch.setenv(runtime.RUNTIME_VARIABLE, str(tmp_path / "rig"))
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    (tmp_path / "tactile").mkdir(mode=0o700)
    (tmp_path / "tactile").chmod(0o777)
    with pytest.raises(BusError, match="may write to"):
        open_session(BusConfig(role="tactiled"))
    (tmp_path / "tactile").rmdir()
    (tmp_path / "tactile").touch()
    with pytest.raises(BusError, match=r"not a folder.*XDG_RUNTIME_DIR"):
        open_session(BusConfig(role="tactiled"))


def test_service_folder_is_shared_with_its_group(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, join: Any
) -> None:
    monkeypatch.delenv(runtime.RUNTIME_VARIABLE, raising=False)
    monkeypatch.setenv(runtime.SYSTEMD_VARIABLE, f"{tmp_path / 'run'}:{tmp_path / 'other'}")
    join(role="tactiled")
    modes = {p.name: stat.S_IMODE(p.stat().st_mode) for p in (tmp_path / "run").rglob("*")}
    assert modes["bus"] == 0o750
    assert modes["tactiled.sock"] == 0o660
    assert modes["token"] == 0o640


# Certificates


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Keys of a lab for every role, those of a second lab, and some invalid ones."""
    keys = pytest.importorskip("tactile_tools.operate.lab_keys")
    pytest.importorskip("cryptography", reason="making keys needs cryptography")
    folder = tmp_path_factory.mktemp("lab")
    order, roles = keys.Order, keys.DEFAULT_PARTIES
    keys.make_keys(order(folder / "lab", roles))
    keys.make_keys(order(folder / "lab", [("guest", "operator")]))
    keys.remove_party(folder / "lab", "guest")  # signed by the lab but in no list
    keys.make_keys(order(folder / "foreign", roles))
    long_ago = datetime.datetime.now(datetime.UTC) - datetime.timedelta(days=10)
    keys.make_keys(order(folder / "lab", [("late", "operator")], days=5, now=long_ago))
    return folder


@pytest.fixture
def secure_arm(lab: Path, join: Any) -> Any:
    """An arm over TLS: (endpoint, commands obeyed, publisher of states)."""
    endpoint = f"tls/localhost:{free_port()}"
    arm = join(role="arm", listen=(endpoint,), connect=(), keys=str(lab / "lab" / "arm"))
    obeyed: list[str] = []
    for name in ("limits", "clear", "status"):
        declare_service(
            arm, f"arm/arm/srv/{name}", lambda r, n=name: {"did": n, "n": obeyed.append(n)}
        )
    arm.declare_subscriber("arm/arm/cmd_vel", lambda s: obeyed.append("command"))
    return endpoint, obeyed, declare_publisher(arm, topics.ARM_STATE, "arm"), arm


def test_each_role_has_only_its_own_rights(lab: Path, join: Any, secure_arm: Any) -> None:
    endpoint, obeyed, states, arm = secure_arm
    _token = arm.liveliness().declare_token(topics.alive_key("arm", "arm"))
    for role in ("reachd", "operator", "viewer", "tactiled"):
        session = join(listen=(), connect=(endpoint,), keys=str(lab / "lab" / role))
        stream = latest(session, states.key)
        hears(stream, lambda: states.put(b"x", 1))
        obeyed.clear()
        assert call(session, "arm/arm/srv/status", timeout=PATIENCE_S)["did"] == "status"
        alive = session.liveliness().get("arm/*/alive", timeout=PATIENCE_S)
        assert [str(reply.ok.key_expr) for reply in alive] == ["arm/arm/alive"]
        session.put("arm/arm/cmd_vel", b"go")
        if role in ("reachd", "operator"):
            assert call(session, "arm/arm/srv/limits", timeout=PATIENCE_S)["did"] == "limits"
        else:
            with pytest.raises(ServiceError, match=f"the role {role} may not ask.*operator's"):
                call(session, "arm/arm/srv/limits", timeout=1)
            # Bypassing our own check of rights does not help.
            assert list(session.get("arm/arm/srv/limits", timeout=0.5)) == []
            assert list(session.get("arm/arm/srv/*", timeout=0.5)) == []
        if role == "reachd":
            wait_until(lambda: "command" in obeyed)
        time.sleep(0.1)
        assert ("command" in obeyed) == (role == "reachd")
        assert ("limits" in obeyed) == (role in ("reachd", "operator"))
    assert certificate_names(arm) == ["operator", "reachd", "tactiled", "viewer"]


def test_only_the_arm_certificate_publishes_arm_state(lab: Path, join: Any) -> None:
    """A process that listens in the arm's place is not believed, even with keys of the lab."""
    endpoint = f"tls/localhost:{free_port()}"
    reach = join(listen=(), connect=(endpoint,), keys=str(lab / "lab" / "reachd"))
    stream = latest(reach, "arm/arm/state")
    events = latest(reach, "tactile/b0/features")
    false = join(listen=(endpoint,), connect=(), keys=str(lab / "lab" / "tactiled"))
    declare_service(false, "arm/arm/srv/limits", lambda r: {})
    states = declare_publisher(false, topics.ARM_STATE, "arm")
    skin = declare_publisher(false, topics.FEATURES, "b0")
    wait_until(lambda: states.put(b"x", 1) or skin.put(b"x", 1) or events.newest())
    assert stream.received == 0
    with pytest.raises(NoAnswerError):
        call(reach, "arm/arm/srv/limits", timeout=0.5)


def test_tool_certificate_cannot_impersonate_a_daemon(lab: Path, join: Any) -> None:
    endpoint = f"tls/localhost:{free_port()}"
    reach = join(listen=(), connect=(endpoint,), keys=str(lab / "lab" / "reachd"))
    false = join(listen=(endpoint,), connect=(), keys=str(lab / "lab" / "operator"))
    time.sleep(1)
    assert list(reach.info.peers_zid()) == []
    assert list(false.info.peers_zid()) == []


@pytest.mark.parametrize(
    "who", ["unlisted", "foreign", "expired", "no certificate", "plain TCP", "self-made name"]
)
def test_rejected_peer_hears_and_moves_nothing(
    lab: Path, join: Any, plain: Any, secure_arm: Any, who: str
) -> None:
    endpoint, obeyed, states, _arm = secure_arm
    ca = {"transport/link/tls/root_ca_certificate": str(lab / "lab" / "ca.pem")}
    port = endpoint.rpartition(":")[2]
    stranger = {
        "unlisted": lambda: join(connect=(endpoint,), keys=str(lab / "lab" / "guest")),
        "foreign": lambda: plain(endpoint, **_tls(lab / "foreign" / "operator", ca)),
        "expired": lambda: join(connect=(endpoint,), keys=str(lab / "lab" / "late")),
        "no certificate": lambda: plain(endpoint, **ca),
        "plain TCP": lambda: plain(f"tcp/127.0.0.1:{port}"),
        "self-made name": lambda: plain(endpoint, **_tls(lab / "foreign" / "reachd", ca)),
    }[who]()
    spy = latest(stranger, states.key)
    friend = latest(join(connect=(endpoint,), keys=str(lab / "lab" / "viewer")), states.key)
    hears(friend, lambda: states.put(b"x", 1))
    for _ in range(60):
        states.put(b"x", 1)
        stranger.put("arm/arm/cmd_vel", b"go")
        time.sleep(0.005)
    for service in ("limits", "clear", "status"):
        assert list(stranger.get(f"arm/arm/srv/{service}", timeout=0.3)) == []
    assert spy.newest() is None
    assert obeyed == []


def _tls(folder: Path, ca: dict[str, str]) -> dict[str, Any]:
    tls = "transport/link/tls/"
    return ca | {
        tls + "enable_mtls": True,
        tls + "connect_certificate": str(folder / "cert.pem"),
        tls + "connect_private_key": str(folder / "key.pem"),
    }


def test_rig_with_keys_is_closed_to_peers_without_keys(lab: Path, tmp_path: Path) -> None:
    keys = str(lab / "lab" / "arm")
    for endpoint in ("tcp/127.0.0.1:0", f"unixsock-stream/{tmp_path}/a.sock", "tcp/0.0.0.0:0"):
        with pytest.raises(BusError, match="this rig has keys"):
            open_session(BusConfig(listen=(endpoint,), connect=(), keys=keys))
    assert BusConfig(role="arm", keys=keys).listen_endpoints() == ("tls/127.0.0.1:7453",)


def test_incomplete_keys_are_refused(lab: Path, tmp_path: Path) -> None:
    def refused(keys: Path, said: str) -> None:
        with pytest.raises(BusError, match=said):
            open_session(BusConfig(listen=(), connect=(), keys=str(keys)))

    refused(tmp_path / "none", "no such folder")
    refused(tmp_path, "roles.toml")
    copy = tmp_path / "copy"
    copy.mkdir()
    for path in (lab / "lab" / "viewer").iterdir():
        (copy / path.name).write_bytes(path.read_bytes())
    (copy / "key.pem").chmod(0o644)
    refused(copy, "chmod 0600")
    (copy / "key.pem").chmod(0o600)
    (copy / "cert.pem").unlink()
    refused(copy, "cert.pem: No such file")
    (copy / "roles.toml").write_text("[roles]\nking = ['a']\n", encoding="utf-8")
    refused(copy, "roles.toml:2: unknown key roles.king; allowed: arm, operator")
    refused(lab, "name the folder of one party")


def test_every_role_has_a_certificate(lab: Path) -> None:
    for role in CERTIFICATE_ROLES:
        assert (lab / "lab" / role / "cert.pem").exists()
        assert stat.S_IMODE((lab / "lab" / role / "key.pem").stat().st_mode) == 0o600
    assert stat.S_IMODE((lab / "lab" / "ca.key").stat().st_mode) == 0o600


# Session limits


def test_hundred_strangers_over_plain_tcp_take_no_session(join: Any, plain: Any) -> None:
    """Half of them repeat zenoh's handshake, half hold a silent connection."""
    port = free_port()
    session = join(listen=(f"tcp/127.0.0.1:{port}",), connect=())
    silent = [
        socket.create_connection(("127.0.0.1", port), timeout=PATIENCE_S)
        for _ in range(STRANGERS // 2)
    ]
    strangers = [plain(f"tcp/127.0.0.1:{port}") for _ in range(STRANGERS // 2)]
    publisher = declare_publisher(session, topics.FEATURES, "b0")
    peers = [
        latest(join(listen=(), connect=(f"tcp/127.0.0.1:{port}",)), "tactile/*/features")
        for _ in range(4)
    ]
    wait_until(lambda: publisher.put(b"x", 1) or all(p.received for p in map(_drained, peers)))
    assert len(session.info.peers_zid()) == 4
    assert not any(list(s.info.peers_zid()) for s in strangers)
    for connection in silent:
        connection.close()


def test_hundred_strangers_over_tls_leave_room_for_own_peers(
    lab: Path, join: Any, secure_arm: Any
) -> None:
    """With a certificate signed by the lab but not listed: they connect and get no further."""
    endpoint, obeyed, states, arm = secure_arm
    guest = str(lab / "lab" / "guest")
    strangers = [join(connect=(endpoint,), listen=(), keys=guest) for _ in range(STRANGERS)]
    wait_until(lambda: len(arm.info.peers_zid()) >= STRANGERS)
    peer = join(connect=(endpoint,), listen=(), keys=str(lab / "lab" / "reachd"))
    stream = latest(peer, states.key)
    hears(stream, lambda: states.put(b"x", 1))
    strangers[-1].put("arm/arm/cmd_vel", b"go")
    peer.put("arm/arm/cmd_vel", b"go")
    wait_until(lambda: obeyed)
    time.sleep(0.2)
    assert obeyed == ["command"]
    assert certificate_names(arm) == ["guest", "reachd"]


def test_liveliness_tokens_belong_to_their_role(lab: Path, join: Any, secure_arm: Any) -> None:
    endpoint, _, _, arm = secure_arm
    viewer = join(connect=(endpoint,), listen=(), keys=str(lab / "lab" / "viewer"))
    skin = join(connect=(endpoint,), listen=(), keys=str(lab / "lab" / "tactiled"))
    _false = viewer.liveliness().declare_token("reach/reach/alive")
    _true = declare_alive(skin, "b0")
    wait_until(lambda: list_alive(arm, 1) == ["b0"])
    assert list(arm.liveliness().get("reach/*/alive", timeout=0.5)) == []
