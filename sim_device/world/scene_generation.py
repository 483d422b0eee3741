"""Seeded scene generators: the same seed gives the same scene, bit for bit."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import Final, Protocol

import numpy as np

from sim_device.world.parameters import WORLD_PARAMETERS
from sim_device.world.scene_squeeze import Plate, push
from sim_device.world.scenes import Pose, Scene, SceneObject, Shape

PIVOT_X = -0.2
"""x of the pivot at the start, m: the tip is 42 mm in front of the cupboard (simulator)."""

LATERAL = 0.15
"""Start and goal are uniform within ± this, m (simulator; the paper only says random)."""

BACK_CLEARANCE = 0.017
"""Distance from goal to back wall, m: less than any object, so one at the goal must be moved."""

MAX_DRAWS = 10_000
"""Draws of a place after which a scene is given up; the fullest need about 400."""

_SCATTER_X: Final = (-0.2625, 0.6375)
_SCATTER_Y: Final = 0.45
"""Area where centres are scattered, m (simulator)."""

_DISC_SHARE = 0.43
"""Share of cylinders drawn. They are refused a place more often than boxes, so that 41 % are left,
as in the recorded scenes; an even draw leaves 48 % and fills 0.41 of the area, not 0.37."""

_SHORT = 0.0003
"""Distance that plates stop short of the cupboard's bounds, m, as in the recorded scenes."""

_GIVE = 0.0099
"""Distance by which the plates of the first stage give way during the second, m: in the recorded
scenes objects lie in heaps at the cupboard's depth and 9.6 mm beyond it."""

_CLEARANCE = 1e-3
"""Distance between objects of a grid scene, m, as left when placed by hand."""


Range = tuple[int, int]
"""Least and greatest number of objects."""


def authors_sim(seed: int, objects: Range = (20, 30)) -> Scene:
    """Scatter and squeeze objects as the authors' simulator does, then put them on the shelf there.

    The 20 to 30 objects, scattered over 0.9 × 0.9 m, are pushed together by plates, first in x to
    1 cm beyond the cupboard's depth at either end, then in y to its width, in the simulator's scale
    (see `push`). Heights and masses are drawn afterwards, as in that simulator.
    """
    parameters = WORLD_PARAMETERS["authors_sim"]
    rng = np.random.default_rng(np.random.SeedSequence([seed, _STREAM["authors_sim"]]))
    placed: list[SceneObject] = []
    count = int(rng.integers(objects[0], objects[1] + 1))
    for _ in range(MAX_DRAWS):
        item = _scattered_object(rng)
        if all(gap(item, other) > 0 for other in placed):
            placed.append(item)
            if len(placed) == count:
                break
    else:
        raise RuntimeError(f"seed {seed}: no room in {MAX_DRAWS} draws")
    front, back, side = _SHORT, parameters.depth - _SHORT, parameters.width / 2 - _SHORT
    reach = 0.05
    squeezed = push(
        placed,
        (
            (
                Plate(0.0, _SCATTER_X[0] - reach, front, front - _GIVE),
                Plate(math.pi, _SCATTER_X[1] + reach, back, back + _GIVE),
            ),
            (
                Plate(-math.pi / 2, _SCATTER_Y + reach, side),
                Plate(math.pi / 2, -_SCATTER_Y - reach, -side),
            ),
        ),
        parameters,
        speed=0.1,
        gravity=40.0,
    )
    shelved = tuple(
        replace(o, height=float(rng.uniform(0.06, 0.08)), mass=float(rng.uniform(0.25, 0.75)))
        for o in squeezed
    )
    return _scene("authors_sim", seed, rng, shelved)


def _scattered_object(rng: np.random.Generator) -> SceneObject:
    """Cylinder or box anywhere on the scattering area, not turned."""
    if rng.random() < _DISC_SHARE:
        shape, (size_x, size_y) = Shape.DISC, [2 * rng.uniform(0.03, 0.05)] * 2
    else:
        shape, (size_x, size_y) = Shape.BOX, rng.uniform(0.03, 0.05, 2)
    return SceneObject(
        shape=shape,
        size_x=float(size_x),
        size_y=float(size_y),
        height=1.0,  # heights and masses come after the squeeze; until then a mean mass
        mass=0.5,
        x=float(rng.uniform(*_SCATTER_X)),
        y=float(rng.uniform(-_SCATTER_Y, _SCATTER_Y)),
        yaw=0.0,
    )


