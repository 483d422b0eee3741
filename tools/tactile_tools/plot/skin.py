"""Pictures of a skin: taxel maps of each side, the finger from above, and an overview."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tactile_core.geometry import FINGER_OUTLINE, Side
from tactile_tools.plot.curves import ambient, contact_forces, latency, presses, shade
from tactile_tools.plot.look import COLOURS, SCREEN, Look, Sheet, named, styled
from tactile_tools.plot.series import BoardSeries

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SHEAR_PITCHES = 0.75
"""Length of the arrow in the key of a map, as a multiple of the distance of two taxels."""
ROUND = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)
"""Forces, N, that a circle and an arrow of the key may stand for."""
LARGEST = 8.0
"""Greatest force of a picture as a multiple of the key's: its circle is then three times as
wide."""
ABOVE_MM = 24.0
"""Length of the longest arrow on the finger from above, mm."""
SHOWN_FROM_N = 0.1  # a taxel's noise is about 0.03 N
MOMENTS = 3  # number of strongest presses
MAPS = 12
"""Arrays drawn for one moment, those with the greatest load; a board may have 128."""
ACROSS = 4
"""Maps side by side; half as many in a narrow picture."""
SIDE_NAMES = {Side.LEFT: "left side", Side.RIGHT: "right side", Side.TIP: "tip", Side.NONE: ""}
ORDER = (Side.RIGHT, Side.TIP, Side.LEFT, Side.NONE)
"""Order in which the skin wraps around the finger, so that neighbouring maps join."""
PRESS, SHEAR, MASKED = COLOURS[0], COLOURS[1], "crimson"


def draw(
    board: BoardSeries,
    out: Path,
    *,
    at: float | None = None,
    applied: tuple[Any, Any] | None = None,
    look: Look = SCREEN,
    dpi: int | None = None,
    title: str = "",
) -> None:
    """Write the overview of one board. ``applied``: times (s) and true forces (N), if known."""
    with styled(look):
        overview_sheet(board, at, applied, look, title).save(out, dpi)


def overview_sheet(
    board: BoardSeries,
    at: float | None = None,
    applied: tuple[Any, Any] | None = None,
    look: Look = SCREEN,
    title: str = "",
) -> Sheet:
    """Make the sheet that `draw` writes."""
    moment = strongest(board, 1)[0] if at is None else nearest(board, at)
    maps = _Maps(board, [moment], look)
    heights = [maps.height_in, *(ratio * look.row_in for ratio in (1.1, 1.1, 0.8))]
    sheet = Sheet(look, sum(heights) + 0.8 * look.row_in, _title(board, title))
    grid = sheet.figure.add_gridspec(4, 1, height_ratios=heights)
    maps.draw(sheet, grid[0], moment, f"at {board.time[moment]:.2f} s")
    forces = sheet.figure.add_subplot(grid[1])
    rows = [forces, *(sheet.figure.add_subplot(grid[i], sharex=forces) for i in (2, 3))]
    contact_forces(forces, board, applied, look)
    forces.axvline(board.time[moment], color="0.6", lw=0.8 * look.thin, ls=":")
    ambient(rows[1], board, look)
    latency(rows[2], board, look)
    for axes in rows:
        sheet.legend(axes)
    _finish(sheet, rows, board)
    maps.explain(sheet)
    return sheet


def draw_taxels(
    board: BoardSeries,
    out: Path,
    *,
    at: Sequence[float] | None = None,
    look: Look = SCREEN,
    dpi: int | None = None,
    title: str = "",
) -> None:
    """Write taxel maps of the moments ``at`` (s), or of the strongest ones."""
    with styled(look):
        taxels_sheet(board, at, look, title).save(out, dpi)


def taxels_sheet(
    board: BoardSeries, at: Sequence[float] | None = None, look: Look = SCREEN, title: str = ""
) -> Sheet:
    """Make the sheet that `draw_taxels` writes."""
    moments = [nearest(board, when) for when in at] if at else strongest(board, MOMENTS)
    maps = _Maps(board, moments, look)
    heights = [*(maps.height_in for _ in moments), look.row_in]
    sheet = Sheet(
        look, sum(heights) + 0.5 * look.row_in,
        f"{_title(board, title)}: normal force and shear on each side",
    )  # fmt: skip
    grid = sheet.figure.add_gridspec(len(heights), 1, height_ratios=heights)
    for row, moment in enumerate(moments):
        maps.draw(sheet, grid[row], moment, f"{row + 1}  at {board.time[moment]:.2f} s")
    axes = sheet.figure.add_subplot(grid[len(moments)])
    contact_forces(axes, board, None, look)
    sheet.legend(axes)
    _finish(sheet, [axes], board)
    low, top = axes.get_ylim()
    # Room above the curves for the numbers.
    axes.set_ylim(low, top + 0.25 * (top - low))
    for number, moment in enumerate(moments, start=1):
        when = board.time[moment]
        axes.axvline(when, color="0.5", lw=0.9 * look.thin, ls=":")
        axes.text(
            when, top + 0.13 * (top - low), str(number), ha="center", va="center",
            fontsize=0.85 * look.font_pt, fontweight="bold", clip_on=True,
            bbox={"boxstyle": "circle,pad=0.15", "fc": "white", "ec": "0.4"},
        )  # fmt: skip
    maps.explain(sheet)
    return sheet


def nearest(board: BoardSeries, when: float) -> int:
    """Index of the cycle nearest to ``when``, s."""
    return int(np.abs(np.asarray(board.time) - when).argmin())


def strongest(board: BoardSeries, count: int) -> list[int]:
    """Indices, in order of time, of the strongest cycle of each of the strongest presses.

    The last cycle if nothing was pressed.
    """
    if board.features:
        times, forces = np.asarray(board.feature_time), board.contact_force()
    else:
        times = np.asarray(board.time)
        slices = [taxels for _, taxels in board.array_slices()]
        pressed = [np.nan_to_num(-f[:, 2]).clip(0) for f in board.force]
        forces = np.array([[p[taxels].sum() for taxels in slices] for p in pressed])
    chosen = presses(times, forces, SHOWN_FROM_N, count)
    return [nearest(board, float(times[i])) for i in chosen or [len(times) - 1]]


def _title(board: BoardSeries, name: str) -> str:
    taxels = board.force[0].shape[0]
    seconds = board.last - board.first
    return f"{name or board.name}: {taxels} taxels, {board.cycles} cycles in {seconds:.1f} s"


def _finish(sheet: Sheet, rows: list[Any], board: BoardSeries) -> None:
    shade(sheet, rows, board, invalid=True)
    margin = max(0.01 * (board.last - board.first), 1e-3)
    rows[0].set_xlim(board.first - margin, board.last + margin)
    for axes in rows[:-1]:
        axes.tick_params(labelbottom=False)
    rows[-1].set_xlabel("time since the first cycle, s")


class _Maps:
    """Maps of moments on one scale: all sides in the order in which they join, and the finger."""

    def __init__(self, board: BoardSeries, moments: Sequence[int], look: Look) -> None:
        self.board, self.look = board, look
        self.sides = [Side(int(s)) for s in board.geometry.array_side]
        self.slices = board.array_slices()
        force = np.stack([np.nan_to_num(board.force[moment]) for moment in moments])
        normal = (-force[..., 2]).clip(0)
        bear = [float(normal[:, taxels].sum(axis=1).max()) for _, taxels in self.slices]
        kept = sorted(range(len(bear)), key=lambda i: -bear[i])[:MAPS]
        self.left_out = len(bear) - len(kept)
        self.order = sorted(kept, key=lambda i: (ORDER.index(self.sides[i]), i))
        self.is_finger = str(board.geometry.model) == "finger"
        shear = np.linalg.norm(force[..., :2], axis=-1)
        largest = float(normal.max(initial=0.0))
        self.newton = _round(largest / LARGEST)
        self.shear_newton = _round(float(shear.max(initial=0.0)) / 3.0)
        self.masked = any(bool((~np.isfinite(board.force[m])).any()) for m in moments)
        self.pitch = min(_pitch(_surface(board, taxels)) for _, taxels in self.slices)
        # No circle is cut off at an edge, or lies on the key.
        self.margin = self.pitch * max(0.7, 0.5 * float(np.sqrt(largest / self.newton)))
        self.across = max(1, min(ACROSS // (1 + look.narrow), len(self.order) + self.is_finger))
        self.down = -(-(len(self.order) + self.is_finger) // self.across)

    @property
    def height_in(self) -> float:
        """Height of the maps of one moment, inches."""
        return self.down * 1.35 * self.look.row_in + 1.5 * self.look.line_in

    def draw(self, sheet: Sheet, place: Any, moment: int, label: str) -> None:
        """Draw one moment, with its label above the first map."""
        boxes = [self._box(self.slices[i][1]) for i in self.order]
        widths = [high[0] - low[0] for low, high in boxes]
        if self.is_finger:
            widths.append(90.0)
        if self.down == 1:
            grid = place.subgridspec(1, self.across, width_ratios=widths)
        else:
            grid = place.subgridspec(self.down, self.across)
        for number, index in enumerate(self.order):
            axes = sheet.figure.add_subplot(grid[divmod(number, self.across)])
            name = SIDE_NAMES.get(self.sides[index], "") or named(self.slices[index][0])
            self._map(axes, moment, name, self.slices[index][1], label if number == 0 else "")
        if self.is_finger:
            axes = sheet.figure.add_subplot(grid[divmod(len(self.order), self.across)])
            _from_above(axes, self.board, moment, self.look)

    def explain(self, sheet: Sheet) -> None:
        """Draw the key to circles, arrows and crosses."""
        from matplotlib.lines import Line2D

        size = 7 * self.look.thin
        sheet.key(
            Line2D([], [], ls="", marker="o", mfc="none", mec=PRESS, ms=size),
            f"normal force of a taxel by area; the circle in a map's corner is {self.newton:g} N",
        )
        sheet.key(
            Line2D([], [], color=SHEAR, marker=">", ms=0.6 * size, markevery=[1]),
            f"what shears the skin; the arrow in a map's corner is {self.shear_newton:g} N",
        )
        if self.masked:
            sheet.key(Line2D([], [], ls="", marker="x", mec=MASKED, ms=size), "masked taxel")
        if self.left_out:
            sheet.key(Line2D([], [], ls=""), f"{self.left_out} arrays that bear less are not drawn")

    def _box(self, taxels: slice) -> tuple[Any, Any]:
        surface = _surface(self.board, taxels)
        return surface.min(axis=0) - self.margin, surface.max(axis=0) + self.margin

    def _map(self, axes: Axes, moment: int, name: str, taxels: slice, label: str) -> None:
        """Draw one array seen from outside: circles for normal force, arrows for shear force."""
        surface = _surface(self.board, taxels)
        force = self.board.force[moment][taxels]
        healthy = np.isfinite(force).all(axis=1)
        normal = np.where(healthy & (-force[:, 2] > SHOWN_FROM_N), -force[:, 2], 0.0)
        thin = self.look.thin
        x, y = surface.T
        axes.scatter(x[healthy], y[healthy], s=6 * thin**2, color="0.75", lw=0, zorder=1)
        axes.scatter(
            x[~healthy], y[~healthy], s=40 * thin**2, color=MASKED, marker="x", lw=thin, zorder=4
        )
        _circles(axes, surface, self.pitch * np.sqrt(np.nan_to_num(normal) / self.newton))
        arrow = SHEAR_PITCHES * self.pitch
        strong = healthy & (np.linalg.norm(np.nan_to_num(force[:, :2]), axis=1) > SHOWN_FROM_N)
        _arrows(axes, surface[strong], force[strong, :2] * arrow / self.shear_newton, thin)
        low, high = self._box(taxels)
        below = low[1] - 1.2 * self.pitch
        axes.set_xlim(low[0], high[0])
        axes.set_ylim(below, high[1])
        axes.axhline(low[1], color="0.85", lw=0.8 * thin)
        corner = np.array([[low[0] + 0.7 * self.pitch, (below + low[1]) / 2]])
        _circles(axes, corner, np.array([self.pitch]), hollow=True, thin=thin)
        if high[0] - low[0] > 2.0 * self.pitch + arrow:
            beside = corner + np.array([1.1 * self.pitch, 0.0])
            _arrows(axes, beside, np.array([[arrow, 0.0]]), thin)
        axes.set_aspect("equal")
        total = float(np.nansum(normal))
        axes.set_title(f"{name}: {total:.1f} N", pad=3 * thin, fontsize=0.9 * self.look.font_pt)
        axes.set_xlabel(_direction(self.board, taxels), fontsize=0.85 * self.look.font_pt)
        axes.set_ylabel("up, mm", fontsize=0.85 * self.look.font_pt)
        axes.tick_params(labelsize=0.8 * self.look.font_pt)
        if label:
            axes.set_title(f"{label}\n ", loc="left", fontweight="bold", pad=3 * thin)


def _round(newton: float) -> float:
    return float(next((n for n in ROUND if n >= newton), ROUND[-1]))


def _surface(board: BoardSeries, taxels: slice) -> Any:
    """Places of the taxels on the unrolled skin, (n, 2) mm."""
    surface = np.asarray(board.geometry.surface)
    if surface.size:
        return surface.reshape(-1, 2)[taxels] * 1e3
    # The geometry of the largest boards lacks the unrolled skin; use the places seen from above.
    places = np.asarray(board.geometry.position).reshape(-1, 3)[taxels]
    centred = places - places.mean(axis=0)
    return centred @ np.linalg.svd(centred)[2][:2].T * 1e3


def _pitch(surface: Any) -> float:
    """Median distance of a taxel to its nearest neighbour, mm; 10 for a single taxel."""
    if len(surface) < 2:
        return 10.0
    away = np.linalg.norm(surface[:, None] - surface[None], axis=-1)
    np.fill_diagonal(away, np.inf)
    return max(float(np.median(away.min(axis=1))), 0.1)


def _circles(
    axes: Axes, places: Any, widths: Any, *, hollow: bool = False, thin: float = 1.0
) -> None:
    """Draw circles of diameter ``widths``, in the units of the axes."""
    from matplotlib.collections import EllipseCollection

    style: dict[str, Any] = (
        {"facecolors": "none", "edgecolors": PRESS, "linewidths": thin}
        if hollow
        else {"facecolors": PRESS, "edgecolors": "none", "alpha": 0.45}
    )
    axes.add_collection(
        EllipseCollection(
            widths, widths, np.zeros(len(widths)), units="xy", offsets=places,
            offset_transform=axes.transData, zorder=2, **style,
        )
    )  # fmt: skip


def _arrows(axes: Axes, places: Any, along: Any, thin: float) -> None:
    if len(places):
        axes.quiver(
            *places.T, *along.T, angles="xy", scale_units="xy", scale=1, units="inches",
            width=0.025 * thin, color=SHEAR, zorder=3,
        )  # fmt: skip


def _direction(board: BoardSeries, taxels: slice) -> str:
    """Say in which direction the tip lies on a map."""
    surface = _surface(board, taxels)
    ahead = np.asarray(board.geometry.position).reshape(-1, 3)[taxels, 0]
    slope = float(np.dot(surface[:, 0] - surface[:, 0].mean(), ahead - ahead.mean()))
    scale = float(np.ptp(surface[:, 0]) * np.ptp(ahead)) or 1.0
    if abs(slope) / scale < 0.5:
        is_finger = str(board.geometry.model) == "finger"
        return "round the tip, mm" if is_finger and np.ptp(surface[:, 0]) > 0 else "mm"
    return "along, mm  (tip →)" if slope > 0 else "along, mm  (← tip)"


def _from_above(axes: Axes, board: BoardSeries, moment: int, look: Look) -> None:
    """Draw the finger from above, with its contact patches and the forces on them."""
    outline = np.array([*FINGER_OUTLINE, FINGER_OUTLINE[0]]) * 1e3
    axes.plot(-outline[:, 1], outline[:, 0], color="0.3", lw=1.3 * look.thin)
    position = np.asarray(board.geometry.position).reshape(-1, 3) * 1e3
    axes.scatter(-position[:, 1], position[:, 0], s=4 * look.thin**2, color="0.75", lw=0)
    when = board.time[moment]
    small = 0.8 * look.font_pt
    if board.features:
        index = int(np.abs(np.asarray(board.feature_time) - when).argmin())
        patches = board.features[index].patches
        greatest = max((np.hypot(p.force.x, p.force.y) for p in patches), default=0.0)
        scale = ABOVE_MM / max(greatest, 1e-6)
        for patch in patches:
            x, y = -patch.centroid.y * 1e3, patch.centroid.x * 1e3
            fx, fy = -patch.force.y * scale, patch.force.x * scale
            axes.annotate(
                "", (x, y), (x - fx, y - fy),
                arrowprops={"arrowstyle": "-|>", "color": SHEAR, "lw": 1.4 * look.thin,
                            "mutation_scale": 10 * look.thin, "shrinkA": 0, "shrinkB": 0},
            )  # fmt: skip
        # Labels stand at the edge on the touched side, one below another, so that they never
        # overlap.
        for side, mine in ((-1, [p for p in patches if p.centroid.y > 0]),
                           (1, [p for p in patches if p.centroid.y <= 0])):  # fmt: skip
            last = np.inf
            for patch in sorted(mine, key=lambda p: -p.centroid.x):
                last = min(patch.centroid.x * 1e3, last - 22.0)
                axes.text(
                    side * 107, last, f"{patch.normal_force:.1f} N", fontsize=small,
                    ha="right" if side > 0 else "left", va="center",
                )  # fmt: skip
    axes.set_xlabel("left      right", fontsize=0.85 * look.font_pt)
    axes.set_aspect("equal")
    axes.set_xlim(-110, 110)
    axes.set_ylim(-15, 205)
    axes.set_title("from above", pad=3 * look.thin, fontsize=0.9 * look.font_pt)
    axes.set_xticks([])
    axes.set_yticks([0, 50, 100, 150])
    axes.tick_params(labelsize=small)
    axes.set_ylabel("mm", fontsize=0.85 * look.font_pt)
