"""Curves over time: forces and features, the ambient field removed, clock and latency."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tactile_core.arrays import FloatArray
from tactile_tools.plot.look import (
    COLOURS,
    SCREEN,
    Look,
    Sheet,
    named,
    plain,
    plain_ticks,
    shortened,
    show_text,
    styled,
    width_pt,
)
from tactile_tools.plot.series import LATENCY_BINS, BoardSeries, Spread

# Holes in a curve, and presses in it.


HOLE_PERIODS = 5.0
"""A step longer than this many periods is a hole; delays by the scheduler are shorter."""
NEAR = 31
"""Steps whose median is taken as the local period: the rate may change in the middle of a log."""

CHATTER_S = 0.5
"""Time for which a press may be let go and still count as the same press, s."""
PROMINENCE = 0.4
"""The force must fall between two maxima by this share of the smaller one."""
BIN_S, MOST_BINS = 0.05, 200_000


def holes(time: Sequence[float] | FloatArray) -> list[tuple[float, float]]:
    """Find the stretches in which points are missing: (begin, end), s, in order."""
    from scipy.ndimage import median_filter

    times = np.asarray(time, float)
    if len(times) < 4:
        return []
    steps = np.diff(times)
    usual = np.maximum(median_filter(steps, min(NEAR, len(steps)), mode="nearest"), 1e-6)
    return [
        (float(times[i]), float(times[i + 1]))
        for i in np.flatnonzero(steps > HOLE_PERIODS * usual).tolist()
    ]


def period(time: Sequence[float] | FloatArray) -> float:
    """Median step, s; 0 if there are fewer than two points."""
    return float(np.median(np.diff(time))) if len(time) > 1 else 0.0


def broken(time: Sequence[float] | FloatArray, values: Any) -> tuple[FloatArray, FloatArray]:
    """Put a NaN into each hole of a curve, so that no line is drawn across it."""
    times, points = np.asarray(time, float), np.asarray(values, float)
    after = np.searchsorted(times, [end for _, end in holes(times)])
    middle = [(times[i - 1] + times[i]) / 2 for i in after]
    return np.insert(times, after, middle), np.insert(points, after, np.nan, axis=0)


def presses(time: Sequence[float] | FloatArray, force: Any, least: float, count: int) -> list[int]:
    """Indices, in order of time, of the strongest point of each of the strongest presses.

    ``force``: (points, places) N. A press is a maximum at one place (an array of a skin) that is at
    least ``least`` N and stands out from its surroundings by `PROMINENCE` of its height. What is
    let go for less than `CHATTER_S` counts as the same press, and so do presses within `CHATTER_S`
    at two places.
    """
    from scipy.ndimage import grey_closing
    from scipy.signal import find_peaks

    times, felt = np.asarray(time, float), np.nan_to_num(np.asarray(force, float))
    if not len(times):
        return []
    width = max(BIN_S, 1.5 * period(times), (times[-1] - times[0]) / MOST_BINS)
    bins = ((times - times[0]) / width).astype(int)
    found: list[tuple[float, int]] = []
    for place in range(felt.shape[1]):
        most = np.zeros(bins[-1] + 3)  # an empty bin at each end, for cut-off presses
        np.maximum.at(most, bins + 1, felt[:, place])
        reach = 1 + round(CHATTER_S / width)
        closed = grey_closing(np.pad(most, reach), (reach,))[reach:-reach]
        _, about = find_peaks(closed, height=least, prominence=0.0, plateau_size=1)
        for height, rise, left, right in zip(
            *(about[k] for k in ("peak_heights", "prominences", "left_edges", "right_edges")),
            strict=True,
        ):
            inside = np.flatnonzero((bins + 1 >= left) & (bins + 1 <= right))
            if rise >= PROMINENCE * height and len(inside):
                index = int(inside[felt[inside, place].argmax()])
                found.append((float(felt[index, place]), index))
    chosen: list[int] = []
    for _, index in sorted(found, reverse=True):
        if all(abs(times[index] - times[other]) > CHATTER_S for other in chosen):
            chosen.append(index)
        if len(chosen) == count:
            break
    return sorted(chosen)


if TYPE_CHECKING:
    from matplotlib.axes import Axes

INVALID = "#F4C7C3"
"""Colour behind stretches in which features were not valid."""
MISSING = "0.88"
"""Colour behind stretches that are missing in the log."""

LISTED = 10
"""Groups of events listed with their text; further ones are numbered or only counted."""

TAKEN_UP = 0.6
"""Share of the width that the numbers of events may take before neighbours are grouped."""

REASONS = 3

SETTLED = (0.1, 0.9)
"""Part of a clock's points, from the first to the last, whose errors set the scale."""


