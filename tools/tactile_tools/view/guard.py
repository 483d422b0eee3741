"""Decide who may open the page, from Host, Origin, token and the owner of a connection. Pure.

The page can tare and record, so it must be closed to other users of this machine and to web sites
open in the same browser (a foreign ``Origin``, or a name that was made to point here).
"""

from __future__ import annotations

import hmac
import ipaddress
import os
import re
import secrets
import sys
from dataclasses import dataclass, field
from http.cookies import CookieError, SimpleCookie
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

COOKIE = "tactile_view"

LOCAL_NAMES = frozenset({"127.0.0.1", "localhost", "::1"})

HOST = re.compile(r"(\[[0-9a-fA-F:.]+\]|[A-Za-z0-9.-]{1,253})(?::(\d{1,5}))?")

MAX_TABLE_BYTES = 4 << 20
"""Bytes read of the kernel's list of connections: 25,000 connections."""


def make_token() -> str:
    """Make a secret for a page that other machines can reach."""
    return secrets.token_urlsafe(24)


def is_loopback(address: str) -> bool:
    """Whether an address to bind to cannot be reached from another machine."""
    if address == "localhost":
        return True
    try:
        return ipaddress.ip_address(address).is_loopback
    except ValueError:
        return False


@dataclass(frozen=True, slots=True)
class Guard:
    """Rules of one page. ``token``: secret of the browsers; None on loopback.

    ``names``: further names of this host. ``port``: of the page; a ``Host`` must name it.
    """

    port: int
    token: str | None = None
    names: frozenset[str] = field(default_factory=frozenset)

    def refuse_host(self, host: str | None) -> str | None:
        """Say why a request for ``host`` is refused; None when it is accepted."""
        match = HOST.fullmatch(host or "")
        name = "" if match is None else match[1].strip("[]").lower()
        port = 80 if match is None or match[2] is None else int(match[2])
        # A tunnel ends at another port; with a loopback name it is still this machine.
        if name in LOCAL_NAMES:
            return None
        known = name in self.names or (self.token is not None and _is_address(name))
        if known and port == self.port:
            return None
        return f"this page is not served for the host {(host or 'without a name')[:100]}"

    def refuse_origin(self, host: str | None, origin: str | None) -> str | None:
        """Say why a web socket of a page of ``origin`` is refused; only browsers send an origin."""
        if origin is None:
            return None
        parts = urlsplit(origin)
        if parts.scheme in ("http", "https") and parts.netloc == (host or ""):
            return None
        return f"pages of {origin[:100]} may not use this one"

    def knows_token(self, path: str, cookies: str | None) -> bool:
        """Whether the address or a cookie of a request holds the token, if one is needed."""
        if self.token is None:
            return True
        given = parse_qs(urlsplit(path).query).get("token", [])
        try:
            cookie = SimpleCookie(cookies or "").get(self.cookie)
        except CookieError:
            cookie = None
        if cookie is not None:
            given.append(cookie.value)
        return any(hmac.compare_digest(each.encode(), self.token.encode()) for each in given)

    @property
    def cookie(self) -> str:
        """Name of the cookie, with the port: pages on other ports share a host's cookies."""
        return f"{COOKIE}_{self.port}"


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


def owner_of(address: tuple[str, int], folder: Path = Path("/proc/net")) -> int | None:
    """Id of the user whose process holds the end ``address`` of a TCP connection of this machine.

    None where the system does not say: not Linux, or a process in another container.
    """
    host, port = address
    try:
        ip = ipaddress.ip_address(host.partition("%")[0])
    except ValueError:
        return None
    for table, wanted in _tables(ip, port):
        try:
            with (folder / table).open("rb") as file:
                lines = file.read(MAX_TABLE_BYTES).decode("ascii", "replace").splitlines()
        except OSError:
            continue
        for line in lines[1:]:
            fields = line.split()
            if len(fields) > 7 and fields[1] == wanted:
                return int(fields[7])
    return None


def _tables(ip: ipaddress.IPv4Address | ipaddress.IPv6Address, port: int) -> list[tuple[str, str]]:
    """Tables of the kernel, and the address as written there: words in the host's byte order."""
    if ip.version == 6 and ip.ipv4_mapped is not None:
        ip = ip.ipv4_mapped
    packed = ip.packed
    found = [("tcp" if ip.version == 4 else "tcp6", f"{_words(packed)}:{port:04X}")]
    if ip.version == 4:
        mapped = b"\0" * 10 + b"\xff\xff" + packed
        found.append(("tcp6", f"{_words(mapped)}:{port:04X}"))
    return found


def _words(packed: bytes) -> str:
    return "".join(
        f"{int.from_bytes(packed[at : at + 4], sys.byteorder):08X}"
        for at in range(0, len(packed), 4)
    )


def refuse_owner(address: tuple[str, int]) -> str | None:
    """Say why a connection from this machine is refused: it belongs to another user."""
    owner = owner_of(address)
    if owner is None or owner in (0, os.getuid()):
        return None
    return "this page belongs to another user of this machine; open one of your own: tactile view"
