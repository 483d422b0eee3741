"""Curves over time: forces and features, the field removed, clock and latency."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tactile_tools.plots.series import LATENCY_BINS, BoardSeries, Spread

if TYPE_CHECKING:
    from matplotlib.axes import Axes

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
"""Okabe and Ito's palette: told apart in print and by the colour-blind."""

INVALID = "#F4C7C3"
"""Behind stretches in which features were not valid."""

SHOWN_EVENTS = 12
"""Events with their text; the others are lines alone."""

LONGEST_REASON = 46
LONGEST_TEXT = 60

TOGETHER = 0.015
"""Share of a log's length within which events share one text."""


def contact_forces(axes: Axes, board: BoardSeries, applied: tuple[Any, Any] | None) -> None:
    """Normal force of the contact patches of each array."""
    labels = [name for name, _ in board.array_slices()]
    contact = board.contact_force()
    for index, label in enumerate(labels):
        axes.plot(
            board.feature_time, contact[:, index], color=COLOURS[index % 6], lw=1.2, label=label
        )
    if applied is not None:
        axes.plot(*applied, color="black", ls="--", lw=1.0, label="really applied")
    axes.set_ylabel("contact force, N\n(normal, summed)")
    axes.set_ylim(bottom=0, top=max(axes.get_ylim()[1], 0.5))
    axes.legend(loc="upper right", ncols=5, fontsize=8)
    axes.grid(alpha=0.25)


def ambient(axes: Axes, board: BoardSeries) -> None:
    """Field at the centre of each array that compensation took off."""
    labels = [name for name, _ in board.array_slices()]
    axes.set_ylabel("ambient field removed, µT")
    axes.grid(alpha=0.25)
    if not board.ambient:
        _say(axes, "compensation was off")
        return
    plane = np.stack([np.asarray(m.plane, float).reshape(-1, 3, 3) for m in board.ambient])
    valid = np.stack([np.asarray(m.valid, bool) for m in board.ambient])
    for component, name in enumerate("xyz"):
        for index, label in enumerate(labels[: plane.shape[1]]):
            axes.plot(
                board.ambient_time,
                np.where(valid[:, index], plane[:, index, component, 0], np.nan),
                color=COLOURS[component],
                ls=("-", "--", ":")[index % 3],
                lw=1.0,
                label=f"{name} {label}",
            )
    axes.legend(loc="upper right", ncols=3, fontsize=7)


def latency(axes: Axes, board: BoardSeries) -> None:
    """From capture to receipt, and where features were refused."""
    rows = np.asarray(board.delays.items, float).reshape(-1, 3)
    axes.plot(board.delays.time, rows[:, 0] * 1e3, color=COLOURS[0], lw=0.8)
    axes.set_ylabel("captured → received, ms", fontsize=8)
    axes.set_ylim(bottom=0)
    axes.grid(alpha=0.25)
    refused = [t for t, f in zip(board.feature_time, board.features, strict=True) if not f.valid]
    if refused:
        axes.plot(refused, np.zeros(len(refused)), "x", color="crimson", label="features invalid")
        axes.legend(loc="upper right", fontsize=8)


def draw_forces(board: BoardSeries, out: Path) -> None:
    """Write contact forces, peak and tip, net wrench, taxels in contact, and what happened."""
    figure, rows = _sheet(board, "contact forces, features and events", 4, (1.2, 1, 1, 0.6))
    contact_forces(rows[0], board, None)
    time, features = board.feature_time, board.features
    if features:
        _lines(rows[1], time, {
            "peak of one taxel": [f.peak_force for f in features],
            "all of the skin": [f.normal_force for f in features],
            "tip": [f.tip_force for f in features],
        })  # fmt: skip
        _lines(rows[2], time, {
            "forward (x)": [f.wrench.force.x for f in features],
            "to the left (y)": [f.wrench.force.y for f in features],
            "up (z)": [f.wrench.force.z for f in features],
        })  # fmt: skip
        _lines(rows[3], time, {
            "in contact": [f.taxels_in_contact for f in features],
            "masked": [f.taxels_masked for f in features],
        })  # fmt: skip
    rows[1].set_ylabel("normal force, N")
    rows[2].set_ylabel("net force on\nthe skin, N")
    rows[3].set_ylabel("taxels")
    _shade_invalid(rows, board)
    _mark_events(rows[0], board)
    _finish(figure, rows, out)


