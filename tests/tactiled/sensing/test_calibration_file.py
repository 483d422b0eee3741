from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from sensor_proto.packets import ArrayDescriptor, ChipType, Descriptor
from tactile_core import calibration
from tactile_core.calibration import CalibrationError, CalibrationMismatch, nominal
from tactile_core.geometry import finger


@pytest.fixture
def measured(board):
    """A calibration with unusual numbers in every field."""
    rng = np.random.default_rng(5)
    plain = board(coupling=0.03, chip_yaw=np.deg2rad(-90.0))
    arrays = tuple(
        dataclasses.replace(
            a,
            rest_ut=rng.normal(0, 1e4, a.rest_ut.shape),
            drift_ut_per_k=rng.normal(0, 1 / 3, a.rest_ut.shape),
            reference_c=24.1,
            newton_per_ut=a.newton_per_ut * (1 + rng.normal(0, 1e-3, a.newton_per_ut.shape)),
        )
        for a in plain.arrays
    )
    return dataclasses.replace(plain, arrays=arrays, provenance='rig "3" \\ µ\n2nd line')


def test_calibration_file_round_trips_exactly(measured, tmp_path):
    path = tmp_path / "board.cal.toml"
    calibration.save(measured, path)
    back = calibration.load(path)
    assert back.hash == measured.hash
    for field in ("serial_number", "model", "frame", "created", "provenance", "nominal"):
        assert getattr(back, field) == getattr(measured, field)
    for a, b in zip(back.arrays, measured.arrays, strict=True):
        assert a.newton_per_ut.tobytes() == b.newton_per_ut.tobytes()
        assert a.rest_ut.tobytes() == b.rest_ut.tobytes()
        assert a.drift_ut_per_k.tobytes() == b.drift_ut_per_k.tobytes()
        assert a.reference_c == b.reference_c
        assert a.geometry.position.tobytes() == b.geometry.position.tobytes()
        assert a.geometry.rotation.tobytes() == b.geometry.rotation.tobytes()
        np.testing.assert_allclose(a.geometry.chip_yaw, b.geometry.chip_yaw, atol=1e-12)
        assert (a.geometry.name, a.geometry.side) == (b.geometry.name, b.geometry.side)


def test_uncoupled_taxels_write_no_coupling_lines(board):
    text = calibration.saves(board())
    assert "coupling_n_per_ut = [  #" in text
    assert len(text) < 20_000
    assert calibration.loads(text).hash == board().hash


def test_hash_changes_with_any_number(measured):
    array = measured.arrays[1]
    nudged = array.newton_per_ut.copy()
    nudged[3, 7] = np.nextafter(nudged[3, 7], 1)
    other = dataclasses.replace(
        measured,
        arrays=(
            measured.arrays[0],
            dataclasses.replace(array, newton_per_ut=nudged),
            measured.arrays[2],
        ),
    )
    assert other.hash != measured.hash
    assert dataclasses.replace(measured, serial_number="x").hash != measured.hash


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("format_version = 1", "format_version = 4", ["format_version is 4", "newer than 3"]),
        ('format = "tactile-calibration"', 'format = "mask"', ["format", "mask"]),
        ("nominal = false", 'nominal = "no"', ['nominal = "no"', "true or false"]),
        ('side = "left"', 'side = "top"', ['array[0].side = "top"', "left, right, tip"]),
        ("rows = 4", "rows = 0", ["array[0].rows = 0", "1 to 128"]),
        ("rows = 4", "rows = 5", ["array[0].rotation", "16 rows", "20 rows"]),
        ("reference_c = 25.0", "reference_c = nan", ["reference_c = nan", "finite"]),
        ("reference_c = 25.0", "reference_c = true", ["reference_c = true", "number"]),
        ("reference_c = 25.0", "", ["array[0].reference_c is missing"]),
        ("reference_c = 25.0", "referenz_c = 25.0", ["referenz_c (did you mean reference_c?)"]),
        ("reference_c = 25.0", "reference_c = 25.0\ncolour = 1", ["unknown key array[0].colour"]),
        ('kind = "linear"', 'kind = "pickle"', ['array[0].force.kind = "pickle"', "linear"]),
        ("serial_number = ", "serial_number = [", ["bad.cal.toml:"]),
    ],
)
def test_bad_file_is_refused_with_key_value_and_allowed_values(board, tmp_path, old, new, words):
    path = tmp_path / "bad.cal.toml"
    path.write_text(calibration.saves(board()).replace(old, new, 1))
    with pytest.raises(CalibrationError) as caught:
        calibration.load(path)
    message = str(caught.value)
    assert str(path) in message
    for word in words:
        assert word in message


def test_invalid_rotation_is_refused(board):
    text = calibration.saves(board()).replace("[1.0, 0.0, 0.0, ", "[1.1, 0.0, 0.0, ", 1)
    with pytest.raises(CalibrationError, match="orthonormal"):
        calibration.loads(text)


@pytest.mark.parametrize(
    ("row", "words"),
    [
        ("[0, 99, 1, 2, 3, 4, 5, 6, 7, 8, 9]", "taxels from 0 to 15"),
        ("[0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9]", "two different taxels once"),
        ("[0, 1, 2]", "9 numbers"),
        ("[0, 1, 1, 2, 3, 4, 5, 6, 7, 8, inf]", "finite"),
        ("[0, 1, 1, 2, 3, 4, 5, 6, 7, 8, 1" + "0" * 400 + "]", "finite"),
    ],
)
def test_bad_coupling_is_refused(board, row, words):
    text = calibration.saves(board())
    at = text.index("coupling_n_per_ut = [")
    end = text.index("\n", at)
    with pytest.raises(CalibrationError, match=words) as caught:
        calibration.loads(text[:end] + "\n" + row + text[end:])
    assert "array[0].force.coupling_n_per_ut[0]" in str(caught.value)


