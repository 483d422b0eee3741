"""Push objects on a shelf with moving plates: used to squeeze and settle scenes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import mujoco

from sim_device.world.base import PHYSICS_STEP
from sim_device.world.mujoco_model import add_ground, add_object, add_wall, base_spec
from sim_device.world.parameters import WorldParameters
from sim_device.world.scenes import Scene, SceneObject

SETTLE_SPEED = 0.05
"""Speed at which walls move out of objects, m/s: that of the finger, slow enough that nothing
slides on (v² / 2μg = 0.6 mm)."""

REST = 0.1
"""Seconds of rest after the plates of a stage have stopped: contacts, 1 mm deep at 0.1 m/s, recover
with a time constant of 10 ms."""


@dataclass(frozen=True, slots=True)
class Plate:
    """Vertical plate facing ``normal`` (rad) that moves along x if that is 0 or π, else along y.

    Its face moves from ``start`` to ``end`` m, and stands at ``rest`` m (None: at ``end``) while
    later stages move.
    """

    normal: float
    start: float
    end: float
    rest: float | None = None

    @property
    def along_x(self) -> bool:
        """Whether it moves along x."""
        return abs(math.cos(self.normal)) > 0.5


def push(
    objects: Sequence[SceneObject],
    stages: Sequence[Sequence[Plate]],
    parameters: WorldParameters,
    *,
    speed: float,
    gravity: float = 9.81,
) -> tuple[SceneObject, ...]:
    """Objects where the plates leave them; plates of one stage move together, then stand.

    ``speed``: m/s. ``gravity``: m/s²; higher gravity stops pushed objects sooner and does not
    change the balance of forces between objects that are pushed slowly.
    """
    spec = base_spec(gravity)
    add_ground(spec, "shelf", (-2.0, 2.0), 2.0, 0.0)
    friction = parameters.friction
    for index, item in enumerate(objects):
        add_object(
            spec,
            f"object_{index}",
            item,
            friction_objects=friction.objects,
            friction_shelf=friction.object_shelf,
        )
    plates = [plate for stage in stages for plate in stage]
    for index, plate in enumerate(plates):
        place = (plate.start, 0.0) if plate.along_x else (0.0, plate.start)
        name = f"plate_{index}"
        add_wall(spec, name, place, plate.normal, friction.object_wall, moves=True)
    model = spec.compile()
    data = mujoco.MjData(model)
    first = 0
    for stage in stages:
        way = max(abs(plate.end - plate.start) for plate in stage)
        steps = max(1, math.ceil(way / speed / PHYSICS_STEP))
        for step in range(1, steps + 1):
            for index, plate in enumerate(stage, first):
                axis = 0 if plate.along_x else 1
                at = plate.start + (plate.end - plate.start) * step / steps
                data.mocap_pos[index, axis] = at
            mujoco.mj_step(model, data)
        mujoco.mj_step(model, data, round(REST / PHYSICS_STEP))
        for index, plate in enumerate(stage, first):
            if plate.rest is not None:
                data.mocap_pos[index, 0 if plate.along_x else 1] = plate.rest
        first += len(stage)
    moved = data.qpos.reshape(len(objects), 4) if objects else ()
    return tuple(
        replace(
            item,
            x=item.x + float(q[0]),
            y=item.y + float(q[1]),
            yaw=item.yaw + float(q[3]),
        )
        for item, q in zip(objects, moved, strict=True)
    )


def settled(scene: Scene, parameters: WorldParameters) -> tuple[SceneObject, ...]:
    """Objects of ``scene`` after its walls have pushed out those that overlap them.

    The authors' scenes overlap the back wall by up to 1 cm; an engine would shoot such an object
    through the cupboard.
    """
    half = scene.width / 2
    back = max((o.x + o.half_extent[0] for o in scene.objects), default=0.0)
    left = max((o.y + o.half_extent[1] for o in scene.objects), default=0.0)
    right = min((o.y - o.half_extent[1] for o in scene.objects), default=0.0)
    if back <= scene.depth and left <= half and right >= -half:
        return scene.objects
    plates = (
        Plate(math.pi, max(back, scene.depth), scene.depth),
        Plate(-math.pi / 2, max(left, half), half),
        Plate(math.pi / 2, min(right, -half), -half),
    )
    return push(scene.objects, (plates,), parameters, speed=SETTLE_SPEED)