def contact_forces(
    axes: Axes, board: BoardSeries, applied: tuple[Any, Any] | None, look: Look = SCREEN
) -> None:
    """Draw the normal force of the contact patches of each array."""
    contact = board.contact_force()
    for index, (label, _) in enumerate(board.array_slices()):
        axes.plot(
            *broken(board.feature_time, contact[:, index]),
            color=COLOURS[index % 6],
            label=named(label),
        )
    if applied is not None:
        axes.plot(*applied, color="black", ls="--", lw=0.9 * look.thin, label="really applied")
    axes.set_ylabel("contact force, N\n(normal, summed)")
    axes.set_ylim(bottom=0, top=max(axes.get_ylim()[1], 0.5))
    axes.grid(visible=True)


def ambient(axes: Axes, board: BoardSeries, look: Look = SCREEN) -> None:
    """Draw the field at the centre of each array that compensation removed."""
    labels = [name for name, _ in board.array_slices()]
    axes.set_ylabel("ambient field\nremoved, µT")
    axes.grid(visible=True)
    if not board.ambient:
        show_text(axes, "compensation was off")
        return
    plane = np.stack([np.asarray(m.plane, float).reshape(-1, 3, 3) for m in board.ambient])
    valid = np.stack([np.asarray(m.valid, bool) for m in board.ambient])
    for component, name in enumerate("xyz"):
        for index, label in enumerate(labels[: plane.shape[1]]):
            values = np.where(valid[:, index], plane[:, index, component, 0], np.nan)
            axes.plot(
                *broken(board.ambient_time, values),
                color=COLOURS[component],
                ls=("-", "--", ":")[index % 3],
                lw=0.9 * look.thin,
                label=f"{name} {plain(label)}",
            )


def latency(axes: Axes, board: BoardSeries, look: Look = SCREEN) -> None:
    """Draw the time from capture to receipt."""
    delays = np.asarray(board.delay_track.items, float).reshape(-1, 3)[:, 0] * 1e3
    axes.plot(*broken(board.delay_track.time, delays), color=COLOURS[0], lw=0.8 * look.thin)
    axes.set_ylabel("captured →\nreceived, ms")
    _logarithmic(axes, delays)
    axes.grid(visible=True)


def draw_forces(
    board: BoardSeries, out: Path, look: Look = SCREEN, dpi: int | None = None, title: str = ""
) -> None:
    """Write contact forces, peak and tip, net wrench, taxels in contact, and events."""
    with styled(look):
        forces_sheet(board, look, title).save(out, dpi)


def forces_sheet(board: BoardSeries, look: Look = SCREEN, title: str = "") -> Sheet:
    """Make the sheet that `draw_forces` writes."""
    groups = _grouped(board, 72.0 * (look.width_in - 0.12 * look.font_pt), look)
    sheet, rows = _sheet(
        board, f"{title or board.name}: contact forces, features and events",
        (1.2, 1.0, 1.0, 0.7), look, groups,
    )  # fmt: skip
    contact_forces(rows[0], board, None, look)
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
    else:
        for axes in rows:
            show_text(axes, "the log holds no features")
    rows[1].set_ylabel("normal force, N")
    rows[2].set_ylabel("net force on\nthe skin, N")
    rows[3].set_ylabel("taxels")
    rows[3].yaxis.get_major_locator().set_params(integer=True)
    for axes in rows[1:]:
        axes.grid(visible=True)
    for axes in rows:
        sheet.legend(axes)
    shade(sheet, rows, board, invalid=True)
    return sheet


