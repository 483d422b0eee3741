"""Row 47 of the fault table: impossible readings are masked, named, and never a force."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from copy import deepcopy
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from tactile_core.calibration.nominal import nominal
from tactile_core.types import Instant
from tactiled.blocks import Cycle, SampleBlock, TaxelHealth
from tactiled.sensing.pipeline import BoardPipeline, PipelineSettings
from tactiled.sensing.reasons import Fault

Float = NDArray[np.float64]

REST = np.array(
    [
        [-1391, 0, -1744],
        [41, -2, -514],
        [266, -788, -1335],
        [1933, 3962, -3840],
        [-577, 219, -1030],
    ],
    float,
)
"""Rest field of a common five-magnetometer finger, µT."""
FINE = np.array([0.15, 0.15, 0.242])
COARSE = np.array([2.4, 2.4, 3.872])
NOISE = np.array([3.7, 3.7, 5.8])
HZ = 100
UT_PER_N = 115.0
STEADY = 150
"""Cycle by which the board has been tared and its scale is known."""

Spoil = Callable[[int, NDArray[np.int64], Float], None]


class Five:
    """A board of five magnetometers that sends floats, and its pipeline."""

    def __init__(
        self,
        spoil: Spoil | None = None,
        rest: Float = REST,
        step: Float = FINE,
        noise: Float = NOISE,
        hz: float = HZ,
        seed: int = 0,
    ) -> None:
        self.spoil, self.rest, self.step, self.noise, self.hz = spoil, rest, step, noise, hz
        self.rng = np.random.default_rng(seed)
        self.pipeline = BoardPipeline(nominal("anyskin", "five", len(rest)), PipelineSettings())
        self.revived: list[tuple[int, int]] = []

    def run(
        self, cycles: int, press: Callable[[int], Float] | None = None, begin: int = 0
    ) -> Iterator[Cycle]:
        """Yield cycles ``begin`` to ``cycles``. ``press``: µT to add to the chips, up to (5, 3), by
        the cycle's number."""
        for k in range(begin, cycles):
            field = self.rest + self.rng.normal(0, 1, self.rest.shape) * self.noise
            if press is not None:
                field = field + press(k)
            counts = np.rint(field / self.step).astype(np.int64)
            temperature = np.round((27 + self.rng.normal(0, 0.05, len(counts))) * 45.2) / 45.2
            if self.spoil is not None:
                self.spoil(k, counts, temperature)
            counts = (counts + 32768) % 65536 - 32768
            sent = (counts * self.step).astype(np.float32).astype(np.float64)
            now = Instant(round(k * 1e9 / self.hz))
            status = np.zeros(len(counts), np.uint8)
            block = SampleBlock(0, k, now, now, 1e-3, sent, temperature, status)
            (cycle,) = self.pipeline.feed(block)
            self.revived += [(k, int(i)) for i in np.flatnonzero(self.pipeline._monitor.revived)]
            yield cycle


@cache
def _steady() -> Five:
    board = Five()
    for k, cycle in enumerate(board.run(STEADY)):
        assert no_force(cycle)
        assert k < 60 or not cycle.fault.any()
    return board


def steady(spoil: Spoil | None = None) -> Five:
    """A board after `STEADY` sound cycles; the first are fed once for all tests."""
    board = deepcopy(_steady())
    board.spoil = spoil
    return board


def chip(number: int, ut: float, axis: int = 2) -> Float:
    """(5, 3) µT, non-zero on one axis of one chip."""
    out = np.zeros((5, 3))
    out[number, axis] = ut
    return out


def ramp(number: int, ut: float, begin: int = 200, length: int = 100) -> Callable[[int], Float]:
    """A press that grows from cycle ``begin``."""
    return lambda k: chip(number, ut * min(1.0, max(0.0, (k - begin) / length)))


def no_force(cycle: Cycle) -> bool:
    """Whether no contact is reported."""
    return cycle.features.taxels_in_contact == 0


ALIKE = {"zero": 0, "minus one": -1, "zero less the offset of 19 bits": -16384}


