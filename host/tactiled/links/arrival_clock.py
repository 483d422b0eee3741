"""Clock for boards that have none: frame k left at phase + k·period, and arrived no earlier."""

from __future__ import annotations

import itertools
import math
from collections import Counter, deque
from dataclasses import dataclass

from tactile_bus.instant import NS_PER_S, Instant, seconds_between
from tactiled.links.clock import Stamp
from tactiled.links.envelope import LowerEnvelope
from tactiled.links.pace import SLOWEST_S

BUCKET = 16
"""Frames of which only the least delayed is kept: a USB burst is shorter."""

BUCKETS = 16
"""Buckets in the regression: 256 frames, 2.5 s at 100 Hz, so that a changed rate is followed."""

SCATTER = 3.0
"""Times the scatter of the buckets' earliest arrivals that the line through them may err by, with
half as much again as the mean jitter on top: the earliest of sixteen is itself late."""

UNPROVEN = 3.0
"""Times the range of the delays seen so far that a delay may have while they are few."""

PROVEN = 4
"""Buckets from which their scatter about the line says how good it is; two lie on it anyway."""

LATE_RUN = 8
"""Reads whose frames must all be late before frames are held to be lost: a host stall ends in a
few reads that catch up, a loss does not."""

LATE = 0.75
"""Periods a frame must be late to count towards such a run."""

TOGETHER = 0.25
"""Periods; frames that come closer than this came of one delay, and count as one read."""

RESTARTS_AFTER = 3
"""Losses found within one window after which the period itself must be wrong."""

LEARNING = 2 * BUCKET
"""Frames from which the first guess of the period is made; until then arrivals are the stamps."""

LEARNING_LEAST, LEARNING_S = 6, 1.0
"""Fewer frames do when they span so many s: jitter is then small beside the period."""

MIN_PERIOD = 5e-4
"""s: four times the fastest rate of the chip. A shorter period is that of a backlog being read."""

UNLEARNT = 0.05
"""s of uncertainty until then, at least: the period of the slowest usual board (ReSkin, 20 Hz)."""

LINE_DELAY = 2e-3
"""s that every frame may take from board to host, which no arrival can show: two USB frames and
the wait for the thread that reads."""


@dataclass(frozen=True, slots=True)
class Arrival:
    """One frame: its place in the board's sequence, lost frames counted, and its stamp."""

    sequence: int
    stamp: Stamp


