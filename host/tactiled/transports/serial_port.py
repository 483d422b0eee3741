"""A serial port: exclusive, low latency, and unplugging is noticed within milliseconds."""

from __future__ import annotations

import errno
import logging
import os
import select
import stat
import termios
import threading
import time
from fcntl import ioctl

import serial

from sensor_proto.can_transfers import BusState, CanFrame
from tactile_core.types import monotonic_now
from tactiled.blocks import Chunk
from tactiled.transports import listing
from tactiled.transports.base import (
    READ_LIMIT,
    WRITE_TIMEOUT,
    Losses,
    Medium,
    PortBusy,
    PortClosed,
    PortDenied,
    PortGone,
    PortMissing,
    PortUnsuitable,
    TransportError,
    Waker,
)

log = logging.getLogger(__name__)

USB_PREFIX = "usb:"
PTY_MAJORS = range(136, 144)  # Linux devices.txt: UNIX98 pseudo-terminal slaves
LOST_SLAVE = select.POLLHUP | select.POLLERR | select.POLLNVAL
"""Poll events of a terminal whose other end is gone."""


class SerialTransport:
    """A serial port by its path, or by the serial number of its USB device (``usb:SERIAL``).

    Once opened, it is found again by its USB serial number, even when plugged in elsewhere. The
    system gives the number of a pseudo-terminal that ended to the next one, which may be anybody's:
    one that is younger than the link that leads to it, or than the one opened before by the same
    number, is refused as missing.
    ``baud``: bit/s; USB devices ignore it. POSIX only.
    """

    def __init__(self, port: str, baud: int = 115_200) -> None:
        if not port or port == USB_PREFIX:
            raise ValueError("no serial port given; allowed: a path or usb:SERIAL_NUMBER")
        if baud <= 0:
            raise ValueError(f"baud rate {baud} given; allowed: a positive number of bit/s")
        self._name = port
        self.baud = baud
        self.usb_serial: str | None = None
        if port.startswith(USB_PREFIX):
            self.usb_serial = port.removeprefix(USB_PREFIX)
        self._serial: serial.Serial | None = None
        self._made_ns: int | None = None  # when the pseudo-terminal opened by its number was made
        self._losses = Losses()
        self._reading = threading.Lock()
        self._writing = threading.Lock()
        self._waker: Waker | None = None
        self._poll = select.poll()

    @property
    def name(self) -> str:
        """The port as given."""
        return self._name

    @property
    def medium(self) -> Medium:
        """Bytes."""
        return Medium.SERIAL

    @property
    def state(self) -> BusState:
        """Always active: a serial line has no other state."""
        return BusState.ACTIVE

    @property
    def losses(self) -> dict[str, int]:
        """Counts of bytes that could not be written, by reason."""
        return self._losses.snapshot()

    @property
    def device(self) -> str | None:
        """Path of the open port; None while closed."""
        return None if self._serial is None else self._serial.port

    def open(self) -> None:
        """Open the port exclusively; `TransportError` names the remedy."""
        self.close()
        device = self._locate()
        made_ns = self._made_ns_of(device)
        port = _open_exclusively(device, self.baud)
        self._made_ns = made_ns
        try:
            port.set_low_latency_mode(True)
        except ValueError:
            log.debug("%s has no low latency mode", device)  # USB CDC and ptys need none
        if self.usb_serial is None:
            self.usb_serial = listing.usb_serial_of(device)
        waker = Waker()
        poll = select.poll()
        poll.register(port.fileno(), select.POLLIN)
        poll.register(waker.read_end, select.POLLIN)
        self._serial, self._waker, self._poll = port, waker, poll

    @property
    def leads_elsewhere(self) -> bool:
        """Whether the path now leads to another device than the one that is open.

        A symbolic link may have been changed. False while the path leads nowhere.
        """
        port = self._serial
        if port is None or self._name.startswith(USB_PREFIX):
            return False
        try:
            return os.stat(self._name).st_rdev != os.fstat(port.fileno()).st_rdev
        except (OSError, serial.SerialException, TypeError):
            return False

    def forget_device(self) -> None:
        """Next time, open the path as given, whatever USB device it led to before."""
        if not self._name.startswith(USB_PREFIX):
            self.usb_serial = None

    def read(self, timeout: float) -> Chunk | None:
        """Read at most `READ_LIMIT` bytes; see `Transport.read`."""
        with self._reading:
            port, waker = self._serial, self._waker
            if port is None or waker is None:
                raise PortClosed(f"{self._name} is closed")
            fd = port.fileno()
            events = dict(self._poll.poll(max(0.0, timeout) * 1000))
            if waker.read_end in events:
                raise PortClosed(f"{self._name} was closed")
            if fd not in events:
                return None
            try:
                data = os.read(fd, READ_LIMIT)
                received = monotonic_now()
            except BlockingIOError:
                data, received = b"", monotonic_now()
                if not events[fd] & LOST_SLAVE:
                    return None
            except OSError as error:
                raise self._gone(error.strerror or str(error)) from error
            if not data:
                raise self._gone("end of file")
            return Chunk(received, data)

    def write(self, data: bytes | tuple[CanFrame, ...]) -> None:
        """Send bytes within `WRITE_TIMEOUT`; bytes not sent are counted."""
        if not isinstance(data, bytes):
            raise TypeError(f"a serial port takes bytes, not {type(data).__name__}")
        with self._writing:
            port = self._serial
            if port is None:
                self._losses.add("write_closed_bytes", len(data))
                return
            fd = port.fileno()
            deadline = time.monotonic() + WRITE_TIMEOUT
            rest = memoryview(data)
            while rest:
                try:
                    rest = rest[os.write(fd, rest) :]
                except BlockingIOError:
                    left = deadline - time.monotonic()
                    if left <= 0 or not select.select([], [fd], [], left)[1]:
                        self._losses.add("write_timeout_bytes", len(rest))
                        return
                except OSError:
                    # The reader notices the same unplugging and raises `PortGone`.
                    self._losses.add("write_gone_bytes", len(rest))
                    return

    def close(self) -> None:
        """Wake a waiting reader, then close the port; may be called again."""
        waker = self._waker
        if waker is not None:
            waker.wake()
        with self._reading, self._writing:
            # Only now does nobody wait on the descriptors, which the system may reuse at once.
            port, self._serial = self._serial, None
            if self._waker is not None:
                self._waker.close()
                self._waker = None
            if port is not None:
                try:
                    port.close()
                except OSError as error:
                    log.debug("closing %s: %s", self._name, error)  # unplugged: nothing to release

    def _gone(self, why: str) -> PortGone:
        return PortGone(f"{self._name} is gone ({why})", "plug it in again")

    def _locate(self) -> str:
        """Path to open: that of the known USB device, wherever it is, else the path as given."""
        if self.usb_serial is not None:
            found = listing.find_by_serial(self.usb_serial)
            if found is not None:
                return found.device
            if self._name.startswith(USB_PREFIX) or os.path.exists(self._name):
                raise PortMissing(
                    f"no USB serial port has the serial number {self.usb_serial}",
                    f"plug it in; {listing.known_ports()}",
                )
        return self._name

    def _made_ns_of(self, device: str) -> int | None:
        """When the pseudo-terminal ``device`` was made; None for other devices and behind links.

        `PortMissing` if it took the number of the one that was meant. Asked before it is opened,
        for opening changes the settings of a terminal, and this one may be somebody's.
        """
        try:
            found = os.stat(device)
        except OSError:
            return None  # opening it says why
        if os.major(found.st_rdev) not in PTY_MAJORS:
            return None
        link_ns = _made_last_ns(device)
        meant_ns = self._made_ns if link_ns is None else link_ns
        # One of the three is as old as the terminal: setting its mode changes the first alone, what
        # is written and read the others.
        made_ns = min(found.st_ctime_ns, found.st_mtime_ns, found.st_atime_ns)
        if meant_ns is not None and made_ns > meant_ns:
            raise PortMissing(
                f"the pseudo-terminal of {device} has ended; another one has its number now",
                "start its simulator again, and give the link that it makes",
            )
        return found.st_ctime_ns if link_ns is None else None


