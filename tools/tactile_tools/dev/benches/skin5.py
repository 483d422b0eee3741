"""Benchmark of a board of five magnetometers: error of a press, and whether its bounds hold."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from sim_device.skin.environment import Environment, EnvironmentParameters, rotation_about
from sim_device.skin.parameters import anyskin_parameters
from sim_device.skin.skin import Contact, SkinModel, nominal_calibration
from tactile_core.arrays import FloatArray
from tactile_core.geometry import anyskin
from tactile_core.types import NS_PER_S, Instant
from tactiled.blocks import Cycle, SampleBlock
from tactiled.sensing import Method
from tactiled.sensing.pipeline import BoardPipeline
from tactiled.sensing.settings import PipelineSettings

RATE_HZ = 100.0
FORCES_N = (0.5, 1.0, 2.0, 5.0, 10.0)
RADII_M = (2e-3, 4e-3, 8e-3)
PLACES_M = (-0.008, -0.004, 0.0, 0.004, 0.008)
RAMP_S = 0.15
"""Seconds in which a press reaches its full force."""
TURN_AXIS = np.array([0.6, 0.48, 0.64])
TURN_RAD_PER_S = 1.0


class Board:
    """Simulated AnySkin board with its factory calibration, under the sensing pipeline."""

    def __init__(self, seed: int, method: Method = "consensus") -> None:
        self._rng = np.random.default_rng([seed, 5])
        self.geometry = anyskin()
        self.skin = SkinModel(self.geometry, anyskin_parameters(), self._rng)
        room = EnvironmentParameters(self_heating_k=0.0, room_c=25.0)
        self._environment = Environment(room)
        calibration = nominal_calibration(self.skin, "skin5")
        # the rest field comes from the tare: this calibration does not contain the earth's field
        self._pipeline = BoardPipeline(calibration, PipelineSettings(method=method, auto_tare=True))
        self._cycle = 0

    def step(self, force: FloatArray, turn: FloatArray) -> Cycle:
        """One cycle under taxel forces (5, 3) N, the board turned by ``turn`` (3, 3)."""
        skin = self.skin
        displacement = skin.elastomer.load(force, 1.0 / RATE_HZ)
        seen = skin.field_ut(displacement, self._environment.at(0.0, turn))
        counts = skin.chips.convert(seen, 25.0, self._rng).counts
        now = Instant(round(self._cycle * NS_PER_S / RATE_HZ))
        block = SampleBlock(
            0,
            self._cycle,
            now,
            now,
            1e-4,
            counts * skin.chips.lsb_ut,
            np.array([25.0]),
            np.zeros(len(counts), np.uint8),
        )
        self._cycle += 1
        (cycle,) = self._pipeline.feed(block)
        return cycle

    def run(
        self,
        force_at: Callable[[float], FloatArray],
        turn_at: Callable[[float], FloatArray],
        seconds: float,
    ) -> tuple[list[float], list[Cycle]]:
        """True normal force (N) and cycle for ``seconds`` after the board has tared."""
        still = turn_at(0.0)
        for _ in range(round(0.8 * RATE_HZ)):
            self.step(np.zeros((5, 3)), still)
        truth, cycles = [], []
        for k in range(round(seconds * RATE_HZ)):
            force = force_at(k / RATE_HZ)
            truth.append(-float(force[:, 2].sum()))
            cycles.append(self.step(force, turn_at(k / RATE_HZ)))
        return truth, cycles


def bench_skin5(*, quick: bool = False, seed: int = 0) -> dict[str, float]:
    """Figures of a five-chip board with its factory calibration and default compensation.

    ``skin5_force_error``: for presses of 0.5 to 10 N at 25 places with three indenters, the rms
    over presses of the mean error of the normal force over the allowed error, the larger of 5 % and
    0.1 N. ``skin5_force_error_pct``, ``skin5_light_force_error_n``: rms in % from 2 N, in N below.
    ``skin5_press_coverage``: share of their cycles whose bound holds the truth.
    ``skin5_rest_n``: largest force of a still, untouched board. ``skin5_bound_coverage``: share of
    cycles whose bound holds the truth while the board turns at 1 rad/s in 50 µT with 0, 1, 3 and 5
    chips pressed, the worst of the four; ``skin5_bound_median_n``: the median of the bounds;
    ``skin5_bound_coverage_K``, ``skin5_bound_median_n_K``, ``skin5_valid_K``: for K chips.
    """
    rng = np.random.default_rng([seed, 55])
    return _presses(rng, quick) | _rest(rng, quick) | _turning(rng, quick)


def _presses(rng: np.random.Generator, quick: bool) -> dict[str, float]:
    array = anyskin().arrays[0]
    axes, centre = array.rotation[0], array.position[0]
    allowed, relative, light, held = [], [], [], []
    every = [(r, x, y, f) for r in RADII_M for x in PLACES_M for y in PLACES_M for f in FORCES_N]
    if quick:
        every = every[::9]
    for radius, x, y, newton in every:
        board = Board(int(rng.integers(1000)))
        place = centre + axes[:, 0] * x + axes[:, 1] * y
        shear, angle = rng.uniform(0.0, 0.2), rng.uniform(0.0, 2 * np.pi)
        direction = axes @ np.array([shear * np.cos(angle), shear * np.sin(angle), -1.0])

        def force_at(
            t: float,
            board: Board = board,
            place: FloatArray = place,
            load: FloatArray = newton * direction,
            radius: float = radius,
        ) -> FloatArray:
            share = min(1.0, max(0.0, (t - 0.3) / RAMP_S))
            return board.skin.taxel_force([Contact(place, share * load, radius)])

        truth, cycles = board.run(force_at, lambda _: np.eye(3), 1.2)
        late = [c.features.normal_force for c in cycles[70:]]
        true = truth[-1]
        bounds = [c.features.normal_force_bound for c in cycles[70:]]
        held += [abs(f - true) <= b for f, b in zip(late, bounds, strict=True)]
        error = float(np.mean(late)) - true
        allowed.append(error / max(0.05 * true, 0.1))
        if newton >= 2.0:
            relative.append(100 * error / true)
        else:
            light.append(error)
    return {
        "skin5_force_error": _rms(allowed),
        "skin5_force_error_pct": _rms(relative),
        "skin5_light_force_error_n": _rms(light),
        "skin5_press_coverage": float(np.mean(held)),
    }


def _rest(rng: np.random.Generator, quick: bool) -> dict[str, float]:
    worst = 0.0
    for _ in range(2 if quick else 6):
        board = Board(int(rng.integers(1000)))
        _, cycles = board.run(lambda _: np.zeros((5, 3)), lambda _: np.eye(3), 10.0)
        worst = max(worst, *(abs(c.features.normal_force) for c in cycles))
    return {"skin5_rest_n": worst}


def _turning(rng: np.random.Generator, quick: bool) -> dict[str, float]:
    out: dict[str, float] = {}
    pooled = []
    for chips in (0, 1, 3, 5):
        held, bounds, valid = [], [], []
        for _ in range(2 if quick else 8):
            board = Board(int(rng.integers(1000)))
            pressed = rng.choice(5, chips, replace=False)
            load = np.zeros((5, 3))
            load[pressed, 2] = -rng.uniform(0.5, 4.0, chips)
            load[pressed, :2] = load[pressed, 2:] * rng.uniform(-0.3, 0.3, (chips, 2))

            def force_at(t: float, load: FloatArray = load) -> FloatArray:
                return load * min(1.0, max(0.0, (t - 2.0) / RAMP_S))

            def turn_at(t: float) -> FloatArray:
                return rotation_about(TURN_AXIS, TURN_RAD_PER_S * max(0.0, t - 0.5))

            truth, cycles = board.run(force_at, turn_at, 7.0)
            for true, cycle in zip(truth, cycles, strict=True):
                f = cycle.features
                held.append(abs(f.normal_force - true) <= f.normal_force_bound)
                bounds.append(f.normal_force_bound)
                valid.append(f.valid)
        out[f"skin5_bound_coverage_{chips}"] = float(np.mean(held))
        out[f"skin5_bound_median_n_{chips}"] = float(np.median(bounds))
        out[f"skin5_valid_{chips}"] = float(np.mean(valid))
        pooled += bounds
    out["skin5_bound_coverage"] = min(out[f"skin5_bound_coverage_{k}"] for k in (0, 1, 3, 5))
    out["skin5_bound_median_n"] = float(np.median(pooled))
    return out


def _rms(values: list[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
