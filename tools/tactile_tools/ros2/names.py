"""Names of topics, types, endpoints and QoS as ROS 2 over zenoh (rmw_zenoh) writes them. Pure.

The data of a topic travels under ``<domain>/<topic>/<type>/<hash of the type>``. Liveliness tokens,
one per node and one per endpoint, announce what exists; without them ``ros2 topic list`` shows
nothing. Source: section "graph cache" of rmw_zenoh's design document.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Final, Literal

ADMIN_SPACE: Final = "@ros2_lv"

DISTROS: Final = ("humble", "jazzy", "kilted", "lyrical", "rolling")
"""ROS 2 distributions that rmw_zenoh supports."""

DEFAULT_DISTRO: Final = "jazzy"

WITHOUT_HASHES: Final = frozenset({"humble"})
"""Distributions whose message types have no hash yet."""

NO_HASH: Final = "TypeHashNotSupported"

MAX_DOMAIN: Final = 232
"""Largest ROS domain id that every middleware accepts."""

NAMESPACE: Final = re.compile(r"(/[A-Za-z_][A-Za-z0-9_]*)*")
NODE_NAME: Final = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")

EndpointKind = Literal["MP", "MS", "SS", "SC"]
"""Publisher, subscription, service server, service client."""


@dataclass(frozen=True, slots=True)
class Qos:
    """The announced part of a QoS profile. ``depth``: of the history (keep last)."""

    reliable: bool = True
    transient_local: bool = False
    depth: int = 10

    @property
    def token(self) -> str:
        """Form in a liveliness token; empty where the value is rmw_zenoh's default."""
        reliability = "" if self.reliable else "2"
        durability = "1" if self.transient_local else ""
        return f"{reliability}:{durability}:,{self.depth}:,:,:,,"


STREAM: Final = Qos()
LATCHED: Final = Qos(transient_local=True, depth=1)
"""The last message is kept and given to later subscribers."""


@dataclass(frozen=True, slots=True)
class Node:
    """A ROS node. ``zid``: id of the zenoh session, in hex. ``namespace``: "" or "/like/this"."""

    domain: int
    zid: str
    name: str
    namespace: str = ""
    number: int = 0

    @property
    def token(self) -> str:
        """Key of the liveliness token that announces the node."""
        return (
            f"{ADMIN_SPACE}/{self.domain}/{self.zid}/{self.number}/{self.number}/NN/%/"
            f"{mangle(self.namespace)}/{self.name}"
        )

    def resolve(self, topic: str) -> str:
        """Absolute name of ``topic``, which is in the namespace unless it begins with a slash."""
        return topic if topic.startswith("/") else f"{self.namespace}/{topic}"


@dataclass(frozen=True, slots=True)
class Endpoint:
    """A publisher, subscription or service of a node. ``topic``: absolute. ``number``: its id."""

    node: Node
    number: int
    kind: EndpointKind
    topic: str
    type_name: str
    type_hash: str
    qos: Qos = STREAM

    @property
    def key(self) -> str:
        """Key under which the data travels."""
        kind = f"{dds_type(self.type_name)}/{self.type_hash}"
        return f"{self.node.domain}/{self.topic.strip('/')}/{kind}"

    @property
    def token(self) -> str:
        """Key of the liveliness token that announces the endpoint."""
        node = self.node
        return (
            f"{ADMIN_SPACE}/{node.domain}/{node.zid}/{node.number}/{self.number}/{self.kind}/%/"
            f"{mangle(node.namespace)}/{node.name}/{mangle(self.topic)}/"
            f"{dds_type(self.type_name)}/{self.type_hash}/{self.qos.token}"
        )


def mangle(name: str) -> str:
    """Return a name as one chunk of a key: slashes become %, an empty name becomes a single %."""
    return name.replace("/", "%") or "%"


def dds_type(type_name: str) -> str:
    """Return ``pkg/msg/Name`` as ``pkg::msg::dds_::Name_``; ValueError for anything else."""
    parts = type_name.split("/")
    if len(parts) != 3 or parts[1] not in ("msg", "srv", "action"):
        raise ValueError(f"{type_name!r} is not a type such as std_msgs/msg/Header")
    return f"{parts[0]}::{parts[1]}::dds_::{parts[2]}_"


def ros_name(name: str) -> str:
    """Return the ``name`` of a board, arm or reach as ROS allows it: no dash, no digit in front."""
    plain = name.replace("-", "_")
    return f"_{plain}" if plain[:1].isdigit() else plain


def type_hash(distro: str, rihs01: str) -> str:
    """Hash of a type as ``distro`` writes it. ``rihs01``: the hash in the form ``RIHS01_...``."""
    return NO_HASH if distro in WITHOUT_HASHES else rihs01
