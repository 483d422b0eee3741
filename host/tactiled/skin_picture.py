"""Markers of a skin for a 3D view, at a rate for viewers: taxels, patches and their forces."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactile_core.bus.markers import ARROW, SPHERE, SPHERE_LIST, TEXT, Colour, Triple, marker, wipe
from tactile_core.bus.messages import MSG
from tactile_core.bus.topics import CONTACTS
from tactile_core.geometry import SkinGeometry
from tactile_core.types import NS_PER_S, Instant
from tactiled.blocks import Cycle
from tactiled.publisher import strongest

TAXELS, CONTACT, FORCE, LABEL = "taxels", "contacts", "forces", "labels"
"""Namespaces of the markers; contacts are numbered like their patches."""

FULL_N = 3.0
"""N on a taxel at which its colour is full: a firm press spread over several taxels."""

METRES_PER_N = 0.01
"""Length of an arrow: the paper's threshold of 10 N is as long as the finger's side."""

TAXEL_M, SHAFT_M, LETTERS_M = 0.003, 0.002, 0.01
"""Sizes of a taxel's sphere, an arrow's shaft and letters."""

LIST_MAX = 1024
"""Most taxels in one marker, 40 B each."""

SMALL, FEW = 512, 32
"""Most taxels, and patches (some 1.1 kB each), in a picture of one message; larger pictures take
several."""

MAX_DRAWN = 128
"""Most patches drawn: more cannot be told apart."""

IDLE: Colour = (0.55, 0.58, 0.62, 1.0)
SICK: Colour = (0.85, 0.0, 0.6, 1.0)
PRESSED = np.array([0.90, 0.25, 0.05, 1.0])
AT_ORIGIN = (0.0, 0.0, 0.0, 0.0)


class SkinPicture:
    """Draws one board; `due` says when the next picture is."""

    def __init__(self, geometry: SkinGeometry) -> None:
        self._frame = geometry.frame
        places = np.concatenate([a.position for a in geometry.arrays])
        self._places: list[Triple] = [(x, y, z) for x, y, z in places.tolist()]
        self._due: Instant | None = None

    def due(self, captured: Instant) -> bool:
        """Whether to draw a cycle with this capture time; depends on capture times alone."""
        period = round(NS_PER_S / CONTACTS.rate)
        if self._due is not None and self._due - 2 * period <= captured < self._due:
            return False
        self._due = Instant(captured + period)
        return True

    def draw(self, cycle: Cycle, wall_ns: int) -> list[Any]:
        """``MarkerArray`` of the taxels by their normal force, and of the contact patches.

        One message, or several that make up the picture in order, each within the size limit of a
        message. Of more than `MAX_DRAWN` patches the strongest are drawn.
        """
        size = (TAXEL_M, TAXEL_M, TAXEL_M)
        colours = self._colours(cycle)
        taxels = [
            marker(
                wall_ns, self._frame, TAXELS, number, SPHERE_LIST, AT_ORIGIN, size, IDLE,
                points=self._places[at : at + LIST_MAX], colours=colours[at : at + LIST_MAX],
            )
            for number, at in enumerate(range(0, len(self._places), LIST_MAX))
        ]  # fmt: skip
        felt = [
            (_triple(patch.centroid), _triple(patch.force), patch.normal_force)
            for patch in strongest(cycle.features.patches, MAX_DRAWN)
        ]
        patches = patch_markers(wall_ns, self._frame, felt)
        first = [wipe(wall_ns, self._frame), taxels[0]]
        if len(self._places) <= SMALL and len(felt) <= FEW:
            return [MSG.MarkerArray([*first, *patches])]
        return [
            MSG.MarkerArray(part)
            for part in (
                first,
                *([each] for each in taxels[1:]),
                *(patches[at : at + 3 * FEW] for at in range(0, len(patches), 3 * FEW)),
            )
        ]

    def _colours(self, cycle: Cycle) -> list[Colour]:
        share = np.clip(-np.nan_to_num(cycle.force[:, 2]) / FULL_N, 0.0, 1.0)[:, None]
        colours = ((1.0 - share) * np.array(IDLE) + share * PRESSED).tolist()
        sick = cycle.health != 0
        return [
            SICK if bad else (r, g, b, a) for bad, (r, g, b, a) in zip(sick, colours, strict=True)
        ]


def patch_markers(
    wall_ns: int, frame: str, patches: Iterable[tuple[Triple, Triple, float]]
) -> list[Any]:
    """Markers of contact patches: position (m), force on the skin there (N), normal force (N).

    Vectors in ``frame``. The arrow of a force ends on the skin.
    """
    made = []
    for number, ((x, y, z), force, normal) in enumerate(patches):
        fx, fy, fz = (METRES_PER_N * part for part in force)
        wide = TAXEL_M * (1.0 + 2.0 * min(1.0, normal / 10.0))
        above = (x - 1.2 * fx, y - 1.2 * fy, z - 1.2 * fz + LETTERS_M, 0.0)
        made += [
            marker(
                wall_ns, frame, CONTACT, number, SPHERE, (x, y, z, 0.0), (wide, wide, wide),
                (0.9, 0.6, 0.0, 0.9),
            ),
            marker(
                wall_ns, frame, FORCE, number, ARROW, AT_ORIGIN,
                (SHAFT_M, 2 * SHAFT_M, 3 * SHAFT_M), (0.8, 0.1, 0.1, 1.0),
                points=((x - fx, y - fy, z - fz), (x, y, z)),
            ),
            marker(
                wall_ns, frame, LABEL, number, TEXT, above, (LETTERS_M, LETTERS_M, LETTERS_M),
                (0.1, 0.1, 0.1, 1.0), text=f"{normal:.1f} N",
            ),
        ]  # fmt: skip
    return made


def _triple(vector: NDArray[np.float64]) -> Triple:
    x, y, z = vector.tolist()
    return x, y, z
