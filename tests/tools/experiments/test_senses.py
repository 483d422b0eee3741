"""Touch degraded in one way at a time, and what of it reaches a strategy."""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np
import pytest

from sim_device.world.base import FingerContact
from tactile_core.geometry import Side
from tactile_core.types import Instant, after
from tactile_tools.experiments.conditions import parameters_of, scene_of, sense_of, world_of
from tactile_tools.experiments.degraded_touch import (
    DegradedContacts,
    DegradedTaxels,
    FingerStretch,
    dead_taxels,
)
from tactile_tools.experiments.spec import TrialSpec
from tactile_tools.experiments.trial import run_one

START = Instant(1_000_000_000)


class Pressed:
    """A world in which something presses on the finger."""

    def __init__(self, *contacts: FingerContact) -> None:
        self._contacts = contacts
        self.scene = scene_of(spec())

    def contacts(self) -> tuple[FingerContact, ...]:
        return self._contacts


def press(x: float, y: float, force: float, *, side: float = 1.0) -> FingerContact:
    """A force straight into the left side of the finger (for −1: the right side)."""
    return FingerContact(x, y, 0.0, side, 0.0, -side * force, 0)


def spec(depth: str = "contacts", seconds: float = 1.0, **conditions: Any) -> TrialSpec:
    return TrialSpec(
        "hardware", 5, "hardware", "mujoco", depth, "burrow", 5,
        json.dumps({"time_limit": seconds}), json.dumps(conditions),
    )  # fmt: skip


def contacts_sense(**changed: Any) -> DegradedContacts:
    settings: dict[str, Any] = {"noise": 0.0, "rate": None, "dead": 0.0, "stretch": 1.0}
    return DegradedContacts(3, **{**settings, **changed})


def test_unchanged_condition_uses_plain_touch() -> None:
    assert sense_of(spec(), scene_of(spec())) is None
    crowded = spec(friction_all=0.3)
    assert sense_of(crowded, scene_of(crowded)) is None


def test_noise_has_its_standard_deviation_and_forces_stay_positive() -> None:
    sense = contacts_sense(noise=0.5)
    world: Any = Pressed(press(0.05, 0.0285, 8.0))
    felt = [sense.feel(world, after(START, 0.01 * i)) for i in range(2000)]
    peaks = np.array([t.peak_force for t in felt if t is not None])
    assert peaks.mean() == pytest.approx(8.0, abs=0.05)
    assert peaks.std() == pytest.approx(0.5, rel=0.1)
    quiet: Any = Pressed()
    empty = [sense.feel(quiet, after(START, 20 + 0.01 * i)) for i in range(500)]
    assert min(t.peak_force for t in empty if t is not None) == 0.0


def test_slow_stream_renews_touch_at_its_rate_with_its_age() -> None:
    sense = contacts_sense(rate=15.0)
    stamps = []
    for i in range(200):
        now = after(START, 0.01 * i)
        world: Any = Pressed(press(0.05, 0.0285, 1.0 + i))
        touch = sense.feel(world, now)
        assert touch is not None
        assert 0 <= now - touch.captured < 0.0767e9
        stamps.append(touch.captured)
    assert len(set(stamps)) == pytest.approx(2.0 * 15, abs=1)


def test_gate_tolerates_a_stream_known_to_be_slow() -> None:
    safety = parameters_of(spec(feature_rate=5.0)).safety
    assert safety.features_age == pytest.approx(0.6)
    assert parameters_of(spec(feature_rate=50.0)).safety == parameters_of(spec()).safety


def test_dead_taxels_match_the_fraction_and_are_nested() -> None:
    few, more = dead_taxels(3, 0.1), dead_taxels(3, 0.4)
    assert len(few) == 8
    assert len(more) == 32
    assert set(few) < set(more)
    assert set(few) != set(dead_taxels(4, 0.1))


