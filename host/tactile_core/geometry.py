"""Places of the taxels of a skin, in the end-effector's frame.

End-effector frame ``ee``: origin at the wrist pivot, x along the finger towards its tip, y to the
left, z up (ROS REP 103). Taxel frame: z is the outward normal of the skin, x and y lie in it.
Forces are those that the environment exerts on the skin, so a press has a negative z in the taxel
frame and the normal force is ``-z``.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from tactile_core.arrays import FloatArray


class Side(IntEnum):
    """Part of the end-effector that an array covers or a contact is on."""

    NONE = 0
    LEFT = 1
    RIGHT = 2
    TIP = 3


@dataclass(frozen=True, slots=True, eq=False)
class ArrayGeometry:
    """Geometry of one array; taxels are numbered row by row.

    ``position``: (n, 3) m in ``ee``. ``rotation``: (n, 3, 3), taxel axes to ``ee`` axes (columns
    are the taxel's x, y, z in ``ee``). ``surface``: (n, 2) m, coordinates of the taxels on the
    unrolled skin, over which planes are fitted. ``chip_yaw``: (n,) rad, rotation of each chip about
    its z from the taxel's axes: v_taxel = Rz(chip_yaw) v_chip. ``posed``: whether the array's pose
    in ``ee`` is known. If it is not, only the relative places of its taxels are valid: neither
    field directions nor contact places may be compared with other arrays.
    """

    name: str
    side: Side
    rows: int
    columns: int
    position: FloatArray
    rotation: FloatArray
    surface: FloatArray
    chip_yaw: FloatArray
    posed: bool = True

    def __post_init__(self) -> None:
        """Reject inconsistent shapes."""
        n = self.rows * self.columns
        shapes = {
            "position": (self.position, (n, 3)),
            "rotation": (self.rotation, (n, 3, 3)),
            "surface": (self.surface, (n, 2)),
            "chip_yaw": (self.chip_yaw, (n,)),
        }
        for label, (array, shape) in shapes.items():
            if array.shape != shape:
                raise ValueError(f"array {self.name!r}: {label} is {array.shape}, not {shape}")
            if not np.isfinite(array).all():
                raise ValueError(f"array {self.name!r}: {label} is not finite")

    @property
    def taxels(self) -> int:
        """Number of taxels."""
        return self.rows * self.columns


@dataclass(frozen=True, slots=True, eq=False)
class SkinGeometry:
    """All arrays of one board, in the order of their numbers.

    ``frame``: name of the frame ``ee``.
    """

    model: str
    frame: str
    arrays: tuple[ArrayGeometry, ...]

    @property
    def taxels(self) -> int:
        """Number of taxels of the whole board."""
        return sum(a.taxels for a in self.arrays)

    @property
    def slices(self) -> tuple[slice, ...]:
        """Slice of each array within data of all taxels."""
        ends = np.cumsum([0, *(a.taxels for a in self.arrays)]).tolist()
        return tuple(slice(a, b) for a, b in itertools.pairwise(ends))

    @property
    def posed(self) -> bool:
        """Whether the relative poses of the arrays are known; True for a single array."""
        return len(self.arrays) == 1 or all(a.posed for a in self.arrays)


def grid_on_plane(
    name: str,
    side: Side,
    shape: tuple[int, int],
    pitch: tuple[float, float],
    centre: tuple[float, float, float],
    axes: FloatArray,
    chip_yaw: FloatArray | None = None,
) -> ArrayGeometry:
    """Flat grid of taxels: rows along the taxel's y, columns along its x.

    ``shape``: rows, columns. ``pitch``: m along x, along y. ``centre``: m in ``ee``. ``axes``:
    (3, 3), columns are the grid's x, y and outward normal in ``ee``.
    """
    rows, columns = shape
    u = (np.arange(columns) - (columns - 1) / 2) * pitch[0]
    v = (np.arange(rows) - (rows - 1) / 2) * pitch[1]
    surface = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    n = rows * columns
    return ArrayGeometry(
        name=name,
        side=side,
        rows=rows,
        columns=columns,
        position=np.asarray(centre) + surface @ axes[:, :2].T,
        rotation=np.broadcast_to(axes, (n, 3, 3)).copy(),
        surface=surface,
        chip_yaw=np.zeros(n) if chip_yaw is None else chip_yaw,
    )


FINGER_OUTLINE: tuple[tuple[float, float], ...] = (
    (-0.0060, -0.02850),
    (0.10848, -0.02850),
    (0.14034, -0.01998),
    (0.15185, -0.00353),
    (0.15185, 0.00353),
    (0.14034, 0.01998),
    (0.10848, 0.02850),
    (-0.0060, 0.02850),
)
"""Convex outline of the finger seen from above, counter-clockwise from the right rear corner, m in
``ee``; the authors' simulator at true scale (15.8 cm long, 5.7 cm wide)."""

FINGER_HEIGHT = 0.080
"""Height in m, along z (authors' simulator: z 1.11 to 1.91, × 10 cm)."""

TIP_X = 0.158
"""x in m of the point that is steered to the target: pivot + 1.58 × 10 cm along the heading."""


def grid_on_outline(
    name: str,
    side: Side,
    shape: tuple[int, int],
    pitch: tuple[float, float],
    centre: float,
    outline: tuple[tuple[float, float], ...] = FINGER_OUTLINE,
) -> ArrayGeometry:
    """Grid of taxels wrapped around an outline: columns follow it, rows are stacked along z.

    ``pitch``: m along the outline, along z. ``centre``: arc length in m from the outline's first
    point to the middle of the grid. Each taxel's x is the outline's direction of travel, its y is
    up, its z the outward normal.
    """
    rows, columns = shape
    points = np.asarray(outline)
    steps = np.diff(points, axis=0)
    lengths = np.linalg.norm(steps, axis=1)
    starts = np.concatenate([[0.0], np.cumsum(lengths)])
    u = (np.arange(columns) - (columns - 1) / 2) * pitch[0]
    v = (np.arange(rows) - (rows - 1) / 2) * pitch[1]
    arc = centre + u
    if arc[0] < 0 or arc[-1] > starts[-1]:
        raise ValueError(f"array {name!r} does not fit on the outline")
    segment = np.minimum(np.searchsorted(starts, arc, side="right") - 1, len(lengths) - 1)
    tangent = steps[segment] / lengths[segment, None]
    on_line = points[segment] + tangent * (arc - starts[segment])[:, None]
    axes = np.zeros((columns, 3, 3))
    axes[:, :2, 0] = tangent
    axes[:, 2, 1] = 1.0
    axes[:, 0, 2], axes[:, 1, 2] = tangent[:, 1], -tangent[:, 0]
    n = rows * columns
    position = np.empty((rows, columns, 3))
    position[..., :2] = on_line
    position[..., 2] = v[:, None]
    return ArrayGeometry(
        name=name,
        side=side,
        rows=rows,
        columns=columns,
        position=position.reshape(n, 3),
        rotation=np.tile(axes, (rows, 1, 1)),
        surface=np.stack(np.meshgrid(u, v), axis=-1).reshape(n, 2),
        chip_yaw=np.zeros(n),
    )


def finger() -> SkinGeometry:
    """Default end-effector: 4 × 8 taxels on each side, 4 × 4 around the tip of the finger.

    Columns are 16.5 mm apart on the sides and 11.5 mm at the tip, rows 16 mm. The foremost column
    of each side is on the slanted shoulder.
    """
    total = float(np.linalg.norm(np.diff(np.asarray(FINGER_OUTLINE), axis=0), axis=1).sum())
    middle = 0.0755  # arc length of the sides' centre: 17.8 to 133.3 mm from the rear corner
    return SkinGeometry(
        model="finger",
        frame="ee",
        arrays=(
            grid_on_outline("left", Side.LEFT, (4, 8), (0.0165, 0.016), total - middle),
            grid_on_outline("right", Side.RIGHT, (4, 8), (0.0165, 0.016), middle),
            grid_on_outline("tip", Side.TIP, (4, 4), (0.0115, 0.016), total / 2),
        ),
    )


ANYSKIN_CHIPS = 5
"""Magnetometers of one AnySkin board: centre, left, right, up, down."""

ANYSKIN_OFFSET = 0.008
"""Distance in m from the centre to the other four."""

ANYSKIN_YAW_DEG = (-90.0, -90.0, 180.0, 90.0, 0.0)
"""Yaw of each chip in degrees, as mounted."""


def anyskin() -> SkinGeometry:
    """Five-magnetometer AnySkin board: centre, left, right, up, down, 8 mm out from the centre.

    Chips are mounted with their own yaw (−90, −90, 180, 90, 0°). The array is one row of five for
    numbering only; it is mounted flat at the tip until a calibration file says otherwise.
    """
    return SkinGeometry("anyskin", "ee", (anyskin_board("skin", Side.TIP),))


def anyskin_board(name: str, side: Side, sideways: float = 0.0) -> ArrayGeometry:
    """One five-magnetometer board on ``side`` of the finger, ``sideways`` m along its own x."""
    d = ANYSKIN_OFFSET
    surface = np.array([[0, 0], [-d, 0], [d, 0], [0, d], [0, -d]])
    axes, centre = _mount(side)
    return ArrayGeometry(
        name=name,
        side=side,
        rows=1,
        columns=ANYSKIN_CHIPS,
        position=centre + sideways * axes[:, 0] + surface @ axes[:, :2].T,
        rotation=np.broadcast_to(axes, (ANYSKIN_CHIPS, 3, 3)).copy(),
        surface=surface,
        chip_yaw=np.deg2rad(ANYSKIN_YAW_DEG),
    )


def _mount(side: Side) -> tuple[FloatArray, FloatArray]:
    """Axes (3, 3) and centre (3,) m in ``ee`` of a board on a side of the finger; z outwards."""
    up = (0.0, 0.0, 1.0)
    if side is Side.LEFT:
        axes, centre = np.column_stack([(-1.0, 0, 0), up, (0, 1.0, 0)]), (0.080, 0.0285, 0.0)
    elif side is Side.RIGHT:
        axes, centre = np.column_stack([(1.0, 0, 0), up, (0, -1.0, 0)]), (0.080, -0.0285, 0.0)
    else:
        axes, centre = np.column_stack([(0, 1.0, 0), up, (1.0, 0, 0)]), (FINGER_OUTLINE[3][0], 0, 0)
    return axes, np.array(centre)


MOUNTS = (Side.LEFT, Side.RIGHT, Side.TIP, Side.TIP)
"""Sides of the finger for up to four simulated AnySkin boards of a controller."""


def anyskin_jaws(boards: int) -> SkinGeometry:
    """Up to four AnySkin boards of one controller, on different sides of the finger."""
    if not 1 <= boards <= len(MOUNTS):
        raise ValueError(f"{boards} AnySkin boards; allowed: 1 to {len(MOUNTS)}")
    if boards == 1:
        return anyskin()
    arrays = tuple(
        anyskin_board(f"skin{i}", side, 0.03 if i == 3 else 0.0)
        for i, side in enumerate(MOUNTS[:boards])
    )
    return SkinGeometry("anyskin", "ee", arrays)
