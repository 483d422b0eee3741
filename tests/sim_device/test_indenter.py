"""Press scripts: what they do and what they refuse."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sim_device.skin.indenter import load_script
from tactile_core.config import ConfigError
from tactile_core.geometry import anyskin, finger
from tests.support.paths import ROOT

PRESS = """
[[press]]
array = "left"
u_mm = 8.25
v_mm = 8.0
normal_n = 4.0
shear_n = [1.0, -0.5]
radius_mm = 6.0
start_s = 1.0
ramp_s = 0.5
hold_s = 2.0
repeat = 2
every_s = 5.0
"""


@pytest.fixture
def script(tmp_path: Path):
    def write(text: str) -> Path:
        path = tmp_path / "press.toml"
        path.write_text(text, encoding="utf-8")
        return path

    return write


def normal_at(indenter, seconds: float) -> float:
    return sum(-c.force[1] for c in indenter.contacts(seconds))


def test_press_rises_holds_falls_and_repeats(script) -> None:
    indenter = load_script(script(PRESS))
    # On the left side the inward normal is -y.
    levels = {0.9: 0, 1.25: 2, 1.5: 4, 3.4: 4, 3.75: 2, 4.1: 0, 5.9: 0, 6.25: 2, 8.0: 4, 9.1: 0}
    for seconds, newton in levels.items():
        assert normal_at(indenter, seconds) == pytest.approx(newton)
    assert indenter.duration == pytest.approx(9.0)


def test_press_position_and_direction_on_the_skin(script) -> None:
    (contact,) = load_script(script(PRESS)).contacts(2.0)
    left = finger().arrays[0]
    # 8.25, 8 mm from the middle of a 4 x 8 grid of 16.5 and 16 mm is a taxel.
    nearest = np.linalg.norm(left.position - contact.position, axis=1)
    assert nearest.min() == pytest.approx(0, abs=1e-12)
    x, y, z = left.rotation[nearest.argmin()].T
    assert contact.force @ x == pytest.approx(1.0)
    assert contact.force @ y == pytest.approx(-0.5)
    assert contact.force @ z == pytest.approx(-4.0)
    assert contact.radius == pytest.approx(0.006)


def test_press_position_in_the_end_effector_frame(script) -> None:
    text = "[[press]]\nposition_mm = [60.0, -28.5, 4.0]\nnormal_n = 2\nramp_s = 0\n"
    (contact,) = load_script(script(text)).contacts(0.5)
    assert contact.position == pytest.approx([0.06, -0.0285, 0.004])
    assert contact.force == pytest.approx([0, 2, 0])


def test_press_script_loops(script) -> None:
    indenter = load_script(script("loop_s = 10\n" + PRESS))
    assert normal_at(indenter, 2.0) == pytest.approx(normal_at(indenter, 42.0)) == 4
    assert indenter.contacts(2.0)[0].force == pytest.approx(indenter(12.0)[0].force)


def test_script_for_another_skin(script) -> None:
    text = '[[press]]\narray = "skin"\nnormal_n = 1\nramp_s = 0\n'
    (contact,) = load_script(script(text), anyskin()).contacts(0.1)
    assert contact.force == pytest.approx([-1, 0, 0])


def test_example_script_works() -> None:
    example = ROOT / "docs" / "press.toml"
    indenter = load_script(example)
    assert any(indenter.contacts(t / 10) for t in range(120))


def test_example_for_five_chips_leaves_time_to_tare() -> None:
    example = ROOT / "docs" / "press-anyskin.toml"
    indenter = load_script(example, anyskin())
    assert not any(indenter.contacts(t / 10) for t in range(50))
    pressed = [sum(-c.force[0] for c in indenter.contacts(t / 10)) for t in range(200)]
    assert {1.0, 2.0, 3.0, 5.0} <= {round(force, 6) for force in pressed}


@pytest.mark.parametrize(
    ("old", "new", "line", "message"),
    [
        ('array = "left"', 'array = "lft"', 3, 'array = "lft"; allowed: left, right'),
        ('array = "left"', "", 2, "array is missing; it must be one of left"),
        ("normal_n = 4.0", "normal_n = -4", 6, "normal_n = -4; allowed: a finite number above 0"),
        ("normal_n = 4.0", "normal_n = nan", 6, "normal_n = nan; allowed"),
        ("normal_n = 4.0", 'normal_n = "4"', 6, 'normal_n = "4"; allowed'),
        ("normal_n = 4.0", "normal_n = true", 6, "normal_n = true; allowed"),
        ("normal_n = 4.0", "", 2, "normal_n is missing"),
        ("u_mm = 8.25", "u_mm = 825", 4, "u_mm = 825; allowed: a number from -64.75 to 64.75 mm"),
        ("shear_n = [1.0, -0.5]", "shear_n = [1.0]", 7, "shear_n = .*an array of 2"),
        ("shear_n = [1.0, -0.5]", "shear_n = [1, inf]", 7, r"shear_n\[1\] = inf; allowed"),
        ("start_s = 1.0", "start_s = -1", 9, "start_s = -1; allowed: a finite number from 0"),
        ("repeat = 2", "repeat = 0", 12, "repeat = 0; allowed: a whole number from 1"),
        ("repeat = 2", "repeat = 1.5", 12, "repeat = 1.5; allowed: a whole number"),
        ("every_s = 5.0", "every_s = 1", 13, "every_s = 1; allowed: at least 3 s"),
        ("every_s = 5.0", "evry_s = 5", 13, "evry_s .did you mean every_s"),
        (
            "v_mm = 8.0",
            "position_mm = [0, 0, 0]",
            3,
            'array = "left"; allowed: either position_mm, or',
        ),
    ],
)
def test_errors_name_file_line_key_and_remedy(script, old, new, line, message) -> None:
    path = script(PRESS.replace(old, new))
    with pytest.raises(ConfigError, match=message) as caught:
        load_script(path)
    assert str(caught.value).startswith(f"{path}:{line}: ")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "press.*at least one .*press.* table"),
        ("press = 3", "press.*at least one .*press.* table"),
        ("press = [3]", r"press\[0\] = 3; allowed: a table"),
        ("lop_s = 3\n" + PRESS, "unknown key lop_s .did you mean loop_s"),
        ("loop_s = 3\n" + PRESS, "loop_s = 3; allowed: at least 9"),
        ("loop_s = 0\n" + PRESS, "loop_s = 0; allowed: a finite number above 0"),
        ("[[press]\n", r"toml:1: Expected"),
        (
            "[[press]]\nposition_mm = [0, 200, 0]\nnormal_n = 1\n",
            "up to 12 mm from the nearest",
        ),
        (
            '[[press]]\narray = "tip"\nnormal_n = 1\nramp_s = 0\nhold_s = 0\n',
            "ramp_s and hold_s are both 0",
        ),
    ],
)
def test_senseless_scripts_are_refused(script, text, message) -> None:
    with pytest.raises(ConfigError, match=message):
        load_script(script(text))


def test_missing_and_unreadable_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"nowhere.toml: cannot be read .No such file"):
        load_script(tmp_path / "nowhere.toml")
    with pytest.raises(ConfigError, match="cannot be read"):
        load_script(tmp_path)
    binary = tmp_path / "binary.toml"
    binary.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ConfigError, match="not UTF-8"):
        load_script(binary)
