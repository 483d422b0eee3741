"""A TCP connection that can be cut or delayed without notice to either end."""

from __future__ import annotations

import contextlib
import queue
import socket
import threading
import time

from tests.support.waiting import PATIENCE_S


class Wire:
    """A TCP connection to ``target`` that can be cut without notice to either end.

    ``delay``: delay in s towards ``target``; the other direction is not delayed.
    """

    def __init__(self, target: str) -> None:
        self.delay = 0.0
        self._target = int(target.rpartition(":")[2])
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.endpoint = f"tcp/127.0.0.1:{self._listener.getsockname()[1]}"
        self._whole = threading.Event()
        self._whole.set()
        self._ends: list[socket.socket] = [self._listener]
        threading.Thread(target=self._accept, daemon=True).start()

    def cut(self) -> None:
        """Stop forwarding; data sent meanwhile is held."""
        self._whole.clear()

    def mend(self) -> None:
        """Resume forwarding, first what was held."""
        self._whole.set()

    def close(self) -> None:
        self._whole.set()
        for end in self._ends:
            with contextlib.suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)
            end.close()

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                near, _ = self._listener.accept()
                far = self._far()
                if far is None:
                    near.close()
                    continue
                self._ends += [near, far]
                waiting: queue.SimpleQueue[tuple[float, bytes]] = queue.SimpleQueue()
                for work, args in (
                    (self._hold, (near, waiting)),
                    (self._send, (waiting, far)),
                    (self._pump, (far, near)),
                ):
                    threading.Thread(target=work, args=args, daemon=True).start()

    def _far(self) -> socket.socket | None:
        try:
            return socket.create_connection(("127.0.0.1", self._target), timeout=PATIENCE_S)
        except OSError:
            return None  # not yet listening; the client tries again

    def _hold(self, source: socket.socket, waiting: queue.SimpleQueue[tuple[float, bytes]]) -> None:
        with contextlib.suppress(OSError):
            while data := source.recv(65536):
                waiting.put((time.monotonic() + self.delay, data))
        waiting.put((0.0, b""))

    def _send(self, waiting: queue.SimpleQueue[tuple[float, bytes]], sink: socket.socket) -> None:
        with contextlib.suppress(OSError):
            while (item := waiting.get())[1]:
                time.sleep(max(0.0, item[0] - time.monotonic()))
                self._whole.wait()
                sink.sendall(item[1])
            sink.shutdown(socket.SHUT_RDWR)

    def _pump(self, source: socket.socket, sink: socket.socket) -> None:
        with contextlib.suppress(OSError):
            while data := source.recv(65536):
                self._whole.wait()
                sink.sendall(data)
        for end in (source, sink):
            with contextlib.suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)