def draw_field(board: BoardSeries, out: Path) -> None:
    """Write the field removed, how well it was supported, what was left over, temperature."""
    figure, rows = _sheet(board, "ambient field and its removal", 4, (1.4, 0.8, 0.8, 0.6))
    labels = [name for name, _ in board.array_slices()]
    ambient(rows[0], board)
    if board.ambient:
        support = np.stack([np.asarray(m.support, float) for m in board.ambient])
        residual = np.stack([np.asarray(m.residual_ut, float) for m in board.ambient])
        for index, label in enumerate(labels[: support.shape[1]]):
            colour = COLOURS[index % 6]
            rows[1].plot(
                board.ambient_time, support[:, index] * 100, color=colour, lw=0.9, label=label
            )
            rows[2].plot(board.ambient_time, residual[:, index], color=colour, lw=0.9, label=label)
        rows[1].legend(loc="lower right", ncols=3, fontsize=8)
        rows[2].legend(loc="upper right", ncols=3, fontsize=8)
    else:
        _say(rows[1], "compensation was off")
        _say(rows[2], "compensation was off")
    if len(board.warmth):
        warmth = [np.atleast_1d(item) for item in board.warmth.items]
        width = min(len(item) for item in warmth)
        per_taxel = width > len(labels)
        curves = np.stack([item[:width] for item in warmth])
        if per_taxel:
            rows[3].plot(
                board.warmth.time,
                np.nanmean(curves, axis=1),
                color=COLOURS[0],
                lw=0.9,
                label="mean of all taxels",
            )
        else:
            for index in range(width):
                rows[3].plot(
                    board.warmth.time,
                    curves[:, index],
                    color=COLOURS[index % 6],
                    lw=0.9,
                    label=labels[index] if index < len(labels) else str(index),
                )
        rows[3].legend(loc="upper right", ncols=3, fontsize=8)
    else:
        _say(rows[3], "no field is in this log")
    rows[1].set_ylabel("taxels that\nsupport the fit, %")
    rows[1].set_ylim(0, 105)
    rows[2].set_ylabel("left over by\nthe fit, µT rms")
    rows[2].set_ylim(bottom=0)
    rows[3].set_ylabel("chips, °C")
    for axes in rows[1:]:
        axes.grid(alpha=0.25)
    _shade_invalid(rows, board)
    _finish(figure, rows, out)


