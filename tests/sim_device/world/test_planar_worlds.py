"""Many cupboards at once are the single ones, bit for bit."""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
from typing import Any

import numpy as np
import pytest

pytest.importorskip("numba", reason="the extra `train` is not installed")

from sim_device.world.base import WALL
from sim_device.world.planar_world import PlanarWorld
from sim_device.world.planar_worlds import Worlds
from sim_device.world.scene_generation import authors_sim
from sim_device.world.scenes import Pose
from tactile_core.types import Instant, Twist
from tactile_tools.reach.touch_senses import ContactSense
from tests.support.paths import ROOT

SEEDS = (1, 5, 6, 11, 12)


def wanted(index: int, cycle: int) -> tuple[float, float, float]:
    return 0.05, 0.02 * math.sin(cycle / 20 + index), 0.1 * math.cos(cycle / 30)


def test_worlds_are_single_worlds_to_the_bit() -> None:
    """Also in what touch makes of their contacts, and whatever the number of threads."""
    scenes = [authors_sim(seed) for seed in SEEDS]
    single = [PlanarWorld(scene) for scene in scenes]
    touched = 0
    with Worlds(scenes, threads=2) as worlds:
        for cycle in range(300):
            twists = [wanted(index, cycle) for index in range(len(scenes))]
            worlds.step(0.01, np.array(twists))
            rows, counts = worlds.contacts()
            features, sides = worlds.features()
            for index, (world, twist) in enumerate(zip(single, twists, strict=True)):
                world.step(0.01, Twist(*twist))
                finger, contacts = world.finger(), world.contacts()
                assert worlds.finger[index].tolist() == [
                    finger.x, finger.y, finger.heading, *twist_of(finger.twist)
                ]  # fmt: skip
                assert worlds.wrench[index].tolist() == [finger.fx, finger.fy, finger.mz]
                assert rows[index, : counts[index]].tolist() == [
                    [c.x, c.y, c.normal_x, c.normal_y, c.force_x, c.force_y, c.body]
                    for c in contacts
                ]
                touch = ContactSense().feel(world, Instant(0))
                assert features[index].tolist() == [
                    touch.total_force, touch.tip_force, touch.peak_force, touch.peak_x, touch.peak_y
                ]  # fmt: skip
                assert sides[index] == int(touch.peak_side)
                touched += bool(contacts)
        for index, world in enumerate(single):
            poses = world.poses()
            assert np.array_equal(worlds.poses()[index, : len(poses)], poses)
            assert np.isnan(worlds.poses()[index, len(poses) :]).all()
            assert worlds.on_shelf()[index].sum() == world.on_shelf().sum()
            assert worlds.ejected[index] == world.ejected
        assert worlds.time.tolist() == pytest.approx([3.0] * len(scenes))
    assert touched > 300


def twist_of(twist: Twist) -> tuple[float, float, float]:
    return twist.vx, twist.vy, twist.omega


def test_a_reset_begins_anew_and_touches_no_other_world(build: Any) -> None:
    scenes = [authors_sim(5), authors_sim(6)]
    with Worlds(scenes, objects=40, threads=1) as worlds:
        forward = np.tile((0.05, 0.0, 0.0), (2, 1))
        for _ in range(200):
            worlds.step(0.01, forward)
        first, other = worlds.poses()[0], worlds.finger[1]
        worlds.reset(0)
        assert worlds.time.tolist() == [0.0, 2.0]
        assert np.array_equal(worlds.finger[1], other)
        for _ in range(200):
            worlds.step(0.01, forward)
        assert np.array_equal(worlds.poses()[0], first, equal_nan=True)
        worlds.reset(1, build.cupboard(build.disc(0.1, 0.0)))
        assert np.isfinite(worlds.poses()[1]).all(axis=1).sum() == 1
        with pytest.raises(ValueError, match="41 objects in a world with room for 40"):
            worlds.reset(0, build.cupboard(*[build.disc(0.01 * i, 0.0) for i in range(41)]))


