"""Axes of a robustness map: what it varies, one thing at a time."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

from reachd.strategies.parameters import parameters
from sim_device.world.parameters import FINGER_WIDTH, world_parameters
from tactile_tools.experiments.spec import Conditions


@dataclass(frozen=True, slots=True)
class Level:
    """One value of an axis. ``nominal``: the parameter set's own value, nothing is changed."""

    label: str
    parameters: Mapping[str, Any] = field(default_factory=dict)
    conditions: Conditions = field(default_factory=Conditions)

    @property
    def nominal(self) -> bool:
        """Whether nothing differs from the set."""
        return not self.parameters and self.conditions == Conditions()


@dataclass(frozen=True, slots=True)
class Axis:
    """Something that is varied: its name in words, its levels for a set, and their unit."""

    name: str
    levels: Callable[[str], list[Level]]
    unit: str = ""

    @property
    def title(self) -> str:
        """Name and unit, as on an axis."""
        return f"{self.name}, {self.unit}" if self.unit else self.name

    def at(self, *labels: str) -> str:
        """Levels in words, such as "width of the finger 4 and 5 cm"."""
        several = " and ".join([", ".join(labels[:-1]), labels[-1]] if labels[1:] else labels)
        return f"{self.name} {several}" + (f" {self.unit}" if self.unit else "")


OBJECTS = MappingProxyType({"authors_sim": (20, 30), "hardware": (15, 22)})
"""Range of the number of objects that each generator draws from."""


def levels_of(axis: str, set_name: str) -> list[Level]:
    """Levels of ``axis`` for the parameter set ``set_name``, in rising order."""
    return AXES[axis].levels(set_name)


def _density(set_name: str) -> list[Level]:
    own = OBJECTS[set_name]
    ranges = sorted({(12, 16), (16, 20), (20, 30), (30, 34), own})
    return [
        Level(f"{a}–{b}", conditions=Conditions(objects=None if (a, b) == own else (a, b)))
        for a, b in ranges
    ]


def _friction_objects(set_name: str) -> list[Level]:
    own = world_parameters(set_name).friction.objects
    return [
        Level(f"{mu:g}", conditions=Conditions(friction_objects=None if mu == own else mu))
        for mu in sorted({0.08, own, 0.25, 0.4})
    ]


def _friction_all(set_name: str) -> list[Level]:
    del set_name
    return [
        Level("each its own"),
        *(Level(f"{mu:g}", conditions=Conditions(friction_all=mu)) for mu in (0.1, 0.2, 0.3, 0.45)),
    ]


def _force(set_name: str) -> list[Level]:
    """Levels of the arm's force limit. The gate's force limit is scaled with it, so that a gate
    limit above the motors' limit stays above it."""
    safety = parameters(set_name).safety
    levels = []
    for force in (5.0, 7.5, 10.0, 15.0):
        changed = {
            "safety.arm_f_max": force,
            "safety.force": safety.force * force / safety.arm_f_max,
        }
        levels.append(Level(f"{force:g}", {} if force == safety.arm_f_max else changed))
    return levels


def _width(set_name: str) -> list[Level]:
    del set_name
    widths = (0.04, 0.05, FINGER_WIDTH, 0.065, 0.075)
    return [
        Level(
            f"{100 * w:g}",
            conditions=Conditions(finger_width=None if w == FINGER_WIDTH else w),
        )
        for w in widths
    ]


def _time(set_name: str) -> list[Level]:
    own = parameters(set_name).time_limit
    return [
        Level(f"{own * k:g}", {} if k == 1.0 else {"time_limit": own * k})
        for k in (0.5, 0.75, 1.0, 1.5, 2.0)
    ]


def _noise(set_name: str) -> list[Level]:
    del set_name
    return [
        Level(f"{n:g}", conditions=Conditions(noise=n)) for n in (0.0, 0.05, 0.1, 0.25, 0.5, 1.0)
    ]


def _rate(set_name: str) -> list[Level]:
    del set_name
    return [
        *(
            Level(f"{rate:g}", conditions=Conditions(feature_rate=rate))
            for rate in (5.0, 10.0, 15.0, 25.0, 50.0, 100.0)
        )
    ]


def _dead(set_name: str) -> list[Level]:
    del set_name
    return [
        Level(f"{100 * d:g}", conditions=Conditions(dead_taxels=d))
        for d in (0.0, 0.05, 0.1, 0.2, 0.4)
    ]


AXES: Mapping[str, Axis] = MappingProxyType(
    {
        "density": Axis("objects in the cupboard", _density),
        "friction_objects": Axis("friction of object on object", _friction_objects),
        "friction_all": Axis("friction of every pair", _friction_all),
        "force": Axis("force limit of the arm", _force, "N"),
        "width": Axis("width of the finger", _width, "cm"),
        "time": Axis("time limit", _time, "s"),
        "noise": Axis("noise of the sensor", _noise, "N"),
        "rate": Axis("rate of the features", _rate, "Hz"),
        "dead": Axis("dead taxels", _dead, "%"),
    }
)
"""Axes by the name a user gives."""
