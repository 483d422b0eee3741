"""The event-driven strategy: its reaction to touch, and when and in which direction it digs."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from reachd.interfaces import ZERO, Goal
from reachd.strategies import load_strategy
from reachd.strategies.parameters import AUTHORS_SIM, parameters
from reachd.strategies.primitives import aim, burrow, straight
from tactile_core.geometry import Side
from tactile_core.types import Instant, after

T0 = Instant(5_000_000_000)
FAR = Goal(5.0, 0.0, 0.001, 20.0)
"""So far away that the finger does not get near in 20 s: progress is practically straight ahead."""


class Driven:
    """A strategy stepped by hand, with the finger at a given place."""

    def __init__(self, strategy: Any, make_touch: Callable, make_arm: Callable) -> None:
        self.strategy, self.make_touch, self.make_arm = strategy, make_touch, make_arm
        self.now = T0
        strategy.start(FAR, T0)

    def step(self, x: float = -0.2, dt: float = 0.01, **touch: Any) -> str:
        """Run one step with this touch; returns the activity."""
        arm = self.make_arm(self.now, x=x)
        self.twist = self.strategy.step(self.make_touch(self.now, **touch), arm, FAR, self.now)
        self.arm = arm
        self.now = after(self.now, dt)
        return self.strategy.activity

    def until(self, seconds: float, x: float = -0.2, **touch: Any) -> float | None:
        """Step until an excavation begins; returns its time in s since the start, or None."""
        end = after(self.now, seconds)
        while self.now < end:
            at = self.now
            if self.step(x, **touch).startswith("excavate"):
                return (at - T0) / 1e9
        return None


@pytest.fixture
def event(make_arm: Callable, make_touch: Callable) -> Callable[..., Driven]:
    """Hybrid event strategy of a set, with overrides, stepped by hand."""

    def make(name: str, seed: int = 0, **overrides: Any) -> Driven:
        p = parameters(name, overrides)
        return Driven(
            load_strategy("hybrid_event", p, np.random.default_rng(seed)), make_touch, make_arm
        )

    return make


@pytest.mark.parametrize(
    ("name", "measure", "threshold"),
    [("hardware", "peak_force", 5.0), ("authors_sim", "total_force", 1.5)],
)
def test_event_strategy_burrows_above_its_force_threshold(
    name: str, measure: str, threshold: float, event: Callable[..., Driven]
) -> None:
    run = event(name)
    p = parameters(name)
    assert run.step(**{measure: threshold}) == "straight"
    here = aim(run.arm, FAR, p.tip_length)
    assert run.twist == straight(here, 0.0, p)
    assert run.step(**{measure: math.nextafter(threshold, 9)}) == "burrow"
    assert run.twist == burrow(here, 0.0, 0.01, p)
    other = "total_force" if measure == "peak_force" else "peak_force"
    assert run.step(**{other: 9.0}) == "straight", "the other measure does not count"


@pytest.mark.parametrize(("name", "after_s"), [("hardware", 2.0), ("authors_sim", 2.0833)])
def test_sustained_light_tip_contact_excavates(
    name: str, after_s: float, event: Callable[..., Driven]
) -> None:
    run = event(name)
    begun = run.until(5.0, tip_force=1.0, peak_side=Side.LEFT)
    assert begun == pytest.approx(after_s, abs=0.0101)
    assert begun >= after_s - 1e-3
    assert [e.trigger for e in run.strategy.take_events()] == ["push"]


@pytest.mark.parametrize(
    ("name", "force", "excavates"),
    [
        ("hardware", 0.5, True),
        ("hardware", math.nextafter(0.5, 0), False),
        ("hardware", 7.5, True),
        ("hardware", math.nextafter(7.5, 9), False),
        ("hardware", 0.0, False),
        ("authors_sim", 0.05, True),
        ("authors_sim", 5.0, True),
        ("authors_sim", math.nextafter(5.0, 9), False),
        ("authors_sim", math.nextafter(0.05, 0), False),
    ],
)
def test_only_light_contact_counts_as_pushing(
    name: str, force: float, excavates: bool, event: Callable[..., Driven]
) -> None:
    assert (event(name).until(4.0, tip_force=force) is not None) == excavates


@pytest.mark.parametrize(("name", "gap_s"), [("hardware", 0.1), ("authors_sim", 0.025)])
def test_short_gaps_in_a_push_are_bridged(
    name: str, gap_s: float, event: Callable[..., Driven]
) -> None:
    for steps, kept in ((math.ceil(gap_s / 0.01) - 1, True), (math.ceil(gap_s / 0.01), False)):
        run = event(name)
        run.until(1.0, tip_force=1.0)
        for _ in range(steps):
            run.step(tip_force=0.0)
        begun = run.until(5.0, tip_force=1.0)
        assert begun is not None
        whole = parameters(name).push_time
        assert (begun < whole + 0.02) == kept, (steps, begun)


def test_stall_under_load_excavates(event: Callable[..., Driven]) -> None:
    """Standing still: v_max·(t − t_prog) ≥ 0 from t = t_prog on."""
    run = event("hardware")
    assert run.until(10.0, peak_force=10.0) == pytest.approx(3.0, abs=0.0101)
    assert [e.trigger for e in run.strategy.take_events()] == ["stall"]
    run = event("authors_sim")
    assert run.until(10.0, total_force=7.5) == pytest.approx(3.125, abs=0.0101)


def test_stall_or_load_alone_does_not_excavate(event: Callable[..., Driven]) -> None:
    assert event("hardware").until(10.0, peak_force=math.nextafter(10.0, 0)) is None
    run = event("hardware")
    for k in range(1000):  # at v_max the lag never grows
        assert not run.step(x=-0.2 + 0.045 * 0.01 * k, peak_force=20.0).startswith("excavate")


def test_progress_window_applies_wherever_progress_is_lost(event: Callable[..., Driven]) -> None:
    """Half speed: d is reduced by v/2·t ≤ v·(t − 3) from t = 6 s on."""
    run = event("hardware")
    for k in range(1000):
        if run.step(x=-0.2 + 0.0225 * 0.01 * k, peak_force=20.0).startswith("excavate"):
            break
    assert k * 0.01 == pytest.approx(6.0, abs=0.0101)


@pytest.mark.parametrize(("name", "again"), [("hardware", 3.0), ("authors_sim", 3.125 - 0.4)])
def test_progress_restarts_after_an_excavation(
    name: str, again: float, event: Callable[..., Driven]
) -> None:
    """It ends 2 cm behind its start: an advantage only if progress counts from its end."""
    run = event(name)
    load = {"peak_force": 20.0, "total_force": 20.0}
    begun = run.until(10.0, x=0.02, **load)
    assert begun is not None
    while run.step(x=0.0, **load).startswith("excavate"):
        pass
    second = run.until(10.0, x=0.0, **load)
    assert second is not None
    assert second - (begun + 5.0) == pytest.approx(again, abs=0.02)


def test_push_restarts_after_an_excavation(event: Callable[..., Driven]) -> None:
    run = event("hardware")
    first = run.until(5.0, tip_force=1.0)
    while run.step(tip_force=1.0).startswith("excavate"):
        pass
    second = run.until(5.0, tip_force=1.0)
    assert first is not None
    assert second is not None
    assert second - first == pytest.approx(5.0 + 2.0, abs=0.03)


def test_simulator_set_starts_no_excavation_it_cannot_finish(
    event: Callable[..., Driven],
) -> None:
    for remaining, begins in ((5.0, True), (4.99, False)):
        run = event("authors_sim")
        run.now = after(T0, 20.0 - remaining)
        assert run.step(total_force=20.0).startswith("excavate") == begins
    run = event("hardware")
    run.now = after(T0, 19.9)
    assert run.step(peak_force=20.0).startswith("excavate")


@pytest.mark.parametrize(
    ("side", "peak_y", "direction"),
    [
        (Side.LEFT, -0.02, "ccw"),
        (Side.RIGHT, 0.02, "cw"),
        (Side.TIP, 0.003, "ccw"),
        (Side.TIP, -0.003, "cw"),
    ],
)
def test_hardware_set_excavates_by_the_side_of_the_peak(
    side: Side, peak_y: float, direction: str, event: Callable[..., Driven]
) -> None:
    for seed in range(20):
        run = event("hardware", seed)
        run.until(4.0, peak_force=12.0, peak_side=side, peak_x=0.1, peak_y=peak_y)
        assert run.strategy.activity == f"excavate_{direction}"


@pytest.mark.parametrize("name", ["hardware", "authors_sim"])
def test_peak_without_side_gives_a_random_direction(
    name: str, event: Callable[..., Driven]
) -> None:
    seen = []
    for seed in range(60):
        run = event(name, seed)
        run.until(4.0, peak_force=12.0, total_force=12.0, peak_side=Side.NONE)
        seen.append(run.strategy.activity)
    assert 15 < seen.count("excavate_ccw") < 45


def test_simulator_set_follows_its_comparison_in_three_of_four(
    make_arm: Callable, make_touch: Callable
) -> None:
    """Heading 30° left: a contact on the finger's left side may lie to the right of the tip."""
    followed = 0
    for seed in range(400):
        strategy = load_strategy("hybrid_event", AUTHORS_SIM, np.random.default_rng(seed))
        strategy.start(FAR, T0)
        late = after(T0, 4.0)
        arm = make_arm(late, heading=math.radians(30))
        strategy.step(make_touch(T0), arm, FAR, T0)
        # y = sin 30°·0.05 + cos 30°·0.0285 = 0.0497, and the tip is at sin 30°·0.158 = 0.079.
        touch = make_touch(late, total_force=20.0, peak_side=Side.LEFT, peak_x=0.05, peak_y=0.0285)
        strategy.step(touch, arm, FAR, late)
        followed += strategy.activity == "excavate_cw"
    assert followed / 400 == pytest.approx(0.75, abs=0.06)


