"""Reaching strategy that follows twists from outside, such as a ROS 2 controller or a policy.

Run it with ``reachd --strategy tactile_tools.ros2.follow:FollowTwist``. Every twist passes the
safety gate like that of any other strategy, within a reach that has a goal, a time limit and an
outcome.
"""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np

from reachd.interfaces import ZERO, ArmState, Goal, Touch, Twist
from reachd.strategies.parameter_fields import Parameters
from tactile_core.bus.messages import DecodeError, codec
from tactile_core.bus.session import open_sessions
from tactile_core.bus.streams import Latest, latest
from tactile_core.bus.topics import Topic
from tactile_core.types import Instant, seconds_between

WANTED: Final = Topic("reference/{name}/twist", "geometry_msgs/msg/TwistStamped", 100)
"""Wanted velocity of the wrist pivot: m/s and rad/s, planar, in ``cupboard``."""

FRAMES: Final = ("", "cupboard")

TIMEOUT_S: Final = 0.1
"""Silence after which the arm is asked to stand still, s."""


def planar_twist(message: Any) -> Twist | None:
    """Twist of a ``TwistStamped``; None unless it is finite, planar and in ``cupboard``."""
    linear, angular = message.twist.linear, message.twist.angular
    parts = (linear.x, linear.y, linear.z, angular.x, angular.y, angular.z)
    if message.header.frame_id not in FRAMES or not all(math.isfinite(part) for part in parts):
        return None
    if linear.z or angular.x or angular.y:
        return None
    return Twist(float(linear.x), float(linear.y), float(angular.z))


class FollowTwist:
    """Follows ``reference/<reach>/twist``; stands still without one. Runs only within reachd.

    ``reach`` is the name of the reach (reachd --name); derive a class to change it.
    """

    reach = "reach"

    def __init__(self, parameters: Parameters, rng: np.random.Generator) -> None:
        del parameters, rng
        self.activity = "waiting"
        self._latest: Latest | None = None
        self._twist = ZERO
        self._heard: Instant | None = None

    def start(self, goal: Goal, now: Instant) -> None:
        """Begin a reach; RuntimeError where there is no bus to listen to."""
        del goal, now
        if self._latest is None:
            sessions = open_sessions()
            if not sessions:
                raise RuntimeError("FollowTwist needs the bus of reachd: it cannot run in lockstep")
            self._latest = latest(sessions[0], WANTED.key(self.reach))
        self._latest.newest()  # drop twists from before this reach
        self._twist, self._heard, self.activity = ZERO, None, "waiting"

    def step(self, touch: Touch, arm: ArmState, goal: Goal, now: Instant) -> Twist:
        """Return the newest twist; zero once it is older than `TIMEOUT_S`."""
        del touch, arm, goal
        sample = None if self._latest is None else self._latest.newest()
        if sample is not None:
            self._take(sample.data, now)
        if self._heard is None or seconds_between(self._heard, now) > TIMEOUT_S:
            self.activity = "waiting"
            return ZERO
        self.activity = "follow"
        return self._twist

    def _take(self, data: bytes, now: Instant) -> None:
        try:
            twist = planar_twist(codec().decode(WANTED, data))
        except DecodeError:
            twist = None
        if twist is not None:
            self._twist, self._heard = twist, now
