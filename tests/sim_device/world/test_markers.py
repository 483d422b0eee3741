"""Scene as a 3D view shows it."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest

from sim_device.world.mujoco_world import MujocoWorld
from sim_device.world.parameters import world_parameters
from sim_device.world.scene_markers import scene_markers
from sim_device.world.scenes import Pose
from tactile_core.geometry import FINGER_OUTLINE

BACK, FRONT = FINGER_OUTLINE[0][0], FINGER_OUTLINE[3][0]


@pytest.mark.parametrize("heading", [0.0, 0.7, math.pi / 2])
def test_finger_marker_spans_back_to_front(build: Any, heading: float) -> None:
    scene = build.cupboard(start=Pose(0.1, 0.02, heading))
    (finger,) = (m for m in scene_markers(MujocoWorld(scene), 0).markers if m.ns == "finger")
    half = (FRONT - BACK) / 2
    x, y = finger.pose.position.x, finger.pose.position.y
    c, s = math.cos(heading), math.sin(heading)
    assert finger.scale.x == pytest.approx(FRONT - BACK)
    assert (x + half * c, y + half * s) == pytest.approx((0.1 + FRONT * c, 0.02 + FRONT * s))
    assert (x - half * c, y - half * s) == pytest.approx((0.1 + BACK * c, 0.02 + BACK * s))


def test_finger_marker_has_the_finger_width(build: Any) -> None:
    narrow = replace(world_parameters("authors_sim"), finger_width=0.04)
    world = MujocoWorld(build.cupboard(), narrow)
    (finger,) = (m for m in scene_markers(world, 0).markers if m.ns == "finger")
    assert finger.scale.y == pytest.approx(0.04)
