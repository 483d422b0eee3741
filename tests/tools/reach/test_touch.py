"""What a strategy is told of touch, in every engine and at both depths, agrees with physics."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from reachd.inputs import MAX_PATCHES, make_touch
from reachd.interfaces import Touch, Wrench, arm_wrench
from reachd.strategies.parameters import parameters
from sim_device.board.catalogue import factory_calibration
from sim_device.world.base import WALL, FingerContact, FingerState, World
from sim_device.world.engines import ENGINES, EngineMissing, make_world
from tactile_core.bus.messages import MSG, codec, header
from tactile_core.bus.topics import FEATURES
from tactile_core.geometry import Side
from tactile_core.types import ZERO, Instant, WallClock, after
from tactile_tools.reach.lockstep import Step, run_trial
from tactile_tools.reach.touch_senses import TaxelSense
from tactiled.publisher import MessageMaker
from tests.support import trial_trace

SECONDS = 2.5
NOW = Instant(5_000_000_000)
OUT = MSG.Vector3(0.0, 1.0, 0.0)


def steps(depth: Any, engine: str = "mujoco") -> list[tuple[Step, Any, Any]]:
    """Cycles of a reach into clutter, with the wrench and the contacts of each moment."""
    scene = trial_trace.crowded()
    try:
        world: World = make_world(engine, scene)
    except EngineMissing as missing:
        pytest.skip(str(missing))
    seen: list[tuple[Step, Any, Any]] = []
    limited = replace(parameters(scene.parameters), time_limit=SECONDS)
    run_trial(
        scene,
        "straight",
        limited,
        3,
        depth=depth,
        world=world,
        watch=lambda step: seen.append((step, world.finger(), world.contacts())),
    )
    return seen


@pytest.mark.parametrize("engine", ENGINES)
def test_patches_are_the_contacts_and_sum_to_the_wrench(engine: str) -> None:
    touched = 0
    for step, _, contacts in steps("contacts", engine):
        touch = step.touch
        assert touch is not None
        assert len(touch.patches) == len(contacts)
        if not touch.patches:
            assert (touch.total_force, touch.wrench) == (0.0, Wrench(0.0, 0.0, 0.0))
            continue
        touched += 1
        forces = [p.normal_force for p in touch.patches]
        assert forces == sorted(forces, reverse=True)
        assert touch.peak_force == forces[0]
        assert sum(forces) == pytest.approx(touch.total_force)
        tip = sum(p.normal_force for p in touch.patches if p.side is Side.TIP)
        assert tip == pytest.approx(touch.tip_force)
        assert all(math.hypot(p.normal_x, p.normal_y) == pytest.approx(1.0) for p in touch.patches)
        summed = np.array([[p.force_x, p.force_y, p.x * p.force_y - p.y * p.force_x]
                           for p in touch.patches]).sum(axis=0)  # fmt: skip
        wrench = (touch.wrench.fx, touch.wrench.fy, touch.wrench.mz)
        assert summed == pytest.approx(wrench, abs=1e-9)
        assert {p.bound for p in touch.patches} == {0.0}
    assert touched > 20


def test_wrench_of_the_skin_is_that_of_the_arm() -> None:
    """The arm's sensor feels the same contacts, some milliseconds and a filter later."""
    skin, arm = [], []
    for step, state, _ in steps("contacts"):
        assert step.touch is not None
        turned = arm_wrench(replace(step.arm, heading=state.heading, fx=state.fx, fy=state.fy,
                                    mz=state.mz))  # fmt: skip
        skin.append((step.touch.wrench.fx, step.touch.wrench.fy, step.touch.wrench.mz))
        arm.append((turned.fx, turned.fy, turned.mz))
    away = np.abs(np.array(skin) - np.array(arm))
    assert np.abs(np.array(arm)).max() > 2.0
    assert np.median(away[:, :2]) < 0.05
    assert np.median(away[:, 2]) < 0.01


class Pressed:
    """A world in which something presses on the finger and nothing moves."""

    def __init__(self, *contacts: FingerContact) -> None:
        self._contacts: tuple[FingerContact, ...] = ()
        self._pressing = contacts
        self.scene = trial_trace.crowded()

    def press(self) -> None:
        self._contacts = self._pressing

    def contacts(self) -> tuple[FingerContact, ...]:
        return self._contacts

    def finger(self) -> FingerState:
        return FingerState(0.0, 0.0, 0.0, ZERO, 0.0, 0.0, 0.0)


LEFT = FingerContact(0.070, 0.0285, 0.0, 1.0, 0.8, -4.0, WALL)
RIGHT = FingerContact(0.050, -0.0285, 0.0, -1.0, 0.0, 3.0, WALL)
TIP = FingerContact(0.15185, 0.001, 1.0, 0.0, -4.0, 0.0, WALL)