def test_invalid_touch_never_counts_as_no_contact(event: Callable[..., Driven]) -> None:
    run = event("hardware")
    assert run.step(valid=False) == "waiting"
    assert run.twist == ZERO
    assert run.step(peak_force=6.0) == "burrow"
    for _ in range(10):
        assert run.step(valid=False) == "burrow", "it goes on with what it did"
        assert run.step(peak_force=math.nan) == "burrow"
    assert run.step() == "straight"
    assert run.step(valid=False, peak_force=100.0) == "straight"


def test_invalid_touch_neither_triggers_nor_counts(event: Callable[..., Driven]) -> None:
    run = event("hardware")
    run.step()
    assert run.until(10.0, valid=False, peak_force=20.0, tip_force=1.0) is None
    run = event("hardware")
    run.until(1.0, tip_force=1.0)
    run.until(1.0, valid=False, tip_force=0.0)
    begun = run.until(5.0, tip_force=1.0)
    assert begun == pytest.approx(3.0, abs=0.03), "the time without knowledge is left out"


def test_start_clears_the_previous_reach(event: Callable[..., Driven]) -> None:
    run = event("hardware")
    run.until(4.0, peak_force=20.0)
    assert run.strategy.activity.startswith("excavate")
    run.strategy.start(FAR, run.now)
    assert run.strategy.take_events() == ()
    assert run.step(peak_force=20.0) == "burrow"
    assert run.until(2.9, peak_force=20.0) is None
