"""Picture of a reach from a log: the cupboard from above, the finger's path, and what happened."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tactile_bus.geometry import FINGER_OUTLINE, TIP_X
from tactile_bus.markers import ADD, CYLINDER
from tactile_tools.plots.reach_series import Contact, ReachSeries, read_reach, turned

if TYPE_CHECKING:
    from matplotlib.axes import Axes

ACTIVITIES = {
    "homing": "#999999",
    "straight": "#0072B2",
    "burrow": "#009E73",
    "excavate_ccw": "#E69F00",
    "excavate_cw": "#CC79A7",
}
"""Okabe and Ito's palette: told apart in print and by the colour-blind."""
OTHER = "#7f7f7f"
TOUCHED = "#B2182B"  # contacts and what they did
FINGER = "#08306B"

AREA_PER_N = 55.0  # points²
SHEAR_M_PER_N = 0.008
SHEAR_FROM_N = 0.3  # shorter arrows would be dots
MOVED_M = 0.004  # an object that went less far is drawn once
SHOWN = 6  # moments that are numbered
APART_S, APART_M = 1.2, 0.012  # one of both must lie between two of them
LEAST_N = 0.3  # weaker touches are not numbered
FAINT_EVERY_S = 0.2  # all the other touches, as faint circles

BELOW_M = 0.235  # how far in front of the shelf the picture begins


def draw_reach(path: Path | Sequence[Path], out: Path) -> None:
    """Write the picture of the last reach in a log; LogUnreadableError when there is none."""
    import matplotlib as mpl  # 0.3 s: not before a picture is really wanted

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    reach = read_reach(path)
    moments = reach.moments(SHOWN, APART_S, APART_M, LEAST_N)
    figure = plt.figure(figsize=(15.5, 9.2), layout="constrained")
    grid = figure.add_gridspec(3, 2, width_ratios=(1.12, 1), height_ratios=(1, 1, 0.6))
    _cupboard(figure.add_subplot(grid[:, 0]), reach, moments)
    distance = figure.add_subplot(grid[0, 1])
    force = figure.add_subplot(grid[1, 1], sharex=distance)
    doing = figure.add_subplot(grid[2, 1], sharex=distance)
    _distance(distance, reach)
    _force(force, reach, moments)
    _activity(doing, reach)
    for axes in (distance, force):
        axes.tick_params(labelbottom=False)
        for begin, end, activity in _spans(reach):
            if activity.startswith("excavate"):
                axes.axvspan(begin, end, color=ACTIVITIES.get(activity, OTHER), alpha=0.15, lw=0)
    distance.set_xlim(0.0, max(reach.time[-1], 0.1))
    figure.suptitle(_title(reach), fontsize=15)
    figure.savefig(out, dpi=100)
    plt.close(figure)


def _title(reach: ReachSeries) -> str:
    """Strategy and outcome in words."""
    outcome = reach.outcome()
    peak = max((t.peak_force for t in reach.touch if math.isfinite(t.peak_force)), default=0.0)
    count = len(reach.excavations())
    words = outcome.text if outcome is not None else "the log ends before the reach does"
    number = f"{count or 'no'} excavation{'' if count == 1 else 's'}"
    return f"{reach.states[-1].strategy}: {words}; peak force {peak:.1f} N, {number}"


def _flip(points: Any) -> Any:
    """Plotted x is −y (right is right), plotted y is x (up is into the cupboard)."""
    points = np.asarray(points)
    return np.stack([-points[..., 1], points[..., 0]], axis=-1)


def _spans(reach: ReachSeries) -> list[tuple[float, float, str]]:
    """(begin, end, activity) of each stretch of one activity, s."""
    found: list[tuple[float, float, str]] = []
    for when, state in zip(reach.time, reach.states, strict=True):
        if found and found[-1][2] == state.activity:
            found[-1] = (found[-1][0], when, state.activity)
        else:
            if found:
                found[-1] = (found[-1][0], when, found[-1][2])
            found.append((when, when, state.activity))
    return found


