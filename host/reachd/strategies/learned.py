"""Learned: quick sweep, and on top of it a residual motion that a network has learned.

Ten times a second a small network looks at what was felt in the last eight seconds, and where, and
adds a velocity to that of `quick_sweep`. It was trained by `tactile train` in the planar engine;
how, when and on what is stored with its weights. Without a residual it is quick sweep.
"""

from __future__ import annotations

import json
import math
import zipfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib import resources
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from reachd.gate.limits import usable
from reachd.interfaces import ArmState, Goal, Touch, Twist
from reachd.strategies.builtin import Moment, ReachingStrategy, StrategyEvent
from reachd.strategies.memory import DECISION_S, FELT, VERSION, WIDTH, Memory, Rows
from reachd.strategies.parameter_fields import Parameters
from reachd.strategies.parameters import ParameterTable
from reachd.strategies.primitives import pivot_velocity
from reachd.strategies.quick_sweep import QuickSweep
from tactile_core.config import convert
from tactile_core.geometry import Side
from tactile_core.types import Instant, seconds_between

NEAR_GOAL_M: Final = 0.01
NEAR_GOAL_N: Final = 1.0
"""Nearer to the goal and more lightly touched than this, nothing is added."""

RESIDUAL_BOUND: Final = 2.0
"""Greatest component of a residual, in v_max and ω_max."""

STRONG: Final = 0.5
"""Residual in v_max or ω_max from which it is told apart in activity and events."""

BASE: Final = (
    "jam_time", "jam_progress", "jam_force", "sweep_time", "sweep_angle", "sweep_omega",
    "sweep_obedience",
)  # fmt: skip
"""Parameters of the quick sweep that a residual is learned on."""

WEIGHTS: Final = "learned.npz"
"""Weights that come with the package."""


class WeightsError(ValueError):
    """The weights cannot be used; the message says why and what to do."""


@dataclass(frozen=True, slots=True)
class Policy:
    """A network of fully connected layers with ELU between them.

    ``layers``: a matrix (inputs, outputs) and offsets (outputs,) for each. ``about``: how, when and
    on what it was trained.
    """

    layers: tuple[tuple[Rows, Rows], ...]
    about: dict[str, Any]

    def base(self, parameters: Parameters) -> Parameters:
        """``parameters`` with the quick sweep that this was trained on, where it tells of this set.

        Another sweep beneath a residual makes it worse: it was learned on that one.
        """
        return replace(parameters, **self.about.get("base", {}).get(parameters.name, {}))

    def __call__(self, observations: Rows) -> Rows:
        """(n, `WIDTH`) → (n, 3): residuals ahead, aside and in turning, within `RESIDUAL_BOUND`."""
        values = observations
        for index, (matrix, offsets) in enumerate(self.layers):
            values = values @ matrix + offsets
            if index + 1 < len(self.layers):
                values = np.where(values > 0, values, np.expm1(np.minimum(values, 0.0)))
        return np.clip(values, -RESIDUAL_BOUND, RESIDUAL_BOUND)


def base_of(parameters: Parameters) -> dict[str, float]:
    """What weights that are trained with ``parameters`` tell of the sweep beneath them."""
    return {name: getattr(parameters, name) for name in BASE}


def save_policy(path: Path, policy: Policy) -> None:
    """Write ``policy`` as plain arrays, in one step."""
    arrays: dict[str, NDArray[Any]] = {}
    for index, (matrix, offsets) in enumerate(policy.layers):
        arrays[f"matrix_{index}"] = np.asarray(matrix, np.float32)
        arrays[f"offsets_{index}"] = np.asarray(offsets, np.float32)
    about = {"observation": VERSION, "width": WIDTH} | policy.about
    arrays["about"] = np.frombuffer(json.dumps(about, sort_keys=True).encode(), np.uint8)
    new = path.with_name(f".{path.name}.new")
    with new.open("wb") as file:
        np.savez(file, allow_pickle=False, **arrays)
    new.replace(path)


