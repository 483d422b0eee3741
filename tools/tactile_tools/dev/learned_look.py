"""Write the picture and the figures of docs/learned.md: what `learned` does, and what it looks at.

``python -m tactile_tools.dev.learned_look`` runs `learned` and `hybrid_event` in the same scenes,
in MuJoCo with exact contacts, draws five of them side by side, and asks of every group of what the
network sees how much its residual changes when that group is exchanged for that of other moments.
"""

from __future__ import annotations

import argparse
import json
import math
from collections import defaultdict
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Polygon
from numpy.typing import NDArray

from reachd.strategies.learned import Learned, load_policy
from reachd.strategies.memory import FELT, LAGS, PLACED, PRESENT, RECORD, Rows
from reachd.strategies.parameter_fields import Parameters
from reachd.strategies.parameters import parameters
from sim_device.world.mujoco_world import MujocoWorld
from sim_device.world.scene_generation import generate
from sim_device.world.scenes import Scene, Shape
from tactile_core.geometry import TIP_X, Side
from tactile_tools.reach.lockstep import Result, Step, run_trial

FIRST_SEED: Final = 730_000
"""Scenes that are neither trained on, nor chosen by, nor judged on."""

LOADED_N: Final = 4.5
"""Summed normal force from which the finger counts as loaded: that of a jam of quick_sweep."""

PRESENT_AT: Final = RECORD + PRESENT


def _groups() -> dict[str, list[int]]:
    """Columns of an observation by what they tell."""
    start = RECORD
    groups = {
        "forces now": [0, 1, 2, 8],
        "place of the contact now": [3, 4],
        "skin's wrench now": [5, 6, 7],
        "own motion and action just before": list(range(len(FELT), RECORD)),
        "goal, distance, heading": [start + k for k in (0, 1, 2, 3, 4, 5, 8, 9)],
        "place in the cupboard": [start + 6, start + 7],
        "time left, closest so far": [start + 10, start + 11],
        "what quick_sweep is doing": [start + 12, start + 13, start + 14],
    }
    for name, low, high in (("0.1 to 0.5 s", 1, 5), ("0.8 to 2.3 s", 6, 23), ("3 to 8 s", 30, 80)):
        lags = [k for k, lag in enumerate(LAGS) if low <= lag <= high]
        columns = [PRESENT_AT + k * PLACED + c for k in lags for c in range(PLACED)]
        groups[f"memory of {name} ago"] = columns
    return groups


class Watched(Learned):
    """`Learned` that keeps what it saw and added."""

    kept: Final[list[tuple[Rows, NDArray[Any]]]] = []
    residual_now: NDArray[Any] = np.zeros(3)

    def __init__(self, parameters: Parameters, rng: np.random.Generator) -> None:
        super().__init__(parameters, rng)
        policy = self._policy

        def keep(seen: Rows) -> Rows:
            residual = policy(seen)
            self.kept.append((seen, residual[0]))
            Watched.residual_now = residual[0]
            return residual

        self._policy = keep


@dataclass
class Track:
    """One reach: rows of tip x, y, heading, summed force, residual (3), time; and its result."""

    scene: Scene
    before: NDArray[Any]
    after: NDArray[Any]
    rows: NDArray[Any]
    activities: list[str]
    contacts: NDArray[Any] = field(repr=False)  # x, y in ``cupboard``, N
    result: Result = field(repr=False, kw_only=True)


def track(strategy: str, seed: int) -> Track:
    """Run ``strategy`` in scene ``seed``, and keep its way."""
    scene = generate("authors_sim", seed)
    world = MujocoWorld(scene)
    before = np.array(world.poses())
    rows: list[tuple[float, ...]] = []
    activities: list[str] = []
    contacts: list[tuple[float, float, float]] = []
    Watched.residual_now = np.zeros(3)

    def watch(step: Step) -> None:
        arm, touch = step.arm, step.touch
        c, s = math.cos(arm.heading), math.sin(arm.heading)
        total = 0.0 if touch is None else touch.total_force
        own = Watched.residual_now if strategy != "hybrid_event" else np.zeros(3)
        tip = (arm.x + TIP_X * c, arm.y + TIP_X * s)
        rows.append((*tip, arm.heading, total, *own, len(rows) * 0.01))
        activities.append(step.control.status.activity)
        if touch is not None and touch.peak_side != Side.NONE and touch.peak_force > 2.0:
            x = arm.x + c * touch.peak_x - s * touch.peak_y
            y = arm.y + s * touch.peak_x + c * touch.peak_y
            contacts.append((x, y, touch.peak_force))

    result = run_trial(
        scene, strategy, parameters(scene.parameters), seed, world=world, watch=watch
    )
    return Track(
        scene, before, np.array(world.poses()), np.array(rows), activities,
        np.array(contacts).reshape(-1, 3), result=result,
    )  # fmt: skip


