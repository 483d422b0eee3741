"""Tells an arm whose state has frozen from one that is jammed or at rest."""

from __future__ import annotations

import math

from reachd.limits import fastest_point
from reachd.safety_settings import SafetySettings
from reachd.seam import ArmState, Twist
from tactile_bus.instant import Instant, seconds_between

COMMANDED = 0.002
"""m/s at pivot or tip: slower commands are not watched, for arms do not follow them well."""

MOVED = 1e-5
"""m, rad by which the pose must change: well below what the slowest watched command does."""

REPORTED = 0.001
"""m/s, rad/s of reported motion that contradicts a pose that stays: jammed arms creep slower."""


class Stillness:
    """Watches for motion that is commanded and not reported.

    An arm that does not move though told to is jammed, and then it feels a load; or its state is
    frozen: then it reports no load, or the motion that it had when it froze.
    """

    def __init__(self) -> None:
        self._pose = (math.nan, math.nan, math.nan)
        self._since: Instant | None = None  # commanded to move and still since then

    def frozen(self, arm: ArmState, last: Twist, now: Instant, settings: SafetySettings) -> bool:
        """Whether ``arm`` has stayed for too long while ``last`` commands told it to move."""
        x, y, heading = self._pose
        # A pose of NaN, as at first, has not stayed either.
        stayed = (
            abs(arm.x - x) <= MOVED
            and abs(arm.y - y) <= MOVED
            and abs(arm.heading - heading) <= MOVED
        )
        if not stayed or fastest_point(last, settings) < COMMANDED:
            self._pose = (arm.x, arm.y, arm.heading)
            self._since = None
            return False
        if self._since is None:
            self._since = now
        if seconds_between(self._since, now) <= settings.frozen_after:
            return False
        twist = arm.twist
        moving = max(math.hypot(twist.vx, twist.vy), abs(twist.omega)) > REPORTED
        return moving or math.hypot(arm.fx, arm.fy) < settings.free_air_force
