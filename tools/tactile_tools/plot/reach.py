"""Draw a reach from a log: the cupboard from above, the finger's path, and the events."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tactile_core.bus.markers import ADD, CYLINDER
from tactile_core.geometry import FINGER_OUTLINE, TIP_X
from tactile_tools.plot.curves import MISSING, broken, explain_shades, holes
from tactile_tools.plot.look import SCREEN, Look, Sheet, named, plain, shortened, styled
from tactile_tools.plot.reach_series import Contact, ReachSeries, read_reach, turned

if TYPE_CHECKING:
    from matplotlib.axes import Axes

ACTIVITIES = {
    "homing": "#999999",
    "straight": "#0072B2",
    "burrow": "#009E73",
    "excavate_ccw": "#E69F00",
    "excavate_cw": "#CC79A7",
    "sweep_ccw": "#E69F00",
    "sweep_cw": "#CC79A7",
}
"""Palette of Okabe and Ito, distinguishable in print and by colour-blind people."""
OTHER = "#7f7f7f"
TOUCHED = "#B2182B"  # contacts and their effects
FINGER = "#08306B"
TARGET = "#F0E442"

M_AT_1_N = 0.0105
"""Width of the circle for 1 N, m; its area is proportional to the force."""
KEY_FORCES_N = (5.0, 2.0, 1.0, 0.5, 0.2, 0.1)
"""Forces that the key may show, the largest whose circle fits beside its words."""
KEY_CIRCLE = 2.0
"""Largest width of that circle, as a multiple of the size of the letters."""
SHEAR_M_PER_N = 0.008
SHEAR_FROM_N = 0.3  # shorter arrows would look like dots
MOVED_M = 0.004  # an object that moved less is drawn once
SHOWN = 6  # numbered moments
LEAST_N = 0.3  # weaker touches are not numbered
FAINT_EVERY_S = 0.2  # further touches are drawn as faint circles
NAMED = 4
"""Excavations that are named; further ones are only lines."""
GATES = 6
"""Rows for what the safety gate did; the rarest kinds share the last one."""

ROOM_M = 0.02
"""Margin around the contents, m."""


def draw_reach(
    path: Path | Sequence[Path], out: Path, look: Look = SCREEN, dpi: int | None = None
) -> None:
    """Write the picture of the last reach in a log; LogUnreadableError when there is none."""
    draw(read_reach(path), out, look, dpi)


def draw(reach: ReachSeries, out: Path, look: Look = SCREEN, dpi: int | None = None) -> None:
    """Write the picture of one reach."""
    with styled(look):
        reach_sheet(reach, look).save(out, dpi)


def reach_sheet(reach: ReachSeries, look: Look = SCREEN) -> Sheet:
    """Make the sheet that `draw` writes."""
    moments = reach.moments(SHOWN, LEAST_N)
    activities = list(dict.fromkeys(s.activity for s in reach.states))
    rows_in = [1.35 * look.row_in, 1.35 * look.row_in]
    bars_in = (len(activities) + len(_gates(reach)) + 1) * 1.25 * look.line_in
    rows_in.append(max(bars_in, 0.5 * look.row_in))
    rest = 0.75 * look.row_in
    if look.narrow:
        heights = [1.05 * look.width_in, *rows_in]
        sheet = Sheet(look, sum(heights) + 2.2 * rest, _title(reach))
        grid = sheet.figure.add_gridspec(4, 1, height_ratios=heights)
        places = [grid[i] for i in range(4)]
    else:
        sheet = Sheet(look, max(sum(rows_in) + rest, 0.58 * look.width_in), _title(reach))
        grid = sheet.figure.add_gridspec(3, 2, width_ratios=(1.05, 1), height_ratios=rows_in)
        places = [grid[:, 0], grid[0, 1], grid[1, 1], grid[2, 1]]
    _cupboard(sheet, sheet.figure.add_subplot(places[0]), reach, moments, activities)
    distance = sheet.figure.add_subplot(places[1])
    force = sheet.figure.add_subplot(places[2], sharex=distance)
    doing = sheet.figure.add_subplot(places[3], sharex=distance)
    _distance(distance, reach, look)
    _force(force, reach, moments, look)
    _activity(doing, reach, activities, look)
    missing = _missing(reach)
    for axes in (distance, force, doing):
        for begin, end in missing:
            axes.axvspan(begin, end, color=MISSING, lw=0, zorder=0.1)
    for axes in (distance, force):
        axes.tick_params(labelbottom=False)
        sheet.legend(axes)
        for begin, end, activity in _spans(reach):
            if activity.startswith(("excavate", "sweep")):
                axes.axvspan(
                    begin, end, color=ACTIVITIES.get(activity, OTHER), alpha=0.15, lw=0, zorder=0
                )
    distance.set_xlim(0.0, max(reach.time[-1], 0.1) * 1.01)
    explain_shades(sheet, missing, None)
    if reach.left_out:
        from matplotlib.lines import Line2D

        sheet.key(Line2D([], [], ls=""), f"{reach.left_out} later messages are left out: too many")
    return sheet


def _missing(reach: ReachSeries) -> list[tuple[float, float]]:
    """Find stretches in which states, arm or touch are missing, s."""
    every = sorted([*holes(reach.time), *holes(reach.arm_time), *(holes(reach.touch_time))])
    joined: list[tuple[float, float]] = []
    for begin, end in every:
        if joined and begin <= joined[-1][1]:
            joined[-1] = (joined[-1][0], max(end, joined[-1][1]))
        else:
            joined.append((begin, end))
    return joined


def _title(reach: ReachSeries) -> str:
    """Describe strategy and outcome, and say which of several reaches this is."""
    outcome = reach.outcome()
    peak = max((t.peak_force for t in reach.touch if math.isfinite(t.peak_force)), default=0.0)
    count = len(reach.excavations())
    words = outcome.text if outcome is not None else "the log ends before the reach does"
    number = f"{count or 'no'} excavation{'' if count == 1 else 's'}"
    several = []
    if len(reach.all_reaches) > 1:
        several.append(f"reach {reach.number} of {len(reach.all_reaches)}")
    for what, name, held in (
        ("board", reach.board_name, reach.boards),
        ("arm", reach.arm_name, reach.arms),
    ):
        if len(held) > 1:
            several.append(f"{what} {name} of {', '.join(sorted(held))}")
    which = f"{', '.join(several)}. " if several else ""
    strategy = reach.states[-1].strategy
    return f"{which}{strategy}: {words}; peak force {peak:.1f} N, {number}"


def _flip(points: Any) -> Any:
    """Turn points into picture axes: x is −y (right is right), y is x (up is into the cupboard)."""
    points = np.asarray(points)
    return np.stack([-points[..., 1], points[..., 0]], axis=-1)


def _spans(reach: ReachSeries) -> list[tuple[float, float, str]]:
    """Find the stretches of one activity each: (begin, end, activity), s."""
    found: list[tuple[float, float, str]] = []
    torn = {end for _, end in holes(reach.time)}
    for when, state in zip(reach.time, reach.states, strict=True):
        if found and found[-1][2] == state.activity and when not in torn:
            found[-1] = (found[-1][0], when, state.activity)
        else:
            if found and when not in torn:
                found[-1] = (found[-1][0], when, found[-1][2])
            found.append((when, when, state.activity))
    return found


def _cupboard(
    sheet: Sheet, axes: Axes, reach: ReachSeries, moments: Sequence[int], activities: Sequence[str]
) -> None:
    look = sheet.look
    _objects(axes, reach, look)
    tip = _flip(reach.tip())
    at = np.clip(np.searchsorted(reach.time, reach.arm_time), 0, len(reach.states) - 1)
    doing = np.array([reach.states[i].activity for i in at])
    for activity in dict.fromkeys(doing.tolist()):
        # A line must not bridge stretches of other activities or without data.
        line = np.where((doing == activity)[:, None], tip, np.nan)
        _, line = broken(reach.arm_time, line)
        colour = ACTIVITIES.get(activity, OTHER)
        axes.plot(*line.T, lw=2.4 * look.thin, color=colour, zorder=5, solid_capstyle="round")
    thin = look.thin
    shown = [tip]
    for index, style in ((0, {"ls": ":", "lw": 1.3 * thin}), (len(tip) - 1, {"lw": 2.0 * thin})):
        arm = reach.arm[index]
        outline = _flip(turned(_outline(reach), arm.x, arm.y, arm.heading))
        closed = np.vstack([outline, outline[:1]])
        axes.plot(closed[:, 0], closed[:, 1], color=FINGER, zorder=4, **style)
        pointed = _flip(turned([(0.15185, 0.0), (TIP_X, 0.0)], arm.x, arm.y, arm.heading))
        axes.plot(pointed[:, 0], pointed[:, 1], color=FINGER, zorder=4, **style)
        shown.append(closed)
    _contacts(sheet, axes, reach, moments)
    goal = next((s for s in reversed(reach.states) if s.goal_radius > 0), None)
    if goal is not None:
        place = np.array([[-goal.goal.y, goal.goal.x]])
        shown.append(place)
        axes.plot(*place.T, "*", ms=17 * thin, color=TARGET, mec="black", mew=thin, zorder=9)
    axes.autoscale_view()
    axes.set_aspect("equal", anchor="N")
    low, high = np.vstack(shown).min(axis=0) - ROOM_M, np.vstack(shown).max(axis=0) + ROOM_M
    axes.set_xlim(min(low[0], axes.get_xlim()[0]), max(high[0], axes.get_xlim()[1]))
    axes.set_ylim(min(low[1], axes.get_ylim()[0]), max(high[1], axes.get_ylim()[1]))
    axes.set_xlabel("across the cupboard, m")
    axes.set_ylabel("into the cupboard, m  (0: front edge)")
    axes.set_title("the cupboard from above")
    _legends(sheet, axes, activities, moved=_any_moved(reach))


def _outline(reach: ReachSeries) -> list[tuple[float, float]]:
    """Corners of the finger in ``ee``, m, in the width that the log gives."""
    width = max(y for _, y in FINGER_OUTLINE) - min(y for _, y in FINGER_OUTLINE)
    shown = [] if reach.last_world is None else _shown(reach.last_world)
    told = next((m.scale.y for m in shown if m.ns == "finger"), width)
    return [(x, y * told / width) for x, y in FINGER_OUTLINE]


def _moved(old: Any, new: Any) -> bool:
    here, there = (_flip((m.pose.position.x, m.pose.position.y)) for m in (old, new))
    return math.dist(here, there) > MOVED_M


def _any_moved(reach: ReachSeries) -> bool:
    if reach.last_world is None:
        return False
    after = {m.id: m for m in _shown(reach.last_world) if m.ns == "objects"}
    before = [m for m in _shown(reach.first_world) if m.ns == "objects"]
    return any(m.id not in after or _moved(m, after[m.id]) for m in before)


def _objects(axes: Axes, reach: ReachSeries, look: Look) -> None:
    """Draw walls and objects at the end; objects that moved also at the start, dashed."""
    if reach.last_world is None:
        return
    thin = look.thin
    before = {m.id: m for m in _shown(reach.first_world) if m.ns == "objects"}
    for marker in _shown(reach.last_world):
        tone = (marker.color.r, marker.color.g, marker.color.b)
        if marker.ns == "cupboard":
            axes.add_patch(_shape(marker, facecolor=tone, edgecolor="none"))
        if marker.ns != "objects":
            continue
        old = before.pop(marker.id, marker)
        moved = _moved(old, marker)
        edge = TOUCHED if moved else "0.35"
        axes.add_patch(
            _shape(marker, facecolor=tone, edgecolor=edge, alpha=0.8, lw=(0.9 + moved) * thin)
        )
        if moved:
            here, there = (_flip((m.pose.position.x, m.pose.position.y)) for m in (old, marker))
            axes.add_patch(_shape(old, fill=False, edgecolor=TOUCHED, ls="--", lw=thin))
            arrow = {"arrowstyle": "-|>", "color": TOUCHED, "lw": 1.2 * thin, "ls": "--",
                     "mutation_scale": 10 * thin, "shrinkA": 0, "shrinkB": 0}  # fmt: skip
            axes.annotate("", there, here, arrowprops=arrow, zorder=3)
    for gone in before.values():
        axes.add_patch(_shape(gone, fill=False, edgecolor=TOUCHED, ls="--", lw=thin))
        x, y = _flip((gone.pose.position.x, gone.pose.position.y))
        cross: dict[str, Any] = {
            "marker": "x",
            "s": 60 * thin**2,
            "lw": 1.2 * thin,
            "color": TOUCHED,
        }
        axes.scatter([x], [y], zorder=3, **cross)


def _shown(world: Any) -> list[Any]:
    """Markers of a message, without those that only delete another (of a fallen object)."""
    return [marker for marker in world.markers if marker.action == ADD]


def _shape(marker: Any, **look: Any) -> Any:
    """Make a patch of a marker seen from above."""
    from matplotlib.patches import Circle, Polygon

    x, y = marker.pose.position.x, marker.pose.position.y
    if marker.type == CYLINDER:
        return Circle((-y, x), marker.scale.x / 2, **look)
    yaw = 2 * math.atan2(marker.pose.orientation.z, marker.pose.orientation.w)
    a, b = marker.scale.x / 2, marker.scale.y / 2
    return Polygon(_flip(turned([(a, b), (-a, b), (-a, -b), (a, -b)], x, y, yaw)), **look)


def _contacts(sheet: Sheet, axes: Axes, reach: ReachSeries, moments: Sequence[int]) -> None:
    """Draw numbered moments as circles with shear arrows, and all other touches faintly."""
    look = sheet.look
    marks: list[tuple[int, Any]] = []
    due = 0.0
    known = reach.placed()
    faint: list[Contact] = []
    for index, when in enumerate(reach.touch_time):
        if when >= due and known[index] and reach.touch[index].patches:
            due = when + FAINT_EVERY_S
            faint += reach.contacts_at(index)
    _circles(axes, faint, alpha=0.10)
    for number, index in enumerate(moments, 1):
        contacts = reach.contacts_at(index)
        if not contacts:
            continue
        _circles(axes, contacts, alpha=0.45, rim=0.8 * look.thin)
        for contact in contacts:
            _shear(axes, contact, look)
        marks.append((number, _flip(max(contacts, key=lambda c: c.normal).place)))
    sheet.defer(lambda: _number(sheet, axes, marks))


def _number(sheet: Sheet, axes: Axes, marks: Sequence[tuple[int, Any]]) -> None:
    """Number each place, far from other numbers and places."""
    look = sheet.look
    per_pt = sheet.figure.dpi / 72.0
    places = [axes.transData.transform(place) for _, place in marks]
    taken = list(places)
    turns = np.linspace(0.0, 2 * math.pi, 24, endpoint=False)
    box = axes.get_window_extent()
    for (number, place), here in zip(marks, places, strict=True):
        offsets = 26 * look.thin * np.stack([np.cos(turns), np.sin(turns)], axis=1)
        tried = here + offsets * per_pt
        away = [
            min((math.dist(spot, other) for other in taken if other is not here), default=math.inf)
            if box.contains(*spot)
            else -1.0
            for spot in tried
        ]
        best = int(np.argmax(away))
        taken.append(tried[best])
        axes.annotate(
            str(number), place, xytext=tuple(offsets[best]), textcoords="offset points",
            arrowprops={"arrowstyle": "-", "color": TOUCHED, "lw": 0.7 * look.thin},
            **_tag(look),
        )  # fmt: skip


def _tag(look: Look) -> dict[str, Any]:
    """Style of the number of a moment."""
    box = {"boxstyle": "circle,pad=0.2", "fc": TOUCHED, "ec": "white", "lw": 0.6 * look.thin}
    return {
        "ha": "center", "va": "center", "fontsize": 0.85 * look.font_pt, "color": "white",
        "weight": "bold", "bbox": box, "zorder": 10,
    }  # fmt: skip


def _circles(axes: Axes, contacts: Sequence[Contact], alpha: float, rim: float = 0.0) -> None:
    from matplotlib.collections import EllipseCollection

    if not contacts:
        return
    widths = [M_AT_1_N * math.sqrt(max(c.normal, 0.0)) for c in contacts]
    axes.add_collection(
        EllipseCollection(
            widths, widths, np.zeros(len(widths)), units="xy",
            offsets=np.array([_flip(c.place) for c in contacts]),
            offset_transform=axes.transData, facecolors=TOUCHED, edgecolors=TOUCHED,
            linewidths=rim, alpha=alpha, zorder=6,
        )
    )  # fmt: skip


def _shear(axes: Axes, contact: Contact, look: Look) -> None:
    size = float(np.hypot(*contact.shear))
    if not size >= SHEAR_FROM_N:
        return
    place = _flip(contact.place)
    axes.annotate(
        "",
        place + _flip(contact.shear) * SHEAR_M_PER_N,
        place,
        arrowprops={"arrowstyle": "-|>", "color": "black", "lw": 1.3 * look.thin, "shrinkA": 0,
                    "shrinkB": 0, "mutation_scale": 10 * look.thin},
        zorder=8,
    )  # fmt: skip


def _legends(sheet: Sheet, axes: Axes, activities: Sequence[str], moved: bool) -> None:
    """Draw the key to colours, sizes and arrows below the view from above."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch
    from matplotlib.transforms import ScaledTranslation

    thin = sheet.look.thin
    paths = [
        Line2D([], [], color=ACTIVITIES.get(a, OTHER), lw=2.6 * thin, label=f"tip, {named(a)}")
        for a in activities
    ]
    circle = Line2D([], [], ls="", marker="o", mec=TOUCHED, mfc=TOUCHED, alpha=0.45,
                    label=f"contact, {KEY_FORCES_N[0]:g} N normal")  # fmt: skip
    things = [
        circle,
        Line2D([], [], color="black", marker=">", ms=4 * thin, markevery=[1],
               label=f"shear ({1 / SHEAR_M_PER_N / 100:.2g} N is 1 cm)"),
        Patch(fc="0.75", ec="0.35", label="object (darker: heavier)"),
        *([Patch(fc="0.7", ec=TOUCHED, lw=1.9 * thin, label="object that was moved"),
           Patch(fc="none", ec=TOUCHED, ls="--", label="… where it was (×: fell off)")]
          if moved else []),
        Line2D([], [], color=FINGER, ls=":", label="finger at the start"),
        Line2D([], [], color=FINGER, lw=2 * thin, label="finger at the end"),
        Line2D([], [], ls="", marker="*", ms=11 * thin, color=TARGET, mec="black",
               mew=thin, label="target"),
    ]  # fmt: skip
    # Below ticks, numbers and label, whatever the height of the axes.
    down_in = (2.7 * sheet.look.font_pt + 14.0 * thin) / 72.0
    below = axes.transAxes + ScaledTranslation(0.0, -down_in, sheet.figure.dpi_scale_trans)
    legend = axes.legend(
        handles=[*things, *paths], loc="upper center", bbox_to_anchor=(0.5, 0.0),
        bbox_transform=below,
        ncols=3 if sheet.look.width_in > 10 else 2, fontsize=0.85 * sheet.look.font_pt,
        frameon=False, labelspacing=0.5, handlelength=1.8, columnspacing=1.2, borderaxespad=0.0,
    )  # fmt: skip

    def size() -> None:
        """Make the circle of the key as large as those in the picture, of a force that fits."""
        box = axes.get_window_extent()
        per_m = box.width / (axes.get_xlim()[1] - axes.get_xlim()[0]) * 72.0 / sheet.figure.dpi
        index = things.index(circle)
        key: Any = legend.legend_handles[index]
        for force_n in KEY_FORCES_N:
            size_pt = M_AT_1_N * math.sqrt(force_n) * per_m
            if size_pt <= KEY_CIRCLE * sheet.look.font_pt:
                break
        key.set_markersize(size_pt)
        legend.get_texts()[index].set_text(f"contact, {force_n:g} N normal")

    sheet.defer(size)


