"""Rows 5 and 7 of the fault table for single taxels: flagged, masked, never zero force."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from tactile_core.geometry import finger
from tactile_core.types import Instant
from tactiled.blocks import TaxelHealth
from tactiled.sensing.health import HealthMonitor
from tactiled.sensing.layout import Layout
from tactiled.sensing.pipeline import BoardPipeline, PipelineSettings
from tactiled.sensing.reasons import Fault


@pytest.fixture
def flow(board, stream):
    return stream(BoardPipeline(board(coupling=0.02), PipelineSettings()))


@pytest.fixture
def noise():
    rng = np.random.default_rng(8)
    return lambda: rng.normal(0, 5, (48, 3))


@pytest.mark.parametrize("bit", [TaxelHealth.SATURATED, TaxelHealth.STALE, TaxelHealth.READ_FAILED])
def test_flagged_taxels_are_masked_in_the_same_cycle(flow, noise, bit):
    status = np.zeros(48, np.uint8)
    status[20] = bit
    field = noise()
    field[20] = 32_000.0
    cycle = flow.one(field, status)
    assert cycle.health[20] == bit
    assert np.isnan(cycle.force[20]).all()
    assert np.isnan(cycle.field_ut[20]).all()
    assert np.isfinite(np.delete(cycle.force, 20, axis=0)).all()
    assert cycle.features.taxels_masked == 1
    assert cycle.features.valid
    assert np.abs(np.delete(cycle.force, 20, axis=0)).max() < 0.5  # no leak into neighbours


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 60_000.0])
def test_impossible_readings_are_masked_at_once(flow, noise, value):
    field = noise()
    field[5, 1] = value
    cycle = flow.one(field)
    assert cycle.health[5] == TaxelHealth.OUT_OF_RANGE
    assert np.isnan(cycle.force[5]).all()
    assert np.isfinite(np.delete(cycle.force, 5, axis=0)).all()
    assert np.isfinite(cycle.ambient.plane).all()


@pytest.mark.parametrize("temperature", [-998.1, 451.8, float("nan")])
def test_impossible_temperature_masks_the_array(flow, noise, temperature):
    block = flow.block(0, noise())
    flow.pipeline.feed(dataclasses.replace(block, temperature_c=np.array([temperature])))
    flow.pipeline.feed(flow.block(1, noise()))
    (cycle,) = flow.pipeline.feed(flow.block(2, noise()))
    assert (cycle.health[:16] == TaxelHealth.OUT_OF_RANGE).all()
    assert not cycle.features.valid
    assert "taxels_masked:left" in cycle.features.codes


def test_frozen_taxel_is_unhealthy_within_a_second_and_recovers(flow, noise):
    stuck = np.array([3.0, 4.0, 5.0])
    flagged = None
    for k in range(100):
        field = noise()
        field[7] = stuck
        cycle = flow.one(field)
        if cycle.health[7] and flagged is None:
            flagged = k
    assert flagged is not None
    assert flagged * 0.01 <= 1.0
    assert cycle.health[7] == TaxelHealth.FROZEN
    assert np.isnan(cycle.force[7]).all()
    assert (np.delete(cycle.health, 7) == 0).all()
    assert flow.one(noise()).health[7] == 0


def test_two_equal_readings_at_low_rate_do_not_mask(flow, noise):
    field = noise()
    for _ in range(3):
        flow.sequence += 99  # one reading a second
        cycle = flow.one(field)
    assert (cycle.health == 0).all()
    flow.sequence += 99
    assert (flow.one(field).health == TaxelHealth.FROZEN).all()


def test_too_many_masked_taxels_make_features_invalid(flow, noise):
    status = np.zeros(48, np.uint8)
    status[32:36] = TaxelHealth.READ_FAILED  # a quarter of the tip is tolerated
    assert flow.one(noise(), status).features.valid
    status[36] = TaxelHealth.READ_FAILED
    features = flow.one(noise(), status).features
    assert not features.valid
    assert [r.text for r in features.reasons] == ["taxels masked: tip 31%"]
    assert features.taxels_masked == 5


def test_masked_taxel_in_contact_does_not_read_zero_force(flow, noise, board, field_of):
    force = np.zeros((48, 3))
    force[33, 2] = -2.0
    pressed = field_of(board(coupling=0.02), force)
    assert flow.one(noise() + pressed).features.peak_force == pytest.approx(2.0, abs=0.3)
    status = np.zeros(48, np.uint8)
    status[33] = TaxelHealth.SATURATED
    cycle = flow.one(noise() + pressed, status)
    assert np.isnan(cycle.force[33]).all()
    assert cycle.features.taxels_masked == 1


STRONG = np.array([300.0, -200.0, 6000.0])  # µT; z lies beyond the range of x and y


@pytest.fixture
def strong():
    """A monitor of 16 chips whose magnets read `STRONG`, and a function that makes its cycles."""
    layout = Layout(finger_tip())
    rng = np.random.default_rng(5)
    rest = np.repeat(STRONG[None, :, None], layout.width, axis=2)
    monitor = HealthMonitor(layout, 0.5, 50_000.0, rest)
    monitor.set_scale(0, (0.15, 0.242))

    def cycle(spoil=lambda raw, temperature: None):
        raw = rest + rng.normal(0, 4, rest.shape)
        temperature = np.full(layout.real.shape, 25.0)
        spoil(raw, temperature)
        cycle.now += 10_000_000
        status = np.zeros(layout.real.shape, np.uint8)
        monitor.update(raw, temperature, status, np.ones(1, bool), Instant(cycle.now))
        return monitor.fault[0]

    cycle.now = 0
    return cycle


def finger_tip():
    geometry = finger()
    return dataclasses.replace(geometry, arrays=(geometry.arrays[2],))


def test_strong_fields_alone_are_no_fault(strong):
    for _ in range(40):
        assert not strong().any()


def test_the_end_of_an_axis_is_found_among_strong_fields(strong):
    def spoil(raw, temperature):
        raw[0, 2, 5] = 32_767 * 0.242

    strong()
    strong()
    fault = strong(spoil)
    assert fault[5] == Fault.RAIL
    assert np.count_nonzero(fault) == 1


def test_a_chip_that_reads_zero_from_the_start_is_found_among_strong_fields(strong):
    def spoil(raw, temperature):
        raw[0, :, 5] = 0.0

    faults = [strong(spoil)[5] for _ in range(10)]
    assert Fault.ZEROS in faults or Fault.JUMPED in faults


def test_a_thermometer_that_creeps_out_of_its_range_is_found_among_strong_fields(strong):
    def hot(degrees):
        def spoil(raw, temperature):
            temperature[0, 5] = degrees

        return spoil

    for degrees in range(25, 131, 5):
        assert strong(hot(degrees))[5] == 0
    assert strong(hot(135.0))[5] == Fault.TEMPERATURE
