"""What is the planar engine's own: free motion under friction, rest, failure, outcomes."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("numba", reason="the extra `train` is not installed")

from sim_device.world.base import WorldError
from sim_device.world.mujoco_model import GRAVITY, mean_lever, yaw_inertia
from sim_device.world.parameters import world_parameters
from sim_device.world.planar_world import PlanarWorld
from sim_device.world.recorded_scenes import load_outcomes, load_recorded
from sim_device.world.scene_generation import authors_sim
from sim_device.world.scenes import Pose
from tactile_core.types import ZERO, Twist

AHEAD = Twist(0.05, 0.0, 0.0)


def thrown(world: PlanarWorld, vx: float, omega: float) -> np.ndarray[Any, Any]:
    """Displacement of object 0 that is let go at vx m/s and omega rad/s."""
    before = world.poses()[0]
    body = world.arrays.bodies[0, 1]
    body["vx"], body["omega"] = vx, omega
    for _ in range(200):
        world.step(0.01, ZERO)
    assert world.kinetic_energy() == 0.0  # asleep
    moved: np.ndarray[Any, Any] = world.poses()[0] - before
    return moved


@pytest.mark.parametrize("shape", ["disc", "box"])
def test_sliding_and_spinning_stop_by_the_law_of_friction(build: Any, shape: str) -> None:
    item = {"disc": build.disc, "box": build.box}[shape](0.1, 0.0)
    scale = world_parameters("authors_sim").inertia_scale
    slid = thrown(PlanarWorld(build.cupboard(item)), 0.1, 0.0)
    assert slid[0] == pytest.approx(scale * 0.1**2 / (2 * 0.20 * GRAVITY), rel=0.03)
    assert slid[1:].tolist() == [0.0, 0.0]
    spun = thrown(PlanarWorld(build.cupboard(item)), 0.0, 3.0)
    torque = 0.20 * item.mass * GRAVITY * mean_lever(item)
    way = 3.0**2 / 2 * scale * yaw_inertia(item) / torque
    assert spun[2] == pytest.approx(way, abs=3.0 * 0.0025)
    # Together they share one bound: each goes further than alone.
    both = thrown(PlanarWorld(build.cupboard(item)), 0.1, 3.0)
    assert both[0] > slid[0] * 1.05
    assert both[2] > spun[2] * 1.05


def test_sleepers_do_not_move_and_wake_when_touched(build: Any) -> None:
    scene = build.cupboard(build.disc(0.1, 0.0), build.disc(0.1801, 0.0), start=Pose(-0.12, 0, 0))
    world = PlanarWorld(scene)
    for _ in range(30):
        world.step(0.01, ZERO)
    before = world.poses()
    for _ in range(30):
        world.step(0.01, ZERO)
    assert np.array_equal(world.poses(), before)
    for _ in range(150):
        world.step(0.01, AHEAD)
    moved = world.poses()[:, 0] - before[:, 0]
    assert moved[0] > 0.02
    assert moved[1] == pytest.approx(moved[0], abs=0.002)


def test_diverging_and_overflowing_worlds_are_errors(build: Any) -> None:
    world = PlanarWorld(build.cupboard(build.disc(0.1, 0.0)))
    world.step(0.01, AHEAD)
    world.arrays.bodies["vx"][0, 1] = math.nan
    with pytest.raises(WorldError, match="diverged"):
        world.step(0.01, AHEAD)
    heap = [build.disc(0.2 + 0.001 * i, 0.0) for i in range(30)]  # one in the other
    world = PlanarWorld(build.cupboard(*heap))
    with pytest.raises(WorldError, match="too many contacts"):
        world.step(0.01, AHEAD)


def test_motion_is_that_of_mujoco_until_chance_sets_in() -> None:
    """The first contact of three scenes comes at the same cycle and at the same place."""
    from sim_device.world.mujoco_world import MujocoWorld

    for seed in (1, 5, 6):
        worlds = [PlanarWorld(authors_sim(seed)), MujocoWorld(authors_sim(seed))]
        first = []
        for world in worlds:
            for cycle in range(400):
                world.step(0.01, AHEAD)
                if world.contacts():
                    contact = world.contacts()[0]
                    first.append((cycle, contact.body, contact.x, contact.y))
                    break
        assert first[0] == pytest.approx(first[1], abs=1e-3)


def test_recorded_scenes_end_as_in_mujoco(recorded: Path, reach_straight: Any) -> None:
    outcomes = load_outcomes(recorded / "outcomes_5_8.csv")
    straight = {o.seed: o.success for o in outcomes if o.strategy == "straight"}
    for scene in load_recorded(recorded / "scenes_5_8.json.gz"):
        assert reach_straight(PlanarWorld(scene)).success == straight[scene.seed]
