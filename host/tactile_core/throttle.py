"""Rate limit for messages: a burst, then a steady rate; suppressed ones are counted."""

from __future__ import annotations

from tactile_core.types import Instant, seconds_between


class Throttle:
    """Rate limiter. Pure. Allows ``burst`` messages at once, then ``rate`` per second.

    ``held``: number suppressed since the last `take_held`.
    """

    def __init__(self, rate: float, burst: int) -> None:
        self.held = 0
        self._rate = rate
        self._burst = float(burst)
        self._left = float(burst)
        self._at: Instant | None = None

    def allow(self, now: Instant) -> bool:
        """Whether a message may be sent now; counts it if not.

        An earlier ``now`` changes nothing.
        """
        if not self.ready(now):
            self.held += 1
            return False
        self._left -= 1.0
        return True

    def ready(self, now: Instant) -> bool:
        """Whether a message could be sent now; counts nothing."""
        if self._at is None:
            self._at = now
        passed = seconds_between(self._at, now)
        if passed > 0:
            self._left = min(self._burst, self._left + passed * self._rate)
            self._at = now
        return self._left >= 1.0

    def take_held(self) -> int:
        """Return and reset the number of suppressed messages."""
        held, self.held = self.held, 0
        return held
