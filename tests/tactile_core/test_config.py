"""Configuration errors name file, line, value and what is allowed."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec import Meta

from tactile_core import config
from tactile_core.bus.session import BusConfig
from tactile_core.config import (
    ConfigError,
    Count,
    Duration,
    MetresPerSecond,
    Positive,
    Rate,
    check_fields,
    describe,
    key_lines,
    load_toml,
    parse_toml,
    table_of,
)
from tactile_core.log.recorder import RecorderSettings


class Board(msgspec.Struct, forbid_unknown_fields=True):
    port: str
    rate: Rate = 100.0
    baud: Literal[115200, 1000000] = 115200


class Settings(msgspec.Struct, forbid_unknown_fields=True):
    name: Annotated[str, Meta(pattern="^[a-z]+$")] = "a"
    compensation: Literal["off", "ransac", "consensus"] = "consensus"
    timeout: Duration = 1.0
    threshold: Positive | None = None
    limit: Annotated[int, Meta(ge=1, le=10)] = 5
    boards: list[Board] = []
    by_name: dict[str, Board] = {}
    rates: dict[str, Rate] = {}
    axis: tuple[float, float, float] = (0.0, 0.0, 1.0)
    log: RecorderSettings = RecorderSettings()
    bus: BusConfig = BusConfig()


DURATION = "a finite number above 0 and at most 1e9 s"
GOOD = """
# a comment with [brackets] and "quotes"
name = "abc"
timeout = 2
text_is_not_here = false
"""


def error_of(text: str) -> str:
    with pytest.raises(ConfigError) as caught:
        parse_toml(text, Settings, "t.toml")
    return str(caught.value)


def test_valid_file_is_read(tmp_path: Path) -> None:
    path = tmp_path / "t.toml"
    path.write_text(
        'name = "abc"\ntimeout = 2\naxis = [1, 0, 0]\n[[boards]]\nport = "x"\n'
        '[by_name.left]\nport = "y"\nrate = 50\n[log]\nmax_files = 3\n'
    )
    found = load_toml(path, Settings)
    assert (found.name, found.timeout, found.axis) == ("abc", 2.0, (1.0, 0.0, 0.0))
    assert found.boards[0].port == "x"
    assert found.by_name["left"].rate == 50.0
    assert found.log.max_files == 3


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("name = 5", 't.toml:1: name = 5; allowed: a text that matches ^[a-z]+$'),
        ('\n\nname = "A1"', 't.toml:3: name = "A1"; allowed: a text that matches ^[a-z]+$'),
        (
            'compensation = "ransack"',
            't.toml:1: compensation = "ransack"; allowed: off, ransac, consensus',
        ),
        ("timeout = 0", f"t.toml:1: timeout = 0; allowed: {DURATION}"),
        ("timeout = -1.5", f"t.toml:1: timeout = -1.5; allowed: {DURATION}"),
        ("timeout = nan", f"t.toml:1: timeout = nan; allowed: {DURATION}"),
        ("timeout = inf", f"t.toml:1: timeout = inf; allowed: {DURATION}"),
        ("timeout = true", f"t.toml:1: timeout = true; allowed: {DURATION}"),
        ("threshold = -inf", "t.toml:1: threshold = -inf; allowed: a finite number above 0"),
        ("limit = 11", "t.toml:1: limit = 11; allowed: a whole number from 1 to 10"),
        ("limit = 5.5", "t.toml:1: limit = 5.5; allowed: a whole number from 1 to 10"),
        ("axis = [1, 2]", "t.toml:1: axis = [1, 2]; allowed: an array of 3, each a finite number"),
        ('axis = [\n1,\n2,\n"x"]', 't.toml:4: axis[2] = "x"; allowed: a finite number'),
        ("boards = 3", "t.toml:1: boards = 3; allowed: an array, each element a table"),
        (
            '[[boards]]\nport = "a"\n\n[[boards]]\nport = "b"\nrate = 0',
            "t.toml:6: boards[1].rate = 0; allowed: a finite number above 0 and at most 1e6 Hz",
        ),
        (
            '[[boards]]\nport = "a"\n[[boards]]\nrate = 5',
            "t.toml:3: boards[1].port is missing; it must be a text",
        ),
        (
            '[by_name.left]\nport = "a"\n[by_name.right]\nport = 7',
            "t.toml:4: by_name.right.port = 7; allowed: a text",
        ),
        (
            'by_name = { left = { port = "a",  baud = 9600 } }',
            "t.toml:1: by_name.left.baud = 9600; allowed: 1000000, 115200",
        ),
        ("[log]\n#\nmax_files = 0", "t.toml:3: log.max_files = 0; allowed: a whole number above 0"),
        (
            "[rates]\na = 1\nb = -1",
            "t.toml:3: rates.b = -1; allowed: a finite number above 0 and at most 1e6 Hz",
        ),
        ('bus.role = "x"', 't.toml:1: bus.role = "x"; allowed: arm, reachd, tactiled, tool'),
    ],
)  # fmt: skip
def test_wrong_value_is_located_with_allowed_values(text: str, message: str) -> None:
    got = error_of(text)
    head, _, allowed = message.partition("; allowed: ")
    assert got.startswith(head)
    # msgspec lists choices in an order of its own.
    assert sorted(got.partition("; allowed: ")[2].split(", ")) == sorted(allowed.split(", "))


@pytest.mark.parametrize(
    ("text", "line", "key", "hint"),
    [
        ("timout = 1", 1, "timout", "did you mean timeout?"),
        ("[log]\nsplit_byts = 5", 2, "log.split_byts", "did you mean split_bytes?"),
        ('[[boards]]\nport = "a"\nqqq = 1', 3, "boards[0].qqq", ""),
        ("[bus]\n[bus.tls]\nfoo = 1", 3, "bus.tls.foo", ""),
        ("[loog]\nx = 1", 1, "loog", "did you mean log?"),
    ],
)
def test_unknown_key_lists_allowed_keys(text: str, line: int, key: str, hint: str) -> None:
    got = error_of(text)
    assert got.startswith(f"t.toml:{line}: unknown key {key}")
    assert hint in got
    assert "; allowed: " in got


@pytest.mark.parametrize(
    ("text", "line"), [("a = ", 1), ("a = 1\nb b = 2", 2), ("x = 1\nx = 2", 2), ('a = "', 1)]
)
def test_invalid_toml_names_its_line(text: str, line: int) -> None:
    assert error_of(text).startswith(f"t.toml:{line}: ")


def test_files_that_cannot_be_configurations_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="No such file"):
        load_toml(tmp_path / "none.toml", Settings)
    with pytest.raises(ConfigError, match="Is a directory"):
        load_toml(tmp_path, Settings)
    binary = tmp_path / "b.toml"
    binary.write_bytes(b"name = 1\n\xff\xfe")
    with pytest.raises(ConfigError, match=r"b.toml:2: not UTF-8"):
        load_toml(binary, Settings)
    huge = tmp_path / "h.toml"
    huge.write_bytes(b"#" * (2 << 20))
    with pytest.raises(ConfigError, match="over 1048576 bytes"):
        load_toml(huge, Settings)
    deep = tmp_path / "d.toml"
    deep.write_text("a = " + "[" * 5000 + "]" * 5000)
    with pytest.raises(ConfigError):
        load_toml(deep, Settings)


KEYS = st.text("abc", min_size=1, max_size=3)
SCALARS = st.sampled_from(
    ["1", "-2.5e3", "true", '"a # b [c] = {d}"', "'raw \\ \" text'", "1979-05-27 07:32:00Z",
     '"""two\nlines \\""" = "x" """', "'''x\n[y]\n'''", '"esc \\" quote"', "0xff", "[1, [2, 3],\n]",
     "{ }", '{ q = 1, r.s = "}" }', "[ # c\n{z = 1}, {z = 2} ]"]
)  # fmt: skip
PAIRS = st.tuples(KEYS, SCALARS)


@given(st.lists(st.tuples(st.booleans(), KEYS, st.lists(PAIRS, max_size=4)), max_size=5))
@settings(max_examples=80, deadline=None)
def test_every_key_of_valid_toml_has_its_line(
    tables: list[tuple[bool, str, list[tuple[str, str]]]],
) -> None:
    lines = ["# start"]
    for double, name, pairs in tables:
        lines.append(f"[[ {name} ]] # x" if double else f"[{name}]")
        lines += [f"  {key} = {value}  # c" for key, value in pairs]
    text = "\n".join(lines)
    try:
        data = tomllib.loads(text)
    except tomllib.TOMLDecodeError:
        return
    found = key_lines(text)
    rows = text.split("\n")

    def check(value: object, path: tuple[str | int, ...]) -> None:
        items = (
            value.items()
            if isinstance(value, dict)
            else enumerate(value)
            if isinstance(value, list)
            else ()
        )
        for key, item in items:
            here = (*path, key)
            assert here in found
            if isinstance(key, str):
                assert key in rows[found[here] - 1]
            check(item, here)

    check(data, ())


def test_counts_must_be_whole_numbers() -> None:
    class One(msgspec.Struct):
        n: Count = 1

    with pytest.raises(ConfigError, match="a whole number above 0"):
        parse_toml("n = 1.0", One)


@dataclass(frozen=True, slots=True, kw_only=True)
class Figures:
    speed: Annotated[MetresPerSecond, Meta(gt=0, description="greatest speed")] = 1.0
    way: Annotated[Literal["a", "b"], Meta(description="which way")] = "a"

    def __post_init__(self) -> None:
        check_fields(self)


FiguresTable = table_of("FiguresTable", "Some figures.", Figures, rename={"speed": "v"})


def test_dataclass_is_checked_like_a_file_and_overridden_by_one() -> None:
    with pytest.raises(ConfigError, match=r"speed = nan; allowed: .* above 0 m/s") as caught:
        Figures(speed=float("nan"))
    assert caught.value.keys == ("speed",)
    said = config.given(parse_toml("v = 2", FiguresTable, "t.toml"))
    assert Figures(**said) == Figures(speed=2.0)
    with pytest.raises(ConfigError, match=r"t.toml:1: v = 0; allowed: a finite number above 0 m/s"):
        parse_toml("v = 0", FiguresTable, "t.toml")
    (section,) = describe(FiguresTable)
    assert [(k.name, k.unit, k.default) for k in section.keys] == [
        ("v", "m/s", "1"),
        ("way", "", '"a"'),
    ]
