"""Picture of a reach from a log: the cupboard from above, the finger's path, and what happened."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tactile_bus.geometry import FINGER_OUTLINE, TIP_X
from tactile_bus.topics import ARM_STATE, FEATURES, REACH_EVENT, REACH_STATE, WORLD
from tactile_tools.series import LogUnreadableError, messages

if TYPE_CHECKING:
    from matplotlib.axes import Axes

ACTIVITIES = {
    "straight": "#0072B2",
    "burrow": "#009E73",
    "excavate_ccw": "#D55E00",
    "excavate_cw": "#CC79A7",
}
OTHER = "#7f7f7f"
AREA_PER_N = 26.0  # points²
SHEAR_M_PER_N = 0.004
CAPTURED = frozenset({ARM_STATE, FEATURES})
SHOWN = 10  # moments at which contacts are drawn


@dataclass(eq=False)
class ReachSeries:
    """What a log says of one reach. Times are s since the first control cycle."""

    time: list[float] = field(default_factory=list)
    states: list[Any] = field(default_factory=list)
    arm_time: list[float] = field(default_factory=list)
    arm: list[Any] = field(default_factory=list)
    touch_time: list[float] = field(default_factory=list)
    touch: list[Any] = field(default_factory=list)
    events: list[tuple[float, Any]] = field(default_factory=list)
    first_world: Any = None
    last_world: Any = None


def read_reach(path: Path) -> ReachSeries:
    """Return the reach in a log; LogUnreadableError when there is none."""
    series = ReachSeries()
    wanted = frozenset({ARM_STATE, FEATURES, REACH_EVENT, REACH_STATE, WORLD})
    start: int | None = None
    for topic, _, message in messages(path, wanted):
        if topic == WORLD:
            series.first_world = series.first_world or message
            series.last_world = message
            continue
        stamp = message.captured_ns if topic in CAPTURED else message.stamped_ns
        if start is None:
            start = stamp
        now = (int(stamp) - start) * 1e-9
        if topic == REACH_STATE:
            series.time.append(now)
            series.states.append(message)
        elif topic == ARM_STATE:
            series.arm_time.append(now)
            series.arm.append(message)
        elif topic == FEATURES:
            series.touch_time.append(now)
            series.touch.append(message)
        else:
            series.events.append((now, message))
    if not series.states or not series.arm:
        raise LogUnreadableError(
            f"{path} holds no reach: was it written by reachd or `tactile reach --log`?"
        )
    return series


def draw_reach(path: Path, out: Path) -> None:
    """Write the picture of the reach in a log."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    reach = read_reach(path)
    figure = plt.figure(figsize=(15, 9), layout="constrained")
    grid = figure.add_gridspec(3, 2, width_ratios=(1.15, 1), height_ratios=(1, 1, 0.55))
    above = figure.add_subplot(grid[:, 0])
    _cupboard(above, reach)
    distance = figure.add_subplot(grid[0, 1])
    force = figure.add_subplot(grid[1, 1], sharex=distance)
    doing = figure.add_subplot(grid[2, 1], sharex=distance)
    _distance(distance, reach)
    _force(force, reach)
    _activity(doing, reach)
    outcome = [e.code for _, e in reach.events if e.kind == "outcome"]
    figure.suptitle(
        f"{reach.states[-1].strategy}: {outcome[-1] if outcome else reach.states[-1].state}, "
        f"{reach.time[-1]:.1f} s",
        fontsize=15,
    )
    figure.savefig(out, dpi=100)
    plt.close(figure)


def _turned(points: Any, x: float, y: float, heading: float) -> Any:
    c, s = math.cos(heading), math.sin(heading)
    return np.asarray(points) @ np.array([[c, s], [-s, c]]) + (x, y)


def _cupboard(axes: Axes, reach: ReachSeries) -> None:
    """Draw from above, the cupboard's depth upwards: plotted x is −y, plotted y is x."""
    for world, style in (
        (reach.first_world, {"fill": False, "edgecolor": "0.6", "ls": "--", "lw": 0.8}),
        (reach.last_world, {"edgecolor": "0.2", "lw": 0.8}),
    ):
        for marker in world.markers if world is not None else ():
            _shape(axes, marker, style)
    x = np.array([a.x for a in reach.arm])
    y = np.array([a.y for a in reach.arm])
    heading = np.array([a.heading for a in reach.arm])
    tip = np.stack([x + TIP_X * np.cos(heading), y + TIP_X * np.sin(heading)], axis=1)
    at = np.clip(np.searchsorted(reach.time, reach.arm_time), 0, len(reach.states) - 1)
    doing = np.array([reach.states[i].activity for i in at])
    for activity in dict.fromkeys(doing.tolist()):
        colour = ACTIVITIES.get(activity, OTHER)
        chosen = doing == activity
        axes.plot(-tip[chosen, 1], tip[chosen, 0], ".", ms=2.5, color=colour, label=activity)
    for index, alpha in ((0, 0.35), (len(x) - 1, 1.0)):
        outline = _turned(FINGER_OUTLINE, x[index], y[index], heading[index])
        closed = np.vstack([outline, outline[:1]])
        axes.plot(-closed[:, 1], closed[:, 0], color="#0072B2", lw=1.6, alpha=alpha)
    _contacts(axes, reach, x, y, heading)
    goal = next((s for s in reversed(reach.states) if s.goal_radius > 0), None)
    if goal is not None:
        axes.plot(-goal.goal.y, goal.goal.x, "*", ms=16, color="#E69F00", mec="black", zorder=9)
    axes.set_aspect("equal")
    axes.set_xlabel("across the cupboard, m (right is right)")
    axes.set_ylabel("into the cupboard, m")
    axes.legend(loc="lower right", fontsize=9, title="tip's path while")
    axes.set_title("dashed: objects at the start; filled: at the end; star: target", fontsize=10)


