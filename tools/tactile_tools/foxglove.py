"""``tactile foxglove``: show the running rig in Foxglove, with the schemas of its logs."""

from __future__ import annotations

import argparse
import json
import logging
import signal
import sys
import threading
import time
from collections import Counter
from typing import TYPE_CHECKING, Any, Final

import zenoh

from tactile_core.bus.messages import codec
from tactile_core.bus.services import ServiceError, call
from tactile_core.bus.session import BusError, close_session, open_session
from tactile_core.bus.streams import BusSample, Tap
from tactile_core.bus.topics import COMMAND, FEATURES, REACH_STATE, TF, find_topic, service_key
from tactile_core.options import BusTable, bus_config

if TYPE_CHECKING:
    from foxglove import Channel, Parameter, Service, ServiceRequest

log = logging.getLogger(__name__)

DEFAULT_PORT: Final = 8765
"""Default of Foxglove, which *Open connection* offers."""

HOST: Final = "127.0.0.1"
"""This machine alone, because the protocol has no authentication."""

BACKLOG: Final = 32
"""Messages that wait for a slow viewer before the oldest are dropped: a third of a second of a
stream."""

MAX_CHANNELS: Final = 256
KEYS: Final = ("tactile/*/*", "arm/*/state", "reach/*/*", "reference/*/*", "world/*/*", TF.template)

TICK_S: Final = 0.05
QUIET_S: Final = 5.0
"""Seconds of silence after which an empty bus is mentioned, once."""
STATUS_TIMEOUT_S: Final = 2.0
TARE_TIMEOUT_S: Final = 120.0
GEOMETRY_TIMEOUT_S: Final = 5.0

BOARD_SERVICES: Final = {"status": {}, "tare": {"force": "boolean"}}
REACH_SERVICES: Final = {
    "status": {},
    "stop": {"reason": "string"},
    "arm": {"free_air": "boolean"},
    "goal": {"x": "number", "y": "number"},
    "reset": {},
}
"""Services offered for boards and reaches: name, and fields of the request with their types. Those
of a reach need --control, except `ALWAYS`."""

ALWAYS: Final = ("status", "stop")

RATE: Final = "rate_hz"
READ_ONLY: Final = ("model", "serial_number", "port", "features_valid")
"""Fields of a board's status shown as parameters; only `RATE` can be set."""

DONE, USAGE, REFUSED = 0, 2, 3


def run(options: argparse.Namespace) -> int:
    """Serve viewers until stopped; returns the exit status."""
    try:
        import foxglove  # noqa: F401 - is it installed?
    except ImportError:
        print("tactile foxglove: needs `pip install 'tactile-reach[foxglove]'`", file=sys.stderr)
        return REFUSED
    stopping = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stopping.set())
    config = bus_config(options, BusTable(), "tool")
    try:
        bus = open_session(config)
    except BusError as error:
        print(f"tactile foxglove: {error}", file=sys.stderr)
        return USAGE
    try:
        live = Live(bus, options.port, control=options.control)
    except OSError as error:
        print(f"tactile foxglove: {error}", file=sys.stderr)
        close_session(bus)
        return REFUSED
    print(
        f"Foxglove: Open connection, ws://{HOST}:{live.port} (or {live.app_url}); layout: "
        "docs/foxglove-layout.json",
        flush=True,
    )
    quiet_until = time.monotonic() + QUIET_S
    try:
        while not stopping.wait(TICK_S):
            live.tick()
            if quiet_until and time.monotonic() > quiet_until:
                quiet_until = 0.0
                if not live.counts["shown"]:
                    print(
                        f"nothing on the bus yet{config.where()}: is tactiled running, with the "
                        "same keys and TACTILE_RUNTIME_DIR?",
                        file=sys.stderr,
                        flush=True,
                    )
    finally:
        live.close()
        close_session(bus)
    return DONE


