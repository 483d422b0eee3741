"""Ambient field of an array of few magnetometers, all of which may be under the same contact.

A plane cannot be fitted to five chips in every frame, because a press reaches them all. So ambient
field and contact are tracked together over time. One Kalman filter per array, a quarter of a second
behind the present, estimates the ambient field ``b``, equal at every chip, and the contribution of
contact at each chip, ``c_i``:

    d_i = b + c_i + noise

A chip is *free* (its ``c_i`` is zero, so it measures ``b``), *loaded* (its ``c_i`` is constant, so
it measures changes of ``b``) or *changing* (it measures nothing). Which chips change is decided in
the present: by the ambient field for which the fewest have changed, each at a price. The filter
takes a frame only once it is known which chips changed soon after it, so that the slow beginning of
a press is never taken for the ambient field.

Limits: a contact that slowly loads all chips alike cannot be told from the ambient field, nor can a
field that turns while all chips are loaded be told from their contact; the bound then grows.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tactile_core.arrays import FloatArray

Bool = NDArray[np.bool_]

LAG_S = 0.25
"""s by which the filter lags: the onset of a press is shorter."""
LAG_FRAMES = (3, 64)
"""Fewest and most frames of that lag, at very low and very high rates."""
SMOOTH_S = 0.05
"""s over which the present is averaged to judge the chips."""
EVENT = 13.0
"""Price of a contact that begins or begins to change, as squared distance over variance: −2 ln of
one in 700 frames."""
PRESSED, OTHER = 7.0, 11.0
"""Least price of a changed chip, with a reading that a press makes, and with any other."""
NEAR_UT, NEAR_SHEAR_UT = 16.0, 5.0
"""µT rms, along and across the direction of a press, that a contact may add at the array's other
chips without being noticed at once."""
TURN = 20.0
"""Price of an arm that begins or stops turning while nothing touches."""
FIRM_UT = 40.0
"""µT; a contact above this cannot be noise."""
TURN_TOUCHED = 100.0
"""Price of a turn while something touches: a change of the contact is more likely."""
LEAP = 60.0
"""Price of a leap of the ambient field by more than turning explains."""
LEAP_SHARE = 0.8
"""Share of the chips that must agree on a leap."""
LEAST_LEAP_UT = 80.0
"""µT, smallest leap; less is a turn that was missed."""
EARTH_UT = 130.0
"""µT, largest possible change of the earth's field: 65 µT reversed."""
LOST_UT = 60.0
"""µT rms per component, uncertainty of the field after an estimate exceeded that."""
SHEAR = 0.6
"""Largest shear over normal force of a usual press: friction of skin."""
ROUNDS = 4
"""Steps of the search from each start; it converges after three or four."""
OPEN_UT = 3000.0
"""µT rms, range of the contact at a chip after it has changed."""
MODEL_ERROR_UT = 1.5
"""µT rms by which chips differ in a uniform field: 3 % sensitivity in 50 µT."""
UNEVEN = 0.02
"""Share by which chips differ in a field that leaps."""
CALM_UT_PER_S = 0.3
"""µT/s rms, change of the ambient field while nothing moves: chips warm up."""
TURNING_UT_PER_S = 60.0
"""µT/s rms, fastest change of the ambient field: an arm turning at 1 rad/s in 60 µT."""
UNSTEADY = 0.3
"""Share by which the rate of a turning arm may change within the lag."""
KNOWN_UT = 6.0
"""µT rms within which the field must be known before its rate is used."""
MOVING_UT_PER_S = 8.0
"""µT/s above which the arm counts as turning: an arm at 0.15 rad/s."""
PACE_TAU_S = 0.2
"""s over which that rate is averaged."""
CREEP_PER_S = 0.012
"""Share of a contact by which it creeps in the first second, at all chips alike: rubber yields by
4 % in 8 s."""
UNEVEN_CREEP_PER_S = 0.004
"""The same, for each chip on its own."""
ALIKE_CHIPS = 3
ALIKE_SHARE = 0.6
"""Fewest chips, and share of the array's, with equal contact for that to be the ambient field."""
ALIKE = 9.0
"""Squared distance over variance within which contacts are equal."""
LEAST_ALIKE_UT = 8.0
"""µT; smaller equal contacts are left alone."""
LEAN_TAU_S = 0.3
"""s over which deviations of readings from the filter's are averaged."""
LEAN_RATIO = 3.0
"""Variance of that mean among loaded chips, over that of noise, above which contact changes."""
LEAN_GAIN = 3.0
"""Multiple of that mean by which a contact may then change within `LEAN_TAU_S`."""
RELEASED_SHARE = 0.03
"""Share of its recent peak below which a chip's contact may be unrecovered rubber (hysteresis of 1
to 6 %, decaying within seconds)."""
RECOVERY_S = 5.0
"""s, time constant with which that peak decays."""
RELEASED_SIGMAS = 2.5
"""Standard deviations below which a contact counts as released."""