def draw_field(
    board: BoardSeries, out: Path, look: Look = SCREEN, dpi: int | None = None, title: str = ""
) -> None:
    """Write the field removed, its support, the residual, and temperature."""
    with styled(look):
        field_sheet(board, look, title).save(out, dpi)


def field_sheet(board: BoardSeries, look: Look = SCREEN, title: str = "") -> Sheet:
    """Make the sheet that `draw_field` writes."""
    sheet, rows = _sheet(
        board, f"{title or board.name}: ambient field and its removal",
        (1.4, 0.9, 0.9, 0.7), look,
    )  # fmt: skip
    labels = [name for name, _ in board.array_slices()]
    ambient(rows[0], board, look)
    if board.ambient:
        support = np.stack([np.asarray(m.support, float) for m in board.ambient])
        residual = np.stack([np.asarray(m.residual_ut, float) for m in board.ambient])
        for index, label in enumerate(labels[: support.shape[1]]):
            for axes, values in ((rows[1], support * 100), (rows[2], residual)):
                axes.plot(
                    *broken(board.ambient_time, values[:, index]),
                    color=COLOURS[index % 6],
                    lw=0.8 * look.thin,
                    label=named(label),
                )
    else:
        show_text(rows[1], "compensation was off")
        show_text(rows[2], "compensation was off")
    _warmth(rows[3], board, labels, look)
    rows[1].set_ylabel("taxels that\nsupport the fit, %")
    rows[1].set_ylim(0, 105)
    rows[2].set_ylabel("left over by\nthe fit, µT rms")
    rows[2].set_ylim(bottom=0)
    rows[3].set_ylabel("chips, °C")
    for axes in rows[1:]:
        axes.grid(visible=True)
    for axes in (rows[0], rows[1], rows[3]):  # the third row has the curves of the second
        sheet.legend(axes)
    shade(sheet, rows, board, invalid=True)
    return sheet


def _warmth(axes: Axes, board: BoardSeries, labels: list[str], look: Look) -> None:
    if not len(board.temperature_track):
        show_text(axes, "no field is in this log")
        return
    warmth = [np.atleast_1d(item) for item in board.temperature_track.items]
    width = min(len(item) for item in warmth)
    curves = np.stack([item[:width] for item in warmth]).astype(float)
    if width > len(labels):
        known = np.isfinite(curves).any(axis=1)
        mean = np.full(len(curves), np.nan)
        mean[known] = np.nanmean(curves[known], axis=1)
        curves, labels = mean[:, None], ["mean of all taxels"]
    for index, curve in enumerate(curves.T):
        axes.plot(
            *broken(board.temperature_track.time, curve),
            color=COLOURS[index % 6],
            lw=0.8 * look.thin,
            label=named(labels[index] if index < len(labels) else str(index)),
        )


def draw_timing(
    board: BoardSeries, out: Path, look: Look = SCREEN, dpi: int | None = None, title: str = ""
) -> None:
    """Write latency, uncertainty of stamps, clock error and drops, with their distributions."""
    with styled(look):
        timing_sheet(board, look, title).save(out, dpi)


