"""What people see of a board."""

from __future__ import annotations

from pathlib import Path

import pytest

from tactile_bus.terminal import drops_text
from tactiled.cli import can_networks
from tactiled.links.lines import bus_names
from tactiled.status import BAR, bar


def test_a_force_bar_fills_up_and_stays_full() -> None:
    shown = [BAR.index(bar(force)) for force in (-1.0, 0.0, 2.5, 5.0, 10.0, 99.0)]
    assert shown == sorted(shown)
    assert shown[:2] == [0, 0]
    assert shown[-2:] == [len(BAR) - 1] * 2


def test_drops_are_named_the_largest_first() -> None:
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
def test_names_on_a_bus(
    given: dict[int, str], nodes: tuple[int, ...], late: bool, names: dict[int, str]
) -> None:
    assert bus_names("hand", given, nodes, late) == names


def test_can_networks_are_told_by_their_type(tmp_path: Path) -> None:
    for name, kind in (("can0", "280"), ("eth0", "1"), ("vcan1", "280")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "type").write_text(kind + "\n")
    (tmp_path / "odd").mkdir()
    assert can_networks(tmp_path) == ["can0", "vcan1"]
    assert can_networks(tmp_path / "none") == []
