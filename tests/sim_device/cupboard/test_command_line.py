"""Command line of ``simdevice cupboard``, before anything moves."""

from __future__ import annotations

import socket
import sys
from pathlib import Path

import pytest

from reachd.services import make_goal, parse_target
from reachd.strategies.parameters import SETS
from sim_device.cli import main
from sim_device.world import scene_loading
from sim_device.world.scene_loading import FOLDER_VARIABLE, RECORDED_OUTCOMES, RECORDED_SCENES
from tests.support.paths import DATA

BAD = [
    (
        ["--scene", "attic"],
        "authors_sim_recorded, recorded:FILE.json.gz, FILE.json",
    ),
    (["--scene", "none.json"], "none.json: cannot be read (No such file or directory)"),
    (["--scene", "bad.json"], "bad.json: no JSON"),
    (["--scene", "wrong.json"], "wrong.json: scene format is None; this version reads 1"),
    (["--scene", "recorded:none.gz"], "cannot read none.gz"),
    (["--seed", "-1"], "allowed: a whole number from 0"),
    (["--engine", "bullet"], "bullet"),
    (["--arm", "a/b"], "'a/b' is not a valid name"),
    (["--world", "*"], "'*' is not a valid name"),
    (["--arm-fault", "gremlins@5s"], "KIND one of silent, frozen, stale, biased, refuses_limits"),
    (["--arm-fault", "silent@5"], "allowed: KIND, KIND@Ts or KIND@Ts+Ds"),
    (["--arm-fault", "silent@5s+0s"], "lasts 0 s"),
    (["--arm-noise", "force=lots"], "allowed: NAME=STD"),
    (["--arm-noise", "force=nan"], "allowed: NAME=STD"),
    (["--arm-noise", "smell=1"], "position (m), heading (rad)"),
    (["--arm-latency", "0.2"], "allowed: 0 to 0.04 s"),
    (["--arm-latency", "nan"], "'nan' given"),
    (["--arm-rate", "50"], "50"),
    (["--faults", "busoff@1s+1s"], "busoff is a fault of CAN boards"),
    (["--duration", "0"], "'0' given"),
]


@pytest.mark.parametrize(("arguments", "message"), BAD, ids=lambda v: " ".join(v)[:40])
def test_bad_input_is_refused_with_allowed_values(
    arguments: list[str],
    message: str,
    scene_file: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("bad.json").write_text("{")
    Path("wrong.json").write_text("{}")
    scene = [] if "--scene" in arguments else ["--scene", str(scene_file)]
    try:
        code = main(["cupboard", "--pty", "board0", *scene, *arguments])
    except SystemExit as ended:  # argparse
        code = int(ended.code or 0)
    assert code == 2
    errors = capsys.readouterr().err
    assert message in " ".join(errors.split())
    assert "Traceback" not in errors
    assert not Path("board0").is_symlink()


def test_system_errors_are_distinguished_from_bad_input(
    scene_file: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        monkeypatch.setitem(sys.modules, "pymunk", None)
        monkeypatch.setitem(sys.modules, "numba", None)
        for arguments, code, said in (
            (["--engine", "pymunk"], 2, "pip install 'tactile-reach[crosscheck]'"),
            (["--engine", "planar"], 2, "pip install 'tactile-reach[train]'"),
            (["--listen", f"tcp/127.0.0.1:{port}"], 3, "is in use: another arm runs"),
            (["--listen", "tcp/0.0.0.0:1"], 3, "leaves this machine unprotected"),
        ):
            quiet = ["--connect", f"tcp/127.0.0.1:{port}"]
            assert main(["cupboard", "--scene", str(scene_file), *quiet, *arguments]) == code
            assert said in capsys.readouterr().err


@pytest.mark.parametrize("name", ["authors_sim", "hardware"])
def test_scene_goal_is_accepted_by_reachd(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["cupboard", "--scene", name, "--seed", "7", "--print-goal"]) == 0
    text = capsys.readouterr().out.strip()
    goal = make_goal(*parse_target(text), SETS[name])
    assert goal.x > 0.3
    assert main(["cupboard", "--scene", name, "--seed", "7", "--print-goal"]) == 0
    assert capsys.readouterr().out.strip() == text


FOUR = DATA / "recorded_scenes"


def test_recorded_scenes_are_found_by_their_number(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / RECORDED_SCENES).write_bytes((FOUR / "scenes_5_8.json.gz").read_bytes())
    monkeypatch.setenv(FOLDER_VARIABLE, str(tmp_path))
    goals = []
    for name in ("authors_sim_recorded", f"recorded:{tmp_path / RECORDED_SCENES}"):
        assert main(["cupboard", "--scene", name, "--seed", "7", "--print-goal"]) == 0
        goals.append(capsys.readouterr().out)
        assert main(["cupboard", "--scene", name, "--seed", "99", "--print-goal"]) == 2
        assert "scenes_1_60.json.gz has 5 to 8" in capsys.readouterr().err
    assert goals[0] == goals[1]
    assert goals[0].startswith("0.3580,")


@pytest.mark.parametrize("place", ["folder", "home"])
def test_missing_recorded_scenes_are_asked_for(
    place: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(scene_loading, "_BESIDE_CHECKOUT", tmp_path / "none")
    monkeypatch.delenv(FOLDER_VARIABLE, raising=False)
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    if place == "folder":
        monkeypatch.setenv(FOLDER_VARIABLE, str(tmp_path / "empty"))
    asked = tmp_path / ("empty" if place == "folder" else "tactile-reach/authors_scenes")
    words = ["cupboard", "--scene", "authors_sim_recorded", "--seed", "7", "--print-goal"]
    assert main(words) == 2
    message = capsys.readouterr().err
    assert f"{RECORDED_SCENES} is not in {asked}" in message
    assert f"put {RECORDED_SCENES} and {RECORDED_OUTCOMES} there" in message
    asked.mkdir(parents=True)
    (asked / RECORDED_SCENES).write_bytes((FOUR / "scenes_5_8.json.gz").read_bytes())
    assert main(words) == 0
