"""Scenes of few objects, recorded scenes, and the simplest possible reach."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import pytest

from sim_device.world.base import World
from sim_device.world.engines import ENGINES, EngineMissing, world_maker
from sim_device.world.scene_loading import RECORDED_SCENES, find_recorded
from sim_device.world.scenes import Pose, Scene, SceneError, SceneObject, Shape
from tactile_core.geometry import TIP_X
from tactile_core.types import Twist
from tests.support.paths import DATA

RECORDED = DATA / "recorded_scenes"


def disc(x: float, y: float, *, radius: float = 0.04, mass: float = 0.5) -> SceneObject:
    return SceneObject(Shape.DISC, 2 * radius, 2 * radius, 0.07, mass, x, y, 0.0)


def box(
    x: float,
    y: float,
    *,
    size: tuple[float, float] = (0.04, 0.04),
    mass: float = 0.5,
    yaw: float = 0.0,
) -> SceneObject:
    return SceneObject(Shape.BOX, *size, 0.07, mass, x, y, yaw)


def cupboard(*objects: SceneObject, start: Pose | None = None) -> Scene:
    return Scene(
        source="test",
        parameters="authors_sim",
        seed=0,
        depth=0.375,
        width=0.55,
        start=start or Pose(-0.2, 0.0, 0.0),
        goal=(0.358, 0.0),
        objects=objects,
    )


class Engine(Protocol):
    def __call__(self, scene: Scene) -> World: ...


@dataclass(frozen=True)
class Build:
    disc: Callable[..., SceneObject]
    box: Callable[..., SceneObject]
    cupboard: Callable[..., Scene]


@pytest.fixture(scope="session")
def build() -> Build:
    return Build(disc, box, cupboard)


@pytest.fixture(params=ENGINES)
def engine(request: pytest.FixtureRequest) -> Engine:
    try:
        return world_maker(request.param)
    except EngineMissing as missing:
        pytest.skip(str(missing))


@pytest.fixture(scope="session")
def recorded() -> Path:
    """Folder with four scenes of our own in the format of the authors' recordings."""
    return RECORDED


@pytest.fixture(scope="session")
def authors() -> Path:
    """Folder with the sixty scenes of the authors' simulator; skips if it is not there."""
    try:
        return find_recorded(RECORDED_SCENES).parent
    except SceneError as error:
        pytest.skip(str(error))


@dataclass(frozen=True)
class Reach:
    """``success``: within 1 mm. ``distance``: m from the tip to the goal at the end."""

    success: bool
    distance: float
    duration: float


def straight_reach(world: World, limit: float = 20.0) -> Reach:
    """The authors' straight reach with their figures, without sensing: the least for a world."""
    scene = world.scene
    for cycle in range(round(limit / 0.01)):
        finger = world.finger()
        dx = scene.goal[0] - finger.x - TIP_X * math.cos(finger.heading)
        dy = scene.goal[1] - finger.y - TIP_X * math.sin(finger.heading)
        distance = math.hypot(dx, dy)
        if distance <= 0.001:
            return Reach(True, distance, cycle * 0.01)
        error = math.remainder(math.atan2(dy, dx) - finger.heading, math.tau)
        speed = 0.025 if distance < 0.01 else 0.05
        omega = math.copysign(0.01 if abs(error) < 0.05 else 0.35, error)
        world.step(0.01, Twist(speed * dx / distance, speed * dy / distance, omega))
        world.contacts()
    return Reach(False, distance, limit)


@pytest.fixture(scope="session")
def reach_straight() -> Callable[..., Reach]:
    return straight_reach


COMPILING_S = 1200
"""Time limit of a test that may be the first to use the planar engine, whose kernels take 6 s of a
processor to compile: minutes on a machine that has much else to do."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if "planar" in item.nodeid:
            item.add_marker(pytest.mark.timeout(COMPILING_S))
