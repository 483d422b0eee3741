"""Requests and replies over zenoh queryables. Both are JSON: few, small, and read by people.

A service always answers. A failing handler, an invalid request and an oversized reply all return an
error (``{"error": text}``) rather than silence.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any, TypeVar

import msgspec
import zenoh

from tactile_core.bus.messages import MAX_PAYLOAD
from tactile_core.bus.rights import may_ask
from tactile_core.bus.session import config_of

log = logging.getLogger(__name__)

T = TypeVar("T")

MAX_ERROR = 4096
"""Longest error in characters; some quote the request."""

RETRY_PERIOD = 0.05
"""Interval in s between attempts while no service is found: a new session takes a moment to find
its peers."""


class ServiceError(Exception):
    """The service answered with an error, whose text is the reason. Handlers raise it as well."""


class NoAnswerError(ServiceError):
    """No service answered."""


class Service:
    """A declared service. Handlers run one at a time, on the service's own thread."""

    def __init__(
        self, session: zenoh.Session, key: str, handler: Callable[[Any], object], request: Any
    ) -> None:
        self.key = key
        self.answered = 0
        self.failed = 0
        self._handler = handler
        self._decoder: msgspec.json.Decoder[Any] = msgspec.json.Decoder(request)
        self._queryable = session.declare_queryable(key, self._serve, complete=True)

    def close(self) -> None:
        """Withdraw the service."""
        with suppress(zenoh.ZError):  # the session is already closed
            self._queryable.undeclare()

    def _serve(self, query: zenoh.Query) -> None:
        # If the session closes meanwhile, there is nobody to answer.
        with suppress(zenoh.ZError), query:
            try:
                reply = self._answer(query)
            except ServiceError as error:
                self.failed += 1
                plain = str(error).encode("utf-8", "backslashreplace").decode()
                text = msgspec.json.encode({"error": plain[:MAX_ERROR]})
                query.reply_err(text, encoding=zenoh.Encoding.APPLICATION_JSON)
            else:
                self.answered += 1
                query.reply(self.key, reply, encoding=zenoh.Encoding.APPLICATION_JSON)

    def _answer(self, query: zenoh.Query) -> bytes:
        payload = query.payload.to_bytes() if query.payload is not None else b"{}"
        if len(payload) > MAX_PAYLOAD:
            raise ServiceError(f"request of {len(payload)} bytes: {MAX_PAYLOAD} allowed")
        try:
            request = self._decoder.decode(payload or b"{}")
        except msgspec.DecodeError as error:  # includes ValidationError
            raise ServiceError(f"bad request: {error}") from error
        try:
            reply = msgspec.json.encode(self._handler(request))
        except ServiceError:
            raise
        except Exception as error:  # thread boundary: the caller must get an answer
            log.exception("service %s failed", self.key)
            raise ServiceError(f"internal error: {type(error).__name__}: {error}") from error
        if len(reply) > MAX_PAYLOAD:
            raise ServiceError(f"reply of {len(reply)} bytes: {MAX_PAYLOAD} allowed")
        return reply


def declare_service(
    session: zenoh.Session,
    key: str,
    handler: Callable[[Any], object],
    request: Any = dict[str, Any],
) -> Service:
    """Serve requests at ``key`` with the result of ``handler`` (anything msgspec can encode).

    ``request``: type to which requests are decoded (a msgspec struct can forbid unknown fields). A
    `ServiceError` from the handler is sent to the caller.
    """
    return Service(session, key, handler, request)


def call(session: zenoh.Session, key: str, payload: object = None, timeout: float = 2.0) -> Any:
    """Call the service at ``key`` and return its reply; waits at most ``timeout`` s in all.

    Raises `ServiceError` with the service's reason, or `NoAnswerError` if there was no answer.
    """
    request = msgspec.json.encode({} if payload is None else payload)
    if len(request) > MAX_PAYLOAD:
        raise ValueError(f"request of {len(request)} bytes: {MAX_PAYLOAD} allowed")
    _refuse_without_right(session, key)
    deadline = time.monotonic() + timeout
    while (remaining := deadline - time.monotonic()) > 0:
        replies = session.get(
            key,
            payload=request,
            encoding=zenoh.Encoding.APPLICATION_JSON,
            timeout=remaining,
            target=zenoh.QueryTarget.BEST_MATCHING,
        )
        for reply in replies:
            if reply.ok is not None:
                return _decode(key, reply.ok.payload.to_bytes())
            if reply.err is not None and reply.err.encoding == zenoh.Encoding.APPLICATION_JSON:
                answer = _decode(key, reply.err.payload.to_bytes())
                reason = answer.get("error") if isinstance(answer, dict) else answer
                raise ServiceError(str(reason))
            if reply.err is not None:  # zenoh's own: the peer got the request, no answer
                raise NoAnswerError(f"no answer from {key} within {timeout:g} s")
        time.sleep(RETRY_PERIOD)
    config = config_of(session)
    who = "" if config is None else config.where()
    raise NoAnswerError(
        f"no service at {key}: is the daemon running, and this bus connected to it{who}?"
    )


def _refuse_without_right(session: zenoh.Session, key: str) -> None:
    """Raise `ServiceError` if our certificate does not allow the call: it would get no answer."""
    config = config_of(session)
    role = None if config is None or config.tls is None else config.tls.role()
    if role is not None and not may_ask(role, key):
        raise ServiceError(
            f"a certificate of the role {role} may not ask {key}: join with an operator's "
            "(--keys FOLDER)"
        )


def _decode(key: str, payload: bytes) -> Any:
    if len(payload) > MAX_PAYLOAD:
        raise ServiceError(f"reply of {key} has {len(payload)} bytes: {MAX_PAYLOAD} allowed")
    try:
        return msgspec.json.decode(payload)
    except msgspec.DecodeError as error:
        raise ServiceError(f"reply of {key} is not JSON: {error}") from error