class ArrivalClock:
    """Numbers and stamps frames that carry neither; pure, fed with arrivals in order.

    What a frame holds was measured within the period before it was sent, so its stamp is half a
    period before its jitter-free arrival, give or take half a period, the scatter of the earliest
    arrivals and `LINE_DELAY`. Frames that were read together each have an instant of their own.
    ``counters``: frames held to be lost, and restarts of the model.
    """

    def __init__(self) -> None:
        self.counters: Counter[str] = Counter()
        self._sequence = -1
        self._last = Instant(0)
        self._guess = 0.0
        self._longest = SLOWEST_S
        self._forget()

    def restart(self) -> None:
        """Forget phase and sequence; the period stays a guess, and the numbering goes on."""
        self._guess = self.period or self._guess
        if self._guess:
            self._longest = max(2 * self._guess, UNLEARNT / 2)
        self._forget()

    def _forget(self) -> None:
        self._origin: Instant | None = None
        self._index = -1
        self._learning: list[float] = []
        self._envelope: LowerEnvelope | None = None
        self._scatter = 0.0
        self._jitter = 0.0
        self._group = math.inf
        self._group_at: Instant | None = None
        self._late: deque[float] = deque(maxlen=LATE_RUN)
        self._losses: deque[int] = deque(maxlen=RESTARTS_AFTER)

    @property
    def period(self) -> float:
        """Estimated s between frames; 0 while it is being learnt."""
        return 0.0 if self._envelope is None else max(self._envelope.slope, 0.0)

    def heard(self, received: Instant) -> None:
        """Learn from a frame that is not used."""
        self._place(received)

    def arrived(self, received: Instant, behind: int = 0, newest: Instant | None = None) -> Arrival:
        """Number and stamp the frame that arrived at ``received``, wire time already taken off.

        ``behind``: frames after it that were read together with it, and so were sent after it;
        ``newest``: when the last of them arrived.
        """
        self._sequence += 1
        origin, ideal, error = self._place(received, behind, newest)
        period = self.period or self._guess
        captured = origin + round((ideal - period / 2) * NS_PER_S)
        self._last = Instant(max(captured, min(self._last + 1, received)))
        return Arrival(self._sequence, Stamp(self._last, error + LINE_DELAY))

    def _place(
        self, received: Instant, behind: int = 0, newest: Instant | None = None
    ) -> tuple[Instant, float, float]:
        """Origin, s after it of the arrival without jitter, and the uncertainty, s."""
        origin = self._origin = self._origin or received
        self._index += 1
        host = seconds_between(origin, received)
        if behind:
            # It was sent so many periods before the newest, which was sent before it arrived.
            earlier = seconds_between(origin, newest or received)
            host = min(host, earlier - behind * (self.period or self._guess))
        if self._envelope is None:
            self._learn(host)
            period = self.period or self._guess
            return origin, host, max(UNLEARNT, 2 * self._longest, period)
        ideal, error = self._follow(host, received, behind, self._envelope)
        return origin, min(ideal, host), error

    def _learn(self, host: float) -> None:
        """Guess the period by least squares once enough frames came, then sort them by it."""
        heard = self._learning
        heard.append(host)
        n = len(heard)
        if n < 2:
            return
        gaps = [b - a for a, b in itertools.pairwise(heard)]
        self._longest = max(self._guess, *gaps)
        self._guess = max((heard[-1] - heard[0]) / (n - 1), 0.0)
        if n < LEARNING and not (n >= LEARNING_LEAST and heard[-1] - heard[0] >= LEARNING_S):
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
        off = [h - slope * k for k, h in enumerate(heard)]
        self._scatter = max(off) - min(off)

    def _follow(
        self, host: float, received: Instant, behind: int, envelope: LowerEnvelope
    ) -> tuple[float, float]:
        """Jitter-free arrival and its uncertainty, both s; numbering moves on after a loss."""
        period = self.period
        if period < MIN_PERIOD:
            return self._start_anew(host, received)
        if self._group_at is not None:
            together = seconds_between(self._group_at, received) < TOGETHER * period
            if not together and not self._judge(self._group):
                return self._start_anew(host, received)
            self._group = self._group if together else math.inf
        self._group_at = received
        late = host - envelope.at(self._index)
        self._group = min(self._group, late / period)
        if late <= LATE * period:
            if not behind:  # the others of one read were no less delayed by it
                envelope.add(self._index, host)
                self._scatter = max(self._scatter, late)
                self._jitter += (max(late, 0.0) - self._jitter) / BUCKET
            if envelope.buckets < PROVEN:
                # The line is not yet better than the arrival itself.
                return host, self.period / 2 + UNPROVEN * self._scatter + max(late, 0.0)
            late = 0.0
        scatter = SCATTER * envelope.spread + 1.5 * self._jitter + self._unproven(envelope)
        return envelope.at(self._index), self.period / 2 + scatter + late

    def _unproven(self, envelope: LowerEnvelope) -> float:
        """s by which the line may err while it rests on what was learnt more than on buckets."""
        return 0.0 if envelope.buckets >= PROVEN else UNPROVEN * self._scatter

    def _judge(self, late: float) -> bool:
        """Take the lateness of one read, in periods; False when the model cannot be right."""
        self._late.append(late)
        if len(self._late) < LATE_RUN:
            return True
        if max(self._late) < -LATE:
            return False
        least = min(self._late)
        proven = self._envelope is not None and self._envelope.buckets >= PROVEN
        return least <= LATE or not proven or self._lose(max(round(least), 1))

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

    def _start_anew(self, host: float, received: Instant) -> tuple[float, float]:
        self.counters["restarts"] += 1
        origin, gap = self._origin, seconds_between(self._group_at or received, received)
        self.restart()
        self._longest = max(self._longest, gap)
        self._origin, self._index = origin, 0
        self._learn(host)
        return host, max(UNLEARNT, 2 * self._longest)
