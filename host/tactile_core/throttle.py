"""How often something may be said: a burst, then a steady rate; what is held back is counted."""

from __future__ import annotations

from tactile_core.types import Instant, seconds_between


class Throttle:
    """Pure. ``burst`` times at once, then ``rate`` times a second.

    ``held``: what was held back since `take_held` was last asked.
    """

    def __init__(self, rate: float, burst: int) -> None:
        self.held = 0
        self._rate = rate
        self._burst = float(burst)
        self._left = float(burst)
        self._at: Instant | None = None

    def allow(self, now: Instant) -> bool:
        """Whether it may be said now; if not, it is counted. An earlier ``now`` changes nothing."""
        if not self.ready(now):
            self.held += 1
            return False
        self._left -= 1.0
        return True

    def ready(self, now: Instant) -> bool:
        """Whether it might be said now; nothing is counted."""
        if self._at is None:
            self._at = now
        passed = seconds_between(self._at, now)
        if passed > 0:
            self._left = min(self._burst, self._left + passed * self._rate)
            self._at = now
        return self._left >= 1.0

    def take_held(self) -> int:
        """How often it was held back since this was last asked."""
        held, self.held = self.held, 0
        return held
