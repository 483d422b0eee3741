"""Names and opening of CAN buses, shared by daemon and simulator."""

from __future__ import annotations

import errno
import logging
import os
import re
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sensor_proto.can_transfers import CanFrame

if TYPE_CHECKING:
    import can

log = logging.getLogger(__name__)

FORM = "INTERFACE:CHANNEL[@BITRATE[/DATA_BITRATE]][+fd], as in socketcan:can0, \
slcan:/dev/ttyACM1@1000000, virtual:0"

DEFAULT_BITRATE = 1_000_000
"""Default bit rate in bit/s, for adapters that need one."""

DEFAULT_DATA_BITRATE = 2_000_000
"""Default bit rate in bit/s of the CAN FD data phase."""

RX_QUEUE = 4096
"""Frames queued for a reader of a virtual bus: half a second of a full 1 Mbit/s bus. By default the
queue is unbounded."""

CAN_LINK_TYPE = "280"  # ARPHRD_CAN

_SPEC = re.compile(
    r"(?P<interface>[A-Za-z0-9_]+):(?P<channel>[^@+]+)"
    r"(?:@(?P<bitrate>[0-9]+)(?:/(?P<data>[0-9]+))?)?(?P<fd>\+fd)?"
)


class Trouble(Enum):
    """Why a bus cannot be opened."""

    MISSING = "missing"
    BUSY = "busy"
    DENIED = "denied"
    UNSUITABLE = "unsuitable"


class CanUnavailable(Exception):  # noqa: N818 - names a state of the bus
    """The bus cannot be opened; the text names the remedy."""

    def __init__(self, trouble: Trouble, problem: str, remedy: str) -> None:
        super().__init__(f"{problem}; {remedy}")
        self.trouble = trouble
        self.problem = problem
        self.remedy = remedy


@dataclass(frozen=True, slots=True)
class CanSpec:
    """One CAN bus. Rates in bit/s; None: as the interface is already configured."""

    interface: str
    channel: str
    bitrate: int | None = None
    data_bitrate: int | None = None
    fd: bool = False

    @classmethod
    def parse(cls, text: str) -> CanSpec:
        """Parse a bus as written by users. The ValueError it raises names what is allowed."""
        match = _SPEC.fullmatch(text)
        if match is None:
            raise ValueError(f"invalid CAN bus {text!r}; expected {FORM}")
        bitrate = int(match["bitrate"]) if match["bitrate"] else None
        data = int(match["data"]) if match["data"] else None
        if bitrate == 0 or data == 0:
            raise ValueError(f"{text!r} has a bit rate of 0; allowed: a positive number of bit/s")
        return cls(match["interface"], match["channel"], bitrate, data, match["fd"] is not None)

    def __str__(self) -> str:
        """The syntax that users write."""
        rate = "" if self.bitrate is None else f"@{self.bitrate}"
        if self.data_bitrate is not None:
            rate += f"/{self.data_bitrate}"
        return f"{self.interface}:{self.channel}{rate}{'+fd' if self.fd else ''}"


def open_bus(spec: CanSpec) -> can.BusABC:
    """Open any python-can interface. Raises `CanUnavailable` with the remedy."""
    import can
    from can.interfaces import VALID_INTERFACES

    # python-can logs the errors that it also raises; the raised one carries the remedy.
    logging.getLogger("can.interfaces").setLevel(logging.CRITICAL)
    if spec.interface not in VALID_INTERFACES:
        raise CanUnavailable(
            Trouble.UNSUITABLE,
            f"no such CAN interface: {spec.interface!r}",
            f"available: {', '.join(sorted(VALID_INTERFACES))}",
        )
    options: dict[str, Any] = {}
    if spec.interface == "socketcan":
        _check_link(spec.channel)
        if spec.bitrate is not None:
            log.warning("%s: the bit rate is not used; `ip link` sets that of a CAN link", spec)
        options["fd"] = spec.fd
    elif spec.interface == "virtual":
        options["rx_queue_size"] = RX_QUEUE
        options["protocol"] = can.CanProtocol.CAN_FD if spec.fd else can.CanProtocol.CAN_20
    else:
        options["bitrate"] = spec.bitrate or DEFAULT_BITRATE
        if spec.fd:
            options |= {"fd": True, "data_bitrate": spec.data_bitrate or DEFAULT_DATA_BITRATE}
    try:
        return can.Bus(channel=spec.channel, interface=spec.interface, **options)
    except OSError as error:
        raise _explain(spec, error) from error
    except (can.CanError, ImportError, NameError, AttributeError, TypeError, ValueError) as error:
        # Drivers without their vendor library fail in all these ways; each means the same to a
        # user.
        raise CanUnavailable(
            Trouble.MISSING,
            f"cannot open {spec}: {error}",
            f"install the driver of the {spec.interface} adapter and plug it in "
            "(python-can's page of that interface names it)",
        ) from error


