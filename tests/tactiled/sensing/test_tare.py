from __future__ import annotations

import numpy as np
import pytest

from tactile_core.calibration import nominal
from tactiled.blocks import TaxelHealth
from tactiled.sensing.pipeline import BoardPipeline, PipelineSettings


class Bench:
    """A board at rest with known rest fields."""

    def __init__(self, calibration, field_of, stream, **settings):
        self.calibration = calibration
        self.rng = np.random.default_rng(21)
        self.rest = self.rng.normal(0, 3000, (calibration.geometry.taxels, 3))
        self.field_of = field_of
        self.flow = stream(BoardPipeline(calibration, PipelineSettings(**settings)))
        self.pipeline = self.flow.pipeline
        self.noise = np.array([3.0, 3.0, 5.0])

    def go(self, cycles=1, newton=None, drift=0.0, status=None):
        force = np.zeros_like(self.rest)
        for taxel, n in (newton or {}).items():
            force[taxel, 2] = -n
        clean = self.rest + self.field_of(self.calibration, force)
        for k in range(cycles):
            noisy = clean + self.rng.normal(0, 1, clean.shape) * self.noise + drift * k
            cycle = self.flow.one(noisy, status)
        return cycle


@pytest.fixture
def unknown(board, field_of, stream):
    return lambda **settings: Bench(board(nominal=True), field_of, stream, **settings)


def test_nominal_board_is_tared_at_start(unknown):
    bench = unknown()
    first = bench.go()
    assert bench.pipeline.taring
    assert not first.features.valid
    assert first.features.codes == ("taring",)
    assert np.isnan(first.force).all()  # rest fields of 3 mT are not forces of 30 N
    assert not first.ambient.valid.any()
    bench.go(50)
    assert not bench.pipeline.taring
    cycle = bench.go()
    assert cycle.features.valid
    assert not cycle.calibrated
    assert np.abs(cycle.force).max() < 0.3
    report = bench.pipeline.tare_report
    assert report.accepted
    assert report.cycles == 51
    assert "51 cycles" in report.message
    np.testing.assert_allclose(report.noise_ut, bench.noise, rtol=0.15)
    assert report.shift_ut == pytest.approx(np.abs(bench.rest).max(), abs=5)
    assert bench.go(newton={20: 2.0}).features.peak_force == pytest.approx(2.0, abs=0.25)


def test_moving_skin_at_start_gets_a_rough_rest_field(unknown):
    bench = unknown()
    bench.go(60, drift=3.0)
    assert bench.pipeline.taring
    assert not bench.pipeline.tare_report.accepted
    assert "keep the skin still" in bench.pipeline.tare_report.message
    bench.go(110, drift=3.0)
    report = bench.pipeline.tare_report
    assert report.accepted
    assert "rough" in report.message
    cycle = bench.go()
    assert not cycle.features.valid
    assert cycle.features.codes[0] == "rest_uncertain"
    assert np.isfinite(cycle.force).all()
    bench.pipeline.tare()
    bench.go(51)
    assert bench.go().features.valid


def test_tare_removes_drift_and_reports_how_much(board, field_of, stream):
    bench = Bench(board(), field_of, stream, auto_tare=False)
    bench.rest[:] = 0
    bench.rest[7, 2] = 60.0  # creep after a long press: 0.6 N
    assert bench.go(5).features.peak_force == pytest.approx(0.6, abs=0.15)
    bench.pipeline.tare()
    bench.go(51)
    assert bench.pipeline.tare_report.accepted
    assert bench.pipeline.tare_report.shift_ut == pytest.approx(60.0, abs=4)
    assert bench.go(20).features.taxels_in_contact == 0


def test_tare_under_contact_is_refused_and_changes_nothing(board, field_of, stream):
    bench = Bench(board(), field_of, stream, auto_tare=False)
    bench.rest[:] = 0
    bench.go(5, {33: 2.0})
    bench.pipeline.tare()
    bench.go(52, {33: 2.0})
    report = bench.pipeline.tare_report
    assert not report.accepted
    assert not bench.pipeline.taring
    assert "bears 2." in report.message or "bears 1.9" in report.message
    assert "lift the skin off" in report.message
    assert bench.go(newton={33: 2.0}).features.peak_force == pytest.approx(2.0, abs=0.25)


def test_tare_in_motion_is_refused(board, field_of, stream):
    bench = Bench(board(), field_of, stream, auto_tare=False)
    bench.rest[:] = 0
    bench.go(3)
    bench.pipeline.tare()
    bench.go(52, drift=1.0)
    assert not bench.pipeline.tare_report.accepted
    assert "moved by" in bench.pipeline.tare_report.message


def test_taxel_faulty_during_first_tare_stays_masked(unknown):
    bench = unknown()
    status = np.zeros(48, np.uint8)
    status[12] = TaxelHealth.READ_FAILED
    bench.go(52, status=status)
    assert "1 unhealthy taxels stay masked" in bench.pipeline.tare_report.message
    cycle = bench.go()  # it answers again, but its rest field is unknown
    assert cycle.health[12] == TaxelHealth.OUT_OF_RANGE
    assert np.isnan(cycle.force[12]).all()
    assert cycle.features.taxels_in_contact == 0
    bench.pipeline.tare()
    bench.go(52)
    assert bench.go().health[12] == 0


def test_tare_takes_enough_cycles_at_low_rates(unknown):
    bench = unknown()
    for _ in range(9):
        bench.flow.sequence += 9  # 10 Hz
        bench.go()
    assert not bench.pipeline.taring
    assert bench.pipeline.tare_report.accepted
    assert bench.pipeline.tare_report.cycles >= 8


def test_rest_field_follows_untouched_taxels_when_enabled(board, field_of, stream):
    bench = Bench(board(), field_of, stream, auto_tare=False, rest_tracking_s=0.5)
    bench.rest[:] = 0
    bench.rest[7, 0] = 15.0  # 0.15 N of false shear
    bench.go(300)
    tail = np.array([bench.go().force[7, 0] for _ in range(50)])
    assert abs(tail.mean()) < 0.03


def test_reset_keeps_the_rest_field(unknown):
    bench = unknown()
    bench.go(52)
    bench.pipeline.reset()
    bench.flow.sequence = 0
    assert bench.go().features.valid


def test_chip_yaw_is_corrected(stream):
    """Chip y of the taxel mounted at −90° is the taxel's x."""
    flow = stream(BoardPipeline(nominal("anyskin", "A"), PipelineSettings(auto_tare=False)))
    field = np.zeros((5, 3))
    field[0] = [0.0, 7.0, 3.0]
    np.testing.assert_allclose(flow.one(field).field_ut[0], [7.0, 0.0, 3.0], atol=1e-12)


def test_temperature_drift_is_removed(board, stream):
    import dataclasses

    calibration = board()
    drift = np.tile([1.0, -2.0, 4.0], (16, 1))
    calibration = dataclasses.replace(
        calibration,
        arrays=(
            dataclasses.replace(calibration.arrays[0], drift_ut_per_k=drift, reference_c=25.0),
            *calibration.arrays[1:],
        ),
    )
    flow = stream(BoardPipeline(calibration, PipelineSettings(method="off")))
    field = np.zeros((48, 3))
    field[:16] = 10.0 * drift[0]
    np.testing.assert_allclose(flow.one(field, temperature_c=35.0).field_ut, 0.0, atol=1e-12)
