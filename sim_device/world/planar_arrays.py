"""Scenes as the arrays that the kernels of the planar engine work on."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import lru_cache
from typing import Any, Final

import numba
import numpy as np
from numpy.typing import NDArray

from sim_device.world.mujoco_model import GRAVITY, SUPPORT_SOLREF, mean_lever, yaw_inertia
from sim_device.world.parameters import WorldParameters
from sim_device.world.planar_solver import (
    BODY,
    CONTACT,
    CORNERS,
    DISC,
    FALLEN,
    GROUND,
    IMPRATIO,
    MEMORY,
    POLYGON,
    REAL,
    SUPPORT_SOLIMP,
    WORLD,
    place_all,
)
from sim_device.world.scene_squeeze import settled
from sim_device.world.scenes import Scene, SceneObject, Shape

CONTACTS_PER_OBJECT: Final = 8
"""Memory for contacts; a disc among discs has at most 6, of which each is shared by two."""

FELT: Final = 32
"""Memory for contacts on the finger."""

READOUT: Final = 13

Corners = Sequence[tuple[float, float]]


@dataclass(frozen=True, slots=True)
class Arrays:
    """Memory of some worlds, a row of each array for one; see `planar_solver`.

    ``wanted`` (w, 3): twist that the motors are asked for, m/s and rad/s in ``cupboard``.
    """

    wanted: NDArray[Any]
    worlds: NDArray[Any]
    bodies: NDArray[Any]
    outlines: NDArray[Any]
    hulls: NDArray[Any]
    contacts: NDArray[Any]
    memory: NDArray[Any]
    queues: NDArray[Any]
    felt: NDArray[Any]
    readout: NDArray[Any]

    @property
    def all(self) -> tuple[NDArray[Any], ...]:
        """The arrays in the order in which the kernels take them."""
        return tuple([getattr(self, name) for name in self.names])

    @property
    def names(self) -> tuple[str, ...]:
        """Their names in that order."""
        return tuple([field.name for field in fields(self)])


def arrays_of(
    scenes: Sequence[Scene], parameters: Sequence[WorldParameters], room: int | None = None
) -> Arrays:
    """Memory of worlds built from ``scenes``, with ``room`` for objects in each.

    ``room``: None for as many as the largest has.
    """
    most = max((len(scene.objects) for scene in scenes), default=0)
    arrays = empty(len(scenes), most if room is None else room)
    for index, (scene, figures) in enumerate(zip(scenes, parameters, strict=True)):
        put(arrays, index, scene, figures)
    return arrays


def empty(worlds: int, objects: int) -> Arrays:
    """Memory for so many worlds of at most so many objects."""
    slots, contacts = objects + 2, CONTACTS_PER_OBJECT * (objects + 2)
    return Arrays(
        wanted=np.zeros((worlds, 3), REAL),
        worlds=np.zeros(worlds, WORLD),
        bodies=np.zeros((worlds, slots), BODY),
        outlines=np.zeros((worlds, slots, CORNERS, 4), REAL),
        hulls=np.zeros((worlds, slots, CORNERS, 4), REAL),
        contacts=np.zeros((worlds, contacts), CONTACT),
        memory=np.zeros((worlds, contacts), MEMORY),
        queues=np.zeros((worlds, slots), np.int64),
        felt=np.zeros((worlds, FELT, 8), REAL),
        readout=np.zeros((worlds, READOUT), REAL),
    )


def _named(records: NDArray[Any]) -> NDArray[Any]:
    """``records`` with fields as attributes in Python, too, where Numba is told not to compile."""
    disabled = bool(getattr(numba.config, "DISABLE_JIT", False))
    return records.view(np.recarray) if disabled else records


def put(arrays: Arrays, w: int, scene: Scene, parameters: WorldParameters) -> None:
    """Build ``scene`` in row ``w`` of ``arrays``, whatever was there.

    Objects that overlap a wall are first moved out of it, see `settled`. ValueError where it has
    more objects than there is room for.
    """
    room, count = arrays.bodies.shape[1], len(scene.objects) + 2
    if count > room:
        raise ValueError(f"{count - 2} objects in a world with room for {room - 2}")
    world, bodies, outlines = _built(scene, parameters)
    arrays.wanted[w] = 0.0
    arrays.worlds[w] = world
    arrays.bodies[w, :count], arrays.bodies[w, count:] = bodies, bodies[-1]
    arrays.outlines[w, :count] = outlines
    place_all(w, _named(arrays.bodies), arrays.outlines, arrays.hulls)
    finger = bodies[0]
    arrays.readout[w] = 0.0
    arrays.readout[w, :3] = finger["x"], finger["y"], finger["yaw"]


@lru_cache(maxsize=1024)
def _built(
    scene: Scene, parameters: WorldParameters
) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """World, bodies and outlines of ``scene``; kept, for training begins the same scenes again."""
    objects = settled(scene, parameters)
    world, bodies = np.zeros((), WORLD), np.zeros(len(objects) + 2, BODY)
    outlines = np.zeros((len(bodies), CORNERS, 4), REAL)
    _world(world, scene, parameters)
    _finger(bodies[0], outlines[0], scene, parameters)
    softness = shelf_softness(GRAVITY / parameters.inertia_scale)
    for index, item in enumerate(objects, 1):
        _object(bodies[index], outlines[index], item, parameters, softness)
    bodies[-1]["kind"] = GROUND
    return world, bodies, outlines


def shelf_softness(gravity: float) -> float:
    """R of an object's friction with the shelf times its mass.

    It follows from how deep MuJoCo's support sinks into the shelf at rest under ``gravity``, m/s²:
    k d r = R g with R = (1 − d)/d and d a sigmoid of r.
    """
    d0, d1, width = SUPPORT_SOLIMP
    stiffness = 1.0 / (d1 * SUPPORT_SOLREF[0]) ** 2
    low, high = 0.0, width
    for _ in range(60):
        depth = (low + high) / 2
        x = min(depth / width, 1.0)
        d = d0 + (2 * x * x if x <= 0.5 else 1 - 2 * (1 - x) ** 2) * (d1 - d0)
        if stiffness * d * depth < (1 - d) / d * gravity:
            low = depth
        else:
            high = depth
    return (1 - d) / d / IMPRATIO


def _world(world: Any, scene: Scene, parameters: WorldParameters) -> None:
    friction, limits = parameters.friction, parameters.limits
    world["bodies"] = len(scene.objects) + 1
    world["depth"], world["half_width"] = scene.depth, scene.width / 2
    world["front"] = -parameters.lip
    world["object_object"], world["object_wall"] = friction.objects, friction.object_wall
    world["finger_object"], world["finger_wall"] = friction.finger_object, friction.finger_wall
    world["mass"], world["inertia"] = parameters.finger_mass, parameters.finger_inertia
    world["f_max"], world["m_max"] = limits.f_max, limits.m_max


def _finger(body: Any, outline: Any, scene: Scene, parameters: WorldParameters) -> None:
    start = scene.start
    body["x"], body["y"], body["yaw"] = start.x, start.y, start.heading
    body["inv_mass"] = 1 / parameters.finger_mass
    body["inv_inertia"] = 1 / parameters.finger_inertia
    # MuJoCo's mean over three axes, on one of which the finger cannot move.
    body["inv_weight"] = 2 / (3 * parameters.finger_mass)
    _polygon(body, outline, parameters.outline)
    body["ahead"] = (outline[:, 0].min() + outline[:, 0].max()) / 2
    across = np.hypot(outline[:, 0] - body["ahead"], outline[:, 1])
    body["radius"] = across.max()


def _object(
    body: Any, outline: Any, item: SceneObject, parameters: WorldParameters, softness: float
) -> None:
    heavier = parameters.inertia_scale
    body["x"], body["y"], body["yaw"] = item.x, item.y, item.yaw
    body["inv_mass"] = body["inv_weight"] = 1 / (heavier * item.mass)
    body["inv_inertia"] = 1 / (heavier * yaw_inertia(item))
    body["lever"] = mean_lever(item)
    body["grip"] = parameters.friction.object_shelf * item.mass * GRAVITY
    body["softness"] = softness / (heavier * item.mass)
    if item.shape is Shape.DISC:
        body["kind"], body["radius"] = DISC, item.radius
    else:
        x, y = item.size_x / 2, item.size_y / 2
        _polygon(body, outline, ((-x, -y), (x, -y), (x, y), (-x, y)))
        body["radius"] = math.hypot(x, y)


def _polygon(body: Any, outline: Any, corners: Corners) -> None:
    """Corners in counter-clockwise order, and the outward normals of the edges that begin there."""
    if len(corners) > CORNERS:
        raise ValueError(f"an outline of {len(corners)} corners; at most {CORNERS}")
    body["kind"], body["corners"] = POLYGON, len(corners)
    points = np.array(corners)
    along = np.roll(points, -1, axis=0) - points
    normals = np.stack([along[:, 1], -along[:, 0]], axis=1)
    outline[:] = 0.0
    outline[: len(corners), :2] = points
    outline[: len(corners), 2:] = normals / np.linalg.norm(normals, axis=1)[:, np.newaxis]


def poses_of(bodies: NDArray[Any], count: int) -> NDArray[Any]:
    """(…, count, 3) x, y m and yaw rad of objects in ``cupboard``, from rows of ``bodies``."""
    objects = bodies[..., 1 : count + 1]
    return np.stack([objects["x"], objects["y"], objects["yaw"]], axis=-1)


def standing(bodies: NDArray[Any], count: int) -> NDArray[np.bool_]:
    """(…, count) whether each object still stands on the shelf."""
    on: NDArray[np.bool_] = bodies["kind"][..., 1 : count + 1] != FALLEN
    return on
