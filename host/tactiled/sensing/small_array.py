"""Ambient field of an array of few magnetometers, all of which may feel the same contact.

Five chips cannot be fitted with a plane in every frame: a press reaches them all. So ambient field
and contact are followed together over time. One Kalman filter an array, a quarter of a second
behind the present, holds the ambient field ``b``, the same at every chip, and what contact adds at
each chip, ``c_i``:

    d_i = b + c_i + noise

A chip is *free* (its ``c_i`` is zero: it tells ``b`` itself), *loaded* (its ``c_i`` is what it
was: it tells how ``b`` has changed since) or *changing* (it tells nothing). Which ones change is
decided in the present, where the ambient field is sought that leaves the fewest of them, each at a
price; the filter takes a frame only when it is known which chips changed soon after it, so that
the slow beginning of a press is never taken for the field of the room.

What cannot be known: a contact that loads all chips alike, slowly, is not told from the field of
the room; nor is a field that turns while all chips are loaded told from their contact, which is
why the bound then grows.
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
"""s by which the filter is behind: presses begin within it."""
LAG_FRAMES = (3, 64)
"""Fewest and most frames that it is behind, at very low and very high rates."""
SMOOTH_S = 0.05
"""s over which the present is averaged before chips are judged by it."""
EVENT = 13.0
"""Price of a contact that begins, or begins to change, in units of squared distance over variance;
−2 ln of one in 700 frames."""
PRESSED, OTHER = 7.0, 11.0
"""Least price of a chip that takes part in it, where it reads what a press makes and where not."""
NEAR_UT, NEAR_SHEAR_UT = 16.0, 5.0
"""µT rms along a press and across it that a contact may add at the other chips of the array
without being seen at once."""
TURN = 20.0
"""Price of an arm that begins to turn, or stops, while nothing touches."""
FIRM_UT = 40.0
"""µT of a contact that is more than what noise may pass for."""
TURN_TOUCHED = 100.0
"""The same while something touches: that the contact changes is more likely."""
LEAP = 60.0
"""Price of an ambient field that leaps by more than turning explains."""
LEAP_SHARE = 0.8
"""Share of the chips that must have leapt alike."""
LEAST_LEAP_UT = 80.0
"""µT of a leap; less is a turn that was missed."""
EARTH_UT = 130.0
"""Most that the earth's field can change: 65 µT turned round."""
LOST_UT = 60.0
"""µT rms a component, how well the field is known when it was taken for more than that."""
SHEAR = 0.6
"""Greatest shear over normal force of a press that is nothing unusual: friction of skin."""
ROUNDS = 4
"""Steps of the search from each start; it has settled after three or four."""
OPEN_UT = 3000.0
"""µT rms, what the contact at a chip may be after it has changed."""
MODEL_ERROR_UT = 1.5
"""µT rms by which chips differ in a uniform field: 3 % sensitivity in 50 µT."""
UNEVEN = 0.02
"""Share by which they differ in a field that leaps."""
CALM_UT_PER_S = 0.3
"""µT/s rms, how fast the field of the room changes while nothing moves: chips that warm up."""
TURNING_UT_PER_S = 60.0
"""µT/s rms, how fast it may change at all: an arm at 1 rad/s in 60 µT."""
UNSTEADY = 0.3
"""Share by which the pace of a turning arm may change within the lag."""
KNOWN_UT = 6.0
"""µT rms within which the field must be known before its pace is believed."""
MOVING_UT_PER_S = 8.0
"""µT/s from which the arm is seen to turn: an arm at 0.15 rad/s."""
PACE_TAU_S = 0.2
"""s over which that pace is averaged."""
CREEP_PER_S = 0.012
"""Share of a contact that creeps in the first second, at all chips alike: rubber yields by 4 % in
8 s."""
UNEVEN_CREEP_PER_S = 0.004
"""The same, at each chip by itself."""
ALIKE_CHIPS = 3
ALIKE_SHARE = 0.6
"""Chips, and share of the array's, that must bear the same for it to be the ambient field."""
ALIKE = 9.0
"""Squared distance over variance within which contacts are the same."""
LEAST_ALIKE_UT = 8.0
"""µT below which it does not matter."""
LEAN_TAU_S = 0.3
"""s over which readings that lean away from the filter's are averaged."""
LEAN_RATIO = 3.0
"""Variance of that mean among loaded chips over noise alone, from which their contact changes."""
LEAN_GAIN = 3.0
"""How many times the lean a contact may change within `LEAN_TAU_S`."""
RELEASED_SHARE = 0.03
"""Share of its recent peak below which a chip's contact may be what the rubber has not recovered
(hysteresis of 1 to 6 %, falling within seconds)."""
RECOVERY_S = 5.0
"""s, time constant with which rubber forgets its peak."""
RELEASED_SIGMAS = 2.5
"""Standard deviations below which a contact counts as released."""


