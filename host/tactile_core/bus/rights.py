"""Access rights: the table of roles, from which zenoh's access control is generated.

A certificate gives its holder a role. Every process checks the traffic from a peer against the
rights of that peer's certificate and drops what they do not grant. On the bus of one machine, which
only its owner and group can enter (`runtime`), everybody has all rights.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

CertificateRole = Literal["tactiled", "reachd", "arm", "operator", "viewer"]

CERTIFICATE_ROLES: tuple[CertificateRole, ...] = (
    "tactiled",
    "reachd",
    "arm",
    "operator",
    "viewer",
)
"""Roles: the daemons; operator, a person or tool that arms, gives goals and tares; viewer,
read-only."""

ASKS_ONLY = ("status", "geometry")
"""Services that change nothing and are open to every role."""


@dataclass(frozen=True, slots=True)
class Rights:
    """Key expressions that a role may publish, ask (services), serve, and declare tokens for."""

    publishes: tuple[str, ...] = ()
    asks: tuple[str, ...] = ()
    serves: tuple[str, ...] = ()
    tokens: tuple[str, ...] = ()


PREFIX = "replay/"
"""Prefix of a replay's keys."""

PUBLIC = tuple(
    f"{lead}{kind}/*/srv/{name}"
    for lead in ("", PREFIX)
    for kind in ("tactile", "arm", "reach", "world")
    for name in ASKS_ONLY
)

_SKIN = ("features", "forces", "field", "ambient", "geometry", "contacts", "diagnostics", "log")

RIGHTS: Mapping[CertificateRole, Rights] = {
    "tactiled": Rights(
        publishes=(*(f"tactile/*/{name}" for name in _SKIN), f"{PREFIX}**"),
        serves=("tactile/*/srv/*", f"{PREFIX}tactile/*/srv/*"),
        tokens=("tactile/*/alive",),
    ),
    "reachd": Rights(
        publishes=("arm/*/cmd_vel", "reach/**"),
        # The arm accepts limits, clear and release only from its commander.
        asks=("arm/*/srv/*",),
        serves=("reach/*/srv/*",),
        tokens=("reach/*/alive", "arm/*/commander/*"),
    ),
    "arm": Rights(
        publishes=("arm/*/state", "world/**", "tf"),
        serves=("arm/*/srv/*", "world/*/srv/*"),
        tokens=("arm/*/alive", "world/*/alive"),
    ),
    "operator": Rights(
        publishes=("reference/**", f"{PREFIX}**"),
        asks=("tactile/*/srv/*", "arm/*/srv/*", "reach/*/srv/*", "world/*/srv/*"),
        tokens=("reference/*/alive", f"{PREFIX}*/alive"),
    ),
    "viewer": Rights(),
}

READS = ("tactile/**", "arm/**", "reach/**", "reference/**", "world/**", "replay/**", "tf")
"""Key expressions that every role may subscribe to."""


def access_control(roles: Mapping[CertificateRole, Sequence[str]]) -> dict[str, Any]:
    """zenoh's ``access_control`` for the certificate names of each role; all else is denied."""
    rules: list[dict[str, Any]] = [
        _rule("hear", ["egress"], ["put", "delete", "liveliness_token"], [*READS, *PUBLIC]),
        _rule("be asked", ["egress"], ["query", "reply", "liveliness_query"], READS),
        _rule(
            "declare",
            ["egress"],
            ["declare_subscriber", "declare_queryable", "declare_liveliness_subscriber"],
            READS,
        ),
        _rule(
            "subscribe",
            ["ingress"],
            [
                "declare_subscriber",
                "liveliness_query",
                "declare_liveliness_subscriber",
            ],
            READS,
        ),
        _rule("look", ["ingress"], ["query"], PUBLIC),
    ]
    policies = []
    for role in CERTIFICATE_ROLES:
        rights = RIGHTS[role]
        granted = ["hear", "be asked", "declare", "subscribe", "look"]
        for name, messages, keys in (
            ("publish", ["put", "delete"], rights.publishes),
            ("ask", ["query"], rights.asks),
            ("serve", ["declare_queryable", "reply"], rights.serves),
            ("token", ["liveliness_token"], rights.tokens),
        ):
            if keys:
                rules.append(_rule(f"{role} {name}", ["ingress"], messages, keys))
                granted.append(f"{role} {name}")
        if roles.get(role):
            policies.append({"rules": granted, "subjects": [role]})
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": [
            {"id": role, "cert_common_names": list(roles[role])}
            for role in CERTIFICATE_ROLES
            if roles.get(role)
        ],
        "policies": policies,
    }


def _rule(name: str, flows: list[str], messages: list[str], keys: Sequence[str]) -> dict[str, Any]:
    return {
        "id": name,
        "permission": "allow",
        "flows": flows,
        "messages": messages,
        "key_exprs": list(keys),
    }


def may_ask(role: str, key: str) -> bool:
    """Whether a certificate of ``role`` may ask the service at ``key``."""
    import zenoh

    rights = RIGHTS.get(role)  # type: ignore[call-overload]  # an unknown role has no rights
    if rights is None:
        return False
    wanted = zenoh.KeyExpr(key)
    return any(zenoh.KeyExpr(k).includes(wanted) for k in (*PUBLIC, *rights.asks))
