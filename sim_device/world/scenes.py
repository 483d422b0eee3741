"""Scenes: the objects in the cupboard, where the finger starts and where it is to go.

Frame ``cupboard``: origin at the middle of the front edge, x into the cupboard, y left, angles
counter-clockwise from x; SI at true scale.
"""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass
from enum import StrEnum
from typing import Any

from sim_device.world.parameters import world_parameters

SCENE_FORMAT = 1
"""Version of the JSON form; a reader refuses any other."""

MAX_OBJECTS = 200
"""Most objects; a cupboard of this size holds about 100 of the smallest. More means a damaged
file."""


class Shape(StrEnum):
    """Footprint of an object."""

    DISC = "disc"
    BOX = "box"


class SceneError(ValueError):
    """Invalid scene; the message gives the figure, its value and what is allowed."""


def _finite(label: str, *values: float) -> None:
    """Check that all are finite; SceneError."""
    for value in values:
        if not math.isfinite(value):
            raise SceneError(f"{label} is {value}, not a finite number")


def _positive(label: str, *values: float) -> None:
    """Check that all are finite and above 0; SceneError."""
    _finite(label, *values)
    for value in values:
        if value <= 0:
            raise SceneError(f"{label} is {value}, not above 0")


@dataclass(frozen=True, slots=True)
class SceneObject:
    """Rigid object on the shelf.

    ``size_x``, ``size_y``: m, full sides of a box along its own axes; for a disc, both are its
    diameter. ``height`` m, ``mass`` kg; ``x``, ``y`` m and ``yaw`` rad of its centre in
    ``cupboard``.
    """

    shape: Shape
    size_x: float
    size_y: float
    height: float
    mass: float
    x: float
    y: float
    yaw: float

    def __post_init__(self) -> None:
        """Check sizes, mass and pose; SceneError."""
        _positive("size of an object", self.size_x, self.size_y, self.height)
        _positive("mass of an object", self.mass)
        _finite("pose of an object", self.x, self.y, self.yaw)
        if self.shape is Shape.DISC and self.size_x != self.size_y:
            raise SceneError(f"a disc has one diameter, not {self.size_x} and {self.size_y}")

    @property
    def radius(self) -> float:
        """Half of ``size_x``, m: the radius of a disc."""
        return self.size_x / 2

    @property
    def area(self) -> float:
        """Area of the footprint, m²."""
        if self.shape is Shape.DISC:
            return math.pi * self.radius**2
        return self.size_x * self.size_y

    @property
    def half_extent(self) -> tuple[float, float]:
        """Half of the bounding box along the axes of ``cupboard``, m."""
        if self.shape is Shape.DISC:
            return self.radius, self.radius
        c, s = abs(math.cos(self.yaw)), abs(math.sin(self.yaw))
        return (
            (c * self.size_x + s * self.size_y) / 2,
            (s * self.size_x + c * self.size_y) / 2,
        )


@dataclass(frozen=True, slots=True)
class Pose:
    """Position x, y, m, and heading, rad, in ``cupboard``."""

    x: float
    y: float
    heading: float


@dataclass(frozen=True, slots=True)
class Scene:
    """One task. ``source``: generator it came from; ``parameters``: named set of physical figures.

    ``depth`` and ``width`` of the cupboard in m. ``start``: the pivot's pose. ``goal``: m.
    """

    source: str
    parameters: str
    seed: int
    depth: float
    width: float
    start: Pose
    goal: tuple[float, float]
    objects: tuple[SceneObject, ...]

    def __post_init__(self) -> None:
        """Check that a world can be built from it; SceneError."""
        world_parameters(self.parameters)
        _positive("depth of the cupboard", self.depth)
        _positive("width of the cupboard", self.width)
        _finite("start", self.start.x, self.start.y, self.start.heading)
        _finite("goal", *self.goal)
        if len(self.objects) > MAX_OBJECTS:
            raise SceneError(f"{len(self.objects)} objects; at most {MAX_OBJECTS}")

    @property
    def fill(self) -> float:
        """Area of all footprints over the area of the cupboard."""
        return sum(o.area for o in self.objects) / (self.depth * self.width)

    def to_json(self) -> str:
        """Text from which `from_json` makes an equal scene, bit for bit."""
        return json.dumps({"format": SCENE_FORMAT, **asdict(self)}, allow_nan=False)

    @classmethod
    def from_json(cls, text: str) -> Scene:
        """Scene from `to_json`'s text; SceneError says what is wrong."""
        try:
            raw = json.loads(text)
        except json.JSONDecodeError as error:
            raise SceneError(f"no JSON: {error}") from None
        return _scene(raw)


def _scene(raw: Any) -> Scene:
    """Scene from decoded JSON."""
    if not isinstance(raw, dict) or raw.get("format") != SCENE_FORMAT:
        found = raw.get("format") if isinstance(raw, dict) else type(raw).__name__
        raise SceneError(f"scene format is {found!r}; this version reads {SCENE_FORMAT}")
    try:
        goal_x, goal_y = raw["goal"]
        return Scene(
            source=str(raw["source"]),
            parameters=str(raw["parameters"]),
            seed=int(raw["seed"]),
            depth=float(raw["depth"]),
            width=float(raw["width"]),
            start=Pose(**{k: float(raw["start"][k]) for k in ("x", "y", "heading")}),
            goal=(float(goal_x), float(goal_y)),
            objects=tuple(
                SceneObject(
                    shape=Shape(o["shape"]),
                    **{k: float(o[k]) for k in SceneObject.__slots__ if k != "shape"},
                )
                for o in raw["objects"]
            ),
        )
    except KeyError as error:
        raise SceneError(f"scene lacks {error}") from None
    except SceneError:
        raise
    except (TypeError, ValueError) as error:
        raise SceneError(f"scene is damaged: {error}") from None
