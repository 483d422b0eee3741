"""Figures on recordings of the eFlesh rig; docs/calibration.md has those of the whole recordings.

Bounds are a little above what was measured, so that a regression is noticed.
"""

from __future__ import annotations

import numpy as np
import pytest

from tactile_tools.calibrate.evaluate import predict
from tactile_tools.calibrate.fit import Choice, fit
from tactile_tools.calibrate.recipes import FORCE_RECIPES, PLACE_RECIPES

LINEAR, CUBIC, CREEP, PLAY = FORCE_RECIPES


def last_fifth(recording, recipe, penalty, label_clock=True):
    """Errors on the last fifth, of the model that cross-validation chose on the rest."""
    head = recording.until(0.8)
    model = fit([head], Choice(recipe, penalty, 0.0, (), ()))
    tested = recording.label_time_s > head.time_s[-1]
    assert tested.mean() == pytest.approx(0.2, abs=0.01)
    return (predict(model, recording, label_clock) - recording.labels)[tested]


def test_readings_of_minus_one_are_not_labels_and_weights_become_newtons(real):
    recording = real("normal_force_20250401_014340")
    assert len(recording.labels) == 1860  # of 3600 rows; the others hold -1
    assert recording.labels.min() == 0
    assert recording.labels.max() == pytest.approx(3482.78 * 9.80665e-3)
    assert recording.taxels == 5


@pytest.mark.parametrize(
    "name",
    ["normal_force_20250401_014340", "normal_force_20250401_015037", "shear_force_20250416_200533"],
)
def test_the_load_cell_was_read_every_0_2048_s_and_measured_every_0_1998(real, name):
    clock = real(name).label_clock
    assert clock is not None
    assert clock.reading_s == pytest.approx(0.1999, abs=0.0003)
    assert clock.concentration > 0.85


@pytest.mark.parametrize(
    ("name", "recipe", "penalty", "bound"),
    [
        ("normal_force_20250401_014340", PLAY, 10.0, 0.18),
        ("normal_force_20250401_015037", CREEP, 10.0, 0.14),
        ("shear_force_20250416_200533", CREEP, 3.0, 0.13),
    ],
)
def test_force_error_on_the_last_fifth(real, name, recipe, penalty, bound):
    error = last_fifth(real(name), recipe, penalty)
    assert np.sqrt((error**2).mean()) < bound


def test_label_clock_explains_much_of_the_error(real):
    recording = real("normal_force_20250401_015037")
    with_clock = last_fifth(recording, CREEP, 10.0)
    without = last_fifth(recording, CREEP, 10.0, label_clock=False)
    assert (with_clock**2).mean() < 0.7 * (without**2).mean()


def test_position_error_on_the_last_fifth(real):
    error = last_fifth(real("spatial_resolution_20250316_155729"), PLACE_RECIPES[-1], 1e-3)
    assert np.sqrt((error**2).mean(axis=0)).max() < 0.49
    assert np.linalg.norm(error, axis=1).mean() < 0.53


def test_force_error_on_an_unseen_recording(real):
    one, other = (real(f"normal_force_20250401_{n}") for n in ("014340", "015037"))
    errors = []
    for seen, unseen in ((one, other), (other, one)):
        model = fit([seen], Choice(CREEP, 3.0, 0.0, (), ()))
        errors.append(np.sqrt(((predict(model, unseen) - unseen.labels) ** 2).mean()))
    assert np.mean(errors) < 0.38
