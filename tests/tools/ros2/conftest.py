"""A ROS 2 router configured like rmw_zenohd, a bus with a publisher, messages of any type."""

from __future__ import annotations

import json
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import Any

import numpy as np
import pytest
import zenoh

from tactile_core.bus.messages import NUMBER_TYPES, codec, message_class
from tactile_core.bus.session import BusConfig, close_session, open_session
from tactile_core.bus.streams import declare_publisher
from tactile_core.bus.topics import Topic
from tactile_tools.ros2.bridge import Bridge
from tactile_tools.ros2.node import RosNode

PATIENCE_S = 120.0


def until(done: Callable[[], Any], seconds: float = PATIENCE_S) -> Any:
    """Return what ``done`` returns, as soon as that is true."""
    end = time.monotonic() + seconds
    while not (found := done()):
        assert time.monotonic() < end, "waited too long"
        time.sleep(0.01)
    return found


def free_endpoint() -> str:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


def plain_session(**values: object) -> zenoh.Session:
    """A zenoh session of another program; ``a__b`` stands for the setting ``a/b``."""
    config = zenoh.Config()
    for key, value in (
        {"scouting__multicast__enabled": False, "scouting__delay": 0} | values
    ).items():
        config.insert_json5(key.replace("__", "/"), json.dumps(value))
    return zenoh.open(config)


class Router:
    """Like rmw_zenohd: a router that does not forward between peers."""

    def __init__(self) -> None:
        self.endpoint = free_endpoint()
        self.session: zenoh.Session | None = None
        self.start()

    def start(self) -> None:
        self.session = plain_session(
            mode="router",
            listen__endpoints=[self.endpoint],
            routing__router__peers_failover_brokering=False,
        )

    def stop(self) -> None:
        if self.session is not None:
            self.session.close()
            self.session = None


class RosPeer:
    """A ROS node of another program: a peer at the router, like rmw_zenoh's sessions."""

    def __init__(self, router: Router) -> None:
        self.session = plain_session(mode="peer", connect__endpoints=[router.endpoint])
        self.heard: dict[str, list[zenoh.Sample]] = {}
        self._kept: list[Any] = []

    def listen(self, key: str) -> list[zenoh.Sample]:
        heard: list[zenoh.Sample] = self.heard.setdefault(key, [])
        self._kept.append(self.session.declare_subscriber(key, heard.append))
        return heard

    def tokens(self) -> set[str]:
        replies = self.session.liveliness().get("@ros2_lv/**", timeout=5.0)
        return {str(reply.ok.key_expr) for reply in replies if reply.ok is not None}

    def close(self) -> None:
        self.session.close()


class Bus:
    """A daemon's session with its publishers, and the endpoint where others join it."""

    def __init__(self) -> None:
        self.endpoint = free_endpoint()
        self.session = open_session(BusConfig(role="tactiled", listen=(self.endpoint,), connect=()))
        self._publishers: dict[tuple[Topic, str], Any] = {}

    def put(
        self, topic: Topic, name: str, message: Any, wall_ns: int = 1_700_000_000 * 10**9
    ) -> bytes:
        publisher = self._publishers.get((topic, name))
        if publisher is None:
            publisher = declare_publisher(self.session, topic, name)
            self._publishers[topic, name] = publisher
        data = codec().encode(topic, message)
        publisher.put(data, wall_ns)
        return data

    def skip(self, topic: Topic, name: str, count: int) -> None:
        """Pretend that ``count`` messages were lost on the way."""
        self._publishers[topic, name].sequence += count

    def join(self) -> zenoh.Session:
        return open_session(BusConfig(listen=(), connect=(self.endpoint,)))


def fill(msgtype: str, rng: np.random.Generator) -> Any:
    """A message of a type with a value in every field."""

    def value(description: Any) -> Any:
        kind, detail = description
        if kind == 1:
            name = detail[0]
            if name == "string":
                return f"text {rng.integers(1000)}"
            if name == "bool":
                return bool(rng.integers(2))
            return float(rng.integers(100)) if name.startswith("float") else int(rng.integers(100))
        if kind == 2:
            return fill(detail, rng)
        element, length = detail
        count = length if kind == 3 else 3
        if element[0] == 1 and element[1][0] in NUMBER_TYPES:
            return rng.integers(0, 2, count).astype(NUMBER_TYPES[element[1][0]])
        return [value(element) for _ in range(count)]

    fields = {name: value(description) for name, description in codec().fields(msgtype)}
    return message_class(msgtype)(**fields)


@pytest.fixture
def router() -> Iterator[Router]:
    made = Router()
    yield made
    made.stop()


@pytest.fixture
def peer(router: Router) -> Iterator[RosPeer]:
    made = RosPeer(router)
    yield made
    made.close()


@pytest.fixture
def bus() -> Iterator[Bus]:
    made = Bus()
    yield made
    close_session(made.session)


class Running:
    """A bridge with its two sessions, driven by the test."""

    def __init__(self, bus: Bus, router: Router, **options: Any) -> None:
        node_options = {key: options.pop(key) for key in ("namespace", "domain") if key in options}
        self.node = RosNode(
            router.endpoint, "tactile_bridge", distro=options.pop("distro", "jazzy"), **node_options
        )
        self.session = bus.join()
        self.bridge = Bridge(self.session, self.node, **options)

    def until(self, done: Callable[[], Any]) -> Any:
        def ticked() -> Any:
            self.bridge.tick()
            return done()

        return until(ticked)

    def close(self) -> None:
        self.bridge.close()
        self.node.close()
        with suppress(zenoh.ZError):
            close_session(self.session)


@pytest.fixture
def start_bridge(bus: Bus, router: Router) -> Iterator[Callable[..., Running]]:
    """``start_bridge(**options)``: start a bridge between ``bus`` and ``router``."""
    made: list[Running] = []

    def start(**options: Any) -> Running:
        made.append(Running(bus, router, **options))
        return made[-1]

    yield start
    for each in made:
        each.close()


@pytest.fixture
def filled() -> Callable[[str], Any]:
    """``filled(msgtype)``: a message with a value in every field."""
    rng = np.random.default_rng(1)
    return lambda msgtype: fill(msgtype, rng)


@pytest.fixture
def wait() -> Callable[..., Any]:
    """``wait(done)``: return what ``done`` returns, as soon as that is true."""
    return until
