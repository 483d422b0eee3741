"""Shapes for a 3D view: ``visualization_msgs/Marker`` with the rarely used fields left empty."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from tactile_core.bus.messages import MSG, header, message_class

ARROW, CUBE, SPHERE, CYLINDER, SPHERE_LIST, TEXT = 0, 1, 2, 3, 7, 9
"""Kinds of marker, as ``visualization_msgs/Marker`` numbers them."""

ADD, DELETE, DELETE_ALL = 0, 2, 3
"""Action of a marker on the one with its namespace and number, or on all of its topic."""

Triple = tuple[float, float, float]
Colour = tuple[float, float, float, float]


def marker(
    wall_ns: int,
    frame_id: str,
    namespace: str,
    number: int,
    kind: int,
    pose: tuple[float, float, float, float],
    size: Triple,
    colour: Colour,
    *,
    action: int = ADD,
    points: Sequence[Triple] = (),
    colours: Sequence[Colour] = (),
    text: str = "",
) -> Any:
    """One upright shape. ``pose``: x, y, z in m and yaw in rad; ``size``: m along its own axes.

    ``points``: of a list, or tail and tip of an arrow, m; ``colours``: one per point.
    """
    x, y, z, yaw = pose
    head = header(wall_ns, frame_id)
    image = message_class("sensor_msgs/msg/CompressedImage")
    mesh = message_class("visualization_msgs/msg/MeshFile")
    return MSG.Marker(
        header=head,
        ns=namespace,
        id=number,
        type=kind,
        action=action,
        pose=MSG.Pose(
            MSG.Point(x, y, z), MSG.Quaternion(0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2))
        ),
        scale=MSG.Vector3(*size),
        color=MSG.ColorRGBA(*colour),
        lifetime=message_class("builtin_interfaces/msg/Duration")(0, 0),
        frame_locked=False,
        points=[MSG.Point(*point) for point in points],
        colors=[MSG.ColorRGBA(*each) for each in colours],
        texture_resource="",
        texture=image(head, "", np.zeros(0, np.uint8)),
        uv_coordinates=[],
        text=text,
        mesh_resource="",
        mesh_file=mesh("", np.zeros(0, np.uint8)),
        mesh_use_embedded_materials=False,
    )


def wipe(wall_ns: int, frame_id: str) -> Any:
    """Marker that deletes all earlier ones of its topic; put it first in an array."""
    nothing = (0.0, 0.0, 0.0)
    colour = (0.0, 0.0, 0.0, 0.0)
    pose = (0.0, 0.0, 0.0, 0.0)
    return marker(wall_ns, frame_id, "", 0, CUBE, pose, nothing, colour, action=DELETE_ALL)


def frame_transform(
    wall_ns: int, parent: str, child: str, pose: tuple[float, float, float, float]
) -> Any:
    """``TFMessage`` with the pose of frame ``child`` in ``parent``: x, y, z in m, yaw in rad."""
    x, y, z, yaw = pose
    turn = MSG.Quaternion(0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2))
    place = MSG.Transform(MSG.Vector3(x, y, z), turn)
    return MSG.TFMessage([MSG.TransformStamped(header(wall_ns, parent), child, place)])
