"""Features: closed forms, hysteresis, patches, and time in light contact."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tactile_core.calibration import nominal
from tactile_core.geometry import Side, finger
from tactile_core.types import Instant
from tactiled.sensing.features import Adjacency, FeatureExtractor
from tactiled.sensing.pipeline import BoardPipeline, PipelineSettings

GEOMETRY = finger()
POSITION = np.concatenate([a.position for a in GEOMETRY.arrays])
ROTATION = np.concatenate([a.rotation for a in GEOMETRY.arrays])
MS = 1_000_000


class FedExtractor:
    """An extractor fed cycle by cycle at 100 Hz."""

    def __init__(self, **changes):
        self.extractor = FeatureExtractor(GEOMETRY, PipelineSettings(**changes))
        self.extractor.set_noise(np.full(80, 0.05))  # thresholds: 0.225, certain at 0.3, off 0.135
        self.cycle = -1

    def __call__(self, force=None, tip_usable=True, masked=0):
        self.cycle += 1
        force = np.zeros((80, 3)) if force is None else force
        return self.extractor.update(
            force, masked, (), True, tip_usable, Instant(self.cycle * 10 * MS)
        )


def presses(**newton):
    """Forces (80, 3) with a press on the taxels named t<number>, N."""
    force = np.zeros((80, 3))
    for name, value in newton.items():
        force[int(name[1:]), 2] = -value
    return force


def test_untouched_board_has_no_contact():
    features = FedExtractor()()
    assert features.peak_force == 0.0
    assert features.peak_side is Side.NONE
    assert features.patches == ()
    assert features.taxels_in_contact == 0
    assert (features.wrench == 0).all()


def test_wrench_of_a_known_press_is_exact():
    """2 N onto a taxel of the left side, and 0.5 N of drag towards the wrist."""
    taxel = 12
    force = np.zeros((80, 3))
    in_ee = np.array([-0.5, -2.0, 0.0])  # the left side's normal is +y
    force[taxel] = in_ee @ ROTATION[taxel]
    features = FedExtractor()(force)
    np.testing.assert_allclose(ROTATION[taxel][:, 2], [0, 1, 0], atol=1e-9)
    np.testing.assert_allclose(features.wrench[:3], in_ee, atol=1e-12)
    x, y, z = POSITION[taxel]
    moment = [z * 2.0, -z * 0.5, x * -2.0 + y * 0.5]  # r × F by hand
    np.testing.assert_allclose(features.wrench[3:], moment, atol=1e-12)
    assert features.peak_force == pytest.approx(2.0)
    assert features.normal_force == pytest.approx(2.0)
    assert features.peak_side is Side.LEFT
    np.testing.assert_allclose(features.peak_position, POSITION[taxel], atol=1e-12)
    (patch,) = features.patches
    assert (patch.array, patch.side, patch.taxels) == (0, Side.LEFT, 1)
    np.testing.assert_allclose(patch.force, in_ee, atol=1e-12)
    np.testing.assert_allclose(patch.normal, [0, 1, 0], atol=1e-9)


def test_normal_of_a_patch_round_the_tip_lies_between_those_of_its_taxels():
    tip = [t for t in range(64, 80) if abs(POSITION[t][2] - POSITION[64][2]) < 1e-9]
    pressed = tip[:2]
    features = FedExtractor()(presses(**{f"t{t}": 2.0 for t in pressed}))
    (patch,) = features.patches
    middle = ROTATION[pressed][:, :, 2].sum(axis=0)
    np.testing.assert_allclose(patch.normal, middle / np.linalg.norm(middle), atol=1e-9)


def test_press_between_taxels_is_located_between_them():
    features = FedExtractor()(presses(t9=1.0, t10=1.0))
    np.testing.assert_allclose(features.peak_position, (POSITION[9] + POSITION[10]) / 2)
    features = FedExtractor()(presses(t9=3.0, t10=1.0))
    np.testing.assert_allclose(features.peak_position, 0.75 * POSITION[9] + 0.25 * POSITION[10])


def test_patches_are_clusters_within_one_array_strongest_first():
    force = presses(t0=1.0, t9=2.0, t20=0.5, t31=1.0, t64=4.0)  # 0 and 9 touch at a corner
    features = FedExtractor()(force)
    assert [(p.array, p.taxels, round(p.normal_force, 6)) for p in features.patches] == [
        (2, 1, 4.0),
        (0, 2, 3.0),
        (0, 1, 1.0),
        (0, 1, 0.5),
    ]
    np.testing.assert_allclose(features.patches[1].centroid, (POSITION[0] + 2 * POSITION[9]) / 3)
    assert features.patches[1].peak_force == 2.0
    assert features.peak_side is Side.TIP
    assert features.tip_force == pytest.approx(4.0)
    assert features.taxels_in_contact == 5


def test_touching_arrays_are_not_one_patch():
    """Taxel 31 is the last of the left array and 32 the first of the right."""
    assert len(FedExtractor()(presses(t31=1.0, t32=1.0)).patches) == 2


@settings(max_examples=50, deadline=None)
@given(st.sets(st.integers(0, 79), max_size=40))
def test_clusters_match_brute_force_search(members):
    adjacency = Adjacency(GEOMETRY)
    left, expected = set(members), set()
    while left:
        group, border = set(), [min(left)]
        while border:
            taxel = border.pop()
            if taxel in left:
                left.discard(taxel)
                group.add(taxel)
                border += adjacency.neighbours[taxel]
        expected.add(frozenset(group))
    found = adjacency.clusters(sorted(members))
    assert {frozenset(g) for g in found} == expected
    assert sum(map(len, found)) == len(members)


def test_neighbours_on_grid_and_cross():
    adjacency = Adjacency(GEOMETRY)
    assert sorted(adjacency.neighbours[9]) == [0, 1, 2, 8, 9, 10, 16, 17, 18]
    assert sorted(adjacency.neighbours[0]) == [0, 1, 8, 9]
    cross = Adjacency(nominal("anyskin", "A").geometry)
    assert sorted(cross.neighbours[0]) == [0, 1, 2, 3, 4]


def test_contact_has_hysteresis_against_noise():
    feel = FedExtractor()
    assert feel(presses(t5=0.25)).taxels_in_contact == 0  # once above the threshold may be noise
    assert feel(presses(t5=0.0)).taxels_in_contact == 0
    assert feel(presses(t5=0.25)).taxels_in_contact == 0
    assert feel(presses(t5=0.25)).taxels_in_contact == 1  # twice in a row is not
    assert feel(presses(t5=0.14)).taxels_in_contact == 1  # held above the release threshold
    assert feel(presses(t5=0.13)).taxels_in_contact == 0
    assert feel(presses(t5=0.14)).taxels_in_contact == 0
    assert feel(presses(t5=0.31)).taxels_in_contact == 1  # certain at once


def test_no_false_contact_in_many_hours_of_noise(board, stream):
    """2,000 cycles of 48 taxels at rest, with normal noise of known size: no contact."""
    rng = np.random.default_rng(0)
    flow = stream(BoardPipeline(board(), PipelineSettings(noise_ut=(4.4, 4.4, 6.7))))
    for _ in range(2000):
        cycle = flow.one(rng.normal(0, 1, (48, 3)) * [4.4, 4.4, 6.7])
        assert cycle.features.taxels_in_contact == 0


def test_smallest_contact_is_a_tenth_of_a_newton():
    feel = FedExtractor()
    feel.extractor.set_noise(np.full(80, 1e-6))
    assert feel(presses(t5=0.14)).taxels_in_contact == 1
    assert FedExtractor().extractor.contact.sum() == 0
    feel.extractor.reset()
    feel.extractor.set_noise(np.full(80, 1e-6))
    assert feel(presses(t5=0.09)).taxels_in_contact == 0
    assert feel(presses(t5=0.09)).taxels_in_contact == 0


def test_masked_taxel_is_excluded_without_ending_contacts():
    force = presses(t5=1.0, t6=2.0)
    force[6] = np.nan
    features = FedExtractor()(force, masked=1)
    assert features.taxels_in_contact == 1
    assert features.taxels_masked == 1
    assert features.normal_force == pytest.approx(1.0)
    assert np.isfinite(features.wrench).all()
    assert np.isfinite(features.peak_position).all()


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), masked=st.sets(st.integers(0, 79), max_size=80))
def test_features_are_finite_and_add_up(seed, masked):
    rng = np.random.default_rng(seed)
    force = rng.normal(0, 1, (80, 3)) * rng.integers(0, 2, (80, 1))
    force[list(masked)] = np.nan
    features = FedExtractor()(force, masked=len(masked))
    assert np.isfinite(features.wrench).all()
    assert np.isfinite(features.peak_position).all()
    assert sum(p.normal_force for p in features.patches) == pytest.approx(features.normal_force)
    assert sum(p.taxels for p in features.patches) == features.taxels_in_contact
    total = sum((p.force for p in features.patches), np.zeros(3))
    np.testing.assert_allclose(total, features.wrench[:3], atol=1e-9)
    if features.patches:
        assert features.peak_force == max(p.peak_force for p in features.patches)


def test_light_tip_contact_time_is_measured():
    feel = FedExtractor()
    light = presses(t70=2.0)
    assert feel(light).tip_contact_time == 0.0
    for _ in range(10):
        features = feel(light)
    assert features.tip_contact_time == pytest.approx(0.1)
    assert feel(presses(t70=8.0)).tip_contact_time == 0.0  # no longer light
    assert feel(light).tip_contact_time == 0.0
    assert feel(light).tip_contact_time == pytest.approx(0.01)
    assert feel(presses(t70=0.4)).tip_contact_time == 0.0  # no longer a contact to count


def test_one_lost_cycle_is_bridged_two_are_not():
    feel = FedExtractor()
    light = presses(t70=2.0)
    for _ in range(5):
        feel(light)
    feel(None, tip_usable=False)
    assert feel(light).tip_contact_time == pytest.approx(0.06)
    feel(None, tip_usable=False)
    assert feel(None, tip_usable=False).tip_contact_time == 0.0
    assert feel(light).tip_contact_time == 0.0


def test_light_contact_limits_are_configurable():
    feel = FedExtractor(tip_light_n=(1.0, 3.0))
    feel(presses(t70=2.0))
    assert feel(presses(t70=2.0)).tip_contact_time > 0
    assert feel(presses(t70=3.1)).tip_contact_time == 0


def test_tip_contact_time_survives_a_lost_tip_block(board, stream, field_of):
    calibration = board()
    flow = stream(BoardPipeline(calibration, PipelineSettings(frozen_after_s=None)))
    force = np.zeros((48, 3))
    force[40, 2] = -2.0
    field = field_of(calibration, force)
    rng = np.random.default_rng(1)
    for _ in range(10):
        flow.one(field + rng.normal(0, 3, (48, 3)))
    flow.cycle(field, without=(2,))
    lost, whole = flow.cycle(field + rng.normal(0, 3, (48, 3)))
    assert "array_missing:tip" in lost.features.codes
    assert whole.features.tip_contact_time == pytest.approx(0.11)


def test_patch_includes_subthreshold_force_around_it():
    features = FedExtractor()(presses(t9=2.0, t8=0.05, t10=0.05, t30=0.05))  # t30 is far away
    assert features.taxels_in_contact == 1
    assert features.normal_force == pytest.approx(2.1)
    assert features.patches[0].normal_force == pytest.approx(2.1)
    np.testing.assert_allclose(features.patches[0].centroid, POSITION[9])


def test_pulled_neighbour_does_not_reduce_a_patch():
    features = FedExtractor()(presses(t9=2.0, t10=-0.5, t8=-0.1))
    assert features.normal_force == pytest.approx(1.9)


def test_masked_taxels_around_a_patch_are_excluded():
    force = presses(t9=2.0)
    force[10] = np.nan
    assert FedExtractor()(force, masked=1).normal_force == pytest.approx(2.0)
