"""zenoh sessions with the project's security defaults.

All processes of a rig use the same one of three modes:

- One machine (the default): every role listens at a unix socket in a folder that only its owner and
  group can enter (`runtime`), and connects to the roles before it. Tools do not listen and connect
  to all roles (one link per pair: two links between the same peers double the traffic). Loopback
  TCP is possible on request. In both cases a peer must know the folder's secret.
- With keys (``tls``): mutual TLS everywhere; rights by the role of the certificate (`rights`).
- ``insecure``, explicitly: whoever reaches an endpoint may read and command.
"""

from __future__ import annotations

import atexit
import contextlib
import ipaddress
import json
import logging
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

import msgspec
import zenoh

from tactile_core.bus.keys import KeysError, TlsConfig, check_keys, load_keys
from tactile_core.bus.messages import MAX_PAYLOAD
from tactile_core.bus.rights import access_control
from tactile_core.bus.runtime import (
    USER,
    Runtime,
    RuntimeFolderError,
    SocketLock,
    check_socket_path,
    find_runtime,
    home,
    listener_of,
    prepare,
    socket_path,
    token_file,
)

log = logging.getLogger(__name__)

Role = Literal["tactiled", "reachd", "arm", "tool"]

PORTS: dict[str, int] = {"tactiled": 7451, "reachd": 7452, "arm": 7453}
"""TCP port of each role over TLS. Each role connects to those before it. Port 7447 is avoided, as a
ROS 2 machine has its zenoh router there."""

MAX_MESSAGE = MAX_PAYLOAD + 1024
"""Largest message in bytes that zenoh may reassemble: a full payload, its key, attachment and
headers."""

MAX_SESSIONS = 512
"""Peers that one process accepts. Over TLS, any certificate of the lab takes a place before its
rights are checked; a hundred of them must leave room for three daemons and a dozen tools."""

MAX_PENDING = 1024
"""Connections that may be in the handshake, including silent ones of strangers."""

ACCEPT_TIMEOUT_MS = 2000
"""A handshake takes 10 ms; slower peers lose their place."""

CLOSE_TIMEOUT = 1.0
"""Time in s to wait for zenoh to close; zenoh itself waits up to 10 s for a peer that is
stopped."""


class BusError(Exception):
    """The bus cannot be opened as asked; the message names the remedy."""


class BusConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How to join the bus. ``listen`` and ``connect``: zenoh endpoints; None: those of the role.

    ``keys``: folder of keys (see module `keys`); ``tls`` names each file instead.
    """

    role: Role = "tool"
    listen: tuple[str, ...] | None = None
    connect: tuple[str, ...] | None = None
    tls: TlsConfig | None = None
    keys: str | None = None
    insecure: bool = False

    @property
    def certified(self) -> bool:
        """Whether this rig uses keys."""
        return self.tls is not None or self.keys is not None

    def with_keys(self) -> BusConfig:
        """Return a copy with the keys loaded. Raises `BusError` if the folder is incomplete."""
        tls = self.tls
        try:
            if self.keys is not None:
                tls = load_keys(self.keys)
            if tls is not None:
                check_keys(tls)
        except KeysError as error:
            raise BusError(str(error)) from error
        return msgspec.structs.replace(self, tls=tls)

    def listen_endpoints(self) -> tuple[str, ...]:
        """Endpoints at which this process listens."""
        if self.listen is not None:
            return self.listen
        return (self._endpoint(self.role),) if self.role in PORTS else ()

    def connect_endpoints(self) -> tuple[str, ...]:
        """Endpoints to which this process connects, retrying in the background."""
        if self.connect is not None:
            return self.connect
        roles = list(PORTS)
        earlier = roles[: roles.index(self.role)] if self.role in PORTS else roles
        return tuple(self._endpoint(role) for role in earlier)

    def where(self) -> str:
        """Where peers are looked for, as words to append to a sentence."""
        places = [*self.connect_endpoints(), *self.listen_endpoints()]
        paths = [path for path in map(socket_path, places) if path is not None]
        if self.connect is None and paths:
            return f" (through {paths[0].parent})"
        return f" (through {', '.join(places)})" if places else ""

    def _endpoint(self, role: str) -> str:
        if self.certified:
            return f"tls/127.0.0.1:{PORTS[role]}"
        return find_runtime().endpoint(role)


def _is_local(endpoint: str) -> bool:
    """Whether an endpoint is unreachable from other machines."""
    protocol, _, address = endpoint.partition("/")
    if protocol.startswith("unix"):
        return True
    host = address.partition("?")[0].partition("#")[0].rpartition(":")[0].strip("[]")
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


SECURE = ("tls/", "quic/")
"""Prefixes of endpoints that certificates protect."""


def _check_endpoints(config: BusConfig) -> None:
    """Reject endpoints open to the network without TLS, or that need keys not given."""
    for endpoint in (*config.listen_endpoints(), *config.connect_endpoints()):
        secure = endpoint.startswith(SECURE)
        if secure and config.tls is None:
            raise BusError(
                f"{endpoint} needs certificates: --keys FOLDER (`tactile bus keys` makes them), or "
                "a [bus.tls] table with root_ca, certificate, private_key and roles"
            )
        if secure:
            continue
        if config.tls is not None and not config.insecure:
            raise BusError(
                f"{endpoint} has no certificates, and this rig has keys: use tls/... for all of it "
                "(tls/127.0.0.1:PORT on this machine)"
            )
        if _is_local(endpoint):
            continue
        if not config.insecure:
            raise BusError(
                f"{endpoint} leaves this machine unprotected: use tls/... with --keys FOLDER, or "
                "say --insecure if everyone on that network may read and command this robot"
            )
        log.warning("%s is open to the network without protection, as --insecure asks", endpoint)


def _tls_settings(tls: TlsConfig) -> dict[str, Any]:
    return {
        "transport/link/tls": {
            "root_ca_certificate": tls.root_ca,
            "listen_certificate": tls.certificate,
            "listen_private_key": tls.private_key,
            "connect_certificate": tls.certificate,
            "connect_private_key": tls.private_key,
            "enable_mtls": True,
            "verify_name_on_connect": True,
            # If a certificate expires while its peer is connected, the link ends.
            "close_link_on_expiration": True,
        },
        "access_control": access_control(tls.roles.table()),
    }


def _secret_settings(runtime: Runtime) -> dict[str, Any]:
    path, secret = token_file(runtime)
    return {
        "transport/auth/usrpwd/user": USER,
        "transport/auth/usrpwd/password": secret,
        "transport/auth/usrpwd/dictionary_file": str(path),
    }


def _zenoh_config(config: BusConfig) -> zenoh.Config:
    """The complete zenoh configuration; nothing is taken from the environment."""
    values: dict[str, Any] = {
        "mode": "peer",
        "listen/endpoints": list(config.listen_endpoints()),
        "listen/timeout_ms": 0,
        "listen/exit_on_failure": True,
        "connect/endpoints": list(config.connect_endpoints()),
        "connect/timeout_ms": -1,  # retry forever, in the background
        "connect/exit_on_failure": False,
        "connect/retry": {
            "period_init_ms": 100,
            "period_max_ms": 1000,
            "period_increase_factor": 2,
        },
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "scouting/delay": 0,  # nothing to wait for: opening takes 5 ms, not 500
        "transport/unicast/max_sessions": MAX_SESSIONS,
        "transport/unicast/accept_pending": MAX_PENDING,
        "transport/unicast/accept_timeout": ACCEPT_TIMEOUT_MS,
        "transport/link/rx/max_message_size": MAX_MESSAGE,
        # When a link is full, a fragmented message may wait no longer than a small one.
        "transport/link/tx/queue/congestion_control/drop/max_wait_before_drop_fragments": 1000,
        "transport/shared_memory/enabled": False,
    }
    if config.tls is not None:
        values |= _tls_settings(config.tls)
    elif not config.insecure:
        values |= _secret_settings(home())
    result = zenoh.Config()
    for key, value in values.items():
        try:
            result.insert_json5(key, json.dumps(value))
        except zenoh.ZError as error:
            shown = "..." if "usrpwd" in key else repr(value)
            raise BusError(f"bus setting {key} = {shown} is refused: {_brief(error)}") from error
    return result


def _brief(error: zenoh.ZError) -> str:
    """Text of a zenoh error without the source locations."""
    return str(error).partition(" at /")[0]


def open_session(config: BusConfig) -> zenoh.Session:
    """Join the bus. Raises `BusError` with the remedy if the port is busy or the endpoint refused.

    Returns at once; peers that are not yet running are sought in the background. End the session
    with `close_session`; those still open when the interpreter exits are closed then.
    """
    config = config.with_keys()
    locks: list[SocketLock] = []
    try:
        _check_endpoints(config)
        runtime = _prepare_sockets(config)
        settings = _zenoh_config(config)
        for endpoint in config.listen_endpoints():
            path = socket_path(endpoint)
            if path is not None:
                locks.append(_lock_socket(path, config.role))
        session = _open(settings, config)
        for lock in locks:
            # A service with its own group admits that group; otherwise only the owner is admitted.
            lock.path.with_name(lock.path.name.removesuffix(".held")).chmod(
                0o660 if runtime.shared else 0o600
            )
    except BaseException as error:
        for lock in locks:
            lock.release()
        if isinstance(error, RuntimeFolderError):
            raise BusError(str(error)) from error
        raise
    _open_sessions[str(session.zid())] = _Open(session, config, locks)
    return session


def _prepare_sockets(config: BusConfig) -> Runtime:
    """Check the paths of all sockets, and create the runtime folder if they are in it."""
    runtime = find_runtime()
    for endpoint in (*config.listen_endpoints(), *config.connect_endpoints()):
        path = socket_path(endpoint)
        if path is None:
            continue
        check_socket_path(path)
        # Do so for peers as well, so that no other user can create the folder first and listen
        # there.
        if path.parent == runtime.bus:
            prepare(runtime)
    return runtime


def _lock_socket(path: Path, role: str) -> SocketLock:
    """Lock a socket until the session has closed."""
    lock = SocketLock(path)
    try:
        held = lock.acquire()
    except OSError as error:
        raise BusError(
            f"cannot listen at {path}: {error.strerror}; name a socket in a folder of yours: "
            "--listen unixsock-stream//FOLDER/NAME.sock"
        ) from error
    if not held:
        raise BusError(_in_use_text(path, role))
    return lock


def _in_use_text(path: Path, role: str) -> str:
    pid = listener_of(path)
    who = "another process" if pid is None else f"process {pid}"
    return (
        f"{path} is in use: another {role} runs on this machine ({who}); stop it, or give this one "
        "a place of its own: TACTILE_RUNTIME_DIR=FOLDER for a whole rig, or --listen "
        "unixsock-stream//FOLDER/NAME.sock"
    )


def _open(settings: zenoh.Config, config: BusConfig) -> zenoh.Session:
    try:
        return zenoh.open(settings)
    except zenoh.ZError as error:
        text = str(error)
        where = ", ".join(config.listen_endpoints())
        if "in use" in text:
            raise BusError(
                f"{where} is in use: another {config.role} runs on this machine; stop it (`ss "
                f"-ltnp` shows it), or give this one another port: --listen {_example(where)}"
            ) from error
        raise BusError(f"cannot open the bus at {where}: {_brief(error)}") from error


def _example(where: str) -> str:
    return f"{where.partition('/')[0]}/127.0.0.1:PORT"


def close_session(session: zenoh.Session, timeout: float = CLOSE_TIMEOUT) -> bool:
    """Close the session.

    Returns False if zenoh still waits for a peer after ``timeout`` s; closing then continues.
    """
    if session.is_closed():
        return True
    opened = _open_sessions.pop(str(session.zid()), None)
    done = threading.Event()

    def close() -> None:
        try:
            session.close()
        except zenoh.ZError as error:
            log.debug("zenoh did not close cleanly: %s", _brief(error))
        for lock in opened.locks if opened is not None else ():
            lock.release()
        done.set()

    threading.Thread(target=close, name="bus-close", daemon=True).start()
    return done.wait(timeout)


def open_sessions() -> list[zenoh.Session]:
    """Open sessions of this process, oldest first."""
    return [opened.session for opened in _open_sessions.values()]


def config_of(session: zenoh.Session) -> BusConfig | None:
    """Configuration of an open session; None for one that `open_session` did not open."""
    opened = _open_sessions.get(str(session.zid()))
    return None if opened is None else opened.config


def certificate_names(session: zenoh.Session) -> list[str]:
    """Certificate names of the peers connected now."""
    names = set()
    with contextlib.suppress(zenoh.ZError):
        for link in session.info.links():
            if link.auth_identifier:
                names.add(str(link.auth_identifier))
    return sorted(names)


class _Open:
    """An open session with its configuration and socket locks."""

    def __init__(
        self, session: zenoh.Session, config: BusConfig, locks: Sequence[SocketLock]
    ) -> None:
        self.session = session
        self.config = config
        self.locks = tuple(locks)


_open_sessions: dict[str, _Open] = {}  # by zenoh id


def _close_all() -> None:
    for opened in list(_open_sessions.values()):
        close_session(opened.session)


# zenoh runs callbacks on threads that end only with their session. Plain atexit hooks run after the
# interpreter has joined those threads, so a forgotten session would hang the process. The hook used
# by concurrent.futures runs earlier.
_register: Callable[[Callable[[], None]], object] = getattr(
    threading, "_register_atexit", atexit.register
)
_register(_close_all)
