"""One reach of a log: states, arm, touch, events, and the world before and after."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactile_core.arrays import FloatArray
from tactile_core.bus.topics import ARM_STATE, FEATURES, REACH_EVENT, REACH_STATE, WORLD
from tactile_core.geometry import TIP_X, finger
from tactile_tools.log.terminal import ToolError
from tactile_tools.plot.curves import HOLE_PERIODS, period, presses
from tactile_tools.plot.series import LogUnreadableError, messages

WANTED = frozenset({ARM_STATE, FEATURES, REACH_EVENT, REACH_STATE, WORLD})
UNDER_WAY = frozenset({"homing", "reaching"})

MAX_POINTS = 200_000
"""Messages kept of each kind: half an hour of control cycles, far longer than a reach."""


@dataclass(frozen=True, slots=True)
class Contact:
    """One contact patch. ``place`` (2,) m and ``shear`` (2,) N in ``cupboard``; ``normal``, N.

    ``shear`` is the part of the in-plane force that acts along the skin.
    """

    place: FloatArray
    normal: float
    shear: FloatArray


@dataclass(frozen=True, slots=True)
class ReachSummary:
    """A reach in the log: its name, its strategy, and how it ended ("" if unknown)."""

    name: str
    strategy: str
    outcome: str


@dataclass(eq=False)
class ReachSeries:
    """What a log says of one reach. Times are seconds since the reach began.

    ``number``: among all in the log, from 1. ``arms``, ``boards``: those heard meanwhile;
    ``arm_name`` and ``board_name`` are drawn. ``left_out``: number of messages beyond `MAX_POINTS`.
    """

    start_ns: int
    first_world: Any
    name: str = "reach"
    number: int = 1
    time: list[float] = field(default_factory=list)
    states: list[Any] = field(default_factory=list)
    events: list[tuple[float, Any]] = field(default_factory=list)
    last_world: Any = None
    ended: bool = False
    arms: dict[str, tuple[list[float], list[Any]]] = field(default_factory=dict)
    boards: dict[str, tuple[list[float], list[Any]]] = field(default_factory=dict)
    arm_name: str = ""
    board_name: str = ""
    all_reaches: tuple[ReachSummary, ...] = ()
    left_out: int = 0
    newest: Any = None

    def is_over(self, state: Any) -> bool:
        """Whether ``state`` belongs to a later reach, the end of this one being lost in a hole."""
        last = self.newest
        return (
            last is not None
            and state.state == last.state
            and state.stamped_ns > last.stamped_ns
            and state.elapsed < last.elapsed
        )

    @property
    def arm_time(self) -> list[float]:
        """Times of `arm`, s."""
        return self.arms[self.arm_name][0]

    @property
    def arm(self) -> list[Any]:
        """States of the arm that is drawn."""
        return self.arms[self.arm_name][1]

    @property
    def touch_time(self) -> list[float]:
        """Times of `touch`, s."""
        return self.boards.get(self.board_name, ([], []))[0]

    @property
    def touch(self) -> list[Any]:
        """Features of the board that is drawn; empty where nothing was felt or logged."""
        return self.boards.get(self.board_name, ([], []))[1]

    def outcome(self) -> Any:
        """The event that says how the reach ended; None when the log was cut off before."""
        return next((e for _, e in self.events if e.kind == "outcome"), None)

    def excavations(self) -> list[tuple[float, str]]:
        """Time of the start of each excavation, s, and its kind, such as "cw stall"."""
        return [
            (when, event.text)
            for when, event in self.events
            if event.kind == "excavation" and event.code == "excavation_start"
        ]

    def pose_at(self, when: float) -> tuple[float, float, float]:
        """Pose of the wrist pivot at ``when``: x, y in m, heading in rad."""
        k = min(int(np.searchsorted(self.arm_time, when)), len(self.arm) - 1)
        arm = self.arm[k]
        return float(arm.x), float(arm.y), float(arm.heading)

    def placed(self) -> NDArray[np.bool_]:
        """Whether the arm's place is known at each of `touch`, outside holes of its states."""
        times, asked = np.asarray(self.arm_time), np.asarray(self.touch_time)
        if not len(asked):
            return np.zeros(0, bool)
        after = np.clip(np.searchsorted(times, asked), 0, len(times) - 1)
        before = np.clip(after - 1, 0, None)
        away = np.minimum(np.abs(times[after] - asked), np.abs(times[before] - asked))
        return np.asarray(away <= max(HOLE_PERIODS * period(times), 0.02))

    def tip(self) -> FloatArray:
        """Path of the tip, (arm states, 2) m."""
        poses = np.array([(a.x, a.y, a.heading) for a in self.arm])
        ahead = np.stack([np.cos(poses[:, 2]), np.sin(poses[:, 2])], axis=1)
        return np.asarray(poses[:, :2] + TIP_X * ahead)

    def contacts_at(self, index: int) -> list[Contact]:
        """Contact patches of the features at ``index``, placed where the finger was then."""
        x, y, heading = self.pose_at(self.touch_time[index])
        found = []
        for patch in self.touch[index].patches:
            centre = np.array([patch.centroid.x, patch.centroid.y])
            force = np.array([patch.force.x, patch.force.y])
            outward = _outward(centre)
            shear = force - (force @ outward) * outward
            found.append(
                Contact(
                    turned(centre, x, y, heading),
                    float(patch.normal_force),
                    turned(shear, 0.0, 0.0, heading),
                )
            )
        return found

    def moments(self, most: int, least_n: float) -> list[int]:
        """Indices of the strongest moments of touch, each of another press, in order of time.

        Moments below ``least_n`` and those at which the arm's place is unknown are left out.
        """
        sides = 1 + max((p.side for t in self.touch for p in t.patches), default=0)
        force = np.zeros((len(self.touch), sides))
        for index, known in enumerate(self.placed()):
            if known:
                for patch in self.touch[index].patches:
                    force[index, patch.side] += max(float(patch.normal_force), 0.0)
        return presses(self.touch_time, force, least_n, most)


