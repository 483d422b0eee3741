"""mlx90393.h on a bus of chips modelled at register level, in simulated fields."""

from __future__ import annotations

import ctypes
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import pytest

from sim_device.board.catalogue import build_skin
from sim_device.skin.environment import Environment
from sim_device.skin.parameters import ChipSetting

SATURATED, STALE, FAILED = 1, 2, 4
SLOWEST_US = 2900
"""Longer than the slowest chip needs for a conversion with filter 3."""


class Rig:
    """Chips on one bus with the driver; each `cycle` converts, waits and reads."""

    def __init__(self, library: ctypes.CDLL, chips: int, spi: bool, pin: bool) -> None:
        self._c = library
        self.chips = chips
        library.rig_new.restype = ctypes.c_void_p
        self._r = ctypes.c_void_p(library.rig_new(chips, int(spi), int(pin)))

    def close(self) -> None:
        self._c.rig_free(self._r)

    def field(self, field_ut: Any, temperature_c: float = 25.0) -> None:
        """Set the field at the chips, (chips, 3) µT."""
        nt = np.rint(1000 * np.asarray(field_ut)).astype(np.int32).ravel().tolist()
        cc = round(100 * temperature_c)
        self._c.rig_field(self._r, (ctypes.c_int32 * len(nt))(*nt), cc)

    def cycle(self, wait_us: int = SLOWEST_US) -> tuple[Any, list[int], float]:
        """Run a cycle; returns counts (chips, 3), status of each chip, mean temperature in °C."""
        v = (ctypes.c_int64 * 40)()
        self._c.rig_cycle(self._r, wait_us, v)
        rows = np.array(v[: 4 * self.chips]).reshape(self.chips, 4)
        return rows[:, :3], rows[:, 3].tolist(), v[4 * self.chips] / 100

    def cycles(self, count: int) -> list[list[int]]:
        """Run cycles; returns the status of each chip for each."""
        return [self.cycle()[1] for _ in range(count)]

    def set(self, setting: Sequence[int], rate_hz: float = 10.0) -> int:
        return int(self._c.rig_set(self._r, *setting, round(rate_hz * 1000)))

    def chip(
        self,
        number: int,
        dead: bool = False,
        stuck: bool = False,
        resets: bool = False,
        slow: int = 0,
    ) -> None:
        self._c.rig_chip(self._r, number, int(dead), int(stuck), int(resets), slow)

    def register(self, chip: int, number: int) -> int:
        return int(self._c.rig_register(self._r, chip, number))

    def flip(self) -> None:
        self._c.rig_flip(self._r, 1)

    def burst(self, interval: int, step_us: int, steps: int) -> list[int]:
        v = (ctypes.c_int64 * steps)()
        assert self._c.rig_burst(self._r, 0, interval, step_us, steps, v) == 0
        return v[:]


@pytest.fixture(params=["i2c", "i2c, no pin", "spi"])
def rig(request: pytest.FixtureRequest, library: ctypes.CDLL) -> Iterator[Rig]:
    made = Rig(library, 5, request.param == "spi", "no pin" not in request.param)
    yield made
    made.close()


@pytest.fixture
def i2c(library: ctypes.CDLL) -> Iterator[Rig]:
    made = Rig(library, 5, False, True)
    yield made
    made.close()


def test_driver_reads_the_field_of_the_simulated_skin(rig: Rig) -> None:
    skin = build_skin("anyskin", 2)
    around = Environment().at(0.0)
    for force in (0.0, 1.0, 5.0):
        on_taxels = np.zeros((5, 3))
        on_taxels[2] = 0.3 * force, 0.0, -force
        seen = skin.field_ut(skin.elastomer.settled(on_taxels), around)
        rig.field(seen, 31.5)
        counts, status, temperature = rig.cycle()
        assert status == [0] * 5
        assert np.abs(counts - seen / ChipSetting(gain=4).lsb_ut).max() < 0.51
        assert temperature == pytest.approx(31.5, abs=0.03)


@pytest.mark.parametrize("resolution", range(4))
@pytest.mark.parametrize("gain", [0, 4, 7])
def test_scales_match_the_datasheet(rig: Rig, gain: int, resolution: int) -> None:
    assert rig.set((gain, resolution, 0, 3)) == 0
    lsb = np.array(ChipSetting(gain, resolution).lsb_ut)
    counts = np.array([[100, -200, 3000], [-9000, 9000, -1], [0, 0, 0], [1, 2, 3], [-5, 6, -7]])
    rig.field(counts * lsb)
    got, status, _ = rig.cycle()
    assert status == [0] * 5
    assert np.abs(got - counts).max() <= 1