def _made_last_ns(path: str) -> int | None:
    """When the symbolic link was made that ``path`` leads through last; None if it is no link."""
    made = None
    while os.path.islink(path):
        made = os.lstat(path).st_ctime_ns
        path = os.path.join(os.path.dirname(path), os.readlink(path))
    return made


def _open_exclusively(device: str, baud: int) -> serial.Serial:
    """Open ``device`` exclusively; `TransportError` names the remedy."""
    _check_is_port(device)
    try:
        port = serial.Serial(device, baud, timeout=0, exclusive=True)
    except serial.SerialException as error:
        raise _explain(device, error.errno, error) from error
    except (OSError, termios.error) as error:
        raise _explain(device, error.args[0], error) from error
    except ValueError as error:
        raise PortUnsuitable(
            f"{device} refuses {baud} bit/s: {error}", "give a baud rate that the port supports"
        ) from error
    if os.major(os.fstat(port.fileno()).st_rdev) in PTY_MAJORS:
        return port  # the process at its other end holds it too, and TIOCEXCL would outlive us
    others = [who for who in listing.holders(device) if f"pid {os.getpid()}" not in who]
    if others:
        port.close()
        raise _busy(device, others)
    # flock stops only programs that use it as well; this stops all others.
    try:
        ioctl(port.fileno(), termios.TIOCEXCL)
    except OSError as error:
        log.debug("%s cannot be made exclusive: %s", device, error)  # flock still holds
    return port


