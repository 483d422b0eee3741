"""Mistakes of users: every message names file and remedy; exit status 2 and 3."""

from __future__ import annotations

import json
import os

import pytest

from tactile_core.calibration import load, nominal, save
from tactile_tools.calibrate import fit as fitting
from tactile_tools.calibrate.recipes import FORCE_RECIPES
from tactile_tools.cli import main


@pytest.fixture
def quick(monkeypatch):
    """Try only the linear recipe: messages about files do not depend on the model."""
    monkeypatch.setattr(fitting, "FORCE_RECIPES", FORCE_RECIPES[:1])


def run(capsys, *words):
    code = main(["calibrate", *map(str, words)])
    said = capsys.readouterr()
    assert "Traceback" not in said.err
    return code, said.out, said.err


def cut(columns):
    def edit(sensor, states):
        states[:] = [",".join(line.split(",")[:columns]) for line in states]

    return edit


def put(at, text, of=0):
    def edit(*files):
        files[of][at] = text

    return edit


def swap(sensor, states):
    sensor[10], sensor[11] = sensor[11], sensor[10]


def empty(sensor, states):
    sensor.clear()


def short(sensor, states):
    del sensor[20:]
    del states[20:]


def no_readings(sensor, states):
    states[:] = [line.rpartition(",")[0] + ",-1" for line in states]


def pressed_at_start(sensor, states):
    states[2] = states[2].rpartition(",")[0] + ",1500"


def lose_column(sensor, states):
    sensor[:] = [line.rpartition(",")[0] for line in sensor]


@pytest.mark.parametrize(
    ("edit", "words"),
    [
        (cut(3), ["states.csv", "3 columns", "gram-force"]),
        (lose_column, ["sensor.csv", "15 columns", "x, y, z"]),
        (empty, ["sensor.csv", "empty"]),
        (put(5, "1,2,3"), ["sensor.csv, line 6", "3 columns, 16 before"]),
        (put(5, "a,b,c"), ["sensor.csv, line 6", "allowed: numbers"]),
        (put(4, "1700000000.4,315,-100,280,nan", of=1), ["not a finite number"]),
        (swap, ["time does not increase", "11 to 12", "frames"]),
        (short, ["20 frames", "at least 50"]),
        (no_readings, ["0 labels", "at least 50"]),
        (pressed_at_start, ["first 1 s", "untouched"]),
    ],
    ids=lambda v: getattr(v, "__name__", None),
)
def test_bad_recording_is_refused_with_its_location(capsys, write_pair, edit, words):
    folder = write_pair(edit=edit)
    code, _, err = run(capsys, "evaluate", folder)
    assert code == 2
    for word in [str(folder), *words]:
        assert word in err


def test_recordings_of_other_or_no_boards_are_refused(capsys, write_pair, tmp_path):
    one, other = write_pair("a"), write_pair("b", taxels=4)
    out = tmp_path / "x.cal.toml"
    code, _, err = run(capsys, "fit", one, other, "--out", out, "--serial", "s")
    assert code == 2
    assert "4 magnetometers" in err
    code, _, err = run(capsys, "evaluate", one, "--split", "leave-one-out")
    assert code == 2
    assert "needs two recordings" in err
    code, _, err = run(capsys, "evaluate", one, one)
    assert code == 2
    assert "given twice" in err
    code, _, err = run(capsys, "evaluate", tmp_path / "none")
    assert code == 2
    assert "no such file" in err
    garbage = tmp_path / "log.mcap"
    garbage.write_bytes(b"not a log")
    code, _, err = run(capsys, "evaluate", garbage)
    assert code == 2
    assert str(garbage) in err


def test_unwritable_outputs_are_refused_before_work_starts(capsys, write_pair, tmp_path):
    folder = write_pair()
    for out, code in (("x.toml", 2), ("none/x.cal.toml", 3)):
        got, _, err = run(capsys, "fit", folder, "--serial", "s", "--out", tmp_path / out)
        assert got == code
        assert out in err
    code, _, err = run(capsys, "fit", folder, "--out", tmp_path / "x.cal.toml")
    assert code == 2
    assert "--serial" in err
    blocked = tmp_path / "blocked"
    blocked.write_text("a file")
    code, _, err = run(capsys, "evaluate", folder, "--report", blocked)
    assert code == 3
    assert str(blocked) in err
    base = tmp_path / "base.cal.toml"
    save(nominal("anyskin", "s", 4), base)
    words = ["--serial", "s", "--out", tmp_path / "x.cal.toml", "--base", base]
    code, _, err = run(capsys, "fit", folder, *words)
    assert code == 2
    assert "4 taxels" in err


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_unwritable_folder_is_refused(capsys, quick, write_pair, tmp_path):
    locked = tmp_path / "locked"
    locked.mkdir(mode=0o500)
    code, _, err = run(capsys, "fit", write_pair(), "--serial", "s", "--out", locked / "x.cal.toml")
    assert code == 3
    assert "cannot be written" in err


def test_fitted_file_names_its_recordings(capsys, quick, write_pair, tmp_path):
    folders = [write_pair("normal_1", rows=600), write_pair("normal_2", rows=600)]
    out, report = tmp_path / "x.cal.toml", tmp_path / "report"
    code, said, err = run(
        capsys, "fit", *folders, "--serial", "S7", "--out", out, "--report", report
    )
    assert (code, "normal_1" in said) == (0, True), err
    calibration = load(out)
    assert calibration.serial_number == "S7"
    assert not calibration.nominal
    assert "normal_2" in calibration.provenance
    names = [figure.name for figure in calibration.nets[0].figures]
    assert any("leave-one-out" in name for name in names)
    assert any("tail20" in name for name in names)
    assert (report / "index.html").stat().st_size > 500
    assert len(list(report.glob("*.png"))) == 2
    code, said, _ = run(capsys, "info", out, "--json")
    described = json.loads(said)
    assert described["serial_number"] == "S7"
    assert described["models"][0]["targets"] == {"normal": "N"}

    # the message names what is wrong by its key
    text = out.read_text()
    for old, new, words in (
        ("format_version = 3", "format_version = 9", ["newer than 3"]),
        ('targets = ["normal"]', 'targets = ["weight"]', ["net[0]", "weight", "normal"]),
        ("degree = 1", "degree = 99", ["net[0].degree", "99"]),
        ("lagged = 0", "lagged = 900", ["lagged is 900"]),
        ("mean = [", "mean = [nan, ", ["net[0].mean"]),
        ("mean = [", "mean = [1.0, ", ["mean has"]),
        ('kind = "linear"\ncolumns', 'kind = "cubic"\ncolumns', ["layer[0].kind", "rbf"]),
        ("delay_s = ", "surprise = 1\ndelay_s = ", ["unknown key net[0].surprise"]),
    ):
        assert old in text
        bad = tmp_path / "bad.cal.toml"
        bad.write_text(text.replace(old, new, 1))
        code, _, err = run(capsys, "info", bad)
        assert code == 2, new
        for word in [str(bad), *words]:
            assert word in err


def test_evaluation_is_json(capsys, quick, write_pair):
    code, said, _ = run(capsys, "evaluate", write_pair(rows=400), "--json")
    assert code == 0
    found = json.loads(said)
    assert found["split"] == "tail20"
    one = found["recordings"][0]
    assert 0 < one["labels_tested"] < one["labels_total"]
    assert one["targets"]["normal"]["rmse"] > 0
    assert found["summary"]["normal"]["aim"] == 0.18
    assert "field_noise_n" in one["limits"]
