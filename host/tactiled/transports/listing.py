"""List serial ports, find who holds one, and find a replugged one again."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from serial.tools import list_ports as pyserial_ports

MAX_PROCESSES = 4096
"""Most processes searched for a port's holder, which bounds the search on a busy machine."""


@dataclass(frozen=True, slots=True)
class PortInfo:
    """A serial port. ``vid``, ``pid`` and ``serial_number`` are None if it is not on USB."""

    device: str
    description: str
    vid: int | None
    pid: int | None
    serial_number: str | None

    def __str__(self) -> str:
        """One line for people."""
        usb = "" if self.vid is None or self.pid is None else f"  {self.vid:04x}:{self.pid:04x}"
        serial = f"  serial {self.serial_number}" if self.serial_number else ""
        text = "" if self.description in ("", "n/a") else f"  {self.description}"
        return f"{self.device}{usb}{serial}{text}"


def list_ports() -> list[PortInfo]:
    """List the serial ports of this machine, USB first, then by name."""
    ports = [
        PortInfo(p.device, p.description or "", p.vid, p.pid, p.serial_number or None)
        for p in pyserial_ports.comports()
    ]
    return sorted(ports, key=lambda p: (p.vid is None, p.device))


def find_by_serial(usb_serial: str) -> PortInfo | None:
    """Find the port whose USB device has this serial number; None if there is none."""
    return next((p for p in list_ports() if p.serial_number == usb_serial), None)


def usb_serial_of(device: str) -> str | None:
    """USB serial number of a device, following symbolic links; None if it has none."""
    real = os.path.realpath(device)
    return next((p.serial_number for p in list_ports() if os.path.realpath(p.device) == real), None)


def known_ports(limit: int = 8) -> str:
    """The available ports, for a message."""
    devices = [p.device for p in list_ports()]
    if not devices:
        return "no serial port is plugged in"
    more = f" and {len(devices) - limit} more" if len(devices) > limit else ""
    return f"available ports: {', '.join(devices[:limit])}{more}"


def holders(device: str) -> list[str]:
    """Processes that have ``device`` open, as "name (pid)"; other users' processes are hidden."""
    real = os.path.realpath(device)
    return [
        f"{_process_name(pid)} (pid {pid}{', this process' if pid == os.getpid() else ''})"
        for pid in _processes()
        if _has_open(pid, real)
    ]


def _processes() -> Iterator[int]:
    try:
        names = os.listdir("/proc")
    except OSError:
        return  # not Linux
    pids = sorted((int(name) for name in names if name.isdigit()), reverse=True)
    yield from pids[:MAX_PROCESSES]


def _has_open(pid: int, real: str) -> bool:
    folder = f"/proc/{pid}/fd"
    try:
        return any(os.readlink(f"{folder}/{fd}") == real for fd in os.listdir(folder))
    except OSError:
        return False  # it has ended meanwhile, or belongs to another user


def _process_name(pid: int) -> str:
    try:
        return Path(f"/proc/{pid}/comm").read_text(encoding="utf-8").strip()
    except OSError:
        return "a process"
