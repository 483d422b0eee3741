"""Targets as people give them, checked before anything moves."""

from __future__ import annotations

import math

from reachd.fields import SettingError
from reachd.parameter_fields import Parameters
from reachd.seam import Goal


def parse_target(text: str) -> tuple[float, float]:
    """``X,Y`` in m in ``cupboard``; SettingError says what was given."""
    parts = text.split(",")
    try:
        x, y = (float(part) for part in parts)
    except ValueError as error:
        raise SettingError(
            f"target {text!r} is not X,Y in metres from the middle of the cupboard's front edge, "
            "such as 0.358,0.03 (x into the cupboard, y left)"
        ) from error
    return x, y


def make_goal(
    x: float,
    y: float,
    parameters: Parameters,
    *,
    radius: float | None = None,
    time_limit: float | None = None,
) -> Goal:
    """Goal of a reach with the set's radius and time limit unless given.

    SettingError for a target where the tip may not go, or a radius or time that is not positive
    and finite.
    """
    goal = Goal(
        x,
        y,
        parameters.goal_radius if radius is None else radius,
        parameters.time_limit if time_limit is None else time_limit,
    )
    for name, value, unit in (("radius", goal.radius, "m"), ("time limit", goal.time_limit, "s")):
        if not (math.isfinite(value) and value > 0.0):
            raise SettingError(f"{name} {value} {unit} is not a finite number above 0")
    if not (math.isfinite(x) and math.isfinite(y)):
        raise SettingError(f"target {x}, {y} is not finite")
    region = parameters.safety.tip_region
    if region.depth(x, y) < 0.0:
        corners = ", ".join(f"({cx:g}, {cy:g})" for cx, cy in region.corners)
        raise SettingError(
            f"target {x:g}, {y:g} m lies outside the region where the tip may go, with corners "
            f"{corners}; change the target or safety.tip_region"
        )
    return goal
