"""Board clock to host clock: regression over clock polls, with a bound on the error it makes.

Every answered poll proves an interval: the board's reading happened after the poll left and before
the reply was read. A line through the middles of the narrowest intervals therefore errs by no
more than a known amount, which is published beside every stamp.
"""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import dataclass

from sensor_proto.packets import ClockReply
from tactile_bus.instant import NS_PER_S, Instant
from tactiled.links.envelope import LowerEnvelope

BUCKET_S = 0.5
"""s of board time from which only the poll with the shortest round trip is kept."""

WINDOW = 16
"""Buckets in the regression: 8 s, so short that thermal drift stays near a straight line."""

OUTSTANDING = 16
"""Polls that may await an answer: 1.6 s of the fastest polling; later answers are worthless."""

WORST_HALF_WIDTH = 0.25
"""s; a poll slower than this bounds nothing that matters."""

RATE_LIMIT = 0.11
"""Largest departure of a board's oscillator from nominal: ±5 % trim and ±5 % thermal (MLX90393)."""

RATE_CHANGE = 2e-5
"""1/s, how fast the rate may drift: ±5 % over 125 K is 400 ppm/K, at 3 K a minute."""

CONTRADICTIONS = 3
"""Answers in a row outside the bound after which the board's clock must have jumped."""

ONE_WAY_ALLOWANCE = 0.02
"""s assumed between a conversion and its arrival when no poll was answered: one conversion at the
slowest usual rate, or the 16 ms latency timer of a USB bridge."""

WRAP = 1 << 32


@dataclass(frozen=True, slots=True)
class Stamp:
    """A board reading on the host's clock; the true instant is within ``uncertainty`` (s) of it."""

    captured: Instant
    uncertainty: float


class TickUnwrapper:
    """Extends 32-bit ticks to a number that never wraps, reordering of half a wrap allowed."""

    def __init__(self) -> None:
        self._last: int | None = None

    def unwrap(self, ticks: int) -> int:
        """64-bit count that is nearest to the last one and ends in ``ticks``."""
        if self._last is None:
            self._last = ticks
            return ticks
        step = (ticks - self._last) % WRAP
        if step >= WRAP // 2:
            return self._last + step - WRAP
        self._last += step
        return self._last


@dataclass(frozen=True, slots=True)
class _Pair:
    board: float  # s of board time at the nominal rate
    host: float  # s since the first stamp
    half: float  # s; the host time is within this of ``host``


@dataclass(frozen=True, slots=True)
class _Line:
    board: float
    host: float
    slope: float
    offset_error: float
    slope_error: float
    spread: float

    def at(self, board: float) -> float:
        return self.host + (board - self.board) * self.slope

    def error(self, board: float) -> float:
        lever = abs(board - self.board)
        drift = 0.5 * RATE_CHANGE * (lever * lever + self.spread)
        return self.offset_error + lever * self.slope_error + drift


