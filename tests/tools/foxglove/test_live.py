"""The rig live in Foxglove, seen by a client that knows only the protocol."""

from __future__ import annotations

import json
import signal
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("foxglove", reason="needs pip install -e '.[foxglove]'")
client = pytest.importorskip("websockets.sync.client", reason="needs pip install websockets")

from tactile_core.bus.messages import MSG, codec, header  # noqa: E402
from tactile_core.bus.services import ServiceError, declare_service  # noqa: E402
from tactile_core.bus.session import BusConfig, close_session, open_session  # noqa: E402
from tactile_core.bus.streams import declare_publisher  # noqa: E402
from tactile_core.bus.topics import FEATURES, GEOMETRY, LOG, REACH_STATE, Topic, service_key  # noqa: E402
from tactile_tools.foxglove import Live  # noqa: E402

PATIENCE_S = 120.0


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


class Viewer:
    """Client of Foxglove's WebSocket protocol.

    `data`: messages by topic; the last of each JSON kind.
    """

    def __init__(self, port: int) -> None:
        self.socket = client.connect(
            f"ws://127.0.0.1:{port}", subprotocols=["foxglove.sdk.v1"], max_size=None
        ).__enter__()
        self.channels: dict[str, dict[str, Any]] = {}
        self.services: dict[str, int] = {}
        self.said: dict[str, dict[str, Any]] = {}
        self.data: dict[str, list[tuple[int, bytes]]] = {}
        self.answers: dict[int, bytes] = {}
        self._topics: dict[int, str] = {}

    def until(self, done: Callable[[], Any], meanwhile: Callable[[], None] = lambda: None) -> Any:
        end = time.monotonic() + PATIENCE_S
        while not (found := done()):
            assert time.monotonic() < end, f"waited too long; said: {self.said}"
            meanwhile()
            try:
                self._take(self.socket.recv(timeout=0.05))
            except TimeoutError:
                continue
        return found

    def subscribe(self, topic: str) -> None:
        number = len(self._topics)
        self._topics[number] = topic
        self.data[topic] = []
        wanted = {"id": number, "channelId": self.channels[topic]["id"]}
        self.send(op="subscribe", subscriptions=[wanted])

    def send(self, **message: Any) -> None:
        self.socket.send(json.dumps(message))

    def call(self, service: str, request: dict[str, Any]) -> Any:
        number = len(self.answers) + 1
        head = struct.pack("<BIII", 2, self.services[service], number, 4)
        self.socket.send(head + b"json" + json.dumps(request).encode())
        self.said.pop("serviceCallFailure", None)
        self.until(lambda: number in self.answers or "serviceCallFailure" in self.said)
        if number not in self.answers:
            raise ServiceError(self.said["serviceCallFailure"]["message"])
        return json.loads(self.answers[number])

    def _take(self, message: str | bytes) -> None:
        if isinstance(message, str):
            said = json.loads(message)
            self.said[said["op"]] = said
            if said["op"] == "advertise":
                self.channels |= {c["topic"]: c for c in said["channels"]}
            elif said["op"] == "advertiseServices":
                self.services |= {s["name"]: s["id"] for s in said["services"]}
        elif message[0] == 1:
            number, log_ns = struct.unpack_from("<IQ", message, 1)
            self.data[self._topics[number]].append((log_ns, message[13:]))
        elif message[0] == 3:
            _, number, length = struct.unpack_from("<III", message, 1)
            self.answers[number] = message[13 + length :]