@pytest.mark.parametrize("count", ALIKE.values(), ids=ALIKE)
@pytest.mark.parametrize("which", [[2], [0, 3], [0, 1, 2, 3, 4]], ids=["one", "two", "all"])
@pytest.mark.parametrize(
    "when",
    [lambda k: k % 3 > 0, lambda k: k % 37 == 0, lambda k: k % 50 < 2],
    ids=["two of three", "single", "bursts"],
)
def test_failed_reads_are_masked_in_each_frame(count, which, when) -> None:
    def spoil(k: int, counts: NDArray[np.int64], temperature: Float) -> None:
        if when(k):
            counts[which] = count
            temperature[which] = 0.0 if count == 0 else 27.0

    expected = Fault.ONES if count else Fault.ZEROS
    for k, cycle in enumerate(steady(spoil).run(400, begin=STEADY), STEADY):
        assert no_force(cycle)
        masked = np.flatnonzero(cycle.fault).tolist()
        assert masked == (which if when(k) else [])
        assert np.isnan(cycle.force[masked]).all()
        if when(k):
            assert (cycle.fault[which] == expected).all()
            assert (cycle.health[which] & TaxelHealth.READ_FAILED).all()


@pytest.mark.parametrize("count", [0, -1])
def test_chip_that_never_answers_is_named_from_the_start(count) -> None:
    def spoil(k: int, counts: NDArray[np.int64], temperature: Float) -> None:
        counts[2], temperature[2] = count, 0.0

    *_, last = Five(spoil).run(120)
    assert last.fault.tolist() == [0, 0, Fault.ONES if count else Fault.ZEROS, 0, 0]
    assert last.features.codes == ("chip_masked:skin",)


def test_chip_that_comes_alive_is_reported_and_used() -> None:
    def spoil(k: int, counts: NDArray[np.int64], temperature: Float) -> None:
        if k < 300:
            counts[2], temperature[2] = 0, 0.0

    board = Five(spoil)
    cycles = list(board.run(600, ramp(2, 800.0, 450, 50)))
    assert board.revived == [(300, 2)]
    assert cycles[310].fault[2] == Fault.UNRESTED
    assert not any(cycle.fault.any() for cycle in cycles[400:])  # it has a rest field by now
    assert cycles[440].features.taxels_in_contact == 0
    assert cycles[-1].features.peak_force == pytest.approx(800 / UT_PER_N, rel=0.1)


def test_chip_that_comes_alive_under_a_press_waits_for_release() -> None:
    def spoil(k: int, counts: NDArray[np.int64], temperature: Float) -> None:
        if k < 300:
            counts[2], temperature[2] = 0, 0.0

    board = Five(spoil)
    press = np.array([0.3, 0.0, 1.0, 0.0, 0.0])[:, None] * [0.0, 0.0, 800.0]
    cycles = list(board.run(700, lambda k: press * (200 <= k < 500)))
    assert all(cycle.fault[2] for cycle in cycles[300:500])
    assert not any(cycle.features.valid for cycle in cycles[210:500])
    assert cycles[-1].fault[2] == 0
    assert cycles[-1].features.taxels_in_contact == 0


@pytest.mark.parametrize(("rest_z", "by"), [(7000.0, 2000.0), (-7000.0, -1500.0), (7500.0, 3500.0)])
def test_wrap_is_undone_when_continuity_proves_it(rest_z, by) -> None:
    rest = REST.copy()
    rest[2, 2] = rest_z
    flat = list(Five(rest=REST).run(400, ramp(2, by)))
    over = list(Five(rest=rest).run(400, ramp(2, by)))
    for k, (there, here) in enumerate(zip(flat, over, strict=True)):
        crossing = here.fault[2] == Fault.RAIL  # the last count looks like a rail
        assert not here.fault.any() or crossing
        if k > STEADY and not crossing:
            assert here.force[2, 2] == pytest.approx(there.force[2, 2], abs=0.2)
            assert here.features.valid == there.features.valid
    assert sum(cycle.fault.any() for cycle in over) <= 3
    assert abs(over[-1].force[2, 2]) > 0.9 * abs(by) / UT_PER_N


