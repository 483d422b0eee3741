"""Short trials in a crowded scene, and their logs."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from tactile_tools.cli import main
from tests.support import trial_trace


@pytest.fixture(scope="session")
def scene_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Crowded scene in a file, as a user would give it."""
    path = tmp_path_factory.mktemp("scene") / "crowded.json"
    path.write_text(trial_trace.crowded().to_json(), encoding="utf-8")
    return path


@pytest.fixture(scope="session")
def recorded(
    scene_file: Path, tmp_path_factory: pytest.TempPathFactory
) -> Callable[[str], tuple[int, Path]]:
    """Exit code and log of a whole trial at a depth; each is run once."""
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