def _check_is_port(device: str) -> None:
    try:
        mode = os.stat(device).st_mode
    except FileNotFoundError as error:
        raise PortMissing(f"there is no port {device}", listing.known_ports()) from error
    except OSError as error:
        raise _explain(device, error.errno, error) from error
    if not stat.S_ISCHR(mode):
        kind = "a folder" if stat.S_ISDIR(mode) else "a file"
        raise PortUnsuitable(f"{device} is {kind}, not a serial port", listing.known_ports())


def _explain(device: str, number: object, error: BaseException) -> TransportError:
    if number in (errno.ENOENT, errno.ENXIO, errno.ENODEV):
        return PortMissing(f"there is no port {device}", listing.known_ports())
    if number in (errno.EACCES, errno.EPERM):
        return PortDenied(f"no permission to open {device}", permission_remedy(device))
    if number in (errno.EBUSY, errno.EAGAIN):
        return _busy(device, listing.holders(device))
    if number in (errno.ENOTTY, errno.EINVAL) or "configure port" in str(error):
        return PortUnsuitable(f"{device} is not a serial port", listing.known_ports())
    return PortUnsuitable(f"cannot open {device}: {error}", "plug it out and in again")


def _busy(device: str, who: list[str]) -> PortBusy:
    by = f" by {', '.join(who)}" if who else " by another process"
    return PortBusy(f"{device} is held{by}", "end that process, or give another port")


def permission_remedy(device: str) -> str:
    """How to permit a user to open ``device``: join its group, or add a udev rule."""
    import grp

    try:
        group = grp.getgrgid(os.stat(device).st_gid).gr_name
    except (OSError, KeyError):
        group = "dialout"
    if group == "root":
        group = "dialout"
    rule = 'SUBSYSTEM=="tty", ATTRS{idVendor}=="VID", ATTRS{idProduct}=="PID", MODE="0660"'
    return (
        f"run `sudo usermod -aG {group} $USER` and log in again, or add the udev rule "
        f'{rule}, GROUP="{group}" in /etc/udev/rules.d/70-tactile.rules'
    )
