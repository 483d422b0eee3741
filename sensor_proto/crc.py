"""CRC-32C (Castagnoli) with numpy, for one packet or many at once.

Reflected polynomial 0x82F63B78, register initialised with ones and inverted at the end (RFC 3720,
appendix B.4). The CRC is linear: it is the xor of a contribution of each byte, which depends on the
byte's distance from the end, and of a constant for the length. A table lookup and a reduction
replace the loop.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

POLYNOMIAL = 0x82F63B78
RESIDUE = 0x48674BC7
"""Result for any packet that is followed by its own CRC, least significant byte first."""

BLOCK = 1040
"""Distances from the end covered by the table (1 MB): a whole packet (`packets.MAX_PACKET`). Longer
data is processed in several blocks."""


def _byte_table() -> NDArray[np.uint32]:
    """Contribution of the last byte, (256,)."""
    table = np.arange(256, dtype=np.uint32)
    for _ in range(8):
        table = np.where(table & 1, (table >> 1) ^ np.uint32(POLYNOMIAL), table >> 1)
    return table.astype(np.uint32)


def _tables() -> tuple[NDArray[np.uint32], NDArray[np.uint32]]:
    """Contributions by distance and byte, flat (BLOCK × 256,), and registers by length, (BLOCK +
    1,).

    A register is the state after that many zero bytes, initialised with ones.
    """
    last = _byte_table()
    table = np.empty((BLOCK, 256), dtype=np.uint32)
    table[0] = last
    seeds = np.empty(BLOCK + 1, dtype=np.uint32)
    seeds[0] = seed = np.uint32(0xFFFFFFFF)
    for distance in range(1, BLOCK):
        before = table[distance - 1]
        table[distance] = last[before & 0xFF] ^ (before >> 8)
    for length in range(1, BLOCK + 1):
        seed = last[seed & 0xFF] ^ (seed >> np.uint32(8))
        seeds[length] = seed
    return table.reshape(-1), seeds


_TABLE, _SEEDS = _tables()
_OFFSETS = np.arange(BLOCK - 1, -1, -1, dtype=np.intp) * 256
_CONSTANTS = ~_SEEDS


def crc32c(data: bytes | bytearray | memoryview) -> int:
    """CRC-32C of ``data`` of any length; 0xE3069283 for ``b"123456789"``."""
    values = np.frombuffer(data, dtype=np.uint8)
    size = len(values)
    if size <= BLOCK:
        if not size:
            return 0
        parts = _TABLE.take(values + _OFFSETS[-size:])
        return int(np.bitwise_xor.reduce(parts) ^ _CONSTANTS[size])
    first = size % BLOCK
    register = int(_SEEDS[first])
    if first:
        register ^= int(np.bitwise_xor.reduce(_TABLE.take(values[:first] + _OFFSETS[-first:])))
    for start in range(first, size, BLOCK):
        # Continuing from a register equals xoring it into the next four bytes.
        block = values[start : start + BLOCK].copy()
        block[:4] ^= np.frombuffer(register.to_bytes(4, "little"), dtype=np.uint8)
        register = int(np.bitwise_xor.reduce(_TABLE.take(block + _OFFSETS)))
    return register ^ 0xFFFFFFFF


def crc32c_each(packets: Sequence[bytes]) -> NDArray[np.uint32]:
    """CRC-32C of each packet, (k,).

    Raises ValueError for an empty packet or one longer than `BLOCK`.
    """
    sizes = np.fromiter(map(len, packets), dtype=np.intp, count=len(packets))
    if not len(sizes):
        return np.empty(0, dtype=np.uint32)
    smallest, largest = int(sizes.min()), int(sizes.max())
    if smallest < 1 or largest > BLOCK:
        raise ValueError(f"packets must hold 1 to {BLOCK} bytes each, not {smallest} to {largest}")
    values = np.frombuffer(b"".join(packets), dtype=np.uint8)
    if smallest == largest:
        index = values.reshape(len(sizes), largest) + _OFFSETS[-largest:]
        parts: NDArray[np.uint32] = np.bitwise_xor.reduce(_TABLE.take(index), axis=1)
        parts ^= _CONSTANTS[largest]
        return parts
    ends = np.cumsum(sizes)
    distance = np.repeat(ends - 1, sizes)
    distance -= np.arange(len(values))
    distance <<= 8
    distance += values
    parts = np.bitwise_xor.reduceat(_TABLE.take(distance), ends - sizes)
    parts ^= _CONSTANTS.take(sizes)
    return parts
