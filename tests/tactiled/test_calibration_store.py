"""The choice of a calibration for a board, and refusals."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sensor_proto.packets import Descriptor
from tactile_core.calibration import load, nominal, nominal_from_descriptor, save, saves
from tactile_core.geometry import anyskin_jaws
from tactile_core.log.recorder import Recorder
from tactiled.boards.events import Identity, Refusal
from tactiled.calibration_store import CalibrationStore, Choice


def pad(descriptor: Descriptor, serial: str = "00000000000000aa") -> Identity:
    told = replace(descriptor, unique_id=bytes.fromhex(serial))
    shapes = tuple((a.rows, a.columns) for a in told.arrays)
    return Identity(serial, "pad", "1", shapes, 493.0, told)


def skin(serial: str = "", magnetometers: int = 5) -> Identity:
    return Identity(serial, "anyskin", "", ((1, magnetometers),), None)


def file_of(folder: Path, descriptor: Descriptor, serial: str) -> Path:
    calibration = nominal_from_descriptor(replace(descriptor, unique_id=bytes.fromhex(serial)))
    path = folder / f"{serial}.cal.toml"
    save(replace(calibration, nominal=False), path)
    return path


def test_files_are_matched_by_serial_number(tmp_path: Path, descriptor: Descriptor) -> None:
    paths = [file_of(tmp_path, descriptor, s) for s in ("00000000000000bb", "00000000000000aa")]
    chosen = CalibrationStore(paths, strict=True).choose(pad(descriptor))
    assert isinstance(chosen, Choice)
    assert chosen.path == paths[1]
    assert chosen.warning == ""


def test_calibration_of_another_board_is_refused_with_both_names(
    tmp_path: Path, descriptor: Descriptor
) -> None:
    path = file_of(tmp_path, descriptor, "00000000000000bb")
    refusal = CalibrationStore([path], strict=True).choose(pad(descriptor))
    assert isinstance(refusal, Refusal)
    assert "00000000000000bb" in refusal.problem
    assert "00000000000000aa" in refusal.problem
    assert refusal.remedy


def test_boards_without_a_file_use_nominal_values(tmp_path: Path, descriptor: Descriptor) -> None:
    path = file_of(tmp_path, descriptor, "00000000000000bb")
    chosen = CalibrationStore([path], strict=False).choose(pad(descriptor))
    assert isinstance(chosen, Choice)
    assert chosen.calibration.nominal
    assert "nominal" in chosen.warning


def test_calibration_with_different_arrays_is_refused(
    tmp_path: Path, descriptor: Descriptor
) -> None:
    path = file_of(tmp_path, descriptor, "00000000000000aa")
    grown = replace(pad(descriptor), shapes=((4, 4), (1, 3)))
    refusal = CalibrationStore([path], strict=True).choose(grown)
    assert isinstance(refusal, Refusal)
    assert "4 × 4" in refusal.problem


@pytest.mark.parametrize("magnetometers", [1, 5, 7, 20])
def test_boards_without_a_serial_number_use_nominal_values(magnetometers: int) -> None:
    chosen = CalibrationStore([], strict=True).choose(skin(magnetometers=magnetometers))
    assert isinstance(chosen, Choice)
    assert chosen.calibration.geometry.taxels == magnetometers


def test_board_without_serial_number_takes_the_only_fitting_file(tmp_path: Path) -> None:
    path = tmp_path / "skin.cal.toml"
    save(replace(nominal("anyskin", "USB1"), nominal=False), path)
    chosen = CalibrationStore([path], strict=True).choose(skin())
    assert isinstance(chosen, Choice)
    assert chosen.path == path
    assert "cannot confirm" in chosen.warning
    assert isinstance(CalibrationStore([path], strict=True).choose(skin("USB2")), Refusal)


def test_replay_uses_its_recorded_calibration(tmp_path: Path, descriptor: Descriptor) -> None:
    calibration = load(file_of(tmp_path, descriptor, "00000000000000aa"))
    log = tmp_path / "run.mcap"
    recorder = Recorder(log)
    recorder.attach("pad.cal.toml", "application/toml", saves(calibration).encode())
    recorder.attach("rim.cal.toml", "application/toml", b"")
    assert recorder.close(60)
    store = CalibrationStore([], strict=True)
    store.adopt_from_log(log, "pad")
    chosen = store.choose(pad(descriptor))
    assert isinstance(chosen, Choice)
    assert chosen.calibration.hash == calibration.hash
    given = CalibrationStore([file_of(tmp_path, descriptor, "00000000000000aa")], strict=True)
    given.adopt_from_log(log, "pad")
    chosen = given.choose(pad(descriptor))
    assert isinstance(chosen, Choice)
    assert chosen.path != log


def test_reload_reads_the_current_file(tmp_path: Path, descriptor: Descriptor) -> None:
    path = file_of(tmp_path, descriptor, "00000000000000aa")
    store = CalibrationStore([path], strict=True)
    first = store.choose(pad(descriptor))
    assert isinstance(first, Choice)
    save(replace(first.calibration, provenance="again"), path)
    store.reload()
    second = store.choose(pad(descriptor))
    assert isinstance(second, Choice)
    assert second.calibration.hash != first.calibration.hash


def controller(arrays: tuple[int, ...] | None = None, magnetometers: int = 10) -> Identity:
    return Identity("USB1", "anyskin", "", ((1, magnetometers),), None, arrays=arrays)


def test_controller_defaults_to_arrays_of_five() -> None:
    for arrays, sizes in ((None, [5, 5]), ((5, 5), [5, 5]), ((6, 4), [6, 4]), ((10,), [10])):
        chosen = CalibrationStore([], strict=True).choose(controller(arrays))
        assert isinstance(chosen, Choice)
        geometry = chosen.calibration.geometry
        assert [a.taxels for a in geometry.arrays] == sizes
        assert geometry.posed == (len(sizes) == 1)
    refusal = CalibrationStore([], strict=True).choose(controller((5, 4)))
    assert isinstance(refusal, Refusal)
    assert "5+4 names 9 magnetometers" in refusal.problem
    assert "5+5" in refusal.remedy


def test_file_describes_arrays_of_a_shared_controller(tmp_path: Path) -> None:
    path = tmp_path / "jaws.cal.toml"
    jaws = anyskin_jaws(2)
    typical = nominal("anyskin", "USB1", 10)
    placed = tuple(
        replace(array, geometry=geometry)
        for array, geometry in zip(typical.arrays, jaws.arrays, strict=True)
    )
    save(replace(typical, nominal=False, arrays=placed), path)
    chosen = CalibrationStore([path], strict=True).choose(controller())
    assert isinstance(chosen, Choice)
    assert chosen.calibration.geometry.posed
    np.testing.assert_array_equal(
        chosen.calibration.arrays[1].geometry.position, jaws.arrays[1].position
    )
    assert isinstance(CalibrationStore([path], strict=True).choose(controller((5, 5))), Choice)
    for arrays, words in (((10,), "--arrays says 10"), ((4, 6), "--arrays says 4+6")):
        refusal = CalibrationStore([path], strict=True).choose(controller(arrays))
        assert isinstance(refusal, Refusal)
        assert words in refusal.problem
    assert isinstance(
        CalibrationStore([path], strict=True).choose(controller(magnetometers=15)), Refusal
    )