def _cupboard(axes: Axes, reach: ReachSeries, moments: Sequence[int]) -> None:
    _objects(axes, reach)
    tip = _flip(reach.tip())
    at = np.clip(np.searchsorted(reach.time, reach.arm_time), 0, len(reach.states) - 1)
    doing = np.array([reach.states[i].activity for i in at])
    for activity in dict.fromkeys(doing.tolist()):
        # Gaps where it did something else must not be bridged by a line.
        line = np.where((doing == activity)[:, None], tip, np.nan)
        colour = ACTIVITIES.get(activity, OTHER)
        axes.plot(line[:, 0], line[:, 1], lw=2.6, color=colour, zorder=5, solid_capstyle="round")
    for index, style in ((0, {"ls": ":", "lw": 1.3}), (len(tip) - 1, {"lw": 2.0})):
        arm = reach.arm[index]
        outline = _flip(turned(_outline(reach), arm.x, arm.y, arm.heading))
        closed = np.vstack([outline, outline[:1]])
        axes.plot(closed[:, 0], closed[:, 1], color=FINGER, zorder=4, **style)
        pointed = _flip(turned([(0.15185, 0.0), (TIP_X, 0.0)], arm.x, arm.y, arm.heading))
        axes.plot(pointed[:, 0], pointed[:, 1], color=FINGER, zorder=4, **style)
    _contacts(axes, reach, moments)
    goal = next((s for s in reversed(reach.states) if s.goal_radius > 0), None)
    if goal is not None:
        axes.plot(-goal.goal.y, goal.goal.x, "*", ms=19, color="#F0E442", mec="black", zorder=9)
    axes.set_aspect("equal")
    axes.set_ylim(bottom=min(-BELOW_M, float(tip[:, 1].min()) - 0.19))
    axes.set_xlabel("across the cupboard, m")
    axes.set_ylabel("into the cupboard, m  (0: front edge of the shelf)")
    axes.set_title("the cupboard from above", fontsize=12)
    _legends(axes, list(dict.fromkeys(doing.tolist())))


def _outline(reach: ReachSeries) -> list[tuple[float, float]]:
    """Corners of the finger in ``ee``, m, as wide as the log says it was."""
    width = max(y for _, y in FINGER_OUTLINE) - min(y for _, y in FINGER_OUTLINE)
    shown = [] if reach.last_world is None else _shown(reach.last_world)
    told = next((m.scale.y for m in shown if m.ns == "finger"), width)
    return [(x, y * told / width) for x, y in FINGER_OUTLINE]


def _objects(axes: Axes, reach: ReachSeries) -> None:
    """Draw walls and objects at the end; those that were moved at the start as well, dashed."""
    if reach.last_world is None:
        return
    before = {m.id: m for m in _shown(reach.first_world) if m.ns == "objects"}
    for marker in _shown(reach.last_world):
        tone = (marker.color.r, marker.color.g, marker.color.b)
        if marker.ns == "cupboard":
            axes.add_patch(_shape(marker, facecolor=tone, edgecolor="none"))
        if marker.ns != "objects":
            continue
        old = before.pop(marker.id, marker)
        here, there = (_flip((m.pose.position.x, m.pose.position.y)) for m in (old, marker))
        moved = math.dist(here, there) > MOVED_M
        edge = TOUCHED if moved else "0.35"
        axes.add_patch(_shape(marker, facecolor=tone, edgecolor=edge, alpha=0.8, lw=0.9 + moved))
        if moved:
            axes.add_patch(_shape(old, fill=False, edgecolor=TOUCHED, ls="--", lw=1.0))
            arrow = {"arrowstyle": "-|>", "color": TOUCHED, "lw": 1.2, "ls": "--"}
            axes.annotate("", there, here, arrowprops=arrow, zorder=3)
    for gone in before.values():
        axes.add_patch(_shape(gone, fill=False, edgecolor=TOUCHED, ls="--", lw=1.0))
        place = _flip((gone.pose.position.x, gone.pose.position.y))
        axes.annotate("off the shelf", place, ha="center", fontsize=8, color=TOUCHED)


