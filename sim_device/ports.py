"""Ports at which hosts reach simulated boards: pseudo-terminals and CAN buses.

No port ever waits: what a reader does not take in time is dropped, oldest first, and counted.
"""

from __future__ import annotations

import fcntl
import hashlib
import os
import socket
import stat
import struct
import sys
import termios
import tty
from collections import Counter, deque
from pathlib import Path
from typing import TYPE_CHECKING

from sensor_proto import can_transfers
from sensor_proto.can_transfers import BusState, CanFrame
from sim_device.board.slcan_adapter import SlcanAdapter
from sim_device.board.wire import TimedBus
from tactile_core.can_bus import DEFAULT_BITRATE, CanSpec, from_message, open_bus, to_message
from tactile_core.types import Instant

if TYPE_CHECKING:
    import can

BACKLOG = 4_096
"""Bytes kept here for a late reader, besides those in the terminal: what a board's USB buffers
hold. More would only give stale samples to a host that comes back."""

PTY_ROOM = 4_095
"""Bytes that Linux' line discipline holds for a reader. More would pile up in the kernel, where
the oldest cannot be dropped, and a late reader would get stale samples."""

READ_LIMIT = 4_096
"""Bytes taken from a host at once; the rest is taken at the next call."""

BUS_QUEUE = 64
"""Frames that wait for the bus before boards hold back: 10 ms at 1 Mbit/s, so that a clock reply
never waits long and the bus is never idle between two ticks."""

MAX_FRAMES = 256
"""Frames taken from a bus at once."""


class LinkRefused(Exception):  # noqa: N818 - names a state of the path
    """The path for a port is taken. ``foreign``: by a file that is not ours to replace."""

    def __init__(self, problem: str, foreign: bool) -> None:
        super().__init__(problem)
        self.foreign = foreign


