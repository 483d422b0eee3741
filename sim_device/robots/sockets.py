"""Servers of an emulated robot: non-blocking sockets, delays, a frozen network. Thin shell.

One thread serves all of them every millisecond, like everything else in the simulator.
"""

from __future__ import annotations

import contextlib
import errno
import socket
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final, Protocol

import numpy as np

from tactile_core.types import Instant, after, seconds_between

READ: Final = 65536
MAX_WAITING: Final = 1 << 20
"""Bytes kept for a client that does not read; beyond that it is disconnected."""

RESENT: Final = 0.2
"""Time that TCP takes to resend what was lost, s; everything after it waits."""


class Peer(Protocol):
    """What talks to one client."""

    def greet(self) -> bytes:
        """Said at once to a client that has connected."""
        ...

    def hear(self, data: bytes) -> bytes:
        """Take what came, return what is to be said."""
        ...


@dataclass(frozen=True, slots=True)
class Network:
    """``latency``: s that a message takes. ``loss``: part of the messages that are sent again."""

    latency: float = 0.0
    loss: float = 0.0


@dataclass(slots=True, eq=False)
class Client:
    """One connection with what is on its way, each with the instant of its arrival."""

    link: socket.socket
    peer: Peer
    incoming: deque[tuple[Instant, bytes]] = field(default_factory=deque)
    outgoing: deque[tuple[Instant, bytes]] = field(default_factory=deque)
    waiting: bytes = b""
    open: bool = True


class SocketError(Exception):
    """A port is not available; the message names the remedy."""


class Servers:
    """Listeners of one robot at ``address``. ``frozen``: nothing comes or goes, links stay up."""

    def __init__(
        self,
        address: str,
        ports: dict[int, Callable[[], Peer]],
        network: Network,
        rng: np.random.Generator,
    ) -> None:
        self.address = address
        self.frozen = False
        self.clients: list[Client] = []
        self.counters = {"clients": 0, "hung_up": 0, "resent": 0}
        self._ports = ports
        self._network = network
        self._rng = rng
        self._listeners: list[tuple[socket.socket, Callable[[], Peer]]] = []
        self._slowed: tuple[float, float, Instant] | None = None

    def open(self) -> None:
        """Listen; `SocketError`."""
        for port, make in self._ports.items():
            listener = socket.socket()
            try:
                listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                listener.bind((self.address, port))
                listener.listen(8)
                listener.setblocking(False)
            except OSError as error:
                listener.close()
                self.close()
                raise SocketError(
                    f"{self.address}:{port}: {error.strerror}; give another loopback address, such "
                    "as --address 127.0.0.3"
                ) from error
            self._listeners.append((listener, make))

    def close(self) -> None:
        """Hang up on all."""
        for listener, _ in self._listeners:
            listener.close()
        self._listeners.clear()
        for client in self.clients:
            client.link.close()
        self.clients.clear()

    def slow(self, growth: float, most_s: float, now: Instant) -> None:
        """Let every message take longer from ``now`` on, by ``growth`` s a second up to ``most_s``;
        0 s takes it away."""
        self._slowed = (growth, most_s, now) if most_s > 0 else None

    def serve(self, now: Instant) -> None:
        """Take in what came and send what is due."""
        for listener, make in self._listeners:
            self._accept(listener, make, now)
        if self.frozen:
            return
        for client in self.clients:
            self._receive(client, now)
            while client.incoming and client.incoming[0][0] <= now and client.open:
                self.say(client, client.peer.hear(client.incoming.popleft()[1]), now)
            self._send(client, now)
        if any(not client.open for client in self.clients):
            for client in self.clients:
                if not client.open:
                    client.link.close()
            self.clients = [client for client in self.clients if client.open]

    def say(self, client: Client, data: bytes, now: Instant) -> None:
        """Put ``data`` on its way."""
        if data and client.open:
            client.outgoing.append((self._arrival(client.outgoing, now), data))

    def of(self, kind: type[object]) -> list[Client]:
        """Clients whose peer is a ``kind``."""
        return [client for client in self.clients if isinstance(client.peer, kind)]

    def _accept(self, listener: socket.socket, make: Callable[[], Peer], now: Instant) -> None:
        with contextlib.suppress(BlockingIOError):
            link, _ = listener.accept()
            link.setblocking(False)
            link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            client = Client(link, make())
            self.clients.append(client)
            self.counters["clients"] += 1
            self.say(client, client.peer.greet(), now)

    def _arrival(self, queued: deque[tuple[Instant, bytes]], now: Instant) -> Instant:
        delay = self._network.latency
        if self._slowed is not None:
            growth, most_s, since = self._slowed
            delay += min(most_s, growth * seconds_between(since, now))
        if self._network.loss and self._rng.random() < self._network.loss:
            delay += RESENT
            self.counters["resent"] += 1
        at = after(now, delay)
        return max(at, queued[-1][0]) if queued else at

    def _receive(self, client: Client, now: Instant) -> None:
        try:
            data = client.link.recv(READ)
        except BlockingIOError:
            return
        except OSError:
            client.open = False
            return
        if not data:
            client.open = False
            return
        client.incoming.append((self._arrival(client.incoming, now), data))

    def _send(self, client: Client, now: Instant) -> None:
        while client.outgoing and client.outgoing[0][0] <= now:
            client.waiting += client.outgoing.popleft()[1]
        if not client.waiting or not client.open:
            return
        try:
            sent = client.link.send(client.waiting)
            client.waiting = client.waiting[sent:]
        except BlockingIOError:
            pass
        except OSError as error:
            client.open = False
            if error.errno not in (errno.EPIPE, errno.ECONNRESET):
                self.counters["hung_up"] += 1
        if len(client.waiting) > MAX_WAITING:
            client.open = False
            self.counters["hung_up"] += 1
