"""Reference codecs, written from PROTOCOL.md alone and deliberately slow; shared sample makers."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace

import numpy as np
import pytest

from sensor_proto.packets import Samples


def crc_bitwise(data: bytes) -> int:
    register = 0xFFFFFFFF
    for byte in data:
        register ^= byte
        for _ in range(8):
            register = register >> 1 ^ (0x82F63B78 if register & 1 else 0)
    return register ^ 0xFFFFFFFF


def cobs_textbook(data: bytes) -> bytes:
    """Encode one byte at a time, as in figure 3 of Cheshire & Baker."""
    out, block = bytearray(), bytearray()
    ended_full = False
    for byte in data:
        ended_full = False
        if byte:
            block.append(byte)
            if len(block) == 254:
                out += b"\xff" + block
                block.clear()
                ended_full = True
        else:
            out += bytes([len(block) + 1]) + block
            block.clear()
    if not ended_full:
        out += bytes([len(block) + 1]) + block
    return bytes(out)


def packet_of(kind: int, payload: bytes, board: int = 0) -> bytes:
    body = bytes([kind, board, len(payload) & 0xFF, len(payload) >> 8]) + payload
    return body + crc_bitwise(body).to_bytes(4, "little")


def serial_of(packet: bytes) -> bytes:
    return cobs_textbook(packet) + b"\0"


def can_of(packet: bytes, transfer: int, size: int) -> list[bytes]:
    """Data of the CAN frames of ``size`` bytes that carry ``packet``."""
    parts = [packet[i : i + size - 1] for i in range(0, len(packet), size - 1)]
    frames = []
    for i, part in enumerate(parts):
        tail = transfer | (0x20 if i % 2 == 0 else 0)
        tail |= (0x80 if i == 0 else 0) | (0x40 if part is parts[-1] and i == len(parts) - 1 else 0)
        if size == 64:
            while len(part) + 1 not in (1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64):
                part += b"\0"
        frames.append(part + bytes([tail]))
    return frames


@pytest.fixture(scope="session")
def reference() -> SimpleNamespace:
    """Independent codecs: ``crc``, ``cobs``, ``packet``, ``serial``, ``can``."""
    return SimpleNamespace(
        crc=crc_bitwise, cobs=cobs_textbook, packet=packet_of, serial=serial_of, can=can_of
    )


@pytest.fixture(scope="session")
def make_samples() -> Callable[..., Samples]:
    """Samples with realistic counts: ``make_samples(sequence, taxels=32, array=0)``."""

    def make(sequence: int, taxels: int = 32, array: int = 0) -> Samples:
        rng = np.random.default_rng(sequence)
        counts = rng.normal((0, 0, 12000), 300, (taxels, 3)).astype("<i2")
        status = (rng.random(taxels) < 0.05).astype(np.uint8) * 4
        return Samples(array, sequence, sequence * 10_000 % (1 << 32), 2512, counts, status)

    return make


def _same(a: object, b: object) -> bool:
    if isinstance(a, Samples) and isinstance(b, Samples):
        return (
            (a.array, a.sequence, a.ticks, a.temperature_cc)
            == (b.array, b.sequence, b.ticks, b.temperature_cc)
            and np.array_equal(a.field, b.field)
            and np.array_equal(a.status, b.status)
        )
    return a == b


@pytest.fixture(scope="session")
def same() -> Callable[[object, object], bool]:
    """Whether two messages hold the same values, arrays included."""
    return _same
