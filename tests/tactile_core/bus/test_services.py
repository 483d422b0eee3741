"""Services: every request gets an answer, every failure a reason."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from typing import Any

import msgspec
import pytest
import zenoh

from tactile_core.bus.messages import MAX_PAYLOAD
from tactile_core.bus.services import NoAnswerError, ServiceError, call, declare_service
from tactile_core.bus.topics import service_key
from tests.support.network import free_port
from tests.support.waiting import PATIENCE_S

KEY = service_key("b0", "set_rate")


class SetRate(msgspec.Struct, forbid_unknown_fields=True):
    rate: float


def handle(request: SetRate) -> dict[str, Any]:
    if request.rate <= 0:
        raise ServiceError(f"rate = {request.rate:g}; allowed: above 0")
    if request.rate == 13:
        raise KeyError("a bug")
    if request.rate == 14:
        return {"blob": "x" * MAX_PAYLOAD}
    return {"rate": request.rate}


@pytest.fixture
def client(bus: Any) -> Iterator[Any]:
    port = free_port()
    service = declare_service(bus(listen=port), KEY, handle, SetRate)
    client = bus(connect=port)
    assert call(client, KEY, {"rate": 5}, timeout=PATIENCE_S) == {"rate": 5.0}
    yield client
    service.close()


@pytest.mark.parametrize(
    ("request_", "reason"),
    [
        ({"rate": -1}, "rate = -1; allowed: above 0"),
        ({"rate": 13}, "internal error: KeyError"),
        ({"rate": 14}, "65536 allowed"),
        ({"rate": "fast"}, r"bad request: Expected `float`, got `str` - at `\$.rate`"),
        ({}, "bad request: Object missing required field `rate`"),
        ({"rate": 1, "unit": "Hz"}, "bad request: Object contains unknown field `unit`"),
        ([1], "bad request: Expected `object`"),
    ],
)
def test_failures_come_back_as_errors(client: Any, request_: Any, reason: str) -> None:
    with pytest.raises(ServiceError, match=reason):
        call(client, KEY, request_, timeout=PATIENCE_S)
    assert call(client, KEY, {"rate": 7}, timeout=PATIENCE_S) == {
        "rate": 7.0
    }  # the service continues


def test_non_json_request_gets_an_error(client: Any) -> None:
    replies = list(client.get(KEY, payload=b"\xff{", timeout=PATIENCE_S))
    assert len(replies) == 1
    assert b"bad request" in replies[0].err.payload.to_bytes()


def test_oversized_request_is_refused(client: Any) -> None:
    with pytest.raises(ValueError, match="65536 allowed"):
        call(client, KEY, {"rate": 1, "x": "y" * MAX_PAYLOAD})
    raw = msgspec.json.encode({"rate": 1}) + b" " * MAX_PAYLOAD
    replies = list(client.get(KEY, payload=raw, timeout=PATIENCE_S))
    assert b"65536 allowed" in replies[0].err.payload.to_bytes()


def test_absent_service_is_reported_after_the_timeout(client: Any) -> None:
    with pytest.raises(NoAnswerError, match="no service at tactile/b1/srv/tare"):
        call(client, service_key("b1", "tare"), timeout=0.3)


def test_hanging_service_is_distinguished_from_absent_one(bus: Any) -> None:
    port = free_port()
    leave = threading.Event()
    server = bus(listen=port)
    service = declare_service(server, KEY, lambda request: leave.wait(2 * PATIENCE_S))
    quick = declare_service(server, service_key("b0", "status"), lambda request: "here")
    client = bus(connect=port)
    assert call(client, quick.key, timeout=PATIENCE_S) == "here"
    with pytest.raises(NoAnswerError, match="no answer from"):
        call(client, KEY, timeout=3.0)
    leave.set()
    service.close()


def test_late_service_is_waited_for(bus: Any) -> None:
    port = free_port()
    client = bus(connect=port)
    server = bus(listen=port)
    timer = threading.Timer(0.5, lambda: declare_service(server, KEY, lambda request: "hello"))
    timer.start()
    assert call(client, KEY, timeout=PATIENCE_S) == "hello"
    timer.join()


def test_non_json_reply_is_an_error(bus: Any) -> None:
    port = free_port()
    server = bus(listen=port)
    queryable = server.declare_queryable(KEY, lambda query: query.reply(KEY, b"\xff"))
    with pytest.raises(ServiceError, match="is not JSON"):
        call(bus(connect=port), KEY, timeout=PATIENCE_S)
    assert isinstance(queryable, zenoh.Queryable)