def test_flags_say_what_was_reached_ejected_and_failed(build: Any) -> None:
    pushed = build.cupboard(build.box(0.03, 0.0), start=Pose(0.07, 0.0, 0.0))
    near = build.cupboard(start=Pose(0.17, 0.0, 0.0))
    heap = build.cupboard(*[build.disc(0.2 + 0.001 * i, 0.1) for i in range(30)])
    with Worlds([pushed, near, heap], threads=1) as worlds:
        assert worlds.distance[1] == pytest.approx(0.358 - 0.17 - 0.15185, abs=0.01)
        for _ in range(300):
            worlds.step(0.01, np.array([(-0.05, 0, 0), (0.05, 0, 0), (0.0, 0, 0)]))
        assert worlds.ejected.tolist() == [1, 0, 0]
        assert worlds.reached.tolist() == [False, True, False]
        assert worlds.failed.tolist() == [False, False, True]
        rows, counts = worlds.contacts()
        assert rows[1, : counts[1], 6].tolist() == [WALL] * counts[1]
        worlds.limit_wrench(5.0, 1.0)
        worlds.step(0.01, np.array([(0, 0, 0), (0.05, 0, 0), (0, 0, 0)]))
        assert worlds.wrench[1, 0] == pytest.approx(-5.0, rel=0.2)


def test_misuse_is_refused() -> None:
    with Worlds([authors_sim(1)]) as worlds:
        with pytest.raises(ValueError, match="shape"):
            worlds.step(0.01, np.zeros(3))
        with pytest.raises(ValueError, match="finite"):
            worlds.step(0.01, np.full((1, 3), math.nan))
        with pytest.raises(ValueError, match="multiple"):
            worlds.step(0.004, np.zeros((1, 3)))
        with pytest.raises(ValueError, match="limits"):
            worlds.limit_wrench(0.0, 1.0)
    with pytest.raises(ValueError, match="allowed: cpu, cuda"):
        Worlds([authors_sim(1)], device="tpu")  # type: ignore[arg-type]


ON_CUDA = """
import json, sys
import numpy as np
from sim_device.world.planar_worlds import Worlds
from sim_device.world.scene_generation import authors_sim

device, cycles = sys.argv[1], int(sys.argv[2])
with Worlds([authors_sim(seed, (8, 10)) for seed in (1, 6)], device=device) as worlds:
    start = worlds.poses().copy()
    for cycle in range(cycles):
        worlds.step(0.01, np.tile((0.05, 0.03, 0.3), (2, 1)))
    assert not np.allclose(worlds.poses(), start, atol=1e-5, equal_nan=True), "nothing was pushed"
    worlds.reset(1)
    worlds.limit_wrench(3.0, 1.0)
    worlds.step(0.01, np.tile((0.05, 0.0, 0.0), (2, 1)))
    print(json.dumps([worlds.finger.tolist(), np.nan_to_num(worlds.poses()).tolist()]))
"""


def run_on(device: str, **variables: str) -> np.ndarray[Any, Any]:
    done = subprocess.run(
        [sys.executable, "-c", ON_CUDA, device, "2"],
        capture_output=True,
        text=True,
        env=os.environ | variables,
        cwd=ROOT,
    )
    assert done.returncode == 0, done.stderr
    finger, poses = json.loads(done.stdout)
    return np.concatenate([np.ravel(finger), np.ravel(poses)])


def test_the_cuda_kernel_gives_what_the_cpu_gives_in_the_simulator() -> None:
    """In Python, thread by thread: no GPU is needed, and a few cycles take a while."""
    simulated = run_on("cuda", NUMBA_ENABLE_CUDASIM="1", NUMBA_DISABLE_JIT="1")
    assert simulated == pytest.approx(run_on("cpu"), abs=1e-12)


def test_a_missing_gpu_is_said_in_one_sentence() -> None:
    from numba import cuda

    if cuda.is_available():
        pytest.skip("there is a GPU")
    with pytest.raises(RuntimeError, match="use device='cpu'"):
        Worlds([authors_sim(1)], device="cuda")