def test_contact_is_felt_only_if_its_column_is_alive() -> None:
    world: Any = Pressed(*(press(0.02 + 0.01 * i, 0.0285, 4.0) for i in range(10)))
    whole = contacts_sense().feel(world, START)
    half = contacts_sense(dead=0.5).feel(world, START)
    none = contacts_sense(dead=1.0).feel(world, START)
    assert whole is not None
    assert half is not None
    assert none is not None
    assert whole.total_force == pytest.approx(40.0)
    assert 8.0 < half.total_force < 32.0
    assert (none.total_force, none.peak_side) == (0.0, Side.NONE)


@pytest.mark.parametrize("stretch", [0.7, 1.3])
def test_wider_finger_feels_the_same_forces_at_its_width(stretch: float) -> None:
    y = 0.0285 * stretch
    slope = math.radians(14.0)
    pressed = FingerContact(
        0.12, y, math.sin(slope), math.cos(slope), -3.0 * math.sin(slope), -3.0 * math.cos(slope), 0
    )
    (moved,) = FingerStretch(stretch).contacts([pressed])
    assert moved.y == pytest.approx(0.0285)
    assert math.hypot(moved.normal_x, moved.normal_y) == pytest.approx(1.0)
    assert moved.normal_force == pytest.approx(3.0)
    assert moved.shear_force == pytest.approx(0.0, abs=1e-12)
    world: Any = Pressed(pressed)
    touch = contacts_sense(stretch=stretch).feel(world, START)
    assert touch is not None
    assert (touch.peak_x, touch.peak_y) == pytest.approx((0.12, y))
    assert touch.peak_side is Side.LEFT


@pytest.mark.parametrize("width", [0.04, 0.075])
@pytest.mark.parametrize("engine", ["mujoco", "pymunk"])
def test_objects_touch_the_finger_at_its_width(width: float, engine: str) -> None:
    from dataclasses import replace

    from sim_device.world.scenes import Pose, SceneObject, Shape
    from tactile_core.types import Twist

    wide = replace(spec(finger_width=width), engine=engine)
    box = SceneObject(Shape.BOX, 0.04, 0.04, 0.07, 0.3, 0.05, width / 2 + 0.02 + 0.002, 0.0)
    scene = replace(scene_of(wide), objects=(box,), start=Pose(0.0, 0.0, 0.0))
    world = world_of(wide, scene)
    world.limit_wrench(15.0, 4.5)
    for _ in range(100):
        world.step(0.01, Twist(0.0, 0.01, 0.0))
    touched = [c.y for c in world.contacts() if c.body == 0]
    assert touched
    assert all(y == pytest.approx(width / 2, abs=1e-3) for y in touched)


def test_every_condition_has_an_effect_and_repeats_bit_for_bit() -> None:
    from tactile_tools.experiments.rows import outcome_of

    plain = run_one(spec(seconds=4.0))
    for changed in (
        {"friction_all": 0.45},
        {"friction_objects": 0.4},
        {"finger_width": 0.075},
        {"objects": [24, 24]},
    ):
        row = run_one(spec(seconds=4.0, **changed))
        assert row["error"] is None
        assert row["distance_m"] != plain["distance_m"], changed
        assert outcome_of(run_one(spec(seconds=4.0, **changed))) == outcome_of(row)


def test_degraded_board_affects_the_whole_chain() -> None:
    from tactile_tools.experiments.rows import outcome_of

    conditions = {"noise": 0.1, "dead_taxels": 0.1, "feature_rate": 10.0}
    plain = run_one(spec("taxels", 4.0))
    worse = run_one(spec("taxels", 4.0, **conditions))
    assert plain["error"] is worse["error"] is None
    assert plain["peak_contact_n"] > 0
    assert worse["peak_contact_n"] != plain["peak_contact_n"]
    assert outcome_of(run_one(spec("taxels", 4.0, **conditions))) == outcome_of(worse)


def test_board_flags_its_dead_taxels() -> None:
    bad = spec("taxels", dead_taxels=0.1)
    scene = scene_of(bad)
    sense = sense_of(bad, scene)
    assert isinstance(sense, DegradedTaxels)
    sense.settle(world_of(bad, scene), START)
    assert sense.cycle is not None
    assert sense.cycle.features.taxels_masked == 8
