"""Serve the page over HTTP and its stream over web sockets, with ``websockets`` alone.

While somebody watches, one loop polls the source at most 30 times a second and makes one frame, and
the newest frame is sent to every viewer. A viewer reports each frame it has drawn; one with two
frames still to draw is sent no more. So a slow browser loses frames, does not fall behind, and
holds nobody up.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import re
import time
from collections import deque
from dataclasses import replace
from http import HTTPStatus
from importlib import resources
from typing import Any, Literal
from urllib.parse import urlsplit

import msgspec
from websockets.asyncio.server import Server, ServerConnection, serve
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response

from tactile_core.bus.services import ServiceError
from tactile_core.bus.topics import NAME, service_key
from tactile_core.types import Instant, monotonic_now
from tactile_tools.view.guard import Guard, refuse_owner
from tactile_tools.view.live import LiveSource
from tactile_tools.view.player import LogPlayer, PlayError
from tactile_tools.view.state import PageModel

log = logging.getLogger(__name__)

FRAMES_PER_S = 30.0

SHARE = 0.035
"""Part of a core that making frames may cost; on a busy machine, or with many taxels, there are
fewer frames a second. Sending them to a viewer costs about as much again."""

IDLE_S = 0.5
"""Time between polls while nobody watches, and between frames when nothing is new, s."""

MAX_VIEWERS = 16

MAX_UNDRAWN = 2
"""Frames that a viewer may have been sent and not drawn yet."""

MAX_REQUEST = 4096
"""Largest message of a viewer, bytes."""

MAX_PENDING = 4
"""Requests of one viewer that may wait for a daemon."""

SEND_S = 20.0
"""Time for a viewer to take a frame, s; one that does not is disconnected."""

FILES = {
    "/": ("index.html", "text/html; charset=utf-8"),
    "/page.css": ("page.css", "text/css; charset=utf-8"),
    "/page.js": ("page.js", "text/javascript; charset=utf-8"),
    "/skin.js": ("skin.js", "text/javascript; charset=utf-8"),
    "/chart.js": ("chart.js", "text/javascript; charset=utf-8"),
    "/cupboard.js": ("cupboard.js", "text/javascript; charset=utf-8"),
    "/icon.svg": ("icon.svg", "image/svg+xml"),
}

STREAM = "/live"
"""Path of the web socket."""

POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; connect-src 'self'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)

MAX_RECORD_NAME = 80


class ViewerMessage(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """Message of a viewer: the frame it has drawn, or a request (``do``)."""

    ack: int | None = None
    do: Literal["tare", "record", "stop_record", "rate", "stop", "seek", "play", "pause"] | None = (
        None
    )
    id: int = 0
    board: str = ""
    name: str | None = None
    force: bool = False
    rate_hz: float = 0.0
    share: float = 0.0
    speed: float | None = None


class _Viewer:
    """One browser."""

    def __init__(self, connection: ServerConnection) -> None:
        self.connection = connection
        self.sent = 0  # number of the last frame sent
        self.undrawn: deque[int] = deque()  # numbers of frames sent and not drawn yet
        self.layout = -1
        self.skipped = 0
        self.acked = asyncio.Event()
        self.pending: set[asyncio.Task[None]] = set()
        self.replies: asyncio.Queue[bytes] = asyncio.Queue(MAX_PENDING * 2)


class PageServer:
    """Serves one source to many viewers, from one event loop."""

    def __init__(
        self,
        source: LiveSource | LogPlayer,
        guard: Guard,
        *,
        read_only: bool = False,
        loopback: bool = True,
    ) -> None:
        self.frames = 0
        self.model = PageModel()
        self._source = source
        self._guard = guard
        self._read_only = read_only
        self._loopback = loopback
        self._encode = msgspec.json.Encoder().encode
        self._decoder = msgspec.json.Decoder(ViewerMessage)
        self._viewers: set[_Viewer] = set()
        self._watched = asyncio.Event()
        self._fresh = asyncio.Condition()
        self._payload = b""
        self._server: Server | None = None
        self._helpers: set[asyncio.Task[Any]] = set()
        self._files = {
            path: (resources.files("tactile_tools.view").joinpath("page", name).read_bytes(), kind)
            for path, (name, kind) in FILES.items()
        }

    async def start(self, host: str, port: int) -> int:
        """Begin to serve; returns the port. OSError when the port cannot be opened."""
        self._server = await serve(
            self._serve_viewer,
            host,
            port,
            process_request=self._answer_http,
            compression=None,
            max_size=MAX_REQUEST,
            max_queue=8,
            server_header=None,
            write_limit=1 << 16,
        )
        port = int(next(iter(self._server.sockets)).getsockname()[1])
        self._guard = replace(self._guard, port=port)
        return port

    async def run(self) -> None:
        """Make frames until cancelled."""
        last = monotonic_now()
        period = 1.0 / FRAMES_PER_S
        shown = 0.0
        while True:
            began = time.thread_time()
            now = monotonic_now()
            new = await self._poll((now - last) * 1e-9)
            last = now
            if self._viewers and (new or time.monotonic() - shown >= IDLE_S):
                shown = time.monotonic()
                await self._publish(now)
            cost = time.thread_time() - began
            pause = max(period, cost / SHARE) if self._viewers else IDLE_S
            spent = (monotonic_now() - now) * 1e-9
            if self._viewers:
                await asyncio.sleep(max(pause - spent, 0.001))
            else:
                with contextlib.suppress(TimeoutError):
                    await asyncio.wait_for(self._watched.wait(), pause)

    async def close(self) -> None:
        """Close every connection."""
        if self._server is not None:
            self._server.close()
            await self._server.wait_closed()

    async def _poll(self, elapsed_s: float) -> bool:
        source, model = self._source, self.model
        if isinstance(source, LiveSource):
            new = source.poll(model)
            for name in source.missing_geometry(model):
                self._start(asyncio.to_thread(source.ask_geometry, name))
            return new
        if not self._viewers:
            return False  # a log waits for its viewers
        window = source.window
        if window is not None:
            source.take_window(window, await asyncio.to_thread(source.load, window))
        source.advance(min(elapsed_s, IDLE_S))
        return source.poll(model) or not source.paused

    async def _publish(self, now: Instant) -> None:
        source = self._source
        if isinstance(source, LogPlayer):
            frame = self.model.frame(Instant(source.position_ns), source.position_ns * 1e-9)
            frame["log"] = source.status()
        else:
            frame = self.model.frame(now)
        self.frames += 1
        frame["n"] = self.frames
        self._payload = self._encode({"frame": frame})
        async with self._fresh:
            self._fresh.notify_all()

    def _start(self, work: Any) -> None:
        task = asyncio.ensure_future(work)
        self._helpers.add(task)
        task.add_done_callback(self._helpers.discard)

    # HTTP

    def _answer_http(self, connection: ServerConnection, request: Request) -> Response | None:
        """Answer with a file or a refusal; None continues with the web socket."""
        headers = request.headers
        try:
            host = headers.get("Host")
            origin = headers.get("Origin")
            cookies = headers.get("Cookie")
        except LookupError:  # the header is there more than once
            return _refusal(HTTPStatus.BAD_REQUEST, "a header is there twice")
        refused = self._guard.refuse_host(host) or self._guard.refuse_origin(host, origin)
        if refused is None and self._loopback:
            refused = refuse_owner(connection.remote_address[:2])
        if refused is not None:
            return _refusal(HTTPStatus.FORBIDDEN, refused)
        if not self._guard.knows_token(request.path, cookies):
            return _refusal(
                HTTPStatus.FORBIDDEN,
                "this page needs its token: open the address that `tactile view` printed",
            )
        parts = urlsplit(request.path)
        if parts.path == STREAM:
            if len(self._viewers) >= MAX_VIEWERS:
                return _refusal(
                    HTTPStatus.SERVICE_UNAVAILABLE, f"{MAX_VIEWERS} pages are open; close one"
                )
            return None
        if parts.path == "/" and "token=" in parts.query:
            return self._without_token()
        found = self._files.get(parts.path)
        if found is None:
            return _refusal(HTTPStatus.NOT_FOUND, "there is nothing at this address")
        body, kind = found
        return _response(HTTPStatus.OK, body, kind)

    def _without_token(self) -> Response:
        """Move the token from the address to a cookie, because people pass addresses on."""
        token = self._guard.token or ""
        response = _response(HTTPStatus.SEE_OTHER, b"", "text/plain")
        response.headers["Location"] = "/"
        if token:
            response.headers["Set-Cookie"] = (
                f"{self._guard.cookie}={token}; Path=/; HttpOnly; SameSite=Strict"
            )
        return response

    # Web sockets

    async def _serve_viewer(self, connection: ServerConnection) -> None:
        if len(self._viewers) >= MAX_VIEWERS:
            await connection.close(1013, "too many pages are open")
            return
        viewer = _Viewer(connection)
        self._viewers.add(viewer)
        self._watched.set()
        tasks = [
            asyncio.create_task(work(viewer))
            for work in (self._send_frames, self._send_replies, self._hear)
        ]
        try:
            await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        finally:
            self._viewers.discard(viewer)
            if not self._viewers:
                self._watched.clear()
            for task in tasks:
                task.cancel()
            ended = await asyncio.gather(*tasks, return_exceptions=True)
            for error in ended:
                if isinstance(error, Exception) and not isinstance(
                    error, ConnectionClosed | TimeoutError
                ):
                    log.error("a viewer's connection failed", exc_info=error)

    async def _send_frames(self, viewer: _Viewer) -> None:
        await self._send(viewer, self._hello())
        while True:
            while len(viewer.undrawn) >= MAX_UNDRAWN:
                viewer.acked.clear()
                await viewer.acked.wait()
            async with self._fresh:
                await self._fresh.wait_for(lambda: self.frames > viewer.sent)
            if viewer.layout != self.model.version:
                viewer.layout = self.model.version
                await self._send(viewer, self._encode({"layout": self.model.layout()}))
            if viewer.sent:
                viewer.skipped += self.frames - viewer.sent - 1
            viewer.sent = self.frames
            viewer.undrawn.append(self.frames)
            await self._send(viewer, self._payload)

    def _hello(self) -> bytes:
        source = self._source
        player = isinstance(source, LogPlayer)
        return self._encode(
            {
                "hello": {
                    "read_only": self._read_only or player,
                    "log": source.name if isinstance(source, LogPlayer) else None,
                    "meets": "" if isinstance(source, LogPlayer) else source.meets,
                    "history": self.model.history(),
                }
            }
        )

    async def _send_replies(self, viewer: _Viewer) -> None:
        while True:
            await self._send(viewer, await viewer.replies.get())

    async def _send(self, viewer: _Viewer, data: bytes) -> None:
        await asyncio.wait_for(viewer.connection.send(data, text=True), SEND_S)

    async def _hear(self, viewer: _Viewer) -> None:
        async for data in viewer.connection:
            try:
                said = self._decoder.decode(data)
            except msgspec.DecodeError as error:
                self._reply(viewer, 0, False, f"bad request: {error}")
                continue
            if said.ack is not None:
                while viewer.undrawn and viewer.undrawn[0] <= said.ack:
                    viewer.undrawn.popleft()
                viewer.acked.set()
            if said.do is None:
                continue
            if len(viewer.pending) >= MAX_PENDING:
                self._reply(viewer, said.id, False, f"{MAX_PENDING} requests are waiting already")
                continue
            task = asyncio.create_task(self._handle_request(viewer, said))
            viewer.pending.add(task)
            task.add_done_callback(viewer.pending.discard)

    async def _handle_request(self, viewer: _Viewer, said: ViewerMessage) -> None:
        try:
            text = await self._carry_out(said)
        except (ServiceError, PlayError, ValueError) as error:
            self._reply(viewer, said.id, False, str(error))
        else:
            self._reply(viewer, said.id, True, text)

    def _reply(self, viewer: _Viewer, number: int, ok: bool, text: str) -> None:
        with contextlib.suppress(asyncio.QueueFull):  # the viewer does not read
            viewer.replies.put_nowait(self._encode({"reply": number, "ok": ok, "text": text}))

    async def _carry_out(self, said: ViewerMessage) -> str:
        """Carry a request out; returns what came of it."""
        source = self._source
        if isinstance(source, LogPlayer):
            return _play(source, said)
        if self._read_only:
            raise ServiceError("this page only looks on (--read-only)")
        if said.do == "stop":
            name = self.model.reach.name
            if not NAME.fullmatch(name):
                raise ServiceError("no reach is running")
            request = {"reason": "stopped at the live page"}
            await asyncio.to_thread(source.ask, service_key(name, "stop", "reach"), request)
            return "stopped"
        if not NAME.fullmatch(said.board) or said.board not in self.model.boards:
            known = ", ".join(sorted(self.model.boards)) or "none"
            raise ServiceError(f"no such board: {said.board[:80]!r} (available: {known})")
        return await self._ask_board(source, said)

    async def _ask_board(self, source: LiveSource, said: ViewerMessage) -> str:
        def key(service: str) -> str:
            return service_key(said.board, service)

        async def ask(key: str, request: object, *, slow: bool = False) -> Any:
            return await asyncio.to_thread(source.ask, key, request, slow=slow)

        if said.do == "tare":
            reply = await ask(key("tare"), {"force": said.force}, slow=True)
            return str(reply["message"])
        if said.do == "record":
            name = (said.name or "").strip()[:MAX_RECORD_NAME] or None
            reply = await ask(key("record"), {"action": "start", "name": name})
            return f"recording to {reply['path']}"
        if said.do == "stop_record":
            reply = await ask(key("record"), {"action": "stop"})
            lost = f", {reply['dropped']} dropped" if reply["dropped"] else ""
            return (
                f"{reply['path']}: {reply['messages']} messages in {reply['seconds']:.1f} s{lost}"
            )
        if said.do == "rate":
            reply = await ask(key("set_rate"), {"rate_hz": said.rate_hz})
            return f"{reply['rate_hz']:g} Hz"
        raise ServiceError(f"{said.do} is for logs")


def _play(player: LogPlayer, said: ViewerMessage) -> str:
    if said.do == "seek":
        player.seek(said.share)
    elif said.do == "play":
        player.play(said.speed)
    elif said.do == "pause":
        player.paused = True
    else:
        raise ServiceError("this is a log: nothing in it can be tared or recorded")
    return ""


def _response(status: HTTPStatus, body: bytes, kind: str) -> Response:
    headers = Headers(
        {
            "Content-Type": kind,
            "Content-Length": str(len(body)),
            "Cache-Control": "no-cache",
            "Connection": "close",
            "Content-Security-Policy": POLICY,
            "Cross-Origin-Resource-Policy": "same-origin",
            "Referrer-Policy": "no-referrer",
            "X-Content-Type-Options": "nosniff",
        }
    )
    return Response(status.value, status.phrase, headers, body)


UNPRINTABLE = re.compile(r"[^\x20-\x7e]")


def _refusal(status: HTTPStatus, text: str) -> Response:
    body = UNPRINTABLE.sub("?", text) + "\n"
    return _response(status, body.encode(), "text/plain; charset=utf-8")
