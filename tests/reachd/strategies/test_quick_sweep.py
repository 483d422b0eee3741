"""quick_sweep: when it takes the finger to be jammed, how it sweeps, and what it makes of touch."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from reachd.interfaces import ZERO, Goal
from reachd.strategies import load_strategy
from reachd.strategies.parameters import parameters
from reachd.strategies.primitives import aim, straight
from tactile_core.geometry import Side
from tactile_core.types import Instant, after

T0 = Instant(5_000_000_000)
FAR = Goal(5.0, 0.0, 0.001, 20.0)
JAMMED = {"total_force": 10.0, "peak_force": 6.0, "peak_side": Side.LEFT, "peak_y": 0.02}


class Driven:
    """The strategy stepped by hand, the finger held where it is told."""

    def __init__(self, strategy: Any, make_touch: Callable, make_arm: Callable) -> None:
        self.strategy, self.make_touch, self.make_arm = strategy, make_touch, make_arm
        self.now = T0
        strategy.start(FAR, T0)

    def step(self, x: float = -0.2, **touch: Any) -> str:
        """One cycle with the finger at ``x`` and this touch; returns the activity."""
        self.arm = self.make_arm(self.now, x=x)
        felt = self.make_touch(self.now, **touch)
        self.twist = self.strategy.step(felt, self.arm, FAR, self.now)
        self.now = after(self.now, 0.01)
        return self.strategy.activity

    def until(self, wanted: str, seconds: float, **touch: Any) -> float | None:
        """Step until the activity begins with ``wanted``; s since the call, None if it does not."""
        for k in range(round(seconds / 0.01)):
            if self.step(**touch).startswith(wanted):
                return k * 0.01
        return None


@pytest.fixture
def drive(make_arm: Callable, make_touch: Callable) -> Callable[..., Driven]:
    """quick_sweep with a parameter set, overridden as given."""

    def make(name: str = "authors_sim", seed: int = 0, **overrides: Any) -> Driven:
        strategy = load_strategy(
            "quick_sweep", parameters(name, overrides), np.random.default_rng(seed)
        )
        return Driven(strategy, make_touch, make_arm)

    return make


@pytest.mark.parametrize("name", ["hardware", "authors_sim"])
def test_standing_still_under_load_starts_a_sweep(name: str, drive: Callable[..., Driven]) -> None:
    run = drive(name)
    assert run.until("sweep", 5.0, **JAMMED) == pytest.approx(0.3, abs=0.011)
    (event,) = run.strategy.take_events()
    assert (event.kind, event.direction, event.trigger) == ("sweep_start", "cw", "jam")
    assert event.family == "sweep"


def test_a_light_touch_or_progress_is_not_a_jam(drive: Callable[..., Driven]) -> None:
    assert drive().until("sweep", 5.0, total_force=4.49) is None
    run = drive()
    # 1.8 mm in 0.25 s are enough, as slow as that is.
    for k in range(500):
        assert run.step(x=-0.2 + 0.0073 * 0.01 * k, **JAMMED) == "straight"


def test_creeping_is_a_jam(drive: Callable[..., Driven]) -> None:
    run = drive()
    assert any(run.step(x=-0.2 + 0.004 * 0.01 * k, **JAMMED) == "sweep_cw" for k in range(60))


@pytest.mark.parametrize(
    ("side", "peak_y", "activity"),
    [
        (Side.LEFT, -0.02, "sweep_cw"),
        (Side.RIGHT, 0.02, "sweep_ccw"),
        (Side.TIP, 0.003, "sweep_cw"),
        (Side.TIP, -0.003, "sweep_ccw"),
    ],
)
def test_sweep_goes_away_from_the_contact(
    side: Side, peak_y: float, activity: str, drive: Callable[..., Driven]
) -> None:
    for seed in range(5):
        run = drive(seed=seed)
        run.until("sweep", 1.0, total_force=10.0, peak_side=side, peak_y=peak_y)
        assert run.strategy.activity == activity


def test_contact_in_the_middle_leaves_the_side_to_the_seed(drive: Callable[..., Driven]) -> None:
    def side(seed: int) -> str:
        run = drive(seed=seed)
        run.until("sweep", 1.0, total_force=10.0, peak_side=Side.TIP, peak_y=0.0)
        return str(run.strategy.activity)

    sides = [side(seed) for seed in range(20)]
    assert set(sides) == {"sweep_cw", "sweep_ccw"}
    assert sides == [side(seed) for seed in range(20)]


def test_sweep_moves_aside_and_forward_at_full_speed(drive: Callable[..., Driven]) -> None:
    run = drive("authors_sim")
    run.until("sweep", 1.0, **JAMMED)
    p = parameters("authors_sim")
    assert math.hypot(run.twist.vx, run.twist.vy) == pytest.approx(p.v_max)
    assert math.atan2(run.twist.vy, run.twist.vx) == pytest.approx(-p.sweep_angle)
    assert run.twist.omega == -p.sweep_omega


def test_sweep_of_the_hardware_set_stays_within_the_gate(drive: Callable[..., Driven]) -> None:
    """There the tip gets the speed, and the pivot turns beneath it."""
    run = drive("hardware")
    run.until("sweep", 1.0, **JAMMED)
    safety = parameters("hardware").safety
    assert math.hypot(run.twist.vx, run.twist.vy) <= safety.speed
    assert abs(run.twist.omega) <= safety.turn_rate


def test_after_a_sweep_the_next_jam_has_to_last_as_long(drive: Callable[..., Driven]) -> None:
    run = drive()
    run.until("sweep", 1.0, **JAMMED)
    assert run.until("straight", 1.0, **JAMMED) == pytest.approx(0.6, abs=0.021)
    here = aim(run.arm, FAR, parameters("authors_sim").tip_length)
    assert run.twist == straight(here, 0.0, parameters("authors_sim"))
    assert run.until("sweep", 1.0, **JAMMED) == pytest.approx(0.3, abs=0.021)
    kinds = [event.kind for event in run.strategy.take_events()]
    assert kinds == ["sweep_start", "sweep_end", "sweep_start"]


def test_it_waits_until_touch_is_valid(drive: Callable[..., Driven]) -> None:
    run = drive()
    assert run.step(valid=False, **JAMMED) == "waiting"
    assert run.twist == ZERO
    assert run.step() == "straight"


def test_time_with_invalid_touch_does_not_count(drive: Callable[..., Driven]) -> None:
    run = drive()
    assert run.until("sweep", 0.2, **JAMMED) is None
    assert run.until("sweep", 2.0, valid=False, **JAMMED) is None
    assert run.strategy.activity == "straight", "it goes on with what it did"
    assert run.until("sweep", 1.0, **JAMMED) == pytest.approx(0.1, abs=0.03)


def test_sweep_goes_on_while_touch_is_invalid_and_ends(drive: Callable[..., Driven]) -> None:
    run = drive()
    run.until("sweep", 1.0, **JAMMED)
    assert run.until("straight", 1.0, valid=False) == pytest.approx(0.6, abs=0.021)


def test_start_forgets_a_sweep(drive: Callable[..., Driven]) -> None:
    run = drive()
    run.until("sweep", 1.0, **JAMMED)
    run.strategy.start(FAR, run.now)
    assert run.strategy.take_events() == ()
    assert run.step(**JAMMED) == "straight"
    assert run.until("sweep", 0.25, **JAMMED) is None
