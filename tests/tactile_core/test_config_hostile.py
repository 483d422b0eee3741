"""Any configuration is read, or refused quickly in one sentence (row 33)."""

from __future__ import annotations

import os
import socket
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from reachd.cli import main as reachd
from sim_device.cli import main as simdevice
from tactile_core.calibration import CalibrationError, load
from tactile_core.config import MAX_DEPTH, ConfigError, Document, printable, read_text
from tactiled.cli import main as tactiled

LIMIT = 1 << 20

BOMBS: dict[str, str | bytes] = {
    "number": "radius = " + "9" * 200_000,
    "negative": "radius = -" + "9" * 4_000,
    "hexadecimal": "radius = 0x" + "f" * 200_000,
    "just_too_long": f"radius = {1 << 63}",
    "in_an_array": "home = [1, 2, " + "7" * 5_000 + "]",
    "array": "a = " + "[" * 100_000 + "]" * 100_000,
    "inline": "a = " + "{b = " * 1_000 + "1" + "}" * 1_000,
    "header": "[" + ".".join(["a"] * 50_000) + "]\n",
    "key": ".".join(["a"] * 300_000) + " = 1\n",
    "spaced_key": " . ".join(["'a'"] * 50_000) + " = 1\n",
    "dotted": "".join(f"{'.'.join('a' * 200)}.b{i} = 1\n" for i in range(500)),
    "table": "".join(f"[{'.'.join('a' * n)}]\n" for n in range(1, 60)),
    "many": "".join(f"k{i} = 1\n" for i in range(20_000)),
    "zeros": b"\0\0\0",
    "latin": b'name = "\xff\xfe"',
    "escape": 'name = "\\u001b[2J"',
    "escaped_key": '"\\u001b[2J" = 1',
    "long_key": f"{'k' * 500_000} = 1",
    "date": "name = 9999-99-99",
    "huge": b"# " + bytes(2 << 20),
}


def lay(folder: Path, name: str) -> Path:
    """Create a hostile file, or something that is not a file."""
    path = folder / f"{name}.toml"
    if name == "fifo":
        os.mkfifo(path)
    elif name == "folder":
        path.mkdir()
    elif name == "loop":
        path.symlink_to(path)
    elif name == "socket":
        with socket.socket(socket.AF_UNIX) as made:
            made.bind(str(path))
    elif name == "endless":
        path.symlink_to("/dev/zero")
    else:
        content = BOMBS[name]
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


ALL = (*BOMBS, "fifo", "folder", "loop", "socket", "endless")


def commands(path: Path) -> dict[str, tuple[Callable[[list[str]], int], list[str]]]:
    """Every command that reads TOML, with arguments to read ``path``."""
    p = str(path)
    return {
        "tactiled --config": (tactiled, ["--config", p, "--port", "a", "--no-log"]),
        "tactiled --calibration": (tactiled, ["--calibration", p, "--port", "a", "--no-log"]),
        "reachd --config": (reachd, ["--config", p, "--target", "0.3,0", "--no-log"]),
        "simdevice --press": (simdevice, ["boards", "--pty", "p", "--press", p]),
    }


@pytest.mark.parametrize("name", ALL)
def test_every_command_refuses_bad_toml_in_one_sentence(
    tmp_path: Path, name: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    path = lay(tmp_path, name)
    for what, (command, words) in commands(path).items():
        assert command(words) == 2, what
        said = capsys.readouterr().err
        assert f"{name}.toml" in said or "nam" in said, (what, said)
        assert len(said.strip().splitlines()) == 1, (what, said)
        assert len(said) < 900, (what, len(said))
        assert said.strip().isprintable(), (what, said)
        assert "Traceback" not in said


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("number", [":1: ", "about 200000 digits", "at most 64 bits"]),
        ("hexadecimal", [":1: radius is a whole number", "at most 64 bits"]),
        ("in_an_array", ["about 5000 digits"]),
        ("just_too_long", [":1: radius is"]),
        ("header", [":1: nested too deeply"]),
        ("array", ["nested too deeply"]),
        ("fifo", ["it is a pipe, not a file"]),
        ("folder", ["Is a directory"]),
        ("loop", ["symbolic link"]),
        ("endless", ["it is a device, not a file"]),
        ("latin", [":1: not UTF-8"]),
        ("huge", ["over 1048576 bytes"]),
    ],
)
def test_refusal_says_where_and_why(tmp_path: Path, name: str, words: list[str]) -> None:
    path = lay(tmp_path, name)
    with pytest.raises(ConfigError) as caught:
        Document.read(path, LIMIT)
    for word in words:
        assert word in str(caught.value)


def test_toml_within_bounds_is_read() -> None:
    deep = ".".join("a" * (MAX_DEPTH - 1))
    assert Document.parse(f"[{deep}]\nb = {(1 << 63) - 1}\nc = -{1 << 63}\n", "t").data
    assert Document.parse('t = "' + "a.b." * 100 + '"\n', "t").data["t"].count("a") == 100
    assert printable("grüße µT") == "grüße µT"
    assert printable("a\x1b\x07\x9b\u202e") == "a\\x1b\\x07\\x9b\\u202e"


def test_nul_byte_in_a_name_is_refused() -> None:
    with pytest.raises(ConfigError, match="cannot be read"):
        read_text("a\0b", LIMIT)


@given(st.text(alphabet="ab.=[]{}\"',#\n1-_ \\e", max_size=60))
@settings(max_examples=300, deadline=None)
def test_any_toml_text_is_read_or_refused(text: str) -> None:
    try:
        assert isinstance(Document.parse(text, "t").data, dict)
    except ConfigError:
        return


@pytest.mark.parametrize("key", ["serial_number", "model", "frame"])
def test_calibration_names_its_board_in_printable_characters(
    tmp_path: Path, key: str, capsys: Any
) -> None:
    path = tmp_path / "a.cal.toml"
    assert simdevice(["calibration", "--out", str(path)]) == 0
    lines = path.read_text().splitlines()
    at = next(i for i, line in enumerate(lines) if line.startswith(f"{key} = "))
    lines[at] = f'{key} = "../../x\\u001b[2J"'
    path.write_text("\n".join(lines))
    with pytest.raises(CalibrationError, match=f"{key} = .*printable") as caught:
        load(path)
    assert "\x1b" not in str(caught.value)
