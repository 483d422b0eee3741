"""The bus as the page's source: the newest value of each stream, decoded only when it is shown.

zenoh keeps one sample of each stream in its own threads, so that unseen streams cost no Python.
"""

from __future__ import annotations

import logging
import time
from collections import deque
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

import zenoh

from tactile_core.bus.messages import DecodeError, codec
from tactile_core.bus.services import ServiceError, call
from tactile_core.bus.session import BusConfig, close_session, open_session
from tactile_core.bus.streams import BusSample, Latest, Tap
from tactile_core.bus.topics import (
    AMBIENT,
    ARM_STATE,
    DIAGNOSTICS,
    FEATURES,
    FORCES,
    GEOMETRY,
    REACH_EVENT,
    REACH_STATE,
    WORLD,
    Topic,
    find_topic,
    service_key,
)
from tactile_core.types import monotonic_now
from tactile_tools.view.state import MAX_BOARDS, PageModel

log = logging.getLogger(__name__)

BOARD_TOPICS = (GEOMETRY, DIAGNOSTICS, FEATURES, FORCES, AMBIENT)

TOKENS = {"tactile/*/alive": "tactile", "reach/*/alive": "reach", "arm/*/alive": "arm"}
"""Keys of the liveliness tokens that announce daemons."""

MAX_EVENTS_WAITING = 256
"""Events of a reach that may wait between two polls; they come a few a second."""

MAX_TOKENS_WAITING = 1024
"""Announcements of daemons that may wait between two polls."""

GEOMETRY_PERIOD_S = 2.0
"""Time between two requests to a board whose geometry is unknown, s."""

GEOMETRY_TIMEOUT_S = 1.0

TARE_S = 120.0
"""Time allowed for a tare, s: several times eight frames of a board at 0.5 Hz."""

REQUEST_S = 10.0
"""Time allowed for any other request of a button, s."""


@dataclass(slots=True)
class _Board:
    streams: dict[Topic, Latest]
    asked: float = -1e9  # when its geometry was last requested


@dataclass(slots=True)
class _Reach:
    states: Latest
    events: deque[BusSample] = field(default_factory=lambda: deque(maxlen=MAX_EVENTS_WAITING))
    tap: Tap | None = None


class LiveSource:
    """Boards, reach, arm and cupboard of the daemons on the bus. Call `poll` from one thread."""

    playing = False

    def __init__(self, config: BusConfig) -> None:
        """`BusError` when the bus cannot be joined."""
        self.meets = config.where()
        self.undecodable = 0
        self._codec = codec()
        self._session = open_session(config)
        self._boards: dict[str, _Board] = {}
        self._reaches: dict[str, _Reach] = {}
        self._arms: dict[str, Latest] = {}
        self._tokens: deque[tuple[str, bool]] = deque(maxlen=MAX_TOKENS_WAITING)
        self._world = Latest(self._session, WORLD.template.format(name="*"))
        liveliness = self._session.liveliness()
        self._watches = [
            liveliness.declare_subscriber(key, self._hear_token, history=True) for key in TOKENS
        ]

    def poll(self, model: PageModel) -> bool:
        """Give the model what is new; returns whether there was anything."""
        now = monotonic_now()
        new = self._take_tokens(model)
        for name, board in self._boards.items():
            for topic, stream in board.streams.items():
                new |= self._take(model, topic, name, stream.newest(), now)
        for name, reach in self._reaches.items():
            new |= self._take(model, REACH_STATE, name, reach.states.newest(), now)
            while reach.events:
                new |= self._take(model, REACH_EVENT, name, reach.events.popleft(), now)
        for name, stream in self._arms.items():
            new |= self._take(model, ARM_STATE, name, stream.newest(), now)
        sample = self._world.newest()
        if sample is not None:
            found = find_topic(sample.key)
            new |= self._take(model, WORLD, found[1] if found else "", sample, now)
        return new

    def missing_geometry(self, model: PageModel) -> list[str]:
        """Boards whose geometry should be requested; each at most every two seconds."""
        due, now = [], time.monotonic()
        for name, board in self._boards.items():
            shown = model.boards.get(name)
            if shown is None or not shown.alive or shown.layout is not None:
                continue
            if shown.features is not None and now - board.asked > GEOMETRY_PERIOD_S:
                board.asked = now
                due.append(name)
        return due

    def ask_geometry(self, name: str) -> None:
        """Make a board publish its geometry. Blocks."""
        with suppress(ServiceError):
            call(self._session, service_key(name, "geometry"), timeout=GEOMETRY_TIMEOUT_S)

    def ask(self, key: str, request: object, *, slow: bool = False) -> Any:
        """Call a service and return its reply. Blocks. `ServiceError` with the reason."""
        return call(self._session, key, request, timeout=TARE_S if slow else REQUEST_S)

    def close(self) -> None:
        """Leave the bus."""
        close_session(self._session)

    def _take(
        self, model: PageModel, topic: Topic, name: str, sample: BusSample | None, now: Any
    ) -> bool:
        if sample is None:
            return False
        try:
            model.take(topic, name, self._codec.decode(topic, sample.data), now)
        except (DecodeError, ValueError, IndexError) as error:
            self.undecodable += 1
            if self.undecodable == 1:
                log.warning("%s: a message cannot be shown: %s", sample.key, error)
            return False
        return True

    def _hear_token(self, sample: zenoh.Sample) -> None:
        self._tokens.append((str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT))

    def _take_tokens(self, model: PageModel) -> bool:
        new = False
        while self._tokens:
            key, alive = self._tokens.popleft()
            kind, _, rest = key.partition("/")
            name = rest.partition("/")[0]
            new = True
            if kind == "tactile":
                self._set_board(model, name, alive)
            elif kind == "reach":
                model.set_reach_alive(name, alive)
                if alive and name not in self._reaches and len(self._reaches) < MAX_BOARDS:
                    self._reaches[name] = self._open_reach(name)
            elif alive and name not in self._arms and len(self._arms) < MAX_BOARDS:
                self._arms[name] = Latest(self._session, ARM_STATE.key(name))
        return new

    def _set_board(self, model: PageModel, name: str, alive: bool) -> None:
        if alive and name not in self._boards:
            if len(self._boards) >= MAX_BOARDS:
                return
            streams = {topic: Latest(self._session, topic.key(name)) for topic in BOARD_TOPICS}
            self._boards[name] = _Board(streams)
        model.set_alive(name, alive)

    def _open_reach(self, name: str) -> _Reach:
        reach = _Reach(Latest(self._session, REACH_STATE.key(name)))
        reach.tap = Tap(self._session, REACH_EVENT.key(name), reach.events.append)
        return reach