def _shape(item: Any, pose: Any, **look: Any) -> Any:
    x, y, yaw = pose
    if item.shape is Shape.DISC:
        return Circle((y, x), item.radius, **look)
    c, s = math.cos(yaw), math.sin(yaw)
    a, b = item.size_x / 2, item.size_y / 2
    corners = [(u, v) for u, v in ((-a, -b), (a, -b), (a, b), (-a, b))]
    return Polygon([(y + s * u + c * v, x + c * u - s * v) for u, v in corners], **look)


COLOURS: Final = {
    "straight": "tab:blue", "burrow": "tab:green", "excavate": "tab:red", "sweep": "tab:orange",
    "residual": "tab:purple", "waiting": "0.5",
}  # fmt: skip


def _draw(axes: Any, found: Track, title: str) -> None:
    """The cupboard from above, front edge below; before in outline, after in grey."""
    for item, old, new in zip(found.scene.objects, found.before, found.after, strict=True):
        axes.add_patch(_shape(item, old, fill=False, ec="0.75", lw=0.5, ls=":"))
        if np.isfinite(new).all():
            axes.add_patch(_shape(item, new, fc="0.9", ec="0.5", lw=0.6))
    tip = found.rows[:, :2]
    families = [a.partition("_")[0] for a in found.activities]
    start = 0
    for k in range(1, len(families) + 1):
        if k == len(families) or families[k] != families[start]:
            part = tip[start : k + 1]
            axes.plot(part[:, 1], part[:, 0], color=COLOURS.get(families[start], "k"), lw=1.3)
            start = k
    if len(found.contacts):
        some = found.contacts[::25]
        axes.scatter(some[:, 1], some[:, 0], s=some[:, 2], color="k", alpha=0.25, lw=0, zorder=3)
    strong = [k for k in range(0, len(tip), 30) if np.hypot(*found.rows[k, 4:6]) >= 0.3]
    if strong:
        heading, ahead, aside = found.rows[strong, 2], found.rows[strong, 4], found.rows[strong, 5]
        dx = np.cos(heading) * ahead - np.sin(heading) * aside
        dy = np.sin(heading) * ahead + np.cos(heading) * aside
        axes.quiver(
            tip[strong, 1], tip[strong, 0], dy, dx, color="tab:purple", angles="xy",
            scale_units="xy", scale=25, width=0.004, headwidth=3, zorder=4,
        )  # fmt: skip
    axes.plot(found.scene.goal[1], found.scene.goal[0], "*", color="tab:red", ms=9, zorder=5)
    half = found.scene.width / 2
    axes.plot([half, half, -half, -half], [0, found.scene.depth, found.scene.depth, 0], "k", lw=1)
    axes.set(xlim=(half + 0.01, -half - 0.01), ylim=(-0.05, found.scene.depth + 0.01))
    axes.set_aspect("equal")
    axes.set_xticks([])
    axes.set_yticks([])
    outcome = found.result.outcome
    end = f"arrived, {outcome.time:.1f} s" if outcome.success else "did not arrive"
    axes.set_title(f"{title}: {end}", fontsize=8)


def picture(pairs: list[tuple[Track, Track]], out: Path) -> None:
    """Five scenes, a row each: hybrid_event on the left, learned on the right."""
    figure = Figure(figsize=(7.0, 2.7 * len(pairs)), layout="constrained")
    grid = figure.subplots(len(pairs), 2, squeeze=False)
    for row, (event, learned) in zip(grid, pairs, strict=True):
        _draw(row[0], event, f"scene {event.scene.seed}, hybrid_event")
        _draw(row[1], learned, f"scene {event.scene.seed}, learned")
    lines = [
        figure.axes[0].plot([], [], color=colour, label=name)[0]
        for name, colour in COLOURS.items()
        if name != "waiting"
    ]
    figure.legend(handles=lines, loc="outside lower center", ncols=5, fontsize=8)
    figure.savefig(out, dpi=110)


