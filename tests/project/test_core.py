"""The core stays light: its libraries, and their wheels for board computers."""

from __future__ import annotations

import json
import re
import tomllib

from tactile_core.cli import EXTRAS
from tests.support.paths import ROOT

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
WHEELS = json.loads((ROOT / "tests/data/core_wheels.json").read_text(encoding="utf-8"))["wheels"]
CORE = {
    "numpy", "pyserial", "python-can", "eclipse-zenoh", "mcap", "zstandard", "rosbags", "msgspec",
    "rich", "psutil", "websockets",
}  # fmt: skip


def names(requirements: list[str]) -> set[str]:
    return {re.split(r"[\[<>=!~ ]", each)[0] for each in requirements}


def test_core_dependencies_are_as_listed() -> None:
    assert names(PROJECT["dependencies"]) == CORE


def test_every_python_has_core_wheels_for_aarch64() -> None:
    """Recorded with `pip download --platform manylinux…_aarch64 --only-binary=:all:`."""
    marker = "Programming Language :: Python :: 3."
    named = {c.rpartition(" ")[2] for c in PROJECT["classifiers"] if c.startswith(marker)}
    assert named == set(WHEELS)
    for python, wheels in WHEELS.items():
        assert set(wheels) == CORE
        for wheel in wheels.values():
            assert wheel.endswith(("-none-any.whl", "aarch64.whl")), f"{python}: {wheel}"


def test_extras_exist_and_all_includes_them() -> None:
    extras = PROJECT["optional-dependencies"]
    assert set(EXTRAS.values()) | {"experiments"} <= set(extras)
    (everything,) = extras["all"]
    held = set(re.search(r"\[(.*)\]", everything)[1].split(","))  # type: ignore[index]
    vendors = {"ur", "franka", "xarm", "flexiv"}  # large, and each for one robot
    apart = {"browser", "docs", "reference", "learn"}  # PyTorch may be several GB
    assert held == set(extras) - {"all", "dev"} - apart - vendors
    assert "tactile-reach[all]" in extras["dev"]
