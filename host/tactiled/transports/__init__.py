"""Transports: serial ports, CAN buses and recorded logs behind one interface."""

from __future__ import annotations

from sensor_proto.can_transfers import BusState
from tactiled.transports.base import (
    EndOfLog,
    Medium,
    PortBusy,
    PortClosed,
    PortDenied,
    PortGone,
    PortMissing,
    PortUnsuitable,
    Transport,
    TransportError,
)
from tactiled.transports.listing import PortInfo, find_by_serial, list_ports

__all__ = [
    "BusState",
    "EndOfLog",
    "Medium",
    "PortBusy",
    "PortClosed",
    "PortDenied",
    "PortGone",
    "PortInfo",
    "PortMissing",
    "PortUnsuitable",
    "Transport",
    "TransportError",
    "find_by_serial",
    "list_ports",
    "make_transport",
    "open_spec",
]


def make_transport(spec: str, baud: int = 115_200, speed: float = 1.0) -> Transport:
    """Make the transport, not yet open, for a port, a CAN bus or a log.

    ``/dev/ttyACM0``, ``./board0`` or ``usb:SERIAL``: serial; ``INTERFACE:CHANNEL[@BITRATE][+fd]``:
    CAN; a name that ends in ``.mcap``: replay at ``speed`` times real time. ValueError otherwise.
    """
    if spec.endswith(".mcap"):
        from tactiled.transports.recorded_log import McapTransport

        return McapTransport(spec, speed=speed)
    head, colon, _ = spec.partition(":")
    if colon and "/" not in head and head != "usb":
        from tactiled.transports.can_bus import CanTransport

        return CanTransport(spec)
    from tactiled.transports.serial_port import SerialTransport

    return SerialTransport(spec, baud)


def open_spec(spec: str, baud: int = 115_200, speed: float = 1.0) -> Transport:
    """Make a transport and open it; `TransportError` names the remedy."""
    transport = make_transport(spec, baud, speed)
    transport.open()
    return transport
