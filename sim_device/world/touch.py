"""Turn contacts in the plane into contacts on the skin, which has height."""

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
"""m from the shelf to the lower edge of the finger (authors' simulator: z 1.11, floor at 1.0)."""

LINE_SPACING: Final = 0.016
"""m between the points that represent a line of contact; rows of taxels are as far apart."""


def on_skin(contacts: Sequence[FingerContact], scene: Scene) -> list[Contact]:
    """Point contacts on the skin (positions in m, forces in N, in ``ee``) for planar ``contacts``.

    Objects are upright prisms: each touches along a vertical line from the finger's lower edge to
    its own top, or to the finger's upper edge if that is lower. The force is spread evenly over it.
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
