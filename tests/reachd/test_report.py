"""Texts and JSON of an outcome."""

from __future__ import annotations

import io
import json
import math

from rich.console import Console

from reachd.interfaces import Goal
from reachd.publish import as_json, last_line, show
from reachd.trial import Excavation, Outcome, Reason

GOAL = Goal(0.358, 0.03, 0.0075, 40.0)
ABOUT = {"strategy": "hybrid_event", "set": "hardware", "seed": 7}
OUTCOME = Outcome(
    success=True,
    reason=Reason.REACHED,
    text="reached within 7.4 mm after 12.30 s",
    distance=0.0074,
    closest=0.0071,
    time=12.3,
    peak_force=6.25,
    peak_load=8.0,
    excavations=(
        Excavation("ccw", "stall", 3.0),
        Excavation("cw", "push", 8.0),
        Excavation("ccw", "push", 11.0),
    ),
    interventions={"wrench": 2, "acceleration": 5},
)
NEVER = Outcome(False, Reason.HELD, "why", math.nan, math.inf, 0.0, 0.0, 0.0, (), {})


def test_last_line_summarises_the_outcome() -> None:
    assert last_line(OUTCOME) == (
        "REACHED: 7.4 mm from the target, 12.30 s, peak force 6.2 N, excavations "
        "3 (2 ccw, 1 cw; 1 by stall, 2 by push), interventions acceleration 5, wrench 2"
    )
    assert last_line(NEVER).startswith("NOT REACHED (held): unknown distance from the target")


def test_table_ends_with_the_last_line() -> None:
    file = io.StringIO()
    show(Console(file=file, width=60), OUTCOME, GOAL, ABOUT)
    assert file.getvalue().splitlines()[-1] == last_line(OUTCOME)


def test_report_is_valid_json_for_any_numbers() -> None:
    found = json.loads(as_json(OUTCOME, GOAL, ABOUT))
    assert found["goal"] == {"x": 0.358, "y": 0.03, "radius": 0.0075, "time_limit": 40.0}
    assert (found["success"], found["reason"], found["seed"]) == (True, "reached", 7)
    assert found["excavations"][1] == {"direction": "cw", "trigger": "push", "at": 8.0}
    assert found["interventions"] == {"wrench": 2, "acceleration": 5}
    assert json.loads(as_json(NEVER, GOAL, ABOUT))["distance"] is None
    assert "NaN" not in as_json(NEVER, GOAL, ABOUT)
