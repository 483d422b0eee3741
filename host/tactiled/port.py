"""One port of the daemon: its reader, its line, and the stations of the boards behind it."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass

from tactile_bus.instant import Instant
from tactiled.blocks import Chunk
from tactiled.events import Diagnosed, Found, Identity, Refusal
from tactiled.inbox import Inbox, PortLost, PortOpened
from tactiled.line import Line, LineEvent
from tactiled.link import BoardLink
from tactiled.reader import PortReader
from tactiled.station import Station

log = logging.getLogger(__name__)

TURN = 64
"""Chunks worked off at a time: however far behind a port is, others and requests get their turn."""


@dataclass(frozen=True, slots=True)
class Trouble:
    """Why a port or board never came into service; ends the daemon at the start."""

    problem: str
    remedy: str

    def __str__(self) -> str:
        """As people read it."""
        return f"{self.problem}; {self.remedy}"


class Port:
    """Owned by the pipeline's thread.

    ``names``: of the boards at some nodes, and whether those came later than the others of their
    bus. ``open_station``: makes the station of a board; `Trouble` when its name is taken.
    ``live`` False: a recording, whose time is that of its chunks.
    """

    def __init__(
        self,
        name: str,
        line: Line,
        reader: PortReader,
        inbox: Inbox,
        names: Callable[[tuple[int, ...], bool], dict[int, str]],
        open_station: Callable[[Port, int, str], Station | Trouble],
        live: bool = True,
    ) -> None:
        self.name = name
        self.line = line
        self.reader = reader
        self.inbox = inbox
        self.stations: dict[int, Station] = {}
        self.ended = False
        self.trouble: Trouble | None = None
        """What keeps this port out of service, as far as is known."""
        self._names = names
        self._open_station = open_station
        self._live = live
        self._clock = Instant(0)

    @property
    def served(self) -> bool:
        """Whether any board of this port has ever streamed."""
        return any(station.sent for station in self.stations.values())

    def admit(self, node: int, identity: Identity) -> Refusal | None:
        """Judge a board that introduced itself."""
        station = self.stations.get(node)
        if station is None:
            return Refusal(f"no name is free for {identity}", "see the message above")
        return station.admit(identity)

    def pump(self, now: Instant) -> None:
        """Work off what the reader handed over, then what time demands, then write."""
        for _ in range(TURN):
            item = self.inbox.take()
            if item is None:
                break
            if isinstance(item, Chunk):
                self._clock = item.received
                self._handle(self.line.receive(item))
            elif isinstance(item, PortOpened):
                self._clock = now
                self.line.connect(now, item.usb_serial, item.byte_time)
            elif isinstance(item, PortLost):
                self._handle(self.line.disconnect())
                for station in self.stations.values():
                    station.port_lost(item.reason)
                if not self.stations:
                    log.warning("%s: %s", self.name, item.reason)
            else:
                self.ended = True
                for station in self.stations.values():
                    station.flush()
        # A recording's time is that of its chunks, which at high speed run ahead of ours.
        self._handle(self.line.tick(now if self._live else self._clock))
        self.write()

    @property
    def behind(self) -> bool:
        """Whether more waits than one turn works off."""
        return self.inbox.waiting

    def write(self) -> None:
        """Send what the links want to say."""
        for payload in self.line.outgoing():
            self.reader.transport.write(payload)

    def retry(self, node: int, now: Instant) -> None:
        """Have a refused board judged again."""
        link = self.line.links.get(node)
        if isinstance(link, BoardLink):
            link.retry(now)
        elif link is not None:
            link.retry()

    def farewell(self) -> None:
        """Stop the boards, send what is under way."""
        for node, link in self.line.links.items():
            if isinstance(link, BoardLink):
                link.farewell()
            if node in self.stations:
                self.stations[node].flush()
        self.write()

    def add_station(self, node: int, name: str) -> None:
        """Make room for a board under ``name``."""
        station = self._open_station(self, node, name)
        if isinstance(station, Trouble):
            self.trouble = station
            log.error("%s: %s", self.name, station)
        else:
            self.stations[node] = station

    def drops(self) -> dict[str, int]:
        """What this port lost or refused before any board's pipeline, by reason."""
        counts = dict(self.line.rejects)
        counts.update(self.reader.transport.losses)
        counts["inbox_overflow"] = self.inbox.dropped
        for link in self.line.links.values():
            for reason, n in link.counters.items():
                counts[reason] = counts.get(reason, 0) + n
        return {reason: n for reason, n in counts.items() if n}

    def _handle(self, events: list[LineEvent]) -> None:
        for happened in events:
            event = happened.event
            if happened.node is not None:
                station = self.stations.get(happened.node)
                if station is not None:
                    station.handle(event)
            elif isinstance(event, Found):
                for node, name in self._names(event.nodes, event.late).items():
                    self.add_station(node, name)
            elif isinstance(event, Diagnosed):
                self.trouble = Trouble(event.problem, event.remedy)
                log.error("%s; %s", event.problem, event.remedy)
