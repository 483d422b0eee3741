"""A ROS 2 node in a zenoh client session: publishers, subscriptions and their tokens.

A client of the router hears and reaches every node, also behind a router that does not forward
between peers (rmw_zenohd's default). It reconnects by itself when the router comes back.
"""

from __future__ import annotations

import contextlib
import json
import threading
import uuid
from collections.abc import Callable
from typing import Any

import zenoh
import zenoh.ext

from tactile_core.bus.messages import MAX_PAYLOAD, codec
from tactile_core.bus.streams import (
    ATTACHMENT,
    WALL_LIMIT_NS,
    BusSample,
    read_sample,
    undeclare,
)
from tactile_tools.ros2.names import STREAM, Endpoint, EndpointKind, Node, Qos, type_hash

DEFAULT_ROUTER = "tcp/127.0.0.1:7447"
"""Where rmw_zenohd listens."""

CONNECT_TIMEOUT_S = 3.0

HEARTBEAT_S = 0.5
"""The number of the last message of a latched topic is repeated once after this time, s, so that a
subscriber that missed it can ask again. rmw_zenoh does the same."""


class RouterError(Exception):
    """The router cannot be reached; the text names the remedy."""


def open_client(router: str, timeout_s: float = CONNECT_TIMEOUT_S) -> zenoh.Session:
    """Open a client session at ``router``; `RouterError` when nothing answers there in time."""
    values = {
        "mode": "client",
        "connect/endpoints": [router],
        "connect/timeout_ms": round(timeout_s * 1000),
        "connect/exit_on_failure": True,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "transport/link/rx/max_message_size": MAX_PAYLOAD + 4096,
        "transport/shared_memory/enabled": False,
    }
    config = zenoh.Config()
    try:
        for key, value in values.items():
            config.insert_json5(key, json.dumps(value))
        return zenoh.open(config)
    except zenoh.ZError as error:
        reason = str(error).partition(" at /")[0]
        raise RouterError(
            f"no ROS 2 router answers at {router} ({reason}): start one with `ros2 run "
            "rmw_zenoh_cpp rmw_zenohd`, or name its endpoint with --router tcp/HOST:PORT"
        ) from error


class RosPublisher:
    """Publishes CDR bytes on one topic; drops when the link is full, and never waits.

    ``matched``: whether anybody subscribes; always true for a latched topic, which keeps its last
    message for later subscribers.
    """

    def __init__(self, session: zenoh.Session, endpoint: Endpoint) -> None:
        self.endpoint = endpoint
        self.matched = endpoint.qos.transient_local
        self._sequence = 0
        self._putting = threading.Lock()
        self._closed = False
        self._gid = uuid.uuid4().bytes
        drop = zenoh.CongestionControl.DROP
        self._publisher: Any  # zenoh's two kinds share only their methods
        if endpoint.qos.transient_local:
            self._publisher = zenoh.ext.declare_advanced_publisher(
                session,
                endpoint.key,
                congestion_control=drop,
                cache=zenoh.ext.CacheConfig(endpoint.qos.depth),
                publisher_detection=True,
                sample_miss_detection=zenoh.ext.MissDetectionConfig(
                    heartbeat=None, sporadic_heartbeat=HEARTBEAT_S
                ),
            )
        else:
            publisher = session.declare_publisher(
                endpoint.key, congestion_control=drop, express=True
            )
            publisher.declare_matching_listener(self._match)
            # zenoh's stubs declare a bool, but it is a status object.
            status: Any = publisher.matching_status
            self.matched = status.matching
            self._publisher = publisher
        self._token = session.liveliness().declare_token(endpoint.token)

    def put(self, data: bytes, wall_ns: int, lost: int = 0) -> None:
        """Send ``data``, stamped with its wall-clock time.

        ``lost``: messages lost just before it.
        """
        wall_ns = min(max(wall_ns, 0), WALL_LIMIT_NS)
        with self._putting:  # several daemons share /diagnostics
            if self._closed:
                return
            self._sequence += 1 + lost
            attachment = ATTACHMENT.pack(self._sequence, wall_ns, 16, self._gid)
            try:
                self._publisher.put(data, attachment=attachment)
            except (zenoh.ZError, RuntimeError):
                if not self._closed:  # else another thread has just closed it
                    raise

    def close(self) -> None:
        """Undeclare the publisher and its token; `put` does nothing afterwards."""
        self._closed = True
        with contextlib.suppress(zenoh.ZError):
            self._token.undeclare()
            undeclare(self._publisher)

    def _match(self, status: zenoh.MatchingStatus) -> None:
        self.matched = status.matching


