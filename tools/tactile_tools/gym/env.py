"""Reaching into a cluttered cupboard by touch, with the safety gate between agent and arm.

World, arm, touch and gate are the objects of the daemons and the lockstep trials, on virtual time:
the same seed and actions give the same observations bit for bit. An agent's actions pass the gate,
so a policy trained here has met the gate and cannot learn to exceed its limits.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Final, Literal, SupportsFloat

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from reachd.gate.gate import SafetyGate
from reachd.interfaces import ArmState, Goal, Touch, Twist
from reachd.services import make_goal
from reachd.strategies.parameters import parameters as parameter_set
from reachd.strategies.primitives import aim
from sim_device.arm.arm import ArmSettings, SimulatedArm
from sim_device.world.base import World
from sim_device.world.engines import make_world
from sim_device.world.scene_loading import load_scene
from tactile_core.geometry import Side
from tactile_core.types import Instant, after, seconds_between
from tactile_tools.reach.lockstep import BEGIN
from tactile_tools.reach.touch_senses import ContactSense, Sense, TaxelSense

Float32 = NDArray[np.float32]
Observation = dict[str, Float32]

MAX_PATCHES: Final = 8
"""Contacts in an observation, strongest first; weaker ones are left out."""

PATCH_FIELDS: Final = ("present", "x", "y", "force_x", "force_y", "normal_force")
TOUCH_FIELDS: Final = ("valid", "peak_force", "total_force", "tip_force", "left", "right", "tip")
ARM_FIELDS: Final = ("x", "y", "cos", "sin", "vx", "vy", "omega", "fx", "fy", "mz")
GOAL_FIELDS: Final = ("ahead", "left", "time_left")

FORCE_LIMIT_N: Final = 100.0
"""Forces in observations are cut to this, several times what the gate allows."""

MAX_SCENE: Final = 1 << 31

LIMITS: Final[Mapping[str, float]] = {
    "present": 1.0, "valid": 1.0, "left": 1.0, "right": 1.0, "tip": 1.0,
    "x": 2.0, "y": 2.0, "ahead": 2.0, "cos": 1.0, "sin": 1.0,
    "vx": 2.0, "vy": 2.0, "omega": 4.0, "mz": 20.0, "time_left": 1.0,
}  # fmt: skip
"""Greatest absolute value of each field of an observation (m, m/s, rad/s, N·m)."""

SUCCESS_REWARD: Final = 1.0


class CupboardEnv(gymnasium.Env[Observation, Float32]):
    """Bring the tip to the goal before the time is up.

    Action (3,), each from -1 to 1: velocity of the wrist pivot ahead and to the left of the finger
    (times v_max, m/s) and its turn rate (times omega_max, rad/s), held for ``cycles_per_step``
    control cycles of 10 ms.

    Observation, all float32, forces in N on the finger, places in m:

    - ``arm`` (10,): x and y of the pivot, cosine and sine of its heading, twist (m/s, rad/s), and
      the wrench of the arm's own sensor (N, N·m), in the frame ``cupboard``;
    - ``goal`` (3,): place of the goal from the tip, ahead and left in the finger's frame; the part
      of the time that is left;
    - ``touch`` (7,): 1 if touch is valid; greatest, summed and tip normal force; three flags for
      the side of the greatest (left, right, tip);
    - ``patches`` (8, 6): contacts, strongest first: 1, then place and force in the finger's frame
      ``ee`` and normal force; zeros after the last.

    Reward: part of the initial distance gained in the step, and 1 for reaching the goal. The
    episode ends when the goal is reached or the gate latches (``info["held"]`` says why), and is
    truncated at the parameter set's time limit.

    ``scene``: as for ``tactile reach --scene``. ``depth``: touch from exact contacts, or through
    simulated taxels and the whole pipeline. ``overrides``: parameters as for ``reachd --set``.
    SceneError or SettingError (both are ValueError) for an unknown scene or parameter.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012 - gymnasium declares it so

    def __init__(
        self,
        scene: str = "authors_sim",
        depth: Literal["contacts", "taxels"] = "contacts",
        *,
        parameters: str | None = None,
        overrides: Mapping[str, object] | None = None,
        engine: str = "mujoco",
        cycles_per_step: int = 10,
        render_mode: None = None,
    ) -> None:
        if cycles_per_step < 1:
            raise ValueError(f"cycles_per_step is {cycles_per_step}; expected 1 or more")
        if depth not in ("contacts", "taxels"):
            raise ValueError(f"unknown depth {depth!r}; available: contacts, taxels")
        self.render_mode = render_mode
        self._scene_name = scene
        self._depth = depth
        self._set_name = parameters
        self._overrides = overrides
        self._engine = engine
        self._cycles = cycles_per_step
        self.action_space = spaces.Box(-1.0, 1.0, (3,), np.float32)
        patches = np.tile(_limits(PATCH_FIELDS), (MAX_PATCHES, 1))
        space: Any = spaces.Dict(
            {
                name: spaces.Box(-limit, limit, dtype=np.float32)
                for name, limit in (
                    ("arm", _limits(ARM_FIELDS)),
                    ("goal", _limits(GOAL_FIELDS)),
                    ("touch", _limits(TOUCH_FIELDS)),
                    ("patches", patches),
                )
            }
        )
        self.observation_space = space
        self._episode: _Episode | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin an episode in another scene; ``options={"scene_seed": n}`` chooses the scene.

        RuntimeError when the gate refuses to arm.
        """
        super().reset(seed=seed)
        drawn = int(self.np_random.integers(MAX_SCENE))
        board = int(self.np_random.integers(MAX_SCENE))
        scene_seed = int((options or {}).get("scene_seed", drawn))
        self._episode = episode = _Episode(self, scene_seed, board)
        return episode.observe(), episode.info()

    def step(
        self, action: Float32
    ) -> tuple[Observation, SupportsFloat, bool, bool, dict[str, Any]]:
        """Ask for a twist for some control cycles; numbers beyond -1 to 1 are cut to that range.

        RuntimeError before the first `reset`.
        """
        episode = self._episode
        if episode is None:
            raise RuntimeError("step() before reset(): reset the environment first")
        asked = np.clip(np.asarray(action, np.float64).reshape(3), -1.0, 1.0)
        before = episode.distance
        for _ in range(self._cycles):
            episode.cycle(asked)
            if episode.over:
                break
        reward = (before - episode.distance) / episode.initial_distance
        if episode.reached:
            reward += SUCCESS_REWARD
        terminated = episode.reached or episode.held is not None
        truncated = not terminated and episode.elapsed >= episode.goal.time_limit
        return episode.observe(), float(reward), terminated, truncated, episode.info()

    def close(self) -> None:
        """Release the world."""
        self._episode = None

    def make_episode_parts(self, scene_seed: int, board_seed: int) -> tuple[Any, World, Sense]:
        """Parameters, world and sense of touch of an episode."""
        scene = load_scene(self._scene_name, scene_seed)
        chosen = parameter_set(self._set_name or scene.parameters, self._overrides)
        sense: Sense = ContactSense() if self._depth == "contacts" else TaxelSense(board_seed)
        return chosen, make_world(self._engine, scene), sense


class _Episode:
    """One reach on virtual time."""

    def __init__(self, env: CupboardEnv, scene_seed: int, board_seed: int) -> None:
        self.scene_seed = scene_seed
        self._p, self._world, self._sense = env.make_episode_parts(scene_seed, board_seed)
        now = self._sense.settle(self._world, BEGIN)
        rng = np.random.default_rng([board_seed, 2])
        self._arm = SimulatedArm(self._world, ArmSettings(), now, rng)
        self._arm.request_limits(self._p.safety.arm_limits)
        self._gate = SafetyGate(self._p.safety)
        self.goal: Goal = make_goal(*self._world.scene.goal, self._p)
        self._state: ArmState
        self._touch: Touch | None = None
        self._now = now
        self._advance()
        refused = self._gate.arm(self._now, self._touch, self._state, self._now)
        if refused:
            raise RuntimeError("the gate refuses to arm: " + "; ".join(i.text for i in refused))
        self._began: Instant = self._now
        self.held: str | None = None
        self._interventions: dict[str, int] = {}
        self._peak_load = 0.0
        self.distance = self._measure()
        self.initial_distance = max(self.distance, self.goal.radius)

    @property
    def reached(self) -> bool:
        return self.distance <= self.goal.radius

    @property
    def elapsed(self) -> float:
        """Time since the episode began, s."""
        return seconds_between(self._began, self._now)

    @property
    def over(self) -> bool:
        return self.reached or self.held is not None or self.elapsed >= self.goal.time_limit

    def cycle(self, asked: NDArray[np.float64]) -> None:
        """Run one control cycle: the action, the gate, the arm, the world."""
        ahead, left = asked[0] * self._p.v_max, asked[1] * self._p.v_max
        c, s = math.cos(self._state.heading), math.sin(self._state.heading)
        wanted = Twist(
            float(c * ahead - s * left),
            float(s * ahead + c * left),
            float(asked[2] * self._p.omega_max),
        )
        decision = self._gate.step(wanted, self._touch, self._state, self.goal, self._now)
        for intervention in decision.interventions:
            code = str(intervention.code)
            self._interventions[code] = self._interventions.get(code, 0) + 1
        if decision.held is not None:
            why = [i.text for i in decision.interventions if i.code is decision.held]
            self.held = "; ".join(why) or str(decision.held)
        self._arm.command(decision.twist, self._now, decision.expiry)
        self._advance()
        self.distance = self._measure()
        load = sum(contact.normal_force for contact in self._world.contacts())
        self._peak_load = max(self._peak_load, load)

    def observe(self) -> Observation:
        arm, touch, goal = self._state, self._touch, self.goal
        c, s = math.cos(arm.heading), math.sin(arm.heading)
        tip_x, tip_y = arm.x + self._p.tip_length * c, arm.y + self._p.tip_length * s
        ex, ey = goal.x - tip_x, goal.y - tip_y
        twist = (arm.twist.vx, arm.twist.vy, arm.twist.omega)
        time_left = max(0.0, 1.0 - self.elapsed / goal.time_limit)
        return {
            "arm": _cut(ARM_FIELDS, (arm.x, arm.y, c, s, *twist, arm.fx, arm.fy, arm.mz)),
            "goal": _cut(GOAL_FIELDS, (c * ex + s * ey, c * ey - s * ex, time_left)),
            "touch": _cut(TOUCH_FIELDS, _touch_row(touch)),
            "patches": self._patches(),
        }

    def info(self) -> dict[str, Any]:
        return {
            "scene_seed": self.scene_seed,
            "distance": self.distance,
            "time": self.elapsed,
            "reached": self.reached,
            "held": self.held or "",
            "interventions": dict(self._interventions),
            "peak_load": self._peak_load,
        }

    def _advance(self) -> None:
        self._now = after(self._now, self._p.safety.period)
        self._state = self._arm.advance(self._now)[-1]
        self._touch = self._sense.feel(self._world, self._now)

    def _measure(self) -> float:
        return aim(self._state, self.goal, self._p.tip_length).distance

    def _patches(self) -> Float32:
        rows = np.zeros((MAX_PATCHES, len(PATCH_FIELDS)), np.float32)
        cycle = self._sense.cycle
        if cycle is None:
            contacts = self._world.contacts()
            felt = [(c.x, c.y, c.force_x, c.force_y, c.normal_force) for c in contacts]
        elif cycle.features.valid:
            felt = [
                (p.centroid[0], p.centroid[1], p.force[0], p.force[1], p.normal_force)
                for p in cycle.features.patches
            ]
        else:
            felt = []
        felt.sort(key=lambda row: -row[4])
        for row, values in zip(rows, felt, strict=False):
            row[:] = _cut(PATCH_FIELDS, (1.0, *values))
        return rows


def _touch_row(touch: Touch | None) -> tuple[float, ...]:
    if touch is None or not touch.valid:
        return (0.0,) * len(TOUCH_FIELDS)
    sides = [float(touch.peak_side is side) for side in (Side.LEFT, Side.RIGHT, Side.TIP)]
    return (1.0, touch.peak_force, touch.total_force, touch.tip_force, *sides)


def _limits(fields: tuple[str, ...]) -> Float32:
    return np.array([LIMITS.get(name, FORCE_LIMIT_N) for name in fields], np.float32)


def _cut(fields: tuple[str, ...], values: tuple[float, ...]) -> Float32:
    """Return ``values`` as float32 within their limits; what is not finite becomes 0."""
    limit = _limits(fields)
    plain = np.nan_to_num(np.array(values, np.float64), nan=0.0)
    cut: Float32 = np.clip(plain.astype(np.float32), -limit, limit)
    return cut
