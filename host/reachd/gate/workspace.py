"""Convex regions of the cupboard plane in which a point of the arm must stay."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from tactile_core.config import ConfigError

MAX_CORNERS = 16
"""Most corners of a region: each is two constraints per control cycle, and no shelf needs more."""


@dataclass(frozen=True, slots=True)
class Border:
    """An edge: a point is inside where ``nx·x + ny·y ≤ offset``; (nx, ny) points outward."""

    nx: float
    ny: float
    offset: float


@dataclass(frozen=True, slots=True)
class Region:
    """Convex polygon; corners counter-clockwise, m in ``cupboard``."""

    corners: tuple[tuple[float, float], ...]
    borders: tuple[Border, ...] = field(init=False, compare=False)

    def __post_init__(self) -> None:
        """Compute the borders; ConfigError unless this is a counter-clockwise convex polygon."""
        corners = self.corners
        if not 3 <= len(corners) <= MAX_CORNERS:
            raise ConfigError(f"a region has 3 to {MAX_CORNERS} corners, not {len(corners)}")
        if any(len(c) != 2 or not all(math.isfinite(v) for v in c) for c in corners):
            raise ConfigError(f"corners of a region are pairs of finite numbers in m: {corners}")
        borders = []
        for (ax, ay), (bx, by) in zip(corners, corners[1:] + corners[:1], strict=True):
            length = math.hypot(bx - ax, by - ay)
            if length == 0.0:
                raise ConfigError(f"a region has the corner ({ax:g}, {ay:g}) twice in a row")
            nx, ny = (by - ay) / length, (ax - bx) / length
            borders.append(Border(nx, ny, nx * ax + ny * ay))
        if any(b.nx * x + b.ny * y > b.offset + 1e-9 for b in borders for x, y in corners):
            raise ConfigError(f"a region must be convex, corners counter-clockwise: {corners}")
        object.__setattr__(self, "borders", tuple(borders))

    def depth(self, x: float, y: float) -> float:
        """Distance (m) of a point from the nearest border; negative outside."""
        return min(b.offset - b.nx * x - b.ny * y for b in self.borders)


def box(x_min: float, x_max: float, y_min: float, y_max: float) -> Region:
    """Rectangle along the axes, m in ``cupboard``."""
    return Region(((x_min, y_min), (x_max, y_min), (x_max, y_max), (x_min, y_max)))