class RosSubscription:
    """Gives every sample of one topic to ``take``, in zenoh's thread.

    ``oversized``: samples that were too large and were not taken.
    """

    def __init__(
        self, session: zenoh.Session, endpoint: Endpoint, take: Callable[[BusSample], None]
    ) -> None:
        self.endpoint = endpoint
        self.oversized = 0
        self._take = take
        self._subscriber = session.declare_subscriber(endpoint.key, self._hear)
        self._token = session.liveliness().declare_token(endpoint.token)

    def close(self) -> None:
        """Undeclare the subscription and its token."""
        with contextlib.suppress(zenoh.ZError):
            self._token.undeclare()
            self._subscriber.undeclare()

    def _hear(self, sample: zenoh.Sample) -> None:
        if len(sample.payload) > MAX_PAYLOAD:
            self.oversized += 1
        else:
            self._take(read_sample(sample))


class RosNode:
    """One node with its endpoints. Not thread-safe: declare and close in one thread."""

    def __init__(
        self, router: str, name: str, *, namespace: str = "", domain: int = 0, distro: str
    ) -> None:
        self.distro = distro
        self._session = open_client(router)
        self.node = Node(domain, str(self._session.zid()), name, namespace)
        self._endpoints: list[RosPublisher | RosSubscription] = []
        self._token = self._session.liveliness().declare_token(self.node.token)

    @property
    def connected(self) -> bool:
        """Whether the router is connected."""
        return bool(self._session.info.routers_zid())

    def publish(self, topic: str, type_name: str, qos: Qos = STREAM) -> RosPublisher:
        """Declare a publisher; ``topic`` is in the namespace unless it begins with a slash."""
        made = RosPublisher(self._session, self._endpoint("MP", topic, type_name, qos))
        self._endpoints.append(made)
        return made

    def subscribe(
        self, topic: str, type_name: str, take: Callable[[BusSample], None], qos: Qos = STREAM
    ) -> RosSubscription:
        """Declare a subscription; see `publish`."""
        made = RosSubscription(self._session, self._endpoint("MS", topic, type_name, qos), take)
        self._endpoints.append(made)
        return made

    def close(self, timeout_s: float = 1.0) -> None:
        """Undeclare everything and leave, without waiting for a router that does not answer."""

        def leave() -> None:
            # zenoh raises RuntimeError while another thread is in the middle of a call; what is
            # left then ends with the process, or with the session.
            for endpoint in self._endpoints:
                with contextlib.suppress(zenoh.ZError, RuntimeError):
                    endpoint.close()
            with contextlib.suppress(zenoh.ZError, RuntimeError):
                self._token.undeclare()
            with contextlib.suppress(zenoh.ZError, RuntimeError):
                self._session.close()

        thread = threading.Thread(target=leave, name="ros2-close", daemon=True)
        thread.start()
        thread.join(timeout_s)

    def _endpoint(self, kind: EndpointKind, topic: str, type_name: str, qos: Qos) -> Endpoint:
        rihs01 = codec().schema(type_name).type_hash
        return Endpoint(
            node=self.node,
            number=len(self._endpoints) + 1,
            kind=kind,
            topic=self.node.resolve(topic),
            type_name=type_name,
            type_hash=type_hash(self.distro, rihs01),
            qos=qos,
        )
