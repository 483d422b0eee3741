"""The status lines of boards."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rich.cells import cell_len

from tactile_core.cli import drops_text
from tactile_core.geometry import Side
from tactiled.boards.line import bus_names
from tactiled.cli import can_networks
from tactiled.status import BAR, SIDES, BoardSummary, bar, line


def test_force_bar_saturates() -> None:
    shown = [BAR.index(bar(force)) for force in (-1.0, 0.0, 2.5, 5.0, 10.0, 99.0)]
    assert shown == sorted(shown)
    assert shown[:2] == [0, 0]
    assert shown[-2:] == [len(BAR) - 1] * 2


def a_summary(**values: object) -> BoardSummary:
    usual: dict[str, object] = {
        "name": "board0",
        "state": "streaming",
        "forces": {Side.TIP: 2.345},
        "valid": True,
        "reasons": (),
        "rate": 99.94,
        "drops": 0,
        "latency": 0.0017,
    }
    return BoardSummary(**(usual | values))  # type: ignore[arg-type]  # values of any type


def test_status_shows_force_then_rate_latency_and_losses() -> None:
    shown = line(a_summary()).plain
    assert " ".join(shown.split()) == "board0 2.35 N ▂ 99.9 Hz 0 dropped latency 1.7 ms"
    bounded = line(a_summary(bound=0.25)).plain
    assert "2.35 ± 0.25 N" in bounded
    several = line(a_summary(forces={Side.LEFT: 1.0, Side.RIGHT: 0.0, Side.TIP: 11.0})).plain
    assert several.index("left") < several.index("right") < several.index("tip 11.0█ N")
    assert several.endswith("latency 1.7 ms")
    assert cell_len(several) <= 80
    longest = a_summary(name="n" * 64, forces=dict.fromkeys(Side, 99.9), drops=123_456)
    assert "123456 dropped" in line(longest).plain


def test_invalid_force_is_replaced_by_its_reason() -> None:
    shown = line(a_summary(valid=False, reasons=("taring: leave the skin untouched",))).plain
    assert " N " not in shown
    assert "not valid" in shown
    assert "taring: leave" in shown


@pytest.mark.parametrize("state", ["waiting", "silent", "unplugged", "refused"])
def test_idle_board_shows_its_state(state: str) -> None:
    shown = line(a_summary(state=state, drops=1234)).plain
    assert state in shown
    assert " N " not in shown
    assert " Hz" not in shown
    assert "1234 dropped" in shown


@given(
    name=st.text("abc_-", min_size=1, max_size=64),
    state=st.sampled_from(["streaming", "waiting", "identified", "silent", "refused"]),
    forces=st.dictionaries(st.sampled_from([side for side, _ in SIDES]), st.floats(-999, 999)),
    valid=st.booleans(),
    reasons=st.lists(st.text(min_size=1, max_size=90), max_size=4).map(tuple),
    rate=st.floats(0, 99_999),
    drops=st.integers(0, 10**12),
    latency=st.one_of(st.just(math.nan), st.floats(0, 1000)),
    width=st.sampled_from([40, 80, 120]),
)
@settings(max_examples=100, deadline=None)
def test_status_line_fits_its_width(width: int, **values: object) -> None:
    shown = line(a_summary(**values), width)
    assert shown.cell_len <= width


def test_drops_are_listed_largest_first() -> None:
    assert drops_text({}) == "0"
    assert drops_text({"crc": 2, "missing": 9}) == "missing=9 crc=2"
    assert drops_text({str(k): k for k in range(9)}).endswith("…")


@pytest.mark.parametrize(
    ("given", "nodes", "late", "names"),
    [
        ({}, (7,), False, {7: "hand"}),
        ({}, (3, 5), False, {3: "hand-3", 5: "hand-5"}),
        ({}, (9,), True, {9: "hand-9"}),
        ({3: "left", 5: "right"}, (3, 5), False, {3: "left", 5: "right"}),
        ({3: "left"}, (3, 4), False, {3: "left"}),
    ],
)
def test_boards_on_a_bus_are_named(
    given: dict[int, str], nodes: tuple[int, ...], late: bool, names: dict[int, str]
) -> None:
    assert bus_names("hand", given, nodes, late) == names


def test_can_networks_are_recognised_by_type(tmp_path: Path) -> None:
    for name, kind in (("can0", "280"), ("eth0", "1"), ("vcan1", "280")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "type").write_text(kind + "\n")
    (tmp_path / "odd").mkdir()
    assert can_networks(tmp_path) == ["can0", "vcan1"]
    assert can_networks(tmp_path / "none") == []
