"""Who may open the page: pure decisions, and the kernel's answer on who owns a connection."""

from __future__ import annotations

import os
import socket

import pytest

from tactile_tools.view.guard import Guard, is_loopback, owner_of

TOKEN = "a" * 24


@pytest.mark.parametrize("host", ["127.0.0.1:8420", "localhost:8420", "[::1]:8420", "localhost:99"])
def test_names_of_this_machine_are_served(host: str) -> None:
    assert Guard(8420).refuse_host(host) is None


@pytest.mark.parametrize(
    "host", [None, "", "evil.example:8420", "127.0.0.1.evil.example", "10.0.0.2:8420", "a b", "\r"]
)
def test_foreign_host_names_are_refused(
    host: str | None,
) -> None:
    assert Guard(8420).refuse_host(host)


def test_with_a_token_addresses_and_given_names_are_served() -> None:
    guard = Guard(8420, TOKEN, frozenset({"robot"}))
    assert guard.refuse_host("10.0.0.2:8420") is None
    assert guard.refuse_host("robot:8420") is None
    assert guard.refuse_host("robot:80")
    assert guard.refuse_host("evil.example:8420")


def test_foreign_origins_may_not_use_the_stream() -> None:
    guard = Guard(8420)
    assert guard.refuse_origin("127.0.0.1:8420", "http://127.0.0.1:8420") is None
    assert guard.refuse_origin("127.0.0.1:8420", None) is None
    for origin in ("http://evil.example", "null", "http://127.0.0.1:9999", "file://"):
        assert guard.refuse_origin("127.0.0.1:8420", origin)


def test_token_is_accepted_from_address_or_cookie_only() -> None:
    guard = Guard(8420, TOKEN)
    assert guard.knows_token(f"/?token={TOKEN}", None)
    assert guard.knows_token("/live", f"other=1; {guard.cookie}={TOKEN}")
    for path, cookies in (
        ("/", None), ("/?token=b", None), ("/", f"{guard.cookie}=b"), ("/?token=%FF", "=;=\x01")
    ):  # fmt: skip
        assert not guard.knows_token(path, cookies)


def test_owner_of_a_connection_is_found() -> None:
    with (
        socket.create_server(("127.0.0.1", 0)) as server,
        socket.create_connection(server.getsockname()) as client,
    ):
        assert owner_of(client.getsockname()) in (os.getuid(), None)
    assert owner_of(("not an address", 1)) is None


def test_loopback_addresses_are_recognised() -> None:
    assert all(map(is_loopback, ("127.0.0.1", "127.9.9.9", "::1", "localhost")))
    assert not any(map(is_loopback, ("0.0.0.0", "::", "10.0.0.1", "robot")))
