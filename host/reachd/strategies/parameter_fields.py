"""Parameters of a reach: the values of the paper's Tables I and II, and readings of its text.

The symbols in the descriptions are the paper's.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from msgspec import Meta

from reachd.gate.settings import SafetySettings
from tactile_core.config import (
    ConfigError,
    Metres,
    MetresPerSecond,
    Newtons,
    Radians,
    RadiansPerSecond,
    Seconds,
    check_fields,
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Parameters:
    """One named set. SI units; frequencies in rad/s, as they stand in the sine of equation (4)."""

    name: str

    v_max: Annotated[MetresPerSecond, Meta(gt=0, description="v_max, speed of every primitive")]
    omega_max: Annotated[
        RadiansPerSecond, Meta(gt=0, description="ω_max, turn rate of straight and burrow")
    ]
    time_limit: Annotated[Seconds, Meta(gt=0, description="t_tot, time a reach may take")]
    goal_radius: Annotated[
        Metres, Meta(gt=0, description="distance of tip and goal that counts as success")
    ]
    success_during_excavation: Annotated[
        bool, Meta(description="whether success is tested during an excavation")
    ]
    tip_length: Annotated[Metres, Meta(gt=0, description="L, from the pivot to the tip")]

    commanded_point: Annotated[
        Literal["tip", "pivot"],
        Meta(description="point that gets the velocity of equations (1) and (3)"),
    ]
    slow_radius: Annotated[
        Metres, Meta(gt=0, description="distance to the goal within which a strategy slows")
    ]
    slow_fraction: Annotated[
        float, Meta(gt=0, le=1, description="part of the speed left within it")
    ]
    slow_for: Annotated[
        Literal["every", "straight"], Meta(description="which motion is slowed near the goal")
    ]
    turn_tolerance: Annotated[
        Radians, Meta(ge=0, le=1, description="|φ − θ| within which turning tapers")
    ]
    straight_turn_within: Annotated[
        RadiansPerSecond, Meta(ge=0, description="turn rate of straight within it")
    ]
    burrow_turn_within: Annotated[
        RadiansPerSecond, Meta(ge=0, description="turn rate of burrow within it")
    ]

    burrow_amplitude: Annotated[
        float, Meta(ge=0, lt=1, description="A_bur, 0 straight to 1 sideways")
    ]
    burrow_frequency: Annotated[
        RadiansPerSecond, Meta(gt=0, description="f_bur, as it multiplies t in the sine")
    ]
    burrow_law: Annotated[
        Literal["unit", "literal"],
        Meta(description="whether d̂ or v_max·d̂ is added to the sine in equation (3)"),
    ]

    excavate_duration: Annotated[
        Seconds, Meta(gt=0, description="t_excv, time an excavation takes")
    ]
    trigger_interval: Annotated[
        Seconds, Meta(gt=0, description="t_trig, time between excavations by the clock")
    ]
    excavate_omega_max: Annotated[RadiansPerSecond, Meta(gt=0, description="ω_max of equation (7)")]
    spiral_growth: Annotated[float, Meta(ge=1, description="s_excv, by how much the spiral grows")]
    excavate_law: Annotated[
        Literal["tip_spiral", "literal"],
        Meta(description="whether the tip traces the spiral of equation (5)"),
    ]
    excavate_heading: Annotated[
        Literal["start", "current"], Meta(description="which heading turns the spiral, R_θ")
    ]
    excavate_needs_time: Annotated[
        bool, Meta(description="whether an excavation starts only if it can be finished")
    ]
    ccw_chance: Annotated[float, Meta(ge=0, le=1, description="chance of CCW by the clock")]

    force_measure: Annotated[
        Literal["peak", "sum"], Meta(description="which force F_bur and F_excv are compared with")
    ]
    burrow_force: Annotated[
        Newtons, Meta(gt=0, description="F_bur, force above which hybrid_event burrows")
    ]
    excavate_force: Annotated[
        Newtons, Meta(gt=0, description="F_excv, force that with a stall excavates")
    ]
    push_force_min: Annotated[Newtons, Meta(ge=0, description="F_push,min of a light tip contact")]
    push_force_max: Annotated[Newtons, Meta(gt=0, description="F_push,max of a light tip contact")]
    push_time: Annotated[
        Seconds, Meta(gt=0, description="t_push, light tip contact that excavates")
    ]
    push_dropout: Annotated[Seconds, Meta(ge=0, description="gap in a tip contact that is ignored")]
    progress_time: Annotated[
        Seconds, Meta(gt=0, description="t_prog, lag behind v_max that is a stall")
    ]
    progress_reference: Annotated[
        Literal["excavation_start", "excavation_end"],
        Meta(description="distance from which progress counts anew"),
    ]
    direction_from: Annotated[
        Literal["side", "cupboard_y"],
        Meta(description="what tells left from right at the peak contact"),
    ]
    direction_obedience: Annotated[
        float, Meta(ge=0, le=1, description="chance that the direction follows the contact")
    ]

    jam_time: Annotated[
        Seconds, Meta(gt=0, description="time without progress that is a jam, for quick_sweep")
    ]
    jam_progress: Annotated[
        Metres, Meta(gt=0, description="gain of distance that counts as progress, for quick_sweep")
    ]
    jam_force: Annotated[
        Newtons, Meta(gt=0, description="sum of normal forces that is a jam, for quick_sweep")
    ]
    sweep_time: Annotated[Seconds, Meta(gt=0, description="time that a sweep takes")]
    sweep_angle: Annotated[
        Radians, Meta(ge=0, le=3.1416, description="direction of a sweep off the goal's")
    ]
    sweep_omega: Annotated[
        RadiansPerSecond, Meta(ge=0, description="turn rate of a sweep, to its side")
    ]
    sweep_obedience: Annotated[
        float, Meta(ge=0, le=1, description="chance that a sweep goes away from the contact")
    ]

    learned_weights: Annotated[
        str,
        Meta(
            max_length=4096,
            description="file of the weights of `learned`; empty: those of the package",
        ),
    ] = ""

    safety: SafetySettings
    note: str = ""

    def __post_init__(self) -> None:
        """Check ranges, and values against one another; ConfigError."""
        check_fields(self)
        if self.push_force_max <= self.push_force_min:
            raise ConfigError(
                f"push_force_max ({self.push_force_max:g} N) must exceed push_force_min "
                f"({self.push_force_min:g} N)",
                ("push_force_max",),
            )
        if self.safety.speed < self.v_max:
            raise ConfigError(
                f"v_max ({self.v_max:g} m/s) exceeds safety.speed ({self.safety.speed:g} m/s): "
                "set both",
                ("v_max",),
            )
        fastest = max(self.omega_max, self.excavate_omega_max, self.sweep_omega)
        if self.safety.turn_rate < fastest:
            raise ConfigError(
                f"omega_max ({fastest:g} rad/s) exceeds safety.turn_rate "
                f"({self.safety.turn_rate:g} rad/s): set both",
                ("omega_max",),
            )

    @property
    def burrow_ratio(self) -> float:
        """A/(1 − A) of equation (4)."""
        return self.burrow_amplitude / (1.0 - self.burrow_amplitude)