def _shape(axes: Axes, marker: Any, style: dict[str, Any]) -> None:
    from matplotlib.patches import Circle, Polygon

    if marker.ns not in ("objects", "cupboard"):
        return
    x, y = marker.pose.position.x, marker.pose.position.y
    tone = (marker.color.r, marker.color.g, marker.color.b)
    look = style if "fill" in style else style | {"facecolor": tone, "alpha": 0.75}
    if marker.type == 3:
        axes.add_patch(Circle((-y, x), marker.scale.x / 2, **look))
        return
    yaw = 2 * math.atan2(marker.pose.orientation.z, marker.pose.orientation.w)
    a, b = marker.scale.x / 2, marker.scale.y / 2
    corners = _turned([(a, b), (-a, b), (-a, -b), (a, -b)], x, y, yaw)
    axes.add_patch(Polygon(np.stack([-corners[:, 1], corners[:, 0]], axis=1), **look))


def _contacts(axes: Axes, reach: ReachSeries, x: Any, y: Any, heading: Any) -> None:
    """Draw contacts at the strongest moments, and at the end: circles and shear arrows."""
    if not reach.touch:
        return
    peaks = np.array([t.peak_force for t in reach.touch])
    chosen: list[int] = []
    for index in np.argsort(-peaks).tolist():
        apart = all(abs(reach.touch_time[index] - reach.touch_time[k]) > 0.7 for k in chosen)
        if apart and peaks[index] > 0.2:
            chosen.append(index)
        if len(chosen) == SHOWN:
            break
    for index in {*chosen, len(reach.touch) - 1}:
        k = min(int(np.searchsorted(reach.arm_time, reach.touch_time[index])), len(x) - 1)
        for patch in reach.touch[index].patches:
            place = _turned([(patch.centroid.x, patch.centroid.y)], x[k], y[k], heading[k])[0]
            push = _turned([(patch.force.x, patch.force.y)], 0.0, 0.0, heading[k])[0]
            axes.scatter(
                -place[1],
                place[0],
                s=AREA_PER_N * patch.normal_force,
                color="#D55E00",
                alpha=0.35,
                zorder=6,
            )
            axes.annotate(
                "",
                (-(place[1] + push[1] * SHEAR_M_PER_N), place[0] + push[0] * SHEAR_M_PER_N),
                (-place[1], place[0]),
                arrowprops={"arrowstyle": "->", "color": "#A03000", "lw": 1.0},
                zorder=7,
            )


def _distance(axes: Axes, reach: ReachSeries) -> None:
    axes.plot(reach.time, [s.distance * 1e2 for s in reach.states], color="#0072B2")
    axes.set_ylabel("tip to target, cm")
    axes.set_ylim(bottom=0)
    axes.grid(alpha=0.25)
    for when, event in reach.events:
        if event.kind == "excavation" and "start" in event.text:
            axes.axvline(when, color="#D55E00", lw=1)
            axes.annotate(
                f" {event.text.partition(': ')[2]} {event.code}",
                (when, 0.5),
                rotation=90,
                va="bottom",
                fontsize=8,
            )


def _force(axes: Axes, reach: ReachSeries) -> None:
    axes.plot(reach.touch_time, [t.peak_force for t in reach.touch], lw=1, label="peak contact")
    axes.plot(reach.touch_time, [t.normal_force for t in reach.touch], lw=0.7, label="sum")
    axes.plot(
        reach.arm_time,
        [math.hypot(a.wrench.force.x, a.wrench.force.y) for a in reach.arm],
        lw=0.7,
        color="0.5",
        label="arm's sensor",
    )
    axes.set_ylabel("force, N")
    axes.legend(fontsize=8, loc="upper left")
    axes.grid(alpha=0.25)


def _activity(axes: Axes, reach: ReachSeries) -> None:
    names = list(dict.fromkeys(s.activity for s in reach.states))
    rows = [names.index(s.activity) for s in reach.states]
    axes.scatter(
        reach.time,
        rows,
        c=[ACTIVITIES.get(s.activity, OTHER) for s in reach.states],
        s=9,
        marker="s",
    )
    for row, code in enumerate(
        dict.fromkeys(c for s in reach.states for c in s.interventions), start=len(names)
    ):
        when = [t for t, s in zip(reach.time, reach.states, strict=True) if code in s.interventions]
        axes.plot(when, np.full(len(when), row), "|", color="crimson", ms=5)
        names.append(f"gate: {code}")
    axes.set_yticks(range(len(names)), names, fontsize=8)
    axes.set_ylim(len(names) - 0.5, -0.5)
    axes.set_xlabel("time, s")
    axes.grid(alpha=0.25, axis="x")
