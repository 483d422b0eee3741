"""Broken chips: how each fault changes a reading."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from sensor_proto.packets import TaxelStatus
from sim_device.faults import FaultPlan
from sim_device.skin.chips import Reading
from sim_device.skin.damage import BrokenTaxels

TAXELS = {"left": 2, "skin": 3}
COUNTS = np.array([[100, 200, 300], [9, 8, 7], [-5, 40, 9000], [1, 2, -8000], [7, 7, 7]], np.int16)
"""Taxels, in order: left 0 and 1, skin 0, 1 and 2."""


def reading(number: int = 0) -> Reading:
    """Reading number ``number``; no two are alike."""
    counts = COUNTS + np.int16(number)
    return Reading(counts, np.zeros(5, np.uint8), np.full(5, 27.0))


def broken_reading(faults: str, seconds: float = 1.0) -> Reading:
    """First reading under a plan."""
    return BrokenTaxels(FaultPlan.parse(faults), TAXELS).apply(reading(), seconds)


Check = Callable[[NDArray[np.int16]], bool]


@pytest.mark.parametrize(
    ("faults", "row", "right"),
    [
        ("zeros=skin:0", 2, lambda counts: not counts.any()),
        ("ones=skin:1", 3, lambda counts: (counts == -1).all()),
        ("rail=skin:0", 2, lambda counts: counts.tolist() == [-5, 40, 32767]),
        ("rail=skin:1", 3, lambda counts: counts.tolist() == [1, 2, -32768]),
        ("wrap=skin:0", 2, lambda counts: counts.tolist() == [-5, 40, 30767]),
        ("wrap=skin:1", 3, lambda counts: counts.tolist() == [1, 2, -30767]),
        ("jump=skin:1", 3, lambda counts: counts.tolist() == [24001, 24002, 16000]),
        ("twin=skin:1", 3, lambda counts: counts.tolist() == COUNTS[2].tolist()),
    ],
)
def test_only_the_chosen_chip_is_broken(faults: str, row: int, right: Check) -> None:
    out = broken_reading(faults)
    assert right(out.counts[row])
    others = np.arange(5) != row
    assert (out.counts[others] == COUNTS[others]).all()
    assert not out.status.any()  # nothing is flagged


def test_press_takes_a_wrapping_chip_across_the_wrap() -> None:
    broken = BrokenTaxels(FaultPlan.parse("wrap=skin:0"), TAXELS)
    broken.apply(reading(), 1.0)
    pressed = reading()
    pressed.counts[2, 2] += 2500
    assert broken.apply(pressed, 1.1).counts[2, 2] == 30767 + 2500 - 65536


def test_dithering_chip_changes_only_its_last_bits() -> None:
    broken = BrokenTaxels(FaultPlan.parse("dither=left:1"), TAXELS)
    seen = np.array([broken.apply(reading(9 * k), 1.0).counts[1] for k in range(50)])
    assert (np.ptp(seen, axis=0) == 1).all()


def test_thermometer_infinity_and_failed_read_faults() -> None:
    assert broken_reading("hot=left:0").temperature_c.tolist() == [99.0, 27.0, 27.0, 27.0, 27.0]
    infinite = broken_reading("inf=skin:2").infinite
    assert infinite is not None
    assert infinite.tolist() == [False, False, False, False, True]
    assert broken_reading("failed=left:0").status[0] == TaxelStatus.READ_FAILED


def test_fault_applies_to_all_chips_part_of_the_time() -> None:
    broken = BrokenTaxels(FaultPlan.parse("zeros=skin:*:0.25@1s+9s"), TAXELS)
    zeros = np.array([(broken.apply(reading(), 2.0).counts == 0).all(axis=1) for _ in range(2000)])
    assert not zeros[:, :2].any()
    assert zeros[:, 2:].mean() == pytest.approx(0.25, abs=0.03)
    assert broken.counters["zeros"] == zeros.sum()


def test_stale_readings_repeat_bit_for_bit() -> None:
    broken = BrokenTaxels(FaultPlan.parse("copy@0s+9s"), TAXELS)
    out = [broken.apply(reading(k), 1.0).counts[0, 0] - 100 for k in range(100)]
    old = [k for k in range(100) if out[k] != k]
    assert old == [k for k in range(40, 100) if (k + 1) % 3 == 0]
    assert {k - out[k] for k in old} == {40}
    assert broken.counters["copy"] == len(old)


@pytest.mark.parametrize(
    ("faults", "message"),
    [
        ("zeros=skin:3", "array 'skin' has taxels 0 to 2"),
        ("zeros=palm:*", "there is no array 'palm'; allowed: 'left', 'skin'"),
    ],
)
def test_missing_chips_are_refused(faults: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        BrokenTaxels(FaultPlan.parse(faults), TAXELS)
