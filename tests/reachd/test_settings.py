"""Settings of reachd from flags and file; refusals come before anything is opened."""

from __future__ import annotations

from pathlib import Path

import pytest

from reachd.arguments import make_parser
from reachd.cli import main
from reachd.settings import Settings, SettingsError, make_settings


def settings(*words: str) -> Settings:
    return make_settings(make_parser().parse_args(words))


def refusal(*words: str) -> str:
    with pytest.raises(SettingsError) as caught:
        settings(*words)
    return str(caught.value)


def write(folder: Path, text: str) -> str:
    path = folder / "reach.toml"
    path.write_text(text)
    return str(path)


def test_target_alone_is_enough() -> None:
    s = settings("--target", "0.358,0.03")
    assert s.goal is not None
    assert (s.goal.x, s.goal.y, s.goal.radius, s.goal.time_limit) == (0.358, 0.03, 0.0075, 40.0)
    assert (s.strategy, s.parameters.name) == ("hybrid_event", "hardware")
    assert (s.board, s.arm, s.name) == ("board0", "arm", "reach")
    assert not s.serve
    assert str(s.log) == "tactile-logs"
    assert s.bus.role == "reachd"


def test_without_target_reachd_serves() -> None:
    assert settings().serve
    assert settings("--target", "0.3,0", "--serve").serve
    assert "--target" in refusal("--once")


def test_missing_seed_is_drawn_at_random() -> None:
    assert settings("--serve").seed != settings("--serve").seed
    assert settings("--seed", "7").seed == 7


def test_file_sets_everything_and_flags_override(tmp_path: Path) -> None:
    path = write(
        tmp_path,
        """
        strategy = "burrow"
        set = "authors_sim"
        board = "finger"
        target = [0.3, 0.1]
        time_limit = 15
        home = [-0.2, 0.0, 90.0]
        auto_reset = true
        [parameters]
        burrow_amplitude = 0.5
        safety.force = 12
        [inputs]
        board_clock = "remote"
        [loop]
        priority = 0
        [bus]
        connect = []
        [log]
        enabled = false
        """,
    )
    s = settings("--config", path, "--target", "0.2,0.0", "--strategy", "straight")
    assert (s.strategy, s.board, s.parameters.name) == ("straight", "finger", "authors_sim")
    assert s.goal is not None
    assert (s.goal.x, s.goal.time_limit) == (0.2, 15.0)
    assert s.home is not None
    assert s.home.heading == pytest.approx(1.5707963)
    assert (s.parameters.burrow_amplitude, s.parameters.safety.force) == (0.5, 12.0)
    assert (s.remote_board, s.remote_arm, s.priority, s.log) == (True, False, 0, None)
    assert s.bus.connect_endpoints() == ()


@pytest.mark.parametrize(
    ("text", "line", "words"),
    [
        ("set = 'x'", 0, "authors_sim"),
        ("\nbord = 'a'", 2, "did you mean board?"),
        ("\n\n[parameters]\n\nv_max = -1.0", 5, "v_max"),
        ("[parameters]\nv_mx = 1.0", 2, "did you mean v_max"),
        ("[parameters.safety]\narm_age = 0.1\nforce = 0", 3, "force"),
        ("[parameters]\nsafety.command_expiry = 0.5", 2, "command_expiry"),
        ("[parameters.safety]\ndisabled = ['not_armed']", 2, "cannot be switched off"),
        ("[inputs]\nwait_s = 0", 2, "above 0"),
        ("radius = inf", 1, "finite"),
        ("[inputs]\nboard_clock = 'both'", 2, "remote, same"),
    ],
)
def test_wrong_file_is_refused_with_its_line(
    tmp_path: Path, text: str, line: int, words: str
) -> None:
    path = write(tmp_path, text)
    said = refusal("--config", path)
    assert words in said
    if line:
        assert said.startswith(f"{path}:{line}: ")


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (("--target", "0.3"), "X,Y"),
        (("--target", "0.3,zero"), "X,Y"),
        (("--target", "nan,0"), "not finite"),
        (("--target", "0.5,0"), "outside the region"),
        (("--target", "0.3,0.4"), "outside the region"),
        (("--set", "paper"), "hardware, authors_sim"),
        (("--radius", "0.01"), "--target"),
        (("--home", "1,2"), "X,Y,DEGREES"),
        (("--home", "1,2,inf"), "not finite"),
        (("--home", "9,0,0"), "the pivot is at 9.000, 0.000 m, outside the region"),
        (("--home=-0.2,0.2,90",), "the tip is at -0.200, 0.358 m, outside the region"),
        (("--board", "a/b"), "letters"),
        (("--arm", "*"), "letters"),
    ],
)
def test_wrong_flags_are_refused_with_allowed_values(flags: tuple[str, ...], words: str) -> None:
    assert words in refusal(*flags)


@pytest.mark.parametrize("value", ["0", "-1", "nan", "inf", "soon"])
@pytest.mark.parametrize("flag", ["--time-limit", "--radius", "--wait"])
def test_times_and_sizes_are_finite_and_above_zero(
    flag: str, value: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as caught:
        settings("--target", "0.3,0", f"{flag}={value}")
    assert caught.value.code == 2
    assert f"{value!r} given; allowed" in capsys.readouterr().err


def test_unknown_strategy_lists_available_strategies(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--strategy", "tunnel", "--target", "0.3,0"]) == 2
    said = capsys.readouterr().err
    assert "'tunnel'" in said
    assert all(
        name in said for name in ("straight", "burrow", "excavate", "hybrid_clock", "hybrid_event")
    )


def test_own_strategy_is_found_in_the_working_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "reachd_test_own.py").write_text(
        "class Broken:\n    def __init__(self, parameters, rng):\n        raise KeyError('seen')\n"
    )
    monkeypatch.chdir(tmp_path)
    assert main(["--strategy", "reachd_test_own:Broken", "--target", "0.3,0"]) == 2
    assert "KeyError: 'seen'" in capsys.readouterr().err