def test_registers_match_the_datasheet(rig: Rig) -> None:
    rig.cycle()
    assert rig.set((5, 2, 1, 6)) == 0
    for chip in range(5):
        assert rig.register(chip, 0) & 0x7F == 5 << 4 | 0xC
        assert rig.register(chip, 2) & 0x1FFF == 2 << 9 | 2 << 7 | 2 << 5 | 6 << 2 | 1
        assert rig.register(chip, 1) & 0x8000
        assert rig.register(chip, 1) & 0x6000 in (0x4000, 0x6000)


@pytest.mark.parametrize(("resolution", "limit"), [(0, 32767), (1, 32767), (2, 22000), (3, 11000)])
def test_overrange_is_flagged(rig: Rig, resolution: int, limit: int) -> None:
    rig.set((4, resolution, 0, 3))
    lsb = np.array(ChipSetting(4, resolution).lsb_ut)
    field = np.zeros((5, 3))
    field[1, 0], field[2, 2] = limit * lsb[0], -limit * lsb[2] - (lsb[2] if limit == 32767 else 0)
    field[3, 1] = (limit - 5) * lsb[1]
    rig.field(field)
    assert rig.cycle()[1] == [0, SATURATED, SATURATED, 0, 0]


def test_silent_chip_fails_alone_and_recovers(rig: Rig) -> None:
    rig.field(np.full((5, 3), 300.0))
    rig.cycle()
    rig.chip(3, dead=True)
    assert all(s == [0, 0, 0, FAILED, 0] for s in rig.cycles(5))
    rig.chip(3, resets=True)  # power-cycled: with factory settings
    back = rig.cycles(5)
    assert back[-1] == [0] * 5
    assert np.abs(rig.cycle()[0][3] - 300.0 / np.array(ChipSetting(gain=4).lsb_ut)).max() < 1


def test_chip_that_reset_is_never_read_with_wrong_scale(rig: Rig) -> None:
    rig.field(np.full((5, 3), 600.0))
    wanted = rig.cycle()[0][0]
    rig.chip(0, resets=True)
    failed = 0
    for _ in range(6):
        counts, status, _ = rig.cycle()
        failed += status[0] == FAILED
        if status[0] == 0:
            assert counts[0].tolist() == wanted.tolist()
    assert 1 <= failed <= 3
    assert status == [0] * 5


def test_blocked_bus_is_freed_without_loss(i2c: Rig) -> None:
    i2c.cycle()
    i2c.chip(2, stuck=True)
    assert i2c.cycles(2) == [[0] * 5] * 2


def test_missing_conversion_repeats_last_value_as_stale(i2c: Rig) -> None:
    i2c.field(np.full((5, 3), 90.0))
    before = i2c.cycle()[0]
    i2c.chip(4, slow=30)
    counts, status, _ = i2c.cycle()
    assert status == [0, 0, 0, 0, STALE]
    assert counts.tolist() == before.tolist()
    i2c.chip(4, slow=0)
    assert i2c.cycles(2)[-1] == [0] * 5


def test_slow_or_unknown_settings_are_refused_without_change(rig: Rig) -> None:
    rig.cycle()
    before = [rig.register(0, n) for n in range(3)]
    for bad in ((8, 0, 0, 3), (4, 4, 0, 3), (4, 0, 4, 3), (4, 0, 0, 8)):
        assert rig.set(bad) == 2
    assert rig.set((4, 0, 3, 7), rate_hz=100) == 2
    assert [rig.register(0, n) for n in range(3)] == before
    assert rig.set((4, 0, 3, 7), rate_hz=4) == 0


def test_burst_mode_delivers_each_conversion_once(i2c: Rig) -> None:
    ok, not_ready = 0, 3
    said = i2c.burst(interval=1, step_us=5000, steps=40)  # one conversion per 20 ms
    assert said.count(ok) == pytest.approx(10, abs=1)
    assert set(said) == {ok, not_ready}
    assert i2c.burst(interval=0, step_us=3000, steps=20).count(ok) == 20


def test_flipped_board_is_rotated_about_y(rig: Rig) -> None:
    rig.flip()
    rig.field([[30.0, 60.0, 4840.0]] * 5)
    counts, _, _ = rig.cycle()
    assert counts[0].tolist() == [-100, 200, -10000]
