"""Cupboard against closed forms, in every engine."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sim_device.world.base import WALL, World, WorldError
from sim_device.world.engines import EngineMissing, world_maker
from sim_device.world.mujoco_model import mean_lever
from sim_device.world.mujoco_world import MujocoWorld
from sim_device.world.parameters import WORLD_PARAMETERS, world_parameters
from sim_device.world.scene_generation import authors_sim
from sim_device.world.scene_squeeze import settled
from sim_device.world.scenes import Pose
from tactile_core.geometry import FINGER_OUTLINE
from tactile_core.types import ZERO, Twist

INERTIA = world_parameters("authors_sim").inertia_scale
G = 9.81
FORWARD = Twist(0.05, 0.0, 0.0)
TIP = FINGER_OUTLINE[3][0]  # m, front face of the finger
SKIN = 1.5e-4  # m, within which a contact lies on the outline; Bullet's margin is 0.1 mm

Engine = Callable[..., World]


def cylinder_error(engine: Engine) -> float:
    """Allowed error of friction with the shelf relative to μ m g."""
    # In Bullet a cylinder rests on a few points of its rim, which carry its weight unevenly.
    return 0.08 if "Pybullet" in repr(engine) else 0.04


def run(world: World, seconds: float, twist: Twist) -> None:
    for _ in range(round(seconds / 0.01)):
        world.step(0.01, twist)


@pytest.mark.parametrize("mass", [0.25, 0.75])
@pytest.mark.parametrize("shape", ["disc", "box"])
def test_block_starts_to_slide_at_mu_m_g(
    engine: Engine, build: Any, shape: str, mass: float
) -> None:
    item = {"disc": build.disc, "box": build.box}[shape](0.15, 0.0, mass=mass)
    front = item.x - item.half_extent[0]
    world = engine(build.cupboard(item, start=Pose(front - TIP - 0.001, 0.0, 0.0)))
    onset = 0.20 * mass * G
    world.limit_wrench(0.5 * onset, 1.5)
    run(world, 0.5, Twist(0.005, 0.0, 0.0))  # a gentle touch
    assert world.poses()[0, 0] == pytest.approx(item.x, abs=3e-4)
    slid_at = None
    for share in np.arange(0.90, 1.11, 0.02):
        world.limit_wrench(share * onset, 1.5)
        before = world.poses()[0, 0]
        run(world, 1.0, FORWARD)
        if world.poses()[0, 0] - before > 0.00005:
            slid_at = share
            break
    # Below the onset it creeps by less than 0.05 mm in 1 s; 4 % above, it is pushed further.
    assert slid_at == pytest.approx(1.01, abs=0.04 if shape == "box" else cylinder_error(engine))


@pytest.mark.parametrize("limit", [5.0, 10.0, 15.0])
def test_push_against_the_wall_plateaus_at_the_arm_limit(
    engine: Engine, build: Any, limit: float
) -> None:
    world = engine(build.cupboard(start=Pose(0.375 - TIP - 0.02, 0.0, 0.0)))
    world.limit_wrench(limit, 1.5)
    run(world, 1.0, FORWARD)
    for _ in range(50):
        world.step(0.01, FORWARD)
        assert world.finger().fx == pytest.approx(-limit, rel=1e-3)
    assert world.finger().x + TIP == pytest.approx(0.375, abs=0.0005)
    contacts = world.contacts()
    assert {contact.body for contact in contacts} == {WALL}
    assert sum(contact.normal_force for contact in contacts) == pytest.approx(limit, rel=0.01)
    for contact in contacts:
        assert contact.x == pytest.approx(TIP, abs=SKIN)
        assert abs(contact.y) <= 0.00353 + SKIN


def test_jammed_object_bears_the_arm_limit(engine: Engine, build: Any) -> None:
    item = build.box(0.375 - 0.0201, 0.0)
    world = engine(build.cupboard(item, start=Pose(item.x - 0.02 - TIP - 0.005, 0.0, 0.0)))
    run(world, 1.0, FORWARD)
    assert world.finger().fx == pytest.approx(-10.0, rel=0.01)
    # Of the finger's 10 N the shelf may take μ·m·g, about 1 N; the box must not sink into the wall.
    assert world.poses()[0, 0] + 0.02 == pytest.approx(0.375, abs=0.0005)


def test_sliding_object_stops_after_v2_over_2_mu_g(build: Any) -> None:
    for item in (build.disc(0.1, 0.0), build.box(0.1, 0.0)):
        world = MujocoWorld(build.cupboard(item))
        world.data.qvel[0] = speed = 0.1
        run(world, 1.0, ZERO)
        way = INERTIA * speed**2 / (2 * 0.20 * G)
        assert world.poses()[0, 0] - 0.1 == pytest.approx(way, rel=0.03)


def test_spinning_object_stops_after_w2_over_2_alpha(build: Any) -> None:
    disc = build.disc(0.1, 0.0)
    world = MujocoWorld(build.cupboard(disc))
    world.data.qvel[3] = spin = 3.0
    run(world, 1.5, ZERO)
    # Torque μ m g ⅔r on an inertia of ½ m r².
    alpha = 0.20 * G * (2 / 3 * 0.04) / (0.5 * 0.04**2) / INERTIA
    # A physics step is long compared with the 0.5 s it spins: allow half a step at full speed.
    assert world.poses()[0, 2] == pytest.approx(spin**2 / (2 * alpha), abs=spin * 0.0025)


def test_mean_lever_is_the_mean_distance_from_the_centre(build: Any) -> None:
    rng = np.random.default_rng(1)
    points = rng.uniform(-0.5, 0.5, (200_000, 2)) * (0.03, 0.05)
    expected = np.hypot(*points.T).mean()
    assert mean_lever(build.box(0, 0, size=(0.03, 0.05))) == pytest.approx(expected, rel=0.005)
    assert mean_lever(build.disc(0, 0, radius=0.03)) == pytest.approx(0.02)
    assert mean_lever(build.box(0, 0, size=(0.04, 0.04))) == pytest.approx(0.383 * 0.04, rel=2e-3)


def test_energy_is_never_created(engine: Engine) -> None:
    scene = authors_sim(3)
    # Bullet's world leaves objects in the walls, as its users do, and it shoots them out.
    scene = replace(scene, objects=settled(scene, world_parameters("authors_sim")))
    world = engine(scene)
    rng = np.random.default_rng(5)
    greatest = 0.0
    for cycle in range(400):
        if cycle % 25 == 0:
            aim = rng.uniform(-1, 1, 3) * (0.05, 0.05, 0.35)
        push = Twist(0.03 + float(aim[0]), float(aim[1]), float(aim[2]))
        world.step(0.01, push)
        energy = world.kinetic_energy()
        greatest = max(greatest, energy)
        # Objects are generated with overlaps of up to 0.6 mm, which let go of 0.3 mJ at first.
        assert energy <= world.motor_work + 5e-4
    assert greatest > 1e-2  # something did move
    # While the motors brake it all comes to rest, and stays at rest.
    run(world, 0.5, ZERO)
    assert world.kinetic_energy() < 1e-6
    assert world.motor_work > 0


def test_untouched_objects_stay_in_place(engine: Engine) -> None:
    world = engine(authors_sim(4))
    before = world.poses()
    run(world, 2.0, ZERO)
    moved = np.abs(world.poses() - before)
    assert moved[:, :2].max() < 0.001
    assert world.kinetic_energy() < 1e-6
    assert world.finger().fx == 0.0
    assert world.contacts() == ()


@pytest.mark.parametrize("name", ["mujoco", "planar"])
def test_same_commands_same_bits(name: str) -> None:
    try:
        engine = world_maker(name)
    except EngineMissing as missing:
        pytest.skip(str(missing))

    def trial() -> bytes:
        world = engine(authors_sim(11))
        heard = []
        for cycle in range(600):
            world.step(0.01, Twist(0.05, 0.02 * math.sin(cycle / 20), 0.1 * math.cos(cycle / 30)))
            heard.append((world.contacts(), world.finger()))
        return world.poses().tobytes() + repr(heard).encode()

    assert trial() == trial()


@pytest.mark.parametrize(
    ("y", "twist", "normal"), [(0.1, Twist(0, 0.05, 0), 1.0), (-0.1, Twist(0, -0.05, 0), -1.0)]
)
def test_side_touch_is_located_correctly(
    engine: Engine, build: Any, y: float, twist: Twist, normal: float
) -> None:
    world = engine(build.cupboard(build.disc(0.17, y), start=Pose(0.12, 0.0, 0.0)))
    run(world, 1.5, twist)
    forces = []
    for _ in range(100):
        world.step(0.01, twist)
        felt = world.contacts()
        forces.append(sum(contact.normal_force for contact in felt))
        assert world.finger().fy == pytest.approx(sum(c.force_y for c in felt), rel=0.02, abs=1e-6)
        for contact in felt:
            assert contact.body == 0
            assert contact.x == pytest.approx(0.05, abs=0.004)
            assert contact.y == pytest.approx(normal * 0.0285, abs=SKIN)
            assert (contact.normal_x, contact.normal_y) == pytest.approx((0.0, normal), abs=1e-3)
            assert contact.force_y * normal < 0
    # It slides at a steady speed, so on average the finger bears its friction with the shelf.
    assert np.mean(forces) == pytest.approx(0.20 * 0.5 * G, rel=cylinder_error(engine) + 0.01)


def test_motors_hold_their_speed_under_load(engine: Engine, build: Any) -> None:
    # Three boxes in a row: 3 N of friction of the 10 N the motor has.
    row = [build.box(0.05 + 0.045 * i, 0.0, mass=0.5) for i in range(3)]
    world = engine(build.cupboard(*row, start=Pose(0.05 - 0.02 - TIP - 0.01, 0.0, 0.0)))
    run(world, 2.0, FORWARD)
    loads, start = [], world.finger().x
    for _ in range(150):
        world.step(0.01, FORWARD)
        loads.append(-world.finger().fx)
    assert np.mean(loads) == pytest.approx(3 * 0.20 * 0.5 * G, rel=0.1)
    assert (world.finger().x - start) / 1.5 == pytest.approx(FORWARD.vx, rel=0.01)


@pytest.mark.parametrize("on", ["object", "wall"])
def test_shear_is_bounded_by_friction_and_reached_in_sliding(
    engine: Engine, build: Any, on: str
) -> None:
    # 20 kg stand fast: their friction with the shelf is 39 N, and the finger has 8.
    heavy = build.box(0.15, -0.1, mass=20.0)
    side = -0.08 if on == "object" else -0.275
    scene = build.cupboard(heavy, start=Pose(0.06, side + 0.03, 0.0))
    coefficient = 0.34 if on == "object" else 0.425
    world = engine(scene)
    world.limit_wrench(8.0, 1.5)
    run(world, 0.5, Twist(0.0, -0.05, 0.0))
    run(world, 0.1, Twist(0.05, -0.05, 0.0))
    normals, ratios = [], []
    for _ in range(60):
        world.step(0.01, Twist(0.05, -0.05, 0.0))
        contacts = world.contacts()
        normals.append(sum(contact.normal_force for contact in contacts))
        if normals[-1] > 0:
            ratios.append(sum(contact.shear_force for contact in contacts) / normals[-1])
    # MuJoCo's fast-sliding contacts skip from step to step, but on average they bear the push.
    assert np.mean(normals) == pytest.approx(8.0, rel=0.05)
    # Outward is to the right, so "counter-clockwise of outward" is forward: friction is backward.
    assert min(ratios) >= -coefficient * 1.02
    assert np.median(ratios) == pytest.approx(-coefficient, rel=0.02)


def test_contacts_add_up_to_the_wrench_and_lie_on_the_skin(engine: Engine) -> None:
    world = engine(authors_sim(6))
    outline = np.array(FINGER_OUTLINE)
    nexts = np.roll(outline, -1, axis=0)
    touched = 0
    for _ in range(500):
        world.step(0.005, FORWARD)
        finger, contacts = world.finger(), world.contacts()
        fx = sum(c.force_x for c in contacts)
        fy = sum(c.force_y for c in contacts)
        mz = sum(c.x * c.force_y - c.y * c.force_x for c in contacts)
        c, s = math.cos(finger.heading), math.sin(finger.heading)
        touched += bool(contacts)
        # One step turns the finger by up to 2 mrad between the force and the pose it is read at.
        force = max(0.05, 0.01 * math.hypot(fx, fy))
        assert (c * fx - s * fy, s * fx + c * fy) == pytest.approx(
            (finger.fx, finger.fy), abs=force
        )
        assert mz == pytest.approx(finger.mz, abs=max(0.01, 0.02 * math.hypot(fx, fy)))
        for contact in contacts:
            point = np.array([contact.x, contact.y])
            along = nexts - outline
            share = np.clip(((point - outline) * along).sum(1) / (along**2).sum(1), 0, 1)
            gap = np.linalg.norm(outline + share[:, None] * along - point, axis=1).min()
            assert gap < 0.0005
    assert touched > 100


def test_objects_pushed_past_the_front_edge_fall_and_are_counted(
    engine: Engine, build: Any
) -> None:
    scene = build.cupboard(build.box(0.03, 0.0), build.disc(0.25, 0.2), start=Pose(0.07, 0.0, 0.0))
    world = engine(scene)
    run(world, 0.5, Twist(-0.05, 0.0, 0.0))
    assert world.ejected == 0
    run(world, 2.5, Twist(-0.05, 0.0, 0.0))
    assert world.ejected == 1
    assert world.on_shelf().tolist() == [False, True]
    assert world.poses()[0, 0] < -WORLD_PARAMETERS["authors_sim"].lip
    # What has fallen is out of the way, and stays counted.
    run(world, 1.0, Twist(-0.05, 0.0, 0.0))
    assert world.contacts() == ()
    assert world.ejected == 1


def test_objects_overlapping_a_wall_are_moved_out_gently(build: Any) -> None:
    scene = build.cupboard(build.disc(0.375 - 0.03, 0.0), build.disc(0.1, 0.1))
    world = MujocoWorld(scene)
    assert world.poses()[0, 0] == pytest.approx(0.375 - 0.04, abs=0.001)
    assert world.poses()[1].tolist() == pytest.approx([0.1, 0.1, 0.0], abs=1e-6)
    assert world.kinetic_energy() == 0.0
    run(world, 0.5, ZERO)
    assert world.poses()[0, 0] == pytest.approx(0.375 - 0.04, abs=0.001)


def test_misuse_is_refused(engine: Engine, build: Any) -> None:
    world = engine(build.cupboard())
    for dt in (0.0, -0.01, 0.004, 0.0075):
        with pytest.raises(ValueError, match="multiple"):
            world.step(dt, ZERO)
    with pytest.raises(ValueError, match="finite"):
        world.step(0.005, Twist(math.nan, 0.0, 0.0))
    for limits in ((0.0, 1.0), (10.0, math.inf), (math.nan, 1.0)):
        with pytest.raises(ValueError, match="limits"):
            world.limit_wrench(*limits)
    assert world.time == 0.0


@pytest.mark.parametrize("name", ["hardware", "authors_sim"])
def test_free_finger_follows_its_command(name: str, build: Any) -> None:
    parameters = WORLD_PARAMETERS[name]
    world = MujocoWorld(build.cupboard(), parameters)
    v, w = parameters.limits.v_max, parameters.limits.omega_max
    wanted = Twist(0.6 * v, -0.8 * v, w)
    run(world, 0.2, wanted)
    moved = world.finger().twist
    assert (moved.vx, moved.vy, moved.omega) == pytest.approx(
        (wanted.vx, wanted.vy, wanted.omega), rel=0.01
    )
    run(world, 0.1, ZERO)
    assert abs(world.finger().twist.vx) < 1e-4
    # One physics step of full force changes speeds by no more than half their limits.
    limits = parameters.limits
    assert limits.f_max * 0.005 / parameters.finger_mass <= v / 2
    assert limits.m_max * 0.005 / parameters.finger_inertia <= w / 2 * (1 + 1e-9)


def test_finger_start_heading_is_respected(engine: Engine, build: Any) -> None:
    # Turned to the left, its tip is where the disc is.
    start = Pose(0.1, 0.0, math.pi / 2)
    world = engine(build.cupboard(build.disc(0.1, TIP + 0.042), start=start))
    assert world.finger().heading == pytest.approx(math.pi / 2)
    run(world, 0.5, Twist(0.0, 0.05, 0.0))
    contacts = world.contacts()
    assert {contact.body for contact in contacts} == {0}
    assert all(contact.x == pytest.approx(TIP, abs=1e-3) for contact in contacts)


def test_diverging_physics_is_an_error_and_leaves_no_file(
    build: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    world = MujocoWorld(build.cupboard(build.disc(0.1, 0.0)))
    world.step(0.01, FORWARD)
    world.data.qvel[0] = math.nan
    with pytest.raises(WorldError, match="scene 0"):
        world.step(0.01, FORWARD)
    assert list(tmp_path.iterdir()) == []
