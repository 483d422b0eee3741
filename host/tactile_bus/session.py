"""zenoh sessions with the project's security defaults.

Peer mode on the loopback interface, no scouting of any kind: every daemon listens at the fixed
port of its role and connects to the roles before it, tools listen nowhere and connect to all
(one link a pair; two links between the same peers double the traffic). Off-host endpoints need
mutual TLS with a list of allowed certificates, or ``insecure`` by name.
"""

from __future__ import annotations

import atexit
import ipaddress
import json
import logging
import threading
from collections.abc import Callable
from typing import Any, Literal

import msgspec
import zenoh

from tactile_bus.messages import MAX_PAYLOAD

log = logging.getLogger(__name__)

Role = Literal["tactiled", "reachd", "arm", "tool"]

PORTS: dict[str, int] = {"tactiled": 7447, "reachd": 7448, "arm": 7449}
"""TCP port of each role, in the order of who connects to whom: each to those before it."""

MAX_MESSAGE = MAX_PAYLOAD + 1024
"""Bytes zenoh may reassemble: a full payload, its key, its attachment and headers."""

MAX_SESSIONS = 16
"""Peers one process accepts (security defaults): three daemons and a dozen tools."""

CLOSE_TIMEOUT = 1.0
"""s to wait for zenoh to close; it waits up to 10 s by itself for a peer that is stopped."""

KEYS = ("tactile/**", "arm/**", "reach/**", "reference/**", "world/**", "replay/**", "tf")
"""All that a peer over TLS may speak of."""


class BusError(Exception):
    """The bus cannot be opened as asked; the message names the remedy."""


class TlsConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Mutual TLS: paths of PEM files, and the certificate names that are let in (no others)."""

    root_ca: str
    certificate: str
    private_key: str
    allowed: tuple[str, ...]


class BusConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How to join the bus. ``listen`` and ``connect``: zenoh endpoints; None: those of the role."""

    role: Role = "tool"
    listen: tuple[str, ...] | None = None
    connect: tuple[str, ...] | None = None
    tls: TlsConfig | None = None
    insecure: bool = False

    def listen_endpoints(self) -> tuple[str, ...]:
        """Where this process listens."""
        if self.listen is not None:
            return self.listen
        return (f"tcp/127.0.0.1:{PORTS[self.role]}",) if self.role in PORTS else ()

    def connect_endpoints(self) -> tuple[str, ...]:
        """Whom this process seeks, again and again, in the background."""
        if self.connect is not None:
            return self.connect
        roles = list(PORTS)
        earlier = roles[: roles.index(self.role)] if self.role in PORTS else roles
        return tuple(f"tcp/127.0.0.1:{PORTS[role]}" for role in earlier)


def _is_local(endpoint: str) -> bool:
    """Whether an endpoint cannot be reached from another machine."""
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


def _check_endpoints(config: BusConfig) -> None:
    """Refuse what would open the bus to the network without TLS, or asks for TLS without keys."""
    for endpoint in (*config.listen_endpoints(), *config.connect_endpoints()):
        secure = endpoint.startswith(("tls/", "quic/"))
        if secure and config.tls is None:
            raise BusError(
                f"{endpoint} needs a [bus.tls] table with root_ca, certificate, private_key and "
                "allowed (the certificate names that are let in)"
            )
        if _is_local(endpoint) or secure:
            continue
        if not config.insecure:
            raise BusError(
                f"{endpoint} leaves this machine unprotected: use tls/... with a [bus.tls] table, "
                "or say --insecure if everyone on that network may read and command this robot"
            )
        log.warning("%s is open to the network without protection, as --insecure asks", endpoint)
    if config.tls is not None and not config.tls.allowed:
        raise BusError("[bus.tls] allowed is empty: name the certificates that are let in")