class PtyPort:
    """Pseudo-terminal in raw mode, reached by a symbolic link at ``link``.

    A link left by a killed run is replaced. Any other file there, and a link that a live simulator
    serves, raises `LinkRefused`. The slave end stays open here, so that hosts may come and go.
    """

    def __init__(self, link: str | Path) -> None:
        self.link = Path(link)
        self._reservation: socket.socket | None = None
        self._master = self._slave = -1
        self._backlog: deque[bytes] = deque()
        self._backlog_bytes = 0
        self._begun = False  # whether part of the oldest message has been sent
        self._counts: Counter[str] = Counter()

    @property
    def losses(self) -> dict[str, int]:
        """Messages and bytes dropped because nobody read them."""
        return dict(self._counts)

    @property
    def is_open(self) -> bool:
        """Whether the terminal exists."""
        return self._master >= 0

    @property
    def ready(self) -> bool:
        """Whether the terminal has taken all that was sent; a board waits until then."""
        return not self._backlog

    @property
    def unread(self) -> int:
        """Bytes that no host has read yet."""
        return self._backlog_bytes + (_unread_bytes(self._slave) if self.is_open else 0)

    def fileno(self) -> int:
        """Descriptor that is readable when a host has written; −1 while closed."""
        return self._master

    def open(self) -> None:
        """Make the terminal and the link. Raises `LinkRefused`, or OSError (no such folder)."""
        self._reservation = _reserve(self.link)
        try:
            _check_replaceable(self.link)
            self._master, self._slave = os.openpty()
            tty.setraw(self._slave)
            os.set_blocking(self._master, False)
            _replace_link(self.link, os.ttyname(self._slave))
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Hang up and remove the link; may be called more than once."""
        if self._slave >= 0:
            if self.link.is_symlink() and os.readlink(self.link) == os.ttyname(self._slave):
                self.link.unlink()
            # Slave first: then a host's last read sees the hang-up, not an empty line.
            os.close(self._slave)
            os.close(self._master)
        self._master = self._slave = -1
        if self._reservation is not None:
            self._reservation.close()
            self._reservation = None
        self._backlog.clear()
        self._backlog_bytes = 0
        self._begun = False

    def receive(self) -> bytes:
        """Bytes from the host, at most `READ_LIMIT`; empty if there are none."""
        try:
            return os.read(self._master, READ_LIMIT) if self.is_open else b""
        except BlockingIOError:
            return b""

    def send(self, data: bytes) -> None:
        """Queue one message for the host and pass on what the terminal takes. Never waits."""
        if not self.is_open:
            self._counts["unplugged_bytes"] += len(data)
            return
        if data:
            self._backlog.append(data)
            self._backlog_bytes += len(data)
        self.flush()
        # A message that has begun is finished: else the reader would join its head to the next.
        while self._backlog_bytes > BACKLOG and len(self._backlog) > 1 + self._begun:
            oldest = self._backlog[self._begun]
            del self._backlog[self._begun]
            self._backlog_bytes -= len(oldest)
            self._counts["unread_messages"] += 1
            self._counts["unread_bytes"] += len(oldest)

    def flush(self) -> None:
        """Pass on what the terminal takes now."""
        while self._backlog:
            room = PTY_ROOM - _unread_bytes(self._slave)
            if room <= 0:
                return
            oldest = self._backlog.popleft()
            try:
                written = os.write(self._master, oldest[:room])
            except BlockingIOError:
                written = 0
            self._backlog_bytes -= written
            if written < len(oldest):
                self._begun = self._begun or written > 0
                self._backlog.appendleft(oldest[written:])
                return
            self._begun = False


class SlcanPort:
    """Simulated USB-CAN adapter on a pseudo-terminal, with a bus behind it.

    Frames take their time on the bus, and the lowest identifier goes first. ``fd``: the adapter
    takes CAN FD. ``dialect``: its firmware, see `sim_device.board.slcan_adapter.DIALECTS`.
    """

    def __init__(self, link: str | Path, fd: bool = True, dialect: str = "lawicel") -> None:
        self.pty = PtyPort(link)
        self.adapter = SlcanAdapter(fd=fd, dialect=dialect)
        self.bus = TimedBus()

    @property
    def losses(self) -> dict[str, int]:
        """What the terminal, the adapter and the bus dropped."""
        return self.pty.losses | self.adapter.losses | {"bus_overrun": self.bus.dropped_frames}

    @property
    def ready(self) -> bool:
        """Whether the bus is free enough for boards to send more. A host that does not read never
        blocks the bus: the adapter takes the frames off it and drops them."""
        return self.bus.waiting < BUS_QUEUE

    def fileno(self) -> int:
        """Descriptor that is readable when the host has written."""
        return self.pty.fileno()

    def open(self) -> None:
        """See `PtyPort.open`."""
        self.pty.open()

    def close(self) -> None:
        """See `PtyPort.close`."""
        self.pty.close()

    def receive(self) -> tuple[CanFrame, ...]:
        """Frames that the host put on the bus."""
        frames = self.adapter.feed(self.pty.receive())
        self._answer()
        return tuple(frames)

    def send(self, frames: tuple[CanFrame, ...], now: Instant) -> None:
        """Put a board's frames on the bus. Its error frames (bus-off) put the adapter there too."""
        data = []
        for frame in frames:
            if frame.error:
                self._apply_error_frame(frame)
            else:
                data.append(frame)
        if self.adapter.is_open:
            self.bus.push(data, now)
        self.flush(now)

    def flush(self, now: Instant) -> None:
        """Pass on the frames that have gone over the bus by ``now``."""
        bitrate = self.adapter.bitrate or DEFAULT_BITRATE
        frames = self.bus.pop(now, bitrate, self.adapter.data_bitrate)
        if frames:
            self.adapter.deliver(frames, now)
        self.adapter.pass_time(now)
        self._answer()

    def set_bus_off(self, fault: bool) -> None:
        """Begin or end a bus-off; see `SlcanAdapter.set_bus_off`."""
        self.adapter.set_bus_off(fault)
        self._answer()

    def _apply_error_frame(self, frame: CanFrame) -> None:
        state = can_transfers.reported_state(frame)
        if state is not None:
            self.adapter.set_bus_off(state is BusState.BUS_OFF)

    def _answer(self) -> None:
        self.pty.send(self.adapter.take_output())


