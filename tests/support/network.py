"""Free TCP ports and endpoints of this machine."""

from __future__ import annotations

import socket


def free_port() -> int:
    """Return a TCP port that is currently free."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


def free_endpoint() -> str:
    """Return an endpoint on a TCP port that is currently free."""
    return f"tcp/127.0.0.1:{free_port()}"