def timing_sheet(board: BoardSeries, look: Look = SCREEN, title: str = "") -> Sheet:
    """Make the sheet that `draw_timing` writes."""
    row_in = 1.35 * look.row_in
    sheet = Sheet(
        look, row_in * (6 if look.narrow else 3),
        f"{title or board.name}: clock and latency, {_figures(board)}",
    )  # fmt: skip
    if look.narrow:
        grid = sheet.figure.add_gridspec(6, 1)
        places = [grid[i, 0] for i in range(6)]
    else:
        grid = sheet.figure.add_gridspec(3, 2, width_ratios=(1.7, 1))
        places = [grid[i, j] for j in (0, 1) for i in range(3)]
    rows = [sheet.figure.add_subplot(places[0])]
    rows += [sheet.figure.add_subplot(place, sharex=rows[0]) for place in places[1:3]]
    times = board.delay_track.time
    delays = np.asarray(board.delay_track.items, float).reshape(-1, 3) * 1e3
    thin = 0.8 * look.thin
    for column, index, label in ((0, 0, "captured → received"),
                                 (2, 1, "received → in the log's queue")):  # fmt: skip
        rows[0].plot(*broken(times, delays[:, column]), color=COLOURS[index], lw=thin, label=label)
    rows[0].set_ylabel("delay, ms")
    _logarithmic(rows[0], delays[:, [0, 2]])
    rows[1].plot(*broken(times, delays[:, 1]), color=COLOURS[2], lw=thin)
    rows[1].set_ylabel("uncertainty of the\ncapture time, ms")
    _logarithmic(rows[1], delays[:, 1])
    _clock(rows[2], board, look)
    rows[2].set_ylabel("board's clock\nruns fast, ppm")
    for axes in rows:
        axes.grid(visible=True)
    sheet.legend(rows[0])
    sheet.legend(rows[2])
    shade(sheet, rows, board, invalid=False)
    margin = max(0.01 * (board.last - board.first), 1e-3)
    rows[0].set_xlim(board.first - margin, board.last + margin)
    _finish_axes(rows)
    for place, spread, what, index in zip(
        places[3:],
        (board.latency_spread, board.logging_spread, board.period_spread),
        ("captured → received", "received → in the log's queue", "from cycle to cycle"),
        range(3), strict=True,
    ):  # fmt: skip
        _histogram(sheet, sheet.figure.add_subplot(place), spread, what, index)
    return sheet


def _clock(axes: Axes, board: BoardSeries, look: Look) -> None:
    """Draw the error of the board's clock; the time before it was known does not set the scale."""
    errors = [
        (when, float(values["clock_rate_error"]) * 1e6)
        for when, values in zip(
            board.diagnostics_track.time, board.diagnostics_track.items, strict=True
        )
        if _is_number(values.get("clock_rate_error", ""))
    ]
    if not errors:
        show_text(axes, "this board has no clock of its own")
        return
    times, values = np.array(errors).T
    axes.plot(*broken(times, values), "o-", ms=3 * look.thin, color=COLOURS[3], lw=0.9 * look.thin)
    low, high = np.quantile(values, SETTLED)
    room = max(2.0 * (high - low), 1.0)
    outside = (values < low - room) | (values > high + room)
    if not outside.any():
        return
    inside = values[~outside]
    margin = 0.08 * max(float(np.ptp(inside)), 1.0)
    bottom, top = float(inside.min()) - margin, float(inside.max()) + margin
    axes.set_ylim(bottom, top)
    axes.plot(
        times[outside], np.clip(values[outside], bottom, top), "D", color="black", clip_on=False,
        ms=4 * look.thin, zorder=5,
        label=f"beyond the scale: {_range(values[outside])} ppm",
    )  # fmt: skip


def _range(values: Any) -> str:
    """Return a text such as "-414", or "3 points, -414 to 220"."""
    low, high = f"{values.min():.3g}", f"{values.max():.3g}"
    return low if len(values) == 1 else f"{len(values)} points, {low} to {high}"


def _figures(board: BoardSeries) -> str:
    """Describe rate, losses and drops in words."""
    spread = board.period_spread
    mean = spread.total / spread.number if spread.number else float("nan")
    rate = f"{1 / mean:.1f} Hz, " if mean > 0 else ""
    drops = ", ".join(f"{reason} {n}" for reason, n in sorted(board.drops.items()) if n)
    return f"{rate}{board.cycles} cycles, {board.lost} lost; drops: {drops or 'none'}"


def _histogram(sheet: Sheet, axes: Axes, spread: Spread, what: str, index: int) -> None:
    axes.set_xlabel(f"{what}, ms")
    axes.set_ylabel("cycles")
    if not spread.number:
        show_text(axes, "nothing to count")
        return
    edges = LATENCY_BINS * 1e3
    axes.stairs(spread.counts[1:-1], edges, fill=True, color=COLOURS[index], alpha=0.6)
    axes.set_xscale("log")
    low, high = max(spread.least, LATENCY_BINS[0]) * 1e3, max(spread.greatest, 1e-4) * 1e3
    axes.set_xlim(low / 1.6, high * 1.6)
    plain_ticks(axes.xaxis, low / 1.6, high * 1.6)
    for share, style in ((0.5, "-"), (0.99, "--")):
        value = spread.percentile(share) * 1e3
        axes.axvline(
            value,
            color="0.2",
            lw=sheet.look.thin,
            ls=style,
            label=f"p{share * 100:.0f} {value:.4g}",
        )
    axes.plot([], [], " ", label=f"greatest {spread.greatest * 1e3:.4g}")
    axes.grid(visible=True)
    sheet.legend(axes)


