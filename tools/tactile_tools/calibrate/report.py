"""Draw what a model does, and write a page with the pictures."""

from __future__ import annotations

import html
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from tactile_core.arrays import FloatArray
from tactile_core.calibration.force_model import TARGET_UNITS
from tactile_tools.calibrate.evaluate import Judged, predict
from tactile_tools.calibrate.fit import Choice, fit
from tactile_tools.calibrate.limits import limits
from tactile_tools.calibrate.recipes import FORCE_RECIPES

MEASURED, PREDICTED, SIMPLE, FIT_SHADE = "#222222", "#c1272d", "#0072b2", "#e8eef4"
BINS = 12


def write_report(folder: Path, split: str, judged: Sequence[Judged]) -> Path:
    """Write one picture per recording and ``index.html`` into ``folder``; OSError on failure."""
    names = []
    for number, each in enumerate(judged):
        name = f"{number + 1}_{each.recording.path.stem}.png"
        draw(each, folder / name)
        names.append(name)
    page = folder / "index.html"
    page.write_text(_page(split, judged, names), encoding="utf-8")
    return page


def draw(judged: Judged, out: Path) -> None:
    """Draw the picture of one recording, 1400 × 1000 px."""
    figure = Figure(figsize=(14, 10), layout="constrained")
    FigureCanvasAgg(figure)
    if judged.recording.forces:
        _draw_force(figure, judged)
    else:
        _draw_place(figure, judged)
    figure.savefig(out, dpi=100)


def _draw_force(figure: Figure, judged: Judged) -> None:
    target = judged.model.targets[0]
    unit = TARGET_UNITS[target]
    grid = figure.add_gridspec(3, 3, height_ratios=(1.3, 0.7, 1.3))
    measured, predicted, time = judged.measured[:, 0], judged.predicted[:, 0], judged.time_s
    tested = judged.tested
    simple = _without_history(judged)[:, 0]

    over_time = figure.add_subplot(grid[0, :])
    over_time.plot(time, measured, color=MEASURED, lw=2.0, label="measured")
    over_time.plot(time, predicted, color=PREDICTED, lw=1.0, label="predicted")
    over_time.set_ylabel(f"{target} force, {unit}")
    over_time.set_title(
        f"{judged.recording.name}: {judged.model.recipe}, "
        f"rmse {judged.rmse[0]:.3f} {unit} over {int(tested.sum())} labels"
    )
    residual = figure.add_subplot(grid[1, :], sharex=over_time)
    residual.plot(time, simple - measured, color=SIMPLE, lw=0.7, alpha=0.7, label="no history")
    residual.plot(time, predicted - measured, color=PREDICTED, lw=0.9, label=judged.model.recipe)
    residual.axhline(0, color=MEASURED, lw=0.6)
    residual.set_ylabel(f"error, {unit}")
    residual.set_xlabel("time, s")
    reach = float(np.percentile(np.abs(np.r_[predicted - measured, simple - measured]), 99.5))
    residual.set_ylim(-1.15 * reach, 1.15 * reach)
    residual.legend(loc="upper left", ncols=2, fontsize="small")
    if not tested.all():
        begin = float(time[tested][0])
        for axes in (over_time, residual):
            axes.axvspan(float(time[0]), begin, color=FIT_SHADE, zorder=0)
        over_time.text(begin, over_time.get_ylim()[1], "  tested →", va="top")
        over_time.text(begin, over_time.get_ylim()[1], "fitted  ", va="top", ha="right")
    over_time.legend(loc="upper left", fontsize="small")

    _draw_error_by_force(figure.add_subplot(grid[2, 0]), judged, simple, unit)
    before = figure.add_subplot(grid[2, 1])
    after = figure.add_subplot(grid[2, 2], sharex=before, sharey=before)
    loop = _one_press(judged)
    for axes, guess, colour, title in (
        (before, simple, SIMPLE, "without history"),
        (after, predicted, PREDICTED, "with history"),
    ):
        _draw_loop(axes, measured[loop], guess[loop], colour, unit)
        axes.set_title(f"press and release: {title}")


def _draw_loop(axes: Any, measured: FloatArray, guess: FloatArray, colour: str, unit: str) -> None:
    """Draw error over force, loading and unloading in different strokes."""
    top = int(measured.argmax())
    error = guess - measured
    axes.plot(measured[: top + 1], error[: top + 1], color=colour, lw=1.6, label="press")
    axes.plot(measured[top:], error[top:], color=colour, lw=1.6, ls=":", label="release")
    axes.axhline(0, color=MEASURED, lw=0.6)
    axes.set_xlabel(f"measured, {unit}")
    axes.set_ylabel(f"predicted - measured, {unit}")
    axes.legend(fontsize="small")


