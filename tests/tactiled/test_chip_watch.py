"""Masked chips are reported in the log with duration and remedy, without flooding it."""

from __future__ import annotations

import logging
from collections.abc import Callable

import numpy as np

from tactile_core.geometry import anyskin, finger
from tactile_core.types import Instant
from tactiled.sensing.reasons import Fault
from tactiled.watch import ChipWatch

HZ = 40


def watch(
    faults: Callable[[int], dict[int, Fault]], seconds: int, chips: ChipWatch | None = None
) -> tuple[ChipWatch, list[tuple[int, int, str]]]:
    """Run a watch; returns it with its reports: second, level and text."""
    chips = chips or ChipWatch(anyskin())
    lines = []
    for k in range(seconds * HZ):
        fault = np.zeros(5, np.uint8)
        for chip, what in faults(k).items():
            fault[chip] = what
        now = Instant(round(k * 1e9 / HZ))
        chips.observe(fault, now)
        if (k + 1) % HZ == 0:
            lines += [((k + 1) // HZ, level, text) for level, text in chips.each_second(now)]
    return chips, lines


def test_dead_chip_is_reported_once_and_shown_while_it_lasts() -> None:
    chips, lines = watch(lambda k: {2: Fault.ZEROS} if k >= 100 else {}, 60)
    (line,) = lines
    assert line[:2] == (3, logging.WARNING)
    assert line[2].startswith("chip 2 of skin reads zero on every axis")
    assert "check its cable" in line[2]
    (shown,) = chips.masked
    assert (shown.array, shown.chip, shown.fault) == ("skin", 2, Fault.ZEROS)
    assert 57 < shown.seconds < 58
    assert shown.share == 1.0
    assert [(one.array, one.chip) for one in chips.masked] == [("skin", 2)]


def test_sporadic_read_failures_are_summed_up_every_ten_seconds() -> None:
    chips, lines = watch(lambda k: {4: Fault.ZEROS} if k % 20 == 0 else {}, 35)
    assert [second for second, _, _ in lines] == [1, 11, 21, 31]
    assert all("in 2 of 40 cycles" in text for _, _, text in lines)
    assert chips.masked[0].share == 0.05


def test_chips_of_an_array_with_the_same_fault_are_reported_together() -> None:
    _, lines = watch(lambda k: dict.fromkeys(range(5), Fault.ZEROS), 3)
    assert len(lines) == 1
    assert "chips 0, 1, 2, 3, 4 of skin" in lines[0][2]


def test_recovered_chip_is_reported_with_its_downtime() -> None:
    chips, lines = watch(lambda k: {1: Fault.FROZEN} if k < 200 else {}, 12)
    assert [(second, level) for second, level, _ in lines] == [
        (1, logging.WARNING),
        (9, logging.INFO),
    ]
    assert "chip 1 of skin reads well again, first masked 5.0 s before" in lines[1][2]
    assert chips.masked == []


def test_missing_array_is_not_reported_as_chips() -> None:
    _, lines = watch(lambda k: dict.fromkeys(range(5), Fault.MISSING), 3)
    assert lines == []


def test_many_chips_are_counted() -> None:
    chips = ChipWatch(finger())
    fault = np.zeros(80, np.uint8)
    fault[:16] = Fault.FAILED
    chips.observe(fault, Instant(0))
    ((_, text),) = chips.each_second(Instant(10**9))
    assert text.startswith("each of 16 chips of left")
    assert len(chips.masked) == 16
