"""State of the live page, from bus messages. Pure: no clock, no bus, no thread.

`PageModel.take` is given messages, newest last; `PageModel.frame` returns everything to show as
plain values for JSON. Frames are small: forces are whole mN, and what seldom changes (geometry,
names) is in `PageModel.layout`, whose ``version`` says when it is new.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from tactile_core.bus.markers import DELETE, DELETE_ALL
from tactile_core.bus.messages import DROPS_PREFIX
from tactile_core.bus.topics import (
    AMBIENT,
    ARM_STATE,
    DIAGNOSTICS,
    FEATURES,
    FORCES,
    GEOMETRY,
    REACH_EVENT,
    REACH_STATE,
    WORLD,
    Topic,
)
from tactile_core.geometry import FINGER_OUTLINE, TIP_X
from tactile_core.types import Instant, seconds_between

SIDES = ("none", "left", "right", "tip")

HISTORY_S = 20.0
"""Length of the force curves, s, also kept for a page that is opened later."""

HISTORY_PERIOD_S = 0.03
"""Time between two points kept of it, s."""

STALE_S = 0.5
"""Time without features after which a board's values are shown as old, s."""

STALE_PERIODS = 3.0
"""The same in periods of a slow board, if that is longer."""

DIAGNOSTICS_STALE_S = 3.5
"""Time without diagnostics, which come once a second, after which they are ignored, s."""

MAX_BOARDS = 32
"""Boards on one page; when there are more, those that are gone leave it first."""

MAX_EVENTS = 40
"""Events of a reach kept for the page."""

MAX_OBJECTS = 400
"""Objects of a cupboard that are drawn."""

MAX_REASONS, MAX_TEXT = 8, 300
"""Reasons shown of a board, and characters of a text from the bus."""

STATUS_BITS = (
    (1, "saturated"),
    (2, "stale"),
    (4, "read failed"),
    (8, "frozen"),
    (16, "out of range"),
    (32, "missing"),
    (64, "implausible"),
)
"""Meaning of the bits of ``TaxelForces.status``."""

REMEDIES: Mapping[str, str] = {
    "waiting": "waiting for the board to say what it is",
    "identified": "the board is known; no samples have come yet",
    "silent": "no samples are coming: check the board and its cable",
    "unplugged": "the port is gone: plug the board in again, streaming then goes on by itself",
    "refused": "tactiled refuses this board: see `tactile status`",
    "gone": "tactiled has stopped: start it again",
    "stale": "nothing has come from tactiled: it may be stopped or the network down",
}
"""Each state of a board that is not streaming, in words with the remedy."""


@dataclass(slots=True)
class BoardModel:
    """What is known of one board."""

    name: str
    alive: bool = True
    layout: dict[str, Any] | None = None
    features: Any = None
    heard: Instant | None = None  # of the last features, by the page's clock
    forces: Any = None
    ambient: Any = None
    diagnostics: dict[str, str] = field(default_factory=dict)
    told_at: Instant | None = None
    log_state: str = ""
    history: deque[tuple[float, ...]] = field(default_factory=deque)


@dataclass(slots=True)
class ReachModel:
    """What is known of reach, arm and cupboard."""

    name: str = ""
    alive: bool = True
    state: Any = None
    heard: Instant | None = None
    arm: Any = None
    arm_heard: Instant | None = None
    objects: dict[tuple[str, int], list[Any]] = field(default_factory=dict)
    events: deque[tuple[int, dict[str, Any]]] = field(
        default_factory=lambda: deque(maxlen=MAX_EVENTS)
    )
    event_count: int = 0


