"""Figures of the studies as PNG: boxes, rates, contours, heat maps; readable in print."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import BoundaryNorm
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from tactile_core.arrays import FloatArray
from tactile_tools.experiments.document import in_words, whole
from tactile_tools.experiments.statistics import Rate

DPI = 130
COLOURS = {
    # Okabe and Ito's, which colour-blind readers can distinguish.
    "straight": "#999999",
    "burrow": "#E69F00",
    "excavate": "#56B4E9",
    "hybrid_clock": "#009E73",
    "hybrid_event": "#0072B2",
}
OTHER_COLOUR = "#CC79A7"
MARKS = ("D", "s", "^")


@dataclass(frozen=True, slots=True)
class Bracket:
    """Bar over two boxes, numbered from 0, with its text."""

    left: int
    right: int
    text: str


def colour_of(strategy: str) -> str:
    """Colour of a strategy in every figure."""
    return COLOURS.get(strategy, OTHER_COLOUR)


def boxes(
    values: Mapping[str, Sequence[float]],
    brackets: Sequence[Bracket],
    label: str,
    title: str,
) -> bytes:
    """Box plot of each strategy's values with their points, means, and significance brackets."""
    figure, axes = _figure(6.6, 4.4)
    names = list(values)
    rng = np.random.default_rng(0)
    drawn = axes.boxplot(
        [list(values[n]) for n in names],
        positions=range(len(names)),
        widths=0.55,
        showfliers=False,
        patch_artist=True,
        medianprops={"color": "black", "linewidth": 1.6},
    )
    for patch, name in zip(drawn["boxes"], names, strict=True):
        patch.set(facecolor=colour_of(name), alpha=0.45, edgecolor="black")
    for index, name in enumerate(names):
        y = np.asarray(values[name], dtype=np.float64)
        x = index + rng.uniform(-0.2, 0.2, y.size)
        axes.plot(x, y, ".", color=colour_of(name), markersize=3.5, alpha=0.7, zorder=3)
        if y.size:
            axes.plot(
                index, y.mean(), "D", color="white", markeredgecolor="black", markersize=6, zorder=4
            )
    _brackets(axes, values, brackets)
    axes.set_xticks(range(len(names)), [in_words(n).replace(" ", "\n") for n in names])
    axes.set_ylabel(label)
    axes.set_title(title, loc="left", fontsize=10.5)
    return _png(figure)


def _brackets(
    axes: Axes, values: Mapping[str, Sequence[float]], brackets: Sequence[Bracket]
) -> None:
    top = max((max(v, default=0.0) for v in values.values()), default=1.0) or 1.0
    step = 0.085 * top
    taken: list[tuple[int, int, int]] = []
    highest = 0
    for bracket in sorted(brackets, key=lambda b: (b.right - b.left, b.left)):
        level = 0
        while any(
            level == other and bracket.left < right and left < bracket.right
            for left, right, other in taken
        ):
            level += 1
        taken.append((bracket.left, bracket.right, level))
        highest = max(highest, level)
        y = 1.05 * top + level * step
        left, right = bracket.left + 0.06, bracket.right - 0.06
        axes.plot(
            [left, left, right, right],
            [y - 0.2 * step, y, y, y - 0.2 * step],
            color="black",
            linewidth=0.9,
        )
        axes.text((left + right) / 2, y, bracket.text, ha="center", va="bottom", fontsize=8)
    ticks = [tick for tick in axes.get_yticks() if -1e-9 <= tick <= top + 1e-9]
    axes.set_ylim(-0.03 * top, 1.05 * top + (highest + 1.2) * step if brackets else 1.06 * top)
    axes.set_yticks(ticks)  # none above the values, where the brackets are


def rates(
    ours: Mapping[str, Rate], others: Sequence[tuple[str, Mapping[str, Rate]]], title: str
) -> bytes:
    """Success of each strategy with its interval, and marks for those it is compared with."""
    figure, axes = _figure(6.6, 3.9)
    names = list(ours)
    for index, name in enumerate(names):
        rate = ours[name]
        low, high = rate.interval
        axes.bar(index, 100 * rate.value, 0.5, color=colour_of(name), alpha=0.6, edgecolor="black")
        _bar(axes, index, rate.value, low, high)
        axes.text(index - 0.24, 100 * rate.value + 1.5, whole(rate.value), ha="left", fontsize=9)
    width = 0.16
    for k, (label, theirs) in enumerate(others):
        at = [(i + 0.36 + k * width, theirs[n]) for i, n in enumerate(names) if n in theirs]
        for x, rate in at:
            _bar(axes, x, rate.value, *rate.interval)
        axes.plot(
            [x for x, _ in at],
            [100 * rate.value for _, rate in at],
            MARKS[k % len(MARKS)],
            color="white",
            markeredgecolor="black",
            markersize=6.5,
            linestyle="none",
            label=label,
            zorder=4,
        )
    axes.set_xticks(range(len(names)), [in_words(n).replace(" ", "\n") for n in names])
    axes.set_ylabel("success, % (95 % intervals)")
    axes.set_ylim(0, 100)
    if others:
        axes.legend(loc="upper left", frameon=False, fontsize=8.5)
    axes.set_title(title, loc="left", fontsize=10.5)
    return _png(figure)


