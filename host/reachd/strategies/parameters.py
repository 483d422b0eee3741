"""The two named parameter sets, with the reason for every reading of the sources.

``hardware``: Tables I and II of the paper. ``authors_sim``: what the authors' published simulator
(clutter-jamming) does, its lengths converted from decimetres to metres. Where the paper says
nothing, or cannot have been run as printed, the reason for the value stands beside it.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import TYPE_CHECKING, Annotated, Any

import msgspec

from reachd.gate.settings import Check, SafetySettings
from reachd.gate.workspace import MAX_CORNERS, Region, box
from reachd.strategies.parameter_fields import Parameters
from tactile_core.config import (
    ConfigError,
    Metres,
    allowed_values,
    convert,
    given,
    table_of,
    unit,
)
from tactile_core.geometry import TIP_X

# Ages and periods are ours, the same for every arm: rows 4, 15, 16 and 24 of the fault table.
_COMMON_SAFETY: dict[str, Any] = {
    "features_age": 0.2,
    "features_latch": 1.0,
    "arm_age": 0.05,
    "arm_latch": 1.0,  # an arm that was away for so long shall not start off by itself
    "echo_age": 0.05,
    "frozen_after": 0.3,  # by then the slowest watched command has gone 0.6 mm
    "future": 0.01,  # the board clock's mapping errs by a few ms; more is a fault
    "lateness": 0.05,
    "period": 0.01,
    "command_expiry": 0.06,  # leaves 40 ms of the 100 ms until the arm rests for its braking
    "request_age": 2.0,
    "free_air_force": 1.0,
    "free_air_torque": TIP_X,  # 1 N at the tip
    "soft_fraction": 0.8,
    "overload_within": 5.0,
    "tip_length": TIP_X,
}

_HARDWARE_V, _HARDWARE_OMEGA = 0.045, 0.1
_HARDWARE_SPEED = _HARDWARE_V + TIP_X * _HARDWARE_OMEGA

HARDWARE = Parameters(
    name="hardware",
    v_max=_HARDWARE_V,
    omega_max=_HARDWARE_OMEGA,
    # Not stated. At 20 s a burrowing tip (mean forward part .385 at A = .83) cannot cross 38 cm at
    # 4.5 cm/s; at 40 s the prototype's success rates came close to the paper's.
    time_limit=40.0,
    goal_radius=0.0075,
    # "when the end-effector enters the goal region": no exception is made for an excavation.
    success_during_excavation=True,
    tip_length=TIP_X,
    # d̂ points from the tip to the target and "commanded tip velocity" is the paper's word.
    commanded_point="tip",
    # "For each strategy, the maximum velocity magnitudes are decreased when approaching the goal":
    # by how much is only in the simulator, half within 1 cm.
    slow_radius=0.01,
    slow_fraction=0.5,
    slow_for="every",
    # sign(φ − θ) chatters about zero; the simulator's taper is the only figure there is.
    turn_tolerance=0.05,
    straight_turn_within=0.01,
    burrow_turn_within=0.0,
    burrow_amplitude=0.83,
    # The simulator runs its nominal "1 Hz" as .004 π rad a step, which is sin(π t) at 250 Hz; with
    # π rad/s the prototype came close to the paper's rates. 1 and 2π rad/s are the other readings.
    burrow_frequency=math.pi,
    # As printed, a velocity is added to a number and the straight part all but vanishes (v_max is
    # .045): no burrow would arrive.
    burrow_law="unit",
    excavate_duration=5.0,
    trigger_interval=5.0,
    excavate_omega_max=_HARDWARE_OMEGA,
    spiral_growth=2.0,
    # As printed, L·ω is subtracted from a number inside K·v_max and all but vanishes. The paper
    # says that the commanded *tip* velocity grows from v_max/s to v_max, which holds when the tip
    # traces the spiral, as in the simulator.
    excavate_law="tip_spiral",
    # "according to the end-effector's current orientation"
    excavate_heading="current",
    # "at regular intervals", without exception. The interval counts from the end of the last
    # excavation as in the simulator; else 5 s every 5 s would excavate without end.
    excavate_needs_time=False,
    ccw_chance=0.5,
    # "the magnitude and location of the peak contact force" is what mattered.
    force_measure="peak",
    burrow_force=5.0,
    excavate_force=10.0,
    push_force_min=0.5,
    push_force_max=7.5,
    push_time=2.0,
    # Features come at 15 Hz: one that misses is overlooked, two are not.
    push_dropout=0.1,
    progress_time=3.0,
    # Not stated; counting anew from where the excavation ended is what "progress" means.
    progress_reference="excavation_end",
    # "on the left or right side of the end-effector … CCW or CW", without exception.
    direction_from="side",
    direction_obedience=1.0,
    # quick_sweep is not of the paper. This set's gate takes away motion towards a loaded contact,
    # and with it much of a sweep at 55°: 7 of 16 scenes were reached so, 8 at 90°, 9 at 110°. A
    # sweep that goes back leaves the contact: 48 of 56 at 140° (hybrid_event 50), and 46 at 150°;
    # 31 to 34 of 40 at 120 to 140° and 0.75 to 0.9 s (planar engine, seeds from 730000). Longer
    # sweeps after a failed one, or to the other side, gave less. No motion of this set turns faster
    # than ω_max.
    jam_time=0.3,
    jam_progress=0.0018,
    jam_force=4.5,
    sweep_time=0.75,
    sweep_angle=math.radians(140.0),
    sweep_omega=_HARDWARE_OMEGA,
    sweep_obedience=1.0,
    safety=SafetySettings(
        # The tip moves at v_max while the finger turns at ω_max: the pivot must be that much
        # faster, or every excavation would be cut short.
        speed=_HARDWARE_SPEED,
        turn_rate=_HARDWARE_OMEGA,
        acceleration=0.5,  # full speed in about 0.1 s; the paper gives none
        turn_acceleration=1.0,
        slow_radius=0.01,
        slow_fraction=0.5,
        # Table I bounds each axis; the magnitude bounds both, whatever the heading.
        force=15.0,
        torque=4.5,
        overload=1.5,
        overload_passes=30.0,  # ordinary jams: up to 27
        skin_force=20.0,
        # Slower against whatever is touched bounds impacts further (0.03: half of the reaches peak
        # below 16.5 N) and costs the time in which burrow and hybrid_clock arrive.
        touch_light=0.5,
        touch_speed=_HARDWARE_V,
        touch_soft=6.0,
        touch_hard=15.0,
        touch_lead=0.01,
        arm_v_max=_HARDWARE_SPEED,
        arm_omega_max=_HARDWARE_OMEGA,
        # On each axis: both at once are the 15 N, whatever the direction. With 15 on each the arm
        # pushes with up to 21, and goes on to while the gate holds it still.
        arm_f_max=15.0 / math.sqrt(2.0),
        arm_m_max=4.5,
        # 38 × 53 cm; the tip keeps off the walls and may come out in front to start and to reset.
        tip_region=box(-0.30, 0.378, -0.255, 0.255),
        pivot_region=box(-0.45, 0.30, -0.40, 0.40),
        **_COMMON_SAFETY,
    ),
)

_SIM_V, _SIM_OMEGA = 0.05, 0.35
_SIM_SPEED = _SIM_V + TIP_X * _SIM_OMEGA
_SIM_FORCE, _SIM_TORQUE = 10.0, 1.5  # per world axis; ±15 at a lever × 10

AUTHORS_SIM = Parameters(
    name="authors_sim",
    v_max=_SIM_V,
    omega_max=_SIM_OMEGA,
    time_limit=20.0,
    goal_radius=0.001,
    success_during_excavation=False,
    tip_length=TIP_X,
    commanded_point="pivot",
    slow_radius=0.01,
    slow_fraction=0.5,
    slow_for="straight",
    turn_tolerance=0.05,
    straight_turn_within=0.01,
    burrow_turn_within=0.0,
    burrow_amplitude=2.0 / 3.0,  # its ratio A/(1 − A) is 2.0
    burrow_frequency=0.004 * math.pi * 240.0,  # rad a step × steps a second: 3.02 rad/s
    burrow_law="unit",
    excavate_duration=5.0,
    trigger_interval=5.0,
    # Its .5 is divided by s_excv once more than equation (7) does.
    excavate_omega_max=0.25,
    spiral_growth=2.0,
    excavate_law="tip_spiral",
    excavate_heading="start",
    # With 5 s, 5 s and 20 s exactly one excavation a trial.
    excavate_needs_time=True,
    ccw_chance=0.5,
    force_measure="sum",
    burrow_force=1.5,
    excavate_force=7.5,
    push_force_min=0.05,
    push_force_max=5.0,
    push_time=500 / 240,
    push_dropout=6 / 240,
    progress_time=750 / 240,
    # Its distance is not updated while it excavates, so the next stall counts from before.
    progress_reference="excavation_start",
    direction_from="cupboard_y",
    direction_obedience=0.75,
    # quick_sweep is not of the paper; its parts are compared in docs/results/quick_sweep.json. A
    # free finger gains 1.8 mm in 0.04 s, so 0.3 s without them is a jam; a later answer leaves time
    # for fewer tries.
    jam_time=0.3,
    jam_progress=0.0018,
    # Below it objects are still being pushed aside; the arm's own limit is 10 N on each axis.
    jam_force=4.5,
    # 3 cm at v_max, about half the width of an object; a longer sweep leaves time for fewer tries.
    sweep_time=0.6,
    # In 1000 scenes of the planar engine (seeds from 740000) 80 % arrive at 55°, 84 at 75°, 85 at
    # 80°, 86 at 90° and 100°, 84 at 110°.
    sweep_angle=math.radians(90.0),
    sweep_omega=0.2,
    # The side away from the contact is the better one; that of the authors' excavations, 0.75, is
    # their simulator's.
    sweep_obedience=1.0,
    safety=SafetySettings(
        speed=_SIM_SPEED,
        turn_rate=_SIM_OMEGA,
        # No harder than its motors could drive its arm: 10 N on 1 kg, 15 on .237.
        acceleration=10.0,
        turn_acceleration=15.0 / 0.237,
        slow_radius=0.01,
        slow_fraction=0.5,
        # Its motors end at ±10 N an axis and keep pushing there. The gate stands above them, so
        # that it slows nothing before both axes are at their limit.
        force=_SIM_FORCE * math.sqrt(2.0) / 0.8,
        torque=_SIM_TORQUE / 0.8,
        # Impacts of what is ten times as hard to accelerate: up to 2.3 times the gate's limit, and
        # 64 N on the skin, in 300 trials.
        overload=4.0,
        overload_passes=30.0,
        skin_force=120.0,
        touch_light=0.5,
        touch_speed=_SIM_V,
        touch_soft=6.0,
        touch_hard=15.0,
        touch_lead=0.01,
        arm_v_max=_SIM_SPEED,
        arm_omega_max=_SIM_OMEGA,
        arm_f_max=_SIM_FORCE,
        arm_m_max=_SIM_TORQUE,
        # 37.5 × 55 cm. Its cupboard's walls alone bound its arm: the regions lie just outside.
        tip_region=box(-0.35, 0.40, -0.30, 0.30),
        pivot_region=box(-0.50, 0.40, -0.45, 0.45),
        # Only its straight line is slowed, and by the strategy: burrow arrives at full speed.
        disabled=frozenset({Check.SLOW_DOWN, Check.OVERLOAD_REPEATED, Check.TOUCH_RISING}),
        **_COMMON_SAFETY,
    ),
)

AUTHORS_SIM = replace(
    AUTHORS_SIM,
    note=(
        f"the arm's own limit is {_SIM_FORCE:g} N on each axis, confirmed by it; the gate's is "
        f"{AUTHORS_SIM.safety.force:.1f} N in any direction, above both at once, and impacts go "
        "beyond it for some ms: peaks of 25 N are not a fault of this set"
    ),
)

SETS: Mapping[str, Parameters] = MappingProxyType({s.name: s for s in (HARDWARE, AUTHORS_SIM)})
"""The parameter sets by name."""

Corners = Annotated[
    tuple[tuple[Metres, Metres], ...],
    unit("m"),
    allowed_values(f"3 to {MAX_CORNERS} corners [x, y] of a convex region, counter-clockwise"),
]
if TYPE_CHECKING:

    class GateTable(msgspec.Struct, frozen=True):
        """``[parameters.safety]``: limits of the gate that differ from the set's."""

    class ParameterTable(msgspec.Struct, frozen=True):
        """``[parameters]``: values that differ from the set's."""

        safety: GateTable = GateTable()