@pytest.mark.parametrize("contacts", [(LEFT,), (RIGHT,), (TIP,), (LEFT, RIGHT)])
def test_patches_through_taxels_are_near_the_contacts(contacts: tuple[FingerContact, ...]) -> None:
    """Where they are, which way the skin faces there, and within its bound how hard they press."""
    world: Any = Pressed(*contacts)
    sense = TaxelSense(3)
    now = sense.settle(world, NOW)
    world.press()
    for _ in range(60):
        now = after(now, 0.01)
        touch = sense.feel(world, now)
    assert touch is not None
    assert touch.valid
    assert len(touch.patches) == len(contacts)
    for contact in contacts:
        felt = min(touch.patches, key=lambda p: math.hypot(p.x - contact.x, p.y - contact.y))
        assert math.hypot(felt.x - contact.x, felt.y - contact.y) < 0.01
        facing = felt.normal_x * contact.normal_x + felt.normal_y * contact.normal_y
        assert facing > math.cos(math.radians(20))
        assert 0.0 < felt.bound < 2.0
        # Round the corners of the tip a fifth of a press may be missing, a little beyond the bound.
        assert abs(felt.normal_force - contact.normal_force) < 1.25 * felt.bound
        assert felt.shear_force == pytest.approx(contact.shear_force, abs=0.7)
    summed = sum(c.force_x for c in contacts), sum(c.force_y for c in contacts)
    assert (touch.wrench.fx, touch.wrench.fy) == pytest.approx(summed, abs=1.2)


def test_message_of_a_cycle_says_the_same_as_lockstep() -> None:
    """What reachd makes of the message on the bus is what a trial in lockstep is given."""
    maker = MessageMaker(factory_calibration("finger", 3), WallClock(0))
    compared = 0
    for step, _, _ in steps("taxels"):
        touch, cycle = step.touch, step.cycle
        if touch is None or cycle is None or not touch.patches:
            continue
        message = codec().decode(FEATURES, codec().encode(FEATURES, maker.features(cycle)))
        heard = make_touch(message, touch.captured, touch.received)
        assert numbers(heard) == pytest.approx(numbers(touch), rel=1e-5, abs=1e-6)
        assert [p.side for p in heard.patches] == [p.side for p in touch.patches]
        compared += 1
    assert compared > 20


def numbers(touch: Touch) -> list[float]:
    """Every number of a touch."""
    flat = [touch.peak_force, touch.total_force, touch.tip_force, touch.tip_contact_time]
    flat += [touch.peak_force_bound, touch.normal_force_bound, touch.tip_force_bound]
    flat += [touch.wrench.fx, touch.wrench.fy, touch.wrench.mz]
    for p in touch.patches:
        flat += [p.x, p.y, p.normal_x, p.normal_y, p.normal_force, p.shear_force, p.bound]
    return flat


def patch(normal: float = 2.0, y: float = 0.0285, side: int = 1, out: Any = OUT) -> Any:
    return MSG.ContactPatch(
        array=0, side=side, taxels=2, normal_force=normal, peak_force=normal,
        force=MSG.Vector3(0.5, -normal, 0.25), centroid=MSG.Point(0.1, y, 0.01), normal=out,
        normal_force_bound=0.3,
    )  # fmt: skip


@pytest.fixture
def message() -> Callable[..., Any]:
    """Valid features with these patches."""

    def make(*patches: Any, valid: bool = True) -> Any:
        return MSG.ContactFeatures(
            header=header(0, "ee"), captured_ns=1, received_ns=1, uncertainty=0.0, sequence=1,
            valid=valid, reasons=[], calibrated=True, peak_force=2.0, peak_side=1,
            peak_position=MSG.Point(0.1, 0.0285, 0.0), normal_force=2.0,
            wrench=MSG.Wrench(MSG.Vector3(0.5, -2.0, 9.0), MSG.Vector3(8.0, 7.0, -0.2)),
            tip_force=0.0, tip_contact_time=1.5, taxels_in_contact=2, taxels_masked=0,
            patches=list(patches), reason_codes=[], peak_force_bound=0.1, normal_force_bound=0.2,
            tip_force_bound=0.3,
        )  # fmt: skip

    return make


def test_message_becomes_planar_patches_strongest_first(message: Callable[..., Any]) -> None:
    touch = make_touch(message(patch(1.0), patch(3.0, y=-0.0285, side=2)), NOW, NOW)
    strong, weak = touch.patches
    assert (strong.normal_force, strong.side, strong.y) == (3.0, Side.RIGHT, -0.0285)
    assert (weak.force_x, weak.force_y) == pytest.approx((0.5, -1.0))
    assert weak.shear_force == pytest.approx(-0.5), "forward along the left side is clockwise"
    assert weak.bound == 0.3
    assert touch.wrench == Wrench(0.5, -2.0, -0.2)
    assert (touch.tip_contact_time, touch.tip_force_bound) == (1.5, 0.3)


def test_leaning_normal_counts_by_its_direction_in_the_plane(message: Callable[..., Any]) -> None:
    (leaning,) = make_touch(message(patch(2.0, out=MSG.Vector3(0.0, 0.6, 0.8))), NOW, NOW).patches
    assert (leaning.normal_x, leaning.normal_y) == pytest.approx((0.0, 1.0))


@pytest.mark.parametrize(
    "patches",
    [
        [patch(math.nan)],
        [patch(y=math.inf)],
        [patch(side=9)],
        [patch()] * (MAX_PATCHES + 1),
    ],
    ids=["force", "place", "side", "many"],
)
def test_patches_that_mean_nothing_are_refused(
    patches: list[Any], message: Callable[..., Any]
) -> None:
    with pytest.raises(ValueError, match=r"patch|Side"):
        make_touch(message(*patches), NOW, NOW)


def test_patches_of_invalid_features_are_left_out(message: Callable[..., Any]) -> None:
    touch = make_touch(message(patch(math.nan), valid=False), NOW, NOW)
    assert (touch.valid, touch.patches) == (False, ())
