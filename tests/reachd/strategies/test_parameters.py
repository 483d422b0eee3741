"""The two parameter sets contain their sources' values, and refuse invalid ones."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import pytest
from msgspec import inspect

from reachd.gate.settings import ALWAYS_ON, Check, SafetySettings
from reachd.gate.workspace import Region, box
from reachd.services import make_goal, parse_target
from reachd.strategies.parameter_fields import Parameters
from reachd.strategies.parameters import AUTHORS_SIM, HARDWARE, SETS, parameters
from tactile_core.config import ConfigError

TABLES = {
    # Tables I and II of the paper.
    "hardware": {
        "v_max": 0.045,
        "omega_max": 0.1,
        "burrow_amplitude": 0.83,
        "excavate_duration": 5.0,
        "trigger_interval": 5.0,
        "spiral_growth": 2.0,
        "burrow_force": 5.0,
        "excavate_force": 10.0,
        "push_force_min": 0.5,
        "push_force_max": 7.5,
        "push_time": 2.0,
        "progress_time": 3.0,
        "goal_radius": 0.0075,
        "safety.force": 15.0,
        "safety.torque": 4.5,
        "safety.arm_f_max": 15.0 / math.sqrt(2.0),  # on both axes at once 15
        "safety.arm_m_max": 4.5,
    },
    # The authors' simulator, lengths / 10.
    "authors_sim": {
        "v_max": 0.05,
        "omega_max": 0.35,
        "excavate_omega_max": 0.25,
        "burrow_ratio": 2.0,
        "burrow_frequency": 3.01592895,
        "excavate_duration": 5.0,
        "trigger_interval": 5.0,
        "spiral_growth": 2.0,
        "time_limit": 20.0,
        "goal_radius": 0.001,
        "burrow_force": 1.5,
        "excavate_force": 7.5,
        "push_force_min": 0.05,
        "push_force_max": 5.0,
        "push_time": 2.083333333,
        "push_dropout": 0.025,
        "progress_time": 3.125,
        "direction_obedience": 0.75,
        "safety.arm_f_max": 10.0,
        "safety.arm_m_max": 1.5,
    },
}


@pytest.mark.parametrize(("name", "key"), [(n, k) for n, t in TABLES.items() for k in t])
def test_parameter_values_match_their_source(name: str, key: str) -> None:
    holder: object = SETS[name]
    for part in key.split("."):
        holder = getattr(holder, part)
    assert holder == pytest.approx(TABLES[name][key], rel=1e-8)


def test_both_sets_use_values_of_scene_and_paper() -> None:
    choices = {
        "commanded_point": ("tip", "pivot"),
        "slow_for": ("every", "straight"),
        "burrow_law": ("unit", "unit"),
        "excavate_law": ("tip_spiral", "tip_spiral"),
        "excavate_heading": ("current", "start"),
        "excavate_needs_time": (False, True),
        "force_measure": ("peak", "sum"),
        "direction_from": ("side", "cupboard_y"),
        "success_during_excavation": (True, False),
    }
    for name, (hardware, authors) in choices.items():
        assert (getattr(HARDWARE, name), getattr(AUTHORS_SIM, name)) == (hardware, authors), name


def test_simulator_motors_saturate_before_the_gate_slows_them() -> None:
    gate = AUTHORS_SIM.safety
    assert gate.force * gate.soft_fraction == pytest.approx(math.hypot(10.0, 10.0))
    assert gate.torque * gate.soft_fraction == pytest.approx(1.5)


@pytest.mark.parametrize("name", SETS)
def test_zero_is_sent_before_a_real_arm_must_stop(name: str) -> None:
    gate = SETS[name].safety
    assert gate.command_expiry < 0.1
    assert (gate.features_age, gate.arm_age, gate.features_latch) == (0.2, 0.05, 1.0)


def test_single_values_are_overridden() -> None:
    p = parameters(
        "hardware",
        {
            "burrow_amplitude": 0.5,
            "time_limit": 20,
            "force_measure": "sum",
            "safety.force": 12,
            "safety": {"disabled": ["wrench"], "tip_region": [[0, 0], [1, 0], [0, 1]]},
        },
    )
    assert (p.burrow_amplitude, p.time_limit, p.force_measure) == (0.5, 20.0, "sum")
    assert isinstance(p.time_limit, float)
    assert (p.safety.force, p.safety.torque) == (12.0, 4.5)
    assert p.safety.disabled == {Check.WRENCH}
    assert p.safety.tip_region == Region(((0, 0), (1, 0), (0, 1)))
    assert p.v_max == HARDWARE.v_max
    assert HARDWARE.burrow_amplitude == 0.83, "the set itself stays"
    assert parameters("hardware") == HARDWARE


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"burow_force": 1}, ["burow_force", "did you mean burrow_force?"]),
        ({"zzz": 1}, ["zzz", "allowed", "v_max", "safety"]),
        ({"name": "x"}, ["unknown key name"]),
        ({"safety": 3}, ["safety = 3", "a table"]),
        ({"safety": {"forse": 3}}, ["safety.forse", "did you mean force?"]),
        ({"v_max": 0}, ["v_max", "above 0 m/s", "0"]),
        ({"v_max": math.nan}, ["nan"]),
        ({"v_max": math.inf}, ["inf"]),
        ({"v_max": True}, ["true", "number"]),
        ({"v_max": "fast"}, ['"fast"', "number"]),
        ({"time_limit": 0}, ["time_limit", "above 0 s"]),
        ({"burrow_amplitude": 1.0}, ["below 1"]),
        ({"burrow_amplitude": -0.1}, ["at least 0 and below 1"]),
        ({"excavate_needs_time": 1}, ["true or false"]),
        ({"burrow_law": "other"}, ["unit", "literal", "other"]),
        ({"v_max": 0.2}, ["safety.speed", "set both"]),
        ({"omega_max": 0.2}, ["safety.turn_rate", "set both"]),
        ({"push_force_min": 8.0}, ["push_force_max", "push_force_min"]),
        ({"safety.force": -1}, ["safety.force", "above 0 N"]),
        ({"safety.command_expiry": 0.11}, ["at most 0.1 s"]),
        ({"safety.soft_fraction": 1.0}, ["below 1"]),
        ({"safety.features_age": 2.0}, ["features_latch must be at least features_age"]),
        ({"safety.arm_age": 0.01}, ["arm_age must exceed the loop's period"]),
        ({"safety.disabled": ["not_armed"]}, ["not_armed", "cannot be switched off"]),
        ({"safety.touch_hard": 5.0}, ["touch_hard must exceed touch_soft"]),
        ({"safety.disabled": ["what"]}, ['"what"', "workspace"]),
        ({"safety.disabled": "wrench"}, ["array", "workspace"]),
        ({"safety.tip_region": 3}, ["tip_region = 3", "corners [x, y]"]),
        ({"safety.tip_region": [[0, 0], [1, 0]]}, ["3 to 16 corners"]),
        ({"safety.tip_region": [[0, 0], [0, 1], [1, 0]]}, ["counter-clockwise"]),
        ({"safety.tip_region": [[0, 0], [1, "a"], [0, 1]]}, ["tip_region[1][1]", "m"]),
    ],
)
def test_unusable_values_are_refused_with_a_reason(given: dict, words: list[str]) -> None:
    with pytest.raises(ConfigError) as error:
        parameters("hardware", given)
    for word in words:
        assert word in str(error.value)


def test_region_as_a_list_of_numbers_is_refused() -> None:
    with pytest.raises(ConfigError, match="pivot_region"):
        replace(HARDWARE.safety, pivot_region=((0, 0), (1, 0), (0, 1)))  # type: ignore[arg-type]  # that is the mistake


def test_unknown_set_lists_available_sets() -> None:
    with pytest.raises(ConfigError, match="hardware, authors_sim"):
        parameters("hardwear")


@pytest.mark.parametrize("check", sorted(ALWAYS_ON))
def test_essential_checks_cannot_be_disabled(check: Check) -> None:
    with pytest.raises(ConfigError, match="cannot be switched off"):
        parameters("authors_sim", {"safety.disabled": [check.value]})


def out_of_range() -> list[tuple[str, object]]:
    cases: list[tuple[str, object]] = []
    for prefix, settings in (("", Parameters), ("safety.", SafetySettings)):
        for field in inspect.type_info(settings).fields:
            kind = field.type.type if isinstance(field.type, inspect.Metadata) else field.type
            name = prefix + field.name
            match kind:
                case inspect.FloatType(gt=None, ge=None, le=None, lt=None):
                    pytest.fail(f"{name} has no range")
                case inspect.FloatType(gt=above, ge=least, le=most, lt=below):
                    low = above if least is None else math.nextafter(least, -math.inf)
                    cases += [(name, v) for v in (math.nan, math.inf, -math.inf, low)]
                    if most is not None or below is not None:
                        cases.append((name, below if most is None else math.nextafter(most, 9)))
                case inspect.LiteralType():
                    cases.append((name, "neither"))
                case inspect.BoolType():
                    cases.append((name, "yes"))
    return cases


def test_every_setting_refuses_values_out_of_range() -> None:
    cases = out_of_range()
    assert len(cases) > 150
    for name, value in cases:
        with pytest.raises(ConfigError, match=name.rpartition(".")[2]):
            parameters("hardware", {name: value})


def test_region_membership_is_correct() -> None:
    shelf = box(-0.1, 0.4, -0.3, 0.2)
    assert shelf.depth(0.0, 0.0) == pytest.approx(0.1)
    assert shelf.depth(0.4, 0.0) == pytest.approx(0.0)
    assert shelf.depth(0.45, 0.0) == pytest.approx(-0.05)
    slanted = Region(((0, 0), (1, 0), (0, 1)))
    assert slanted.depth(0.5, 0.5) == pytest.approx(0.0)
    assert slanted.depth(1.0, 1.0) == pytest.approx(-math.sqrt(0.5))
    with pytest.raises(ConfigError, match="twice"):
        Region(((0, 0), (0, 0), (1, 1)))
    with pytest.raises(ConfigError, match="finite"):
        Region(((0, 0), (1, math.nan), (0, 1)))
    with pytest.raises(ConfigError, match="3 to 16"):
        Region(tuple((math.cos(a), math.sin(a)) for a in [k * math.tau / 17 for k in range(17)]))


@pytest.mark.parametrize("text", ["", "0.3", "a,b", "0.3,0.1,0.2", "0.3;0.1"])
def test_malformed_target_is_refused(text: str) -> None:
    with pytest.raises(ConfigError, match="not X,Y in metres"):
        parse_target(text)


def test_targets_become_goals() -> None:
    assert parse_target("0.358, -0.03") == (0.358, -0.03)
    goal = make_goal(0.358, 0.03, HARDWARE)
    assert (goal.radius, goal.time_limit) == (0.0075, 40.0)
    goal = make_goal(0.358, 0.03, AUTHORS_SIM, radius=0.002, time_limit=5.0)
    assert (goal.radius, goal.time_limit) == (0.002, 5.0)


@pytest.mark.parametrize(
    ("x", "y", "more", "words"),
    [
        (0.5, 0.0, {}, "outside the region"),
        (0.3, 0.3, {}, "outside the region"),
        (math.nan, 0.0, {}, "not finite"),
        (0.3, math.inf, {}, "not finite"),
        (0.3, 0.0, {"radius": 0.0}, "radius"),
        (0.3, 0.0, {"time_limit": 0.0}, "time limit"),
        (0.3, 0.0, {"time_limit": math.nan}, "time limit"),
        (0.3, 0.0, {"time_limit": math.inf}, "time limit"),
    ],
)
def test_unreachable_goal_is_refused(x: float, y: float, more: dict, words: str) -> None:
    make: Callable = make_goal
    with pytest.raises(ConfigError, match=words):
        make(x, y, HARDWARE, **more)


def test_what_is_switched_off_or_beyond_a_cap_is_a_caution() -> None:
    assert parameters("hardware").safety.cautions == ()
    risky = parameters("hardware", {"safety.disabled": ["arm_frozen"], "safety.force": 40.0}).safety
    assert risky.cautions == ("the check arm_frozen is off", "force is 40, beyond the cap of 30")
    assert risky.arm_limits == HARDWARE.safety.arm_limits