def _logarithmic(axes: Axes, values: Any) -> None:
    """Give delays a logarithmic axis, as some are a hundred times others.

    Say how many are not above 0.
    """
    known = np.asarray(values)[np.isfinite(values)]
    positive = known[known > 0]
    if not len(positive):
        axes.set_ylim(bottom=0)
        return
    axes.set_yscale("log", nonpositive="mask")
    low, high = float(positive.min()) / 1.3, float(positive.max()) * 1.3
    axes.set_ylim(low, high)
    plain_ticks(axes.yaxis, low, high)
    if count := int((known <= 0).sum()):
        axes.plot([], [], " ", label=f"{count} not above 0, not shown")


def _sheet(
    board: BoardSeries,
    title: str,
    ratios: tuple[float, ...],
    look: Look,
    groups: Sequence[Group] = (),
) -> tuple[Sheet, list[Any]]:
    """Make rows of curves under a title, with a strip for events above and their list below."""
    seconds = board.last - board.first
    listed = _listed(groups, board)
    text_in = look.line_in * (len(listed) + 0.5) if listed else 0.0
    strip_in = 2.0 * look.line_in if groups else 0.0
    heights = [ratio * look.row_in for ratio in ratios]
    sheet = Sheet(
        look, sum(heights) + text_in + strip_in + 0.35 * look.row_in,
        f"{title}, {board.cycles} cycles in {seconds:.1f} s",
    )  # fmt: skip
    every = [*([strip_in] if groups else []), *heights, *([text_in] if listed else [])]
    grid = sheet.figure.add_gridspec(len(every), 1, height_ratios=every)
    offset = 1 if groups else 0
    first = sheet.figure.add_subplot(grid[offset])
    rows = [first]
    for index in range(1, len(heights)):
        rows.append(sheet.figure.add_subplot(grid[offset + index], sharex=first))
    margin = max(0.01 * seconds, 1e-3)
    first.set_xlim(board.first - margin, board.last + margin)
    if groups:
        _strip(sheet.figure.add_subplot(grid[0], sharex=first), groups, rows, look)
        _list(sheet, sheet.figure.add_subplot(grid[len(every) - 1]), listed)
    _finish_axes(rows)
    return sheet, rows


def _lines(axes: Axes, time: list[float], curves: dict[str, list[Any]]) -> None:
    for index, (label, values) in enumerate(curves.items()):
        style = ("-", "-", "--")[index % 3]  # the last curve may cover the one before it
        axes.plot(*broken(time, values), color=COLOURS[index], ls=style, label=label)


def shade(sheet: Sheet, rows: Sequence[Any], board: BoardSeries, *, invalid: bool) -> None:
    """Shade stretches without data grey, and those with invalid features red.

    Say why in the key.
    """
    gaps = holes(board.time)
    spans, reasons = _invalid(board) if invalid else ([], [])
    for axes in rows:
        for begin, end in spans:
            axes.axvspan(begin, end, color=INVALID, lw=0, zorder=0)
        for begin, end in gaps:
            axes.axvspan(begin, end, color=MISSING, lw=0, zorder=0.1)
    explain_shades(sheet, gaps, reasons if spans else None)


def explain_shades(
    sheet: Sheet, gaps: Sequence[tuple[float, float]], reasons: Sequence[str] | None
) -> None:
    """Explain grey and red in the key; ``reasons`` is None where nothing is red."""
    from matplotlib.patches import Patch

    if gaps:
        longest = max(end - begin for begin, end in gaps)
        number = f"a hole of {longest:.3g} s"
        if len(gaps) > 1:
            number = f"{len(gaps)} holes, the longest {longest:.3g} s"
        sheet.key(Patch(color=MISSING), f"nothing in the log: {number}")
    if reasons is not None:
        why = "; ".join(plain(reason) for reason in reasons)
        sheet.key(Patch(color=INVALID), f"features not valid{': ' if why else ''}{why}")


