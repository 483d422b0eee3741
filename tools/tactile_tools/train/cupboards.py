"""Many reaches at once in the planar engine: what a strategy is trained in."""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray

from reachd.strategies.memory import Memory
from reachd.strategies.parameter_fields import Parameters
from reachd.strategies.parameters import SETS
from sim_device.world.parameters import world_parameters
from sim_device.world.planar_arrays import empty, put
from sim_device.world.planar_solver import FALLEN
from sim_device.world.scenes import Scene
from tactile_core.geometry import TIP_X, Side
from tactile_tools.train.kernels import AGENT, CYCLE_S, CYCLES, REAL, RING, decide_some, skin_places
from tactile_tools.train.settings import Reward, Variety
from tactile_tools.train.tables import Table

NEAREST: Final = 10
"""Objects nearest to the tip that the critic sees."""

PRIVILEGED: Final = 5 * NEAREST + 4
"""Numbers that the critic sees besides the observation."""

BUILT: Final = ("worlds", "bodies", "outlines", "hulls", "readout")
"""What a scene is built into."""


def mirrored(scene: Scene) -> Scene:
    """``scene`` with left and right exchanged."""
    start = scene.start
    return replace(
        scene,
        start=replace(start, y=-start.y, heading=-start.heading),
        goal=(scene.goal[0], -scene.goal[1]),
        objects=tuple([replace(item, y=-item.y, yaw=-item.yaw) for item in scene.objects]),
    )


class Bank:
    """Scenes as rows of tables, from which worlds are begun; each also mirrored.

    ``device``: where the tables lie, "cpu" or "cuda".
    """

    def __init__(self, scenes: Sequence[Scene], device: str = "cpu") -> None:
        if not scenes:
            raise ValueError("no scenes to train on")
        both = [*scenes, *(mirrored(scene) for scene in scenes)]
        self.scenes = both
        self.originals = len(scenes)
        self.device = torch.device(device)
        self.room = max(len(scene.objects) for scene in both)
        arrays = empty(len(both), self.room)
        agents = np.zeros(len(both), AGENT)
        for row, scene in enumerate(both):
            figures = world_parameters(scene.parameters)
            put(arrays, row, scene, figures)
            agents[row] = _agent(scene, SETS[scene.parameters], figures.time_limit)
        self.tables = {name: Table(getattr(arrays, name), self.device) for name in BUILT}
        self.agents = Table(agents, self.device)

    def __len__(self) -> int:
        return len(self.scenes)


def _agent(scene: Scene, p: Parameters, limit: float) -> NDArray[Any]:
    """A reach in ``scene`` before it begins, felt exactly."""
    agent = np.zeros((), AGENT)
    agent["goal_x"], agent["goal_y"] = scene.goal
    agent["radius"], agent["limit"] = p.goal_radius, limit
    for name in (
        "v_max", "omega_max", "slow_radius", "slow_fraction", "turn_tolerance", "jam_time",
        "jam_progress", "jam_force", "sweep_time", "sweep_angle", "sweep_omega",
    ):  # fmt: skip
        agent[name] = getattr(p, name)
    agent["turn_within"] = p.straight_turn_within
    agent["slow_every"] = p.slow_for == "every"
    agent["at_tip"] = p.commanded_point == "tip"
    agent["every"], agent["gain"], agent["where"] = 1, 1.0, int(Side.NONE)
    x, y = scene.start.x, scene.start.y
    heading = scene.start.heading
    ex = scene.goal[0] - x - TIP_X * math.cos(heading)
    ey = scene.goal[1] - y - TIP_X * math.sin(heading)
    agent["distance"] = agent["closest"] = math.hypot(ex, ey)
    agent["best"] = math.inf
    return agent


@dataclass(frozen=True, slots=True)
class Turn:
    """What a decision led to; tensors have a row for each reach.

    ``observations``: (n, `WIDTH`), after finished reaches were begun anew. ``privileged``: (n,
    `PRIVILEGED`). ``rewards``: (n,). ``ended``: (n,) whether the reach ended with this decision.
    ``arrived``: (n,) whether it ended at the goal. ``seconds``: (n,) s that it has taken so far.
    ``force_n``: (n,) N, greatest summed force since the last decision.
    """

    observations: torch.Tensor
    privileged: torch.Tensor
    rewards: torch.Tensor
    ended: torch.Tensor
    arrived: torch.Tensor
    seconds: torch.Tensor
    force_n: torch.Tensor