class PythonCanPort:
    """Boards on a bus that python-can opens: ``virtual:0`` in one process, ``socketcan:vcan0``.

    Timing and bus-off are then up to that bus.
    """

    def __init__(self, spec: CanSpec) -> None:
        self.spec = spec
        self._bus: can.BusABC | None = None
        self._counts: Counter[str] = Counter()

    @property
    def losses(self) -> dict[str, int]:
        """Frames the bus did not take, and frames that are not the boards'."""
        return dict(self._counts)

    @property
    def ready(self) -> bool:
        """True: nothing waits here."""
        return True

    def fileno(self) -> int:
        """Descriptor to poll; −1 where the driver has none."""
        if self._bus is None or self.spec.interface != "socketcan":
            return -1
        return self._bus.fileno()

    def open(self) -> None:
        """Open; raises `tactile_core.can_bus.CanUnavailable`."""
        self._bus = open_bus(self.spec)

    def close(self) -> None:
        """Leave the bus; may be called more than once."""
        bus, self._bus = self._bus, None
        if bus is not None:
            bus.shutdown()

    def receive(self) -> tuple[CanFrame, ...]:
        """Frames from the bus, at most `MAX_FRAMES`."""
        frames: list[CanFrame] = []
        bus = self._bus
        while bus is not None and len(frames) < MAX_FRAMES:
            message = bus.recv(0)
            if message is None:
                break
            frame = from_message(message)
            if isinstance(frame, CanFrame):
                frames.append(frame)
            else:
                self._counts[frame] += 1
        return tuple(frames)

    def send(self, frames: tuple[CanFrame, ...], now: Instant) -> None:  # noqa: ARG002 - as SlcanPort
        """Put a board's frames on the bus; count those that it does not take."""
        import can

        bus = self._bus
        if bus is None:
            self._counts["closed_frames"] += len(frames)
            return
        for sent, frame in enumerate(frames):
            try:
                bus.send(to_message(frame), timeout=0)
            except (can.CanError, OSError):
                self._counts["unsent_frames"] += len(frames) - sent
                return

    def flush(self, now: Instant) -> None:
        """Do nothing: nothing waits here."""


class VirtualCanPort(PythonCanPort):
    """Boards on python-can's virtual bus ``channel``, for hosts in the same process."""

    def __init__(self, channel: str, fd: bool = False) -> None:
        super().__init__(CanSpec("virtual", channel, fd=fd))


def _unread_bytes(slave: int) -> int:
    return int(struct.unpack("i", fcntl.ioctl(slave, termios.FIONREAD, b"\0\0\0\0"))[0])


def _reserve(link: Path) -> socket.socket | None:
    """Reserve ``link`` for this process until it ends. None where the system has no such names.

    An abstract socket name leaves no file behind and is free again after a kill.
    """
    if not sys.platform.startswith("linux"):
        return None
    place = str(link.parent.resolve() / link.name).encode()
    reservation = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    try:
        reservation.bind(b"\0simdevice-" + hashlib.sha256(place).hexdigest().encode())
    except OSError as error:
        reservation.close()
        raise LinkRefused(f"{link} is served by another simdevice", foreign=False) from error
    return reservation


def _check_replaceable(link: Path) -> None:
    try:
        mode = link.lstat().st_mode
    except FileNotFoundError:
        return
    if not stat.S_ISLNK(mode):
        raise LinkRefused(f"{link} exists and is not a link of a simulator", foreign=True)
    target = os.readlink(link)
    if link.exists() and not target.startswith("/dev/pts/"):
        raise LinkRefused(f"{link} is a link to {target}, not to a simulator's end", foreign=True)


def _replace_link(link: Path, target: str) -> None:
    """Put the link in place in one step, so that there is one at every moment."""
    fresh = link.with_name(f".{link.name}.{os.getpid()}")
    fresh.unlink(missing_ok=True)
    fresh.symlink_to(target)
    os.replace(fresh, link)