def _shown(world: Any) -> list[Any]:
    """Markers of a message but for those that only take away another, as of a fallen object."""
    return [marker for marker in world.markers if marker.action == ADD]


def _shape(marker: Any, **look: Any) -> Any:
    """A marker seen from above as a patch."""
    from matplotlib.patches import Circle, Polygon

    x, y = marker.pose.position.x, marker.pose.position.y
    if marker.type == CYLINDER:
        return Circle((-y, x), marker.scale.x / 2, **look)
    yaw = 2 * math.atan2(marker.pose.orientation.z, marker.pose.orientation.w)
    a, b = marker.scale.x / 2, marker.scale.y / 2
    return Polygon(_flip(turned([(a, b), (-a, b), (-a, -b), (a, -b)], x, y, yaw)), **look)


def _contacts(axes: Axes, reach: ReachSeries, moments: Sequence[int]) -> None:
    """Draw numbered moments as circles with shear arrows, and every other touch faintly."""
    due = 0.0
    for index, when in enumerate(reach.touch_time):
        if when >= due and reach.touch[index].patches:
            due = when + FAINT_EVERY_S
            for contact in reach.contacts_at(index):
                _circle(axes, contact, alpha=0.10)
    for number, index in enumerate(moments, 1):
        contacts = reach.contacts_at(index)
        for contact in contacts:
            _circle(axes, contact, alpha=0.45, rim=0.8)
            _shear(axes, contact)
        strongest = _flip(max(contacts, key=lambda c: c.normal).place)
        axes.annotate(
            str(number),
            strongest,
            # Turned from one to the next, so that moments at one place can all be read.
            xytext=(26 * math.cos(2.4 * number), 26 * math.sin(2.4 * number)),
            textcoords="offset points",
            ha="center",
            va="center",
            fontsize=9,
            color="white",
            weight="bold",
            bbox={"boxstyle": "circle,pad=0.2", "fc": TOUCHED, "ec": "white", "lw": 0.6},
            arrowprops={"arrowstyle": "-", "color": TOUCHED, "lw": 0.7},
            zorder=10,
        )


def _circle(axes: Axes, contact: Contact, alpha: float, rim: float = 0.0) -> None:
    place = _flip(contact.place)
    size = AREA_PER_N * max(contact.normal, 0.0)
    look: dict[str, Any] = {"facecolors": TOUCHED, "edgecolors": TOUCHED, "linewidths": rim}
    axes.scatter(place[0], place[1], s=size, alpha=alpha, zorder=6, **look)


def _shear(axes: Axes, contact: Contact) -> None:
    size = float(np.hypot(*contact.shear))
    if not size >= SHEAR_FROM_N:
        return
    place = _flip(contact.place)
    axes.annotate(
        "",
        place + _flip(contact.shear) * SHEAR_M_PER_N,
        place,
        arrowprops={"arrowstyle": "-|>", "color": "black", "lw": 1.3, "shrinkA": 0, "shrinkB": 0},
        zorder=8,
    )


