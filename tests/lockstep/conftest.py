"""Short trials in a crowded scene, and logs of them."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest

from tactile_tools.cli import main


@pytest.fixture(scope="session")
def trace() -> ModuleType:
    """``trace.py`` of this folder."""
    path = Path(__file__).with_name("trace.py")
    spec = importlib.util.spec_from_file_location("lockstep_trace", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["lockstep_trace"] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="session")
def scene_file(trace: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The crowded scene as a user would give it."""
    path = tmp_path_factory.mktemp("scene") / "crowded.json"
    path.write_text(trace.crowded().to_json(), encoding="utf-8")
    return path


@pytest.fixture(scope="session")
def recorded(
    scene_file: Path, tmp_path_factory: pytest.TempPathFactory
) -> Callable[[str], tuple[int, Path]]:
    """Exit code and log of a whole trial with a strategy felt through taxels; each run once."""
    folder = tmp_path_factory.mktemp("logs")
    done: dict[str, tuple[int, Path]] = {}

    def run(depth: str, again: str = "") -> tuple[int, Path]:
        name = depth + again
        if name not in done:
            log = folder / f"{name}.mcap"
            words = ["reach", "--scene", str(scene_file), "--depth", depth, "--log", str(log)]
            done[name] = (main([*words, "--png", str(log.with_suffix(".png"))]), log)
        return done[name]

    return run
