"""Report of a parameter sweep: tables and figures."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean
from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter

from tactile_core.arrays import FloatArray
from tactile_tools.experiments.document import Picture, Section, TableData, slug, whole
from tactile_tools.experiments.plots import Surface, contours
from tactile_tools.experiments.reference import PAPER_SWEEP
from tactile_tools.experiments.rows import Row
from tactile_tools.experiments.spec import canonical
from tactile_tools.experiments.studies import (
    SWEEP_AMPLITUDES,
    SWEEP_FREQUENCIES,
    SWEEP_TIMES,
    Cell,
    sweep_cells,
)
from tactile_tools.experiments.tables import Run, title_of

SIGMA = 1.0
"""Width of the Gaussian with which the paper smooths, in cells."""

METRICS = {"distance": "normalized_distance", "time": "normalized_time"}
NAMES = {
    ("burrow", "rad"): "burrow, f in rad/s",
    ("burrow", "hz"): "burrow, f in Hz",
    ("excavate", ""): "excavate",
}
NOMINAL = {"burrow": (1.0, 0.83), "excavate": (5.0, 5.0)}
"""The paper's own setting: f_bur and A_bur; t_trig and t_excv."""


@dataclass(frozen=True, slots=True)
class Grid:
    """10 × 10 grid: ratios to straight by metric, unsmoothed, and success; NaN: no trials."""

    key: tuple[str, str]
    cells: Sequence[Cell]
    ratio: Mapping[str, FloatArray]
    success: FloatArray

    def smooth(self, metric: str) -> FloatArray:
        """The ratio as the paper draws it, smoothed; cells without trials are left out."""
        return smoothed(self.ratio[metric])


def smoothed(values: FloatArray) -> FloatArray:
    """Gaussian filter with σ = 1 cell, edges continued; NaN stays NaN and does not spread."""
    there = np.isfinite(values)
    total = gaussian_filter(np.where(there, values, 0.0), SIGMA, mode="nearest")
    weight = gaussian_filter(there.astype(np.float64), SIGMA, mode="nearest")
    return np.where(there, total / np.where(there, weight, 1.0), np.nan)


def sweep_sections(run: Run) -> list[Section]:
    """One section for each parameter set, engine and depth."""
    several = len(run.groups()) > 1
    sections = []
    for group, rows in run.groups().items():
        name = title_of(group)
        good = [row for row in rows if row["error"] is None]
        if section := _section(run, name, good, slug(" ".join(group)) + "-" if several else ""):
            sections.append(section)
    return sections


def _section(run: Run, name: str, rows: Sequence[Row], prefix: str) -> Section | None:
    base: dict[str, Any] = dict(run.options.parameters)
    straight = [
        r for r in rows if r["strategy"] == "straight" and r["parameters"] == canonical(base)
    ]
    if not straight:
        return None
    grids = grids_of(run, rows, straight)
    means = {metric: fmean(r[column] for r in straight) for metric, column in METRICS.items()}
    success = fmean(r["success"] for r in straight)
    return Section(
        title=name,
        findings=[_finding(grid) for grid in grids if np.isfinite(grid.success).any()],
        text=[
            f"Straight on the same {len(straight)} scenes: mean normalised distance "
            f"{means['distance']:.3f} (paper {PAPER_SWEEP.straight_distance}), time "
            f"{means['time']:.3f} (paper {PAPER_SWEEP.straight_time}), success {whole(success)} % "
            f"(paper {whole(PAPER_SWEEP.straight_success)} %). Each cell is the mean over "
            "the scenes as a ratio to that of straight; below 1 the primitive is better. The plots "
            "show it smoothed by a Gaussian of one cell, as the paper does; the tables say both.",
            "The paper gives f_bur in Hz and writes sin(f t); its authors' simulator puts the "
            "sweep's numbers into the sine as they are, so that they are rad/s. The reading makes "
            "a factor of 2π.",
        ],
        tables=[
            _worst_table(grids, prefix),
            *(table for grid in grids for table in _grid_tables(grid, prefix)),
        ],
        pictures=_pictures(grids, prefix),
    )


