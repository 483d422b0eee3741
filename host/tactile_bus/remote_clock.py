"""Stamps of another machine's monotonic clock. Pure."""

from __future__ import annotations

from tactile_bus.instant import Instant

DRIFT = 2e-4
"""s/s by which the clocks of two machines may drift apart: twice what bad quartzes do."""


class RemoteClock:
    """Maps another machine's monotonic stamps to this one's: the least delay seen counts as none.

    What comes later than the quickest did is that much older, so a queue that fills up on the way
    shows as age. The quickest is forgotten no faster than clocks drift.
    """

    def __init__(self) -> None:
        self._offset: float | None = None
        self._at = Instant(0)

    def here(self, stamp: int, received: Instant) -> Instant:
        """Instant of this host for ``stamp``; never later than ``received``."""
        offset = received - stamp
        if self._offset is not None:
            offset = min(offset, round(self._offset + DRIFT * (received - self._at)))
        self._offset, self._at = offset, received
        return Instant(stamp + offset)
