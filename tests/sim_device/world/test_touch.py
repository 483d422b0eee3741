"""Contacts in the plane become lines of contact on a skin that has height."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from sim_device.skin.elastomer import Contact
from sim_device.skin.parameters import SkinParameters
from sim_device.skin.skin import SkinModel
from sim_device.world.base import WALL, FingerContact, merge_touches
from sim_device.world.mujoco_world import MujocoWorld
from sim_device.world.scenes import Pose
from sim_device.world.touch import on_skin
from tactile_core.geometry import FINGER_HEIGHT, finger
from tactile_core.types import Twist


def left_touch(body: int, force: float = -2.0) -> FingerContact:
    return FingerContact(0.07, 0.0285, 0.0, 1.0, 0.3, force, body)


def test_contact_line_bears_the_whole_force_at_object_height(build: Any) -> None:
    scene = build.cupboard(build.box(0.1, 0.1))  # 70 mm high, on the shelf
    felt = on_skin([left_touch(0)], scene)
    assert sum(c.force for c in felt) == pytest.approx([0.3, -2.0, 0.0])
    heights = [c.position[2] for c in felt]
    # The finger is 80 mm high, 11 mm over the shelf: the object covers its lower 59 mm.
    assert min(heights) >= -0.040
    assert max(heights) <= -0.040 + 0.059
    assert np.mean(heights) == pytest.approx(-0.040 + 0.059 / 2)
    assert all(c.position[:2].tolist() == [0.07, 0.0285] for c in felt)


def test_wall_is_felt_over_the_full_height_and_a_coaster_not_at_all(build: Any) -> None:
    low = build.box(0.1, 0.1)
    low = type(low)(low.shape, low.size_x, low.size_y, 0.01, low.mass, low.x, low.y, low.yaw)
    scene = build.cupboard(low)
    assert on_skin([left_touch(0)], scene) == []
    wall = on_skin([left_touch(WALL)], scene)
    assert np.mean([c.position[2] for c in wall]) == pytest.approx(0.0)
    assert np.ptp([c.position[2] for c in wall]) > FINGER_HEIGHT / 2


def test_taxel_pressure_sums_to_the_contact_force(build: Any) -> None:
    """First links of the chain: physics to contacts to taxels, in newtons."""
    world = MujocoWorld(build.cupboard(build.disc(0.17, 0.1), start=Pose(0.1, 0.0, 0.0)))
    for _ in range(150):
        world.step(0.01, Twist(0.0, 0.05, 0.0))
    contacts = world.contacts()
    geometry = finger()
    skin = SkinModel(geometry, SkinParameters(), np.random.default_rng(0))
    felt: list[Contact] = on_skin(contacts, world.scene)
    force = skin.taxel_force(felt)
    normal = sum(contact.normal_force for contact in contacts)
    assert normal > 0.5
    assert -force[:, 2].sum() == pytest.approx(normal, rel=0.05)
    left = geometry.slices[0]
    assert -force[left, 2].sum() == pytest.approx(normal, rel=0.05)


def test_nearby_touches_of_one_body_are_one_contact() -> None:
    upper = (3, 0.05, 0.0285, 0.0, 1.0, 0.1, -1.0)
    lower = (3, 0.05, 0.0285, 0.0, 1.0, 0.3, -3.0)
    far = (3, 0.09, 0.0285, 0.0, 1.0, 0.0, -2.0)
    other = (4, 0.0502, 0.0285, 0.0, 1.0, 0.0, -1.0)
    pulling = (4, 0.01, 0.0285, 0.0, 1.0, 0.0, 1.0)
    contacts = merge_touches([upper, lower, far, other, pulling], count=2)
    assert [(c.body, c.x) for c in contacts] == [
        (3, pytest.approx(0.05)), (3, pytest.approx(0.09)), (4, pytest.approx(0.0502))
    ]  # fmt: skip
    # Four newtons in one of two physics steps, or in both together: two on average.
    assert contacts[0].normal_force == pytest.approx(2.0)
    assert contacts[0].shear_force == pytest.approx(-0.2)
    assert merge_touches([], count=3) == ()
