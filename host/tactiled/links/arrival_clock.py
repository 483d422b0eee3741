"""Clock for boards that have none: frame k left at phase + k·period, and arrived no earlier."""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import dataclass

from tactile_bus.instant import NS_PER_S, Instant
from tactiled.links.clock import Stamp
from tactiled.links.envelope import LowerEnvelope

BUCKET = 16
"""Frames of which only the least delayed is kept: a USB burst is shorter."""

BUCKETS = 16
"""Buckets in the regression: 256 frames, 2.5 s at 100 Hz, so that a changed rate is followed."""

LATE_RUN = 8
"""Frames that must all be late before frames are held to be lost: a host stall ends in a burst
that catches up, a loss does not."""

LATE = 0.75
"""Periods a frame must be late to count towards such a run."""

RESTARTS_AFTER = 3
"""Losses found within one window after which the period itself must be wrong."""

LEARNING = 2 * BUCKET
"""Frames from which the first guess of the period is made; until then arrivals are the stamps."""

MIN_PERIOD = 5e-4
"""s: four times the fastest rate of the chip. A shorter period is that of a backlog being read."""

UNLEARNT = 0.05
"""s of uncertainty until then, at least: the period of the slowest board seen (ReSkin, 20 Hz)."""


@dataclass(frozen=True, slots=True)
class Arrival:
    """One frame: its place in the board's sequence, lost frames counted, and its stamp."""

    sequence: int
    stamp: Stamp


class ArrivalClock:
    """Numbers and stamps frames that carry neither; pure, fed with arrivals in order.

    What a frame holds was measured within the period before it was sent, so its stamp is half a
    period before its jitter-free arrival, give or take half a period and the scatter of the
    earliest arrivals. ``counters``: frames held to be lost, and restarts of the model.
    """

    def __init__(self) -> None:
        self.counters: Counter[str] = Counter()
        self._sequence = -1
        self._last = Instant(0)
        self.restart()

    def restart(self) -> None:
        """Forget period and phase; the numbering goes on."""
        self._origin: Instant | None = None
        self._index = -1
        self._learning: list[float] = []
        self._envelope: LowerEnvelope | None = None
        self._late: deque[float] = deque(maxlen=LATE_RUN)
        self._losses: deque[int] = deque(maxlen=RESTARTS_AFTER)

    @property
    def period(self) -> float:
        """Estimated s between frames; 0 while it is being learnt."""
        return 0.0 if self._envelope is None else max(self._envelope.slope, 0.0)

    def arrived(self, received: Instant) -> Arrival:
        """Number and stamp the frame that arrived at ``received``, wire time already taken off."""
        if self._origin is None:
            self._origin = received
        self._index += 1
        self._sequence += 1
        host = (received - self._origin) / NS_PER_S
        if self._envelope is None:
            self._learn(host)
            ideal, error = host, UNLEARNT
        else:
            ideal, error = self._follow(host, self._envelope)
        captured = self._origin + round((min(ideal, host) - self.period / 2) * NS_PER_S)
        self._last = Instant(max(captured, min(self._last, received)))
        return Arrival(self._sequence, Stamp(self._last, error))

    def _learn(self, host: float) -> None:
        """Guess the period by least squares once enough frames came, then sort them by it."""
        heard = self._learning
        heard.append(host)
        n = len(heard)
        if n < LEARNING:
            return
        self._learning = []
        centred = [k - (n - 1) / 2 for k in range(n)]
        slope = sum(c * h for c, h in zip(centred, heard, strict=True))
        slope /= sum(c * c for c in centred)
        if slope < MIN_PERIOD:
            return
        self._envelope = LowerEnvelope(BUCKET, BUCKETS, slope)
        for index, earlier in enumerate(heard):
            self._envelope.add(index, earlier)
        self._index = n - 1

    def _follow(self, host: float, envelope: LowerEnvelope) -> tuple[float, float]:
        """Jitter-free arrival and its uncertainty, both s; numbering moves on after a loss."""
        period = self.period
        if period < MIN_PERIOD:
            return self._start_anew(host)
        late = host - envelope.at(self._index)
        self._late.append(late / period)
        if len(self._late) == LATE_RUN:
            if max(self._late) < -LATE:
                return self._start_anew(host)
            if min(self._late) > LATE:
                if not self._lose(max(round(min(self._late)), 1)):
                    return self._start_anew(host)
                late = host - envelope.at(self._index)
        if late <= LATE * period:
            envelope.add(self._index, host)
            late = 0.0
        return envelope.at(self._index), self.period / 2 + 2 * envelope.spread + late

    def _lose(self, lost: int) -> bool:
        """Count lost frames; False when they are so many that the period must be wrong."""
        while self._losses and self._losses[0] < self._index - BUCKET * BUCKETS:
            self._losses.popleft()
        self._losses.append(self._index)
        self._late.clear()
        if len(self._losses) == RESTARTS_AFTER:
            return False
        self.counters["lost"] += lost
        self._index += lost
        self._sequence += lost
        return True

    def _start_anew(self, host: float) -> tuple[float, float]:
        self.counters["restarts"] += 1
        origin = self._origin
        self.restart()
        self._origin, self._index = origin, 0
        self._learn(host)
        return host, UNLEARNT
