"""Run boards in real time: pass data between ports and boards on a fixed grid of ticks."""

from __future__ import annotations

import math
import select
from collections.abc import Callable, Sequence
from typing import Generic, Protocol, TypeVar

from sensor_proto.can_transfers import CanFrame
from sim_device.board.recorded import ReplayBoard
from sim_device.faults import Window
from sim_device.ports import PtyPort, PythonCanPort, SlcanPort
from tactile_core.types import Instant, after, monotonic_now, seconds_between

TICK_S = 0.001
"""Seconds between two ticks: the period of a USB frame. No sample waits longer."""

STATUS_PERIOD_S = 0.5
"""Seconds between two calls of the status function."""

LONGEST_WAIT_S = 0.05
"""Longest time, s, that a board waits for a full terminal. After that the board goes on and the
port drops the oldest data, so that a host that comes back gets nothing older. A full bus always
empties, so there is no limit on a bus."""

STALL_S = 0.1
"""Seconds that a full port may last before a replay's later rows are moved back by that time."""

DRAIN_S = 2.0
"""Seconds that the last frames of a replay wait for their reader."""

SETTLE_S = 0.25
"""Seconds for written bytes to show as unread: the kernel delivers them later, on a busy machine
much later. Without this wait, a replay would begin before anybody reads, and end before all is
read."""

Payload = TypeVar("Payload", bytes, tuple[CanFrame, ...])
AnyPort = TypeVar("AnyPort", bound=PtyPort | SlcanPort | PythonCanPort)


class Board(Protocol[Payload]):
    """Simulated board; see `sim_device.board.firmware`."""

    @property
    def counters(self) -> dict[str, int]:
        """Counts by name, since power-on."""

    def receive(self, data: Payload, now: Instant, /) -> None:
        """Take what arrived from the host."""

    def tick(self, now: Instant, /) -> Payload:
        """Data for the host up to ``now``."""


MakeBoard = Callable[[float], Board[Payload]]
"""Makes a new board that is powered the given number of seconds after the simulation started."""


class PortServer(Protocol):
    """One port and the boards on it."""

    @property
    def sent(self) -> int:
        """Messages (serial) or frames (CAN) given to the port."""

    @property
    def losses(self) -> dict[str, int]:
        """What was lost at the port and at the boards, by reason."""

    @property
    def finished(self) -> bool:
        """Whether nothing is left to do."""

    def fileno(self) -> int:
        """Descriptor to wait on; −1 for none."""

    def open(self) -> None:
        """Open the port."""

    def close(self) -> None:
        """Close the port."""

    def service(self, now: Instant) -> None:
        """Pass on everything that is due."""


class _OnePort(Generic[AnyPort]):
    """What servers of one ``port`` share."""

    def __init__(self, port: AnyPort) -> None:
        self.port = port

    @property
    def finished(self) -> bool:
        """False: boards run until they are stopped."""
        return False

    def fileno(self) -> int:
        """Descriptor of the port; −1 for none."""
        return self.port.fileno()

    def open(self) -> None:
        """Open the port."""
        self.port.open()

    def close(self) -> None:
        """Close the port."""
        self.port.close()


class SerialServer(_OnePort[PtyPort]):
    """Board on a pseudo-terminal. ``unplugged``: when it has neither power nor port."""

    def __init__(
        self, port: PtyPort, make_board: MakeBoard[bytes], unplugged: Sequence[Window] = ()
    ) -> None:
        super().__init__(port)
        self.board: Board[bytes] = make_board(0.0)
        self.sent = 0
        self._make_board = make_board
        self._unplugged = tuple(unplugged)
        self._start: Instant | None = None
        self._feeder = _Feeder[bytes](LONGEST_WAIT_S)

    @property
    def losses(self) -> dict[str, int]:
        """What was lost at the port and at the board, by reason."""
        return self.port.losses | _only_losses(self.board.counters)

    def service(self, now: Instant) -> None:
        """Unplug or plug in when it is time, then pass bytes on."""
        if self._start is None:
            self._start = now
        elapsed = seconds_between(self._start, now)
        if any(w.covers(elapsed) for w in self._unplugged):
            self.port.close()
            return
        if not self.port.is_open:
            self.board = self._make_board(elapsed)
            self._feeder = _Feeder(LONGEST_WAIT_S)
            self.port.open()
        data = self.port.receive()
        if data:
            self.board.receive(data, now)
        self.port.flush()
        out = self._feeder.tick(self.board, self.port.ready, now)
        if out:
            self.sent += 1
            self.port.send(out)