class Rig:
    """A daemon's side of the bus: one board and one reach, and the requests they received."""

    def __init__(self) -> None:
        self.endpoint = f"tcp/127.0.0.1:{free_port()}"
        self.session = open_session(BusConfig(role="tactiled", listen=(self.endpoint,), connect=()))
        self.asked: list[tuple[str, Any]] = []
        self.rate = 100.0
        self._publishers: dict[Topic, Any] = {}
        for name, answer in (
            ("tare", self._tare),
            ("status", self._status),
            ("set_rate", self._rate),
        ):
            declare_service(self.session, service_key("left", name), answer)
        declare_service(self.session, service_key("left", "geometry"), self._geometry)
        declare_service(self.session, service_key("reach", "goal", "reach"), self._goal)

    def put(self, topic: Topic, name: str, message: Any) -> bytes:
        if topic not in self._publishers:
            self._publishers[topic] = declare_publisher(self.session, topic, name)
        data = codec().encode(topic, message)
        self._publishers[topic].put(data, 1_700_000_000 * 10**9)
        return data

    def speak(self) -> None:
        """Publish one message of each stream."""
        self.put(LOG, "left", MSG.Log(header(0, "").stamp, 20, "left", "hello", "", "", 0))
        self.put(FEATURES, "left", _default(FEATURES.msgtype))
        self.put(REACH_STATE, "reach", _default(REACH_STATE.msgtype))

    def _geometry(self, request: Any) -> dict[str, Any]:
        self.put(GEOMETRY, "left", _default(GEOMETRY.msgtype))
        return {}

    def _tare(self, request: Any) -> dict[str, Any]:
        self.asked.append(("tare", request))
        if not request.get("force"):
            raise ServiceError("tare refused: something presses on the skin")
        return {"message": "rest field set"}

    def _status(self, request: Any) -> dict[str, Any]:
        return {"rate_hz": self.rate, "model": "finger", "features_valid": True, "port": None}

    def _rate(self, request: Any) -> dict[str, Any]:
        self.rate = request["rate_hz"]
        return {}

    def _goal(self, request: Any) -> dict[str, Any]:
        self.asked.append(("goal", request))
        return dict(request)


def _default(msgtype: str) -> Any:
    """A message of a type with every field zero or empty."""
    import numpy as np

    from tactile_core.bus.messages import NUMBER_TYPES, message_class

    def value(description: Any) -> Any:
        kind, detail = description
        if kind == 1:
            name = detail[0]
            return "" if name == "string" else NUMBER_TYPES[name](0).item()
        if kind == 2:
            return _default(detail)
        element = detail[0]
        if element[0] == 1 and element[1][0] in NUMBER_TYPES:
            return np.zeros(detail[1] if kind == 3 else 0, NUMBER_TYPES[element[1][0]])
        return []

    fields = {name: value(description) for name, description in codec().fields(msgtype)}
    return message_class(msgtype)(**fields)


@pytest.fixture
def rig() -> Iterator[Rig]:
    made = Rig()
    yield made
    close_session(made.session)


@pytest.fixture
def start(rig: Rig) -> Iterator[Callable[..., tuple[Live, Viewer]]]:
    opened: list[Any] = []

    def begin(**options: Any) -> tuple[Live, Viewer]:
        session = open_session(BusConfig(listen=(), connect=(rig.endpoint,)))
        live = Live(session, 0, **options)
        viewer = Viewer(live.port)
        opened.append((session, live, viewer))
        return live, viewer

    yield begin
    for session, live, viewer in opened:
        viewer.socket.close()
        live.close()
        close_session(session)


def both(rig: Rig, live: Live) -> Callable[[], None]:
    def work() -> None:
        rig.speak()
        live.tick()

    return work


def test_streams_have_the_schemas_of_the_logs(rig: Rig, start: Callable[..., Any]) -> None:
    live, viewer = start()
    topic = "/tactile/left/features"
    viewer.until(lambda: topic in viewer.channels, both(rig, live))
    channel, schema = viewer.channels[topic], codec().schema(FEATURES)
    assert channel["encoding"] == "cdr"
    assert channel["schemaName"] == schema.name
    assert channel["schemaEncoding"] == schema.encoding
    assert channel["schema"].encode() == schema.data
    viewer.subscribe(topic)
    viewer.until(lambda: viewer.data[topic], both(rig, live))
    log_ns, data = viewer.data[topic][0]
    assert log_ns == 1_700_000_000 * 10**9
    assert data == codec().encode(FEATURES, _default(FEATURES.msgtype))


def test_late_joiners_get_the_geometry(rig: Rig, start: Callable[..., Any]) -> None:
    live, viewer = start()
    topic = "/tactile/left/geometry"
    viewer.until(lambda: topic in viewer.channels, both(rig, live))
    late = Viewer(live.port)
    late.until(lambda: topic in late.channels)
    late.subscribe(topic)
    late.until(lambda: late.data[topic])
    assert late.data[topic][0][1] == codec().encode(GEOMETRY, _default(GEOMETRY.msgtype))
    late.socket.close()


