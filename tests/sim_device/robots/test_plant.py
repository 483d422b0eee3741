"""An emulated robot's mechanics: its mount gives way, and a busy machine makes it stand still."""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from armd.frames import Transform
from sim_device.robots.plant import MAX_CATCH_UP_NS, STEP, STEP_NS, Mount, Pace, Plant
from sim_device.robots.sockets import Network, Servers
from sim_device.world.mujoco_world import MujocoWorld
from sim_device.world.scene_loading import load_scene
from tactile_core.types import Instant

HERE = Transform(np.zeros(3), np.eye(3))


def test_finger_that_is_held_is_pushed_with_the_force_of_its_mount() -> None:
    scene = load_scene("authors_sim", 0)
    start = (scene.start.x, scene.start.y, scene.start.heading)
    plant = Plant(Mount(HERE, HERE), start, MujocoWorld(scene), acceleration=2.0)
    plant.target = np.array([0.05, 0.0, 0.0, 0.0, 0.0, 0.0])
    forces = []
    for _ in range(round(12.0 / STEP)):
        plant.step()
        forces.append(plant.force)
        if plant.force > 8.0:
            break
    assert forces[-1] > 8.0, "it meets the objects"
    plant.target = np.zeros(6)
    after = []
    for _ in range(round(0.2 / STEP)):
        plant.step()
        after.append(plant.force)
    assert max(after) < 25.0, "at rest within a millimetre, 3 N each, and an impact"


def test_finger_in_free_air_feels_nothing_and_follows() -> None:
    scene = load_scene("authors_sim", 0)
    start = (scene.start.x, scene.start.y, scene.start.heading)
    plant = Plant(Mount(HERE, HERE), start, MujocoWorld(scene), acceleration=10.0)
    plant.target = np.array([-0.05, 0.0, 0.0, 0.0, 0.0, 0.0])
    forces = []
    for _ in range(round(0.5 / STEP)):
        plant.step()
        forces.append(plant.force)
    assert max(forces) < 3.0, "a jump of its speed is felt a little"
    assert max(forces[-50:]) < 0.2
    assert plant.world is not None
    assert math.isclose(plant.world.finger().x, plant.planar[0], abs_tol=1e-3)


def test_robot_of_a_process_that_was_held_up_stands_still() -> None:
    pace = Pace()
    assert pace.due(Instant(0)) == 0
    assert pace.due(Instant(10 * STEP_NS)) == 10
    held_up = Instant(10 * STEP_NS + 300_000_000)
    assert pace.due(held_up) == MAX_CATCH_UP_NS // STEP_NS
    assert pace.skipped_ns == 300_000_000 - MAX_CATCH_UP_NS


def test_slow_network_delays_by_more_and_more() -> None:
    servers = Servers("127.0.0.1", {}, Network(), np.random.default_rng(0))
    servers.slow(0.5, 0.2, Instant(0))
    delays = [
        (servers._arrival(deque(), Instant(at)) - at) * 1e-9
        for at in (0, 200_000_000, 2_000_000_000)
    ]
    assert delays == [0.0, 0.1, 0.2]