class CanServer(_OnePort[SlcanPort | PythonCanPort]):
    """Boards on one CAN bus."""

    def __init__(
        self,
        port: SlcanPort | PythonCanPort,
        make_boards: Sequence[MakeBoard[tuple[CanFrame, ...]]],
    ) -> None:
        super().__init__(port)
        self.boards = [make(0.0) for make in make_boards]
        self.sent = 0
        self._feeders = [_Feeder[tuple[CanFrame, ...]](math.inf) for _ in self.boards]

    @property
    def losses(self) -> dict[str, int]:
        """What was lost at the port and at all boards together, by reason."""
        total = dict(self.port.losses)
        for board in self.boards:
            for reason, count in _only_losses(board.counters).items():
                total[reason] = total.get(reason, 0) + count
        return total

    def service(self, now: Instant) -> None:
        """Pass frames on. Boards receive what the host sends, not what other boards send."""
        frames = self.port.receive()
        for board in self.boards if frames else ():
            board.receive(frames, now)
        self.port.flush(now)
        for board, feeder in zip(self.boards, self._feeders, strict=True):
            out = feeder.tick(board, self.port.ready, now)
            if out:
                self.sent += len(out)
                self.port.send(out, now)


class ReplayServer(_OnePort[PtyPort]):
    """Recording on a pseudo-terminal. Nothing of it is lost: it begins when a host reads, and
    waits while no host does."""

    def __init__(self, port: PtyPort, board: ReplayBoard) -> None:
        super().__init__(port)
        self.board = board
        self._ended: Instant | None = None
        self._full: Instant | None = None
        self._probed_at: Instant | None = None
        self._probe_waiting = False
        self._now = Instant(0)

    @property
    def sent(self) -> int:
        """Frames sent."""
        return self.board.sent

    @property
    def losses(self) -> dict[str, int]:
        """What was lost at the port, by reason."""
        return self.port.losses

    @property
    def finished(self) -> bool:
        """Whether the last frame was read, or nobody read it for `DRAIN_S`."""
        if self._ended is None:
            return False
        waited = seconds_between(self._ended, self._now)
        return waited > (DRAIN_S if self.port.unread else SETTLE_S)

    def service(self, now: Instant) -> None:
        """Send the frames that are due; begin once the probe bytes have been read."""
        self._now = now
        self.port.receive()  # dropped: such boards do not listen
        self.port.flush()
        if not self.port.ready:
            self._full = self._full or now
            return
        if self._full is not None:
            stalled = seconds_between(self._full, now)
            self._full = None
            if stalled > STALL_S:
                self.board.postpone(stalled)
        out = self.board.tick(now)
        self.port.send(out)
        if not self.board.started and self._probe_was_read(now):
            self.board.start(now)
        if self.board.finished and self._ended is None:
            self._ended = now

    def _probe_was_read(self, now: Instant) -> bool:
        self._probed_at = self._probed_at or now
        if self.port.unread:
            self._probe_waiting = True
            return False
        return self._probe_waiting or seconds_between(self._probed_at, now) > SETTLE_S


class Runner:
    """Serves ports on an absolute grid of `TICK_S` until told to stop."""

    def __init__(self, servers: Sequence[PortServer]) -> None:
        self.servers = tuple(servers)

    def open(self) -> None:
        """Open every port, or none: raises the error of the first that fails."""
        opened: list[PortServer] = []
        try:
            for server in self.servers:
                server.open()
                opened.append(server)
        except BaseException:
            for server in opened:
                server.close()
            raise

    def close(self) -> None:
        """Close every port and remove its link."""
        for server in self.servers:
            server.close()

    def run(
        self,
        stopping: Callable[[], bool],
        duration: float | None = None,
        on_status: Callable[[float], None] | None = None,
    ) -> None:
        """Serve until ``stopping()``, for ``duration`` s, or until every server has finished.

        ``on_status``: called with the seconds since the start every `STATUS_PERIOD_S`.
        """
        start = tick = monotonic_now()
        status = start
        while not stopping():
            now = monotonic_now()
            elapsed = seconds_between(start, now)
            if duration is not None and elapsed >= duration:
                return
            for server in self.servers:
                server.service(now)
            if all(server.finished for server in self.servers):
                return
            if on_status is not None and now >= status:
                on_status(elapsed)
                status = after(now, STATUS_PERIOD_S)
            tick = after(tick, TICK_S)
            if tick < now:
                tick = now  # late: the boards catch up by themselves, without extra ticks
            self._wait(seconds_between(monotonic_now(), tick))

    def _wait(self, seconds: float) -> None:
        descriptors = [fd for server in self.servers if (fd := server.fileno()) >= 0]
        select.select(descriptors, [], [], max(0.0, seconds))


class _Feeder(Generic[Payload]):
    """Lets a board wait while its port is full, for at most ``longest`` s."""

    def __init__(self, longest: float) -> None:
        self._longest = longest
        self._last: Instant | None = None

    def tick(self, board: Board[Payload], ready: bool, now: Instant) -> Payload | None:
        """What the board sends; None while it waits."""
        waited = self._last is None or seconds_between(self._last, now) >= self._longest
        if not ready and not waited:
            return None
        self._last = now
        return board.tick(now)


LOSS_COUNTERS = ("overruns", "lost", "silenced", "damaged", "rx_errors")
"""Counters of a board that count losses, injected or not."""


def _only_losses(counters: dict[str, int]) -> dict[str, int]:
    return {name: counters[name] for name in LOSS_COUNTERS if counters.get(name)}
