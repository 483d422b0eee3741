"""Engines that share no code must tell the same story of a simple push."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from sim_device.world.engines import EngineMissing, WorldMaker, world_maker
from sim_device.world.mujoco_world import MujocoWorld
from sim_device.world.scenes import Pose
from tactile_core.types import Twist

AHEAD, ASIDE = Twist(0.05, 0.0, 0.0), Twist(0.0, 0.05, 0.0)


@pytest.fixture(params=["pymunk", "planar"])
def other(request: pytest.FixtureRequest) -> WorldMaker:
    try:
        return world_maker(request.param)
    except EngineMissing as missing:
        pytest.skip(str(missing))


@pytest.mark.parametrize(
    ("objects", "twist"),
    [
        ([("box", 0.06, 0.0)], AHEAD),
        ([("disc", 0.08, 0.0)], AHEAD),
        ([("box", 0.06, 0.0), ("box", 0.12, 0.005)], AHEAD),
        ([("box", 0.05, 0.1), ("disc", 0.05, 0.18)], ASIDE),
        ([("disc", 0.03, 0.1), ("box", 0.09, 0.07)], ASIDE),
    ],
)
def test_pushed_objects_end_in_the_same_place(
    other: WorldMaker, build: Any, objects: list[tuple[str, float, float]], twist: Twist
) -> None:
    kinds = {"box": build.box, "disc": build.disc}
    scene = build.cupboard(
        *(kinds[kind](x, y) for kind, x, y in objects),
        start=Pose(-0.14 if twist is AHEAD else 0.0, 0.0, 0.0),
    )
    ends = []
    for engine in (MujocoWorld, other):
        world = engine(scene)
        start = world.poses()
        for _ in range(200):
            world.step(0.01, twist)
        finger = world.finger()
        ends.append((world.poses() - start, np.array([finger.x, finger.y, finger.heading])))
    (mine, finger), (theirs, their_finger) = ends
    assert np.abs(mine[:, :2]).max() > 0.02  # it was pushed
    assert np.abs(finger[:2] - their_finger[:2]).max() < 0.002
    # The engines' laws of shelf friction differ where an object also turns.
    assert np.abs(mine[:, :2] - theirs[:, :2]).max() < 0.003


def test_engines_agree_on_a_push_into_the_corner(other: WorldMaker, build: Any) -> None:
    scene = build.cupboard(build.box(0.375 - 0.021, 0.0), start=Pose(0.17, 0.0, 0.0))
    wrenches = []
    for engine in (MujocoWorld, other):
        world = engine(scene)
        for _ in range(150):
            world.step(0.01, Twist(0.05, 0.0, 0.0))
        finger = world.finger()
        wrenches.append((finger.fx, finger.fy))
    # Friction at rest may be anything within its cone; here it is next to nothing beside 10 N.
    assert wrenches[0] == pytest.approx(wrenches[1], abs=0.3)
