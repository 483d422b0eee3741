"""Dipole fields against closed forms and the published figures of the magnets used."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim_device.skin.environment import rotation_about
from sim_device.skin.magnets import MagnetArray, dipole_field_ut

MOMENT = np.array([0, 0, 3.25e-3])
PRESS = 0.1e-3  # m; the published gradients and crosstalk are for a press of 0.1 mm


def at(x: float, z: float) -> np.ndarray:
    """Field at a chip ``z`` below and ``x`` beside a magnet, µT."""
    return dipole_field_ut(np.array([x, 0.0, -z]), MOMENT)


@pytest.mark.parametrize(("gap", "expected_mt"), [(4e-3, 10.2), (5e-3, 5.2)])
def test_field_on_axis_matches_the_dipole(gap: float, expected_mt: float) -> None:
    field = at(0, gap)
    assert field[2] / 1000 == pytest.approx(expected_mt, abs=0.05)
    # mu0/4pi * 2m/r^3
    assert field[2] == pytest.approx(1e-7 * 2 * 3.25e-3 / gap**3 * 1e6)
    assert field[:2] == pytest.approx([0, 0])


@pytest.mark.parametrize(
    ("gap", "normal_mt_per_mm", "lateral_mt_per_mm"), [(4e-3, 8.0, 3.8), (5e-3, 3.25, 1.6)]
)
def test_field_gradients_match_finite_differences(
    gap: float, normal_mt_per_mm: float, lateral_mt_per_mm: float
) -> None:
    normal = (at(0, gap - PRESS) - at(0, gap))[2] / (PRESS * 1e6)
    lateral = abs(at(PRESS, gap)[0]) / (PRESS * 1e6)
    assert normal == pytest.approx(normal_mt_per_mm, abs=0.05)
    assert lateral == pytest.approx(lateral_mt_per_mm, abs=0.05)


@pytest.mark.parametrize(("gap", "percent"), [(4e-3, (7.3, 1.7, 0.8)), (5e-3, (13.6, 3.5, 1.7))])
def test_crosstalk_matches_at_5_8_and_10_mm(gap: float, percent: tuple[float, ...]) -> None:
    own = np.linalg.norm(at(0, gap - PRESS) - at(0, gap))
    for pitch, expected in zip((5e-3, 8e-3, 10e-3), percent, strict=True):
        other = np.linalg.norm(at(pitch, gap - PRESS) - at(pitch, gap))
        assert 100 * other / own == pytest.approx(expected, abs=0.06)


@given(
    st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda v: np.linalg.norm(v) > 0.1),
    st.floats(-3, 3),
)
@settings(max_examples=30, deadline=None)
def test_field_rotates_with_its_source(axis: tuple[float, ...], angle: float) -> None:
    turn = rotation_about(np.array(axis) / np.linalg.norm(axis), angle)
    offset, moment = np.array([2e-3, 1e-3, -4e-3]), np.array([1e-3, 0, 3e-3])
    turned = dipole_field_ut(turn @ offset, turn @ moment)
    assert turned == pytest.approx(turn @ dipole_field_ut(offset, moment), rel=1e-9, abs=1e-6)


def test_field_has_no_divergence_and_no_curl() -> None:
    h = 1e-7
    point, moment = np.array([2e-3, -1e-3, 4e-3]), np.array([1e-3, 2e-3, 3e-3])
    steps = h * np.eye(3)
    jacobian = np.stack(
        [
            (dipole_field_ut(point + s, moment) - dipole_field_ut(point - s, moment)) / (2 * h)
            for s in steps
        ],
        axis=1,
    )
    size = np.abs(jacobian).max()
    assert np.trace(jacobian) == pytest.approx(0, abs=1e-6 * size)
    assert jacobian == pytest.approx(jacobian.T, abs=1e-6 * size)


def test_array_sums_the_magnets_within_its_radius() -> None:
    rng = np.random.default_rng(3)
    chips = np.stack(np.meshgrid(*[np.arange(4) * 8e-3] * 2, [0.0]), axis=-1).reshape(-1, 3)
    magnets = chips + np.array([0, 0, 4e-3]) + rng.normal(0, 1e-4, chips.shape)
    moments = np.tile(MOMENT, (16, 1)) + rng.normal(0, 1e-4, chips.shape)
    displacement = rng.normal(0, 1e-4, chips.shape)
    radius = 14e-3
    array = MagnetArray(chips, magnets, moments, radius)
    expected = np.zeros_like(chips)
    for i, chip in enumerate(chips):
        for j, magnet in enumerate(magnets):
            if np.linalg.norm(chip - magnet) <= radius:
                expected[i] += dipole_field_ut(chip - magnet - displacement[j], moments[j])
    assert array.field_ut(displacement) == pytest.approx(expected, rel=1e-9)
    assert array.field_ut(displacement, 0.5) == pytest.approx(expected / 2, rel=1e-9)
