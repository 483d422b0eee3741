"""From contacts in the plane to contacts on the skin, which has height."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np

from sim_device.skin.elastomer import Contact
from sim_device.world.base import WALL, FingerContact
from sim_device.world.scenes import Scene
from tactile_core.geometry import FINGER_HEIGHT

SHELF_CLEARANCE: Final = 0.011
"""m from the shelf to the lower edge of the finger (simulator: z 1.11 over a floor at 1.0)."""

LINE_SPACING: Final = 0.016
"""m between the points that stand for a line of contact: that of the rows of taxels."""


def on_skin(contacts: Sequence[FingerContact], scene: Scene) -> list[Contact]:
    """What the skin feels of ``contacts``.

    Objects are upright prisms, so each touches along a vertical line from the finger's lower edge
    to the object's top, or the finger's upper edge; its force is spread evenly over that line.
    """
    felt = []
    for contact in contacts:
        height = math.inf if contact.body == WALL else scene.objects[contact.body].height
        length = min(height - SHELF_CLEARANCE, FINGER_HEIGHT)
        if length <= 0:
            continue
        points = max(1, round(length / LINE_SPACING))
        force = np.array([contact.force_x, contact.force_y, 0.0]) / points
        for index in range(points):
            z = (index + 0.5) * length / points - FINGER_HEIGHT / 2
            felt.append(Contact(np.array([contact.x, contact.y, z]), force))
    return felt