def _distance(axes: Axes, reach: ReachSeries, look: Look) -> None:
    distance = [s.distance * 1e2 for s in reach.states]
    axes.plot(*broken(reach.time, distance), color=FINGER)
    axes.set_ylabel("tip to target, cm")
    axes.set_ylim(bottom=0)
    axes.grid(visible=True)
    said = []
    for when, text in reach.excavations():
        axes.axvline(when, color="0.3", lw=0.8 * look.thin)
        said.append(f"{when:.1f} s {text.replace(' ', ': ', 1)}")
    if said:
        more = len(said) - NAMED
        told = ", ".join(said[:NAMED]) + (f" and {more} more" if more > 0 else "")
        axes.plot([], [], color="0.3", lw=0.8 * look.thin, label=f"excavation: {plain(told)}")
    outcome = reach.outcome()
    if outcome is not None:
        word = outcome.code if outcome.code == "reached" else f"not reached: {outcome.code}"
        axes.plot(
            [reach.time[-1]], [distance[-1]], "o", ms=5 * look.thin, mfc="white", mec=FINGER,
            clip_on=False, zorder=5, label=plain(word),
        )  # fmt: skip


def _force(axes: Axes, reach: ReachSeries, moments: Sequence[int], look: Look) -> None:
    load = [math.hypot(a.wrench.force.x, a.wrench.force.y) for a in reach.arm]
    total = [t.normal_force for t in reach.touch]
    peak = [t.peak_force for t in reach.touch]
    for time, values, colour, label, width in (
        (reach.arm_time, load, "0.72", "arm's force sensor", 2.4),
        (reach.touch_time, total, "#E69F00", "skin, sum of normal forces", 0.9),
        (reach.touch_time, peak, TOUCHED, "skin, peak", 0.9),
    ):
        axes.plot(*broken(time, values), lw=width * look.thin, color=colour, label=label)
    axes.set_ylabel("force, N")
    axes.grid(visible=True)
    known = [v for v in (*total, *peak, *load) if math.isfinite(v)]
    top = 1.05 * max([1.0, *known])
    # The numbers stand above every curve; where two would overlap, the second is placed higher.
    axes.set_ylim(0, top * (1.32 if moments else 1.0))
    levels, last = 2, -math.inf
    level = 0
    span = max(reach.time[-1], 0.1)
    for number, index in enumerate(moments, 1):
        when = reach.touch_time[index]
        level = (level + 1) % levels if when - last < 0.05 * span else 0
        last = when
        axes.axvline(when, color=TOUCHED, lw=0.6 * look.thin, ls=":", zorder=1)
        axes.text(when, top * (1.08 + 0.15 * level), str(number), **_tag(look))