def _bar(axes: Axes, x: float, value: float, low: float, high: float) -> None:
    axes.errorbar(
        [x],
        [100 * value],
        yerr=[[100 * (value - low)], [100 * (high - value)]],
        color="black",
        capsize=3,
        linewidth=1,
        zorder=3,
    )


@dataclass(frozen=True, slots=True)
class Surface:
    """Contour plot: values by row (y) and column (x). ``nominal``: x, y of the paper's setting."""

    title: str
    values: FloatArray
    x: Sequence[float]
    y: Sequence[float]
    x_label: str
    y_label: str
    nominal: tuple[float, float] | None


def contours(surfaces: Sequence[Surface], bar_label: str) -> bytes:
    """Contour plots of ratios, two per row; darker is worse."""
    rows = (len(surfaces) + 1) // 2
    figure = Figure(figsize=(8.6, 3.55 * rows), layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.subplots(rows, 2, squeeze=False).ravel()
    for axes in grid[len(surfaces) :]:
        axes.set_visible(False)
    for axes, surface in zip(grid, surfaces, strict=False):
        _contour(figure, axes, surface, bar_label)
    return _png(figure)


def _contour(figure: Figure, axes: Axes, surface: Surface, bar_label: str) -> None:
    values = np.ma.masked_invalid(surface.values)
    axes.set_title(surface.title, loc="left", fontsize=10)
    axes.set_xlabel(surface.x_label)
    axes.set_ylabel(surface.y_label)
    if values.count() < 4:
        axes.text(0.5, 0.5, "too few cells are finished", ha="center", transform=axes.transAxes)
        return
    low, high = max(float(values.min()), 1e-3), float(values.max())
    if high - low < 1e-9:
        low, high = low / 1.01, low * 1.01
    # Each plot has its own scale, so that its shape shows, even in the ratio: otherwise a few cells
    # that are many times worse would leave all others in one colour.
    levels = np.geomspace(low, high, 11)
    filled = axes.contourf(
        surface.x,
        surface.y,
        values.clip(low, high),
        levels=levels,
        cmap="viridis_r",
        norm=BoundaryNorm(levels, 256),
    )
    lines = axes.contour(
        surface.x, surface.y, values, levels=levels[1:-1:2], colors="black", linewidths=0.7
    )
    axes.clabel(lines, fmt="%.2f", fontsize=8)
    figure.colorbar(filled, ax=axes, label=bar_label, format="%.2f")
    if surface.nominal is not None:
        axes.plot(
            *surface.nominal,
            "X",
            color="white",
            markeredgecolor="black",
            markersize=9,
            clip_on=False,
        )


def heat_map(
    title: str,
    rows: Sequence[str],
    columns: Sequence[str],
    values: FloatArray,
    nominal: int | None,
    x_label: str,
) -> bytes:
    """Success in % by strategy and level; ``nominal``: the column of the set's own value."""
    figure, axes = _figure(1.9 + 0.85 * len(columns), 1.35 + 0.36 * len(rows))
    shown = np.ma.masked_invalid(100 * values)
    axes.imshow(shown, cmap="cividis", vmin=0, vmax=100, aspect="auto")
    for i in range(len(rows)):
        for j in range(len(columns)):
            value = values[i, j]
            text = whole(float(value))
            light = not np.isnan(value) and value < 0.55
            axes.text(j, i, text, ha="center", va="center", color="white" if light else "black")
    axes.set_xticks(range(len(columns)), columns)
    axes.set_yticks(range(len(rows)), [in_words(r) for r in rows])
    axes.tick_params(length=0)
    axes.set_xlabel(x_label)
    axes.set_title(title, loc="left", fontsize=10.5)
    for side in ("left", "bottom"):
        axes.spines[side].set_visible(False)
    if nominal is not None:
        axes.add_patch(
            Rectangle(
                (nominal - 0.5, -0.5),
                1,
                len(rows),
                fill=False,
                edgecolor="#D55E00",
                linewidth=2.2,
                clip_on=False,
            )
        )
    return _png(figure)


def _figure(width: float, height: float) -> tuple[Figure, Axes]:
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    axes.spines[["top", "right"]].set_visible(False)
    return figure, axes


def _png(figure: Figure) -> bytes:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=DPI, metadata={"Software": None})
    return buffer.getvalue()