class PageModel:
    """Everything that the page shows."""

    def __init__(self) -> None:
        self.boards: dict[str, BoardModel] = {}
        self.reach = ReachModel()
        self.version = 0
        """Version of `layout`; every change increases it."""

    # Input

    def take(self, topic: Topic, name: str, message: Any, now: Instant) -> None:
        """Take a decoded message of ``topic`` from ``name``, received at ``now``."""
        reach = self.reach
        if topic == REACH_STATE:
            reach.name, reach.state, reach.heard = name, message, now
        elif topic == REACH_EVENT:
            reach.event_count += 1
            reach.events.append((reach.event_count, _event(message)))
        elif topic == ARM_STATE:
            reach.arm, reach.arm_heard = message, now
        elif topic == WORLD:
            self._take_world(message)
        else:
            self._take_board(topic, self._board(name), message, now)

    def set_alive(self, name: str, alive: bool) -> None:
        """Note that a tactiled with board ``name`` has come or gone."""
        if alive or name in self.boards:
            board = self._board(name)
            if board.alive != alive:
                board.alive = alive
                self.version += 1

    def set_reach_alive(self, name: str, alive: bool) -> None:
        """Note that a reachd called ``name`` has come or gone."""
        if alive or name == self.reach.name:
            self.reach.name, self.reach.alive = name, alive

    def forget(self) -> None:
        """Forget everything but the geometry, for another place in a log."""
        for board in self.boards.values():
            layout, name = board.layout, board.name
            self.boards[name] = BoardModel(name, layout=layout)
        self.reach = ReachModel()

    def _board(self, name: str) -> BoardModel:
        board = self.boards.get(name)
        if board is None:
            if len(self.boards) >= MAX_BOARDS:
                gone = next((b.name for b in self.boards.values() if not b.alive), None)
                self.boards.pop(gone or next(iter(self.boards)))
            board = self.boards[name] = BoardModel(name)
            self.version += 1
        return board

    def _take_board(self, topic: Topic, board: BoardModel, message: Any, now: Instant) -> None:
        if topic == FEATURES:
            board.features, board.heard = message, now
        elif topic == FORCES:
            board.forces = message
        elif topic == AMBIENT:
            board.ambient = message
        elif topic == GEOMETRY:
            layout = _layout(message)
            if layout != board.layout:
                board.layout = layout
                self.version += 1
        elif topic == DIAGNOSTICS:
            board.told_at = now
            board.diagnostics, board.log_state = _read_diagnostics(message, board.name)

    def _take_world(self, message: Any) -> None:
        objects = self.reach.objects
        for marker in message.markers:
            key = (marker.ns[:MAX_TEXT], marker.id)
            if marker.action == DELETE_ALL:
                objects.clear()
            elif marker.action == DELETE:
                objects.pop(key, None)
            elif len(objects) < MAX_OBJECTS or key in objects:
                pose, q = marker.pose.position, marker.pose.orientation
                yaw = 2.0 * math.atan2(q.z, q.w)
                values = (pose.x, pose.y, yaw, marker.scale.x, marker.scale.y, marker.color.r)
                if all(math.isfinite(each) for each in values):
                    objects[key] = [key[0], marker.type, *(round(each, 4) for each in values)]

    # Output

    def layout(self) -> dict[str, Any]:
        """What seldom changes: the boards and the places of their taxels."""
        return {
            "version": self.version,
            "boards": {name: board.layout for name, board in sorted(self.boards.items())},
            "finger": [list(point) for point in FINGER_OUTLINE],
            "tip_x": TIP_X,
            "status_bits": [list(each) for each in STATUS_BITS],
            "history_s": HISTORY_S,
        }

    def history(self) -> dict[str, list[tuple[float, ...]]]:
        """Points of the last seconds' forces of each board, for a page that has just opened."""
        return {name: list(board.history) for name, board in self.boards.items()}

    def frame(self, now: Instant, wall_s: float | None = None) -> dict[str, Any]:
        """Everything that changes.

        ``now``: the page's clock. ``wall_s``: time of day to show, if any.
        """
        t = round(now * 1e-9, 4)
        frame: dict[str, Any] = {
            "t": t,
            "layout": self.version,
            "boards": {name: _board_frame(b, now, t) for name, b in sorted(self.boards.items())},
            "reach": self._reach_frame(now),
        }
        if wall_s is not None:
            frame["wall"] = wall_s
        return frame

    def _reach_frame(self, now: Instant) -> dict[str, Any] | None:
        reach = self.reach
        if reach.state is None and reach.arm is None and not reach.objects:
            return None
        frame: dict[str, Any] = {
            "name": reach.name,
            "alive": reach.alive,
            "objects": list(reach.objects.values()),
            "events": [{"n": number} | event for number, event in reach.events],
            "arm": None,
            "state": None,
        }
        arm, state = reach.arm, reach.state
        if arm is not None and reach.arm_heard is not None:
            frame["arm"] = {
                "x": _number(arm.x), "y": _number(arm.y), "heading": _number(arm.heading),
                "mode": arm.mode[:MAX_TEXT],
                "force": _number(math.hypot(arm.wrench.force.x, arm.wrench.force.y), 3),
                "age": round(seconds_between(reach.arm_heard, now), 3),
            }  # fmt: skip
        if state is not None and reach.heard is not None:
            frame["state"] = {
                "state": state.state[:MAX_TEXT],
                "activity": state.activity[:MAX_TEXT],
                "strategy": state.strategy[:MAX_TEXT],
                "goal": [_number(state.goal.x), _number(state.goal.y), _number(state.goal_radius)],
                "distance": _number(state.distance),
                "elapsed": _number(state.elapsed, 2),
                "commanded": _twist(state.commanded),
                "wanted": _twist(state.wanted),
                "armed": bool(state.armed),
                "held": state.held[:MAX_TEXT],
                "interventions": [each[:MAX_TEXT] for each in state.interventions[:MAX_REASONS]],
                "age": round(seconds_between(reach.heard, now), 3),
            }
        return frame


