"""Methods of compensation over time: losing and regaining support, ageing, borrowing, periods.

Row 7 of the fault table.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from tactile_core.calibration import nominal
from tactiled.sensing.pipeline import BoardPipeline, PipelineSettings

AMBIENT = np.array([20.0, 10.0, -40.0])
LATER = np.array([-15.0, 25.0, 35.0])


class Scene:
    """A board in an ambient field, with noise, that tests can press."""

    def __init__(self, calibration, field_of, stream, **settings):
        self.calibration = calibration
        self.field_of = field_of
        self.rng = np.random.default_rng(12)
        pipeline = BoardPipeline(calibration, PipelineSettings(**settings))
        self.flow = stream(pipeline)
        self.parts = calibration.geometry.slices

    def go(self, ambient=AMBIENT, pressed=(), newton=2.0, cycles=1, every=1):
        """The last of ``cycles`` cycles, of which only one in ``every`` comes."""
        force = np.zeros((self.calibration.geometry.taxels, 3))
        force[list(pressed), 2] = -newton * self.rng.uniform(0.5, 1.5, len(pressed))
        clean = self.field_of(self.calibration, force, ambient)
        for _ in range(cycles // every):
            self.flow.sequence += every - 1
            last = self.flow.one(clean + self.rng.normal(0, 4, clean.shape))
        self.force = force
        return last


@pytest.fixture
def scene(board, field_of, stream):
    return lambda **settings: Scene(board(coupling=0.02), field_of, stream, **settings)


@pytest.fixture
def lone(field_of, stream):
    """A single array of five with known rest field."""
    return lambda **settings: Scene(
        nominal("anyskin", "A"), field_of, stream, auto_tare=False, **settings
    )


LEFT = range(16)
EVERY = range(48)


def test_ambient_is_reported_in_ee_with_its_support(scene):
    ambient = scene().go().ambient
    assert ambient.method == "consensus"
    np.testing.assert_allclose(ambient.plane[:, :, 0], np.tile(AMBIENT, (3, 1)), atol=6)
    assert ambient.valid.all()
    assert (ambient.support > 0.9).all()
    assert (ambient.age == 0).all()
    assert ((ambient.residual_ut > 2.5) & (ambient.residual_ut < 5.5)).all()


def test_slopes_are_per_metre(board, stream):
    flow = stream(BoardPipeline(board(), PipelineSettings()))
    field = np.zeros((48, 3))
    surface = board().arrays[2].geometry.surface
    field[32:, 2] = 300.0 * surface[:, 0] - 200.0 * surface[:, 1]  # z of the tip is x of ee
    plane = flow.one(field).ambient.plane
    np.testing.assert_allclose(plane[2, 0, 1:], [300.0, -200.0], atol=0.01)


def test_uncovered_half_is_enough_for_the_fit(scene):
    s = scene()
    cycle = s.go(pressed=range(8))
    assert cycle.ambient.valid.all()
    assert cycle.features.reasons == ()
    np.testing.assert_allclose(cycle.force, s.force, atol=0.35)


def test_covered_array_is_marked_at_once_and_follows_the_others(scene):
    s = scene()
    s.go(cycles=5)
    cycle = s.go(pressed=LEFT)
    assert cycle.ambient.valid.tolist() == [False, True, True]
    assert cycle.features.codes == ("compensation_borrowed:left",)
    assert cycle.features.valid
    assert cycle.ambient.age[0] == pytest.approx(0.01)
    # the board turns while the array is covered: its forces stay correct
    cycle = s.go(ambient=LATER, pressed=LEFT, cycles=40)
    assert cycle.ambient.age[0] == pytest.approx(0.41)
    np.testing.assert_allclose(cycle.force[:16], s.force[:16], atol=0.3)
    # and its own fit is used again as soon as it is free
    cycle = s.go(ambient=LATER)
    assert cycle.ambient.valid.all()
    assert cycle.ambient.age[0] == 0
    assert cycle.features.reasons == ()


def test_covered_board_holds_the_last_plane_for_a_limited_time(scene):
    s = scene(hold_s=0.5)
    s.go(cycles=5)
    before = s.go().ambient.plane
    cycle = s.go(pressed=EVERY)
    assert not cycle.ambient.valid.any()
    assert cycle.features.valid
    assert cycle.features.codes == tuple(
        f"compensation_held:{name}" for name in ("left", "right", "tip")
    )
    np.testing.assert_array_equal(cycle.ambient.plane, before)
    cycle = s.go(pressed=EVERY, cycles=49)
    assert cycle.features.valid
    cycle = s.go(pressed=EVERY)
    assert not cycle.features.valid
    assert cycle.features.codes[0] == "compensation_invalid:left"
    assert (cycle.ambient.age > 0.5).all()
    assert s.go().features.valid


def test_hold_can_be_disabled(scene):
    s = scene(hold_s=0.0)
    s.go()
    assert not s.go(pressed=EVERY).features.valid


def test_board_covered_from_the_start_has_nothing_to_hold(scene):
    cycle = scene().go(pressed=EVERY)
    assert not cycle.features.valid
    assert np.isinf(cycle.ambient.age).all()
    assert (cycle.ambient.plane == 0).all()


def test_five_taxels_hold_through_any_contact_for_some_seconds(lone):
    s = lone()
    assert s.go(cycles=30).ambient.valid.all()
    two = s.go(pressed=(0, 3), cycles=40)
    assert two.ambient.valid.all()  # three free chips determine the field
    s.go(cycles=100)
    cycle = s.go(pressed=range(5), cycles=300)
    assert not cycle.ambient.valid.any()
    assert cycle.features.valid
    assert cycle.features.codes == ("compensation_held:skin",)
    np.testing.assert_allclose(cycle.force, s.force, atol=0.3)
    later = s.go(pressed=range(5), cycles=6000, every=20)
    assert later.features.codes == ("compensation_held:skin", "uncertain:skin")
    assert not later.features.valid
    assert later.features.normal_force_bound > cycle.features.normal_force_bound


def test_plane_is_held_and_ages_between_fits(scene):
    s = scene(compensation_rate_hz=5.0)
    ages = [s.go().ambient.age[0] for _ in range(45)]
    np.testing.assert_allclose(ages, [(k % 20) * 0.01 for k in range(45)])


def test_lost_support_between_fits_shows_in_the_same_cycle(scene):
    s = scene(compensation_rate_hz=2.0)
    assert s.go(cycles=3).ambient.valid.all()
    assert s.go(pressed=LEFT).ambient.valid.tolist() == [False, True, True]
    assert not s.go(ambient=LATER).ambient.valid.any()  # the field differs from the held fit


def test_disabled_compensation_removes_nothing(scene):
    s = scene(method="off")
    cycle = s.go()
    assert cycle.ambient.method == "off"
    assert (cycle.ambient.plane == 0).all()
    normal = AMBIENT[1] / 100.0  # left array: y of ee is its normal; 100 µT/N, −1 N a press
    assert cycle.force[:16, 2].mean() == pytest.approx(-normal, abs=0.05)


def test_ransac_finds_the_plane_at_its_period_and_is_repeatable(scene):
    def run():
        s = scene(method="ransac", seed=3)
        return [s.go(pressed=range(4)) for _ in range(70)]

    cycles = run()
    assert cycles[0].ambient.method == "ransac"
    assert cycles[0].ambient.valid.all()
    np.testing.assert_allclose(cycles[0].ambient.plane[:, :, 0], np.tile(AMBIENT, (3, 1)), atol=9)
    age = [c.ambient.age[0] for c in cycles]
    fresh = [k for k, a in enumerate(age) if a == 0]
    assert fresh[0] == 0
    # then one round in each period of a third of a second, which ends near the period's end
    assert [round(k * 3 / 100) for k in fresh] == [0, 2]
    assert all(later > earlier for earlier, later in pairwise(age) if later)
    again = run()
    assert all(
        a.ambient.plane.tobytes() == b.ambient.plane.tobytes()
        for a, b in zip(cycles, again, strict=True)
    )


def test_ransac_marks_an_unsupported_plane(scene):
    s = scene(method="ransac")
    s.go(cycles=2)
    cycle = s.go(pressed=LEFT)
    assert cycle.ambient.valid.tolist() == [False, True, True]
    assert cycle.features.codes == ("compensation_held:left",)


def test_reset_clears_the_planes(scene):
    s = scene()
    s.go(cycles=3)
    s.flow.pipeline.reset()
    assert np.isinf(s.go(pressed=EVERY).ambient.age).all()