def _legends(axes: Axes, activities: Sequence[str]) -> None:
    """Keys to colours, and to the sizes of circles and arrows, in front of the shelf."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    paths = [
        Line2D([], [], color=ACTIVITIES.get(a, OTHER), lw=3, label=a.replace("_", " "))
        for a in activities
    ]
    style: dict[str, Any] = {"fontsize": 9, "framealpha": 0.9, "title_fontsize": 9}
    axes.add_artist(axes.legend(handles=paths, loc="lower right", title="path of the tip", **style))
    circles = [
        Line2D(
            [], [], ls="", marker="o", ms=math.sqrt(AREA_PER_N * n), mec=TOUCHED, mfc=TOUCHED,
            alpha=0.45, label=f"contact, {n:g} N normal",
        )
        for n in (1.0, 5.0)
    ]  # fmt: skip
    things = [
        *circles,
        Line2D([], [], color="black", marker=">", ms=5, markevery=[1],
               label=f"shear ({1 / SHEAR_M_PER_N / 100:.2g} N is 1 cm)"),
        Patch(fc="0.7", ec=TOUCHED, lw=1.9, label="object that was moved"),
        Patch(fc="none", ec=TOUCHED, ls="--", label="… where it was"),
        Patch(fc="0.75", ec="0.35", label="object (darker: heavier)"),
        Line2D([], [], color=FINGER, ls=":", label="finger at the start"),
        Line2D([], [], color=FINGER, lw=2, label="finger at the end"),
        Line2D([], [], ls="", marker="*", ms=13, color="#F0E442", mec="black", label="target"),
    ]  # fmt: skip
    axes.legend(handles=things, loc="lower left", labelspacing=0.7, **style)


def _distance(axes: Axes, reach: ReachSeries) -> None:
    distance = [s.distance * 1e2 for s in reach.states]
    axes.plot(reach.time, distance, color=FINGER)
    axes.set_ylabel("tip to target, cm")
    axes.set_ylim(bottom=0)
    axes.grid(alpha=0.25)
    for when, text in reach.excavations():
        axes.annotate(
            f" excavate {text.replace(' ', ': ', 1)}",
            (when, 0.97),
            xycoords=("data", "axes fraction"),
            rotation=90,
            va="top",
            ha="left",
            fontsize=9,
        )
        axes.axvline(when, color="0.3", lw=0.8)
    outcome = reach.outcome()
    if outcome is not None:
        word = outcome.code if outcome.code == "reached" else f"not reached: {outcome.code}"
        axes.annotate(
            word,
            (reach.time[-1], distance[-1]),
            xytext=(-8, 22),
            textcoords="offset points",
            ha="right",
            fontsize=10,
            weight="bold",
            arrowprops={"arrowstyle": "->", "color": "0.2"},
        )


def _force(axes: Axes, reach: ReachSeries, moments: Sequence[int]) -> None:
    load = [math.hypot(a.wrench.force.x, a.wrench.force.y) for a in reach.arm]
    axes.plot(reach.arm_time, load, lw=0.7, color="0.6", label="arm's force sensor")
    total = [t.normal_force for t in reach.touch]
    axes.plot(reach.touch_time, total, lw=0.9, color="#E69F00", label="skin, sum of normal forces")
    peak = [t.peak_force for t in reach.touch]
    axes.plot(reach.touch_time, peak, lw=1.2, color=TOUCHED, label="skin, peak")
    for number, index in enumerate(moments, 1):
        axes.annotate(
            str(number),
            (reach.touch_time[index], total[index]),
            xytext=(0, 9),
            textcoords="offset points",
            ha="center",
            fontsize=9,
            color="white",
            weight="bold",
            bbox={"boxstyle": "circle,pad=0.15", "fc": TOUCHED, "ec": "white", "lw": 0.6},
            zorder=10,
        )
    axes.set_ylabel("force, N")
    axes.set_ylim(bottom=0)
    axes.margins(y=0.15)
    axes.legend(fontsize=9, loc="upper left")
    axes.grid(alpha=0.25)


def _activity(axes: Axes, reach: ReachSeries) -> None:
    """Bars for what it did, and under them for what the safety gate did."""
    spans = _spans(reach)
    names = list(dict.fromkeys(activity for _, _, activity in spans))
    for begin, end, activity in spans:
        colour = ACTIVITIES.get(activity, OTHER)
        axes.barh(names.index(activity), max(end - begin, 0.02), left=begin, height=0.7, fc=colour)
    labels = [name.replace("_", " ") for name in names]
    for code in dict.fromkeys(c for s in reach.states for c in s.interventions):
        when = [t for t, s in zip(reach.time, reach.states, strict=True) if code in s.interventions]
        axes.plot(when, np.full(len(when), len(labels)), "|", color="black", ms=9)
        labels.append(f"gate: {code.replace('_', ' ')}")
    axes.set_yticks(range(len(labels)), labels, fontsize=9)
    axes.set_ylim(len(labels) - 0.5, -0.5)
    axes.set_xlabel("time since the reach began, s")
    axes.grid(alpha=0.25, axis="x")