def test_tare_is_a_service_and_its_refusal_is_shown(rig: Rig, start: Callable[..., Any]) -> None:
    live, viewer = start()
    viewer.until(lambda: "/tactile/left/tare" in viewer.services, both(rig, live))
    assert viewer.call("/tactile/left/tare", {"force": True}) == {"message": "rest field set"}
    with pytest.raises(ServiceError, match="something presses on the skin"):
        viewer.call("/tactile/left/tare", {})
    assert rig.asked == [("tare", {"force": True}), ("tare", {})]


def test_motion_is_offered_only_when_asked_for(rig: Rig, start: Callable[..., Any]) -> None:
    live, viewer = start()
    viewer.until(lambda: "/reach/reach/stop" in viewer.services, both(rig, live))
    assert "/reach/reach/goal" not in viewer.services
    live, viewer = start(control=True)
    viewer.until(lambda: "/reach/reach/goal" in viewer.services, both(rig, live))
    viewer.call("/reach/reach/goal", {"x": 0.3, "y": 0.0})
    assert rig.asked == [("goal", {"x": 0.3, "y": 0.0})]


def test_rate_is_a_parameter(rig: Rig, start: Callable[..., Any]) -> None:
    live, viewer = start(control=True)
    viewer.until(lambda: "/tactile/left/tare" in viewer.services, both(rig, live))

    def values() -> dict[str, Any]:
        said = viewer.said.get("parameterValues", {"parameters": []})
        return {p["name"]: p.get("value") for p in said["parameters"]}

    viewer.send(op="getParameters", parameterNames=[], id="all")
    viewer.until(lambda: "left.rate_hz" in values())
    assert values()["left.rate_hz"] == 100.0
    assert values()["left.model"] == "finger"
    wanted = [{"name": "left.rate_hz", "value": 50.0}, {"name": "left.model", "value": "x"}]
    viewer.send(op="setParameters", parameters=wanted, id="set")
    viewer.until(lambda: values().get("left.rate_hz") == 50.0)
    assert rig.rate == 50.0
    assert values()["left.model"] == "finger"


def test_rate_cannot_be_set_without_control(rig: Rig, start: Callable[..., Any]) -> None:
    live, viewer = start()
    viewer.until(lambda: "/tactile/left/tare" in viewer.services, both(rig, live))
    wanted = [{"name": "left.rate_hz", "value": 50.0}]
    viewer.send(op="setParameters", parameters=wanted, id="set")
    viewer.until(lambda: viewer.said.get("parameterValues", {}).get("id") == "set")
    assert rig.rate == 100.0


def test_port_in_use_is_one_sentence(rig: Rig, start: Callable[..., Any]) -> None:
    live, _ = start()
    with pytest.raises(OSError, match="--port"):
        Live(rig.session, live.port)


def test_command_serves_until_it_is_stopped(rig: Rig) -> None:
    port = free_port()
    command = Path(sys.executable).with_name("tactile")
    process = subprocess.Popen(
        [command, "foxglove", "--port", str(port), "--connect", rig.endpoint],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    assert f"ws://127.0.0.1:{port}" in process.stdout.readline()
    viewer = Viewer(port)
    viewer.until(lambda: "/tactile/left/features" in viewer.channels, rig.speak)
    again = subprocess.run(
        [command, "foxglove", "--port", str(port)], capture_output=True, text=True, check=False
    )
    assert again.returncode == 3
    assert "--port" in again.stderr
    assert "Traceback" not in again.stderr
    process.send_signal(signal.SIGTERM)
    _, said = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0, said


def test_without_foxglove_the_extra_is_named() -> None:
    code = (
        "import sys\nsys.modules['foxglove'] = None\n"
        "from tactile_tools.cli import main\nsys.exit(main(['foxglove']))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 3
    assert "tactile-reach[foxglove]" in done.stderr
    assert "Traceback" not in done.stderr
