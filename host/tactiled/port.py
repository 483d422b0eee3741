"""One port of the daemon: its reader, its line, and the boards behind it."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

from tactile_core.throttle import Throttle
from tactile_core.types import Instant, monotonic_now
from tactiled import journal as kinds
from tactiled.blocks import Chunk
from tactiled.board_session import BoardSession
from tactiled.boards.board import BoardLink
from tactiled.boards.events import Diagnosed, Event, Found, Identity, Refusal, Waiting
from tactiled.boards.line import Line, LineEvent
from tactiled.journal import Journal
from tactiled.reader import Inbox, Item, PortLost, PortOpened
from tactiled.transports.base import Transport

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


class Source(Protocol):
    """What a port has of its reader."""

    reopened: int

    @property
    def transport(self) -> Transport:
        """Where payloads are written and losses are counted."""


class Port:
    """Owned by the pipeline's thread.

    ``names``: of the boards at some nodes, and whether those came later than the others of their
    bus. ``open_board``: opens the session of a board; `Trouble` when its name is taken.
    ``live`` False: a recording, whose time is that of its chunks. ``journal``: where it is noted
    what was acted on beside the bytes.
    """

    def __init__(
        self,
        name: str,
        line: Line,
        source: Source,
        inbox: Inbox,
        names: Callable[[tuple[int, ...], bool], dict[int, str]],
        open_board: Callable[[Port, int, str], BoardSession | Trouble],
        live: bool = True,
        journal: Journal | None = None,
    ) -> None:
        self.name = name
        self.line = line
        self.reader = source
        self.inbox = inbox
        self.boards: dict[int, BoardSession] = {}
        self.ended = False
        self.trouble: Trouble | None = None
        """What keeps this port out of service, as far as is known."""
        self.spoilt = 0
        """Chunks, and turns, that could not be worked off for a reason nobody foresaw."""
        self.unnoted = 0
        """Events that the journal could not hold."""
        self._complaints = Throttle(rate=0.1, burst=3)
        self._names = names
        self._open_board = open_board
        self._live = live
        self._journal = journal
        self._clock = Instant(0)

    @property
    def served(self) -> bool:
        """Whether any board of this port has ever streamed."""
        return any(board.sent for board in self.boards.values())

    def admit(self, node: int, identity: Identity) -> Refusal | None:
        """Judge a board that introduced itself."""
        board = self.boards.get(node)
        if board is None:
            return Refusal(f"no name is free for {identity}", "see the message above")
        return board.admit(identity)

    def pump(self, now: Instant, stopping: Callable[[], bool] = lambda: False) -> None:
        """Work off what the reader handed over, then what time demands, then write.

        ``stopping``: asked between two chunks; when true the rest is left. Nothing is raised: what
        cannot be worked off is counted and told.
        """
        for _ in range(TURN):
            item = None if stopping() else self.inbox.take()
            if item is None:
                break
            if isinstance(item, Chunk) and self.inbox.skipped:
                self.note(kinds.SKIPPED, now, until=item.received)
            try:
                self.work(item, now)
            except Exception as error:  # noqa: BLE001 - one chunk must not end the others
                self._spoilt(error)
        try:
            # A recording's time is that of its chunks, which at high speed run ahead of ours.
            self.tick(now if self._live else self._clock)
            if self._journal is not None:
                self._journal.progress(now)
        except Exception as error:  # noqa: BLE001 - one port must not end the others
            self._spoilt(error)

    def work(self, item: Item, now: Instant) -> None:
        """Work off one chunk, or one piece of news of the port itself."""
        if isinstance(item, Chunk):
            self._clock = item.received
            self._handle(self.line.receive(item))
            if self._journal is not None:
                self._journal.worked(item.received)
        elif isinstance(item, PortOpened):
            self._clock = now
            self.note(kinds.OPENED, now, value=item.byte_time, text=item.usb_serial)
            self.line.connect(now, item.usb_serial, item.byte_time)
        elif isinstance(item, PortLost):
            self.note(kinds.LOST, now, text=item.reason)
            self._handle(self.line.disconnect())
            for board in self.boards.values():
                board.port_lost(item.reason)
            if not self.boards:
                log.warning("%s: %s", self.name, item.reason)
        else:
            self.ended = True
            for board in self.boards.values():
                board.flush()

    def tick(self, now: Instant) -> None:
        """Let the links do what time demands, and write what they want to say."""
        events, payloads = self.line.tick(now), self.line.outgoing()
        if events or payloads:  # else it left no trace, whenever it was
            self.note(kinds.TICK, now)
        self._handle(events)
        for payload in payloads:
            self.reader.transport.write(payload)

    def note(self, kind: str, now: Instant, **values: Any) -> None:
        """Have the journal note what is acted on; see `Journal.note`."""
        if self._journal is not None:
            try:
                self._journal.note(kind, now, **values)
            except (ValueError, TypeError) as error:  # a text that no message can hold
                self.unnoted += 1
                log.debug("%s: %s cannot be noted: %s", self.name, kind, error)

    @property
    def behind(self) -> bool:
        """Whether more waits than one turn works off."""
        return self.inbox.waiting

    def retry(self, node: int, now: Instant) -> None:
        """Have a refused board judged again."""
        link = self.line.links.get(node)
        if isinstance(link, BoardLink):
            link.retry(now)
        elif link is not None:
            link.retry()

    def stop_streaming(self, now: Instant) -> None:
        """Stop the boards, send what is under way."""
        self.note(kinds.ENDED, now)
        for node, link in self.line.links.items():
            if isinstance(link, BoardLink):
                link.stop_streaming()
            if node in self.boards:
                self.boards[node].flush()
        for payload in self.line.outgoing():
            self.reader.transport.write(payload)

    def add_board(self, node: int, name: str) -> None:
        """Make room for a board under ``name``."""
        board = self._open_board(self, node, name)
        if isinstance(board, Trouble):
            self.trouble = board
            log.error("%s: %s", self.name, board)
        else:
            board.node = node
            self.boards[node] = board

    def drops(self) -> dict[str, int]:
        """What this port lost or refused before any board's pipeline, by reason."""
        counts = dict(self.line.rejects)
        counts.update(self.reader.transport.losses)
        counts["inbox_overflow"] = self.inbox.dropped
        counts["spoilt_chunks"], counts["unnoted_events"] = self.spoilt, self.unnoted
        for link in self.line.links.values():
            for reason, n in link.counters.items():
                counts[reason] = counts.get(reason, 0) + n
        return {reason: n for reason, n in counts.items() if n}

    @property
    def identified(self) -> bool:
        """Whether any board of this port has ever said who it is."""
        return any(board.identity is not None for board in list(self.boards.values()))

    def _spoilt(self, error: Exception) -> None:
        self.spoilt += 1
        if self._complaints.allow(monotonic_now()):
            log.error("%s: data could not be worked off", self.name, exc_info=error)

    def _hand_over(self, board: BoardSession, event: Event) -> None:
        if not self._live:
            board.handle(event)  # a recording is judged by whether it comes out the same
            return
        try:
            board.handle(event)
        except Exception as error:  # noqa: BLE001 - one event must not end the others
            board.spoilt(error)

    def _handle(self, events: list[LineEvent]) -> None:
        for happened in events:
            event = happened.event
            if happened.node is not None:
                board = self.boards.get(happened.node)
                if board is not None:
                    self._hand_over(board, event)
            elif isinstance(event, Found):
                for node, name in self._names(event.nodes, event.late).items():
                    self.add_board(node, name)
            elif isinstance(event, Waiting):
                log.info("%s", event.text)
            elif isinstance(event, Diagnosed):
                self.trouble = Trouble(event.problem, event.remedy)
                log.error("%s; %s", event.problem, event.remedy)
