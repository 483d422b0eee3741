"""Magnetometers: scales, timing, noise, saturation and wrap."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sensor_proto.packets import TaxelStatus
from sim_device.skin.chips import Magnetometers, temperature_of_raw
from sim_device.skin.parameters import ChipParameters, ChipSetting, SkinParameters

IDEAL = SkinParameters().ideal()


def chips(n: int = 4, parameters: ChipParameters = IDEAL.chip, seed: int = 0) -> Magnetometers:
    return Magnetometers(
        np.tile(np.eye(3), (n, 1, 1)), parameters, IDEAL.tolerance, np.random.default_rng(seed)
    )


@pytest.mark.parametrize(
    ("gain", "xy", "z"),
    [(7, 0.150, 0.242), (6, 0.200, 0.323), (5, 0.250, 0.403), (4, 0.300, 0.484), (0, 0.751, 1.210)],
)
def test_scales_match_the_datasheet(gain: int, xy: float, z: float) -> None:
    assert ChipSetting(gain=gain).lsb_ut == pytest.approx((xy, xy, z))
    assert ChipSetting(gain=gain, resolution=2).lsb_ut == pytest.approx((4 * xy, 4 * xy, 4 * z))


@pytest.mark.parametrize(
    ("filter_", "ms"), [(2, 1.84), (3, 2.61), (4, 4.15), (5, 7.22), (6, 13.4), (7, 25.7)]
)
def test_conversion_times_match_the_datasheet(filter_: int, ms: float) -> None:
    assert ChipSetting(filter=filter_).conversion_time * 1e3 == pytest.approx(ms, rel=0.005)


def test_fastest_rate_is_that_of_the_slowest_oscillator() -> None:
    assert ChipSetting(filter=2).max_rate == pytest.approx(493, abs=2)


@pytest.mark.parametrize(
    "codes", [{"gain": 8}, {"gain": -1}, {"resolution": 4}, {"oversampling": 4}, {"filter": 8}]
)
def test_unsupported_codes_are_refused(codes: dict[str, int]) -> None:
    with pytest.raises(ValueError, match=next(iter(codes))):
        ChipSetting(**codes)


def test_counts_are_field_over_scale() -> None:
    field = np.tile([300.0, -150.1, 484.0], (4, 1))
    reading = chips().convert(field, 25.0, np.random.default_rng(0))
    assert reading.counts.dtype == np.int16
    assert reading.counts[0].tolist() == [1000, -500, 1000]
    assert not reading.status.any()


def test_int16_wraps_silently_as_in_the_chip() -> None:
    sensor = chips(parameters=replace(IDEAL.chip, setting=ChipSetting(gain=6)))
    field = np.zeros((4, 3))
    field[0, 2] = 10.7e3  # beyond 32767 * 0.323 µT = 10.58 mT
    reading = sensor.convert(field, 25.0, np.random.default_rng(0))
    assert reading.counts[0, 2] == round(10.7e3 / 0.323) - 65536
    assert reading.status[0] == TaxelStatus.OK


def test_saturation_is_flagged() -> None:
    sensor = chips(parameters=replace(IDEAL.chip, setting=ChipSetting(gain=0, resolution=3)))
    field = np.zeros((4, 3))
    field[1, 0], field[2, 2] = 80e3, -50e3
    reading = sensor.convert(field, 25.0, np.random.default_rng(0))
    assert reading.status.tolist() == [0, TaxelStatus.SATURATED, TaxelStatus.SATURATED, 0]
    assert reading.counts[1, 0] == round(50e3 / (0.751 * 8))


def test_end_of_scale_is_flagged() -> None:
    field = np.zeros((4, 3))
    field[3, 0] = 32767 * 0.300
    reading = chips().convert(field, 25.0, np.random.default_rng(0))
    assert reading.counts[3, 0] == 32767
    assert reading.status.tolist() == [0, 0, 0, TaxelStatus.SATURATED]


def test_noise_matches_real_boards_and_averages_down() -> None:
    sensor = chips(2000, ChipParameters())
    rng = np.random.default_rng(5)
    default = sensor.convert(np.zeros((2000, 3)), 25.0, rng).counts * sensor.lsb_ut
    sigma = default.std(axis=0)
    assert 3.0 <= sigma[0] <= 4.4
    assert 5.0 <= sigma[2] <= 6.7
    sensor.configure(slice(None), ChipSetting(oversampling=2))
    quieter = (sensor.convert(np.zeros((2000, 3)), 25.0, rng).counts * sensor.lsb_ut).std(axis=0)
    assert quieter == pytest.approx(sigma / 2, rel=0.1)


def test_axes_are_converted_one_after_another() -> None:
    sensor = chips()
    axis = ChipSetting().axis_time
    before, now = np.zeros((4, 3)), np.full((4, 3), 100.0)
    seen = sensor.skew(now, before, 0.01)
    # z ends the conversion; y is one axis time old, x two.
    assert seen[0] == pytest.approx([100 * (1 - 2 * axis / 0.01), 100 * (1 - axis / 0.01), 100])
    # A sample is never older than the one before it.
    assert sensor.skew(now, before, axis)[0] == pytest.approx([0, 0, 100])


def test_cross_axis_and_drift_stay_within_their_bounds() -> None:
    p = ChipParameters()
    sensor = chips(500, p)
    along_x = np.tile([1000.0, 0, 0], (500, 1))
    seen = sensor.sense(along_x, 25.0)
    assert np.abs(seen[:, 1:]).max() <= 1000 * p.cross_axis
    assert np.abs(seen[:, 1:]).max() > 0.9 * 1000 * p.cross_axis
    drift = sensor.sense(np.zeros((500, 3)), 35.0) / 10
    assert np.abs(drift[:, :2]).max() <= p.offset_drift_xy_ut_per_k
    assert 2.5 < np.abs(drift[:, 2]).max() <= p.offset_drift_z_ut_per_k


@pytest.mark.parametrize(("raw", "celsius"), [(0, -998.1), (65535, 451.8), (46244, 25.0)])
def test_thermometer_formula_matches_the_datasheet(raw: int, celsius: float) -> None:
    assert temperature_of_raw(np.array(float(raw))) == pytest.approx(celsius, abs=0.05)


def test_thermometer_reads_in_its_steps() -> None:
    reading = chips().convert(np.zeros((4, 3)), 31.234, np.random.default_rng(0))
    assert reading.temperature_c == pytest.approx([31.234] * 4, abs=0.5 / 45.2)
    steps = (reading.temperature_c - 25) * 45.2
    assert steps == pytest.approx(np.rint(steps))