else:
    GateTable = table_of(
        "GateTable",
        "``[parameters.safety]``: limits of the gate that differ from the set's; see safety.md.",
        SafetySettings,
        tip_region=Corners,
        pivot_region=Corners,
    )
    ParameterTable = table_of(
        "ParameterTable",
        "``[parameters]``: values that differ from the set's; the symbols are the paper's.",
        Parameters,
        without=("name", "note"),
        safety=GateTable,
    )


def parameters(
    name: str, overrides: Mapping[str, object] | ParameterTable | None = None
) -> Parameters:
    """Parameter set ``name`` with single values overridden.

    ``overrides``: what a file said, or a mapping of field names, those of the gate as
    ``safety.force`` or in a mapping under ``safety``; regions are corners [x, y] in m,
    ``safety.disabled`` reason codes. `ConfigError` for an unknown set or key and for a value out
    of its range.
    """
    if name not in SETS:
        raise ConfigError(f"unknown parameter set {name!r}; available: {', '.join(SETS)}")
    chosen = SETS[name]
    if not isinstance(overrides, ParameterTable):
        overrides = convert(_nested(overrides or {}), ParameterTable)
    own = given(overrides)
    gate = given(own.pop("safety"))
    try:
        for key in {"tip_region", "pivot_region"} & set(gate):
            gate[key] = _region(key, gate[key])
        safety = replace(chosen.safety, **gate)
    except ConfigError as error:
        raise ConfigError(f"safety.{error}", ("safety", *error.keys)) from error
    return replace(chosen, safety=safety, **own)


def _nested(overrides: Mapping[str, object]) -> dict[str, object]:
    """Move keys such as ``safety.force`` into a table under ``safety``."""
    nested: dict[str, object] = {}
    gate: dict[str, object] = {}
    for key, value in overrides.items():
        if key == "safety" and isinstance(value, Mapping):
            gate |= value
        elif key.startswith("safety."):
            gate[key.removeprefix("safety.")] = value
        else:
            nested[key] = value
    return {"safety": gate, **nested} if gate else nested


def _region(key: str, corners: Iterable[tuple[float, float]]) -> Region:
    try:
        return Region(tuple(corners))
    except ConfigError as error:
        raise ConfigError(f"{key}: {error}", (key,)) from error
