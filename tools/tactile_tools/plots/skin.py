"""Pictures of a skin: taxel maps of each side, the finger from above, and an overview."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tactile_bus.geometry import FINGER_OUTLINE, Side
from tactile_tools.plots.curves import COLOURS, ambient, contact_forces, latency
from tactile_tools.plots.series import BoardSeries

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SHEAR_ARROW_MM_PER_N = 6.0
CIRCLE_AREA_PER_N = 320.0  # points², so that 1 N is a circle about as wide as the pitch
ABOVE_MM_PER_N, ABOVE_MM = 6.0, 32.0  # of the arrows from above, and how long they may get
SHOWN_FROM_N = 0.1  # noise of a taxel is about 0.03 N
MOMENTS = 3  # of the strongest contacts
APART_S = 0.5  # between two of them: shorter is chatter between two arrays
SIDE_NAMES = {Side.LEFT: "left side", Side.RIGHT: "right side", Side.TIP: "tip", Side.NONE: ""}
ORDER = (Side.RIGHT, Side.TIP, Side.LEFT, Side.NONE)
"""As the skin is wrapped round the finger: its maps then join."""
PRESS, SHEAR = COLOURS[0], COLOURS[1]


def draw(
    board: BoardSeries,
    out: Path,
    *,
    at: float | None = None,
    applied: tuple[Any, Any] | None = None,
) -> None:
    """Write the overview of one board. ``applied``: times (s) and forces (N) known to be true."""
    plt = _pyplot()
    moment = strongest(board, 1)[0] if at is None else nearest(board, at)
    figure = plt.figure(figsize=(13, 11.5), layout="constrained")
    figure.suptitle(_title(board), fontsize=14)
    rows = figure.add_gridspec(4, 1, height_ratios=(1.5, 1, 1, 0.7))
    _row(figure, rows[0], board, moment)
    forces = figure.add_subplot(rows[1])
    contact_forces(forces, board, applied)
    forces.axvline(board.time[moment], color="0.6", lw=0.8, ls=":")
    ambient(figure.add_subplot(rows[2], sharex=forces), board)
    last = figure.add_subplot(rows[3], sharex=forces)
    latency(last, board)
    last.set_xlabel("time since the first cycle, s")
    figure.savefig(out, dpi=110)
    plt.close(figure)


def draw_taxels(board: BoardSeries, out: Path, *, at: Sequence[float] | None = None) -> None:
    """Write taxel maps of some moments: those at ``at``, or the strongest."""
    plt = _pyplot()
    moments = [nearest(board, when) for when in at] if at else strongest(board, MOMENTS)
    figure = plt.figure(figsize=(15, 3.6 * len(moments) + 2.4), layout="constrained")
    figure.suptitle(f"{_title(board)}: normal force and shear on each side", fontsize=14)
    ratios = (*[1.5] * len(moments), 0.8)
    rows = figure.add_gridspec(len(moments) + 1, 1, height_ratios=ratios)
    for row, moment in enumerate(moments):
        _row(figure, rows[row], board, moment, str(row + 1))
    axes = figure.add_subplot(rows[-1])
    contact_forces(axes, board, None)
    top = axes.get_ylim()[1]
    for number, moment in enumerate(moments, start=1):
        when = board.time[moment]
        axes.axvline(when, color="0.5", lw=0.9, ls=":")
        axes.text(
            when, top, str(number), ha="center", va="center", fontsize=9, fontweight="bold",
            bbox={"boxstyle": "circle", "fc": "white", "ec": "0.4"},
        )  # fmt: skip
    axes.set_xlabel("time since the first cycle, s")
    figure.savefig(out, dpi=100)
    plt.close(figure)


def nearest(board: BoardSeries, when: float) -> int:
    """Index of the cycle nearest to ``when``, s."""
    return int(np.abs(np.asarray(board.time) - when).argmin())


def strongest(board: BoardSeries, count: int) -> list[int]:
    """Indices, in time, of the strongest cycle of each of the strongest contacts.

    A contact lasts until nothing is felt, or until another array bears the most.
    """
    if board.features:
        times, forces = np.asarray(board.feature_time), board.contact_force()
    else:
        times = np.asarray(board.time)
        slices = [taxels for _, taxels in board.array_slices()]
        pressed = [np.nan_to_num(-f[:, 2]).clip(0) for f in board.force]
        forces = np.array([[p[taxels].sum() for taxels in slices] for p in pressed])
    total, bearer = forces.sum(axis=1), forces.argmax(axis=1)
    best: dict[int, int] = {}
    contact = 0
    for index in range(len(times)):
        felt = total[index] > SHOWN_FROM_N
        if index and (not felt or bearer[index] != bearer[index - 1]):
            contact += 1
        if felt and (contact not in best or total[index] > total[best[contact]]):
            best[contact] = index
    chosen: list[int] = []
    for index in sorted(best.values(), key=lambda i: -total[i]):
        if all(abs(times[index] - times[other]) > APART_S for other in chosen):
            chosen.append(index)
        if len(chosen) == count:
            break
    return [nearest(board, float(times[i])) for i in sorted(chosen or [len(times) - 1])]


def _pyplot() -> Any:
    import matplotlib as mpl  # 0.3 s: not before a picture is really wanted

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    return plt


def _title(board: BoardSeries) -> str:
    taxels = board.force[0].shape[0]
    return (
        f"{board.name}: {taxels} taxels, {board.cycles} cycles in {board.last - board.first:.1f} s"
    )


def _row(figure: Any, place: Any, board: BoardSeries, moment: int, number: str = "") -> None:
    """One moment: maps of all sides in the order they join, and the finger from above."""
    sides = [Side(int(s)) for s in board.geometry.array_side]
    slices = board.array_slices()
    order = sorted(range(len(slices)), key=lambda i: ORDER.index(sides[i]))
    widths = []
    for index in order:
        surface = _surface(board, slices[index][1])
        widths.append(float(np.ptp(surface[:, 0])) + 20.0)
    is_finger = str(board.geometry.model) == "finger"
    grid = place.subgridspec(
        1, len(order) + is_finger, width_ratios=[*widths, 75] if is_finger else widths
    )
    for column, index in enumerate(order):
        axes = figure.add_subplot(grid[column])
        label = SIDE_NAMES.get(sides[index], "") or slices[index][0]
        taxel_map(axes, board, moment, label, slices[index][1])
        if column == 0:
            when = f"{board.time[moment]:.2f} s"
            axes.text(
                -0.12, 1.1, f"{number}  at {when}" if number else f"at {when}", fontsize=11,
                fontweight="bold", transform=axes.transAxes,
            )  # fmt: skip
    if is_finger:
        _from_above(figure.add_subplot(grid[len(order)]), board, moment)


def _surface(board: BoardSeries, taxels: slice) -> Any:
    """Places on the unrolled skin, (n, 2) mm."""
    surface = np.asarray(board.geometry.surface)
    if surface.size:
        return surface.reshape(-1, 2)[taxels] * 1e3
    # The largest boards leave it out of their geometry: the array as it lies, seen from above.
    places = np.asarray(board.geometry.position).reshape(-1, 3)[taxels]
    centred = places - places.mean(axis=0)
    return centred @ np.linalg.svd(centred)[2][:2].T * 1e3


def taxel_map(axes: Axes, board: BoardSeries, moment: int, label: str, taxels: slice) -> None:
    """One array, seen from outside: circles for normal force, arrows for what shears the skin."""
    surface = _surface(board, taxels)
    x, y = surface.T
    force = board.force[moment][taxels]
    healthy = np.isfinite(force).all(axis=1)
    normal = np.where(-force[:, 2] > SHOWN_FROM_N, -force[:, 2], 0.0)
    axes.scatter(x[healthy], y[healthy], s=6, color="0.75", zorder=1)
    axes.scatter(x[~healthy], y[~healthy], s=40, color="crimson", marker="x")
    axes.scatter(
        x[healthy],
        y[healthy],
        s=CIRCLE_AREA_PER_N * normal[healthy],
        color=PRESS,
        alpha=0.45,
        zorder=2,
    )
    strong = healthy & (np.linalg.norm(np.nan_to_num(force[:, :2]), axis=1) > SHOWN_FROM_N)
    _arrows(axes, surface[strong], force[strong, :2])
    pad = 10.0
    low, high = surface.min(axis=0) - pad, surface.max(axis=0) + pad
    below = low[1] - 14.0
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(below, high[1])
    axes.axhline(low[1], color="0.85", lw=0.8)
    _key(axes, (low[0], below + 7.0), high[0] - low[0], bool((~healthy).any()))
    axes.set_aspect("equal")
    total = float(normal[healthy].sum())
    axes.set_title(f"{label}: {total:.1f} N", fontsize=10)
    axes.set_xlabel(_direction(board, taxels), fontsize=9)
    axes.set_ylabel("up, mm", fontsize=9)
    axes.tick_params(labelsize=8)


def _arrows(axes: Axes, places: Any, shear: Any) -> None:
    if len(places):
        axes.quiver(
            *places.T, *(shear * SHEAR_ARROW_MM_PER_N).T, angles="xy", scale_units="xy", scale=1,
            width=0.009, color=SHEAR, zorder=3,
        )  # fmt: skip


def _key(axes: Axes, corner: tuple[float, float], width: float, sick: bool) -> None:
    """What a circle and an arrow stand for."""
    x, y = corner[0] + 9.0, corner[1]
    axes.scatter([x], [y], s=CIRCLE_AREA_PER_N, facecolors="none", edgecolors=PRESS)
    axes.text(x + 8, y, "1 N", va="center", fontsize=8, color="0.25")
    if width > 60:
        _arrows(axes, np.array([[x + 26.0, y]]), np.array([[2.0, 0.0]]))
        axes.text(x + 41, y, "2 N shear", va="center", fontsize=8, color="0.25")
    if sick:
        axes.text(
            corner[0] + width - 2,
            y,
            "✕ masked",
            va="center",
            ha="right",
            fontsize=8,
            color="crimson",
        )


def _direction(board: BoardSeries, taxels: slice) -> str:
    """Which way the tip is on a map."""
    surface = _surface(board, taxels)
    ahead = np.asarray(board.geometry.position).reshape(-1, 3)[taxels, 0]
    slope = float(np.dot(surface[:, 0] - surface[:, 0].mean(), ahead - ahead.mean()))
    scale = float(np.ptp(surface[:, 0]) * np.ptp(ahead)) or 1.0
    if abs(slope) / scale < 0.5:
        return "round the tip, mm" if np.ptp(surface[:, 0]) > 0 else "mm"
    return "along the finger, mm   (tip →)" if slope > 0 else "along the finger, mm   (← tip)"


def _from_above(axes: Axes, board: BoardSeries, moment: int) -> None:
    """The finger from above with its contact patches: where it is touched, what pushes on it."""
    outline = np.array([*FINGER_OUTLINE, FINGER_OUTLINE[0]]) * 1e3
    axes.plot(-outline[:, 1], outline[:, 0], color="0.3", lw=1.4)
    position = np.asarray(board.geometry.position).reshape(-1, 3) * 1e3
    axes.scatter(-position[:, 1], position[:, 0], s=4, color="0.75")
    when = board.time[moment]
    if board.features:
        index = int(np.abs(np.asarray(board.feature_time) - when).argmin())
        patches = board.features[index].patches
        greatest = max((np.hypot(p.force.x, p.force.y) for p in patches), default=0.0)
        scale = min(ABOVE_MM_PER_N, ABOVE_MM / max(greatest, 1e-6))
        for patch in patches:
            x, y = -patch.centroid.y * 1e3, patch.centroid.x * 1e3
            fx, fy = -patch.force.y * scale, patch.force.x * scale
            axes.scatter([x], [y], s=60 * patch.normal_force, color=PRESS, alpha=0.45)
            axes.annotate(
                "", (x, y), (x - fx, y - fy),
                arrowprops={"arrowstyle": "-|>", "color": SHEAR, "lw": 1.6},
            )  # fmt: skip
            axes.text(
                x - 1.1 * fx, y - 1.1 * fy, f"{patch.normal_force:.1f} N", fontsize=8,
                ha="right" if fx > 0 else "left", va="top" if fy > 0 else "bottom",
            )  # fmt: skip
    axes.text(0, 40, "left   right", ha="center", fontsize=8, color="0.4")
    axes.set_aspect("equal")
    axes.set_xlim(-75, 75)
    axes.set_ylim(-15, 205)
    axes.set_title("from above", fontsize=10)
    axes.set_xticks([])
    axes.set_yticks([0, 50, 100, 150])
    axes.tick_params(labelsize=8)