def draw_timing(board: BoardSeries, out: Path) -> None:
    """Write latency, stamps' uncertainty, clock error and drops, with their distributions."""
    plt = _pyplot()
    figure = plt.figure(figsize=(14, 10), layout="constrained")
    figure.suptitle(f"{board.name}: clock and latency, {_figures(board)}", fontsize=13)
    grid = figure.add_gridspec(3, 2, width_ratios=(1.7, 1))
    rows = [figure.add_subplot(grid[0, 0])]
    rows += [figure.add_subplot(grid[i, 0], sharex=rows[0]) for i in (1, 2)]
    times = board.delays.time
    delays = np.asarray(board.delays.items, float).reshape(-1, 3) * 1e3
    rows[0].plot(times, delays[:, 0], color=COLOURS[0], lw=0.8, label="captured → received")
    rows[0].plot(
        times, delays[:, 2], color=COLOURS[1], lw=0.8, label="received → in the log's queue"
    )
    rows[0].set_ylabel("delay, ms")
    rows[0].set_yscale("log")
    rows[0].legend(loc="upper right", fontsize=8)
    rows[1].plot(times, delays[:, 1], color=COLOURS[2], lw=0.9)
    rows[1].set_ylabel("uncertainty of\nthe capture time, ms")
    rows[1].set_yscale("log")
    errors = [
        (when, float(values["clock_rate_error"]) * 1e6)
        for when, values in zip(board.told.time, board.told.items, strict=True)
        if _is_number(values.get("clock_rate_error", ""))
    ]
    if errors:
        rows[2].plot(*zip(*errors, strict=True), "o-", ms=3, color=COLOURS[3], lw=0.9)
    else:
        _say(rows[2], "this board has no clock of its own")
    rows[2].set_ylabel("board's clock\nruns fast, ppm")
    for axes in rows:
        axes.grid(alpha=0.25)
    for axes in rows[:2]:
        _plain_ticks(axes.yaxis, *axes.get_ylim())
    _finish_axes(rows)
    _histogram(figure.add_subplot(grid[0, 1]), board.latency_spread, "captured → received", 0)
    _histogram(
        figure.add_subplot(grid[1, 1]), board.logging_spread, "received → in the log's queue", 1
    )
    _histogram(figure.add_subplot(grid[2, 1]), board.period_spread, "from cycle to cycle", 2)
    figure.savefig(out, dpi=100)
    plt.close(figure)


def _figures(board: BoardSeries) -> str:
    """Rate, losses and drops in words."""
    spread = board.period_spread
    mean = spread.total / spread.number if spread.number else float("nan")
    rate = f"{1 / mean:.1f} Hz, " if mean > 0 else ""
    drops = ", ".join(f"{reason} {n}" for reason, n in sorted(board.drops.items()) if n)
    return f"{rate}{board.cycles} cycles, {board.lost} lost; drops: {drops or 'none'}"


def _histogram(axes: Axes, spread: Spread, what: str, index: int) -> None:
    axes.set_title(what, fontsize=10)
    axes.set_xlabel("ms")
    axes.set_ylabel("cycles")
    if not spread.number:
        _say(axes, "nothing to count")
        return
    edges = LATENCY_BINS * 1e3
    axes.stairs(spread.counts[1:-1], edges, fill=True, color=COLOURS[index], alpha=0.6)
    axes.set_xscale("log")
    low, high = max(spread.least, LATENCY_BINS[0]) * 1e3, max(spread.greatest, 1e-4) * 1e3
    axes.set_xlim(low / 1.6, high * 1.6)
    _plain_ticks(axes.xaxis, low / 1.6, high * 1.6)
    for share, style in ((0.5, "-"), (0.99, "--")):
        value = spread.percentile(share) * 1e3
        axes.axvline(value, color="0.2", lw=1, ls=style, label=f"p{share * 100:.0f} {value:.3g} ms")
    axes.plot([], [], " ", label=f"greatest {spread.greatest * 1e3:.3g} ms")
    axes.legend(fontsize=8, loc="upper right")
    axes.grid(alpha=0.25)


def _plain_ticks(axis: Any, low: float, high: float) -> None:
    """Label a logarithmic axis with 1, 2, 5, 10 …, thinned where there are many decades."""
    low, high = max(low, 1e-6), max(high, 1e-5)
    decades = range(int(np.floor(np.log10(low))), int(np.ceil(np.log10(high))) + 1)
    steps = (1, 2, 5) if len(decades) <= 4 else (1,)
    ticks = [s * 10.0**d for d in decades for s in steps if low <= s * 10.0**d <= high]
    axis.set_ticks(ticks, [f"{tick:g}" for tick in ticks])
    axis.set_ticks([], minor=True)


def _pyplot() -> Any:
    import matplotlib as mpl  # 0.3 s: not before a picture is really wanted

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    return plt