def importance(kept: list[tuple[Rows, NDArray[Any]]], rng: np.random.Generator) -> dict[str, float]:
    """Mean change of the residual (norm) when a group is exchanged for that of another moment.

    Of moments under load; relative to what exchanging everything changes.
    """
    seen = np.concatenate([one for one, _ in kept])
    loaded = np.expm1(seen[:, 0]) * 2.0 >= LOADED_N
    seen = seen[loaded]
    policy = load_policy()
    own = policy(seen)
    order = rng.permutation(len(seen))
    whole = np.linalg.norm(policy(seen[order]) - own, axis=1).mean()
    found = {}
    for name, columns in _groups().items():
        other = seen.copy()
        other[:, columns] = seen[order][:, columns]
        found[name] = round(float(np.linalg.norm(policy(other) - own, axis=1).mean() / whole), 3)
    return dict(sorted(found.items(), key=lambda item: -item[1]))


def habits(tracks: list[Track]) -> dict[str, float]:
    """How the finger moves under load, over all ``tracks``."""
    rows = np.concatenate([t.rows for t in tracks])
    goals = np.concatenate([np.tile(t.scene.goal, (len(t.rows), 1)) for t in tracks])
    loaded = rows[:, 3] >= LOADED_N
    bearing = np.arctan2(goals[:, 1] - rows[:, 1], goals[:, 0] - rows[:, 0])
    error = np.abs(np.angle(np.exp(1j * (bearing - rows[:, 2]))))
    turning = np.abs(np.gradient(rows[:, 2])) / 0.01
    away = np.hypot(goals[:, 0] - rows[:, 0], goals[:, 1] - rows[:, 1]) > 0.02
    here = loaded & away & (turning < 2.0)
    residual = rows[here, 4:7]
    return {
        "share_of_time_loaded": round(float(loaded.mean()), 3),
        "turn_rate_loaded_rad_s": round(float(turning[here].mean()), 3),
        "off_the_goal_loaded_deg": round(float(np.degrees(error[here].mean())), 1),
        "residual_ahead_loaded": round(float(residual[:, 0].mean()), 3),
        "residual_aside_loaded_abs": round(float(np.abs(residual[:, 1]).mean()), 3),
        "residual_turn_loaded_abs": round(float(np.abs(residual[:, 2]).mean()), 3),
    }


def main() -> None:
    """Run, draw and write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", type=int, default=30)
    parser.add_argument("--picture", type=Path, default=Path("docs/pictures/learned.png"))
    parser.add_argument("--out", type=Path, default=Path("docs/results/learned.json"))
    options = parser.parse_args()
    watched = f"{Watched.__module__}:Watched"
    if Watched.__module__ == "__main__":
        watched = "tactile_tools.dev.learned_look:Watched"
    from tactile_tools.dev import learned_look as own

    pairs = []
    for seed in range(FIRST_SEED, FIRST_SEED + options.scenes):
        pairs.append((own.track("hybrid_event", seed), own.track(watched, seed)))
        print(seed, [t.result.outcome.text for t in pairs[-1]], flush=True)
    kinds: dict[tuple[bool, bool], list[Any]] = defaultdict(list)
    for pair in pairs:
        kinds[pair[0].result.outcome.success, pair[1].result.outcome.success].append(pair)
    chosen = [*kinds[False, True][:3], *kinds[True, True][:1], *kinds[False, False][:1]]
    chosen += [pair for pair in pairs if all(pair is not c for c in chosen)][: 5 - len(chosen)]
    picture(chosen, options.picture)
    result = {
        "scenes": [FIRST_SEED, FIRST_SEED + options.scenes - 1],
        "arrived": {
            name: sum(pair[k].result.outcome.success for pair in pairs)
            for k, name in enumerate(("hybrid_event", "learned"))
        },
        "habits": {
            name: habits([pair[k] for pair in pairs])
            for k, name in enumerate(("hybrid_event", "learned"))
        },
        "importance": importance(own.Watched.kept, np.random.default_rng(0)),
        "weights": {key: value for key, value in load_policy().about.items() if key != "settings"},
    }
    options.out.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    print(json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
