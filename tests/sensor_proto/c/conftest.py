"""The C headers built for this machine and called through ctypes; compilers and emulators.

``make firmware-test`` sets TACTILE_FIRMWARE=full: as many messages as in docs/firmware.md, fuzzers,
emulators. Otherwise the tests need gcc and a few seconds. TACTILE_FIRMWARE_JSON=FILE keeps the
measurements there.
"""

from __future__ import annotations

import ctypes
import json
import os
import platform
import shutil
import subprocess
from collections.abc import Callable, Iterator, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sensor_proto.can_transfers import CanFrame
from sensor_proto.packets import (
    Ack,
    ArrayDescriptor,
    ChipType,
    ClockPoll,
    ClockReply,
    Descriptor,
    Identify,
    Log,
    Message,
    Reboot,
    Samples,
    SetGain,
    SetRate,
    Start,
    Status,
    Stop,
    message_type,
)
from tactile_core.types import Instant
from tactile_tools import board_check
from tactile_tools.board_check import Host
from tactiled.blocks import Chunk
from tactiled.transports.base import Medium
from tests.support.paths import ROOT

C = ROOT / "sensor_proto" / "c"
FULL = os.environ.get("TACTILE_FIRMWARE") == "full"

WARNINGS = [
    "-Wall",
    "-Wextra",
    "-Wpedantic",
    "-Wconversion",
    "-Wsign-conversion",
    "-Wshadow",
    "-Wundef",
    "-Wcast-qual",
    "-Werror",
]
STRICT_C = ["-Wstrict-prototypes", "-Wmissing-prototypes"]

PACKAGES = {
    "gcc": "gcc",
    "g++": "g++",
    "clang": "clang libclang-rt-14-dev",
    "arm-none-eabi-gcc": "gcc-arm-none-eabi libnewlib-arm-none-eabi",
    "avr-gcc": "gcc-avr avr-libc",
    "qemu-system-arm": "qemu-system-arm",
}
"""Debian package of each program."""

EVENTS = [
    "nothing",
    "accepted",
    "cobs",
    "oversized",
    "runt",
    "length",
    "crc",
    "board",
    "type_mismatch",
    "unknown_type",
    "short_payload",
    "bad_value",
    "empty",
    "foreign",
    "error_frame",
    "bad_frame",
    "no_start",
    "interrupted",
    "out_of_order",
    "duplicate",
]
"""Names of `enum tp_event`, as in PROTOCOL.md section 8."""


def tool(name: str) -> str:
    """Path of a program; if it is missing, the test is skipped with a hint what to install."""
    found = shutil.which(name)
    if found is None:
        pytest.skip(f"{name} is not here: apt-get install {PACKAGES[name]}")
    return found


@pytest.fixture(scope="session")
def need() -> Callable[[str], str]:
    return tool


@pytest.fixture(scope="session")
def full() -> bool:
    return FULL


@pytest.fixture
def long_run() -> None:
    if not FULL:
        pytest.skip("takes minutes or an emulator: make firmware-test")


class Notes(dict[str, Any]):
    """Measurements for docs/results/firmware.json."""


@pytest.fixture(scope="session")
def notes() -> Iterator[Notes]:
    kept = Notes()
    yield kept
    name = os.environ.get("TACTILE_FIRMWARE_JSON")
    if name and kept:
        path = Path(name)
        old = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
        told = {
            **old,
            **kept,
            "date": datetime.now(UTC).date().isoformat(),
            "machine": f"{platform.machine()}, {os.cpu_count()} cores",
        }
        path.write_text(json.dumps(told, indent=2, ensure_ascii=False) + "\n", encoding="utf-8")