def hardware(seed: int, objects: Range = (15, 22)) -> Scene:
    """Objects on a grid of 5 × 7 cells over 38 × 53 cm, as on the paper's bench.

    From the paper: footprints 4.3 to 8.8 cm square, 143 to 570 g, number and cells pseudo-random.
    Ours, where it is silent: 15 to 22 objects (with these the prototype's rates came close to the
    paper's), half of them discs, sizes and masses uniform, aligned with the shelf, moved slightly
    within their cells. A cell is 7.6 cm, so neighbours of the largest do not fit and are redrawn.
    """
    parameters = WORLD_PARAMETERS["hardware"]
    rng = np.random.default_rng(np.random.SeedSequence([seed, _STREAM["hardware"]]))
    rows, columns = 5, 7
    cell_x, cell_y = parameters.depth / rows, parameters.width / columns
    count = int(rng.integers(objects[0], objects[1] + 1))
    if count > rows * columns:
        raise RuntimeError(f"seed {seed}: {count} objects on {rows * columns} cells")
    free = [(row, column) for row in range(rows) for column in range(columns)]
    placed: list[SceneObject] = []
    for _ in range(MAX_DRAWS):
        if len(placed) == count:
            break
        pick = int(rng.integers(len(free)))
        item = _grid_object(rng, free[pick], cell_x, cell_y, parameters.depth, parameters.width)
        if all(gap(item, other) > _CLEARANCE for other in placed):
            placed.append(item)
            del free[pick]
    else:
        raise RuntimeError(f"seed {seed}: no room in {MAX_DRAWS} draws")
    return _scene("hardware", seed, rng, tuple(placed))


def _grid_object(
    rng: np.random.Generator,
    cell: tuple[int, int],
    cell_x: float,
    cell_y: float,
    depth: float,
    width: float,
) -> SceneObject:
    """Object for one cell: centred to within 5 mm, as placed by hand, and kept off the walls."""
    disc = rng.random() < 0.5
    size_x, size_y = rng.uniform(0.043, 0.088, 2)
    if disc:
        size_y = size_x
    x, y = np.array([(cell[0] + 0.5) * cell_x, (cell[1] + 0.5) * cell_y - width / 2]) + (
        rng.uniform(-0.005, 0.005, 2)
    )
    room_x, room_y = size_x / 2 + _CLEARANCE, size_y / 2 + _CLEARANCE
    return SceneObject(
        shape=Shape.DISC if disc else Shape.BOX,
        size_x=float(size_x),
        size_y=float(size_y),
        height=float(rng.uniform(0.06, 0.08)),
        mass=float(rng.uniform(0.143, 0.570)),
        x=float(np.clip(x, room_x, depth - room_x)),
        y=float(np.clip(y, room_y - width / 2, width / 2 - room_y)),
        yaw=0.0,
    )


def gap(a: SceneObject, b: SceneObject) -> float:
    """Distance in m between two objects of yaw 0; 0 or negative if they overlap."""
    dx, dy = abs(a.x - b.x), abs(a.y - b.y)
    discs = sum(o.radius for o in (a, b) if o.shape is Shape.DISC)
    for item in (a, b):
        if item.shape is Shape.BOX:
            dx, dy = dx - item.size_x / 2, dy - item.size_y / 2
    if dx < 0 and dy < 0:
        return max(dx, dy) - discs
    return math.hypot(max(dx, 0.0), max(dy, 0.0)) - discs


def _scene(
    name: str, seed: int, rng: np.random.Generator, objects: tuple[SceneObject, ...]
) -> Scene:
    """Scene of ``objects`` with a random start and goal."""
    parameters = WORLD_PARAMETERS[name]
    return Scene(
        source=name,
        parameters=name,
        seed=seed,
        depth=parameters.depth,
        width=parameters.width,
        start=Pose(PIVOT_X, float(rng.uniform(-LATERAL, LATERAL)), 0.0),
        goal=(parameters.depth - BACK_CLEARANCE, float(rng.uniform(-LATERAL, LATERAL))),
        objects=objects,
    )


_STREAM: Final = {"authors_sim": 1, "hardware": 2}
"""Keeps the generators' random streams apart for equal seeds."""


class Generator(Protocol):
    """Makes the scene of a seed."""

    def __call__(self, seed: int, objects: Range = ...) -> Scene:
        """Scene of ``seed``; ``objects``: least and greatest number of them."""
        ...


GENERATORS: Final[Mapping[str, Generator]] = MappingProxyType(
    {"authors_sim": authors_sim, "hardware": hardware}
)
"""Generators by the name a user gives."""


def generate(name: str, seed: int, objects: Range | None = None) -> Scene:
    """Scene ``seed`` of the generator ``name``; ValueError lists the names.

    ``objects``: range of their number, None for the generator's own. RuntimeError if they do not
    fit.
    """
    if seed < 0:
        raise ValueError(f"seed is {seed}; seeds are 0 or above")
    try:
        generator = GENERATORS[name]
    except KeyError:
        known = ", ".join(sorted(GENERATORS))
        raise ValueError(f"no scene generator {name!r}; there are {known}") from None
    return generator(seed) if objects is None else generator(seed, objects)