def _board_frame(board: BoardModel, now: Instant, t: float) -> dict[str, Any]:
    diagnostics = board.diagnostics
    fresh = board.told_at is not None and seconds_between(board.told_at, now) < DIAGNOSTICS_STALE_S
    rate = _float(diagnostics.get("rate_hz")) if fresh else None
    age = None if board.heard is None else seconds_between(board.heard, now)
    limit = max(STALE_S, STALE_PERIODS / rate) if rate else STALE_S
    state = _state(board, age, limit, fresh)
    features = board.features
    reasons: list[str] = []
    if state == "streaming" and features is not None:
        reasons = [text[:MAX_TEXT] for text in features.reasons[:MAX_REASONS]]
    elif state in REMEDIES:
        refusal = diagnostics.get("refused", "") if state == "refused" else ""
        reasons = [refusal or REMEDIES[state]]
    if fresh and diagnostics.get("alarms"):
        reasons.append(diagnostics["alarms"][:MAX_TEXT])
    live = state == "streaming"
    frame: dict[str, Any] = {
        "state": state,
        "age": None if age is None else round(age, 2),
        "valid": bool(live and features is not None and features.valid),
        "reasons": reasons,
        "rate": rate,
        "latency": _float(diagnostics.get("latency_p50_s")) if fresh else None,
        "drops": _drops(diagnostics),
        "recording": _recording(diagnostics) if fresh else None,
        "log": board.log_state,
        "nominal": None if features is None else not features.calibrated,
        "force": None if features is None else _force(features),
        "taxels": None if board.forces is None else _taxels(board.forces),
        "ambient": None if board.ambient is None else _ambient(board.ambient),
    }
    if live and features is not None:
        _remember(board, frame["force"], t)
    return frame


def _state(board: BoardModel, age: float | None, limit: float, fresh: bool) -> str:
    """State of a board as the page shows it."""
    if not board.alive:
        return "gone"
    reported = board.diagnostics.get("state", "") if fresh else ""
    if age is not None and age < limit and reported in ("", "streaming", "identified", "waiting"):
        return "streaming"
    if reported and reported != "streaming":
        return reported if reported in REMEDIES else "waiting"
    if reported == "streaming" and age is None:
        return "identified"
    return "stale" if age is not None or board.told_at is not None else "waiting"


def _remember(board: BoardModel, force: Mapping[str, Any], t: float) -> None:
    """Keep a point of force for pages that are opened later."""
    history = board.history
    if history and t < history[-1][0]:
        history.clear()  # a jump to another place of a log
    if history and t - history[-1][0] < HISTORY_PERIOD_S:
        return
    sides = force["sides"]
    history.append((t, force["normal"], *(sides.get(side, 0.0) for side in SIDES[1:])))
    while history[0][0] < t - HISTORY_S:
        history.popleft()


def _force(features: Any) -> dict[str, Any]:
    sides: dict[str, float] = {}
    patches = []
    for patch in features.patches:
        side = SIDES[patch.side] if patch.side < len(SIDES) else SIDES[0]
        sides[side] = _number(sides.get(side, 0.0) + patch.normal_force) or 0.0
        force, centroid = patch.force, patch.centroid
        patches.append(
            {
                "array": patch.array,
                "n": _number(patch.normal_force),
                "f": [_number(force.x, 3), _number(force.y, 3), _number(force.z, 3)],
                "c": [_number(centroid.x), _number(centroid.y), _number(centroid.z)],
            }
        )
    return {
        "seq": features.sequence,
        "normal": _number(features.normal_force) or 0.0,
        "bound": _number(getattr(features, "normal_force_bound", math.nan)),
        "peak": _number(features.peak_force) or 0.0,
        "peak_bound": _number(getattr(features, "peak_force_bound", math.nan)),
        "peak_side": SIDES[features.peak_side] if features.peak_side < len(SIDES) else SIDES[0],
        "tip": _number(features.tip_force) or 0.0,
        "wrench": [
            _number(each, 3)
            for vector in (features.wrench.force, features.wrench.torque)
            for each in (vector.x, vector.y, vector.z)
        ],
        "contact": features.taxels_in_contact,
        "masked": features.taxels_masked,
        "sides": sides,
        "patches": patches,
        "uncertainty": _number(features.uncertainty, 6),
    }


def _taxels(forces: Any) -> dict[str, Any]:
    """Force and bound of each taxel in whole mN, and the masked taxels with their bits."""
    status = np.asarray(forces.status)
    masked = np.flatnonzero(status)
    bound = getattr(forces, "normal_bound", None)
    return {
        "seq": forces.sequence,
        "f": _millinewtons(forces.force),
        "b": [] if bound is None else _millinewtons(bound, unknown=-1),
        "masked": [[int(i), int(status[i])] for i in masked.tolist()],
        "compensated": bool(forces.compensated),
    }