@dataclass(frozen=True, slots=True, eq=False)
class Small:
    """What one frame says.

    ``field``: (3,) µT in ``ee``, the ambient field since the tare. ``sigma``: (3,) µT rms of it.
    ``free``: (n,) bool, chips that bear nothing. ``changing``: (n,) bool. ``leap``: µT by which
    the field has leapt, more than turning explains; 0 otherwise. ``left_over``: µT rms of the
    chips that the field explains about it. ``moving``: the field is seen to turn.
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
    pace: FloatArray | None = None  # µT/s of the ambient field, by this frame and those before


class SmallArray:
    """The filter of one array of ``n`` taxels; memory and time of a frame are bounded."""

    def __init__(self, direction: FloatArray) -> None:
        """``direction``: (3, n), unit vectors in ``ee`` along which a press changes the field."""
        self._n = direction.shape[1]
        self._direction = direction
        self.set_noise(np.array([4.4, 4.4, 6.7]))
        self.reset()

    def set_noise(self, noise: FloatArray) -> None:
        """Noise of one sample, (3,) µT rms along ``ee``."""
        self._noise: FloatArray = noise**2
        self._variance: FloatArray = noise**2 + MODEL_ERROR_UT**2

    def reset(self, unknown: float = 0.0) -> None:
        """Nothing touches; the ambient field is zero, ± ``unknown`` µT rms a component."""
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

    def update(self, target: FloatArray, healthy: Bool, elapsed: float) -> Small:
        """Take one frame.

        ``target``: (3, n) µT in ``ee`` over rest, without what neighbours' contacts add.
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
        """Average the frames of the last `SMOOTH_S`; one frame where they come more slowly."""
        if self._mean is None:
            self._mean = target.copy()
            self._mean_variance = 1.0
            return
        share = -math.expm1(-elapsed / SMOOTH_S)
        # the mean of a field that moves steadily is behind it by its own time constant
        self._mean += (self._pace * elapsed)[:, None]
        self._mean += share * (target - self._mean)
        self._mean_variance = (1 - share) ** 2 * self._mean_variance + share**2

    def _judge(self, frame: _Frame) -> Small:
        """Where the ambient field is now, and which chips have changed since the filter's time."""
        state, cov = self._state, self._cov
        seen = np.flatnonzero(frame.healthy)
        moved, unsteady, turning = self._moved()
        prior = cov[:, 0, 0] + unsteady**2
        known = float(cov[:, 0, 0].max()) < KNOWN_UT**2
        if not seen.size or self._mean is None:
            return self._say(moved, prior, frame.changing, 0.0, 0.0)
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
        # a field that moves steadily is best known from the mean, one that has just begun to
        # move from the newest frame
        signal = 0 if kind else 1
        chosen = away[:, signal][:, inside]
        shift, variance = self._locate(chosen, seen[inside], prior, noise[:, signal])
        left = chosen - shift[:, None]
        left_over = math.sqrt(float((left**2).mean())) if left.size else 0.0
        if not leap and known:
            frame.pace = (moved + shift) / max(self._behind, 1e-3)
        return self._say(moved + shift, variance, frame.changing, leap, left_over)

    def _locate(
        self, away: FloatArray, chips: NDArray[np.intp], prior: FloatArray, noise: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Shift of the ambient field by the readings ``away`` (3, k) of ``chips``; its variance."""
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
        """How far the field should have moved since the filter's time; (3,) µT each.

        What is expected of a steady motion, how far off that may be, and how far if the motion
        has just begun or ended.
        """
        pace, behind = self._pace, self._behind
        doubt = max(CALM_UT_PER_S, UNSTEADY * float(np.linalg.norm(pace)))
        moved = pace * behind
        unsteady, turning = np.full(3, doubt * behind), np.full(3, TURNING_UT_PER_S * behind)
        return moved, unsteady, turning

    def _follow_pace(self, frame: _Frame, seen: FloatArray) -> None:
        """The field of the room was ``seen`` to move at so many µT/s, (3,)."""
        share = -math.expm1(-frame.elapsed / PACE_TAU_S)
        pace = self._pace + share * (seen - self._pace)
        fast = float(np.linalg.norm(pace))
        if fast > 2 * TURNING_UT_PER_S:
            pace *= 2 * TURNING_UT_PER_S / fast
        self._pace = pace

    def _say(
        self, shift: FloatArray, variance: FloatArray, changing: Bool, leap: float, left_over: float
    ) -> Small:
        return Small(
            self._state[:, 0] + shift,
            np.sqrt(variance),
            self._free & ~changing,
            changing.copy(),
            leap,
            left_over,
            float(np.linalg.norm(self._pace)) >= MOVING_UT_PER_S,
        )

    # The filter, a moment later

    def _take(self, frame: _Frame) -> None:
        """Let the filter take the oldest frame, knowing what came after it."""
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
            # a contact reaches neighbours, too little to be told from noise at once
            fresh = 1 + np.flatnonzero(self._free & ~self._near)
            along = self._direction[:, fresh - 1] ** 2
            cov[:, fresh, fresh] += along * NEAR_UT**2 + (1 - along) * NEAR_SHEAR_UT**2
            self._near |= self._free
        seen = np.flatnonzero(frame.healthy)
        if seen.size:
            self._stir(frame, seen)
            self._absorb(frame.target, seen)
        self._release(frame.healthy & ~changing)
        self._reinterpret(frame.healthy & ~changing)
        size = float(np.linalg.norm(state[:, 0]))
        if size > EARTH_UT and 2 * np.count_nonzero(self._free) <= self._n:
            # creep of a contact was taken for the field of the room
            state[:, 0] *= EARTH_UT / size
            cov[:, 0, 0] = np.maximum(cov[:, 0, 0], LOST_UT**2)
        load = np.linalg.norm(state[:, 1:], axis=0)
        self._peak = np.maximum(load, self._peak * math.exp(-frame.elapsed / RECOVERY_S))
        covered = 2 * np.count_nonzero(self._free) < self._n
        moving = float(np.linalg.norm(self._pace)) >= MOVING_UT_PER_S
        firm = float(load.max()) > FIRM_UT
        if covered and firm and not moving:
            # what all chips do together may be the contact
            self._follow_pace(frame, np.zeros(3))
        elif frame.pace is not None and not changing.any():
            self._follow_pace(frame, frame.pace)

    def _drift(self, frame: _Frame) -> None:
        """Let time pass: the ambient field moves on, loaded chips creep."""
        cov, elapsed = self._cov, frame.elapsed
        self._state[:, 0] += self._pace * elapsed
        # what is unknown of it is the same from frame to frame: deviations add up
        step = max(CALM_UT_PER_S, UNSTEADY * float(np.linalg.norm(self._pace))) * elapsed
        cov[:, 0, 0] += (2.0 * np.sqrt(cov[:, 0, 0]) + step) * step
        contact = np.where(self._free, 0.0, self._state[:, 1:])
        cov[:, 1:, 1:] += CREEP_PER_S**2 * elapsed * contact[:, :, None] * contact[:, None, :]
        index = np.arange(1, self._n + 1)
        cov[:, index, index] += UNEVEN_CREEP_PER_S**2 * elapsed * contact**2

    def _stir(self, frame: _Frame, seen: NDArray[np.intp]) -> None:
        """Let loaded chips change while their readings lean away from what is expected, unevenly.

        A contact that grows slowly changes each chip by its own; the field of the room all alike.
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
        """Kalman's update with the chips ``seen``."""
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
        """Chips whose contact is gone tell the ambient field again."""
        state, cov = self._state, self._cov
        for i in np.flatnonzero(~self._free & judged).tolist():
            own = cov[:, 1 + i, 1 + i]
            slack = (RELEASED_SHARE * self._peak[i]) ** 2
            distance = (state[:, 1 + i] ** 2 / (own + slack + MODEL_ERROR_UT**2)).sum()
            if distance < RELEASED_SIGMAS**2:
                # while its neighbours are loaded it may bear a little still
                self._free[i] = self._near[i] = True
        if self._free.all():
            for i in np.flatnonzero(self._near).tolist():
                self._pin(i, (RELEASED_SHARE * self._peak[i]) ** 2)
            state[:, 1:] = 0.0
            cov[:, 1:, :] = 0.0
            cov[:, :, 1:] = 0.0

    def _reinterpret(self, judged: Bool) -> None:
        """What most chips bear alike, and no press makes, is the ambient field after all."""
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
        """Chip ``i`` bears nothing, to within ``slack`` µT²."""
        state, cov = self._state, self._cov
        column = cov[:, :, 1 + i].copy()
        total = column[:, 1 + i] + slack + MODEL_ERROR_UT**2
        gain = column / total[:, None]
        state -= gain * state[:, 1 + i][:, None]
        cov -= gain[:, :, None] * column[:, None, :]
        self._free[i] = self._near[i] = True


class _Vote:
    """Which chips have changed, by the cheapest explanation of what they read.

    For S signals (the frame and the mean of the last few) of k chips: ``away`` (3, S, k) µT of
    what was expected, ``spread`` (3, S, k) µT² its variance without that of the ambient field,
    ``contact`` (3, k) µT, what contact adds at the chips so far, ``direction`` (3, k) of a press.
    ``touched``: there is contact already.

    A chip that has changed costs more, the more precisely its new contact is known beside how
    large it might have been; and more again when it is not what a press makes. An explanation
    costs the chips that it lets change, an `EVENT` where a contact begins, the distance of its
    ambient field from the expected, and the price of its kind: 0 steady, 1 a turn that begins or
    ends, 2 a leap.
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
        """Chips (k,) that both signals' best explanations keep, its kind, and a leap's size, µT.

        ``steady``, ``turning``: (3,) µT², variance of the ambient field in either kind.
        """
        away, spread = self._away, self._spread
        chips = away.shape[2]
        precision = np.stack([1.0 / steady, 1.0 / turning, np.zeros(3)], axis=1)  # (3, kinds)
        kinds = 3 if chips >= 3 else 2
        precision = precision[:, :kinds]
        starts = np.concatenate(
            [
                np.zeros_like(away[:, :, :1]),
                np.median(away, axis=2, keepdims=True),
                away.mean(axis=2, keepdims=True),
                away,
            ],
            axis=2,
        )  # (3, S, s)
        shift = np.repeat(starts[:, :, None], kinds, axis=2)  # (3, S, kinds, s)
        weight = 1.0 / spread[:, :, None, None]
        weighted = away[:, :, None, None] * weight
        bound = precision[:, None, :, None] + 1e-12
        for _ in range(ROUNDS):
            distance, price = self._prices(shift)
            inside = distance < price
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
        """Squared distance of each chip, and the price of letting it change; (S, kinds, s, k)."""
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
        # a contact that grows or lessens keeps the direction of what it does to a chip
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