class Live:
    """Serves viewers with what is on ``bus``; call `tick` often, from one thread.

    OSError with the remedy when the port is in use. ``control``: offer services that move the arm
    or change a board's rate. ``counts``: messages shown and not shown, by reason.
    """

    def __init__(self, bus: zenoh.Session, port: int = DEFAULT_PORT, *, control: bool = False):
        import foxglove
        from foxglove.websocket import Capability

        self.counts: Counter[str] = Counter()
        self._bus = bus
        self._control = control
        self._context = foxglove.Context()
        self._channels: dict[str, Channel] = {}
        self._latched: dict[str, tuple[bytes, int]] = {}  # last message by topic, and its time
        self._boards: set[str] = set()
        self._reaches: set[str] = set()
        self._unserved: dict[tuple[str, str], None] = {}  # new boards and reaches, as (kind, name)
        self._lock = threading.Lock()
        logging.getLogger("foxglove").setLevel(logging.WARNING)
        try:
            self._server = foxglove.start_server(
                name="tactile-reach",
                host=HOST,
                port=port,
                capabilities=[Capability.Services, Capability.Parameters],
                server_listener=_Listener(self),
                supported_encodings=["json"],
                context=self._context,
                message_backlog_size=BACKLOG,
            )
        except RuntimeError as error:
            raise OSError(
                f"port {port} cannot be used ({error}): stop what listens there, or give another "
                "with --port"
            ) from error
        self._taps = [Tap(bus, key, self._hear) for key in KEYS]

    @property
    def port(self) -> int:
        """TCP port of the server."""
        return int(self._server.port)

    @property
    def app_url(self) -> str:
        """Address that opens Foxglove in a browser, already connected."""
        return str(self._server.app_url())

    def tick(self) -> None:
        """Offer the services of boards and reaches heard for the first time."""
        for kind, name in list(self._unserved):
            del self._unserved[kind, name]
            if kind == "tactile":
                self._boards.add(name)
                key = service_key(name, "geometry")
                self._bus.get(key, lambda _: None, timeout=GEOMETRY_TIMEOUT_S)
                wanted = dict(BOARD_SERVICES)
            else:
                self._reaches.add(name)
                wanted = {
                    service: fields
                    for service, fields in REACH_SERVICES.items()
                    if self._control or service in ALWAYS
                }
            self._server.add_services(
                [self._service(kind, name, service, fields) for service, fields in wanted.items()]
            )

    def close(self) -> None:
        """Stop serving."""
        for tap in self._taps:
            tap.close()
        self._server.stop()

    def subscribed(self, topic: str) -> None:
        """Send a new subscriber the last message of a latched topic."""
        held, channel = self._latched.get(topic), self._channels.get(topic)
        if held is not None and channel is not None:
            data, wall_ns = held
            channel.log(data, log_time=wall_ns)

    def parameters(self, names: list[str]) -> list[Parameter]:
        """Parameters called ``names`` (all if empty), read from the boards' status services."""
        import foxglove

        found = []
        for board in sorted(self._boards):
            wanted = [
                field for field in (RATE, *READ_ONLY) if not names or f"{board}.{field}" in names
            ]
            if not wanted:
                continue
            try:
                status = call(self._bus, service_key(board, "status"), timeout=STATUS_TIMEOUT_S)
            except (ServiceError, zenoh.ZError) as error:
                log.warning("%s: %s", board, error)
                continue
            found += [
                foxglove.Parameter(f"{board}.{field}", value=status[field])
                for field in wanted
                if status.get(field) is not None
            ]
        return found

    def set_parameters(self, asked: list[Parameter]) -> list[Parameter]:
        """Set rates and refuse everything else; returns the values now in force."""
        for parameter in asked:
            board, _, field = parameter.name.rpartition(".")
            if field != RATE or board not in self._boards or not self._control:
                log.warning(
                    "parameter %s cannot be set%s",
                    parameter.name,
                    "" if self._control else " without --control",
                )
                continue
            try:
                # Anything but a number ends in TypeError or ValueError below.
                rate = float(parameter.get_value())  # type: ignore[arg-type]
                key = service_key(board, "set_rate")
                call(self._bus, key, {"rate_hz": rate}, STATUS_TIMEOUT_S)
            except (ServiceError, zenoh.ZError, TypeError, ValueError) as error:
                log.warning("%s: %s", parameter.name, error)
        return self.parameters([parameter.name for parameter in asked])

    def _hear(self, sample: BusSample) -> None:
        found = find_topic(sample.key)
        if found is None or found[0] is COMMAND:
            return
        topic, name = found
        path = "/" + sample.key
        channel = self._channels.get(path)
        if channel is None:
            channel = self._channel(path, topic.msgtype)
            if channel is None:
                self.counts["too_many_streams"] += 1
                return
            if topic is FEATURES and name not in self._boards:
                self._unserved["tactile", name] = None
            elif topic is REACH_STATE and name not in self._reaches:
                self._unserved["reach", name] = None
        wall_ns = time.time_ns() if sample.wall_ns is None else max(0, sample.wall_ns)
        if topic.latched:
            self._latched[path] = (sample.data, wall_ns)
        channel.log(sample.data, log_time=wall_ns)
        self.counts["shown"] += 1

    def _channel(self, path: str, msgtype: str) -> Channel | None:
        import foxglove

        with self._lock:  # two taps may receive the first messages at the same time
            if path not in self._channels:
                if len(self._channels) >= MAX_CHANNELS:
                    return None
                schema = codec().schema(msgtype)
                self._channels[path] = foxglove.Channel(
                    path,
                    message_encoding="cdr",
                    schema=foxglove.Schema(
                        name=schema.name, encoding=schema.encoding, data=schema.data
                    ),
                    context=self._context,
                )
            return self._channels[path]

    def _service(self, kind: str, name: str, service: str, fields: dict[str, str]) -> Service:
        import foxglove

        key = service_key(name, service, kind)
        timeout = TARE_TIMEOUT_S if service == "tare" else STATUS_TIMEOUT_S

        def handle(request: ServiceRequest) -> bytes:
            try:
                answer = call(self._bus, key, json.loads(request.payload or b"{}"), timeout)
            except (ServiceError, zenoh.ZError, ValueError) as error:
                raise RuntimeError(str(error)) from error  # foxglove shows the text to the viewer
            return json.dumps(answer).encode()

        def schema(of: str, properties: dict[str, str]) -> foxglove.MessageSchema:
            text = {"type": "object", "properties": {k: {"type": v} for k, v in properties.items()}}
            return foxglove.MessageSchema(
                encoding="json",
                schema=foxglove.Schema(
                    name=of, encoding="jsonschema", data=json.dumps(text).encode()
                ),
            )

        return foxglove.Service(
            f"/{kind}/{name}/{service}",
            schema=foxglove.ServiceSchema(
                f"{kind}.{service}",
                request=schema(f"{kind}.{service}.request", fields),
                response=schema(f"{kind}.{service}.response", {}),
            ),
            handler=handle,
        )