def grids_of(run: Run, rows: Sequence[Row], straight: Sequence[Row]) -> list[Grid]:
    """Grids that the run sweeps, each compared with straight in the same scenes."""
    definition = run.study.definition
    cells = sweep_cells(definition["primitives"], definition["readings"])
    base = dict(run.options.parameters)
    by: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        by.setdefault((row["strategy"], row["parameters"]), []).append(row)
    beside = {r["scene_seed"]: r for r in straight}
    grids = []
    for key in dict.fromkeys((c.primitive, c.reading) for c in cells):
        own = [c for c in cells if (c.primitive, c.reading) == key]
        ratio = {metric: np.full((10, 10), np.nan) for metric in METRICS}
        success = np.full((10, 10), np.nan)
        for cell in own:
            of = [r for r in by.get((cell.primitive, cell.of(base)), ())
                  if r["scene_seed"] in beside]  # fmt: skip
            if not of:
                continue
            success[cell.row, cell.column] = fmean(r["success"] for r in of)
            for metric, column in METRICS.items():
                theirs = fmean(beside[r["scene_seed"]][column] for r in of)
                if theirs > 0:
                    ratio[metric][cell.row, cell.column] = fmean(r[column] for r in of) / theirs
        grids.append(Grid(key, own, ratio, success))
    return grids


def _finding(grid: Grid) -> str:
    """Say how bad the worst cell is, and whether the paper's claim holds."""
    distance, time = (float(np.nanmax(grid.smooth(metric))) for metric in METRICS)
    claim_d = distance <= PAPER_SWEEP.worst_distance_ratio * 1.1
    claim_t = time <= PAPER_SWEEP.worst_time_ratio * 1.05
    worst = float(np.nanmin(grid.success))
    name = NAMES[grid.key]
    text = (
        f"{name[0].upper()}{name[1:]}: at the worst setting the distance left is {distance:.2f} "
        f"times and the time {time:.2f} times that of straight (the paper: about 0.33 and 0.8); "
    )
    held = [w for w, ok in (("distance", claim_d), ("time", claim_t)) if ok]
    if len(held) == 2:
        verdict = "both claims hold here"
    elif held:
        verdict = f"the claim about {held[0]} holds here, the other does not"
    else:
        verdict = "neither claim holds here"
    paper = PAPER_SWEEP.worst_success[grid.key[0]]
    least = f"The least success of a setting is {whole(worst)} % (paper {whole(paper)} %)."
    better = [int((grid.ratio[metric] < 1).sum()) for metric in METRICS]
    count = (
        f"Of {int(np.isfinite(grid.success).sum())} settings {better[0]} leave less distance than "
        f"straight and {better[1]} take less time."
    )
    return f"{text}{verdict}. {count} {least} {_where(grid)}"


def _where(grid: Grid) -> str:
    """Say which quarter of the grid is worst, and which the paper says to avoid."""
    rows, columns = ("A_bur", "f_bur") if grid.key[0] == "burrow" else ("t_excv", "t_trig")
    sentences = []
    for metric in METRICS:
        smooth = grid.smooth(metric)
        if not np.isfinite(smooth).all():
            continue
        quarters = {
            (down, across): float(smooth[i : i + 5, j : j + 5].mean())
            for i, down in ((0, "low"), (5, "high"))
            for j, across in ((0, "low"), (5, "high"))
        }
        down, across = max(quarters, key=lambda q: quarters[q])
        paper = PAPER_SWEEP.avoid[grid.key[0], metric]
        sentences.append(
            f"{metric} is worst where {rows} is {down} and {columns} {across} (paper: {paper})"
        )
    return f"By quarters of the grid, {'; '.join(sentences)}." if sentences else ""


