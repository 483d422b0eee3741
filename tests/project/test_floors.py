"""Imports point only downward, and the command line starts without the slow libraries."""

from __future__ import annotations

import ast
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

from tests.support.paths import ROOT

ROOMS = {
    "sensor_proto": ROOT / "sensor_proto",
    "tactile_core": ROOT / "host" / "tactile_core",
    "armd": ROOT / "host" / "armd",
    "tactile_reach": ROOT / "host" / "tactile_reach",
    "tactiled": ROOT / "host" / "tactiled",
    "reachd": ROOT / "host" / "reachd",
    "sim_device": ROOT / "sim_device",
    "tactile_tools": ROOT / "tools" / "tactile_tools",
}
MAY_IMPORT = {
    "sensor_proto": set(),
    "tactile_core": {"sensor_proto"},
    "armd": {"sensor_proto", "tactile_core"},
    "tactile_reach": {"sensor_proto", "tactile_core"},
    "tactiled": {"sensor_proto", "tactile_core"},
    "reachd": {"sensor_proto", "tactile_core"},
    "sim_device": {"sensor_proto", "tactile_core", "armd"},
    "tactile_tools": {
        "sensor_proto",
        "tactile_core",
        "tactile_reach",
        "armd",
        "tactiled",
        "reachd",
        "sim_device",
    },
}
IO_MODULES = {"serial", "can", "zenoh", "mcap", "threading", "socket", "logging", "time", "os"}


@cache
def imports_of(path: Path) -> tuple[ast.Import | ast.ImportFrom, ...]:
    """Import statements of a file, read once for all tests."""
    nodes = ast.walk(ast.parse(path.read_text(encoding="utf-8")))
    return tuple(node for node in nodes if isinstance(node, ast.Import | ast.ImportFrom))


def imported(path: Path) -> set[str]:
    names: set[str] = set()
    for node in imports_of(path):
        if isinstance(node, ast.Import):
            names |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
            names.add(node.module.split(".")[0])
        elif isinstance(node, ast.ImportFrom) and node.level > 0:
            names.add(path.parent.name)
    return names


@pytest.mark.parametrize("room", ROOMS)
def test_imports_point_downward(room: str) -> None:
    files = sorted(ROOMS[room].rglob("*.py"))
    assert files, f"{room} has no files"
    for path in files:
        upward = imported(path) & set(ROOMS) - MAY_IMPORT[room] - {room}
        assert not upward, f"{path.relative_to(ROOT)} imports {sorted(upward)}"


def test_protocol_does_no_io() -> None:
    allowed = set(sys.stdlib_module_names) | {"numpy", "sensor_proto"}
    for path in sorted(ROOMS["sensor_proto"].rglob("*.py")):
        names = imported(path)
        assert names <= allowed, f"{path.name} imports {sorted(names - allowed)}"
        assert not names & IO_MODULES, f"{path.name} imports {sorted(names & IO_MODULES)}"


INSIDE = {
    "tactile_core": {"bus": {""}, "log": {"", "bus"}, "calibration": {""}},
    "tactiled": {"transports": {""}, "boards": {"", "transports"}, "sensing": {""}},
    "reachd": {"gate": {""}, "strategies": {"", "gate"}, "arms": {""}},
    "sim_device": {
        "skin": {""},
        "board": {"", "skin"},
        "world": {"skin"},
        "arm": {"", "skin", "world"},
    },
    "tactile_tools": {
        "log": {""},
        "plot": {"log"},
        "reach": {"", "plot"},
        "experiments": {"", "plot", "reach"},
        "calibrate": {""},
        "operate": set(),
        "train": set(),
        "dev": {"", "log", "plot", "reach", "experiments", "train"},
    },
}
"""Imports allowed within a package: other rooms, and "" for files beside the rooms."""


@pytest.mark.parametrize(("package", "room"), [(p, r) for p, rs in INSIDE.items() for r in rs])
def test_rooms_inside_a_package_import_downward(package: str, room: str) -> None:
    root = ROOMS[package]
    files = sorted((root / room).rglob("*.py"))
    assert files, f"{package}/{room} has no files"
    rooms = {p.name for p in root.iterdir() if p.is_dir()}
    for path in files:
        for node in imports_of(path):
            if isinstance(node, ast.ImportFrom) and node.module:
                head, _, rest = node.module.partition(".")
                if head != package:
                    continue
                names = [rest] if rest else [alias.name for alias in node.names]
                for name in names:
                    first = name.partition(".")[0]
                    used = first if first in rooms else ""
                    allowed = INSIDE[package][room] | {room}
                    assert used in allowed, f"{path.relative_to(ROOT)} imports {node.module}"


@pytest.mark.parametrize("room", ["boards", "sensing"])
def test_pure_packages_of_tactiled_use_no_thread_file_or_clock(room: str) -> None:
    files = sorted((ROOMS["tactiled"] / room).glob("*.py"))
    assert len(files) > 5
    for path in files:
        assert not imported(path) & IO_MODULES, path.name


@pytest.mark.parametrize("module", ["tactiled.daemon", "reachd.daemon", "sim_device.runner"])
def test_startup_imports_no_slow_library(module: str) -> None:
    code = (
        f"import {module}, sys; "
        "print([m for m in ('sklearn', 'matplotlib', 'scipy') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
