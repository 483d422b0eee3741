"""One reach out of a log: states, arm, touch, events and the world before and after."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactile_bus.geometry import TIP_X, finger
from tactile_bus.topics import ARM_STATE, FEATURES, REACH_EVENT, REACH_STATE, WORLD
from tactile_tools.plots.series import LogUnreadableError, messages

Float = NDArray[np.float64]

WANTED = frozenset({ARM_STATE, FEATURES, REACH_EVENT, REACH_STATE, WORLD})
CAPTURED = frozenset({ARM_STATE, FEATURES})
UNDER_WAY = frozenset({"homing", "reaching"})

MAX_POINTS = 200_000
"""Messages kept of each kind: half an hour of control cycles, far longer than any reach."""


@dataclass(frozen=True, slots=True)
class Contact:
    """One patch of a moment. ``place``, ``shear``: (2,) m and N in ``cupboard``; ``normal`` in N.

    ``shear`` is the part of the in-plane force that acts along the skin.
    """

    place: Float
    normal: float
    shear: Float


@dataclass(eq=False)
class ReachSeries:
    """What a log says of its last reach. Times are s since that reach began."""

    start_ns: int
    first_world: Any
    time: list[float] = field(default_factory=list)
    states: list[Any] = field(default_factory=list)
    arm_time: list[float] = field(default_factory=list)
    arm: list[Any] = field(default_factory=list)
    touch_time: list[float] = field(default_factory=list)
    touch: list[Any] = field(default_factory=list)
    events: list[tuple[float, Any]] = field(default_factory=list)
    last_world: Any = None
    ended: bool = False

    def outcome(self) -> Any:
        """The event that tells how the reach ended, None when the log was cut off before."""
        return next((e for _, e in self.events if e.kind == "outcome"), None)

    def excavations(self) -> list[tuple[float, str]]:
        """When each excavation began, and "cw stall" and the like."""
        return [
            (when, event.text)
            for when, event in self.events
            if event.kind == "excavation" and event.code == "excavation_start"
        ]

    def pose_at(self, when: float) -> tuple[float, float, float]:
        """Pose of the wrist pivot at ``when``: m, m, rad."""
        k = min(int(np.searchsorted(self.arm_time, when)), len(self.arm) - 1)
        arm = self.arm[k]
        return float(arm.x), float(arm.y), float(arm.heading)

    def tip(self) -> Float:
        """(arm states, 2) m: path of the tip."""
        poses = np.array([(a.x, a.y, a.heading) for a in self.arm])
        ahead = np.stack([np.cos(poses[:, 2]), np.sin(poses[:, 2])], axis=1)
        return np.asarray(poses[:, :2] + TIP_X * ahead)

    def contacts_at(self, index: int) -> list[Contact]:
        """Patches of the ``index``-th features, where the finger then was."""
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

    def moments(self, most: int, apart_s: float, apart_m: float, least_n: float) -> list[int]:
        """Features of the strongest moments, in order of time.

        No two are within both ``apart_s`` and ``apart_m`` of each other, none below ``least_n``.
        """
        chosen: list[tuple[int, Float]] = []
        for index in np.argsort([-t.normal_force for t in self.touch]).tolist():
            contacts = self.contacts_at(index)
            if not contacts or not self.touch[index].normal_force >= least_n:
                continue
            place = max(contacts, key=lambda c: c.normal).place
            if all(
                abs(self.touch_time[index] - self.touch_time[k]) > apart_s
                or math.dist(place, other) > apart_m
                for k, other in chosen
            ):
                chosen.append((index, place))
            if len(chosen) == most:
                break
        return sorted(index for index, _ in chosen)


_SKIN = finger()
_PLACES = np.concatenate([a.position[:, :2] for a in _SKIN.arrays])
_NORMALS = np.concatenate([a.rotation[:, :2, 2] for a in _SKIN.arrays])


def _outward(place: Float) -> Float:
    """(2,) unit normal of the skin in ``ee`` at its taxel nearest to ``place`` (m, ``ee``)."""
    nearest = int(((_PLACES - place) ** 2).sum(axis=1).argmin())
    return np.asarray(_NORMALS[nearest] / np.linalg.norm(_NORMALS[nearest]))


def turned(points: Any, x: float, y: float, heading: float) -> Float:
    """Return ``points`` (..., 2), turned by ``heading`` (rad) and then moved by ``x``, ``y``."""
    c, s = math.cos(heading), math.sin(heading)
    return np.asarray(np.asarray(points) @ np.array([[c, s], [-s, c]]) + (x, y))


def read_reach(path: Path | Sequence[Path]) -> ReachSeries:
    """Return the last reach in a log; LogUnreadableError when there is none."""
    series: ReachSeries | None = None
    world: Any = None
    for topic, _, message in messages(path, WANTED):
        if topic == WORLD:
            world = message
            if series is not None and not series.ended:
                series.first_world = series.first_world or message
                series.last_world = message
            continue
        if topic == REACH_STATE:
            under_way = message.state in UNDER_WAY
            if under_way and (series is None or series.ended):
                series = ReachSeries(message.stamped_ns, world, last_world=world)
            elif series is not None and not under_way:
                series.ended = True
        if series is not None:
            _add(series, topic, message)
    if series is None or not series.arm:
        first = path if isinstance(path, Path) else path[0]
        raise LogUnreadableError(
            f"{first} holds no reach: was it written by reachd or `tactile reach --log`?"
        )
    return series


def _add(series: ReachSeries, topic: Any, message: Any) -> None:
    stamp = message.captured_ns if topic in CAPTURED else message.stamped_ns
    now = (int(stamp) - series.start_ns) * 1e-9
    if topic == REACH_EVENT:
        if now >= 0 and (not series.ended or message.kind == "outcome"):
            series.events.append((now, message))
        return
    if series.ended:
        return
    times, kept = {
        REACH_STATE: (series.time, series.states),
        ARM_STATE: (series.arm_time, series.arm),
        FEATURES: (series.touch_time, series.touch),
    }[topic]
    if len(kept) < MAX_POINTS:
        times.append(now)
        kept.append(message)