def _sheet(
    board: BoardSeries, what: str, count: int, ratios: tuple[float, ...]
) -> tuple[Any, list[Any]]:
    plt = _pyplot()
    figure = plt.figure(figsize=(14, 11), layout="constrained")
    seconds = board.last - board.first
    figure.suptitle(f"{board.name}: {what}, {board.cycles} cycles in {seconds:.1f} s", fontsize=14)
    grid = figure.add_gridspec(count, 1, height_ratios=ratios)
    first = figure.add_subplot(grid[0])
    return figure, [first, *(figure.add_subplot(grid[i], sharex=first) for i in range(1, count))]


def _lines(axes: Axes, time: list[float], curves: dict[str, list[Any]]) -> None:
    for index, (label, values) in enumerate(curves.items()):
        style = ("-", "-", "--")[index % 3]  # the last may lie on the one before it
        axes.plot(time, values, color=COLOURS[index], lw=1.0, ls=style, label=label)
    axes.legend(loc="upper right", ncols=3, fontsize=8)
    axes.grid(alpha=0.25)


def _shade_invalid(rows: list[Any], board: BoardSeries) -> None:
    """Grey out where features were not to be acted on, with the commonest reasons."""
    spans: list[tuple[float, float]] = []
    reasons: dict[str, int] = {}
    period = 1.5 * (board.last - board.first) / max(1, len(board.feature_time))
    for when, features in zip(board.feature_time, board.features, strict=True):
        if features.valid:
            continue
        for reason in features.reasons:
            reasons[reason] = reasons.get(reason, 0) + 1
        if spans and when - spans[-1][1] <= 2 * period:
            spans[-1] = (spans[-1][0], when)
        else:
            spans.append((when, when))
    for axes in rows:
        for begin, end in spans:
            axes.axvspan(begin - period / 2, end + period / 2, color=INVALID, lw=0, zorder=0)
    if spans:
        common = sorted(reasons, key=lambda r: -reasons[r])[:3]
        text = "; ".join(reason[:LONGEST_REASON] for reason in common)
        rows[0].text(
            0.005, 0.97, f"red: features not valid ({text})", transform=rows[0].transAxes,
            fontsize=8, va="top", color="#A03028",
        )  # fmt: skip


def _mark_events(axes: Axes, board: BoardSeries) -> None:
    """Lines at what happened, with its text; what happened together is told together."""
    span = max(board.last - board.first, 1e-3)
    groups: list[tuple[float, list[str]]] = []
    for when, text in board.events:
        if groups and when - groups[-1][0] < TOGETHER * span:
            groups[-1][1].append(text)
        else:
            groups.append((when, [text]))
    top = axes.get_ylim()[1]
    for index, (when, texts) in enumerate(groups):
        axes.axvline(when, color="0.45", lw=0.8, ls="--")
        if index < SHOWN_EVENTS:
            said = "; ".join(dict.fromkeys(texts))
            said = said if len(said) <= LONGEST_TEXT else said[: LONGEST_TEXT - 1] + "…"
            late = when > board.first + 0.5 * span
            axes.annotate(
                said, (when, top * 0.86), xytext=(-3 if late else 3, 0), textcoords="offset points",
                rotation=90, va="top", ha="right" if late else "left", fontsize=8, color="0.3",
            )  # fmt: skip


def _say(axes: Axes, text: str) -> None:
    axes.text(0.5, 0.5, text, transform=axes.transAxes, ha="center", color="0.4")


def _is_number(text: str) -> bool:
    try:
        return bool(np.isfinite(float(text)))
    except ValueError:
        return False


def _finish_axes(rows: list[Any]) -> None:
    for axes in rows[:-1]:
        axes.tick_params(labelbottom=False)
    rows[-1].set_xlabel("time since the first cycle, s")


def _finish(figure: Any, rows: list[Any], out: Path) -> None:
    from matplotlib import pyplot as plt

    _finish_axes(rows)
    figure.savefig(out, dpi=100)
    plt.close(figure)