_SKIN = finger()
_PLACES = np.concatenate([a.position[:, :2] for a in _SKIN.arrays])
_NORMALS = np.concatenate([a.rotation[:, :2, 2] for a in _SKIN.arrays])


def _outward(place: FloatArray) -> FloatArray:
    """Unit normal (2,) of the skin in ``ee`` at the taxel nearest to ``place`` (m, ``ee``)."""
    nearest = int(((_PLACES - place) ** 2).sum(axis=1).argmin())
    return np.asarray(_NORMALS[nearest] / np.linalg.norm(_NORMALS[nearest]))


def turned(points: Any, x: float, y: float, heading: float) -> FloatArray:
    """Return ``points`` (..., 2), turned by ``heading`` (rad) and then moved by ``x``, ``y``."""
    c, s = math.cos(heading), math.sin(heading)
    return np.asarray(np.asarray(points) @ np.array([[c, s], [-s, c]]) + (x, y))


def read_reach(
    path: Path | Sequence[Path],
    number: int | None = None,
    board: str | None = None,
    arm: str | None = None,
) -> ReachSeries:
    """Return one reach of a log: number ``number`` from 1 in order of beginning, else the last.

    ``board``, ``arm``: whose features and states to draw; by default those with the most messages.
    LogUnreadableError when the log holds no reach, ToolError when it does not hold this one.
    """
    reader = _Reader(number)
    for topic, name, message in messages(path, WANTED):
        reader.take(topic, name, message)
    first = path if isinstance(path, Path) else path[0]
    series = reader.chosen
    summaries = tuple(reader.summaries)
    if not summaries:
        raise LogUnreadableError(
            f"{first} holds no reach: was it written by reachd or `tactile reach --log`?"
        )
    if series is None:
        raise ToolError(
            f"no reach {number} in the log; it holds {len(summaries)}:\n{listed(summaries)}"
        )
    if not series.arms:
        raise LogUnreadableError(
            f"{first} holds no states of an arm during reach {series.number}, so that it is not "
            "known where the finger was: was the arm's topic logged?"
        )
    series.all_reaches = summaries
    series.arm_name = _choose("arm", arm, series.arms)
    series.board_name = _choose("board", board, series.boards)
    return series


def listed(summaries: Sequence[ReachSummary]) -> str:
    """List the reaches, one per line."""
    many = len({reach.name for reach in summaries}) > 1
    return "\n".join(
        f"  {number}  {reach.name + ': ' if many else ''}{reach.strategy}, "
        f"{reach.outcome or 'no outcome in the log'}"
        for number, reach in enumerate(summaries, 1)
    )


def _choose(what: str, asked: str | None, held: dict[str, tuple[list[float], list[Any]]]) -> str:
    if asked is not None and asked not in held:
        there = ", ".join(sorted(held)) or "none"
        raise ToolError(f"no {what} {asked!r} was heard during this reach, but {there}")
    return asked or max(sorted(held), key=lambda name: len(held[name][1]), default="")


class _Reader:
    """Reads a log and keeps one reach of it."""

    def __init__(self, wanted: int | None) -> None:
        self.summaries: list[ReachSummary] = []
        self.chosen: ReachSeries | None = None
        self._wanted = wanted
        self._world: Any = None
        self._current: dict[str, ReachSeries] = {}  # the latest reach of each name

    def take(self, topic: Any, name: str, message: Any) -> None:
        """Take the next message."""
        if topic == REACH_STATE:
            self._state(name, message)
        elif topic == REACH_EVENT:
            self._event(name, message)
        elif topic == WORLD:
            self._world = message
            for each in self._current.values():
                if not each.ended:
                    each.first_world = each.first_world or message
                    each.last_world = message
        elif (series := self.chosen) is not None and not series.ended:
            held = series.arms if topic == ARM_STATE else series.boards
            times, kept = held.setdefault(name, ([], []))
            self._keep(series, times, kept, message.captured_ns, message)

    def _state(self, name: str, message: Any) -> None:
        series = self._current.get(name)
        under_way = message.state in UNDER_WAY
        if under_way and (series is None or series.ended or series.is_over(message)):
            self.summaries.append(ReachSummary(name, message.strategy, ""))
            series = ReachSeries(
                message.stamped_ns, self._world, name, len(self.summaries), last_world=self._world
            )
            self._current[name] = series
            if self._wanted in (None, series.number):
                self.chosen = series
        elif series is not None and not under_way:
            series.ended = True
        if series is None:
            return
        series.newest = message
        if series is self.chosen and not series.ended:
            self._keep(series, series.time, series.states, message.stamped_ns, message)

    def _event(self, name: str, message: Any) -> None:
        series = self._current.get(name)
        if series is None:
            return
        now = (int(message.stamped_ns) - series.start_ns) * 1e-9
        if now < 0 or (series.ended and message.kind != "outcome"):
            return
        if message.kind == "outcome" and series.outcome() is None:
            known = self.summaries[series.number - 1]
            self.summaries[series.number - 1] = ReachSummary(
                known.name, known.strategy, message.code
            )
        if len(series.events) < MAX_POINTS:
            series.events.append((now, message))

    @staticmethod
    def _keep(
        series: ReachSeries, times: list[float], kept: list[Any], stamp_ns: int, message: Any
    ) -> None:
        if len(kept) < MAX_POINTS:
            times.append((int(stamp_ns) - series.start_ns) * 1e-9)
            kept.append(message)
        else:
            series.left_out += 1
