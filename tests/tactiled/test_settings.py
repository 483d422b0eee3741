"""Settings from flags and file; refusals say what was given and what is allowed."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import pytest

from tactile_core.calibration import nominal, save
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


def test_ports_and_names_are_paired_in_order(make: Make) -> None:
    settings = make(
        "--port", "a", "--name", "left", "--can", "socketcan:can0", "--name", "hand",
        "--port", "b", "--name", "right", "--board", "anyskin",
    )  # fmt: skip
    assert [(p.name, p.spec, p.medium) for p in settings.ports] == [
        ("left", "a", "serial"),
        ("hand", "socketcan:can0", "can"),
        ("right", "b", "serial"),
    ]


def test_flags_override_the_file(make: Make, tmp_path: Path) -> None:
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


def test_replay_is_logged_only_on_request(make: Make) -> None:
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
        (["--can", "can0"], "expected INTERFACE"),
        (["--can", "socketcan:can0", "--board", "anyskin"], "serial"),
        (["--port", "a", "--mcap", "x.mcap"], "--mcap"),
        (["--port", "a", "--config", "none.toml"], "none.toml"),
        (["--port", "a", "--calibration", "none.cal.toml"], "none.cal.toml"),
        (["--port", "a", "--feature-rate", "1e9"], "allowed"),
    ],
)
def test_impossible_settings_are_refused(make: Make, words: list[str], said: str) -> None:
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
def test_bad_file_is_refused_with_its_location(
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
    assert f"{value!r} given; allowed" in told


def test_exit_status_of_the_command(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert main(["--port", "a", "--name", "*"]) == 2
    assert "allowed" in capsys.readouterr().err
    missing = ["--listen", "tcp/127.0.0.1:0", "--no-log", "--port", str(tmp_path / "none")]
    assert main(missing) == 3
    assert "there is no port" in capsys.readouterr().err
    assert main(["--listen", "tcp/0.0.0.0:0", "--no-log", "--port", "a"]) == 3
    assert "--insecure" in capsys.readouterr().err
    assert main(["--list-ports"]) == 0


def test_layouts_and_arrays_apply_to_all_ports_or_each(make: Make, tmp_path: Path) -> None:
    settings = make(
        "--port", "a", "--board", "floats:5xyz", "--arrays", "5",
        "--port", "b", "--board", "anyskin", "--arrays", "5+5",
    )  # fmt: skip
    assert [(p.kind, p.arrays) for p in settings.ports] == [
        ("floats:5xyz", (5,)),
        ("anyskin", (5, 5)),
    ]
    settings = make("--port", "a", "--port", "b", "--arrays", "5+5")
    assert [p.arrays for p in settings.ports] == [(5, 5), (5, 5)]
    file = tmp_path / "t.toml"
    file.write_text("[[board]]\nport = 'a'\nkind = 'int16:5txyz,big'\narrays = '3+2'\n")
    (port,) = make("--config", str(file)).ports
    assert (port.kind, port.arrays) == ("int16:5txyz,big", (3, 2))


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (("--port", "a", "--board", "skin"), "auto, tactile, anyskin"),
        (("--port", "a", "--board", "floats:5xy"), "x, y and z once each"),
        (("--port", "a", "--arrays", "5+x"), "as in 5+5"),
        (("--port", "a", "--arrays", "15+10"), "at most 20"),
    ],
)
def test_invalid_layouts_and_arrays_are_bad_arguments(
    make: Make, words: tuple[str, ...], named: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        make(*words)
    assert ended.value.code == 2
    assert named in capsys.readouterr().err


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("kind = 'floats:5xy'", "x, y and z once each"),
        ("kind = 'skin'", "or a layout such as floats:5xyz"),
        ("arrays = '5x5'", "joined by +"),
        ("arrays = '15+10'", "at most 20"),
    ],
)
def test_file_error_locates_a_wrong_layout_or_array(
    make: Make, tmp_path: Path, text: str, named: str
) -> None:
    file = tmp_path / "t.toml"
    file.write_text(f"[[board]]\nport = 'a'\n{text}\n")
    with pytest.raises(SettingsError, match=r"board\[0\]") as caught:
        make("--config", str(file))
    assert named in str(caught.value)


@pytest.mark.parametrize("spec", ["slcan:/dev/x@123456", "slcan:/dev/x@1000000/7000000+fd"])
def test_unsupported_bit_rate_is_a_bad_argument(make: Make, spec: str) -> None:
    with pytest.raises(SettingsError, match=r"an slcan adapter has .*000"):
        make("--can", spec)
    for good in ("slcan:/dev/x@83333", "slcan:/dev/x@1000000/8000000+fd", "socketcan:can0@123456"):
        assert make("--can", good).ports[0].spec == good


def test_arrays_apply_to_serial_boards_only(make: Make) -> None:
    with pytest.raises(SettingsError, match="boards on a CAN bus say it themselves"):
        make("--can", "socketcan:can0", "--arrays", "5+5")
    with pytest.raises(SettingsError, match="--arrays go with --port"):
        make("--arrays", "5+5")