class ClockMap:
    """Maps the ticks of one board to instants; pure, fed with polls, replies and arrivals.

    Until a poll is answered the earliest arrivals stand in, with a wider uncertainty. Stamps never
    run backwards while ticks do not, and never lie after the arrival they are asked for.
    ``counters``: replies used and refused, by reason.
    """

    def __init__(self, tick_hz: int) -> None:
        if tick_hz <= 0:
            raise ValueError(f"tick_hz is {tick_hz}: it must be above 0")
        self._tick_hz = tick_hz
        self.counters: Counter[str] = Counter()
        self._last = Instant(0)
        self.restart()

    def restart(self) -> None:
        """Forget everything but the counters: the board has a new clock."""
        self._ticks = TickUnwrapper()
        self._origin: Instant | None = None
        self._first_ticks = 0
        self._sent: dict[int, Instant] = {}
        self._pairs: deque[_Pair] = deque(maxlen=WINDOW)
        self._line: _Line | None = None
        self._doubts: list[_Pair] = []
        self._arrivals = LowerEnvelope(BUCKET_S, WINDOW, slope=1.0, tolerance=RATE_LIMIT)
        self._last_ticks: int | None = None

    @property
    def synchronised(self) -> bool:
        """Whether a poll was answered since the start."""
        return self._line is not None

    @property
    def rate_error(self) -> float:
        """How much faster than nominal the board's clock runs (0.01: 1 %)."""
        slope = self._line.slope if self._line is not None else self._arrivals.slope
        return 1.0 / slope - 1.0

    def polled(self, token: int, sent: Instant) -> None:
        """Note that a poll is about to be written."""
        while len(self._sent) >= OUTSTANDING:
            self._sent.pop(next(iter(self._sent)))
        self._sent[token] = sent

    def replied(self, reply: ClockReply, received: Instant) -> bool:
        """Take the answer to a poll; False, and counted, when it is of no use."""
        sent = self._sent.pop(reply.token, None)
        if sent is None or received < sent:
            return self._refuse("unasked")
        arrived, left = (
            self._ticks.unwrap(reply.ticks_received),
            self._ticks.unwrap(reply.ticks_sent),
        )
        start, end = self._board(arrived, received), self._board(left, received)
        turnaround = (end - start) / (1 + RATE_LIMIT)
        half = ((received - sent) / NS_PER_S - turnaround) / 2
        if end < start or half < 0:
            return self._refuse("impossible")
        if half > WORST_HALF_WIDTH:
            return self._refuse("slow")
        middle = (self._host(sent) + self._host(received)) / 2
        pair = _Pair((start + end) / 2, middle, half + 1.0 / self._tick_hz)
        if self._contradicts(pair):
            return self._refuse("contradiction")
        self._doubts.clear()
        self._keep(pair)
        self.counters["used"] += 1
        return True

    def arrived(self, ticks: int, received: Instant) -> None:
        """Take the arrival of a message that carried ``ticks``."""
        if self._line is None:
            board = self._board(self._ticks.unwrap(ticks), received)
            self._arrivals.add(board, self._host(received))

    def stamp(self, ticks: int, received: Instant) -> Stamp:
        """Instant of a 32-bit tick count that arrived at ``received``."""
        long_ticks = self._ticks.unwrap(ticks)
        board = self._board(long_ticks, received)
        if self._line is not None:
            host, error = self._line.at(board), self._line.error(board)
        elif self._arrivals.ready:
            host = self._arrivals.at(board)
            error = ONE_WAY_ALLOWANCE + self._arrivals.spread
        else:
            host, error = self._host(received), ONE_WAY_ALLOWANCE
        mapped = self._instant(host)
        captured = min(mapped, received)
        if self._last_ticks is None or long_ticks > self._last_ticks:
            captured = max(captured, min(self._last, received))
            self._last_ticks, self._last = long_ticks, Instant(captured)
        else:
            captured = min(captured, self._last)
        return Stamp(Instant(captured), error + abs(captured - mapped) / NS_PER_S)

    def _refuse(self, reason: str) -> bool:
        self.counters[reason] += 1
        return False

    def _board(self, long_ticks: int, now: Instant) -> float:
        if self._origin is None:
            self._origin, self._first_ticks = now, long_ticks
        return (long_ticks - self._first_ticks) / self._tick_hz

    def _host(self, instant: Instant) -> float:
        return (instant - (self._origin or 0)) / NS_PER_S

    def _instant(self, host: float) -> Instant:
        return Instant((self._origin or 0) + round(host * NS_PER_S))

    def _contradicts(self, pair: _Pair) -> bool:
        """Whether ``pair`` cannot be true if the line is; after a few such the line is dropped."""
        if self._line is None:
            return False
        distance = abs(pair.host - self._line.at(pair.board))
        if distance <= pair.half + self._line.error(pair.board):
            return False
        self._doubts.append(pair)
        if len(self._doubts) < CONTRADICTIONS:
            return True
        self.counters["jump"] += 1
        self._pairs.clear()
        self._pairs.extend(self._doubts[-1:])
        self._doubts.clear()
        self._last_ticks = None
        self._line = self._fit()
        return True

    def _keep(self, pair: _Pair) -> None:
        bucket = int(pair.board // BUCKET_S)
        if self._pairs and int(self._pairs[-1].board // BUCKET_S) == bucket:
            if pair.half >= self._pairs[-1].half:
                return
            self._pairs[-1] = pair
        else:
            self._pairs.append(pair)
        self._line = self._fit()

    def _fit(self) -> _Line:
        """Least squares weighted by 1/half²; the errors bound what intervals of that width allow.

        The estimate at any point is a weighted sum of the pairs, so its error is at most the same
        sum of the half widths with the weights made positive.
        """
        weights = [pair.half**-2 for pair in self._pairs]
        total = sum(weights)
        board = sum(w * p.board for w, p in zip(weights, self._pairs, strict=True)) / total
        host = sum(w * p.host for w, p in zip(weights, self._pairs, strict=True)) / total
        offset_error = sum(w * p.half for w, p in zip(weights, self._pairs, strict=True)) / total
        sxx = sxy = lever = 0.0
        for w, p in zip(weights, self._pairs, strict=True):
            dx = p.board - board
            sxx += w * dx * dx
            sxy += w * dx * (p.host - host)
            lever += w * abs(dx) * p.half
        slope, slope_error = 1.0, RATE_LIMIT
        if sxx > 0 and lever / sxx < RATE_LIMIT:
            slope, slope_error = sxy / sxx, lever / sxx
        return _Line(board, host, slope, offset_error, slope_error, sxx / total)
