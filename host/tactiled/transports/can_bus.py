"""A CAN bus, by any interface of python-can; error frames are read and counted by name."""

from __future__ import annotations

import logging
import select
import threading
import time
from typing import TYPE_CHECKING, Protocol

from sensor_proto import can_transfers
from sensor_proto.can_transfers import BusState, CanFrame
from tactile_core.can_bus import (
    CanSpec,
    CanUnavailable,
    Trouble,
    from_message,
    open_bus,
    to_message,
)
from tactile_core.types import Instant, after, monotonic_now
from tactiled.blocks import Chunk
from tactiled.transports.base import (
    WRITE_TIMEOUT,
    Losses,
    Medium,
    PortBusy,
    PortClosed,
    PortDenied,
    PortGone,
    PortMissing,
    PortUnsuitable,
    Waker,
)

if TYPE_CHECKING:
    import can

log = logging.getLogger(__name__)

MAX_BATCH = 512
"""Most frames of one read: some 60 ms of a full 1 Mbit/s bus."""

RECV_SLICE = 0.02
"""s. Drivers without a descriptor to poll cannot be woken, so waits are split into slices."""

RESTART_EVERY = 0.25
"""s between attempts to leave bus-off; the standard demands at least 128 × 11 bit times."""

TROUBLES = {
    Trouble.MISSING: PortMissing,
    Trouble.BUSY: PortBusy,
    Trouble.DENIED: PortDenied,
    Trouble.UNSUITABLE: PortUnsuitable,
}
"""Error class of each reason why a bus is unavailable."""


class CanLink(Protocol):
    """Frames through one adapter; `CanTransport` adds bus states and counts."""

    @property
    def losses(self) -> dict[str, int]:
        """Loss counters, one per reason."""

    def open(self) -> None:
        """Open the adapter; `TransportError`."""

    def close(self) -> None:
        """Close the adapter and wake the reader."""

    def receive(self, timeout: float) -> tuple[Instant, list[CanFrame]] | None:
        """Instant of the read and its frames, including error frames; None after ``timeout`` s."""

    def send(self, frames: tuple[CanFrame, ...]) -> None:
        """Send in order; counts frames that cannot be sent."""

    def restart(self) -> None:
        """Try to leave bus-off."""


class CanTransport:
    """A CAN bus by its spec, ``INTERFACE:CHANNEL[@BITRATE[/DATA_BITRATE]][+fd]``.

    ValueError for an invalid spec. ``losses`` also counts each kind of error frame
    (``can_bus-off``, ``can_no-acknowledgement`` …) and every attempt to leave bus-off.
    ``answer_time``: s that an slcan adapter has to answer a command; None: the usual.
    """

    def __init__(self, spec: str, *, answer_time: float | None = None) -> None:
        self.spec = CanSpec.parse(spec)
        self._link: CanLink
        if self.spec.interface == "slcan":
            from tactiled.transports.slcan import ANSWER_TIME, SlcanLink

            self._link = SlcanLink(self.spec, ANSWER_TIME if answer_time is None else answer_time)
        else:
            self._link = PythonCanLink(self.spec)
        self._losses = Losses()
        self._state = BusState.ACTIVE
        self._restart_at = Instant(0)

    @property
    def name(self) -> str:
        """The spec."""
        return str(self.spec)

    @property
    def medium(self) -> Medium:
        """CAN frames."""
        return Medium.CAN

    @property
    def state(self) -> BusState:
        """State by the last error frame; ACTIVE again with the first frame after bus-off."""
        return self._state

    @property
    def losses(self) -> dict[str, int]:
        """Counts of error frames by kind, foreign frames, and frames not sent."""
        return self._losses.snapshot() | self._link.losses

    def open(self) -> None:
        """Open the bus; `TransportError` names the remedy."""
        self._link.open()
        self._state = BusState.ACTIVE

    def read(self, timeout: float) -> Chunk | None:
        """Read frames, including error frames; see `Transport.read`."""
        got = self._link.receive(timeout)
        if got is not None:
            for frame in got[1]:
                if frame.error:
                    self._note(frame)
                elif self._state is BusState.BUS_OFF:
                    self._enter(BusState.ACTIVE)
        if self._state is BusState.BUS_OFF and monotonic_now() >= self._restart_at:
            self._losses.add("can_restarts")
            self._restart_at = after(monotonic_now(), RESTART_EVERY)
            self._link.restart()
        return None if got is None else Chunk(got[0], tuple(got[1]))

    def write(self, data: bytes | tuple[CanFrame, ...]) -> None:
        """Send frames in order; see `Transport.write`. ValueError for FD frames without +fd."""
        if isinstance(data, bytes):
            raise TypeError("a CAN bus takes a tuple of CanFrame, not bytes")
        if not self.spec.fd and any(frame.fd for frame in data):
            raise ValueError(f"{self.spec} was opened without +fd and takes no CAN FD frames")
        self._link.send(data)

    def close(self) -> None:
        """Close; see `Transport.close`."""
        self._link.close()

    def _note(self, frame: CanFrame) -> None:
        for told in can_transfers.error_names(frame):
            self._losses.add(f"can_{told}")
        state = can_transfers.reported_state(frame)
        if state is not None:
            self._enter(state)

    def _enter(self, state: BusState) -> None:
        if state is self._state:
            return
        level = logging.INFO if state is BusState.ACTIVE else logging.WARNING
        log.log(level, "%s: bus state %s, was %s", self.spec, state, self._state)
        if state is BusState.BUS_OFF:
            self._restart_at = after(monotonic_now(), RESTART_EVERY)
        self._state = state