def _worst_table(grids: Sequence[Grid], prefix: str) -> TableData:
    body = []
    for grid in grids:
        for metric in METRICS:
            smooth, raw = grid.smooth(metric), grid.ratio[metric]
            if not np.isfinite(raw).any():
                continue
            worst, best = (divmod(int(pick(smooth)), 10) for pick in (np.nanargmax, np.nanargmin))
            body.append(
                [
                    f"{NAMES[grid.key]}: {metric}",
                    f"{smooth[worst]:.2f} at {_setting(grid, *worst)}",
                    f"{float(np.nanmax(raw)):.2f}",
                    f"{smooth[best]:.2f} at {_setting(grid, *best)}",
                    f"{float(np.nanmean(raw)):.2f}",
                    f"{whole(float(np.nanmin(grid.success)))} to "
                    f"{whole(float(np.nanmax(grid.success)))} %",
                ]
            )
    return TableData(
        "Worst and best settings, as ratios to straight",
        ["", "worst, smoothed", "worst cell", "best, smoothed", "mean of all", "success"],
        body,
        name=prefix + "worst",
    )


def _setting(grid: Grid, row: int, column: int) -> str:
    if grid.key[0] == "burrow":
        return f"A {SWEEP_AMPLITUDES[row]:g}, f {SWEEP_FREQUENCIES[column]:g}"
    return f"t_excv {SWEEP_TIMES[row]:g} s, t_trig {SWEEP_TIMES[column]:g} s"


def _grid_tables(grid: Grid, prefix: str) -> list[TableData]:
    """Success, and the ratios of each cell, unsmoothed."""
    burrow = grid.key[0] == "burrow"
    across = SWEEP_FREQUENCIES if burrow else SWEEP_TIMES
    down = SWEEP_AMPLITUDES if burrow else SWEEP_TIMES
    corner = "A_bur \\ f_bur" if burrow else "t_excv \\ t_trig, s"
    shown: list[tuple[str, str, FloatArray, Callable[[float], str]]] = [
        ("success", "Success in %", grid.success, whole),
        *(
            (metric, f"Mean {metric} over that of straight", grid.ratio[metric], _two_places)
            for metric in METRICS
        ),
    ]
    return [
        TableData(
            f"{caption}: {NAMES[grid.key]}",
            [corner, *(f"{value:g}" for value in across)],
            [
                [f"{value:g}", *(text(float(v)) for v in row)]
                for value, row in zip(down, values, strict=True)
            ],
            name=f"{prefix}{what}-{slug(NAMES[grid.key])}",
        )
        for what, caption, values, text in shown
    ]


def _two_places(value: float) -> str:
    return "–" if np.isnan(value) else f"{value:.2f}"


def _pictures(grids: Sequence[Grid], prefix: str) -> list[Picture]:
    surfaces = []
    for grid in grids:
        burrow = grid.key[0] == "burrow"
        unit = {"rad": "rad/s", "hz": "Hz", "": ""}[grid.key[1]]
        for metric in METRICS:
            surfaces.append(
                Surface(
                    title=f"{NAMES[grid.key]}: {metric}",
                    values=grid.smooth(metric),
                    x=SWEEP_FREQUENCIES if burrow else SWEEP_TIMES,
                    y=SWEEP_AMPLITUDES if burrow else SWEEP_TIMES,
                    x_label=f"f_bur, {unit}" if burrow else "t_trig, s",
                    y_label="A_bur" if burrow else "t_excv, s",
                    nominal=NOMINAL[grid.key[0]],
                )
            )
    return [
        Picture(
            prefix + "contours",
            contours(surfaces, "ratio to straight"),
            "Mean normalised distance and time of each setting as ratios to straight on the same "
            "scenes, smoothed by a Gaussian of one cell; less is better. The cross is the paper's "
            "own setting. Every plot has its own scale.",
        )
    ]