class Cupboards:
    """``n`` reaches that go on side by side; one that ends begins anew in another scene.

    They move where the ``bank`` lies: on a GPU, a thread of it for each; else shared out among
    ``threads`` of the processor. ``rng``: what is drawn: scenes and how they vary. ``rows``: the
    scenes of the bank to begin with (default: drawn). Close it, or use it in ``with``.
    """

    def __init__(
        self,
        bank: Bank,
        n: int,
        rng: np.random.Generator,
        *,
        variety: Variety | None = None,
        reward: Reward | None = None,
        threads: int = 1,
        rows: Sequence[int] | None = None,
    ) -> None:
        self._bank, self._rng, self.device = bank, rng, bank.device
        self._variety, self._reward = variety or Variety(), reward or Reward()
        arrays = empty(n, bank.room)
        self._world = {name: Table(getattr(arrays, name), self.device) for name in arrays.names}
        self._agents = Table(np.zeros(n, AGENT), self.device)
        self._rings = Table(np.zeros((n, RING, 9), REAL), self.device)
        self._skin = Table(skin_places(), self.device)
        self._memory = Memory(n, torch, bank.device.type)
        self._rows = torch.zeros(n, dtype=torch.int64, device=self.device)
        self._action = torch.zeros((n, 3), dtype=torch.float64, device=self.device)
        self._ejected = torch.zeros(n, dtype=torch.float64, device=self.device)
        self._threads = threads
        self._pool = ThreadPoolExecutor(threads)
        self.launcher: Any = None
        if self.device.type == "cuda":
            from tactile_tools.train.kernels_cuda import Launcher

            self.launcher = Launcher(n)
        chosen = self._draw(n) if rows is None else self._there(np.asarray(rows, np.int64))
        self._begin(torch.arange(n, device=self.device), chosen)

    def __len__(self) -> int:
        return len(self._rows)

    def __enter__(self) -> Cupboards:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End its threads."""
        self._pool.shutdown()

    @property
    def pose(self) -> torch.Tensor:
        """(n, 3) pivot's x, y m and heading rad in ``cupboard``."""
        return self._world["readout"].tensor[:, :3]

    def observe(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Observations and privileged numbers before the first decision."""
        return self._observations(), self._privileged()

    def step(self, actions: torch.Tensor) -> Turn:
        """Carry out ``actions`` (n, 3): residuals ahead, aside and in turning; see `Policy`."""
        agents, reward, readout = self._agents, self._reward, self._world["readout"].tensor
        before = agents["distance"].clone()
        self._action = actions.to(self.device, torch.float64)
        agents["ahead"], agents["aside"], agents["turn"] = self._action.T
        self.run()
        ejected = readout[:, 10] - self._ejected
        self._ejected = readout[:, 10].clone()
        force = agents["true_force"].clone()
        arrived, ended = agents["reached"] != 0, agents["done"] != 0
        seconds = agents["cycle"].double() * CYCLE_S
        gains = (
            reward.progress * (before - agents["distance"])
            + arrived * reward.arrival * (2.0 - seconds / agents["limit"])
            - reward.decision
            - reward.force * (force - reward.free).clamp(min=0.0)
            - reward.ejected * ejected
            - reward.action * (self._action**2).sum(dim=1)
        )
        broken = readout[:, 11] != 0
        gains = torch.where(broken | ~gains.isfinite(), 0.0, gains)
        which = ended.nonzero()[:, 0]
        if len(which):
            rows, draws = self._draw(len(which)), self._rng.random(len(which))
            again = ~arrived[which] & self._there(draws < self._variety.again)
            self._begin(which, torch.where(again, self._rows[which], rows))
        return Turn(
            self._observations(),
            self._privileged(),
            gains.float(),
            ended,
            arrived & ended,
            seconds,
            force,
        )

    @property
    def arrays(self) -> list[Any]:
        """What `kernels.decide` takes, in its order."""
        tables = (self._agents, self._rings, self._skin, *self._world.values())
        return [table.kernel for table in tables]

    def run(self, cycles: int = CYCLES) -> None:
        """Let all move on by so many control cycles, or to their ends."""
        n, arrays = len(self), self.arrays
        if self.launcher is not None:
            self.launcher(cycles, *arrays)
            return
        size = max(1, math.ceil(n / (self._threads * 4)))
        parts = [
            self._pool.submit(decide_some, first, min(first + size, n), cycles, *arrays)
            for first in range(0, n, size)
        ]
        for part in parts:
            part.result()

    def _there(self, array: NDArray[Any]) -> torch.Tensor:
        return torch.from_numpy(array).to(self.device)

    def _draw(self, count: int) -> torch.Tensor:
        rows = self._rng.integers(0, self._bank.originals, count)
        other = self._rng.random(count) < self._variety.mirrored
        return self._there(np.asarray(rows + other * self._bank.originals, np.int64))

    def _begin(self, which: torch.Tensor, rows: torch.Tensor) -> None:
        """Begin the reaches ``which`` in the scenes ``rows`` of the bank, varied."""
        bank, rng, variety = self._bank, self._rng, self._variety
        count = len(which)
        for name, table in bank.tables.items():
            self._world[name].take(which, table, rows)
        self._world["wanted"].tensor[which] = 0.0
        friction = self._there(np.exp(rng.uniform(-1, 1, count) * variety.friction))
        mass = self._there(np.exp(rng.uniform(-1, 1, count) * variety.mass))[:, None]
        worlds, bodies = self._world["worlds"], self._world["bodies"]
        for name in ("object_object", "object_wall", "finger_object", "finger_wall"):
            worlds[name][which] *= friction
        for name in ("inv_mass", "inv_inertia", "inv_weight", "softness"):
            bodies[name][which, 1:] /= mass  # not the finger
        bodies["grip"][which, 1:] *= mass * friction[:, None]
        agents = self._agents
        agents.take(which, bank.agents, rows)
        taxels = rng.random(count) < variety.taxels
        for name, values in (
            ("every", np.where(taxels, 4, 1)),
            ("delay", np.where(taxels, rng.integers(3, 7, count), 0)),
            ("gain", 1.0 + rng.uniform(-1, 1, count) * variety.gain),
            ("bias", taxels * rng.random(count) * variety.bias),
            ("noise", np.where(taxels, rng.random(count) * variety.noise, 0.0)),
            ("lost", taxels * rng.random(count) * variety.lost),
            ("random", rng.integers(1, 2**63, count)),
        ):
            agents[name][which] = self._there(values)
        self._rings.tensor[which] = 0.0
        self._rows[which] = rows
        self._action[which] = 0.0
        self._ejected[which] = 0.0
        self._memory.forget(which, self.pose[which])

    def _observations(self) -> torch.Tensor:
        agents = self._agents
        # Counted per cycle of the last decision; none before the first.
        names = ("sum_total", "sum_tip", "max_peak", "last_x", "last_y", "sum_fx", "sum_fy")
        felt = torch.stack([agents[name] for name in (*names, "sum_mz", "touched")], dim=1)
        felt[:, [0, 1, 5, 6, 7, 8]] /= CYCLES
        state = torch.stack(
            [
                agents["limit"] - agents["cycle"].double() * CYCLE_S,
                agents["closest"],
                agents["sweep"] / agents["sweep_time"],
                agents["side"],
                agents["stuck"] / agents["jam_time"],
            ],
            dim=1,
        )
        found: torch.Tensor = self._memory.observe(
            felt,
            self.pose,
            self._action,
            torch.stack([agents["goal_x"], agents["goal_y"]], dim=1),
            state,
            torch.stack([agents["v_max"], agents["omega_max"]], dim=1),
        )
        return found

    def _privileged(self) -> torch.Tensor:
        """Nearest objects seen from the tip, and what nobody can feel: for the critic alone."""
        bodies, worlds, n = self._world["bodies"], self._world["worlds"], len(self)
        x, y, heading = self.pose.T
        c, s = heading.cos(), heading.sin()
        dx = bodies["x"][:, 1:-1] - (x + TIP_X / 2 * c)[:, None]
        dy = bodies["y"][:, 1:-1] - (y + TIP_X / 2 * s)[:, None]
        # Those that are not there or have fallen are far away.
        slots = torch.arange(1, dx.shape[1] + 1, device=self.device)
        absent = slots >= worlds["bodies"][:, None]
        away = dx**2 + dy**2 + 100.0 * (absent | (bodies["kind"][:, 1:-1] == FALLEN))
        near = min(NEAREST, away.shape[1])
        nearest = away.topk(near, dim=1, largest=False).indices
        dx, dy = dx.gather(1, nearest), dy.gather(1, nearest)
        found = torch.zeros((n, PRIVILEGED), device=self.device)
        table = found[:, : 5 * NEAREST].view(n, NEAREST, 5)[:, :near]
        c, s = c[:, None], s[:, None]
        table[:, :, 0] = (c * dx + s * dy) / 0.1
        table[:, :, 1] = (c * dy - s * dx) / 0.1
        for column, (name, scale) in enumerate((("radius", 0.03), ("vx", 0.05), ("vy", 0.05)), 2):
            table[:, :, column] = bodies[name][:, 1:-1].gather(1, nearest) / scale
        grip = bodies["grip"][:, 1:-1].gather(1, nearest[:, :1])[:, 0]
        found[:, -4] = (worlds["finger_object"] / 0.34).log()
        found[:, -3] = grip.clamp(min=1e-3).log()
        found[:, -2] = self._agents["every"] / 4
        found[:, -1] = self._agents["delay"] / 4
        return found.clamp(-5.0, 5.0)