class PythonCanLink:
    """Frames through python-can."""

    def __init__(self, spec: CanSpec) -> None:
        self._spec = spec
        self._losses = Losses()
        self._bus: can.BusABC | None = None
        self._closing = threading.Event()
        self._reading = threading.Lock()
        self._writing = threading.Lock()
        self._waker: Waker | None = None
        self._poll: select.poll | None = None

    @property
    def losses(self) -> dict[str, int]:
        """Counts of foreign frames, and of frames not sent."""
        return self._losses.snapshot()

    def open(self) -> None:
        """Open the adapter; `TransportError`."""
        self.close()
        try:
            bus = open_bus(self._spec)
        except CanUnavailable as error:
            raise TROUBLES[error.trouble](error.problem, error.remedy) from error
        if self._spec.interface == "socketcan":
            # Only socketcan surely buffers nothing above the descriptor, so that it can be polled.
            self._waker = Waker()
            self._poll = select.poll()
            self._poll.register(bus.fileno(), select.POLLIN)
            self._poll.register(self._waker.read_end, select.POLLIN)
        self._closing.clear()
        self._bus = bus

    def close(self) -> None:
        """Wake the reader and close; may be called again."""
        import can

        self._closing.set()
        waker = self._waker
        if waker is not None:
            waker.wake()
        with self._reading, self._writing:
            bus, self._bus = self._bus, None
            self._poll = None
            if self._waker is not None:
                self._waker.close()
                self._waker = None
            if bus is not None:
                try:
                    bus.shutdown()
                except (can.CanError, OSError) as error:
                    log.debug("closing %s: %s", self._spec, error)  # unplugged

    def receive(self, timeout: float) -> tuple[Instant, list[CanFrame]] | None:
        """Instant of the read and its frames; raises `PortGone` and `PortClosed`."""
        import can

        with self._reading:
            bus = self._bus
            if bus is None:
                raise PortClosed(f"{self._spec} is closed")
            try:
                message = self._first(bus, timeout)
                frames: list[CanFrame] = []
                taken = 0
                while message is not None:
                    taken += 1
                    frame = from_message(message)
                    if isinstance(frame, CanFrame):
                        frames.append(frame)
                    else:
                        self._losses.add(frame)
                    message = bus.recv(0) if taken < MAX_BATCH else None
            except (can.CanError, OSError, ValueError) as error:
                raise PortGone(
                    f"{self._spec} is gone ({error})", "plug the adapter in or bring the link up"
                ) from error
            return (monotonic_now(), frames) if frames else None

    def send(self, frames: tuple[CanFrame, ...]) -> None:
        """Send within `WRITE_TIMEOUT` in total; after a failure the rest of the transfer is
        dropped."""
        import can

        with self._writing:
            bus = self._bus
            if bus is None:
                self._losses.add("write_closed_frames", len(frames))
                return
            deadline = time.monotonic() + WRITE_TIMEOUT
            for sent, frame in enumerate(frames):
                try:
                    bus.send(to_message(frame), timeout=max(0.0, deadline - time.monotonic()))
                except (can.CanError, OSError):
                    self._losses.add("write_failed_frames", len(frames) - sent)
                    return

    def restart(self) -> None:
        """Do nothing but warn: kernel and drivers restart by themselves if set to."""
        if self._spec.interface == "socketcan":
            log.warning(
                "%s is bus-off; unless restart-ms is set, run `sudo ip link set %s type can "
                "restart-ms 100`",
                self._spec,
                self._spec.channel,
            )

    def _first(self, bus: can.BusABC, timeout: float) -> can.Message | None:
        if self._poll is not None and self._waker is not None:
            ready = dict(self._poll.poll(max(0.0, timeout) * 1000))
            if self._waker.read_end in ready:
                raise PortClosed(f"{self._spec} was closed")
            return bus.recv(0) if ready else None
        deadline = time.monotonic() + timeout
        while True:
            left = deadline - time.monotonic()
            message = bus.recv(max(0.0, min(left, RECV_SLICE)))
            if self._closing.is_set():
                raise PortClosed(f"{self._spec} was closed")
            if message is not None or left <= RECV_SLICE:
                return message
