"""Scene as a planar MuJoCo model.

The settings come from trials of several engines: elliptic cones because jams slip with pyramidal
ones, ``impratio`` 10 because at 1 objects creep at half their friction, steps of 5 ms because it
diverges at 10. Each object slides in x, y, z and turns about z. A disc is a sphere, because only
its outline in the plane matters and spheres are the cheapest; the boxes beside it are tall.
Weight rests on one massless support sphere. Its torsional friction gives sliding and turning one
common ellipsoidal limit surface, as a wide footprint has.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Final

import mujoco
import numpy as np

from sim_device.world.base import PHYSICS_STEP
from sim_device.world.parameters import WorldParameters
from sim_device.world.scenes import Scene, SceneObject, Shape
from tactile_core.geometry import FINGER_HEIGHT

GRAVITY: Final = 9.81
"""Acceleration of gravity, m/s²."""

PLANE_HEIGHT: Final = 0.06
"""Height of the plane in which all bodies are centred, m: half the height of a box."""

SUPPORT_RADIUS: Final = 0.005
"""Radius of the sphere that an object rests on, m."""

DROP: Final = 1.0
"""Height of the shelf above the floor in front of it, m. What fell lies still there and costs
nothing."""

MOTOR_TIME: Final = 0.005
"""Time constant of the velocity motors, s: gains of 600 N·s/m and 10 N·m·s/rad on the finger of
`authors_sim`. A shorter one is stiffer than a physics step can follow."""

CONTACT_SOLREF: Final = (0.01, 1.0)
"""Time constant, s, and damping ratio of contacts. Two physics steps are the least MuJoCo takes."""

CONTACT_SOLIMP: Final = (0.95, 0.99, 0.0005, 0.5, 2.0)
"""Impedance of contacts: least, greatest, width in m, midpoint, power."""

SUPPORT_SOLREF: Final = (0.02, 1.0)
"""Time constant, s, and damping ratio of what objects rest on."""

# Bits of contype/conaffinity: bodies of the plane touch each other, supports only the ground.
_PLANAR, _GROUND = 1, 2

FINGER_BODY: Final = "finger"
FINGER_GEOM: Final = "finger"
BACK_WALL: Final = "back"


def mean_lever(item: SceneObject) -> float:
    """Mean distance of a footprint's points from its centre, m: ratio of torsional to sliding
    friction.

    Two thirds of the radius for a disc; for a rectangle the integral in closed form (0.383 of the
    side for a square).
    """
    if item.shape is Shape.DISC:
        return item.radius * 2 / 3
    p, q = item.size_x / 2, item.size_y / 2
    d = math.hypot(p, q)
    whole = 2 * p * q * d + p**3 * math.log((q + d) / p) + q**3 * math.log((p + d) / q)
    return whole / (6 * p * q)


def yaw_inertia(item: SceneObject) -> float:
    """Moment of inertia of a homogeneous object about the vertical through its centre, kg·m²."""
    if item.shape is Shape.DISC:
        return item.mass * item.radius**2 / 2
    return item.mass * (item.size_x**2 + item.size_y**2) / 12


def base_spec(gravity: float = GRAVITY) -> mujoco.MjSpec:
    """Empty model with the solver's settings. ``gravity``: m/s², downwards."""
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    option = spec.option
    option.timestep = PHYSICS_STEP
    option.gravity = [0.0, 0.0, -gravity]
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    option.solver = mujoco.mjtSolver.mjSOL_NEWTON
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    option.impratio = 10.0
    option.iterations = 50
    option.tolerance = 1e-8
    option.enableflags = int(mujoco.mjtEnableBit.mjENBL_SLEEP)
    # Bounding trees over bodies of one shape each cost an eighth of the time and find nothing.
    option.disableflags = int(mujoco.mjtDisableBit.mjDSBL_MIDPHASE)
    return spec


def add_object(
    spec: mujoco.MjSpec,
    name: str,
    item: SceneObject,
    *,
    friction_objects: float,
    friction_shelf: float,
) -> None:
    """Put ``item`` on the shelf."""
    body = spec.worldbody.add_body(name=name, pos=[item.x, item.y, PLANE_HEIGHT])
    for joint, axis in (("x", (1, 0, 0)), ("y", (0, 1, 0)), ("z", (0, 0, 1))):
        body.add_joint(name=f"{name}_{joint}", type=mujoco.mjtJoint.mjJNT_SLIDE, axis=axis)
    body.add_joint(name=f"{name}_yaw", type=mujoco.mjtJoint.mjJNT_HINGE, axis=(0, 0, 1))
    inertia = yaw_inertia(item)
    body.explicitinertial = True
    body.mass = item.mass
    body.ipos = [0, 0, 0]
    body.inertia = [inertia, inertia, inertia]
    if item.shape is Shape.DISC:
        kind, size = mujoco.mjtGeom.mjGEOM_SPHERE, [item.radius, 0, 0]
    else:
        kind = mujoco.mjtGeom.mjGEOM_BOX
        size = [item.size_x / 2, item.size_y / 2, PLANE_HEIGHT]
    half = item.yaw / 2
    body.add_geom(
        name=name,
        type=kind,
        size=size,
        quat=[math.cos(half), 0, 0, math.sin(half)],
        mass=0,
        condim=3,
        friction=[friction_objects, 0, 0],
        solref=CONTACT_SOLREF,
        solimp=CONTACT_SOLIMP,
        contype=_PLANAR,
        conaffinity=_PLANAR,
    )
    body.add_geom(
        name=f"{name}_support",
        type=mujoco.mjtGeom.mjGEOM_SPHERE,
        size=[SUPPORT_RADIUS, 0, 0],
        pos=[0, 0, SUPPORT_RADIUS - PLANE_HEIGHT],
        mass=0,
        condim=4,
        priority=1,
        friction=[friction_shelf, friction_shelf * mean_lever(item), 0],
        solref=SUPPORT_SOLREF,
        contype=_GROUND,
        conaffinity=0,
    )


