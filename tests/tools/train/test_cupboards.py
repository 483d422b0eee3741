"""The cupboards that `learned` is trained in: the motion of the strategy, touch, rewards."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

pytest.importorskip("numba", reason="no numba: pip install 'tactile-reach[train]'")
pytest.importorskip("torch", reason="no torch: pip install 'tactile-reach[learn]'")

import torch

from reachd.interfaces import Goal
from reachd.strategies.learned import NEAR_GOAL_M, NEAR_GOAL_N, with_residual
from reachd.strategies.parameters import parameters
from reachd.strategies.quick_sweep import QuickSweep
from sim_device.world.scene_generation import generate
from sim_device.world.scenes import Scene
from tactile_core.geometry import TIP_X, Side
from tactile_core.types import Instant, after
from tactile_tools.train.cupboards import Bank, Cupboards
from tactile_tools.train.kernels import CYCLE_S
from tactile_tools.train.settings import NO_VARIETY, Reward, Variety

T0 = Instant(5_000_000_000)


@pytest.fixture(scope="module")
def scenes() -> list[Scene]:
    return [generate("authors_sim", 1_000_000 + k) for k in range(4)]


@pytest.fixture(scope="module")
def bank(scenes: list[Scene]) -> Bank:
    return Bank(scenes)


@pytest.mark.parametrize("name", ["authors_sim", "hardware"])
def test_motion_is_that_of_the_strategy(
    name: str, make_touch: Callable[..., Any], make_arm: Callable[..., Any]
) -> None:
    """Cycle by cycle what `QuickSweep` and `with_residual` give for the same touch and pose."""
    scene = generate(name, 1_000_005 if name == "authors_sim" else 1_000_001)
    p = parameters(name)
    residual = np.array([-0.1, 0.05, 0.1])
    worlds = Cupboards(Bank([scene]), 1, np.random.default_rng(0), variety=NO_VARIETY, rows=[0])
    agents = worlds._agents.kernel
    agents["ahead"], agents["aside"], agents["turn"] = residual
    agents["felt_any"] = 1
    strategy = QuickSweep(p, np.random.default_rng(0))
    goal = Goal(*scene.goal, p.goal_radius, p.time_limit)
    strategy.start(goal, T0)
    now, sweeps = T0, 0
    with worlds:
        for _ in range(900):
            agent = agents[0]
            if agent["done"]:
                break
            x, y, heading = worlds.pose[0].tolist()
            touch = make_touch(
                now,
                total_force=agent["total"],
                peak_force=agent["peak"],
                tip_force=agent["tip"],
                peak_side=Side(agent["where"]),
                peak_x=agent["x"],
                peak_y=agent["y"],
            )
            arm = make_arm(now, x=x, y=y, heading=heading)
            twist = strategy.step(touch, arm, goal, now)
            tip = (x + TIP_X * np.cos(heading), y + TIP_X * np.sin(heading))
            distance = np.hypot(goal.x - tip[0], goal.y - tip[1])
            if distance >= NEAR_GOAL_M or touch.total_force >= NEAR_GOAL_N:
                twist = with_residual(twist, residual, heading, p)
            worlds.run(1)
            wanted = worlds._world["wanted"].kernel[0]
            assert wanted == pytest.approx([twist.vx, twist.vy, twist.omega], abs=1e-12)
            sweeps += strategy.activity.startswith("sweep")
            now = after(now, CYCLE_S)
    assert sweeps > 50


def run(worlds: Cupboards, actions: np.ndarray, decisions: int) -> list[Any]:
    with worlds:
        return [worlds.step(torch.from_numpy(actions)) for _ in range(decisions)]


def test_same_seed_gives_the_same_bits_in_any_number_of_threads(bank: Bank) -> None:
    turns = [
        run(
            Cupboards(bank, 6, np.random.default_rng(2), threads=threads),
            np.full((6, 3), 0.3),
            40,
        )
        for threads in (1, 3)
    ]
    for one, other in zip(*turns, strict=True):
        for name in ("observations", "privileged", "rewards", "ended", "force_n"):
            assert torch.equal(getattr(one, name), getattr(other, name)), name


def test_mirrored_scene_mirrors_the_reach(bank: Bank) -> None:
    """Left and right are exchanged to rounding, so neither side is learned more than the other."""
    n = bank.originals
    worlds = Cupboards(
        bank, 2 * n, np.random.default_rng(0), variety=NO_VARIETY, rows=list(range(2 * n))
    )
    action = np.array([[0.2, 0.4, -0.3]] * n + [[0.2, -0.4, 0.3]] * n)
    with worlds:
        for _ in range(8):
            worlds.step(torch.from_numpy(action))
        pose = worlds.pose.numpy()
        assert pose[n:] == pytest.approx(pose[:n] * [1, -1, -1], abs=1e-6)


def test_every_reach_ends_by_its_limit_and_begins_anew(bank: Bank) -> None:
    back = np.tile((-2.0, 0.0, 0.0), (4, 1))  # out of the cupboard, never to arrive
    turns = run(Cupboards(bank, 4, np.random.default_rng(1), variety=NO_VARIETY), back, 201)
    assert not any(turn.ended.any() for turn in turns[:199])
    assert turns[199].ended.all()
    assert not turns[199].arrived.any()
    assert turns[199].seconds.tolist() == pytest.approx([20.0] * 4)
    assert turns[200].seconds.tolist() == pytest.approx([0.1] * 4)


def test_arrival_is_worth_more_the_sooner_it_comes(bank: Bank) -> None:
    reward = Reward(progress=0, decision=0, force=0, ejected=0, action=0, arrival=3)
    worlds = Cupboards(bank, 8, np.random.default_rng(1), variety=NO_VARIETY, reward=reward)
    turns = run(worlds, np.zeros((8, 3)), 200)
    arrived = [
        (float(turn.seconds[w]), float(turn.rewards[w]))
        for turn in turns
        for w in np.flatnonzero(turn.arrived)
    ]
    assert len(arrived) >= 3
    for seconds, worth in arrived:
        assert worth == pytest.approx(3 * (2 - seconds / 20.0), abs=1e-4)
    for turn in turns:
        assert not turn.rewards[~turn.arrived].any()


def test_touch_through_taxels_is_late_and_seldom(bank: Bank) -> None:
    """As a board's: a sample every 40 ms, 30 to 60 ms old, so force is felt later."""
    seldom = Variety(taxels=1, gain=0, noise=0, bias=0, lost=0, friction=0, mass=0, mirrored=0)

    def felt(variety: Variety) -> list[float]:
        worlds = Cupboards(bank, 1, np.random.default_rng(1), variety=variety, rows=[0])
        totals = []
        with worlds:
            for _ in range(300):
                worlds.run(1)
                totals.append(float(worlds._agents["total"][0]))
        return totals

    exact, spoilt = felt(NO_VARIETY), felt(seldom)
    first = [next(k for k, n in enumerate(totals) if n > 0) for totals in (exact, spoilt)]
    # The finger also waits for its first sample before it moves.
    assert 3 <= first[1] - first[0] <= 2 * (6 + 4)
    steps = np.flatnonzero(np.diff(spoilt)) % 4
    assert len(set(steps.tolist())) == 1
