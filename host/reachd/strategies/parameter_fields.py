"""What a reach is made of: the values of the paper's Tables I and II and the readings of its text.

The symbols in the descriptions are the paper's.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Literal

from reachd.fields import SettingError, check_fields, choice, flag, number
from reachd.gate.settings import SafetySettings


@dataclass(frozen=True, slots=True, kw_only=True)
class Parameters:
    """One named set. SI units; frequencies in rad/s, as they stand in the sine of equation (4)."""

    name: str

    v_max: float = number("m/s", "v_max, speed of every primitive")
    omega_max: float = number("rad/s", "ω_max, turn rate of straight and burrow")
    time_limit: float = number("s", "t_tot, time a reach may take")
    goal_radius: float = number("m", "distance of tip and goal that counts as success")
    success_during_excavation: bool = flag("whether success is tested during an excavation")
    tip_length: float = number("m", "L, from the pivot to the tip")

    commanded_point: Literal["tip", "pivot"] = choice(
        ("tip", "pivot"), "point that gets the velocity of equations (1) and (3)"
    )
    slow_radius: float = number("m", "distance to the goal within which a strategy slows", 0.0)
    slow_fraction: float = number("", "part of the speed left within it", 0.0, 1.0)
    slow_for: Literal["every", "straight"] = choice(
        ("every", "straight"), "which motion is slowed near the goal"
    )
    turn_tolerance: float = number("rad", "|φ − θ| within which turning tapers", 0, 1, above=False)
    straight_turn_within: float = number("rad/s", "turn rate of straight within it", above=False)
    burrow_turn_within: float = number("rad/s", "turn rate of burrow within it", above=False)

    burrow_amplitude: float = number(
        "", "A_bur, 0 straight to 1 sideways", 0.0, 1.0, above=False, below=True
    )
    burrow_frequency: float = number("rad/s", "f_bur, as it multiplies t in the sine")
    burrow_law: Literal["unit", "literal"] = choice(
        ("unit", "literal"), "whether d̂ or v_max·d̂ is added to the sine in equation (3)"
    )

    excavate_duration: float = number("s", "t_excv, time an excavation takes")
    trigger_interval: float = number("s", "t_trig, time between excavations by the clock")
    excavate_omega_max: float = number("rad/s", "ω_max of equation (7)")
    spiral_growth: float = number("", "s_excv, by how much the spiral grows", 1.0, above=False)
    excavate_law: Literal["tip_spiral", "literal"] = choice(
        ("tip_spiral", "literal"), "whether the tip traces the spiral of equation (5)"
    )
    excavate_heading: Literal["start", "current"] = choice(
        ("start", "current"), "which heading turns the spiral, R_θ"
    )
    excavate_needs_time: bool = flag("whether an excavation starts only if it can be finished")
    ccw_chance: float = number("", "chance of CCW by the clock", 0.0, 1.0, above=False)

    force_measure: Literal["peak", "sum"] = choice(
        ("peak", "sum"), "which force F_bur and F_excv are compared with"
    )
    burrow_force: float = number("N", "F_bur, force above which hybrid_event burrows")
    excavate_force: float = number("N", "F_excv, force that with a stall excavates")
    push_force_min: float = number("N", "F_push,min of a light tip contact", above=False)
    push_force_max: float = number("N", "F_push,max of a light tip contact")
    push_time: float = number("s", "t_push, light tip contact that excavates")
    push_dropout: float = number("s", "gap in a tip contact that is overlooked", above=False)
    progress_time: float = number("s", "t_prog, lag behind v_max that is a stall")
    progress_reference: Literal["excavation_start", "excavation_end"] = choice(
        ("excavation_start", "excavation_end"), "distance from which progress counts anew"
    )
    direction_from: Literal["side", "cupboard_y"] = choice(
        ("side", "cupboard_y"), "what tells left from right at the peak contact"
    )
    direction_obedience: float = number(
        "", "chance that the direction follows the contact", 0.0, 1.0, above=False
    )

    safety: SafetySettings
    note: str = ""

    def __post_init__(self) -> None:
        """Refuse values out of range and values that contradict one another."""
        check_fields(self)
        if self.push_force_max <= self.push_force_min:
            raise SettingError(
                f"push_force_max ({self.push_force_max:g} N) must exceed push_force_min "
                f"({self.push_force_min:g} N)"
            )
        if self.safety.speed < self.v_max:
            raise SettingError(
                f"v_max ({self.v_max:g} m/s) exceeds safety.speed ({self.safety.speed:g} m/s): "
                "set both"
            )
        fastest = max(self.omega_max, self.excavate_omega_max)
        if self.safety.turn_rate < fastest:
            raise SettingError(
                f"omega_max ({fastest:g} rad/s) exceeds safety.turn_rate "
                f"({self.safety.turn_rate:g} rad/s): set both"
            )

    @property
    def burrow_ratio(self) -> float:
        """A/(1 − A) of equation (4)."""
        return self.burrow_amplitude / (1.0 - self.burrow_amplitude)


def names_of(settings: type) -> tuple[str, ...]:
    """Names of all fields of a dataclass."""
    return tuple(f.name for f in fields(settings))
