"""Whole field model: sensitivity, range, calibration, determinism."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sim_device.board.catalogue import build_skin, factory_calibration, identity
from sim_device.skin.elastomer import Contact
from sim_device.skin.environment import (
    Environment,
    EnvironmentParameters,
    Surroundings,
    parse_rotation,
)
from sim_device.skin.parameters import SkinParameters
from sim_device.skin.skin import SkinModel, nominal_calibration
from tactile_core.geometry import finger
from tactile_core.types import Instant

MS = 1_000_000


def press(model: SkinModel, taxel: int, force: tuple[float, float, float]) -> np.ndarray:
    """Force (N, 3) in taxel axes with one taxel loaded."""
    loaded = np.zeros((model.geometry.taxels, 3))
    loaded[taxel] = force
    return loaded


def change(model: SkinModel, force: np.ndarray) -> np.ndarray:
    """Change of the settled field, µT in taxel axes."""
    return model.settled_field_ut(force, 25.0) - model.settled_field_ut(0 * force, 25.0)


def test_rest_field_matches_the_recordings(ideal_skin) -> None:
    rest = ideal_skin().settled_field_ut(np.zeros((16, 3)), 25.0)
    assert rest[:, 2] / 1000 == pytest.approx([10.2] * 16, abs=0.4)


def test_sensitivity_matches_real_skins(ideal_skin) -> None:
    model = ideal_skin()
    normal = change(model, press(model, 5, (0, 0, -1.0)))[5]
    shear = change(model, press(model, 5, (1.0, 0, 0)))[5]
    assert 100 < normal[2] < 250
    assert 100 < abs(shear[0]) < 250
    # Half of the earth's field, turned around, looks like some tenths of a newton.
    assert 0.2 < 50 / normal[2] < 0.5


@pytest.mark.parametrize("seed", range(4))
def test_twenty_newton_neither_wrap_nor_saturate(seed: int) -> None:
    model = build_skin("finger", seed)
    environment = Environment(EnvironmentParameters(field_ut=65))
    still = environment.at(0.0)
    for taxel in range(0, 80, 9):
        array = next(i for i, s in enumerate(model.geometry.slices) if taxel < s.stop)
        place = model.geometry.arrays[array]
        i = taxel - model.geometry.slices[array].start
        force = place.rotation[i] @ np.array([4.0, 4.0, -20.0])
        model.reset()
        reading = model.sample(Instant(0), [Contact(place.position[i], force, 1e-3)], still)
        seen = reading.counts * model.chips.lsb_ut
        model.reset()
        rest = model.sample(Instant(0), [], still).counts * model.chips.lsb_ut
        assert not reading.status.any()
        assert 2000 < seen[taxel, 2] - rest[taxel, 2] < 6000


def test_neighbours_feel_a_press_by_the_crosstalk_of_their_pitch(ideal_skin) -> None:
    model = ideal_skin((1, 2), 8e-3)
    felt = change(model, press(model, 0, (0, 0, -5.0)))  # 0.1 mm
    assert np.linalg.norm(felt[1]) / np.linalg.norm(felt[0]) == pytest.approx(0.0172, abs=2e-4)


def test_turning_in_a_uniform_field_preserves_the_change_magnitude(ideal_skin) -> None:
    model = ideal_skin()
    environment = Environment(
        EnvironmentParameters(gradient_ut_per_m=0, room_c=25, self_heating_k=0),
        parse_rotation("360deg/8s@1,1,0"),
    )
    rest = model.field_ut(np.zeros((16, 3)), Surroundings())
    for second in range(8):
        field = model.field_ut(np.zeros((16, 3)), environment.at(second)) - rest
        assert np.linalg.norm(field, axis=1) == pytest.approx([50.0] * 16)


def test_each_effect_can_be_switched_off(flat_geometry, calm) -> None:
    ideal = SkinParameters().ideal()
    quiet = SkinModel(flat_geometry(), ideal, np.random.default_rng(0))
    first = quiet.sample(Instant(0), [], calm.at(0)).counts
    again = quiet.sample(Instant(10 * MS), [], calm.at(0)).counts
    assert np.array_equal(first, again)
    noisy = replace(ideal, chip=replace(ideal.chip, noise_xy_ut=3.7))
    model = SkinModel(flat_geometry(), noisy, np.random.default_rng(0))
    counts = model.sample(Instant(0), [], calm.at(0)).counts
    assert (counts[:, :2] != first[:, :2]).any()
    assert np.array_equal(counts[:, 2], first[:, 2])


def test_chip_yaw_is_corrected_by_the_host() -> None:
    model = SkinModel(
        build_skin("anyskin", 0).geometry, SkinParameters().ideal(), np.random.default_rng(0)
    )
    felt = change(model, press(model, 3, (1.0, 0, -1.0)))
    expected = change(model, press(model, 0, (1.0, 0, -1.0)))
    assert felt[3] == pytest.approx(expected[0], rel=0.02, abs=1.0)
    in_chip = model.field_ut(np.zeros((5, 3)), Surroundings(world_field_ut=np.array([0, 40.0, 0])))
    in_chip -= model.field_ut(np.zeros((5, 3)), Surroundings())
    # ee y is the skin's x; chips are turned by -90, -90, 180, 90 and 0 degrees.
    expected_chip = [[0, 40, 0], [0, 40, 0], [-40, 0, 0], [0, -40, 0], [40, 0, 0]]
    assert in_chip == pytest.approx(np.array(expected_chip, float), abs=1e-9)


def test_true_force_belongs_to_the_last_sample(real_skin, calm) -> None:
    model = real_skin()
    model.sample(
        Instant(0), [Contact(np.array([0.008, 0.008, 0]), np.array([0.3, 0, -2.0]))], calm.at(0)
    )
    assert model.true_force.sum(axis=0) == pytest.approx([0.3, 0, -2.0])
    model.sample(Instant(MS), [], calm.at(0))
    assert not model.true_force.any()


def test_backward_time_is_not_accepted(real_skin, calm) -> None:
    model = real_skin()
    model.sample(Instant(MS), [], calm.at(0))
    with pytest.raises(ValueError, match="back"):
        model.sample(Instant(0), [], calm.at(0))


def test_same_seed_same_counts(real_skin) -> None:
    environment = Environment(attitude=parse_rotation("90deg/1s"))
    contact = Contact(np.array([0.002, 0, 0]), np.array([0, 0, -3.0]))

    def counts(seed: int) -> list[bytes]:
        model = real_skin(seed)
        return [
            model.sample(Instant(i * 10 * MS), [contact], environment.at(i / 100)).counts.tobytes()
            for i in range(5)
        ]

    assert counts(7) == counts(7)
    assert counts(7) != counts(8)


@pytest.fixture(scope="module")
def calibrated() -> tuple[SkinModel, object]:
    model = build_skin("finger", 3)
    return model, nominal_calibration(model, "00")


@pytest.mark.parametrize(("newton", "bound"), [(0.5, 0.03), (1.0, 0.03), (2.0, 0.02), (5.0, 0.04)])
@pytest.mark.parametrize("shear", [0.0, 0.3])
def test_factory_calibration_recovers_forces(calibrated, newton, bound, shear) -> None:
    model, calibration = calibrated
    for array, taxels in zip(calibration.arrays, model.geometry.slices, strict=True):
        for i in range(0, array.geometry.taxels, 5):
            force = press(model, taxels.start + i, (shear * newton, 0, -newton))
            felt = array.newton_per_ut @ change(model, force)[taxels].ravel()
            error = felt.reshape(-1, 3) - force[taxels]
            assert np.abs(error[i]).max() < bound * newton
            assert np.abs(np.delete(error, i, axis=0)).max() < 0.002 * newton


def test_factory_calibration_knows_rest_field_and_drift(calibrated) -> None:
    model, calibration = calibrated
    for array, taxels in zip(calibration.arrays, model.geometry.slices, strict=True):
        warm = model.settled_field_ut(np.zeros((80, 3)), 35.0)[taxels]
        predicted = array.rest_ut + 10 * array.drift_ut_per_k
        assert predicted == pytest.approx(warm, abs=1.0)
        assert array.reference_c == 25.0
    assert not calibration.nominal


@pytest.mark.parametrize(("hold_s", "bound"), [(0.3, 0.05), (2.0, 0.045), (10.0, 0.06)])
@pytest.mark.parametrize("newton", [1.0, 5.0])
def test_calibrated_force_of_a_press_is_accurate(
    calm, newton: float, hold_s: float, bound: float
) -> None:
    """Creep, hysteresis, curvature and noise together, over a hundred averaged samples."""
    model = build_skin("finger", 4)
    calibration = nominal_calibration(model, "00").arrays[0]
    geometry = model.geometry.arrays[0]
    contact = Contact(
        geometry.position[11], geometry.rotation[11] @ np.array([0, 0, -newton]), 1e-3
    )
    at = calm.at(0)
    rest, pressed = [], []
    for i in range(100):
        rest.append(model.sample(Instant(i * MS), [], at).counts * model.chips.lsb_ut)
    for step in range(round(hold_s * 100)):
        model.sample(Instant((110 + 10 * step) * MS), [contact], at)
    end = 110 + round(hold_s * 1000)
    for i in range(100):
        reading = model.sample(Instant((end + i) * MS), [contact], at)
        pressed.append(reading.counts * model.chips.lsb_ut)
    felt = (np.mean(pressed, axis=0) - np.mean(rest, axis=0))[:32].ravel()
    normal = -(calibration.newton_per_ut @ felt).reshape(-1, 3)[:, 2]
    assert normal[11] == pytest.approx(-model.true_force[11, 2], rel=bound)


def test_calibration_measures_its_own_board_only() -> None:
    ours, theirs = factory_calibration("anyskin", 1), factory_calibration("anyskin", 2)
    assert ours.serial_number == identity("anyskin", 1).unique_id.hex()
    assert ours.serial_number != theirs.serial_number
    assert not np.allclose(ours.arrays[0].rest_ut, theirs.arrays[0].rest_ut, atol=20)
    again = factory_calibration("anyskin", 1)
    assert np.array_equal(ours.arrays[0].newton_per_ut, again.arrays[0].newton_per_ut)


def test_calibration_does_not_change_the_skin() -> None:
    model, untouched = build_skin("finger", 5), build_skin("finger", 5)
    nominal_calibration(model, "00")
    at = Environment().at(0.0)
    assert np.array_equal(
        model.sample(Instant(0), [], at).counts, untouched.sample(Instant(0), [], at).counts
    )


def test_unknown_model_is_refused_by_name() -> None:
    with pytest.raises(ValueError, match=r"'thumb'.*finger, anyskin"):
        build_skin("thumb", 0)


def test_contacts_on_the_finger_keep_their_force_in_ee() -> None:
    model = SkinModel(finger(), SkinParameters(), np.random.default_rng(0))
    push = np.array([-1.0, -2.0, 0.3])
    shoulder = finger().arrays[0].position[0]
    forces = model.taxel_force([Contact(shoulder, push)])
    rotation = np.concatenate([a.rotation for a in finger().arrays])
    assert np.einsum("nij,nj->i", rotation, forces) == pytest.approx(push)