def _access_control(tls: TlsConfig) -> dict[str, Any]:
    """Deny all but the project's keys to the certificates that were named, and to this machine."""
    messages = (
        "put delete declare_subscriber query reply declare_queryable "
        "liveliness_token liveliness_query declare_liveliness_subscriber"
    )
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": [
            {
                "id": "project keys",
                "permission": "allow",
                "flows": ["ingress", "egress"],
                "messages": messages.split(),
                "key_exprs": list(KEYS),
            }
        ],
        "subjects": [
            {"id": "named certificates", "cert_common_names": list(tls.allowed)},
            {"id": "this machine", "interfaces": ["lo"], "link_protocols": ["tcp"]},
        ],
        "policies": [
            {"rules": ["project keys"], "subjects": ["named certificates", "this machine"]}
        ],
    }


def _zenoh_config(config: BusConfig) -> zenoh.Config:
    """The whole zenoh configuration; nothing is taken from the environment."""
    values: dict[str, Any] = {
        "mode": "peer",
        "listen/endpoints": list(config.listen_endpoints()),
        "listen/timeout_ms": 0,
        "listen/exit_on_failure": True,
        "connect/endpoints": list(config.connect_endpoints()),
        "connect/timeout_ms": -1,  # never give up, in the background
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
        "transport/unicast/accept_pending": MAX_SESSIONS,
        "transport/link/rx/max_message_size": MAX_MESSAGE,
        # A message of several fragments may wait no longer than a small one when a link is full.
        "transport/link/tx/queue/congestion_control/drop/max_wait_before_drop_fragments": 1000,
        "transport/shared_memory/enabled": False,
    }
    if config.tls is not None:
        tls = config.tls
        values["transport/link/tls"] = {
            "root_ca_certificate": tls.root_ca,
            "listen_certificate": tls.certificate,
            "listen_private_key": tls.private_key,
            "connect_certificate": tls.certificate,
            "connect_private_key": tls.private_key,
            "enable_mtls": True,
            "verify_name_on_connect": True,
        }
        values["access_control"] = _access_control(tls)
    result = zenoh.Config()
    for key, value in values.items():
        try:
            result.insert_json5(key, json.dumps(value))
        except zenoh.ZError as error:
            raise BusError(f"bus setting {key} = {value!r} is refused: {_brief(error)}") from error
    return result


def _brief(error: zenoh.ZError) -> str:
    """A zenoh error without the places in its source code."""
    return str(error).partition(" at /")[0]


def open_session(config: BusConfig) -> zenoh.Session:
    """Join the bus; `BusError` with the remedy when the port is busy or the endpoint refused.

    Returns at once: peers that are not there yet are sought in the background for ever. End it
    with `close_session`; sessions still open when the interpreter exits are closed then.
    """
    _check_endpoints(config)
    settings = _zenoh_config(config)
    try:
        session = zenoh.open(settings)
    except zenoh.ZError as error:
        text = str(error)
        where = ", ".join(config.listen_endpoints())
        if "in use" in text:
            raise BusError(
                f"{where} is in use: another {config.role} runs on this machine; stop it (`ss "
                "-ltnp` shows it), or give this one another port: --listen tcp/127.0.0.1:PORT"
            ) from error
        raise BusError(f"cannot open the bus at {where}: {_brief(error)}") from error
    _open_sessions[str(session.zid())] = session
    return session


def close_session(session: zenoh.Session, timeout: float = CLOSE_TIMEOUT) -> bool:
    """Close within ``timeout`` s; False when zenoh still waits for a peer (it goes on alone)."""
    if session.is_closed():
        return True
    _open_sessions.pop(str(session.zid()), None)
    done = threading.Event()

    def close() -> None:
        try:
            session.close()
        except zenoh.ZError as error:
            log.debug("zenoh did not close cleanly: %s", _brief(error))
        done.set()

    threading.Thread(target=close, name="bus-close", daemon=True).start()
    return done.wait(timeout)


_open_sessions: dict[str, zenoh.Session] = {}  # by zenoh id


def _close_all() -> None:
    for session in list(_open_sessions.values()):
        close_session(session)


# zenoh serves callbacks from threads that end only with their session. Plain atexit hooks run after
# the interpreter has joined those, so a forgotten session would hang the process: the hook that
# concurrent.futures uses runs before.
_register: Callable[[Callable[[], None]], object] = getattr(
    threading, "_register_atexit", atexit.register
)
_register(_close_all)
