"""Map a board's clock to the host's: a regression over clock polls, with a bound on its error.

Every answered poll proves an interval: the board read its clock after the poll was sent and before
the reply was read. The error of a line through the middles of the narrowest intervals is therefore
bounded, and the bound is published with every stamp. The board's rate is only assumed to be within
`WIDEST` of what the board states; beyond `RATE_LIMIT` the bound still holds, but the clock is
reported as unusable (`ClockMap.trouble`).

Between polls the clock may jump. Any sign of that in a sample (a step of its ticks that its
sequence does not explain, a delay outside recent ones, an arrival before its own instant) widens
the bound until a poll has settled it.
"""

from __future__ import annotations

import itertools
import math
from collections import Counter, deque
from dataclasses import dataclass

from sensor_proto.packets import ClockReply
from tactile_core.types import NS_PER_S, Instant, seconds_between

# A line along the earliest arrivals: delays are never negative, so the lowest points are the best.


@dataclass(frozen=True, slots=True)
class _Fit:
    x: float
    y: float
    slope: float
    spread: float


class LowerEnvelope:
    """Least-squares line through the lowest point of each of the last ``buckets`` buckets.

    ``bucket``: width in units of x. ``slope``: initial guess, used until two buckets hold points;
    the slope of the line stays within ``tolerance`` of it.
    """

    def __init__(
        self, bucket: float, buckets: int, slope: float, tolerance: float = math.inf
    ) -> None:
        self._bucket = bucket
        self._points: deque[tuple[float, float]] = deque(maxlen=buckets)
        self._guess = slope
        self._tolerance = tolerance
        self._fit: _Fit | None = None

    @property
    def ready(self) -> bool:
        """Whether there is any point."""
        return self._fit is not None

    @property
    def buckets(self) -> int:
        """Number of buckets that hold a point."""
        return len(self._points)

    @property
    def span(self) -> float:
        """Range of the points in x; 0 before the second."""
        return self._points[-1][0] - self._points[0][0] if self._points else 0.0

    @property
    def middle(self) -> float:
        """Mean x of the points, where the line is best known; 0 before the first."""
        return 0.0 if self._fit is None else self._fit.x

    @property
    def slope(self) -> float:
        """Present slope, or the initial guess."""
        return self._guess if self._fit is None else self._fit.slope

    @property
    def spread(self) -> float:
        """Root mean square distance of the points from the line, in units of y."""
        return 0.0 if self._fit is None else self._fit.spread

    def at(self, x: float) -> float:
        """Height of the line at ``x``; ValueError before the first point."""
        if self._fit is None:
            raise ValueError("no point yet")
        return self._fit.y + (x - self._fit.x) * self._fit.slope

    def add(self, x: float, y: float) -> None:
        """Add an arrival."""
        if self._points:
            last_x, last_y = self._points[-1]
            if x // self._bucket == last_x // self._bucket:
                if y - last_y >= self.slope * (x - last_x):
                    return
                self._points[-1] = (x, y)
            elif x > last_x:
                self._points.append((x, y))
            else:
                return
        else:
            self._points.append((x, y))
        self._fit = self._solve()

    def _solve(self) -> _Fit:
        n = len(self._points)
        mean_x = sum(x for x, _ in self._points) / n
        mean_y = sum(y for _, y in self._points) / n
        sxx = sum((x - mean_x) ** 2 for x, _ in self._points)
        slope = self._guess
        if n > 1 and sxx > 0:
            slope = sum((x - mean_x) * (y - mean_y) for x, y in self._points) / sxx
            slope = min(max(slope, self._guess - self._tolerance), self._guess + self._tolerance)
        total = sum((y - mean_y - slope * (x - mean_x)) ** 2 for x, y in self._points)
        return _Fit(mean_x, mean_y, slope, math.sqrt(total / n))


# The actual rate of a board, and the silence that is normal for it. Pure.


SLOWEST_S = 2.0
"""s between frames of the slowest boards supported, 0.5 Hz."""