def add_wall(
    spec: mujoco.MjSpec,
    name: str,
    point: tuple[float, float],
    normal: float,
    friction: float,
    *,
    moves: bool = False,
) -> None:
    """Add a vertical plane through ``point`` that faces the angle ``normal`` (rad in ``cupboard``).

    ``moves``: makes it a mocap body, which costs time, so that it can be moved between steps.
    """
    # Turn the plane's z axis to the horizontal, then about the vertical.
    c, s = math.cos(normal / 2), math.sin(normal / 2)
    h = math.sqrt(0.5)
    place = [*point, 0.0]
    body = spec.worldbody.add_body(name=name, pos=place, mocap=True) if moves else spec.worldbody
    body.add_geom(
        name=name,
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=[1, 1, 1],
        pos=[0, 0, 0] if moves else place,
        quat=[c * h, -s * h, c * h, s * h],
        condim=3,
        friction=[friction, 0, 0],
        solref=CONTACT_SOLREF,
        solimp=CONTACT_SOLIMP,
        contype=_PLANAR,
        conaffinity=_PLANAR,
    )


def add_ground(
    spec: mujoco.MjSpec, name: str, x: tuple[float, float], half_width: float, top: float
) -> None:
    """Add a horizontal slab for objects to rest on, from x[0] to x[1], upper face at ``top``; m."""
    half = (x[1] - x[0]) / 2
    spec.worldbody.add_geom(
        name=name,
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=[half, half_width, 0.05],
        pos=[x[0] + half, 0, top - 0.05],
        contype=0,
        conaffinity=_GROUND,
    )


def cupboard_model(scene: Scene, parameters: WorldParameters) -> mujoco.MjModel:
    """Model of ``scene``: objects ``object_<i>``, walls, shelf, ground, finger and its motors."""
    # Heavier objects under weaker gravity: the same weight and friction, more inertia.
    heavier = parameters.inertia_scale
    spec = base_spec(GRAVITY / heavier)
    friction = parameters.friction
    half = scene.width / 2
    margin = 0.1
    add_ground(spec, "shelf", (-parameters.lip, scene.depth + margin), half + margin, 0.0)
    add_ground(spec, "floor", (-1.0, scene.depth), 1.0, -DROP)
    walls = {
        BACK_WALL: ((scene.depth, 0.0), math.pi),
        "left": ((0.0, half), -math.pi / 2),
        "right": ((0.0, -half), math.pi / 2),
    }
    for name, (point, normal) in walls.items():
        add_wall(spec, name, point, normal, friction.object_wall)
    for index, item in enumerate(scene.objects):
        add_object(
            spec,
            f"object_{index}",
            replace(item, mass=item.mass * heavier),
            friction_objects=friction.objects,
            friction_shelf=friction.object_shelf,
        )
    _add_finger(spec, scene, parameters)
    for name in walls:
        # MuJoCo uses the greater friction of two surfaces, which is right except for this pair.
        spec.add_pair(
            name=f"finger_{name}",
            geomname1=name,
            geomname2=FINGER_GEOM,
            condim=3,
            friction=[friction.finger_wall, friction.finger_wall, 0, 0, 0],
            solref=CONTACT_SOLREF,
            solimp=CONTACT_SOLIMP,
        )
    return spec.compile()


def _add_finger(spec: mujoco.MjSpec, scene: Scene, parameters: WorldParameters) -> None:
    """Add the finger: its outline extruded, three joints at the pivot, a velocity motor on each.

    It is built with heading 0, as a body's joints turn with it; set the start heading as an angle.
    """
    start = scene.start
    outline = np.asarray(parameters.outline)
    z = FINGER_HEIGHT / 2
    vertices = np.concatenate([np.insert(outline, 2, z, axis=1), np.insert(outline, 2, -z, axis=1)])
    spec.add_mesh(name="finger", uservert=vertices.ravel().tolist())
    body = spec.worldbody.add_body(name=FINGER_BODY, pos=[start.x, start.y, PLANE_HEIGHT])
    slide, hinge = mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE
    body.add_joint(name="finger_x", type=slide, axis=(1, 0, 0))
    body.add_joint(name="finger_y", type=slide, axis=(0, 1, 0))
    body.add_joint(name="finger_yaw", type=hinge, axis=(0, 0, 1))
    body.explicitinertial = True
    body.mass = parameters.finger_mass
    body.ipos = [0, 0, 0]
    body.inertia = [parameters.finger_inertia] * 3
    body.add_geom(
        name=FINGER_GEOM,
        type=mujoco.mjtGeom.mjGEOM_MESH,
        meshname="finger",
        mass=0,
        condim=3,
        friction=[parameters.friction.finger_object, 0, 0],
        solref=CONTACT_SOLREF,
        solimp=CONTACT_SOLIMP,
        contype=_PLANAR,
        conaffinity=_PLANAR,
    )
    limits = parameters.limits
    for joint, inertia, bound in (
        ("finger_x", parameters.finger_mass, limits.f_max),
        ("finger_y", parameters.finger_mass, limits.f_max),
        ("finger_yaw", parameters.finger_inertia, limits.m_max),
    ):
        motor = spec.add_actuator(
            name=joint,
            target=joint,
            trntype=mujoco.mjtTrn.mjTRN_JOINT,
            forcerange=[-bound, bound],
            forcelimited=True,
        )
        motor.set_to_velocity(kv=inertia / MOTOR_TIME)
