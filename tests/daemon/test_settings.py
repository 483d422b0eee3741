"""Flags and file to settings, and every refusal with what was given and what is allowed."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import pytest

from tactile_bus.calibration import nominal, save
from tactiled.arguments import make_parser
from tactiled.cli import main
from tactiled.settings import Settings, SettingsError, make_settings

Make = Callable[..., Settings]


@pytest.fixture
def make() -> Make:
    def made(*words: str) -> Settings:
        return make_settings(make_parser().parse_args(words))

    return made


def test_one_port_alone_is_enough(make: Make) -> None:
    settings = make("--port", "/dev/ttyACM0")
    (port,) = settings.ports
    assert (port.name, port.spec, port.kind, port.baud) == (
        "board0",
        "/dev/ttyACM0",
        "auto",
        115200,
    )
    assert settings.pipeline.method == "consensus"
    assert settings.log == Path("tactile-logs")
    assert settings.bus.listen is None
    assert not settings.replay


def test_ports_and_names_go_together_in_their_order(make: Make) -> None:
    settings = make(
        "--port", "a", "--name", "left", "--can", "socketcan:can0", "--name", "hand",
        "--port", "b", "--name", "right", "--board", "anyskin",
    )  # fmt: skip
    assert [(p.name, p.spec, p.medium) for p in settings.ports] == [
        ("left", "a", "serial"),
        ("hand", "socketcan:can0", "can"),
        ("right", "b", "serial"),
    ]


def test_flags_win_over_the_file(make: Make, tmp_path: Path) -> None:
    file = tmp_path / "t.toml"
    file.write_text(
        "rate = 50\n[[board]]\nport = 'a'\n[compensation]\nmethod = 'off'\nrate = 2\n"
        "[sensing]\nfeature_rate = 15\ntip_light_n = [1.0, 5.0]\n"
    )
    settings = make("--config", str(file))
    assert settings.rate == 50
    assert settings.pipeline.method == "off"
    assert settings.pipeline.feature_rate_hz == 15
    assert settings.pipeline.tip_light_n == (1.0, 5.0)
    settings = make(
        "--config", str(file), "--rate", "25", "--compensation", "ransac", "--port", "b"
    )
    assert settings.rate == 25
    assert settings.pipeline.method == "ransac"
    assert settings.ports[0].spec == "b"


def test_boards_of_a_bus_are_named_by_node(make: Make, tmp_path: Path) -> None:
    file = tmp_path / "t.toml"
    file.write_text(
        "[[board]]\nname = 'left'\ncan = 'socketcan:can0'\nnode = 3\n"
        "[[board]]\nname = 'right'\ncan = 'socketcan:can0'\nnode = 4\n"
        "[[board]]\nport = 'a'\n"
    )
    bus, port = make("--config", str(file)).ports
    assert bus.nodes == {3: "left", 4: "right"}
    assert port.name == "board2"


def test_calibrations_in_a_file_are_relative_to_it(make: Make, tmp_path: Path) -> None:
    save(nominal("finger", "11"), tmp_path / "x.cal.toml")
    file = tmp_path / "t.toml"
    file.write_text("[[board]]\nport = 'a'\ncalibration = 'x.cal.toml'\n")
    assert make("--config", str(file)).calibrations == (tmp_path / "x.cal.toml",)


def test_a_replay_is_logged_only_when_asked(make: Make) -> None:
    settings = make("--mcap", "x.mcap", "--speed", "inf")
    assert settings.replay
    assert settings.log is None
    assert math.isinf(settings.speed)
    assert make("--mcap", "x.mcap", "--log", "y.mcap").log == Path("y.mcap")
    assert make("--port", "a", "--no-log").log is None


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ([], "--port"),
        (["--name", "a"], "--port"),
        (["--port", "a", "--port", "a"], "given twice"),
        (["--port", "a", "--port", "b", "--name", "x"], "1 names for 2 ports"),
        (["--port", "a", "--port", "b", "--name", "x", "--name", "x"], "given twice"),
        (["--port", "a", "--name", "a/b"], "allowed"),
        (["--can", "can0"], "allowed"),
        (["--can", "socketcan:can0", "--board", "anyskin"], "serial"),
        (["--port", "a", "--mcap", "x.mcap"], "--mcap"),
        (["--port", "a", "--config", "none.toml"], "none.toml"),
        (["--port", "a", "--calibration", "none.cal.toml"], "none.cal.toml"),
        (["--port", "a", "--feature-rate", "1e9"], "allowed"),
    ],
)
def test_what_cannot_be_is_refused(make: Make, words: list[str], said: str) -> None:
    with pytest.raises(SettingsError, match=said):
        make(*words)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("rate = -1\n", "t.toml:1: rate = -1"),
        ("rate = nan\n", "t.toml:1: rate = nan"),
        ("\n\n[[board]]\nport = 'a'\nkind = 'skin'\n", "t.toml:5: board[0].kind"),
        ("[[board]]\nprot = 'a'\n", "port"),
        ("[[board]]\nname = 'a'\n", "either port or can"),
        ("[[board]]\nport = 'a'\nnode = 1\n", "node goes with can"),
        ("[compensation]\nmethod = 'mean'\n", "consensus"),
        ("[log.recorder]\nsplit_seconds = 0\n", "split_seconds"),
        ("[sensing]\ntip_light_n = [5.0, 1.0]\n[[board]]\nport = 'a'\n", "tip_light_n"),
        ("x = [\n", "t.toml"),
    ],
)
def test_a_bad_file_is_refused_with_its_place(
    make: Make, tmp_path: Path, text: str, said: str
) -> None:
    file = tmp_path / "t.toml"
    file.write_text(text)
    with pytest.raises(SettingsError) as caught:
        make("--config", str(file))
    assert said in str(caught.value)


@pytest.mark.parametrize("flag", ["--rate", "--feature-rate", "--compensation-rate", "--duration"])
@pytest.mark.parametrize("value", ["0", "-1", "nan", "inf", "x"])
def test_rates_and_times_are_finite_and_above_zero(
    flag: str, value: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as caught:
        main(["--port", "a", flag, value])
    assert caught.value.code == 2
    told = capsys.readouterr().err
    assert flag in told
    assert f"{value} given; allowed" in told


def test_exit_status_of_the_command(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert main(["--port", "a", "--name", "*"]) == 2
    assert "allowed" in capsys.readouterr().err
    missing = ["--listen", "tcp/127.0.0.1:0", "--no-log", "--port", str(tmp_path / "none")]
    assert main(missing) == 3
    assert "there is no port" in capsys.readouterr().err
    assert main(["--listen", "tcp/0.0.0.0:0", "--no-log", "--port", "a"]) == 3
    assert "--insecure" in capsys.readouterr().err
    assert main(["--list-ports"]) == 0