SILENCE_PERIODS = 3
"""Periods of silence considered normal: one frame may be lost and the next late."""

SILENCE = 0.2
"""s of silence considered normal for any board, because the host may be busy."""

HEARD = 8
"""Arrivals over which the mean period is taken; bursts do not change the mean."""

KNOWN = 3
"""Arrivals needed for the period."""


class Pace:
    """Mean period of a board's frames, from the last few arrivals."""

    def __init__(self) -> None:
        self._heard: deque[tuple[Instant, int]] = deque(maxlen=HEARD)

    @property
    def period(self) -> float | None:
        """s between frames; None until `KNOWN` have arrived."""
        if len(self._heard) < KNOWN:
            return None
        (first, number), (last, newest) = self._heard[0], self._heard[-1]
        return seconds_between(first, last) / max(newest - number, 1)

    def restart(self) -> None:
        """Forget all arrivals: the rate or the board has changed."""
        self._heard.clear()

    def heard(self, now: Instant, number: int) -> None:
        """Add the arrival of frame ``number``; all parts of a frame have the same number."""
        if self._heard and number <= self._heard[-1][1]:
            if number < self._heard[-1][1]:
                self.restart()
            else:
                return
        if self._heard and now == self._heard[-1][0]:  # several frames of one read count as one
            self._heard[-1] = (now, number)
        else:
            self._heard.append((now, number))

    def silence_limit(self, asked_hz: float | None = None, said_hz: float | None = None) -> float:
        """Silence considered normal, s.

        From the measured period; before it is known, from the rate set, ``asked_hz``, else from the
        rate that the board reports, ``said_hz`` (but at least the slowest supported, because the
        report may be wrong), else from the slowest supported.
        """
        period = self.period
        if period is None and asked_hz:
            period = 1 / asked_hz
        elif period is None:
            period = min(1 / said_hz, SLOWEST_S) if said_hz else SLOWEST_S
        return max(SILENCE, SILENCE_PERIODS * period)


BUCKET_S = 0.5
"""s of board time of which only the poll with the shortest round trip is kept."""

WINDOW = 16
"""Buckets in the regression: 8 s, so short that thermal drift stays near a straight line."""

SETTLING_S = 2.0
"""s of board time that the regression must span before polls are reduced to buckets; until then
every poll improves the slope."""

OUTSTANDING = 16
"""Most polls that may await an answer: 1.6 s of the fastest polling; later answers are useless."""

WORST_HALF_WIDTH = 0.25
"""s, half the round trip; slower polls bound nothing useful."""

RATE_LIMIT = 0.11
"""Largest relative rate error of a usable oscillator: ±5 % trim and ±5 % thermal (MLX90393)."""

WIDEST = 0.6
"""Relative rate error up to which the bound holds; such a clock is unusable, but reported."""

SLOPE_ERROR = 1 / (1 - WIDEST) - 1
"""Largest error of a slope of 1 (host s per board s at the nominal rate) on such a clock."""

RATE_CHANGE = 2e-5
"""1/s, fastest drift of the rate: ±5 % over 125 K is 400 ppm/K, at 3 K per minute."""

JUMPS, JUMPS_WITHIN_S = 3, 30.0
"""This many jumps within this many s make a clock unusable."""

WORST_ERROR_S = 0.1
"""s; a larger uncertainty makes an instant useless: features are stale at twice that."""

WORST_FOR_S = 1.0
"""s for which instants must be that uncertain before the clock counts as unusable."""

ONE_WAY_ALLOWANCE = 0.02
"""s assumed from a conversion to its arrival when no poll was answered: one conversion at the
slowest usual rate, or the 16 ms latency timer of a USB bridge."""

LATEST = 0.5
"""s by which all samples may be late. Beyond, their ticks are of another clock than the replies, or
the line delays everything by that much."""

UNSURE_S = 0.5
"""s of delay that samples of a restarted board may have, until a poll is answered."""

DELAYS = 32
"""Polls for which the delays of the samples between them are kept: 8 s of slow polling."""