@dataclass(frozen=True, slots=True, eq=False)
class SmallEstimate:
    """Result of one frame.

    ``field``: ambient field since the tare, (3,) µT in ``ee``. ``sigma``: its uncertainty, (3,) µT
    rms. ``free``: (n,) bool, chips without contact. ``changing``: (n,) bool. ``leap``: µT by which
    the field has leapt, more than turning explains; else 0. ``left_over``: residual of the chips
    that the field explains, µT rms. ``moving``: whether the field is turning.
    """

    field: FloatArray
    sigma: FloatArray
    free: Bool
    changing: Bool
    leap: float
    left_over: float
    moving: bool


@dataclass(slots=True, eq=False)
class _Frame:
    target: FloatArray
    healthy: Bool
    elapsed: float
    changing: Bool
    pace: FloatArray | None = None  # rate of the ambient field as of this frame, (3,) µT/s


class SmallArray:
    """The filter of one array of ``n`` taxels; memory, and time per frame, are bounded."""

    def __init__(self, direction: FloatArray) -> None:
        """``direction``: (3, n) unit vectors in ``ee`` along which a press changes the field."""
        self._n = direction.shape[1]
        self._direction = direction
        self.set_noise(np.array([4.4, 4.4, 6.7]))
        self.reset()

    def set_noise(self, noise: FloatArray) -> None:
        """Set the noise of one sample, (3,) µT rms along ``ee``."""
        self._noise: FloatArray = noise**2
        self._variance: FloatArray = noise**2 + MODEL_ERROR_UT**2

    def reset(self, unknown: float = 0.0) -> None:
        """Start with no contact and zero ambient field, ± ``unknown`` µT rms per component."""
        n = self._n
        self._state = np.zeros((3, n + 1))  # b, then c of each chip
        self._cov = np.zeros((3, n + 1, n + 1))
        self._cov[:, 0, 0] = 1.0 + unknown**2
        self._free = np.ones(n, dtype=bool)
        self._peak = np.zeros(n)
        self._waiting: deque[_Frame] = deque()
        self._behind = 0.0  # s of the frames that wait
        self._mean: FloatArray | None = None
        self._mean_variance = 1.0
        self._near = np.zeros(n, dtype=bool)
        self._lean = np.zeros((3, n))
        self._lean_weight = 1.0
        self._pace = np.zeros(3)  # µT/s

    def update(self, target: FloatArray, healthy: Bool, elapsed: float) -> SmallEstimate:
        """Process one frame.

        ``target``: (3, n) µT in ``ee`` over rest, without the crosstalk of neighbours' contacts.
        ``healthy``: (n,). ``elapsed``: s since the last frame.
        """
        frame = _Frame(target, healthy, elapsed, np.zeros(self._n, dtype=bool))
        self._waiting.append(frame)
        self._behind += elapsed
        self._smooth(target, elapsed)
        said = self._judge(frame)
        least, most = LAG_FRAMES
        while len(self._waiting) > least and (
            self._behind - self._waiting[0].elapsed > LAG_S or len(self._waiting) > most
        ):
            self._take(self._waiting.popleft())
        return said

    # The present

    def _smooth(self, target: FloatArray, elapsed: float) -> None:
        """Average the frames of the last `SMOOTH_S`; at low rates, only the last frame."""
        if self._mean is None:
            self._mean = target.copy()
            self._mean_variance = 1.0
            return
        share = -math.expm1(-elapsed / SMOOTH_S)
        # without this, the mean of a steadily moving field would lag by its time constant
        self._mean += (self._pace * elapsed)[:, None]
        self._mean += share * (target - self._mean)
        self._mean_variance = (1 - share) ** 2 * self._mean_variance + share**2

    def _judge(self, frame: _Frame) -> SmallEstimate:
        """Estimate the present ambient field, and which chips changed since the filter's time."""
        state, cov = self._state, self._cov
        seen = np.flatnonzero(frame.healthy)
        moved, unsteady, turning = self._moved()
        prior = cov[:, 0, 0] + unsteady**2
        known = float(cov[:, 0, 0].max()) < KNOWN_UT**2
        if not seen.size or self._mean is None:
            return self._result(moved, prior, frame.changing, 0.0, 0.0)
        own = np.diagonal(cov, axis1=1, axis2=2)[:, 1:][:, seen]
        ambient = (state[:, 0] + moved)[:, None]
        contact = state[:, 1 + seen]
        away = np.stack([frame.target[:, seen], self._mean[:, seen]], axis=1)
        away = away - (contact + ambient)[:, None]  # (3, 2, k)
        noise = np.stack([self._noise, self._noise * self._mean_variance], axis=1)
        spread = own[:, None] + noise[:, :, None] + MODEL_ERROR_UT**2
        vote = _Vote(away, spread, contact, self._direction[:, seen], not self._free.all())
        surprise = cov[:, 0, 0] + turning**2
        inside, kind, leap = vote.result(prior, surprise)
        frame.changing[seen[~inside]] = True
        if leap:
            prior = np.full(3, OPEN_UT**2)
        elif kind == 1:
            prior = surprise
        # the mean is best for a steadily moving field, the newest frame for one that has just
        # begun to move
        signal = 0 if kind else 1
        chosen = away[:, signal][:, inside]
        shift, variance = self._locate(chosen, seen[inside], prior, noise[:, signal])
        left = chosen - shift[:, None]
        left_over = math.sqrt(float((left**2).mean())) if left.size else 0.0
        if not leap and known:
            frame.pace = (moved + shift) / max(self._behind, 1e-3)
        return self._result(moved + shift, variance, frame.changing, leap, left_over)

    def _locate(
        self, away: FloatArray, chips: NDArray[np.intp], prior: FloatArray, noise: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Shift of the ambient field from the deviations ``away`` (3, k) of ``chips``, and its
        variance, (3,) each."""
        cov = self._cov
        if not chips.size:
            return np.zeros(3), prior
        rows = prior[:, None] + cov[:, 0, 1 + chips]
        inner = cov[:, 1 + chips][:, :, 1 + chips] + cov[:, 0, 1 + chips][:, :, None]
        inner += rows[:, None, :]
        k = np.arange(len(chips))
        inner[:, k, k] += noise[:, None] + MODEL_ERROR_UT**2
        gain = np.linalg.solve(inner, rows[:, :, None])[:, :, 0]
        return (gain * away).sum(axis=1), np.maximum(prior - (gain * rows).sum(axis=1), 0.0)

    def _moved(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Motion of the field since the filter's time, (3,) µT each: expected for a steady motion,
        its uncertainty, and the uncertainty if the motion has just begun or ended.
        """
        pace, behind = self._pace, self._behind
        doubt = max(CALM_UT_PER_S, UNSTEADY * float(np.linalg.norm(pace)))
        moved = pace * behind
        unsteady, turning = np.full(3, doubt * behind), np.full(3, TURNING_UT_PER_S * behind)
        return moved, unsteady, turning

    def _follow_pace(self, frame: _Frame, seen: FloatArray) -> None:
        """Average the observed rate of the ambient field, ``seen`` (3,) µT/s."""
        share = -math.expm1(-frame.elapsed / PACE_TAU_S)
        pace = self._pace + share * (seen - self._pace)
        fast = float(np.linalg.norm(pace))
        if fast > 2 * TURNING_UT_PER_S:
            pace *= 2 * TURNING_UT_PER_S / fast
        self._pace = pace

    def _result(
        self, shift: FloatArray, variance: FloatArray, changing: Bool, leap: float, left_over: float
    ) -> SmallEstimate:
        return SmallEstimate(
            self._state[:, 0] + shift,
            np.sqrt(variance),
            self._free & ~changing,
            changing.copy(),
            leap,
            left_over,
            float(np.linalg.norm(self._pace)) >= MOVING_UT_PER_S,
        )

    # The filter, which lags

    def _take(self, frame: _Frame) -> None:
        """Let the filter take the oldest frame, given the frames after it."""
        self._behind -= frame.elapsed
        changing = frame.changing.copy()
        for later in self._waiting:
            changing |= later.changing
        state, cov = self._state, self._cov
        self._drift(frame)
        index = 1 + np.flatnonzero(changing)
        cov[:, index, index] += OPEN_UT**2
        self._free &= ~changing
        self._near &= ~changing
        if self._free.all():
            self._near[:] = False
        else:
            # a contact reaches neighbours too, by too little to be told from noise at once
            fresh = 1 + np.flatnonzero(self._free & ~self._near)
            along = self._direction[:, fresh - 1] ** 2
            cov[:, fresh, fresh] += along * NEAR_UT**2 + (1 - along) * NEAR_SHEAR_UT**2
            self._near |= self._free
        seen = np.flatnonzero(frame.healthy)
        if seen.size:
            self._loosen(frame, seen)
            self._absorb(frame.target, seen)
        self._release(frame.healthy & ~changing)
        self._reinterpret(frame.healthy & ~changing)
        size = float(np.linalg.norm(state[:, 0]))
        if size > EARTH_UT and 2 * np.count_nonzero(self._free) <= self._n:
            # creep of a contact was taken for the ambient field
            state[:, 0] *= EARTH_UT / size
            cov[:, 0, 0] = np.maximum(cov[:, 0, 0], LOST_UT**2)
        load = np.linalg.norm(state[:, 1:], axis=0)
        self._peak = np.maximum(load, self._peak * math.exp(-frame.elapsed / RECOVERY_S))
        covered = 2 * np.count_nonzero(self._free) < self._n
        moving = float(np.linalg.norm(self._pace)) >= MOVING_UT_PER_S
        firm = float(load.max()) > FIRM_UT
        if covered and firm and not moving:
            # a common change of all chips may be the contact
            self._follow_pace(frame, np.zeros(3))
        elif frame.pace is not None and not changing.any():
            self._follow_pace(frame, frame.pace)

    def _drift(self, frame: _Frame) -> None:
        """Let time pass: the ambient field moves on, loaded chips creep."""
        cov, elapsed = self._cov, frame.elapsed
        self._state[:, 0] += self._pace * elapsed
        # the unknown part is the same from frame to frame, so deviations add up
        step = max(CALM_UT_PER_S, UNSTEADY * float(np.linalg.norm(self._pace))) * elapsed
        cov[:, 0, 0] += (2.0 * np.sqrt(cov[:, 0, 0]) + step) * step
        contact = np.where(self._free, 0.0, self._state[:, 1:])
        cov[:, 1:, 1:] += CREEP_PER_S**2 * elapsed * contact[:, :, None] * contact[:, None, :]
        index = np.arange(1, self._n + 1)
        cov[:, index, index] += UNEVEN_CREEP_PER_S**2 * elapsed * contact**2

    def _loosen(self, frame: _Frame, seen: NDArray[np.intp]) -> None:
        """Let loaded chips change while their readings deviate unevenly from the expected ones.

        A slowly growing contact changes each chip differently, the ambient field all alike.
        """
        share = -math.expm1(-frame.elapsed / LEAN_TAU_S)
        away = frame.target - self._state[:, 1:] - self._state[:, :1]
        self._lean[:, seen] += share * (away - self._lean)[:, seen]
        self._lean_weight = (1 - share) ** 2 * self._lean_weight + share**2
        loaded = np.zeros(self._n, dtype=bool)
        loaded[seen] = ~self._free[seen]
        if np.count_nonzero(loaded) < 2:
            return
        lean = self._lean[:, loaded]
        uneven = ((lean - lean.mean(axis=1, keepdims=True)) ** 2).sum()
        noise = self._lean_weight * float(self._variance.sum()) * (np.count_nonzero(loaded) - 1)
        if uneven > LEAN_RATIO * noise:
            index = 1 + np.flatnonzero(loaded)
            moved = (LEAN_GAIN * np.abs(lean)) ** 2
            self._cov[:, index, index] += moved * min(1.0, frame.elapsed / LEAN_TAU_S)

    def _absorb(self, target: FloatArray, seen: NDArray[np.intp]) -> None:
        """Kalman update with the chips ``seen``."""
        state, cov = self._state, self._cov
        rows = cov[:, 0, :][:, None, :] + cov[:, 1 + seen, :]  # H P
        inner = rows[:, :, 0][:, :, None] + rows[:, :, 1 + seen]  # H P H'
        k = np.arange(len(seen))
        inner[:, k, k] += self._variance[:, None]
        gain = np.linalg.solve(inner, rows)  # (3, k, n + 1)
        away = target[:, seen] - state[:, :1] - state[:, 1 + seen]
        state += (gain * away[:, :, None]).sum(axis=1)
        cov -= rows.swapaxes(1, 2) @ gain
        cov += cov.swapaxes(1, 2).copy()
        cov *= 0.5

    def _release(self, judged: Bool) -> None:
        """Free the chips whose contact is gone."""
        state, cov = self._state, self._cov
        for i in np.flatnonzero(~self._free & judged).tolist():
            own = cov[:, 1 + i, 1 + i]
            slack = (RELEASED_SHARE * self._peak[i]) ** 2
            distance = (state[:, 1 + i] ** 2 / (own + slack + MODEL_ERROR_UT**2)).sum()
            if distance < RELEASED_SIGMAS**2:
                # while its neighbours are loaded it may still bear a little
                self._free[i] = self._near[i] = True
        if self._free.all():
            for i in np.flatnonzero(self._near).tolist():
                self._pin(i, (RELEASED_SHARE * self._peak[i]) ** 2)
            state[:, 1:] = 0.0
            cov[:, 1:, :] = 0.0
            cov[:, :, 1:] = 0.0

    def _reinterpret(self, judged: Bool) -> None:
        """Move an equal contact of most chips, if no press explains it, to the ambient field."""
        state, cov = self._state, self._cov
        chips = np.flatnonzero(judged)
        if self._free.all() or chips.size < ALIKE_CHIPS:
            return
        index = 1 + chips
        contact = state[:, index]
        common = np.median(contact, axis=1)
        spread = cov[:, index, index] + MODEL_ERROR_UT**2
        alike = ((contact - common[:, None]) ** 2 / spread).sum(axis=0) < ALIKE
        size = float(np.linalg.norm(common))
        enough = max(ALIKE_CHIPS, ALIKE_SHARE * self._n)
        if np.count_nonzero(alike) < enough or not LEAST_ALIKE_UT < size < 2 * EARTH_UT:
            return
        direction = self._direction[:, chips[alike]].mean(axis=1)
        along = float(common @ direction)
        across = float(np.linalg.norm(common - along * direction))
        if along > 0 and across <= SHEAR * along + LEAST_ALIKE_UT:
            return
        state[:, 0] += common
        state[:, 1:] -= common[:, None]
        for i in chips[alike].tolist():
            self._pin(i, 0.0)

    def _pin(self, i: int, slack: float) -> None:
        """Set the contact of chip ``i`` to zero, to within ``slack`` µT²."""
        state, cov = self._state, self._cov
        column = cov[:, :, 1 + i].copy()
        total = column[:, 1 + i] + slack + MODEL_ERROR_UT**2
        gain = column / total[:, None]
        state -= gain * state[:, 1 + i][:, None]
        cov -= gain[:, :, None] * column[:, None, :]
        self._free[i] = self._near[i] = True


class _Vote:
    """Finds the chips that have changed, by the cheapest explanation of the readings.

    For S signals (the frame and the mean of the last few) of k chips: ``away`` (3, S, k) deviation
    from the expected, µT; ``spread`` (3, S, k) its variance without that of the ambient field, µT²;
    ``contact`` (3, k) present contribution of contact, µT; ``direction`` (3, k) of a press.
    ``touched``: there is contact already.

    A changed chip costs the more, the more precisely its new contact is known relative to its
    possible range, and more again when no press explains it. An explanation costs the sum of its
    changed chips, an `EVENT` where a contact begins, the distance of its ambient field from the
    expected, and the price of its kind: 0 steady, 1 a turn that begins or ends, 2 a leap.
    """

    def __init__(
        self,
        away: FloatArray,
        spread: FloatArray,
        contact: FloatArray,
        direction: FloatArray,
        touched: bool,
    ) -> None:
        self._away, self._spread = away, spread
        self._contact, self._direction = contact, direction
        self._event = 0.0 if touched else EVENT
        load = np.sqrt((contact**2).sum(axis=0))
        self._turn = TURN_TOUCHED if touched and load.max() > FIRM_UT else TURN
        self._loaded = load > 10.0 * np.sqrt(spread[:, 0].mean(axis=0))
        self._unit = contact / np.maximum(load, 1e-9)
        self._sigma = np.sqrt(spread.mean(axis=0))  # (S, k)

    def result(self, steady: FloatArray, turning: FloatArray) -> tuple[Bool, int, float]:
        """Chips (k,) unchanged in the best explanations of both signals, the kind, and the size of
        a leap, µT.

        ``steady``, ``turning``: variance of the ambient field in either kind, (3,) µT².
        """
        away, spread = self._away, self._spread
        chips = away.shape[2]
        precision = np.stack([1.0 / steady, 1.0 / turning, np.zeros(3)], axis=1)  # (3, kinds)
        kinds = 3 if chips >= 3 else 2
        precision = precision[:, :kinds]
        ordered = np.sort(away, axis=2)  # np.median takes three times as long on so few
        median = (ordered[:, :, (chips - 1) // 2] + ordered[:, :, chips // 2]) / 2
        starts = np.concatenate(
            [
                np.zeros_like(away[:, :, :1]),
                median[..., None],
                away.mean(axis=2, keepdims=True),
                away,
            ],
            axis=2,
        )  # (3, S, s)
        shift = np.repeat(starts[:, :, None], kinds, axis=2)  # (3, S, kinds, s)
        weight = 1.0 / spread[:, :, None, None]
        weighted = away[:, :, None, None] * weight
        bound = precision[:, None, :, None] + 1e-12
        before = None
        for _ in range(ROUNDS):
            distance, price = self._prices(shift)
            inside = distance < price
            if before is not None and (inside == before).all():
                break  # no further round would change anything
            before = inside
            shift = (weighted * inside).sum(axis=4) / ((weight * inside).sum(axis=4) + bound)
        whole = weighted.sum(axis=4) / (weight.sum(axis=4) + bound)  # no chip has changed
        shift = np.concatenate([shift, whole], axis=3)
        distance, price = self._prices(shift)
        changes = np.minimum(distance, price).sum(axis=3) + self._event
        cost = np.minimum(distance.sum(axis=3), changes)
        cost += (shift**2 * precision[:, None, :, None]).sum(axis=0)
        cost += np.array([0.0, self._turn, LEAP])[:kinds, None]
        keeps = (distance < price) | (distance.sum(axis=3) <= changes)[..., None]
        if kinds == 3:
            few = keeps[:, 2].sum(axis=2) < LEAP_SHARE * chips
            cost[:, 2][few | ((shift[:, :, 2] ** 2).sum(axis=0) < LEAST_LEAP_UT**2)] = np.inf
        flat = cost.reshape(len(cost), -1).argmin(axis=1)
        kept = np.ones(chips, dtype=bool)
        kind, leap = 0, 0.0
        for signal, best in enumerate(flat.tolist()):
            which, start = divmod(best, cost.shape[2])
            kept &= keeps[signal, which, start]
            if which == 2:
                leap = max(leap, float(np.linalg.norm(shift[:, signal, which, start])))
            kind = max(kind, which)
        return kept, kind, leap

    def _prices(self, shift: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Squared distance of each chip and the price of its change, (S, kinds, s, k) each."""
        rest = self._away[:, :, None, None] - shift[..., None]
        spread = self._spread[:, :, None, None]
        slack = spread
        if shift.shape[2] == 3:
            slack = np.repeat(spread, 3, axis=2)
            slack = slack + np.zeros_like(rest)
            slack[:, :, 2] += (UNEVEN**2 * (shift[:, :, 2] ** 2).sum(axis=0))[None, ..., None]
        distance = (rest**2 / slack).sum(axis=0)
        after = rest + self._contact[:, None, None, None]
        along = (after * self._direction[:, None, None, None]).sum(axis=0)
        across = np.sqrt(np.maximum((after**2).sum(axis=0) - along**2, 0.0))
        sigma = self._sigma[:, None, None]
        pressed = across <= SHEAR * np.maximum(along, 0.0) + 3.0 * sigma
        # a contact that grows or shrinks changes a chip along its present contribution
        more = np.abs((rest * self._unit[:, None, None, None]).sum(axis=0))
        change = (rest**2).sum(axis=0)
        aside = np.sqrt(np.maximum(change - more**2, 0.0))
        pressed |= self._loaded & (aside <= SHEAR * more + 3.0 * sigma)
        size = np.sqrt(change) / sigma
        price = np.where(
            pressed,
            PRESSED + 2.0 * np.log1p(size) + 4.0 * np.log1p(0.35 * size),
            OTHER + 6.0 * np.log1p(size),
        )
        return distance, price