def test_ambiguous_wrap_is_masked_and_invalid() -> None:
    rest = REST.copy()
    rest[2, 2] = 7000.0
    press = np.array([0.05, 0.05, 1.0, 0.05, 0.05])[:, None] * [0, 0, 5500.0]
    cycles = list(Five(rest=rest).run(300, lambda k: press * (200 <= k < 230)))
    for cycle in cycles[200:230]:
        assert cycle.fault[2] == Fault.WRAPPED
        assert not cycle.features.valid
        assert "masked_contact:skin" in cycle.features.codes
    assert not cycles[-1].fault.any()
    assert cycles[-1].features.valid


@pytest.mark.parametrize("end", [-32768, 32767])
def test_axis_at_its_rail_is_saturated_and_hides_no_press(end) -> None:
    def spoil(k: int, counts: NDArray[np.int64], temperature: Float) -> None:
        if k >= 200:
            counts[3, 1] = end

    for cycle in list(Five(spoil).run(300))[200:]:
        assert cycle.fault[3] == Fault.RAIL
        assert cycle.health[3] & TaxelHealth.SATURATED
        assert not cycle.features.valid
        assert no_force(cycle)


def test_garbage_of_a_chip_is_masked_while_it_lasts() -> None:
    garbage = np.random.default_rng(4)

    def spoil(k: int, counts: NDArray[np.int64], temperature: Float) -> None:
        if k >= STEADY and k % 10 == 0:
            counts[1] = garbage.integers(11000, 30000, 3) * np.array([1, -1, 1])

    for k, cycle in enumerate(Five(spoil).run(500)):
        if k >= STEADY:
            assert np.flatnonzero(cycle.fault).tolist() == ([1] if k % 10 == 0 else [])
        assert no_force(cycle)


def test_simultaneous_jump_of_all_chips_is_masked() -> None:
    def spoil(k: int, counts: NDArray[np.int64], temperature: Float) -> None:
        if k in (200, 201, 250):
            counts += np.array([30000, -28000, 25000])

    for k, cycle in enumerate(Five(spoil).run(300)):
        assert no_force(cycle)
        if k >= STEADY:
            assert bool(cycle.fault.all()) == (k in (200, 201, 250))


def test_lasting_level_is_accepted_without_its_rest_field() -> None:
    def spoil(k: int, counts: NDArray[np.int64], temperature: Float) -> None:
        if k >= 200:
            counts[1] += np.array([30000, -28000, 25000])

    board = Five(spoil)
    cycles = list(board.run(400))
    assert board.revived
    assert all(no_force(cycle) for cycle in cycles)
    assert cycles[260].fault[1] == Fault.UNRESTED
    assert not cycles[-1].fault.any()  # it has a new rest field, taken while still


def test_chips_with_identical_bits_are_both_masked() -> None:
    def spoil(k: int, counts: NDArray[np.int64], temperature: Float) -> None:
        counts[4] = counts[1]

    for k, cycle in enumerate(Five(spoil).run(200)):
        if k >= 4:
            assert np.flatnonzero(cycle.fault == Fault.SAME_BITS).tolist() == [1, 4]


def test_chip_copying_another_is_masked_at_once() -> None:
    def spoil(k: int, counts: NDArray[np.int64], temperature: Float) -> None:
        if k >= 200:
            counts[0] = counts[3]

    cycles = list(Five(spoil).run(260))
    assert all(no_force(cycle) for cycle in cycles)
    assert all(cycle.fault[0] for cycle in cycles[200:])


@pytest.mark.parametrize("step", [FINE, 4 * FINE], ids=["fine", "coarser"])
def test_copies_of_an_earlier_frame_are_masked(step) -> None:
    kept: list[tuple[NDArray[np.int64], Float]] = []

    def spoil(k: int, counts: NDArray[np.int64], temperature: Float) -> None:
        kept.append((counts.copy(), temperature.copy()))
        if k >= 300 and k % 4 == 0:
            counts[:], temperature[:] = kept[k - 61]

    press = REST * [0.0, 0.0, 0.3]
    cycles = list(Five(spoil, step=step).run(400, lambda k: press * (k >= 270)))
    for k, cycle in enumerate(cycles):
        copied = k >= 300 and k % 4 == 0
        if k >= STEADY:
            assert (cycle.fault == Fault.COPY).all() if copied else not cycle.fault.any()


