"""The built-in strategies: what they do when, and that they depend only on their inputs."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from reachd.gate.limits import usable
from reachd.interfaces import ZERO, ArmState, Goal, Twist
from reachd.strategies import load_strategy
from reachd.strategies.builtin import MAX_EVENTS, Moment, ReachingStrategy
from reachd.strategies.parameters import AUTHORS_SIM, HARDWARE, parameters
from reachd.strategies.runner import BUILT_IN
from tactile_core.geometry import Side
from tactile_core.types import Instant, after

T0 = Instant(5_000_000_000)
FAR = Goal(5.0, 0.0, 0.001, 20.0)
"""So far away that the finger does not get near in 20 s: progress is practically straight ahead."""


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def starts(activity: np.ndarray) -> list[int]:
    """Indices at which an excavation begins."""
    digs = np.char.startswith(activity, "excavate")
    return np.flatnonzero(digs & ~np.concatenate([[False], digs[:-1]])).tolist()


@pytest.mark.parametrize("name", ["straight", "burrow"])
def test_isolated_primitives_continue_indefinitely(name: str, fly: Callable) -> None:
    flown = fly(load_strategy(name, AUTHORS_SIM, rng()), FAR, 20.0)
    assert set(flown["activity"]) == {name}


@pytest.mark.parametrize(
    ("name", "between"), [("excavate", "straight"), ("hybrid_clock", "burrow")]
)
def test_simulator_set_allows_one_excavation_per_trial(
    name: str, between: str, fly: Callable
) -> None:
    """With 5 s, 5 s, 20 s and ≥ 5 s remaining, it begins after 5 s and there is no second one."""
    strategy: Any = load_strategy(name, AUTHORS_SIM, rng())
    flown = fly(strategy, FAR, 20.0)
    assert starts(flown["activity"]) == [501]
    digging = np.char.startswith(flown["activity"], "excavate")
    assert digging.sum() == 500
    assert set(flown["activity"][~digging]) == {between}
    begun, ended = strategy.take_events()
    assert (begun.kind, begun.trigger, begun.at) == ("excavation_start", "clock", after(T0, 5.01))
    assert (ended.kind, ended.direction) == ("excavation_end", begun.direction)
    assert strategy.take_events() == ()


def test_hardware_set_repeats_excavations_at_intervals(fly: Callable) -> None:
    """The time that remains makes no difference; the interval counts from the end."""
    strategy = load_strategy("excavate", HARDWARE, rng())
    flown = fly(strategy, replace(FAR, time_limit=40.0), 36.1)
    assert starts(flown["activity"]) == [501, 1502, 2503, 3504]


def test_clock_strategy_direction_is_even_and_seeded(fly: Callable) -> None:
    short = parameters("authors_sim", {"excavate_duration": 0.02, "trigger_interval": 0.02})
    goal = replace(FAR, time_limit=1e6)

    def directions(seed: int) -> list[str]:
        strategy: Any = load_strategy("hybrid_clock", short, rng(seed))
        fly(strategy, goal, 0.05 * 55)
        events = strategy.take_events()
        return [e.direction for e in events if e.kind == "excavation_start"]

    assert directions(1) == directions(1)
    drawn = [d for seed in range(20) for d in directions(seed)]
    assert len(drawn) > 500
    assert 0.42 < drawn.count("ccw") / len(drawn) < 0.58


def test_unread_events_are_bounded(fly: Callable) -> None:
    short = parameters("hardware", {"excavate_duration": 0.02, "trigger_interval": 0.02})
    strategy: Any = load_strategy("excavate", short, rng())
    fly(strategy, FAR, 10.0)
    assert len(strategy.take_events()) == MAX_EVENTS


def test_excavation_uses_frozen_or_current_heading(
    make_arm: Callable, make_touch: Callable
) -> None:
    def second(name: str) -> tuple[float, float]:
        strategy = load_strategy("excavate", parameters(name, {"trigger_interval": 0.005}), rng())
        strategy.start(FAR, T0)
        touch = make_touch(T0)
        strategy.step(touch, make_arm(T0, heading=0.0), FAR, T0)
        first = strategy.step(touch, make_arm(heading=0.0), FAR, after(T0, 0.01))
        turned = strategy.step(touch, make_arm(heading=1.0), FAR, after(T0, 0.02))
        return math.atan2(first.vy, first.vx), math.atan2(turned.vy, turned.vx)

    one, other = second("authors_sim")
    assert math.remainder(other - one, math.tau) == pytest.approx(0.0, abs=0.05)
    one, other = second("hardware")
    assert math.remainder(other - one, math.tau) == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize("name", ["peak_force", "peak_x", "peak_y", "total_force", "tip_force"])
@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_non_finite_inputs_are_not_used(name: str, value: float, make_touch: Callable) -> None:
    assert usable(make_touch(T0))
    assert not usable(make_touch(T0, **{name: value}))
    assert not usable(make_touch(T0, valid=False))


@settings(max_examples=40, deadline=None)
@given(
    st.sampled_from(list(BUILT_IN)),
    st.sampled_from([HARDWARE, AUTHORS_SIM]),
    st.integers(0, 1000),
)
def test_strategy_is_a_function_of_seed_and_inputs(
    make_touch: Callable, name: str, p: Any, seed: int
) -> None:
    def run() -> list[object]:
        strategy = load_strategy(name, p, rng(seed))
        world = np.random.default_rng(seed)
        strategy.start(FAR, T0)
        said: list[object] = []
        for k in range(60):
            now = after(T0, k * 0.3)
            x, y, h = world.normal(0, 0.1, 3).tolist()
            force = float(world.exponential(5))
            touch = make_touch(
                now,
                valid=bool(world.random() < 0.8),
                peak_force=force,
                total_force=force,
                tip_force=float(world.exponential(2)),
                peak_side=Side(int(world.integers(0, 4))),
                peak_y=y,
            )
            arm = ArmState(now, now, x, y, h, ZERO, 0.0, 0.0, 0.0, "moving", 1.0, 1.0, 1.0, 1.0)
            said.append((strategy.step(touch, arm, FAR, now), strategy.activity))
        return said

    assert run() == run()


class Undecided(ReachingStrategy):
    def _choose(self, at: Moment) -> Twist | None:
        return None


def test_choosing_nothing_without_an_excavation_is_an_error(
    make_arm: Callable, make_touch: Callable
) -> None:
    strategy = Undecided(HARDWARE, rng())
    strategy.start(FAR, T0)
    with pytest.raises(RuntimeError, match="_choose"):
        strategy.step(make_touch(T0), make_arm(), FAR, T0)
