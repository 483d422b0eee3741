"""Who may open the page: pure decisions on Host, Origin, token and the owner of a connection.

The page can tare and record, so a web site that the browser also shows must not reach it (a
foreign ``Origin``, or a name that was made to point here), nor another user of this machine.
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
"""Of the kernel's list of connections that are looked through: 25,000 of them."""


def make_token() -> str:
    """A secret for a page that others than this machine can reach."""
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
    """``token``: what a browser must know, None on loopback. ``names``: further names of this host.

    ``port``: of the page, which a ``Host`` must name.
    """

    port: int
    token: str | None = None
    names: frozenset[str] = field(default_factory=frozenset)

    def refuse_host(self, host: str | None) -> str | None:
        """Why a request for ``host`` is refused, None when it is not."""
        match = HOST.fullmatch(host or "")
        name = "" if match is None else match[1].strip("[]").lower()
        port = 80 if match is None or match[2] is None else int(match[2])
        # A tunnel ends at a port of its own; with a loopback name that is still this machine.
        if name in LOCAL_NAMES:
            return None
        known = name in self.names or (self.token is not None and _is_address(name))
        if known and port == self.port:
            return None
        return f"this page is not served for the host {(host or 'without a name')[:100]}"

    def refuse_origin(self, host: str | None, origin: str | None) -> str | None:
        """Why a web socket asked for by a page of ``origin`` is refused. No browser: no origin."""
        if origin is None:
            return None
        parts = urlsplit(origin)
        if parts.scheme in ("http", "https") and parts.netloc == (host or ""):
            return None
        return f"pages of {origin[:100]} may not use this one"

    def knows_token(self, path: str, cookies: str | None) -> bool:
        """Whether the address or a cookie of a request holds the token, where one is needed."""
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
        """Name of the cookie: pages on other ports of a host share its cookies."""
        return f"{COOKIE}_{self.port}"


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


def owner_of(address: tuple[str, int], folder: Path = Path("/proc/net")) -> int | None:
    """User whose process holds the end ``address`` of a TCP connection of this machine.

    None where the system does not say: it is not Linux, or the process is in another container.
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
    """Tables of the kernel and how the address is written in them: words of the host's order."""
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
    """Why a connection of this machine is refused: it belongs to another of its users."""
    owner = owner_of(address)
    if owner is None or owner in (0, os.getuid()):
        return None
    return "this page belongs to another user of this machine; open one of your own: tactile view"
