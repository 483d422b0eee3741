"""Commands to a board: one at a time, repeated until answered or given up. Pure."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from sensor_proto.packets import Ack, HostMessage
from tactile_bus.instant import Instant, after

COMMAND_RETRY = 0.2
"""s a command waits for its answer: longer than any answer over a 115 200 baud line."""

COMMAND_TRIES = 5
"""Times a command is sent before it is given up."""

COMMANDS = 8
"""Commands that may wait: what a person can ask of a board within a second."""

REQUESTS = 1 << 16
"""Request numbers wrap here: they are 16 bits on the wire."""


@dataclass(slots=True)
class Command:
    """One command under way. ``own``: of the link itself, not asked for from outside."""

    message: HostMessage
    request: int
    own: bool
    due: Instant
    tries: int = 0


class CommandQueue:
    """Order of commands, their repetitions and answers; ``send`` is called with each message."""

    def __init__(self, send: Callable[[HostMessage], None]) -> None:
        self._send = send
        self._waiting: deque[Command] = deque()
        self._request = 0

    @property
    def full(self) -> bool:
        """Whether no further command may be pushed."""
        return len(self._waiting) >= COMMANDS

    def next_request(self) -> int:
        """A fresh request number."""
        self._request = (self._request + 1) % REQUESTS
        return self._request

    def push(self, make: Callable[[int], HostMessage], now: Instant, own: bool) -> int:
        """Queue a command and return its number; ValueError when the queue is full."""
        if self.full:
            raise ValueError(f"{COMMANDS} commands are waiting for the board already")
        number = self.next_request()
        self._waiting.append(Command(make(number), number, own, now))
        self._start(now)
        return number

    def clear(self) -> list[Command]:
        """Forget all commands; returns them."""
        dropped = list(self._waiting)
        self._waiting.clear()
        return dropped

    def answered(self, ack: Ack, now: Instant) -> Command | None:
        """The command that ``ack`` answers; None for an answer that came twice or too late."""
        if not self._waiting or ack.request != self._waiting[0].request:
            return None
        head = self._waiting.popleft()
        self._start(now)
        return head

    def drive(self, now: Instant) -> Command | None:
        """Repeat the command under way if it is time; returns it when it is given up."""
        if not self._waiting or now < self._waiting[0].due:
            return None
        head = self._waiting[0]
        if head.tries < COMMAND_TRIES:
            head.tries, head.due = head.tries + 1, after(now, COMMAND_RETRY)
            self._send(head.message)
            return None
        self._waiting.popleft()
        self._start(now)
        return head

    def _start(self, now: Instant) -> None:
        if self._waiting and self._waiting[0].tries == 0:
            head = self._waiting[0]
            head.tries, head.due = 1, after(now, COMMAND_RETRY)
            self._send(head.message)