def _draw_error_by_force(axes: Any, judged: Judged, simple: FloatArray, unit: str) -> None:
    measured = judged.measured[judged.tested, 0]
    edges = np.linspace(measured.min(), measured.max(), BINS + 1)
    place = np.clip(np.digitize(measured, edges) - 1, 0, BINS - 1)
    middle = (edges[:-1] + edges[1:]) / 2
    width = 0.4 * (edges[1] - edges[0])
    for guess, colour, label, shift in (
        (simple, SIMPLE, "no history", -0.5),
        (judged.predicted[:, 0], PREDICTED, judged.model.recipe, 0.5),
    ):
        error = guess[judged.tested] - measured
        rms = [
            float(np.sqrt((error[place == b] ** 2).mean())) if (place == b).any() else 0.0
            for b in range(BINS)
        ]
        axes.bar(middle + shift * width, rms, width, color=colour, label=label)
    axes.set_xlabel(f"measured, {unit}")
    axes.set_ylabel(f"rms error, {unit}")
    axes.set_title("error by force")
    axes.legend(fontsize="small")


def _draw_place(figure: Figure, judged: Judged) -> None:
    grid = figure.add_gridspec(2, 2)
    tested = judged.tested
    measured, predicted = judged.measured[tested], judged.predicted[tested]
    distance = np.linalg.norm(predicted - measured, axis=1)
    where = figure.add_subplot(grid[:, 0])
    places = np.unique(measured.round(), axis=0)
    mean = np.array([distance[(measured.round() == place).all(axis=1)].mean() for place in places])
    dots = where.scatter(places[:, 0], places[:, 1], c=mean, s=90, marker="s", cmap="viridis")
    figure.colorbar(dots, ax=where, label="mean distance, mm", location="bottom")
    where.set_aspect("equal")
    where.set_xlabel("x, mm")
    where.set_ylabel("y, mm")
    rms = ", ".join(f"{t} {r:.2f}" for t, r in zip(judged.model.targets, judged.rmse, strict=True))
    where.set_title(f"{judged.recording.name}\nrmse {rms} mm over {len(measured)} touches")
    spread = figure.add_subplot(grid[0, 1])
    spread.hist(distance, bins=40, range=(0, max(3.0, float(np.percentile(distance, 99)))))
    spread.axvline(distance.mean(), color=PREDICTED, label=f"mean {distance.mean():.2f} mm")
    spread.set_xlabel("distance of predicted from true place, mm")
    spread.set_ylabel("touches")
    spread.legend()
    by_size = figure.add_subplot(grid[1, 1])
    size = np.linalg.norm(judged.recording.change_ut(), axis=1)
    size = np.interp(judged.time_s, judged.recording.time_s, size)[tested]
    by_size.scatter(size, distance, s=4, alpha=0.4)
    by_size.set_xscale("log")
    by_size.set_xlabel("change of the field, µT (all channels)")
    by_size.set_ylabel("distance, mm")
    by_size.set_title("touches that move the field little are hard to place")


def _without_history(judged: Judged) -> FloatArray:
    """Predictions of the cubic model, (k, targets), fitted to the same samples."""
    recipe = next(r for r in FORCE_RECIPES if r.name == "cubic")
    choice = Choice(recipe, recipe.penalties[0], judged.choice.delay_s, (), ())
    return predict(fit(judged.fitted_on, choice), judged.recording)


def _one_press(judged: Judged) -> NDArray[np.intp]:
    """Labels of the last press that is tested from beginning to end."""
    size = judged.recording.load()
    busy = size > 0.03 * size.max()
    edges = np.flatnonzero(np.diff(np.r_[0, busy.astype(int), 0]))
    runs = [
        np.arange(a, b)
        for a, b in zip(edges[::2], edges[1::2], strict=True)
        if b - a > 10 and judged.tested[a] and size[a:b].max() > 0.5 * size.max()
    ]
    return runs[-1] if runs else np.flatnonzero(judged.tested)


def _page(split: str, judged: Sequence[Judged], names: Sequence[str]) -> str:
    parts = [
        "<!doctype html><meta charset='utf-8'><title>Calibration</title>",
        "<style>body{font:15px sans-serif;max-width:1400px;margin:2em auto}img{width:100%}"
        "td,th{padding:.2em .8em;text-align:right}td:first-child{text-align:left}</style>",
        f"<h1>Calibration, split {html.escape(split)}</h1>",
    ]
    for each, name in zip(judged, names, strict=True):
        unit = TARGET_UNITS[each.model.targets[0]]
        parts.append(f"<h2>{html.escape(each.recording.name)}</h2><table>")
        for target, value in zip(each.model.targets, each.rmse, strict=True):
            parts.append(f"<tr><td>rmse {target}</td><td>{value:.3f} {unit}</td></tr>")
        for key, value in limits(each).items():
            parts.append(f"<tr><td>{html.escape(key)}</td><td>{value:.4g}</td></tr>")
        parts.append(f"</table><img src='{html.escape(name)}' alt='predicted and measured'>")
    return "\n".join(parts) + "\n"