@pytest.mark.parametrize("which", [[2], [0, 1, 2, 3, 4]], ids=["one", "all"])
@pytest.mark.parametrize("bits", [1, 3], ids=["one bit", "two bits"])
def test_dead_chip_with_toggling_last_bits_is_frozen(which, bits) -> None:
    held: list[NDArray[np.int64]] = []
    toggle = np.random.default_rng(9)

    def spoil(k: int, counts: NDArray[np.int64], temperature: Float) -> None:
        if k == 300:
            held.append(counts[which].copy())
        if k >= 300:
            counts[which] = held[0] + toggle.integers(0, bits + 1, (len(which), 3))

    cycles = list(Five(spoil).run(500))
    assert not any(cycle.fault.any() for cycle in cycles[STEADY:300])
    for cycle in cycles[360:]:
        assert np.flatnonzero(cycle.health & TaxelHealth.FROZEN).tolist() == which


def test_chip_dithering_from_the_start_is_detected_by_comparison() -> None:
    toggle = np.random.default_rng(9)

    def spoil(k: int, counts: NDArray[np.int64], temperature: Float) -> None:
        counts[3] = np.array([5000, -3000, 7000]) + toggle.integers(0, 2, 3)

    *_, last = Five(spoil).run(200)
    assert last.fault.tolist() == [0, 0, 0, Fault.DITHER, 0]


def test_single_stuck_axis_is_detected() -> None:
    def spoil(k: int, counts: NDArray[np.int64], temperature: Float) -> None:
        if k >= 300:
            counts[1, 0] = 277

    cycles = list(Five(spoil).run(400))
    assert cycles[-1].fault.tolist() == [0, Fault.AXIS_STUCK, 0, 0, 0]


def test_implausible_temperature_masks_the_chip() -> None:
    def spoil(k: int, counts: NDArray[np.int64], temperature: Float) -> None:
        if k in (200, 230):
            temperature[4] = {200: 85.0, 230: np.nan}[k]
        if k >= 300:
            temperature[:4] += 0.05 * (k - 300)
            temperature[4] = 27.0

    cycles = list(Five(spoil).run(460))
    assert cycles[200].fault.tolist() == [0, 0, 0, 0, Fault.TEMPERATURE_JUMP]
    assert cycles[230].fault.tolist() == [0, 0, 0, 0, Fault.TEMPERATURE]
    assert not cycles[290].fault.any()
    assert cycles[-1].fault.tolist() == [0, 0, 0, 0, Fault.TEMPERATURE_STUCK]


def test_warming_board_is_never_masked() -> None:
    def spoil(k: int, counts: NDArray[np.int64], temperature: Float) -> None:
        temperature += min(30.0, 0.04 * k)
        if k == 900:
            counts[0] = 0

    found = [cycle.fault.tolist() for cycle in Five(spoil).run(1000)]
    assert found[900] == [Fault.ZEROS, 0, 0, 0, 0]
    assert not any(any(faults) for faults in found[:900] + found[901:])


def test_missing_temperature_does_not_mask_permanently() -> None:
    def spoil(k: int, counts: NDArray[np.int64], temperature: Float) -> None:
        if k >= 200:
            temperature[:] = 0.0

    cycles = list(Five(spoil).run(400))
    assert cycles[200].fault.all()
    assert not cycles[-1].fault.any()


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e38, -1e30])
@pytest.mark.parametrize("which", [[2], [0, 1, 2, 3, 4]], ids=["one", "all"])
def test_nan_is_masked_without_numpy_warnings(value, which) -> None:
    board = steady()
    for k in range(STEADY, STEADY + 30):
        sent = REST.copy()
        sent[which] = value
        now = Instant(k * 10_000_000)
        temperature = np.full(5, value if len(which) == 5 else 27.0)
        block = SampleBlock(0, k, now, now, 1e-3, sent, temperature, np.zeros(5, np.uint8))
        (cycle,) = board.pipeline.feed(block)
        assert np.flatnonzero(cycle.fault).tolist()[: len(which)] == which or len(which) == 1
        assert (cycle.health[which] & TaxelHealth.OUT_OF_RANGE).all()
        assert no_force(cycle)


