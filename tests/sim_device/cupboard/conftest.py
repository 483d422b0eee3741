"""Cupboard with one heavy disc in the finger's way, on its own bus, as a real process."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from sim_device.world.scenes import Scene
from tests.support.cupboard import Cupboard, disc_scene


@pytest.fixture
def scene() -> Scene:
    return disc_scene()


@pytest.fixture(scope="session")
def scene_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("scene") / "disc.json"
    path.write_text(disc_scene().to_json())
    return path


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory, scene_file: Path) -> Iterator[Cupboard]:
    running = Cupboard(tmp_path_factory.mktemp("run"), str(scene_file))
    yield running
    running.close()


@pytest.fixture
def cupboard(shared: Cupboard) -> Cupboard:
    """The one process of a module, as new."""
    shared.reset()
    return shared


@pytest.fixture
def start(tmp_path: Path, scene_file: Path) -> Iterator[Callable[..., Cupboard]]:
    started: list[Cupboard] = []

    def run(*arguments: str) -> Cupboard:
        started.append(Cupboard(tmp_path, str(scene_file), *arguments))
        return started[-1]

    yield run
    for running in started:
        running.close()