def test_missing_unreadable_and_binary_files_are_named(tmp_path):
    with pytest.raises(CalibrationError, match=r"none\.cal\.toml: cannot be read"):
        calibration.load(tmp_path / "none.cal.toml")
    binary = tmp_path / "b.cal.toml"
    binary.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(CalibrationError, match="not UTF-8 text"):
        calibration.load(binary)


def test_failed_save_keeps_the_old_file(measured, tmp_path):
    target = tmp_path / "kept.cal.toml"
    target.mkdir()
    with pytest.raises(CalibrationError, match="cannot be written"):
        calibration.save(measured, target)
    assert target.is_dir()


def test_calibration_of_another_board_is_refused_with_both_serial_numbers(measured):
    measured.require_board("0011223344556677")
    with pytest.raises(CalibrationMismatch) as caught:
        measured.require_board("ffeeddccbbaa9988", "finger.cal.toml")
    for word in ("0011223344556677", "ffeeddccbbaa9988", "finger.cal.toml"):
        assert word in str(caught.value)


def test_nominal_values_are_marked_and_have_the_published_sensitivity():
    skin = nominal("anyskin", "A1")
    assert skin.nominal
    assert "nominal" in skin.provenance
    # eFlesh: 115 µT/N; a press of 1 N is −1 N in z of the taxel
    force = skin.arrays[0].newton_per_ut @ np.tile([0.0, 0.0, 115.0], 5)
    np.testing.assert_allclose(force.reshape(5, 3), np.tile([0.0, 0.0, -1.0], (5, 1)), atol=1e-12)
    assert nominal("finger", "B").geometry.taxels == 80
    with pytest.raises(ValueError, match="finger"):
        nominal("hand", "C")


def test_anyskin_controllers_of_any_size():
    for count in range(1, 21):
        skin = nominal("anyskin", "A", count).geometry
        assert skin.taxels == count
        assert {a.taxels for a in skin.arrays} == ({count} if count % 5 else {5})
        for array in skin.arrays:
            apart = np.linalg.norm(array.surface[:, None] - array.surface[None], axis=2)
            assert array.taxels == 1 or apart[~np.eye(array.taxels, dtype=bool)].min() > 0.007
    for array in nominal("anyskin", "A", 10).geometry.arrays:
        np.testing.assert_allclose(np.rad2deg(array.chip_yaw), [-90, -90, 180, 90, 0])
    with pytest.raises(ValueError, match="1 to 20"):
        nominal("anyskin", "A", 21)


def test_boards_of_one_controller_are_arrays_without_poses():
    skin = nominal("anyskin", "A", 10).geometry
    assert [(a.name, a.taxels, a.posed) for a in skin.arrays] == [
        ("skin0", 5, False),
        ("skin1", 5, False),
    ]
    assert not skin.posed
    assert nominal("anyskin", "A", 5).geometry.posed  # a lone array has no other to be posed to
    uneven = nominal("anyskin", "A", 7, (5, 2)).geometry
    assert [a.taxels for a in uneven.arrays] == [5, 2]
    one = nominal("anyskin", "A", 10, (10,)).geometry
    assert [a.taxels for a in one.arrays] == [10]
    for wrong in ((5, 4), (5, 0, 5), (11,)):
        with pytest.raises(ValueError, match="add up to 10"):
            nominal("anyskin", "A", 10, wrong)


def test_posed_flag_round_trips_through_the_file():
    skin = nominal("anyskin", "A", 10)
    text = calibration.saves(skin)
    assert "format_version = 3" in text
    again = calibration.loads(text)
    assert [a.geometry.posed for a in again.arrays] == [False, False]
    assert again.hash == skin.hash
    placed = calibration.loads(text.replace("posed = false", "posed = true"))
    assert placed.geometry.posed
    assert placed.hash != skin.hash
    assert "format_version = 1" in calibration.saves(placed)
    with pytest.raises(CalibrationError, match="true or false"):
        calibration.loads(text.replace("posed = false", "posed = 1"))


def _descriptor(model, *shapes):
    return Descriptor(
        1,
        0,
        bytes(range(8)),
        model,
        "1.0",
        1_000_000,
        100_000,
        tuple(
            ArrayDescriptor(i, f"a{i}", ChipType.MLX90393, rows, columns, 12_000, 300, 484)
            for i, (rows, columns) in enumerate(shapes)
        ),
    )


def test_nominal_from_a_descriptor():
    known = calibration.nominal_from_descriptor(_descriptor("finger", (4, 8), (4, 8), (4, 4)))
    assert known.serial_number == "0001020304050607"
    np.testing.assert_array_equal(known.arrays[0].geometry.position, finger().arrays[0].position)
    other = calibration.nominal_from_descriptor(_descriptor("finger", (2, 3)))
    assert other.geometry.taxels == 6
    unknown = calibration.nominal_from_descriptor(_descriptor("mitten", (2, 3), (1, 1)))
    assert (unknown.model, unknown.nominal) == ("mitten", True)
    first = unknown.arrays[0].geometry.surface
    np.testing.assert_allclose(first[1] - first[0], [0.012, 0.0])