def _invalid(board: BoardSeries) -> tuple[list[tuple[float, float]], list[str]]:
    """Find stretches without valid features, s, and the commonest reasons."""
    spans: list[tuple[float, float]] = []
    reasons: dict[str, int] = {}
    usual = period(board.feature_time)
    for when, features in zip(board.feature_time, board.features, strict=True):
        if features.valid:
            continue
        for reason in features.reasons:
            reasons[reason] = reasons.get(reason, 0) + 1
        if spans and when - spans[-1][1] <= HOLE_PERIODS * usual:
            spans[-1] = (spans[-1][0], when)
        else:
            spans.append((when, when))
    common = sorted(reasons, key=lambda reason: -reasons[reason])[:REASONS]
    return [(begin - usual / 2, end + usual / 2) for begin, end in spans], common


Group = tuple[float, list[str]]
"""Time of events, s, and their texts; events that happened together share a number."""


def _grouped(board: BoardSeries, room_pt: float, look: Look) -> list[Group]:
    span = max(board.last - board.first, 1e-3)
    most = max(2.0, TAKEN_UP * room_pt / width_pt("000", _number_pt(look)))
    groups: list[Group] = []
    for when, text in board.events:
        if groups and when - groups[-1][0] < span / most:
            groups[-1][1].append(text)
        else:
            groups.append((when, [text]))
    return groups


def _number_pt(look: Look) -> float:
    return 0.85 * look.font_pt


def _strip(axes: Axes, groups: Sequence[Group], rows: Sequence[Any], look: Look) -> None:
    """Number the events in a strip, with faint lines through the curves below."""
    begin, end = rows[0].get_xlim()
    axes.set_ylim(0, 1)
    axes.set_yticks([])
    axes.set_ylabel("events", rotation=0, ha="right", va="center")
    axes.tick_params(labelbottom=False, bottom=False)
    for side in ("top", "right", "left"):
        axes.spines[side].set_visible(False)
    for number, (when, _) in enumerate(groups, 1):
        if not begin <= when <= end:
            continue  # stamped by another clock, or while the board was silent
        axes.text(
            when, 0.5, str(number), ha="center", va="center", fontsize=_number_pt(look),
            clip_on=True,
        )  # fmt: skip
        for row in rows:
            row.axvline(when, color="0.5", lw=0.5 * look.thin, ls="--", alpha=0.6, zorder=0.5)


def _listed(groups: Sequence[Group], board: BoardSeries) -> list[str]:
    """Make a line of text for each group, and one for those there is no room for."""
    lines = []
    for number, (when, texts) in enumerate(groups[:LISTED], 1):
        counts: dict[str, int] = {}
        for text in texts:
            counts[text] = counts.get(text, 0) + 1
        said = "; ".join(plain(t) + (f" (× {n})" if n > 1 else "") for t, n in counts.items())
        lines.append(f"{number}  at {when:.2f} s: {said}")
    rest = sum(len(texts) for _, texts in groups[LISTED:]) + board.events_left_out
    if rest:
        lines.append(f"and {rest} more, which `tactile log cat` lists")
    return lines


def _list(sheet: Sheet, axes: Axes, lines: Sequence[str]) -> None:
    axes.axis("off")
    size = _number_pt(sheet.look)

    def write() -> None:
        room = axes.get_window_extent().width * 72.0 / sheet.figure.dpi
        for index, line in enumerate(lines):
            axes.text(
                0.0, 1.0 - (index + 0.5) / len(lines), shortened(line, room, size),
                transform=axes.transAxes, fontsize=size, va="center", in_layout=False,
            )  # fmt: skip

    sheet.defer(write)


def _is_number(text: str) -> bool:
    try:
        return bool(np.isfinite(float(text)))
    except ValueError:
        return False


def _finish_axes(rows: list[Any]) -> None:
    for axes in rows[:-1]:
        axes.tick_params(labelbottom=False)
    rows[-1].set_xlabel("time since the first cycle, s")


Drawer = Callable[..., Sheet]
