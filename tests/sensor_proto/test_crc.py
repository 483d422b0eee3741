"""CRC-32C against the published check value, its residue and a bit-by-bit implementation."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sensor_proto.crc import BLOCK, RESIDUE, crc32c, crc32c_each

# RFC 3720, appendix B.4; the first is the check value in CRC catalogues.
PUBLISHED = [
    (b"123456789", 0xE3069283),
    (bytes(32), 0x8A9136AA),
    (b"\xff" * 32, 0x62A8AB43),
    (bytes(range(32)), 0x46DD794E),
    (bytes(range(31, -1, -1)), 0x113FDB5C),
]


@pytest.mark.parametrize(("data", "crc"), PUBLISHED)
def test_crc_matches_published_values(data: bytes, crc: int) -> None:
    assert crc32c(data) == crc
    assert crc32c_each([data, b"x", data]).tolist()[::2] == [crc, crc]


@pytest.mark.parametrize(
    "size", [0, 1, 2, 3, 4, 5, 250, BLOCK - 1, BLOCK, BLOCK + 1, 3 * BLOCK + 2]
)
def test_crc_matches_bitwise_reference_at_any_length(size: int, reference: SimpleNamespace) -> None:
    data = np.random.default_rng(size).bytes(size)
    assert crc32c(data) == reference.crc(data)
    assert crc32c(bytearray(data)) == crc32c(memoryview(data)) == crc32c(data)


@given(st.lists(st.binary(min_size=1, max_size=300), max_size=12))
@settings(max_examples=40, deadline=None)
def test_batch_crc_equals_single_crc(packets: list[bytes]) -> None:
    assert crc32c_each(packets).tolist() == [crc32c(p) for p in packets]


def test_batch_crc_of_equal_lengths_matches_bitwise_reference(reference: SimpleNamespace) -> None:
    rng = np.random.default_rng(1)
    packets = [rng.bytes(246) for _ in range(5)]
    assert crc32c_each(packets).tolist() == [reference.crc(p) for p in packets]


@given(st.binary(max_size=400))
@settings(max_examples=40, deadline=None)
def test_data_with_its_crc_leaves_the_residue(data: bytes) -> None:
    assert crc32c(data + crc32c(data).to_bytes(4, "little")) == RESIDUE == 0x48674BC7


def test_zeros_are_never_their_own_crc() -> None:
    assert all(crc32c(bytes(size)) != 0 for size in range(1, 200))


@pytest.mark.parametrize("packets", [[b""], [b"a", b""], [bytes(BLOCK + 1)]])
def test_misuse_is_refused_with_reason(packets: list[bytes]) -> None:
    with pytest.raises(ValueError, match="1 to"):
        crc32c_each(packets)
