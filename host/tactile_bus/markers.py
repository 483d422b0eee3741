"""Shapes for a 3D view: ``visualization_msgs/Marker``, the many fields nobody sets left empty."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from tactile_bus.messages import MSG, header, message_class

CUBE, CYLINDER, SPHERE = 1, 3, 2
"""Kinds of marker, as ``visualization_msgs/Marker`` numbers them."""


def marker(
    wall_ns: int,
    frame_id: str,
    namespace: str,
    number: int,
    kind: int,
    pose: tuple[float, float, float, float],
    size: tuple[float, float, float],
    colour: tuple[float, float, float, float],
) -> Any:
    """One upright shape. ``pose``: x, y, z in m and yaw in rad; ``size``: m along its own axes."""
    x, y, z, yaw = pose
    head = header(wall_ns, frame_id)
    image = message_class("sensor_msgs/msg/CompressedImage")
    mesh = message_class("visualization_msgs/msg/MeshFile")
    return MSG.Marker(
        header=head,
        ns=namespace,
        id=number,
        type=kind,
        action=0,
        pose=MSG.Pose(
            MSG.Point(x, y, z), MSG.Quaternion(0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2))
        ),
        scale=MSG.Vector3(*size),
        color=MSG.ColorRGBA(*colour),
        lifetime=message_class("builtin_interfaces/msg/Duration")(0, 0),
        frame_locked=False,
        points=[],
        colors=[],
        texture_resource="",
        texture=image(head, "", np.zeros(0, np.uint8)),
        uv_coordinates=[],
        text="",
        mesh_resource="",
        mesh_file=mesh("", np.zeros(0, np.uint8)),
        mesh_use_embedded_materials=False,
    )