def load_policy(path: Path | None = None) -> Policy:
    """Weights at ``path``, or those of the package. `WeightsError` where they do not fit."""
    again = "make them anew with `tactile train`, or leave them out for those of the package"
    try:
        if path is None:
            with resources.as_file(resources.files("reachd.strategies") / WEIGHTS) as own:
                return _read(own)
        return _read(path)
    except FileNotFoundError as error:
        raise WeightsError(f"there are no weights at {path or WEIGHTS}; {again}") from error
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise WeightsError(f"weights {path or WEIGHTS}: {error}; {again}") from error


def _read(path: Path) -> Policy:
    with path.open("rb") as raw:
        # Of what is no archive numpy says how to unpickle it, which nobody should.
        if not zipfile.is_zipfile(raw):
            raise ValueError("it is not a file of weights")
    with np.load(path, allow_pickle=False) as file:
        about = json.loads(bytes(file["about"]).decode())
        if not isinstance(about, dict):
            raise ValueError("it does not tell how it was trained")
        version, width = about.get("observation"), about.get("width")
        if (version, width) != (VERSION, WIDTH):
            raise ValueError(
                f"made for observation {version} of {width} numbers, not {VERSION} of {WIDTH}"
            )
        layers: list[tuple[Rows, Rows]] = []
        inputs = WIDTH
        while f"matrix_{len(layers)}" in file:
            matrix = np.asarray(file[f"matrix_{len(layers)}"], np.float32)
            offsets = np.asarray(file[f"offsets_{len(layers)}"], np.float32)
            if matrix.ndim != 2 or matrix.shape[0] != inputs or offsets.shape != matrix.shape[1:]:
                raise ValueError(f"layer {len(layers)} has the wrong shape: {matrix.shape}")
            if not (np.isfinite(matrix).all() and np.isfinite(offsets).all()):
                raise ValueError(f"layer {len(layers)} holds numbers that are not finite")
            layers.append((matrix, offsets))
            inputs = matrix.shape[1]
        if not layers or inputs != 3:
            raise ValueError("no network with three outputs")
        _check_base(about.get("base", {}))
    return Policy(tuple(layers), about)


def _check_base(base: Any) -> None:
    """ValueError unless ``base`` holds figures of `BASE`, in range, by parameter set."""
    if not isinstance(base, dict):
        raise ValueError("base is not a table of parameter sets")
    convert(base, dict[str, ParameterTable])
    unknown = {name for told in base.values() for name in told} - set(BASE)
    if unknown:
        raise ValueError(f"base: {', '.join(sorted(unknown))} is not of a quick sweep")


def with_residual(
    base: Twist,
    residual: NDArray[Any],
    heading: float,
    parameters: Parameters,
) -> Twist:
    """The twist ``base`` of the pivot with a residual in the finger's frame on the commanded point.

    The commanded point moves at v_max at most, and the finger turns at ω_max at most.
    """
    p = parameters
    vx, vy = base.vx, base.vy
    if p.commanded_point == "tip":
        vx -= p.tip_length * base.omega * math.sin(heading)
        vy += p.tip_length * base.omega * math.cos(heading)
    c, s = math.cos(heading), math.sin(heading)
    ahead, aside, turn = (float(v) for v in residual)
    vx += p.v_max * (c * ahead - s * aside)
    vy += p.v_max * (s * ahead + c * aside)
    speed = math.hypot(vx, vy)
    if speed > p.v_max:
        vx, vy = vx * p.v_max / speed, vy * p.v_max / speed
    omega = min(max(base.omega + p.omega_max * turn, -p.omega_max), p.omega_max)
    return pivot_velocity(vx, vy, omega, heading, p)


