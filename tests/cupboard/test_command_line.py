"""``simdevice cupboard`` as a user meets it before anything moves."""

from __future__ import annotations

import socket
import sys
from pathlib import Path

import pytest

from reachd.goals import make_goal, parse_target
from reachd.parameters import SETS
from sim_device.cli import main

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
    (["--arm", "a/b"], "'a/b' is no name"),
    (["--world", "*"], "'*' is no name"),
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


@pytest.mark.parametrize(("arguments", "said"), BAD, ids=lambda v: " ".join(v)[:40])
def test_bad_input_is_refused_with_what_is_allowed(
    arguments: list[str],
    said: str,
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
    assert said in " ".join(errors.split())
    assert "Traceback" not in errors
    assert not Path("board0").is_symlink()


def test_what_the_system_refuses_is_told_apart(
    scene_file: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        monkeypatch.setitem(sys.modules, "pymunk", None)
        for arguments, said in (
            (["--engine", "pymunk"], "pip install 'tactile-reach[crosscheck]'"),
            (["--listen", f"tcp/127.0.0.1:{port}"], "is in use: another arm runs"),
            (["--listen", "tcp/0.0.0.0:1"], "leaves this machine unprotected"),
        ):
            quiet = ["--connect", f"tcp/127.0.0.1:{port}"]
            assert main(["cupboard", "--scene", str(scene_file), *quiet, *arguments]) == 3
            assert said in capsys.readouterr().err


@pytest.mark.parametrize("name", ["authors_sim", "hardware"])
def test_the_goal_of_a_scene_is_one_that_reachd_takes(
    name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["cupboard", "--scene", name, "--seed", "7", "--print-goal"]) == 0
    text = capsys.readouterr().out.strip()
    goal = make_goal(*parse_target(text), SETS[name])
    assert goal.x > 0.3
    assert main(["cupboard", "--scene", name, "--seed", "7", "--print-goal"]) == 0
    assert capsys.readouterr().out.strip() == text


def test_recorded_scenes_are_found_by_their_number(capsys: pytest.CaptureFixture[str]) -> None:
    folder = Path(__file__).parents[3] / "shared/data/authors_scenes"
    if not folder.is_dir():
        pytest.skip("the recorded scenes are not here (../shared/data/authors_scenes)")
    goals = []
    for name in ("authors_sim_recorded", f"recorded:{folder}/scenes_1_60.json.gz"):
        assert main(["cupboard", "--scene", name, "--seed", "7", "--print-goal"]) == 0
        goals.append(capsys.readouterr().out)
        assert main(["cupboard", "--scene", name, "--seed", "99", "--print-goal"]) == 2
        assert "scenes_1_60.json.gz has 1 to 60" in capsys.readouterr().err
    assert goals[0] == goals[1]
    assert goals[0].startswith("0.3580,")
