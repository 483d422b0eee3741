"""How fast a board really sends, and how long a silence therefore means nothing. Pure."""

from __future__ import annotations

from collections import deque

from tactile_bus.instant import Instant, seconds_between

SLOWEST_S = 2.0
"""s between frames of the slowest boards that are served, 0.5 Hz."""

SILENCE_PERIODS = 3
"""Periods without a frame that are no cause for concern: one may be lost, the next late."""

SILENCE = 0.2
"""s without frames that are none either, however fast the board: a busy host."""

HEARD = 8
"""Arrivals that the period is taken from. It is the mean over them: frames that come in bursts
have the same mean."""

KNOWN = 3
"""Arrivals from which on the period is known."""


class Pace:
    """Mean time between the frames of a board, from the last few that came."""

    def __init__(self) -> None:
        self._heard: deque[tuple[Instant, int]] = deque(maxlen=HEARD)

    @property
    def period(self) -> float | None:
        """s between frames; None until `KNOWN` of them came."""
        if len(self._heard) < KNOWN:
            return None
        (first, number), (last, newest) = self._heard[0], self._heard[-1]
        return seconds_between(first, last) / max(newest - number, 1)

    def restart(self) -> None:
        """What came before tells nothing any more: another rate, or another board."""
        self._heard.clear()

    def heard(self, now: Instant, number: int) -> None:
        """Frame ``number`` came at ``now``; the parts of one frame have one number."""
        if self._heard and number <= self._heard[-1][1]:
            if number < self._heard[-1][1]:
                self.restart()
            else:
                return
        if self._heard and now == self._heard[-1][0]:  # several in one read: they came as one
            self._heard[-1] = (now, number)
        else:
            self._heard.append((now, number))

    def silence_limit(self, asked_hz: float | None = None, said_hz: float | None = None) -> float:
        """s without a frame that are no cause for concern.

        By what was heard; before that by the rate the board was told, else by the one it says
        (down to the slowest that is served: what it says may be wrong), else that of the slowest.
        """
        period = self.period
        if period is None and asked_hz:
            period = 1 / asked_hz
        elif period is None:
            period = min(1 / said_hz, SLOWEST_S) if said_hz else SLOWEST_S
        return max(SILENCE, SILENCE_PERIODS * period)
