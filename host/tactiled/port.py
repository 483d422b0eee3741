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

CHUNKS_PER_TURN = 64
"""Most chunks processed in one turn, so that a port that lags does not hold up the others."""


@dataclass(frozen=True, slots=True)
class Trouble:
    """Why a port or board cannot come into service; ends the daemon at the start."""

    problem: str
    remedy: str

    def __str__(self) -> str:
        """Problem and remedy in one line."""
        return f"{self.problem}; {self.remedy}"


class Source(Protocol):
    """The part of a reader that a port uses."""

    reopened: int

    @property
    def transport(self) -> Transport:
        """Where payloads are written and losses are counted."""


class Port:
    """A port with its boards; owned by the pipeline's thread.

    ``names``: gives the names of boards by node; its second argument says whether they joined the
    bus later than the others. ``open_board``: opens the session of a board; `Trouble` when its name
    is taken. ``live`` False: a recording, whose time is that of its chunks. ``journal``: takes
    notes of everything acted on besides the bytes.
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
        """What keeps this port out of service; None when nothing is known to."""
        self.spoilt = 0
        """Chunks and turns lost to an unexpected error."""
        self.unnoted = 0
        """Events that the journal could not encode."""
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
        """Accept a board that has identified itself (None) or say why not."""
        board = self.boards.get(node)
        if board is None:
            return Refusal(f"no name is free for {identity}", "see the message above")
        return board.admit(identity)

    def pump(self, now: Instant, stopping: Callable[[], bool] = lambda: False) -> None:
        """Process what the reader handed over, then whatever is due, then write.

        ``stopping``: asked between chunks; when true the rest is left. Never raises: chunks that
        cannot be processed are counted and reported.
        """
        for _ in range(CHUNKS_PER_TURN):
            item = None if stopping() else self.inbox.take()
            if item is None:
                break
            if isinstance(item, Chunk) and self.inbox.skipped:
                self.note(kinds.SKIPPED, now, until=item.received)
            try:
                self.process(item, now)
            except Exception as error:  # noqa: BLE001 - one chunk must not end the others
                self._note_failure(error)
        try:
            # A recording runs on the time of its chunks; at high speed that is ahead of ours.
            self.tick(now if self._live else self._clock)
            if self._journal is not None:
                self._journal.progress(now)
        except Exception as error:  # noqa: BLE001 - one port must not end the others
            self._note_failure(error)

    def process(self, item: Item, now: Instant) -> None:
        """Process one item: a chunk, or that the port opened, was lost or ended."""
        if isinstance(item, Chunk):
            self._clock = item.received
            self._handle(self.line.receive(item))
            if self._journal is not None:
                self._journal.processed(item.received)
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
        """Let the links do what is due, and write what they send."""
        events, payloads = self.line.tick(now), self.line.outgoing()
        if events or payloads:  # a tick without effect need not be rerun
            self.note(kinds.TICK, now)
        self._handle(events)
        for payload in payloads:
            self.reader.transport.write(payload)

    def note(self, kind: str, now: Instant, **values: Any) -> None:
        """Note an event in the journal, if there is one; see `Journal.note`."""
        if self._journal is not None:
            try:
                self._journal.note(kind, now, **values)
            except (ValueError, TypeError) as error:  # the text cannot be encoded
                self.unnoted += 1
                log.debug("%s: %s cannot be noted: %s", self.name, kind, error)

    @property
    def behind(self) -> bool:
        """Whether chunks are still waiting after the last turn."""
        return self.inbox.waiting

    def retry(self, node: int, now: Instant) -> None:
        """Give a refused board another chance."""
        link = self.line.links.get(node)
        if isinstance(link, BoardLink):
            link.retry(now)
        elif link is not None:
            link.retry()

    def stop_streaming(self, now: Instant) -> None:
        """Tell the boards to stop, and publish the cycles under way."""
        self.note(kinds.ENDED, now)
        for node, link in self.line.links.items():
            if isinstance(link, BoardLink):
                link.stop_streaming()
            if node in self.boards:
                self.boards[node].flush()
        for payload in self.line.outgoing():
            self.reader.transport.write(payload)

    def add_board(self, node: int, name: str) -> None:
        """Open the session of a board under ``name``; sets `trouble` when that fails."""
        board = self._open_board(self, node, name)
        if isinstance(board, Trouble):
            self.trouble = board
            log.error("%s: %s", self.name, board)
        else:
            board.node = node
            self.boards[node] = board

    def drops(self) -> dict[str, int]:
        """Count by reason of what was lost or refused before it reached a pipeline."""
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
        """Whether any board of this port has ever identified itself."""
        return any(board.identity is not None for board in list(self.boards.values()))

    def _note_failure(self, error: Exception) -> None:
        self.spoilt += 1
        if self._complaints.allow(monotonic_now()):
            log.error("%s: data could not be processed", self.name, exc_info=error)

    def _dispatch(self, board: BoardSession, event: Event) -> None:
        if not self._live:
            board.handle(event)  # no error may be hidden: a rerun must reproduce the recording
            return
        try:
            board.handle(event)
        except Exception as error:  # noqa: BLE001 - one event must not end the others
            board.event_failed(error)

    def _handle(self, events: list[LineEvent]) -> None:
        for happened in events:
            event = happened.event
            if happened.node is not None:
                board = self.boards.get(happened.node)
                if board is not None:
                    self._dispatch(board, event)
            elif isinstance(event, Found):
                for node, name in self._names(event.nodes, event.late).items():
                    self.add_board(node, name)
            elif isinstance(event, Waiting):
                log.info("%s", event.text)
            elif isinstance(event, Diagnosed):
                self.trouble = Trouble(event.problem, event.remedy)
                log.error("%s; %s", event.problem, event.remedy)