class Learned(ReachingStrategy):
    """Quick sweep with a learned residual; see this module.

    Events: those of quick sweep; and "residual_start" and "residual_end", trigger "touch",
    direction "ccw" (to the left) or "cw", for a residual of `STRONG` or more. While touch is
    invalid the last residual is held and nothing is remembered.
    """

    def __init__(self, parameters: Parameters, rng: np.random.Generator) -> None:
        weights = parameters.learned_weights
        policy = load_policy(Path(weights) if weights else None)
        self._policy: Callable[[Rows], Rows] = policy
        self._sweeps = QuickSweep(policy.base(parameters), rng)
        self._memory = Memory(1)
        super().__init__(parameters, rng)

    def _reset(self, now: Instant) -> None:
        super()._reset(now)
        self._residual = np.zeros(3)
        self._decided: Instant | None = None
        self._closest = math.inf
        self._strong: StrategyEvent | None = None
        self._place = (0.0, 0.0)
        self._begin_sums()

    def _begin_sums(self) -> None:
        self._cycles = 0
        self._sums = [0.0] * len(FELT)

    def start(self, goal: Goal, now: Instant) -> None:
        """Begin a reach towards ``goal``; forget any earlier one."""
        super().start(goal, now)
        self._sweeps.start(goal, now)

    def step(self, touch: Touch, arm: ArmState, goal: Goal, now: Instant) -> Twist:
        """Twist of the pivot wanted now."""
        self._goal = goal
        self._touch = touch
        self._base = self._sweeps.step(touch, arm, goal, now)
        for event in self._sweeps.take_events():
            self._report(event)
        return super().step(touch, arm, goal, now)

    def _choose(self, at: Moment) -> Twist | None:
        p = self._parameters
        self._activity = self._sweeps.activity
        if self._activity == "waiting":
            return self._base
        self._closest = min(self._closest, at.aim.distance)
        if usable(at.touch):
            self._feel(at.touch)
            decided = self._decided
            # A cycle comes a little early or late.
            if decided is None or seconds_between(decided, at.now) >= DECISION_S * 0.95:
                self._decide(at)
        if at.aim.distance < NEAR_GOAL_M and at.touch.total_force < NEAR_GOAL_N:
            return self._base
        if self._strong is not None:
            self._activity = f"residual_{self._strong.direction}"
        return with_residual(self._base, self._residual, at.arm.heading, p)

    def _feel(self, touch: Touch) -> None:
        """Add what one cycle felt."""
        sums = self._sums
        self._cycles += 1
        sums[0] += touch.total_force
        sums[1] += touch.tip_force
        sums[2] = max(sums[2], touch.peak_force)
        sums[5] += touch.wrench.fx
        sums[6] += touch.wrench.fy
        sums[7] += touch.wrench.mz
        if touch.peak_side != Side.NONE:
            sums[8] += 1.0
            self._place = (touch.peak_x, touch.peak_y)

    def _decide(self, at: Moment) -> None:
        """Look at the cycles since the last decision, and choose the residual of the next."""
        p = self._parameters
        arm, goal = at.arm, self._goal
        pose = np.array([[arm.x, arm.y, arm.heading]])
        if self._decided is None:
            self._memory.forget(np.array([0]), pose)
        self._decided = at.now
        felt = np.array([self._sums]) / self._cycles
        felt[0, 2] = self._sums[2]
        felt[0, 3:5] = self._place
        left = self._time_limit - at.elapsed
        observation = self._memory.observe(
            felt,
            pose,
            self._residual[np.newaxis],
            np.array([[goal.x, goal.y]]),
            np.array([[left, self._closest, *self._sweeps.progress(at.now)]]),
            np.array([[p.v_max, p.omega_max]]),
        )
        self._residual = self._policy(observation)[0].astype(float)
        self._begin_sums()
        self._tell(at.now)

    def _tell(self, now: Instant) -> None:
        """Report where a strong residual begins, turns to the other side or ends."""
        _, aside, turn = self._residual
        strong = float(np.abs(self._residual).max()) >= STRONG
        direction = "ccw" if aside + turn > 0 else "cw"
        running = self._strong
        if running is not None and (not strong or running.direction != direction):
            self._report(StrategyEvent(now, "residual_end", running.direction, "touch"))
            self._strong = None
        if strong and self._strong is None:
            self._strong = StrategyEvent(now, "residual_start", direction, "touch")
            self._report(self._strong)