def _gates(reach: ReachSeries) -> list[tuple[str, list[str]]]:
    """Rows for what the gate did: label and codes, the commonest first."""
    count: dict[str, int] = {}
    for state in reach.states:
        for code in state.interventions:
            count[code] = count.get(code, 0) + 1
    codes = sorted(count, key=lambda code: -count[code])
    if len(codes) <= GATES:
        return [(f"gate: {plain(code)}", [code]) for code in codes]
    rare = codes[GATES - 1 :]
    rows = [(f"gate: {plain(code)}", [code]) for code in codes[: GATES - 1]]
    return [*rows, (f"gate: {len(rare)} other kinds", rare)]


def _activity(axes: Axes, reach: ReachSeries, names: Sequence[str], look: Look) -> None:
    """Draw bars for the activities, and below them for what the safety gate did."""
    for begin, end, activity in _spans(reach):
        colour = ACTIVITIES.get(activity, OTHER)
        axes.barh(names.index(activity), max(end - begin, 0.02), left=begin, height=0.7, fc=colour)
    labels = [plain(name) for name in names]
    for label, codes in _gates(reach):
        when = [
            t
            for t, s in zip(reach.time, reach.states, strict=True)
            if any(code in s.interventions for code in codes)
        ]
        axes.plot(
            when, np.full(len(when), len(labels)), "|", color="black", ms=8 * look.thin,
            mew=look.thin,
        )  # fmt: skip
        labels.append(label)
    room = 72.0 * look.width_in * (0.3 if look.narrow else 0.15)
    size = 0.85 * look.font_pt
    axes.set_yticks(
        range(len(labels)), [shortened(label, room, size) for label in labels], fontsize=size
    )
    axes.set_ylim(len(labels) - 0.5, -0.5)
    axes.set_xlabel("time since the reach began, s")
    axes.grid(visible=True, axis="x")
