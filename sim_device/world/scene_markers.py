"""Cupboard as markers, for the bus, logs and 3D views: one message holds the whole scene."""

from __future__ import annotations

import math
from typing import Any, Final

from sim_device.world.base import World
from sim_device.world.scenes import Shape
from sim_device.world.touch import SHELF_CLEARANCE
from tactile_core.bus.markers import CUBE, CYLINDER, DELETE, SPHERE, marker
from tactile_core.bus.messages import MSG
from tactile_core.geometry import FINGER_HEIGHT

OBJECTS, CUPBOARD, FINGER, GOAL = "objects", "cupboard", "finger", "goal"
"""Namespaces of the markers; an object's id is its index in the scene."""

FRAME: Final = "cupboard"
WALL: Final = 0.01  # m, how thick the cupboard's walls are drawn
LIGHTEST, HEAVIEST = 0.1, 0.8  # kg; darker objects are heavier, as in the paper's figure 2


def scene_markers(world: World, wall_ns: int) -> Any:
    """``MarkerArray`` of objects still on the shelf, cupboard, finger and goal, now."""
    scene = world.scene
    made = []

    def add(
        namespace: str,
        number: int,
        kind: int,
        pose: tuple[float, float, float, float],
        size: tuple[float, float, float],
        colour: tuple[float, float, float, float],
    ) -> None:
        made.append(marker(wall_ns, FRAME, namespace, number, kind, pose, size, colour))

    poses, standing = world.poses().tolist(), world.on_shelf().tolist()
    for number, thing in enumerate(scene.objects):
        if not standing[number]:
            gone = (0.0, 0.0, 0.0, 0.0)
            made.append(
                marker(
                    wall_ns, FRAME, OBJECTS, number, CUBE, gone, (0.0, 0.0, 0.0), gone,
                    action=DELETE,
                )
            )  # fmt: skip
            continue
        x, y, yaw = poses[number]
        share = min(1.0, max(0.0, (thing.mass - LIGHTEST) / (HEAVIEST - LIGHTEST)))
        tone = 0.85 - 0.6 * share
        kind = CYLINDER if thing.shape is Shape.DISC else CUBE
        size = (thing.size_x, thing.size_y, thing.height)
        add(OBJECTS, number, kind, (x, y, thing.height / 2, yaw), size, (tone, tone, tone, 1.0))
    depth, width = scene.depth, scene.width
    wood = (0.6, 0.45, 0.3, 1.0)
    height = FINGER_HEIGHT
    across = (depth, WALL, height)
    add(CUPBOARD, 0, CUBE, (depth + WALL / 2, 0, height / 2, 0), (WALL, width, height), wood)
    add(CUPBOARD, 1, CUBE, (depth / 2, (width + WALL) / 2, height / 2, 0), across, wood)
    add(CUPBOARD, 2, CUBE, (depth / 2, -(width + WALL) / 2, height / 2, 0), across, wood)
    finger = world.finger()
    xs, ys = zip(*world.outline, strict=True)
    size = (max(xs) - min(xs), max(ys) - min(ys), FINGER_HEIGHT)
    middle = SHELF_CLEARANCE + FINGER_HEIGHT / 2
    # A cube's pose is that of its centre, the finger's is that of its pivot.
    ahead = (max(xs) + min(xs)) / 2
    x, y = (
        finger.x + ahead * math.cos(finger.heading),
        finger.y + ahead * math.sin(finger.heading),
    )
    add(FINGER, 0, CUBE, (x, y, middle, finger.heading), size, (0.1, 0.4, 0.8, 0.9))
    add(GOAL, 0, SPHERE, (*scene.goal, middle, 0.0), (0.015, 0.015, 0.015), (0.0, 0.6, 0.3, 1.0))
    return MSG.MarkerArray(made)