@pytest.fixture(scope="session")
def build(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    """``build(out, source, *flags, compiler="gcc")``: build a program or library."""
    folder = tmp_path_factory.mktemp("firmware")

    def run(out: str, source: str | Path, *flags: str, compiler: str = "gcc") -> Path:
        target = folder / out
        words = [tool(compiler), *flags, "-I", str(C), str(C / source), "-o", str(target)]
        done = subprocess.run(words, capture_output=True, text=True, check=False)
        assert done.returncode == 0, f"{' '.join(words)}\n{done.stderr}"
        return target

    return run


def fields(message: Message) -> tuple[int, list[int], bytes]:
    """Type, numbers and bytes of ``message`` in the form of the bridge."""
    kind = int(message_type(message))
    match message:
        case Descriptor():
            numbers = [message.major, message.minor, message.tick_hz, message.max_rate_mhz]
            numbers.append(len(message.arrays))
            text = message.unique_id + _name(message.model) + _name(message.firmware)
            for a in message.arrays:
                numbers += [a.array, a.chip, a.rows, a.columns]
                numbers += [a.pitch_um, a.lsb_xy_nt, a.lsb_z_nt]
                text += _name(a.name)
            return kind, numbers, text
        case Samples():
            numbers = [message.array, len(message.status), message.temperature_cc]
            numbers += [message.sequence, message.ticks]
            return kind, numbers + message.field.ravel().tolist() + message.status.tolist(), b""
        case Status():
            uptime = message.uptime_ms
            numbers = [uptime & 0xFFFF_FFFF, uptime >> 32, message.cycles, message.overruns]
            numbers += [message.rx_errors, message.chip_errors]
            return kind, [*numbers, message.rate_mhz, message.reset_cause], b""
        case ClockReply():
            return kind, [message.token, message.ticks_received, message.ticks_sent], b""
        case Log():
            text = message.text.encode()
            return kind, [message.level, len(text), message.ticks], text
        case Ack():
            return kind, [message.command, message.result, message.request], b""
        case Identify():
            return kind, [message.request, message.major, message.minor], b""
        case SetRate():
            return kind, [message.request, message.rate_mhz], b""
        case SetGain():
            numbers = [message.request, message.array, message.gain, message.resolution]
            return kind, [*numbers, message.oversampling, message.filter], b""
        case ClockPoll():
            return kind, [message.token], b""
        case Start() | Stop() | Reboot():
            return kind, [message.request], b""
    raise TypeError(type(message).__name__)


def _name(text: str) -> bytes:
    return text.encode("ascii").ljust(16, b"\0")


class Codec:
    """The C codec: `encode` and `decode` one message, `Receiver` and `segment` for streams."""

    def __init__(self, library: ctypes.CDLL) -> None:
        self._c = library
        library.bridge_crc.restype = ctypes.c_uint32
        library.bridge_receiver.restype = ctypes.c_void_p

    @staticmethod
    def fields(message: Message) -> tuple[int, list[int], bytes]:
        return fields(message)

    def crc(self, data: bytes) -> int:
        return int(self._c.bridge_crc(data, ctypes.c_size_t(len(data))))

    def encode(self, message: Message, stuffed: bool, board: int = 0, room: int = 1100) -> bytes:
        kind, numbers, text = fields(message)
        v = (ctypes.c_int64 * max(len(numbers), 1))(*numbers)
        out = ctypes.create_string_buffer(room)
        n = self._c.bridge_encode(kind, board, v, text, int(stuffed), out, room)
        return out.raw[:n]

    def decode(self, kind: int, payload: bytes, like: Message) -> tuple[str, list[int], bytes]:
        """Decode: result, numbers and bytes; as many as ``like`` has."""
        _, numbers, text = fields(like)
        v = (ctypes.c_int64 * 600)()
        blob = ctypes.create_string_buffer(320)
        said = self._c.bridge_decode(kind, payload, len(payload), v, blob)
        return EVENTS[said], v[: len(numbers)], blob.raw[: len(text)]

    def segment(self, packet: bytes, fd: bool, transfer: int) -> list[tuple[int, bytes]]:
        frames = []
        identifier = ctypes.c_uint32()
        data = ctypes.create_string_buffer(64)
        for k in range(-(-len(packet) // (63 if fd else 7))):
            n = self._c.bridge_segment(
                packet, len(packet), k, int(fd), transfer, ctypes.byref(identifier), data
            )
            frames.append((identifier.value, data.raw[:n]))
        return frames

    def receiver(self, slots: int = 40, hold: int = 1040) -> Receiver:
        return Receiver(self._c, slots, hold)


class Receiver:
    """Receivers of both media. `counters`: named as in PROTOCOL.md section 8."""

    def __init__(self, library: ctypes.CDLL, slots: int, hold: int) -> None:
        self._c = library
        self._r = ctypes.c_void_p(library.bridge_receiver(slots, hold))
        self._counts = (ctypes.c_uint32 * len(EVENTS))()

    def __del__(self) -> None:
        self._c.bridge_receiver_free(self._r)

    @property
    def counters(self) -> dict[str, int]:
        return dict(zip(EVENTS, self._counts, strict=True))

    def serial(self, data: bytes) -> list[bytes]:
        """Return header and payload of every packet that ended in ``data``."""
        out = ctypes.create_string_buffer(3 * len(data) + 2200)
        n = self._c.bridge_serial_feed(self._r, data, len(data), self._counts, out)
        return _split(out.raw[:n])

    def can(self, identifier: int, data: bytes, fd: bool) -> list[bytes]:
        out = ctypes.create_string_buffer(2200)
        n = self._c.bridge_can_feed(
            self._r, ctypes.c_uint32(identifier), data, len(data), int(fd), self._counts, out
        )
        return _split(out.raw[:n])


def _split(raw: bytes) -> list[bytes]:
    packets = []
    while raw:
        n = int.from_bytes(raw[:2], "little")
        packets.append(raw[2 : 2 + n])
        raw = raw[2 + n :]
    return packets


@pytest.fixture(scope="session")
def library(build: Callable[..., Path]) -> ctypes.CDLL:
    return load(build, "serial")


@pytest.fixture(scope="session")
def can_library(build: Callable[..., Path]) -> ctypes.CDLL:
    return load(build, "can", "-DBOARD_CAN=1")


def load(build: Callable[..., Path], name: str, *flags: str) -> ctypes.CDLL:
    words = ["-std=c99", "-O1", "-g", "-fPIC", "-shared", *WARNINGS, *STRICT_C, *flags]
    return ctypes.CDLL(str(build(f"bridge-{name}.so", "test/bridge.c", *words)))


@pytest.fixture(scope="session")
def codec(library: ctypes.CDLL) -> Codec:
    return Codec(library)


RANDOM_TYPES = (
    Descriptor,
    Samples,
    Status,
    ClockReply,
    Log,
    Ack,
    Identify,
    Start,
    Stop,
    SetRate,
    SetGain,
    ClockPoll,
    Reboot,
)


def random_message(rng: np.random.Generator, kind: type) -> Message:
    """Random message of type ``kind`` with any valid values, often extreme ones."""

    def number(bits: int) -> int:
        top = (1 << bits) - 1
        if rng.random() < 0.2:
            return [0, 1, top, top - 1, 1 << (bits - 1)][int(rng.integers(0, 5))]
        return int(rng.integers(0, top, endpoint=True, dtype=np.uint64))

    def text(most: int) -> str:
        return "".join(map(chr, rng.integers(0x20, 0x7F, rng.integers(0, most + 1))))

    if kind is Descriptor:
        numbers = rng.permutation(256)[: rng.integers(1, 17)]
        return Descriptor(
            1,
            number(8),
            rng.bytes(8),
            text(15),
            text(15),
            number(32) or 1,
            number(32) or 1,
            tuple(
                ArrayDescriptor(
                    int(n),
                    text(15),
                    ChipType(int(rng.integers(0, 2))),
                    int(rng.integers(1, 12)),
                    int(rng.integers(1, 12)),
                    *(number(32) or 1 for _ in range(3)),
                )
                for n in numbers
            ),
        )
    if kind is Samples:
        n = int(rng.integers(1, 129))
        field = rng.integers(-32768, 32767, (n, 3), np.int16, endpoint=True)
        field[rng.random((n, 3)) < rng.random()] = 0
        status = rng.integers(0, 8, n).astype(np.uint8)
        temperature = int(rng.integers(-32768, 32768))
        return Samples(number(8), number(32), number(32), temperature, field, status)
    if kind is Status:
        return Status(number(64), *(number(32) for _ in range(5)), number(8))
    if kind is Log:
        line = text(int(rng.choice([3, 40, 255]))) + str(rng.choice(["", "µT", "é"]))
        return Log(number(8), number(32), line if len(line.encode()) <= 255 else line[:250])
    if kind is Ack:
        return Ack(number(8), number(16), int(rng.integers(0, 5)))  # type: ignore[arg-type]
    sizes: dict[type, Sequence[int]] = {
        ClockReply: (32, 32, 32),
        Identify: (16, 8, 8),
        SetRate: (16, 32),
        SetGain: (16, 8, 8, 8, 8, 8),
        ClockPoll: (32,),
    }
    return kind(*(number(bits) for bits in sizes.get(kind, (16,))))  # type: ignore[no-any-return]


@pytest.fixture(scope="session")
def draw() -> Callable[[int, int], list[Message]]:
    """``draw(count, seed)``: random messages of all types in turn."""

    def messages(count: int, seed: int) -> list[Message]:
        rng = np.random.default_rng([seed, 0])
        return [random_message(rng, RANDOM_TYPES[i % len(RANDOM_TYPES)]) for i in range(count)]

    return messages


class CBoard:
    """Reference board in C on a simulated line; `receive` and `tick` as in simulated boards.

    Time is that of the host's instants, from 1 ms on, in whole µs; ``room``: bytes (on CAN: frames)
    that the line takes per poll.
    """

    def __init__(self, library: ctypes.CDLL, node: int | None = None, fd: bool = False) -> None:
        self._c = library
        self._can = node is not None
        library.bench_new.restype = ctypes.c_void_p
        self._t = ctypes.c_void_p(library.bench_new(node or 0, int(fd)))
        assert self._t.value
        self._in = b""
        self.room = 1 << 16

    def __del__(self) -> None:
        self._c.bench_free(self._t)

    def receive(self, data: bytes | Sequence[CanFrame], now: Instant) -> None:
        del now
        if isinstance(data, bytes):
            self._in += data
            return
        for f in data:
            self._in += f.identifier.to_bytes(4, "little") + bytes([f.fd, len(f.data)]) + f.data

    def tick(self, now: Instant) -> bytes | tuple[CanFrame, ...]:
        out = ctypes.create_string_buffer(1 << 16)
        us = ctypes.c_uint32(now // 1000 & 0xFFFF_FFFF)
        room = ctypes.c_uint32(self.room)
        n = self._c.bench_poll(self._t, us, room, self._in, len(self._in), out)
        self._in = b""
        data = out.raw[:n]
        return self._frames(data) if self._can else data

    def _frames(self, data: bytes) -> tuple[CanFrame, ...]:
        frames = []
        while data:
            end = 6 + data[5]
            frames.append(CanFrame(int.from_bytes(data[:4], "little"), data[6:end], bool(data[4])))
            data = data[end:]
        return tuple(frames)

    def log(self, level: int, text: str) -> None:
        self._c.bench_log(self._t, level, text.encode())

    def chip(
        self,
        number: int,
        dead: bool = False,
        stuck: bool = False,
        resets: bool = False,
        slow: int = 0,
    ) -> None:
        """Set or clear faults of a modelled chip."""
        self._c.bench_chip(self._t, number, int(dead), int(stuck), int(resets), slow)

    @property
    def counters(self) -> dict[str, int]:
        v = (ctypes.c_uint32 * 7)()
        self._c.bench_counters(self._t, v)
        names = ("cycles", "overruns", "rx_errors", "chip_errors", "reboots", "recoveries", "size")
        return dict(zip(names, v, strict=True))


class VirtualPort:
    """A port with a board in this process at its other end; time passes while it is read."""

    name = "virtual"

    def __init__(self, board: Any, medium: Medium, step_us: int = 500) -> None:
        self.board = board
        self.medium = medium
        self.now = Instant(1_000_000)
        self._step = step_us * 1000

    def open(self) -> None: ...

    def close(self) -> None: ...

    def write(self, data: Any) -> None:
        self.board.receive(data, self.now)

    def read(self, timeout: float) -> Chunk | None:
        end = self.now + round(timeout * 1e9)
        while self.now < end:
            self.now = Instant(self.now + self._step)
            data = self.board.tick(self.now)
            if data:
                return Chunk(self.now, data)
        return None


@pytest.fixture
def c_board(library: ctypes.CDLL) -> CBoard:
    return CBoard(library)


@pytest.fixture
def c_can_board(can_library: ctypes.CDLL) -> Callable[..., CBoard]:
    """``c_can_board(node, fd)``."""
    return lambda node, fd: CBoard(can_library, node, fd)


@pytest.fixture
def judge() -> Callable[..., list[tuple[str, str, str]]]:
    """``judge(board, node, fd)``: results of ``tactile board-check``, in the board's own time."""

    def run(board: Any, node: int | None = None, fd: bool = False) -> list[tuple[str, str, str]]:
        port: Any = VirtualPort(board, Medium.SERIAL if node is None else Medium.CAN)
        return list(board_check.check(Host(port, node, fd, now=lambda: port.now)))

    return run


@pytest.fixture(scope="session")
def ports() -> Path:
    """Folder of the programs for each microcontroller."""
    return C / "ports"
