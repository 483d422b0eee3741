"""``tactile board-check``: does a board keep to PROTOCOL.md? One line per check: pass or fail."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise

import numpy as np

from sensor_proto import cobs
from sensor_proto.can_transfers import BROADCAST, CanDecoder, CanEncoder, CanFrame, segment
from sensor_proto.crc import crc32c
from sensor_proto.framing import SerialDecoder, encode_serial
from sensor_proto.packets import (
    ACCEPTED,
    PROTOCOL_MAJOR,
    Ack,
    AckResult,
    ChipType,
    ClockPoll,
    ClockReply,
    Descriptor,
    FloatSamples,
    HostMessage,
    Identify,
    Log,
    Message,
    Reboot,
    Received,
    Samples,
    SetGain,
    SetRate,
    Start,
    Status,
    Stop,
    message_type,
    pack,
)
from sim_device.board.firmware import frame_bits
from tactile_core.can_bus import DEFAULT_BITRATE
from tactile_core.types import Instant, after, monotonic_now, seconds_between
from tactiled.transports.base import Medium, Transport, TransportError
from tactiled.transports.can_bus import CanTransport
from tactiled.transports.serial_port import SerialTransport

DONE, FAILED, USAGE, ENVIRONMENT = range(4)

ANSWER_S = 3.0
"""Patience for an answer, s. PROTOCOL.md sets no limit, and the machine may be busy."""

REPEAT_S = 0.25
"""A command without an answer is sent again after this time, s, as a host does."""

RETURN_S = 15.0
"""Time from Reboot until the board must be back, its USB port included, s."""

FIRST_STATUS_S = 1.5
FLOOD = 100
CLOCK_ERROR = 0.11
"""Largest relative error of a clock that is still usable."""

RATE_ERROR = 0.005
"""Largest relative error of the mean period, in ticks of the board itself."""

LSB_NT = {7: (150, 242), 5: (250, 403)}
"""Nanotesla per count of an MLX90393 at resolution 0, by gain: (x and y, z). Source: its
datasheet."""

UNKNOWN_COMMAND = 0xF0
OTHER_BOARDS_TYPE = 0x7E


class Failed(Exception):  # noqa: N818 - names an outcome
    """The board failed a check; the text says what it did and what was expected."""


class Skipped(Exception):  # noqa: N818 - names an outcome
    """A check does not apply to this board; the text says why."""


class Unreachable(Exception):  # noqa: N818 - names an outcome
    """No board answers, or it does not any more; the text names the remedy."""


@dataclass(slots=True)
class Heard:
    """A message of the board and the instant of its arrival."""

    message: Message
    when: Instant


class Host:
    """The host's side of one board on an open port.

    ``node``: the board's number on a CAN bus, None on a serial line. ``fd``: CAN FD. ``bitrate``:
    of the bus, bit/s. ``now``: the clock that ``transport`` stamps with.
    """

    def __init__(
        self,
        transport: Transport,
        node: int | None = None,
        fd: bool = False,
        bitrate: int = DEFAULT_BITRATE,
        now: Callable[[], Instant] = monotonic_now,
    ) -> None:
        self.transport = transport
        self.bitrate = bitrate
        self.now = now
        self.node = node
        self.reopened = 0
        self.heard: list[Heard] = []
        self.fd = fd
        self._serial = SerialDecoder()
        self._can = CanDecoder()
        self._encoder = CanEncoder(BROADCAST if node is None else node, fd)
        self._request = 0
        self._transfer: dict[int, int] = {}

    def set_node(self, node: int) -> None:
        """Talk to board ``node`` alone from now on."""
        self.node = node
        self._encoder = CanEncoder(node, self.fd)

    @property
    def on_can(self) -> bool:
        """Whether the medium is CAN."""
        return self.transport.medium is Medium.CAN

    def next_request(self) -> int:
        """Return a request number that no recent command had."""
        self._request = (self._request + 1) % 0x10000
        return self._request

    def send(self, message: HostMessage) -> None:
        """Send one message."""
        if self.on_can:
            self.transport.write(self._encoder.encode(message))
        else:
            self.transport.write(encode_serial(message))

    def send_raw(self, kind: int, payload: bytes) -> None:
        """Send ``payload`` as a message of any type ``kind``, known or not."""
        board = (self.node or 0) if self.on_can else 0
        body = bytes([kind, board]) + len(payload).to_bytes(2, "little") + payload
        packet = body + crc32c(body).to_bytes(4, "little")
        if self.on_can:
            number = self._transfer[kind] = (self._transfer.get(kind, 15) + 1) % 32
            self.transport.write(segment(packet, _identifier(kind, board), number, self.fd))
        else:
            self.transport.write(cobs.encode(packet) + b"\0")

    def send_bytes(self, data: bytes) -> None:
        """Write bytes to a serial line, in pieces that a port accepts at once."""
        for at in range(0, len(data), 256):
            self.transport.write(data[at : at + 256])
            self.listen(0.002)

    def listen(self, seconds: float, enough: Callable[[], bool] = lambda: False) -> bool:
        """Take messages until ``enough()`` (True) or until ``seconds`` are over (False)."""
        end = after(self.now(), seconds)
        while not enough():
            left = seconds_between(self.now(), end)
            if left <= 0:
                return False
            chunk = self.transport.read(min(left, 0.1))
            if chunk is None:
                continue
            received: list[Received]
            if isinstance(chunk.payload, bytes):
                received = self._serial.feed(chunk.payload)
            else:
                received = self._can.feed(self._own_frames(chunk.payload))
            for item in received:
                if not isinstance(item.message, FloatSamples):
                    self.heard.append(Heard(item.message, chunk.received))
        return True

    def _own_frames(self, frames: tuple[CanFrame, ...]) -> list[CanFrame]:
        """Frames of our board; those of other boards on the bus are not judged."""
        return [
            f
            for f in frames
            if not f.error and (self.node is None or f.identifier & 0x7F == self.node)
        ]

    def nodes(self) -> dict[int, Descriptor]:
        """Find the boards of a CAN bus: those that answer an Identify to all, by number."""
        found: dict[int, Descriptor] = {}
        decoder = CanDecoder()
        self.send(Identify(self.next_request()))
        end = after(self.now(), 1.0)
        while self.now() < end:
            chunk = self.transport.read(0.1)
            if chunk is not None and not isinstance(chunk.payload, bytes):
                for item in decoder.feed(chunk.payload):
                    if isinstance(item.message, Descriptor):
                        found[item.board] = item.message
        return found

    def messages(self, kind: type[Message], first: int = 0) -> list[Heard]:
        """Messages of type ``kind``, from index ``first`` of all messages on."""
        return [h for h in self.heard[first:] if isinstance(h.message, kind)]

    def wait_for(self, kind: type[Message], first: int, seconds: float) -> bool:
        """Wait up to ``seconds`` for a message of type ``kind``, from index ``first`` on."""
        return self.listen(seconds, lambda: bool(self.messages(kind, first)))

    def refusals(self) -> dict[str, int]:
        """Count what the board sent and our decoder refused, by reason."""
        counts = (self._can if self.on_can else self._serial).counters
        quiet = {ACCEPTED, "empty", "foreign"}
        return {k: n for k, n in counts.items() if n and k not in quiet}

    def forget_refusals(self) -> None:
        """Start judging what the board sends: earlier bytes were meant for an earlier host."""
        self._serial = SerialDecoder()
        self._can = CanDecoder()

    def reopen(self) -> None:
        """Reopen a port that vanished with the reset; `Unreachable` when it does not come back."""
        self.transport.close()
        end = after(self.now(), RETURN_S)
        while True:
            try:
                self.transport.open()
            except TransportError as error:
                if self.now() > end:
                    raise Unreachable(f"after Reboot: {error}") from error
                time.sleep(0.1)
            else:
                self.reopened += 1
                return

    # Questions and answers

    def identify(self, major: int = PROTOCOL_MAJOR) -> Descriptor:
        """Ask for the descriptor; `Failed` when Identify is not answered."""
        for _ in range(round(ANSWER_S / REPEAT_S)):
            mark = len(self.heard)
            self.send(Identify(self.next_request(), major))
            if self.wait_for(Descriptor, mark, REPEAT_S):
                message = self.messages(Descriptor, mark)[-1].message
                assert isinstance(message, Descriptor)
                return message
        raise Failed("Identify was not answered")

    def command(self, make: Callable[[int], HostMessage]) -> AckResult:
        """Send a command and return its result; `Failed` when no ack carries its request number."""
        request = self.next_request()
        message = make(request)
        mark = len(self.heard)
        for _ in range(round(ANSWER_S / REPEAT_S)):
            self.send(message)
            if self.listen(REPEAT_S, lambda: self.ack(request, mark) is not None):
                ack = self.ack(request, mark)
                assert ack is not None
                if ack.command != message_type(message):
                    raise Failed(f"the ack names command {ack.command:02X}h")
                return ack.result
        raise Failed(f"{type(message).__name__} was not acknowledged")

    def ack(self, request: int, first: int) -> Ack | None:
        """The ack of ``request`` from index ``first`` on, if it has come."""
        for h in self.messages(Ack, first):
            if isinstance(h.message, Ack) and h.message.request == request:
                return h.message
        return None

    def status(self) -> Status:
        """Wait for the next status; `Failed` when none comes in time."""
        mark = len(self.heard)
        if not self.listen(ANSWER_S, lambda: bool(self.messages(Status, mark))):
            raise Failed(f"no status in {ANSWER_S:g} s")
        message = self.messages(Status, mark)[0].message
        assert isinstance(message, Status)
        return message

    def samples(self, cycles: int, patience: float) -> list[Samples]:
        """Wait for the samples of ``cycles`` further cycles; `Failed` when they do not come."""
        mark = len(self.heard)

        def count() -> bool:
            return len({s.sequence for s in self.all_samples(mark)}) > cycles

        if not self.listen(patience, count):
            got = len({s.sequence for s in self.all_samples(mark)})
            raise Failed(f"{got} sampling cycles in {patience:.1f} s instead of {cycles}")
        return self.all_samples(mark)

    def all_samples(self, first: int = 0) -> list[Samples]:
        """Samples received from index ``first`` on."""
        return [h.message for h in self.heard[first:] if isinstance(h.message, Samples)]


def _identifier(kind: int, board: int) -> int:
    return 2 << 26 | 0x2A5 << 16 | kind << 8 | board


@dataclass(slots=True)
class Board:
    """What the checks know of the board under test."""

    host: Host
    descriptor: Descriptor
    default_mhz: int = 0
    starts: list[int] = field(default_factory=list)  # where in `Host.heard` sequences begin

    @property
    def patience(self) -> float:
        """Time for a dozen cycles of the slowest rate, and more for a busy machine, s."""
        return ANSWER_S + 12 * 1000 / max(self.default_mhz, 1000)


Check = Callable[[Board], str]


def _rate(rate_mhz: int) -> Callable[[int], HostMessage]:
    return partial(SetRate, rate_mhz=rate_mhz)


def _gain(
    array: int, gain: int, resolution: int, oversampling: int, filter_code: int
) -> Callable[[int], HostMessage]:
    return partial(
        SetGain,
        array=array,
        gain=gain,
        resolution=resolution,
        oversampling=oversampling,
        filter=filter_code,
    )


def require_ok(said: AckResult, of: str) -> None:
    """`Failed` unless the command was obeyed."""
    if said is not AckResult.OK:
        raise Failed(f"{of} was answered with {said.name}")


def require_refusal(said: AckResult, of: str, wanted: AckResult = AckResult.BAD_ARGUMENT) -> None:
    """`Failed` unless the command was refused with ``wanted``."""
    if said is not wanted:
        raise Failed(f"{of} was answered with {said.name} instead of {wanted.name}")


# The checks, in order. Each leaves the board streaming unless it says otherwise, and returns what
# it found.


def _describes_itself(board: Board) -> str:
    d = board.descriptor
    if d.major != PROTOCOL_MAJOR:
        raise Failed(f"it speaks {d.major}.{d.minor}; the checks are of {PROTOCOL_MAJOR}")
    if d.unique_id in (bytes(8), b"\xff" * 8):
        raise Failed(f"unique_id {d.serial_number} is what every unprogrammed board has")
    if not d.model or not d.firmware:
        raise Failed("model or firmware is empty")
    taxels = sum(a.taxels for a in d.arrays)
    return f"{d.model} {d.serial_number}, firmware {d.firmware}, {taxels} taxels"


def _answers_other_majors(board: Board) -> str:
    if board.host.identify(major=9) != board.descriptor:
        raise Failed("its descriptor is another then")
    return ""


def _comes_back_after_reboot(board: Board) -> str:
    """Leaves the board stopped."""
    host = board.host
    require_ok(host.command(Reboot), "Reboot")
    mark, reopened = len(host.heard), host.reopened
    end = after(host.now(), RETURN_S)

    def told() -> list[Heard]:
        return [h for h in host.messages(Status, mark) if _uptime(h) < 1000 * (FIRST_STATUS_S + 1)]

    while not told():
        try:
            host.listen(0.5, lambda: bool(told()))
        except TransportError:
            host.reopen()
        if host.now() > end:
            raise Failed("no status tells of a reset")
    first = told()[0].message
    assert isinstance(first, Status)
    # Between ack and reset a board may go on streaming; half a second before this status it was
    # surely reset.
    if any(seconds_between(h.when, told()[0].when) < 0.5 for h in host.messages(Samples, mark)):
        raise Failed("it streams before Start")
    if first.reset_cause != 1:
        raise Failed(f"reset_cause is {first.reset_cause} instead of 1, command")
    if first.cycles or first.overruns or first.rate_mhz:
        raise Failed("cycles, overruns and rate_mhz are not 0 after the reset")
    if host.reopened == reopened and first.uptime_ms > 1000 * FIRST_STATUS_S:
        raise Failed(f"its first status came {first.uptime_ms} ms after the reset, not in 1500")
    board.descriptor = host.identify()
    return f"status after {first.uptime_ms} ms"


def _uptime(heard: Heard) -> int:
    assert isinstance(heard.message, Status)
    return heard.message.uptime_ms


def _says_status_unasked(board: Board) -> str:
    first, _, third = (board.host.status() for _ in range(3))
    step = (third.uptime_ms - first.uptime_ms) / 2
    if not 800 <= step <= 1200:  # a busy board may send one of them late
        raise Failed(f"{step:g} ms of uptime from one status to the next instead of 1000")
    return ""


def _is_silent_until_start(board: Board) -> str:
    mark = len(board.host.heard)
    board.host.listen(0.3)
    if board.host.all_samples(mark):
        raise Failed("samples came before Start")
    return ""


def _begins_at_sequence_0(board: Board) -> str:
    host = board.host
    mark = len(host.heard)
    require_ok(host.command(Start), "Start")
    host.samples(3, board.patience + RETURN_S)
    first = host.all_samples(mark)[0].sequence
    status = host.status()
    board.default_mhz = status.rate_mhz
    if status.rate_mhz == 0:
        raise Failed("its status says rate_mhz 0 while it streams")
    if first > status.overruns:
        raise Failed(f"the first cycle has sequence {first}")
    return f"{status.rate_mhz / 1000:g} Hz by default"


def _sends_whole_cycles(board: Board) -> str:
    d = board.descriptor
    arrays = [a.array for a in d.arrays]
    taxels = {a.array: a.taxels for a in d.arrays}
    samples = board.host.samples(8, board.patience)
    cycles: dict[int, list[Samples]] = {}
    order: list[int] = []
    for s in samples:
        if s.array not in taxels:
            raise Failed(f"samples of array {s.array}, which the descriptor does not have")
        if len(s.status) != taxels[s.array]:
            raise Failed(f"array {s.array} has {len(s.status)} taxels, said {taxels[s.array]}")
        if any(int(bits) & ~7 for bits in s.status):
            raise Failed("status bits beyond 0 to 2 are set")
        if order and order[-1] != s.sequence and s.sequence in cycles:
            raise Failed(f"arrays of cycle {s.sequence} do not follow one another")
        cycles.setdefault(s.sequence, []).append(s)
        order.append(s.sequence)
    for whole in list(cycles.values())[1:-1]:
        if [s.array for s in whole] != arrays:
            raise Failed(f"a cycle holds arrays {[s.array for s in whole]} instead of {arrays}")
        spread = max((s.ticks - whole[0].ticks) % (1 << 32) for s in whole)
        if spread * board.default_mhz > d.tick_hz * 1000 and len(whole) > 1:
            raise Failed("the instants of a cycle's arrays are more than a period apart")
    return f"{len(arrays)} array{'s' * (len(arrays) > 1)}"


def _keeps_to_its_sequence_and_ticks(board: Board) -> str:
    samples = board.host.samples(8, board.patience)
    for one, next_one in pairwise(samples):
        if (next_one.sequence - one.sequence) % (1 << 32) >= 1 << 31:
            raise Failed(f"sequence goes from {one.sequence} to {next_one.sequence}")
        if next_one.array == one.array and (next_one.ticks - one.ticks) % (1 << 32) >= 1 << 31:
            raise Failed(f"ticks go from {one.ticks} back to {next_one.ticks}")
    return ""


def _reads_its_chips(board: Board) -> str:
    samples = board.host.samples(5, board.patience)
    dead = {
        f"{s.array}.{t}" for s in samples[-5:] for t, bits in enumerate(s.status) if int(bits) & 4
    }
    if dead:
        raise Failed(f"taxels that cannot be read: {', '.join(sorted(dead)[:8])}")
    far = [s.temperature_cc / 100 for s in samples if not -4500 <= s.temperature_cc <= 13000]
    if far:
        raise Failed(f"a temperature of {far[0]:g} C")
    return f"{samples[-1].temperature_cc / 100:g} C"


def _obeys_start_while_streaming(board: Board) -> str:
    before = board.host.samples(2, board.patience)[-1].sequence
    require_ok(board.host.command(Start), "a second Start")
    if board.host.samples(2, board.patience)[-1].sequence <= before:
        raise Failed("its sequence began anew")
    return ""


def _identifies_while_streaming(board: Board) -> str:
    if board.host.identify() != board.descriptor:
        raise Failed("its descriptor changed without a command")
    board.host.samples(2, board.patience)
    return ""


def _answers_clock_polls(board: Board) -> str:
    host, hz = board.host, board.descriptor.tick_hz
    sent: list[tuple[Instant, Instant, ClockReply]] = []
    too_long = 0
    for number in range(12):
        token = 0xC0FFEE00 + number
        mark = len(host.heard)
        asked = host.now()
        host.send(ClockPoll(token))
        if not host.wait_for(ClockReply, mark, ANSWER_S):
            raise Failed("a clock poll was not answered")
        heard = host.messages(ClockReply, mark)[0]
        reply = heard.message
        assert isinstance(reply, ClockReply)
        if reply.token != token:
            raise Failed(f"the reply carries token {reply.token:08X}h instead of {token:08X}h")
        held = (reply.ticks_sent - reply.ticks_received) % (1 << 32) / hz
        trip = seconds_between(asked, heard.when)
        too_long += held > trip * (1 + CLOCK_ERROR) + 2 / hz
        if too_long > 3:  # one or two may be an emulator's clock catching up
            raise Failed(f"it says it held the poll for {held:.4f} s, of {trip:.4f} s in all")
        sent.append((asked, heard.when, reply))
        host.listen(0.15)
    (asked, heard_first, first), (asked_last, heard_last, last) = sent[0], sent[-1]
    ticks = (last.ticks_received - first.ticks_received) % (1 << 32)
    shortest = seconds_between(heard_first, asked_last)
    longest = seconds_between(asked, heard_last)
    if not shortest * (1 - CLOCK_ERROR) <= ticks / hz <= longest * (1 + CLOCK_ERROR):
        raise Failed(f"{ticks} ticks in {longest:.2f} s: tick_hz says {hz}")
    return f"{ticks / hz / ((shortest + longest) / 2) - 1:+.2%} against this machine, about"


def _refuses_rates(board: Board) -> str:
    host = board.host
    most = board.descriptor.max_rate_mhz
    for rate in (0, most + 1, 0xFFFF_FFFF):
        if rate <= 0xFFFF_FFFF:
            require_refusal(host.command(_rate(rate)), f"Set rate {rate} mHz")
    rate = host.status().rate_mhz
    if rate != board.default_mhz:
        raise Failed(f"a refused rate left it at {rate} mHz instead of {board.default_mhz}")
    return ""


def _keeps_rates(board: Board) -> str:
    host, d = board.host, board.descriptor
    most = min(d.max_rate_mhz, _bus_rate_mhz(board))
    told = []
    for rate in sorted({most, most * 2 // 3, most // 7, min(most, 33_333)}):
        if rate < 1000 and rate != most:
            continue
        require_ok(host.command(_rate(rate)), f"Set rate {rate} mHz")
        first_array = d.arrays[0].array
        cycles = max(8, min(40, rate // 1000))
        samples = host.samples(cycles, ANSWER_S + 3000 * cycles / rate)
        _judge_pace([s for s in samples if s.array == first_array], d.tick_hz * 1000 / rate, rate)
        said = host.status().rate_mhz
        if said != rate:
            raise Failed(f"after Set rate {rate} its status says {said}")
        told.append(f"{rate / 1000:g}")
    require_ok(host.command(_rate(board.default_mhz)), "Set rate to the default")
    return f"{', '.join(told)} Hz"


def _bus_rate_mhz(board: Board) -> int:
    """Rate, mHz, that fills half of a CAN bus; a full bus loses frames of any board."""
    if not board.host.on_can:
        return 0xFFFF_FFFF
    encoder = CanEncoder(0, board.host.fd)
    bits = sum(
        frame_bits(frame)
        for a in board.descriptor.arrays
        for frame in encoder.encode(
            Samples(
                a.array, 0, 0, 0, np.zeros((a.taxels, 3), np.int16), np.zeros(a.taxels, np.uint8)
            )
        )
    )
    return int(0.5 * 1000 * board.host.bitrate / bits)


def _judge_pace(samples: list[Samples], wanted: float, rate_mhz: int) -> None:
    """`Failed` unless a cycle takes ``wanted`` ticks on average.

    A busy board may begin a cycle late, never early, so the least late cycles of both halves are
    compared.
    """
    first = samples[0]
    late = [
        (s.ticks - first.ticks) % (1 << 32) - (s.sequence - first.sequence) * wanted
        for s in samples
    ]
    half = len(late) // 2
    drift = (min(late[half:]) - min(late[:half])) / half
    if abs(drift) > RATE_ERROR * wanted + 0.2 * wanted / half:
        raise Failed(
            f"at {rate_mhz} mHz a cycle takes {wanted + drift:.1f} ticks instead of {wanted:.1f}"
        )


def _refuses_gains(board: Board) -> str:
    host = board.host
    absent = next(n for n in range(255) if n not in {a.array for a in board.descriptor.arrays})
    for what, make in (
        ("of an array that it lacks", _gain(absent, 5, 0, 0, 2)),
        ("with gain 255", _gain(255, 255, 0, 0, 2)),
        ("with resolution 255", _gain(255, 5, 255, 0, 2)),
        ("with oversampling 255", _gain(255, 5, 0, 255, 2)),
        ("with filter 255", _gain(255, 5, 0, 0, 255)),
    ):
        said = host.command(make)
        require_refusal(said, f"Set gain {what}")
    if host.identify() != board.descriptor:
        raise Failed("a refused gain changed the descriptor")
    return ""


def _refuses_gains_too_slow_for_the_rate(board: Board) -> str:
    if not _mlx(board):
        raise Skipped("its chips are not known here")
    host = board.host
    require_ok(host.command(_rate(board.default_mhz)), "Set rate")
    if board.default_mhz < 15_000:
        raise Skipped("its default rate is slow enough for every filter")
    require_refusal(host.command(_gain(255, 5, 0, 3, 7)), "a filter of 0.2 s")
    return ""


def _sets_gain(board: Board) -> str:
    host = board.host
    if not _mlx(board):
        raise Skipped("its chips are not known here")
    said = host.command(_gain(255, 7, 0, 0, 2))
    if said is AckResult.BAD_ARGUMENT:
        raise Skipped("its gain cannot be set")
    require_ok(said, "Set gain 7")
    d = host.identify()
    for a in d.arrays:
        if (a.lsb_xy_nt, a.lsb_z_nt) != LSB_NT[7]:
            raise Failed(f"array {a.array} has {a.lsb_xy_nt}/{a.lsb_z_nt} nT after gain 7: 150/242")
    require_ok(host.command(_gain(d.arrays[0].array, 5, 0, 0, 2)), "Set gain of one array")
    changed = host.identify()
    got = [(a.lsb_xy_nt, a.lsb_z_nt) for a in changed.arrays]
    if got != [LSB_NT[5], *[LSB_NT[7]] * (len(got) - 1)]:
        raise Failed(f"after gain 5 of array {d.arrays[0].array} the scales are {got} nT")
    board.descriptor = changed
    host.samples(3, board.patience)
    return ""


def _mlx(board: Board) -> bool:
    return all(a.chip is ChipType.MLX90393 for a in board.descriptor.arrays)


def _stops_and_goes_on(board: Board) -> str:
    host = board.host
    before = host.samples(2, board.patience)[-1].sequence
    require_ok(host.command(Stop), "Stop")
    require_ok(host.command(Stop), "a second Stop")
    host.listen(0.2)  # what was still on its way
    mark = len(host.heard)
    host.listen(max(0.3, min(3.0, 3000 / board.default_mhz)))
    if host.all_samples(mark):
        raise Failed("it streams after Stop")
    if host.status().rate_mhz:
        raise Failed("its status gives a rate while it is stopped")
    last = host.all_samples()[-1].sequence
    mark = len(host.heard)
    require_ok(host.command(Start), "Start")
    host.samples(2, board.patience)
    resumed = host.all_samples(mark)[0].sequence
    status = host.status()
    if not before <= last < resumed <= last + 1 + status.overruns:
        raise Failed(f"sequence went from {last} before Stop to {resumed} after Start")
    return ""


def _refuses_unknown_commands(board: Board) -> str:
    host = board.host
    before = host.status().rx_errors
    request = host.next_request()
    mark = len(host.heard)
    host.send_raw(UNKNOWN_COMMAND, request.to_bytes(2, "little") + b"new")
    if not host.listen(ANSWER_S, lambda: host.ack(request, mark) is not None):
        raise Failed("a command of a newer version was not answered")
    ack = host.ack(request, mark)
    assert ack is not None
    if ack.command != UNKNOWN_COMMAND:
        raise Failed(f"the ack names command {ack.command:02X}h")
    require_refusal(ack.result, "a command of a newer version", AckResult.UNKNOWN_COMMAND)
    mark = len(host.heard)
    host.send_raw(OTHER_BOARDS_TYPE, b"\x01\x02")
    host.listen(0.3)
    if host.messages(Ack, mark):
        raise Failed("it answers a message that only boards send")
    status = host.status()
    if status.rx_errors < before + 2:
        raise Failed("messages that it does not know are not counted in rx_errors")
    return ""


def _reads_longer_commands(board: Board) -> str:
    host = board.host
    request = host.next_request()
    mark = len(host.heard)
    host.send_raw(0x82, request.to_bytes(2, "little") + bytes(range(1, 101)))
    if not host.listen(ANSWER_S, lambda: host.ack(request, mark) is not None):
        raise Failed("Start with the fields of a newer version was not answered")
    ack = host.ack(request, mark)
    assert ack is not None
    require_ok(ack.result, "Start with the fields of a newer version")
    return ""


def _counts_what_it_refuses(board: Board) -> str:
    host = board.host
    host.identify()
    before = host.status().rx_errors
    n = _send_rubbish_can(host) if host.on_can else _send_rubbish(host)
    host.identify()
    host.status()
    grown = host.status().rx_errors - before
    if grown != n:
        raise Failed(f"{n} frames had to be refused; rx_errors grew by {grown}")
    return f"{n} frames"


def _send_rubbish(host: Host) -> int:
    start = pack(Start(1))
    good = encode_serial(Start(1))
    frames = [
        cobs.encode(start[:-1] + bytes([start[-1] ^ 1])) + b"\0",  # CRC
        cobs.encode(start[:5]) + b"\0",  # runt
        b"\x09\x01\x02\0",  # COBS
        good[: len(good) // 2] + b"\0",  # half a command
        cobs.encode(_packet(0x82, 0, b"\1\0", 3)) + b"\0",  # length
        cobs.encode(_packet(0x82, 5, b"\1\0")) + b"\0",  # another board's
        cobs.encode(_packet(0x84, 0, b"\1\0")) + b"\0",  # Set rate without a rate
        b"\x55" * 1100 + b"\0",  # no frame is that long
    ]
    for frame in frames:
        host.send_bytes(frame)
        host.listen(0.02)
    host.send_bytes(b"\0" * 10)  # an idle line is not an error
    return len(frames)


def _packet(kind: int, board: int, payload: bytes, length: int | None = None) -> bytes:
    size = len(payload) if length is None else length
    body = bytes([kind, board]) + size.to_bytes(2, "little") + payload
    return body + crc32c(body).to_bytes(4, "little")


def _send_rubbish_can(host: Host) -> int:
    node = host.node or 0
    can_id = _identifier(0x82, node)
    start = _packet(0x82, node, b"\1\0")
    broken = start[:-1] + bytes([start[-1] ^ 1])
    fd = host.fd
    transfers = [
        segment(broken, can_id, 7, fd),  # CRC
        segment(_packet(0x83, node, b"\1\0"), can_id, 9, fd),  # type of another identifier
        segment(_packet(0x82, 100, b"\1\0"), can_id, 11, fd),  # another board's
        segment(_packet(0x84, node, b"\1\0"), _identifier(0x84, node), 13, fd),  # too short
        (CanFrame(can_id, bytes(7) + b"\x0d", False),),  # a transfer whose start was not seen
    ]
    for frames in transfers:
        host.transport.write(frames)
        host.listen(0.02)
    return len(transfers)


def _survives_a_flood(board: Board) -> str:
    host = board.host
    before = host.status().rx_errors
    mark = len(host.heard)
    polls = [ClockPoll(0xF100D000 + n) for n in range(FLOOD)]
    if host.on_can:
        for poll in polls:
            host.send(poll)
    else:
        host.send_bytes(b"".join(encode_serial(p) for p in polls))
    host.listen(1.0)
    host.identify()
    host.status()
    refusals = host.status().rx_errors - before
    tokens = [
        h.message.token
        for h in host.messages(ClockReply, mark)
        if isinstance(h.message, ClockReply)
    ]
    if len(set(tokens)) != len(tokens) or tokens != sorted(tokens):
        raise Failed("replies come twice or in another order")
    if not tokens:
        raise Failed(f"none of {FLOOD} polls was answered")
    if len(tokens) + refusals < FLOOD:
        lost = FLOOD - len(tokens) - refusals
        raise Failed(f"{lost} of {FLOOD} polls were neither answered nor counted in rx_errors")
    return f"{len(tokens)} of {FLOOD} polls answered, {refusals} counted as refused"


def _counts_what_it_drops(board: Board) -> str:
    host = board.host
    require_ok(host.command(Stop), "Stop")
    host.listen(0.3)
    host.status()
    status = host.status()
    got = sorted({s.sequence for s in host.all_samples(board.starts[0])})
    missing = got[-1] + 1 - len(got)
    if missing > status.overruns:
        raise Failed(f"{missing} cycles never came; its overruns say {status.overruns}")
    if not got[-1] < status.cycles <= got[-1] + 1 + status.overruns:
        raise Failed(f"{got[-1] + 1} cycles by sequence; its status says {status.cycles}")
    require_ok(host.command(Start), "Start")
    return f"{len(got)} cycles, {missing} missing, {status.overruns} told"


def _forgets_with_a_reset(board: Board) -> str:
    changed = board.descriptor
    require_ok(board.host.command(_rate(max(1, changed.max_rate_mhz // 2))), "Set rate")
    _comes_back_after_reboot(board)
    mark = len(board.host.heard)
    require_ok(board.host.command(Start), "Start")
    board.host.samples(1, board.patience)
    first = board.host.all_samples(mark)[0].sequence
    status = board.host.status()
    if first > status.overruns:
        raise Failed(f"its sequence begins with {first}")
    if status.rate_mhz != board.default_mhz:
        raise Failed(f"its rate is {status.rate_mhz} mHz instead of {board.default_mhz}")
    require_ok(board.host.command(Stop), "Stop")
    return ""


def _writes_well_formed_messages(board: Board) -> str:
    wrong = board.host.refusals()
    if wrong:
        raise Failed(", ".join(f"{n} {reason}" for reason, n in wrong.items()))
    logs = [h.message for h in board.host.messages(Log) if isinstance(h.message, Log)]
    return f"{len(board.host.heard)} messages, {len(logs)} of them log lines"


CHECKS: tuple[tuple[str, Check], ...] = (
    ("describes itself", _describes_itself),
    ("answers Identify of another major version alike", _answers_other_majors),
    ("Reboot is acknowledged and told by the next status", _comes_back_after_reboot),
    ("says its status every second, unasked", _says_status_unasked),
    ("streams nothing before Start", _is_silent_until_start),
    ("streams from sequence 0 on after a reset", _begins_at_sequence_0),
    ("sends every array of a cycle, in order", _sends_whole_cycles),
    ("neither sequence nor ticks go back", _keeps_to_its_sequence_and_ticks),
    ("reads all of its chips", _reads_its_chips),
    ("obeys Start while streaming", _obeys_start_while_streaming),
    ("answers Identify while streaming", _identifies_while_streaming),
    ("answers clock polls with a clock of tick_hz", _answers_clock_polls),
    ("refuses rates of 0 and above its highest", _refuses_rates),
    ("keeps the rates that it takes", _keeps_rates),
    ("refuses gains that it lacks, and changes nothing", _refuses_gains),
    ("refuses gains too slow for its rate", _refuses_gains_too_slow_for_the_rate),
    ("sets gain and tells the scales", _sets_gain),
    ("stops, and goes on with the next sequence", _stops_and_goes_on),
    ("refuses unknown commands by name, and counts them", _refuses_unknown_commands),
    ("reads commands of newer minor versions", _reads_longer_commands),
    ("counts frames that it refuses, and only those", _counts_what_it_refuses),
    ("survives a flood of clock polls", _survives_a_flood),
    ("counts every cycle that it drops", _counts_what_it_drops),
    ("forgets settings and counters with a reset", _forgets_with_a_reset),
    ("writes well-formed messages only", _writes_well_formed_messages),
)


def check(host: Host) -> Iterator[tuple[str, str, str]]:
    """Run all checks; yield title, verdict (``pass``, ``skip`` or ``FAIL``) and finding of each.

    `Unreachable` when no board answers, or when it stops answering.
    """
    host.send(Stop(host.next_request()))
    try:
        host.listen(0.3)
        host.forget_refusals()
        descriptor = host.identify()
    except Failed as error:
        raise Unreachable(
            f"no board answers at {host.transport.name}: see that it is a board of this protocol, "
            "powered, at the baud or bit rate that was given"
        ) from error
    board = Board(host, descriptor)
    for title, demand in CHECKS:
        if demand is _begins_at_sequence_0:
            board.starts.append(len(host.heard))
        try:
            yield title, "pass", demand(board)
        except Failed as error:
            yield title, "FAIL", str(error)
        except Skipped as error:
            yield title, "skip", str(error)
        except TransportError as error:
            raise Unreachable(f"during the check “{title}”: {error}") from error


def run(options: argparse.Namespace) -> int:
    """Judge one board and print a line per check."""
    try:
        host = connect(options)
    except ValueError as error:
        print(f"tactile board-check: {error}", file=sys.stderr)
        return USAGE
    except (TransportError, Unreachable) as error:
        print(f"tactile board-check: {error}", file=sys.stderr)
        return ENVIRONMENT
    counts = {"pass": 0, "skip": 0, "FAIL": 0}
    try:
        for title, verdict, found in check(host):
            counts[verdict] += 1
            print(f"{verdict}  {title}{': ' if found else ''}{found}", flush=True)
    except Unreachable as error:
        print(f"tactile board-check: {error}", file=sys.stderr)
        return ENVIRONMENT
    finally:
        host.transport.close()
    print(f"{counts['pass']} passed, {counts['FAIL']} failed, {counts['skip']} skipped")
    return FAILED if counts["FAIL"] else DONE


def connect(options: argparse.Namespace) -> Host:
    """Open the port and find the board; ValueError for a bad argument."""
    if options.node is not None and (options.can is None or not 0 <= options.node < BROADCAST):
        raise ValueError(
            f"--node {options.node}: a number from 0 to 126 on a CAN bus, given with --can"
        )
    if options.baud <= 0:
        raise ValueError(f"--baud {options.baud}: give a positive number of bit/s")
    if options.can is None:
        host = Host(SerialTransport(options.port, options.baud))
        host.transport.open()
        return host
    bus = CanTransport(options.can)
    host = Host(bus, options.node, bus.spec.fd, bus.spec.bitrate or DEFAULT_BITRATE)
    bus.open()
    if options.node is None:
        found = host.nodes()
        if len(found) != 1:
            bus.close()
            raise Unreachable(
                f"boards {', '.join(map(str, sorted(found)))} answer; name one with --node"
                if found
                else f"no board answers on {options.can}: see that it is powered, and the bit rate"
            )
        host.set_node(next(iter(found)))
    return host