class _Listener:
    """Callbacks for what viewers do, called in the server's threads. None may raise."""

    def __init__(self, live: Live) -> None:
        self._live = live

    def on_subscribe(self, client: Any, channel: Any) -> None:
        del client
        self._live.subscribed(channel.topic)

    def on_get_parameters(
        self, client: Any, names: list[str], request_id: str | None = None
    ) -> list[Parameter]:
        del client, request_id
        return self._live.parameters(names)

    def on_set_parameters(
        self, client: Any, parameters: list[Parameter], request_id: str | None = None
    ) -> list[Parameter]:
        del client, request_id
        return self._live.set_parameters(parameters)

    def on_unsubscribe(self, client: Any, channel: Any) -> None:
        """Nothing to do."""

    def on_client_advertise(self, client: Any, channel: Any) -> None:
        """Viewers publish nothing."""

    def on_client_unadvertise(self, client: Any, client_channel_id: int) -> None:
        """Viewers publish nothing."""

    def on_message_data(self, client: Any, client_channel_id: int, data: bytes) -> None:
        """Viewers publish nothing."""

    def on_parameters_subscribe(self, names: list[str]) -> None:
        """Not supported: parameters are sent when they are asked for."""

    def on_parameters_unsubscribe(self, names: list[str]) -> None:
        """Nothing to do."""

    def on_connection_graph_subscribe(self) -> None:
        """Not supported."""

    def on_connection_graph_unsubscribe(self) -> None:
        """Not supported."""

    def on_playback_control_request(self, request: Any) -> None:
        """Not supported: live data cannot be rewound."""