# Whether the remaining chips are enough


def dead_after_200(k: int, counts: NDArray[np.int64], temperature: Float) -> None:
    """Chip 2 sends zeros."""
    if k >= 200:
        counts[2], temperature[2] = 0, 0.0


def test_one_masked_of_five_leaves_an_untouched_board_valid() -> None:
    for cycle in list(Five(dead_after_200).run(300))[200:]:
        assert cycle.features.valid
        assert cycle.features.codes == ("chip_masked:skin",)
        assert "chip 2 of skin" in cycle.features.reasons[0].text


def test_contact_possibly_on_a_masked_chip_of_five_is_invalid() -> None:
    cycles = list(Five(dead_after_200).run(400, ramp(0, 800.0, 250, 50)))
    assert cycles[240].features.valid
    for cycle in cycles[300:]:
        assert not cycle.features.valid
        assert "masked_contact:skin" in cycle.features.codes


def test_chip_lost_under_a_press_is_never_valid_zero_force() -> None:
    cycles = list(Five(dead_after_200).run(300, ramp(2, 800.0, 130, 30)))
    assert cycles[190].features.peak_force > 5.0
    assert not any(cycle.features.valid for cycle in cycles[200:])


def test_contact_beside_a_masked_taxel_is_invalid(board, field_of, stream) -> None:
    flow = stream(BoardPipeline(board(coupling=0.02), PipelineSettings()))
    rng = np.random.default_rng(3)
    status = np.zeros(48, np.uint8)
    status[5] = TaxelHealth.READ_FAILED

    def cycle(taxel: int, newton: float, masked: bool) -> Cycle:
        force = np.zeros((48, 3))
        force[taxel, 2] = -newton
        field = field_of(board(coupling=0.02), force) + rng.normal(0, 4, (48, 3))
        result: Cycle = flow.one(field, status if masked else None)
        return result

    assert cycle(6, 0.0, masked=True).features.valid
    assert "masked_contact:left" in cycle(6, 2.0, masked=True).features.codes
    assert cycle(15, 2.0, masked=True).features.valid  # far from it
    assert cycle(5, 2.0, masked=False).features.peak_force > 1.5
    assert not cycle(5, 2.0, masked=True).features.valid


# False alarms


@pytest.mark.parametrize("hz", [0.5, 14, 100, 1000])
@pytest.mark.parametrize(
    ("step", "noise"),
    [(FINE, NOISE), (COARSE, NOISE), (FINE, 0.07 * NOISE), (COARSE, 0.3 * NOISE)],
    ids=["fine", "coarse", "filtered", "coarse and quiet"],
)
@pytest.mark.parametrize("rest", [REST, 0.01 * REST], ids=["magnets", "no field"])
def test_healthy_chips_are_never_masked(hz, step, noise, rest) -> None:
    press = REST / np.linalg.norm(REST, axis=1, keepdims=True)

    def pressed(k: int) -> Float:
        return press * (900.0 * max(0.0, np.sin(k / 40.0)) if k > STEADY else 0.0)

    cycles = list(Five(rest=rest, step=step, noise=noise, hz=hz).run(500, pressed))
    assert not any(cycle.fault.any() for cycle in cycles)


def test_slow_board_with_hard_presses_is_not_masked() -> None:
    blow = np.array([0.1, 0.3, 1.0, 0.2, 0.1])[:, None] * [900.0, -400.0, 4600.0]
    cycles = list(Five(step=COARSE, hz=14).run(300, lambda k: blow * (k > STEADY and k % 7 < 2)))
    assert not any(cycle.fault.any() for cycle in cycles)