def can_links() -> list[str]:
    """Names of the kernel's CAN interfaces."""
    found = []
    for link in sorted(Path("/sys/class/net").glob("*/type")):
        try:
            if link.read_text(encoding="ascii").strip() == CAN_LINK_TYPE:
                found.append(link.parent.name)
        except OSError:
            continue  # removed meanwhile
    return found


def _check_link(channel: str) -> None:
    links = can_links()
    if channel not in links:
        there = f"available: {', '.join(links)}" if links else "this kernel has none"
        raise CanUnavailable(
            Trouble.MISSING,
            f"no such CAN link: {channel!r} ({there})",
            "plug the adapter in; for a test `sudo modprobe vcan && sudo ip link add dev vcan0 "
            "type vcan && sudo ip link set vcan0 up`",
        )
    try:
        flags = int(Path(f"/sys/class/net/{channel}/flags").read_text(encoding="ascii"), 16)
    except OSError:
        return  # removed meanwhile: opening it reports that
    if not flags & 1:  # IFF_UP
        kind = "" if channel.startswith("vcan") else f" type can bitrate {DEFAULT_BITRATE}"
        raise CanUnavailable(
            Trouble.UNSUITABLE,
            f"the CAN link {channel} is down",
            f"run `sudo ip link set {channel} up{kind}`",
        )


def _explain(spec: CanSpec, error: OSError) -> CanUnavailable:
    if error.errno in (errno.EAFNOSUPPORT, errno.EPROTONOSUPPORT):
        return CanUnavailable(
            Trouble.MISSING,
            f"this kernel has no CAN sockets ({os.strerror(error.errno)})",
            "run `sudo modprobe can can_raw`, or use an slcan adapter",
        )
    if error.errno in (errno.EACCES, errno.EPERM):
        return CanUnavailable(
            Trouble.DENIED, f"no permission to open {spec}", "join the group that owns the device"
        )
    if error.errno in (errno.EBUSY, errno.EADDRINUSE):
        return CanUnavailable(
            Trouble.BUSY, f"{spec} is in use", "end the process that holds it, or give another bus"
        )
    return CanUnavailable(
        Trouble.MISSING, f"cannot open {spec}: {error}", "plug the adapter in, or give another bus"
    )


def to_message(frame: CanFrame) -> can.Message:
    """Convert a frame for python-can; FD frames switch bit rate."""
    import can

    return can.Message(
        arbitration_id=frame.identifier,
        data=frame.data,
        is_extended_id=True,
        is_fd=frame.fd,
        bitrate_switch=frame.fd,
        is_error_frame=frame.error,
    )


def from_message(message: can.Message) -> CanFrame | str:
    """Convert a python-can message, or return why it is not of this protocol: ``standard_id`` or
    ``remote_frame``.

    The channel name added by a virtual bus, time stamps and flags are dropped.
    """
    if message.is_error_frame:
        return CanFrame(message.arbitration_id, bytes(message.data), error=True)
    if message.is_remote_frame:
        return "remote_frame"
    if not message.is_extended_id:
        return "standard_id"
    return CanFrame(message.arbitration_id, bytes(message.data), message.is_fd)
