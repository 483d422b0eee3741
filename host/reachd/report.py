"""The outcome of a reach, for people and for programs."""

from __future__ import annotations

import json
import math
from typing import Any

from rich.console import Console
from rich.table import Table

from reachd.outcome import Outcome
from reachd.seam import Goal

DIRECTIONS = ("ccw", "cw")


def as_json(outcome: Outcome, goal: Goal, about: dict[str, Any]) -> str:
    """One JSON object: ``about`` (strategy, set, seed), goal and outcome. m, s, N."""
    values = about | {
        "goal": {"x": goal.x, "y": goal.y, "radius": goal.radius, "time_limit": goal.time_limit},
        "success": outcome.success,
        "reason": str(outcome.reason),
        "text": outcome.text,
        "distance": _finite(outcome.distance),
        "closest": _finite(outcome.closest),
        "time": outcome.time,
        "peak_force": outcome.peak_force,
        "peak_load": outcome.peak_load,
        "excavations": [
            {"direction": e.direction, "trigger": e.trigger, "at": e.at}
            for e in outcome.excavations
        ],
        "interventions": outcome.interventions,
    }
    return json.dumps(values)


def excavations(outcome: Outcome) -> str:
    """Excavations by direction and trigger."""
    count = len(outcome.excavations)
    if not count:
        return "none"
    directions = [f"{outcome.count(direction=d)} {d}" for d in DIRECTIONS]
    names = dict.fromkeys(e.trigger for e in outcome.excavations)
    triggers = [f"{outcome.count(trigger=t)} by {t}" for t in names]
    return f"{count} ({', '.join(directions)}; {', '.join(triggers)})"


def interventions(outcome: Outcome) -> str:
    """Interventions by code, the most frequent first."""
    ordered = sorted(outcome.interventions.items(), key=lambda item: -item[1])
    return ", ".join(f"{code} {n}" for code, n in ordered) or "none"


def last_line(outcome: Outcome) -> str:
    """All that matters, in one line."""
    word = "REACHED" if outcome.success else f"NOT REACHED ({outcome.reason})"
    return (
        f"{word}: {_mm(outcome.distance)} from the target, {outcome.time:.2f} s, peak force "
        f"{outcome.peak_force:.1f} N, excavations {excavations(outcome)}, interventions "
        f"{interventions(outcome)}"
    )


def show(console: Console, outcome: Outcome, goal: Goal, about: dict[str, Any]) -> None:
    """Print the table and the last line."""
    table = Table(show_header=False, box=None, padding=(0, 2), title_justify="left")
    table.add_row("strategy", f"{about['strategy']}, set {about['set']}, seed {about['seed']}")
    table.add_row("target", f"{goal.x:g}, {goal.y:g} m, radius {_mm(goal.radius)}")
    table.add_row("ended", outcome.text or str(outcome.reason))
    table.add_row("distance", f"{_mm(outcome.distance)}, closest {_mm(outcome.closest)}")
    table.add_row("time", f"{outcome.time:.2f} s of {goal.time_limit:g}")
    table.add_row(
        "peak force", f"{outcome.peak_force:.1f} N at a taxel, {outcome.peak_load:.1f} N at the arm"
    )
    if about.get("note"):
        table.add_row("", about["note"])
    table.add_row("excavations", excavations(outcome))
    table.add_row("interventions", interventions(outcome))
    console.print(table, highlight=False, markup=False)
    console.print(last_line(outcome), highlight=False, markup=False, soft_wrap=True)


def _mm(metres: float) -> str:
    return f"{metres * 1e3:.1f} mm" if math.isfinite(metres) else "unknown distance"


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