LOG_AGE_S = 60.0
"""s, oldest believable text of the firmware; an older one gets its arrival as stamp."""

WRAP = 1 << 32
"""Number of ticks after which the board's 32-bit count wraps."""


@dataclass(frozen=True, slots=True)
class Stamp:
    """Instant of a board reading on the host's clock, correct to within ``uncertainty`` s."""

    captured: Instant
    uncertainty: float


class TickUnwrapper:
    """Extends 32-bit ticks to a count that never wraps."""

    def __init__(self) -> None:
        self._last: int | None = None

    @property
    def last(self) -> int | None:
        """Largest count so far; None before the first."""
        return self._last

    def unwrap(self, ticks: int, elapsed: int = 0) -> int:
        """Count that ends in ``ticks`` and is nearest to the last count plus ``elapsed`` ticks."""
        value = self.near(ticks, elapsed)
        self._last = value if self._last is None else max(self._last, value)
        return value

    def near(self, ticks: int, elapsed: int = 0) -> int:
        """The same, without changing the state."""
        if self._last is None:
            return ticks
        expected = self._last + elapsed
        return expected + (ticks - expected + WRAP // 2) % WRAP - WRAP // 2


@dataclass(frozen=True, slots=True)
class _Pair:
    board: float  # s of board time at the nominal rate
    host: float  # s since the first stamp
    half: float  # s; the true host time is within this of ``host``
    sent: Instant


@dataclass(frozen=True, slots=True)
class _Line:
    board: float
    host: float
    slope: float
    offset_error: float
    slope_error: float
    bend: float  # 1/s, how fast the slope may change

    def at(self, board: float) -> float:
        return self.host + (board - self.board) * self.slope

    def error(self, board: float) -> float:
        lever = abs(board - self.board)
        return self.offset_error + lever * self.slope_error + self.bend / 2 * lever * lever


class _Delays:
    """Least and greatest delay of samples, s, while polls confirmed the map."""

    def __init__(self) -> None:
        self.least, self.greatest = 0.0, ONE_WAY_ALLOWANCE
        self._shown: deque[tuple[float, float]] = deque(maxlen=DELAYS)
        self._low, self._high = math.inf, -math.inf

    def add(self, late: float) -> float:
        """Add the delay of a sample; returns the error of the map if that delay is not real, s."""
        self._low, self._high = min(self._low, late), max(self._high, late)
        if late > self.greatest:
            return late - self.least
        return self.greatest - late if late < self.least else 0.0

    def confirm(self) -> None:
        """Accept the delays since the last poll: a poll agrees with the map."""
        if self._low <= self._high:
            self._shown.append((self._low, self._high))
            self.least = min(low for low, _ in self._shown)
            self.greatest = max(high for _, high in self._shown)
            self._low, self._high = math.inf, -math.inf


class ClockMap:
    """Maps the ticks of one board to instants; pure, fed with polls, replies and arrivals.

    Until a poll is answered the earliest arrivals are used, with a larger uncertainty. Stamps never
    run backwards while ticks do not, and are never after the arrival of their sample.
    ``counters``: replies used and refused, by reason, and jumps.
    """

    def __init__(self, tick_hz: int) -> None:
        self.counters: Counter[str] = Counter()
        self._last = Instant(0)
        self._rate_trouble = ""
        self._tick_hz = tick_hz
        self._delays = _Delays()
        self.restart(tick_hz)

    def restart(self, tick_hz: int | None = None) -> None:
        """Forget everything but the counters: the board has restarted.

        ``tick_hz``: its new tick rate, if it has changed; ValueError unless above 0.
        """
        if tick_hz is not None:
            if tick_hz <= 0:
                raise ValueError(f"tick_hz is {tick_hz}: it must be above 0")
            if tick_hz != self._tick_hz:
                self._rate_trouble = ""
            self._tick_hz = tick_hz
        self._ticks = TickUnwrapper()
        self._seen = Instant(0)
        self._origin: Instant | None = None
        self._first_ticks = 0
        self._sent: dict[int, Instant] = {}
        self._slowest = 0.0
        self._before = self._last
        self._pairs: deque[_Pair] = deque(maxlen=WINDOW)
        self._line: _Line | None = None
        self._arrivals = LowerEnvelope(BUCKET_S, WINDOW, slope=1.0, tolerance=SLOPE_ERROR)
        self._last_ticks: int | None = None
        self._line_delay = 0.0 if self._last == 0 else self._delays.greatest
        self._delays = _Delays()
        self._doubt, self._least = 0.0, math.inf
        self._doubted = Instant(0)
        self._jumps: deque[Instant] = deque(maxlen=JUMPS)
        self._bad_since: Instant | None = None
        self._bad_for = 0.0

    @property
    def tick_hz(self) -> int:
        """Nominal ticks per second, from the board's descriptor."""
        return self._tick_hz

    @property
    def synchronised(self) -> bool:
        """Whether a poll has been answered since the start."""
        return self._line is not None

    @property
    def unsettled(self) -> bool:
        """Whether to poll again soon, because the map is new or in doubt."""
        return self._line is not None and (self._doubt > 0 or len(self._pairs) < 3)

    @property
    def rate_error(self) -> float:
        """Relative rate error of the board's clock; positive: fast."""
        return 1.0 / self._slope - 1.0

    def trouble(self, now: Instant) -> str | None:
        """Why the board's clock is unusable; None while it is usable."""
        slowest, fastest = self._rates()
        if slowest > RATE_LIMIT or fastest < -RATE_LIMIT:
            off = self.rate_error
            self._rate_trouble = (
                f"it runs {abs(off):.0%} {'fast' if off > 0 else 'slow'} of the "
                f"{_frequency(self._tick_hz)} that the board says, more than the "
                f"{RATE_LIMIT:.0%} of a poor oscillator"
            )
        elif slowest >= -RATE_LIMIT and fastest <= RATE_LIMIT:
            self._rate_trouble = ""
        if self._rate_trouble:  # kept until the map is good enough to tell
            return self._rate_trouble
        recent = [at for at in self._jumps if seconds_between(at, now) <= JUMPS_WITHIN_S]
        if len(recent) >= JUMPS:
            return f"it jumped {JUMPS} times in {seconds_between(recent[0], now):.1f} s"
        if self._line is not None and self._delays.least > LATEST:
            return f"its samples come {self._delays.least:.1f} s after their instants, or later"
        if self._bad_for > WORST_FOR_S:
            return f"its instants are not known to {WORST_ERROR_S * 1e3:.0f} ms"
        return None

    def polled(self, token: int, sent: Instant) -> None:
        """Note that a poll with ``token`` is about to be sent."""
        while len(self._sent) >= OUTSTANDING:
            self._sent.pop(next(iter(self._sent)))
        self._sent[token] = sent

    def replied(self, reply: ClockReply, received: Instant) -> bool:
        """Process the answer to a poll; False when it cannot be used, which is counted."""
        sent = self._sent.pop(reply.token, None)
        if sent is None or received < sent:
            return self._refuse("unasked")
        # Earlier polls have been answered already or never will be.
        self._sent = {token: at for token, at in self._sent.items() if at >= sent}
        arrived = self._unwrap(reply.ticks_received, received)
        left = self._unwrap(reply.ticks_sent, received)
        start, end = self._board(arrived, received), self._board(left, received)
        turnaround = (end - start) / (1 + WIDEST)
        trip = seconds_between(sent, received)
        half = (trip - turnaround) / 2
        if end < start or half < 0:
            return self._refuse("impossible")
        if half > WORST_HALF_WIDTH:
            self._slowest = max(self._slowest, trip)
            return self._refuse("slow")
        middle = (self._host(sent) + self._host(received)) / 2
        pair = _Pair((start + end) / 2, middle, half + 1.0 / self._tick_hz, sent)
        if self._contradicts(pair, received):
            return self._refuse("contradiction")
        if self._doubt and sent >= self._doubted:
            if self._line is not None and self._least <= 2 * self._allowed(pair, self._line):
                self._restart_with(pair)  # this poll is too wide to tell whether the clock jumped
            self._doubt, self._least = 0.0, math.inf
        self._delays.confirm()
        self._keep(pair)
        self.counters["used"] += 1
        return True

    def doubt(self, ticks: float, now: Instant) -> None:
        """Note a sign that the clock jumped by ``ticks``.

        Widens the uncertainty of every stamp until a poll sent after ``now`` settles it.
        """
        low, high = 1 / (1 + WIDEST), 1 / (1 - WIDEST)
        if self._line is not None:
            low = max(low, self._line.slope - self._line.slope_error)
            high = min(high, self._line.slope + self._line.slope_error)
        jump = ticks / self._tick_hz
        self._suspect((jump + 1 / self._tick_hz) * high, jump * low, now)

    def arrived(self, ticks: int, received: Instant) -> None:
        """Add the arrival of a message with ``ticks``; used only before the first answered poll."""
        if self._line is None:
            board = self._board(self._unwrap(ticks, received), received)
            self._arrivals.add(board, self._host(received))

    def stamp(self, ticks: int, received: Instant) -> Stamp:
        """Instant of a 32-bit tick count that arrived at ``received``."""
        long_ticks = self._unwrap(ticks, received)
        board = self._board(long_ticks, received)
        host, error = self._map(board, received)
        mapped = self._instant(host)
        captured = min(mapped, received)
        if self._last_ticks is None or long_ticks > self._last_ticks:
            captured = max(captured, min(self._last, received))
            self._last_ticks, self._last = long_ticks, Instant(captured)
        error += abs(captured - mapped) / NS_PER_S
        if error <= WORST_ERROR_S:
            self._bad_since, self._bad_for = None, 0.0
        else:
            self._bad_since = self._bad_since or received
            self._bad_for = seconds_between(self._bad_since, received)
        return Stamp(Instant(captured), error)

    def place(self, ticks: int, received: Instant) -> Instant:
        """Likely instant of a firmware text with ``ticks``; does not change the map."""
        if self._line is None or self._origin is None:
            return received
        long_ticks = self._ticks.near(ticks, self._since_seen(received))
        host = self._line.at((long_ticks - self._first_ticks) / self._tick_hz)
        late = self._host(received) - host
        return self._instant(host) if 0 <= late <= LOG_AGE_S else received

    def _map(self, board: float, received: Instant) -> tuple[float, float]:
        """Host time of a sample, s, and the bound on its error."""
        if self._line is not None:
            host = self._line.at(board)
            late = self._host(received) - host
            error = self._line.error(board) + 1.0 / self._tick_hz
            hidden = self._delays.add(late)
            if late < -error:
                # It arrived before it was measured, so the clock has jumped by an unknown amount.
                hidden = max(hidden, self._delays.greatest + ONE_WAY_ALLOWANCE)
                self._doubted = received
            if late > WORST_HALF_WIDTH:
                hidden = max(hidden, late)
            return host, error + hidden + self._doubt
        allowance = max(ONE_WAY_ALLOWANCE, self._waited(received)) + 1.0 / self._tick_hz
        if self._before and self._arrivals.span < SETTLING_S:
            # The board has restarted. New samples were measured after the last ones before.
            since = seconds_between(self._before, received)
            allowance = max(allowance, min(since, UNSURE_S), 2 * self._line_delay)
        if not self._arrivals.ready:
            return self._host(received), allowance
        slope_error = SLOPE_ERROR
        if self._arrivals.span > 0:
            slope_error = min(SLOPE_ERROR, allowance / self._arrivals.span)
        lever = abs(board - self._arrivals.middle)
        return self._arrivals.at(board), allowance + self._arrivals.spread + lever * slope_error

    @property
    def _slope(self) -> float:
        """Host s per board s, limited to possible rates."""
        slope = self._line.slope if self._line is not None else self._arrivals.slope
        return min(max(slope, 1 / (1 + WIDEST)), 1 / (1 - WIDEST))

    def _waited(self, now: Instant) -> float:
        """Delay that a message may have, s, judged by polls answered slowly or not yet."""
        oldest = next(iter(self._sent.values()), now)
        return max(self._slowest, seconds_between(oldest, now))

    def _rates(self) -> tuple[float, float]:
        """Lower and upper bound of the relative rate error."""
        error = SLOPE_ERROR
        if self._line is not None:
            error = self._line.slope_error
        elif self._arrivals.span > SETTLING_S:
            error = (ONE_WAY_ALLOWANCE + self._arrivals.spread) / self._arrivals.span
        slope = self._slope
        return 1 / (slope + error) - 1, 1 / max(slope - error, 1e-3) - 1

    def _suspect(self, seconds: float, least: float, now: Instant) -> None:
        """Note that the clock may have jumped, by at least ``least`` and at most ``seconds`` s."""
        self._doubt += seconds
        self._least = min(self._least, least)
        self._doubted = now

    def _refuse(self, reason: str) -> bool:
        self.counters[reason] += 1
        return False

    def _since_seen(self, now: Instant) -> int:
        """Expected number of ticks since the newest count."""
        return round(seconds_between(self._seen, now) * self._tick_hz / self._slope)

    def _unwrap(self, ticks: int, received: Instant) -> int:
        before = self._ticks.last
        if before is not None and self._since_seen(received) > WRAP // 4:
            self.doubt(WRAP, received)  # it may have wrapped more than once
        value = self._ticks.unwrap(ticks, 0 if before is None else self._since_seen(received))
        if before is None or value > before:
            self._seen = received
        return value

    def _board(self, long_ticks: int, now: Instant) -> float:
        if self._origin is None:
            self._origin, self._first_ticks = now, long_ticks
        return (long_ticks - self._first_ticks) / self._tick_hz

    def _host(self, instant: Instant) -> float:
        return (instant - (self._origin or 0)) / NS_PER_S

    def _instant(self, host: float) -> Instant:
        return Instant((self._origin or 0) + round(host * NS_PER_S))

    def _contradicts(self, pair: _Pair, received: Instant) -> bool:
        """Whether ``pair`` contradicts the line.

        The first such pair only raises a doubt. One that comes while the clock is in doubt settles
        it: the clock has jumped, and the map starts over with this pair.
        """
        if self._line is None:
            return False
        distance = abs(pair.host - self._line.at(pair.board))
        allowed = self._allowed(pair, self._line)
        if distance <= allowed:
            return False
        settled = self._doubt > 0 or self._doubted >= pair.sent
        self._suspect(distance + allowed, distance - allowed, received)
        if settled:
            self.counters["jump"] += 1
            self._jumps.append(received)
            self._restart_with(pair)
            self._delays = _Delays()
        return True

    @staticmethod
    def _allowed(pair: _Pair, line: _Line) -> float:
        """Largest difference of a pair and a line that are both correct, s."""
        return pair.half + line.error(pair.board)

    def _restart_with(self, pair: _Pair) -> None:
        """Start over with this pair alone."""
        self._pairs.clear()
        self._pairs.append(pair)
        self._last_ticks = None
        self._line = self._fit()

    def _keep(self, pair: _Pair) -> None:
        pairs = self._pairs
        settled = bool(pairs) and pair.board - pairs[0].board > SETTLING_S
        if settled and int(pairs[-1].board // BUCKET_S) == int(pair.board // BUCKET_S):
            if pair.half >= pairs[-1].half:
                return
            pairs[-1] = pair
        else:
            pairs.append(pair)
        self._line = self._fit()

    def _fit(self) -> _Line:
        """Least-squares line weighted by 1/half², with bounds of its errors.

        The estimate at any point is a weighted sum of the pairs, so its error is at most the sum of
        the half widths with the absolute weights. The possible drift of the rate from a straight
        line is added to each half width.
        """
        weights = [pair.half**-2 for pair in self._pairs]
        total = sum(weights)
        board = sum(w * p.board for w, p in zip(weights, self._pairs, strict=True)) / total
        host = sum(w * p.host for w, p in zip(weights, self._pairs, strict=True)) / total
        sxx = sum(w * (p.board - board) ** 2 for w, p in zip(weights, self._pairs, strict=True))
        slope = 1.0
        if sxx > 0:
            slope = sum(
                w * (p.board - board) * (p.host - host)
                for w, p in zip(weights, self._pairs, strict=True)
            )
            slope /= sxx
        bend = RATE_CHANGE * max(1.0, slope) ** 3
        offset_error = lever = 0.0
        for w, p in zip(weights, self._pairs, strict=True):
            away = abs(p.board - board)
            error = p.half + bend / 2 * away * away
            offset_error += w * error
            lever += w * away * error
        slope_error = lever / sxx if sxx > 0 else math.inf
        if slope_error > SLOPE_ERROR:
            slope, slope_error = 1.0, SLOPE_ERROR
        return _Line(board, host, slope, offset_error / total, slope_error, bend)


class StepWatch:
    """Detects jumps of the clock, which make an array's ticks disagree with its sequence.

    Finds jumps larger than the usual variation of steps, at the first sample after them.
    """

    def __init__(self) -> None:
        self.restart()

    def restart(self) -> None:
        """Forget the steps: rate, clock or board has changed."""
        self._newest: tuple[int, int] | None = None
        self._steps: deque[float] = deque(maxlen=STEPS)
        self._usual: deque[float] = deque(maxlen=4 * STEPS)

    def take(self, sequence: int, ticks: int) -> float:
        """Unexplained part of this sample's step, ticks; 0 while steps are being learnt."""
        before, self._newest = self._newest, (sequence, ticks)
        if before is None:
            return 0.0
        count = (sequence - before[0]) % WRAP
        step = (ticks - before[1] + WRAP // 2) % WRAP - WRAP // 2
        known = len(self._steps) >= LEAST_STEPS
        usual = sorted(self._steps)[len(self._steps) // 2] if known else 0.0
        self._steps.append(step / count)
        if not known:
            return 0.0
        odd = abs((ticks - before[1] - round(count * usual) + WRAP // 2) % WRAP - WRAP // 2)
        allowed = 2 + 3 * max(self._usual, default=0.0) + 1e-3 * count * usual
        if odd > allowed:
            return float(odd)
        self._usual.append(odd)
        return 0.0


STEPS, LEAST_STEPS = 9, 3
"""Steps whose median is the usual step, and the fewest needed."""


def _frequency(hz: int) -> str:
    for factor, unit in ((1e6, "MHz"), (1e3, "kHz")):
        if hz >= factor:
            return f"{hz / factor:g} {unit}"
    return f"{hz} Hz"


# A clock for boards without one: frame k was sent at phase + k·period, and arrived later.


BUCKET = 16
"""Frames in a bucket, of which the least delayed is kept: a USB burst is shorter."""

BUCKETS = 16
"""Buckets in the regression: 256 frames, 2.5 s at 100 Hz, to track a changed rate."""

SCATTER = 3.0
"""Error of the line as a multiple of the scatter of the buckets' earliest arrivals, to which 1.5
times the mean jitter is added: the earliest of sixteen is late itself."""

UNPROVEN = 3.0
"""Largest delay as a multiple of the range of delays so far, while there are few."""

PROVEN = 4
"""Fewest buckets whose scatter about the line measures its quality; two always lie on it."""

LATE_RUN = 8
"""Reads in a row that must be late before frames count as lost: after a stall of the host a few
reads catch up, after a loss they do not."""

LATE = 0.75
"""Lateness in periods from which a read counts towards such a run."""

TOGETHER = 0.25
"""Periods; frames closer than this had the same delay and count as one read."""

RESTARTS_AFTER = 3
"""Losses within one window after which the period itself must be wrong."""

LEARNING = 2 * BUCKET
"""Frames for the first estimate of the period; until then arrivals are the stamps."""

LEARNING_LEAST, LEARNING_S = 6, 1.0
"""Fewest frames if they span this many s: jitter is then small compared with the period."""

MIN_PERIOD = 5e-4
"""s, a quarter of the chip's shortest period; a shorter one is a backlog being read."""

UNLEARNT = 0.05
"""s, least uncertainty until then: the period of the slowest common board (ReSkin, 20 Hz)."""

LINE_DELAY = 2e-3
"""s that every frame may take from board to host, which arrivals cannot show: two USB frames and
the wait for the reading thread."""


@dataclass(frozen=True, slots=True)
class Arrival:
    """A frame's number, which counts lost frames too, and its stamp."""

    sequence: int
    stamp: Stamp


class ArrivalClock:
    """Numbers and stamps frames that carry neither; pure, fed with arrivals in order.

    The content of a frame was measured within the period before it was sent. Its stamp is therefore
    half a period before its jitter-free arrival; the uncertainty is half a period plus the scatter
    of the earliest arrivals and `LINE_DELAY`. Frames read together get different stamps.
    ``counters``: frames considered lost, and restarts of the model.
    """

    def __init__(self) -> None:
        self.counters: Counter[str] = Counter()
        self._sequence = -1
        self._last = Instant(0)
        self._guess = 0.0
        self._longest = SLOWEST_S
        self._forget()

    def restart(self) -> None:
        """Forget the phase; the period is kept as a guess, and the numbering continues."""
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
        """Estimated period, s; 0 while it is being learnt."""
        return 0.0 if self._envelope is None else max(self._envelope.slope, 0.0)

    def heard(self, received: Instant) -> None:
        """Learn from a frame that is not used."""
        self._place(received)

    def arrived(self, received: Instant, behind: int = 0, newest: Instant | None = None) -> Arrival:
        """Number and stamp the frame that arrived at ``received``, wire time already subtracted.

        ``behind``: number of later frames in the same read; ``newest``: arrival of the last of
        them.
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
        """Origin, jitter-free arrival in s after it, and its uncertainty, s."""
        origin = self._origin = self._origin or received
        self._index += 1
        host = seconds_between(origin, received)
        if behind:
            # It was sent ``behind`` periods before the newest, which was sent before it arrived.
            earlier = seconds_between(origin, newest or received)
            host = min(host, earlier - behind * (self.period or self._guess))
        if self._envelope is None:
            self._learn(host)
            period = self.period or self._guess
            return origin, host, max(UNLEARNT, 2 * self._longest, period)
        ideal, error = self._follow(host, received, behind, self._envelope)
        return origin, min(ideal, host), error

    def _learn(self, host: float) -> None:
        """Estimate the period by least squares once enough frames have arrived."""
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
        """Jitter-free arrival and its uncertainty, both s; advances the numbers after a loss."""
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
            if not behind:  # earlier frames of the same read were delayed at least as much
                envelope.add(self._index, host)
                self._scatter = max(self._scatter, late)
                self._jitter += (max(late, 0.0) - self._jitter) / BUCKET
            if envelope.buckets < PROVEN:
                # The line is not better than the arrival itself yet.
                return host, self.period / 2 + UNPROVEN * self._scatter + max(late, 0.0)
            late = 0.0
        scatter = SCATTER * envelope.spread + 1.5 * self._jitter + self._unproven(envelope)
        return envelope.at(self._index), self.period / 2 + scatter + late

    def _unproven(self, envelope: LowerEnvelope) -> float:
        """Error of the line, s, while there are too few buckets to measure it."""
        return 0.0 if envelope.buckets >= PROVEN else UNPROVEN * self._scatter

    def _judge(self, late: float) -> bool:
        """Add the lateness of one read, in periods; False when the model must be wrong."""
        self._late.append(late)
        if len(self._late) < LATE_RUN:
            return True
        if max(self._late) < -LATE:
            return False
        least = min(self._late)
        proven = self._envelope is not None and self._envelope.buckets >= PROVEN
        return least <= LATE or not proven or self._count_lost(max(round(least), 1))

    def _count_lost(self, lost: int) -> bool:
        """Count lost frames; False when losses are so frequent that the period must be wrong."""
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