def _millinewtons(values: Any, unknown: int = 0) -> list[int]:
    """Round newtons to whole mN; ``unknown`` where a value is not finite or beyond 1 MN."""
    array = np.asarray(values, np.float64) * 1e3
    good = np.abs(array) < 1e9  # False for NaN
    whole = np.where(good, np.rint(np.where(good, array, 0.0)), unknown)
    found: list[int] = whole.astype(int).tolist()
    return found


def _ambient(ambient: Any) -> dict[str, Any]:
    """Strength of the removed field at each array's centre, µT."""
    plane = np.asarray(ambient.plane, np.float64)
    centres = plane.reshape(-1, 3, 3)[:, :, 0] if plane.size % 9 == 0 else np.zeros((0, 3))
    strength = np.linalg.norm(centres, axis=1)
    return {
        "method": ambient.method[:MAX_TEXT],
        "ut": [_number(float(each), 1) for each in strength],
        "support": [_number(float(each), 2) for each in ambient.support],
        "valid": [bool(each) for each in ambient.valid],
    }


def _layout(message: Any) -> dict[str, Any]:
    """Arrays with the places of their taxels on the unrolled skin, mm."""
    rows = np.asarray(message.array_rows, int).tolist()
    columns = np.asarray(message.array_columns, int).tolist()
    surface = np.asarray(message.surface, np.float64).reshape(-1, 2) * 1e3
    posed = getattr(message, "array_posed", ())
    arrays, start = [], 0
    for i, name in enumerate(message.array_name):
        size = rows[i] * columns[i]
        points = surface[start : start + size]
        if len(points) != size or not np.isfinite(points).all():
            points = _grid(rows[i], columns[i])
        side = int(message.array_side[i])
        arrays.append(
            {
                "name": name[:MAX_TEXT],
                "side": SIDES[side] if side < len(SIDES) else SIDES[0],
                "first": start,
                "posed": bool(posed[i]) if i < len(posed) else True,
                "xy": np.round(points, 2).tolist(),
            }
        )
        start += size
    return {
        "model": message.model[:MAX_TEXT],
        "serial": message.serial_number[:MAX_TEXT],
        "taxels": start,
        "arrays": arrays,
    }


def _grid(rows: int, columns: int) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Places for taxels whose own are unknown: a grid of 10 mm."""
    x, y = np.meshgrid(np.arange(columns) * 10.0, np.arange(rows) * 10.0)
    return np.stack([x, y], axis=-1).reshape(-1, 2)


def _read_diagnostics(message: Any, name: str) -> tuple[dict[str, str], str]:
    """Values of a board's diagnostics, and the state of its log ("" if it has none)."""
    values: dict[str, str] = {}
    log_state = ""
    for status in message.status:
        if status.name == f"tactiled/{name}/log":
            log_state = status.message[:MAX_TEXT]
        elif status.name == f"tactiled/{name}" or not values:
            values = {pair.key: pair.value[:MAX_TEXT] for pair in status.values}
    return values, log_state


def _drops(diagnostics: Mapping[str, str]) -> dict[str, int]:
    counts = {
        key.removeprefix(DROPS_PREFIX): _float(value) or 0.0
        for key, value in diagnostics.items()
        if key.startswith(DROPS_PREFIX)
    }
    return {key: int(value) for key, value in counts.items() if value}


def _recording(diagnostics: Mapping[str, str]) -> dict[str, Any] | None:
    if diagnostics.get("recording.recording") != "True":
        return None
    return {
        "path": diagnostics.get("recording.path", ""),
        "seconds": _float(diagnostics.get("recording.seconds")),
        "messages": _float(diagnostics.get("recording.messages")),
        "dropped": _float(diagnostics.get("recording.dropped")),
        "state": diagnostics.get("recording.state", ""),
    }


def _event(message: Any) -> dict[str, Any]:
    return {
        "t": round(message.stamped_ns * 1e-9, 2),
        "kind": message.kind[:MAX_TEXT],
        "code": message.code[:MAX_TEXT],
        "text": message.text[:MAX_TEXT],
    }


def _twist(twist: Any) -> list[float | None]:
    return [_number(twist.linear.x), _number(twist.linear.y), _number(twist.angular.z)]


def _number(value: float, digits: int = 4) -> float | None:
    """Round a number; None for one that JSON cannot hold."""
    return round(float(value), digits) if math.isfinite(value) else None


def _float(text: str | None) -> float | None:
    """Parse a number of the diagnostics, which are texts."""
    try:
        value = float(text or "")
    except ValueError:
        return None
    return value if math.isfinite(value) else None
