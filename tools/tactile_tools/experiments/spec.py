"""What a trial is: everything its outcome depends on, as plain values that are its columns too."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any, Literal

from reachd.fields import SettingError, check_known
from reachd.strategies.parameter_fields import Parameters
from reachd.strategies.parameters import parameters

Depth = Literal["contacts", "taxels"]

DEPTHS: tuple[Depth, ...] = ("contacts", "taxels")
SETS = ("authors_sim", "hardware")
STRATEGIES = ("straight", "burrow", "excavate", "hybrid_clock", "hybrid_event")


@dataclass(frozen=True, slots=True)
class Conditions:
    """How the world and the sense of touch differ from those of the parameter set.

    ``objects``: least and greatest number of objects. ``friction_objects``: Coulomb coefficient
    of object on object (other pairs at least as much); ``friction_all``: of every pair.
    ``finger_width`` m. ``noise``: N, standard deviation added to what is felt. ``feature_rate``:
    Hz at which touch is renewed. ``dead_taxels``: fraction that reports nothing.
    """

    objects: tuple[int, int] | None = None
    friction_objects: float | None = None
    friction_all: float | None = None
    finger_width: float | None = None
    noise: float = 0.0
    feature_rate: float | None = None
    dead_taxels: float = 0.0

    def __post_init__(self) -> None:
        """Refuse values that no world has."""
        if self.objects is not None:
            low, high = self.objects
            if not 0 <= low <= high:
                raise SettingError(f"objects is {low} to {high}: least first, none below 0")
        for name, low_, high_ in (
            ("friction_objects", 0.01, 2.0),
            ("friction_all", 0.01, 2.0),
            ("finger_width", 0.02, 0.12),
            ("noise", 0.0, 100.0),
            ("feature_rate", 1.0, 100.0),
            ("dead_taxels", 0.0, 1.0),
        ):
            value = getattr(self, name)
            if value is not None and not low_ <= value <= high_:
                raise SettingError(f"{name} is {value!r}; allowed: {low_:g} to {high_:g}")

    def to_json(self) -> str:
        """Canonical text of what differs; "{}" when nothing does."""
        default = Conditions()
        return canonical(
            {k: v for k, v in asdict(self).items() if v != getattr(default, k)},
        )

    @classmethod
    def from_json(cls, text: str) -> Conditions:
        """Inverse of `to_json`; SettingError for unknown names."""
        raw = table_of(text, "conditions")
        check_known([f.name for f in fields(cls)], raw, "condition")
        if raw.get("objects") is not None:
            try:
                low, high = raw["objects"]
                raw["objects"] = (int(low), int(high))
            except (TypeError, ValueError):
                raise SettingError(
                    f"objects is {raw['objects']!r}, not the least and the greatest number"
                ) from None
        try:
            return cls(**raw)
        except TypeError as error:
            raise SettingError(f"conditions {text}: {error}") from None


@dataclass(frozen=True, slots=True)
class TrialSpec:
    """One trial. Its fields are the table's identity columns.

    ``source``: scene generator or ``recorded:FILE``. ``parameters`` and ``conditions`` are
    canonical JSON of what differs from the set ``set``.
    """

    source: str
    scene_seed: int
    set: str
    engine: str
    depth: str
    strategy: str
    trial_seed: int
    parameters: str = "{}"
    conditions: str = "{}"

    def resolved(self) -> Parameters:
        """The parameters; SettingError."""
        return parameters(self.set, table_of(self.parameters, "parameters"))

    @property
    def changed(self) -> Conditions:
        """The conditions; SettingError."""
        return Conditions.from_json(self.conditions)

    @property
    def typed_depth(self) -> Depth:
        """The depth of sensing; SettingError."""
        if self.depth not in DEPTHS:
            raise SettingError(f"unknown depth {self.depth!r}; there are: {', '.join(DEPTHS)}")
        return self.depth


IDENTITY = tuple(f.name for f in fields(TrialSpec))


def spec_of(row: Mapping[str, Any]) -> TrialSpec:
    """The trial that ``row`` is of."""
    return TrialSpec(**{name: row[name] for name in IDENTITY})


def canonical(values: Mapping[str, Any]) -> str:
    """``values`` as text: equal for equal values."""
    return json.dumps(dict(values), sort_keys=True, separators=(",", ":"))


def table_of(text: str, what: str) -> dict[str, Any]:
    """The JSON object in ``text``; SettingError."""
    try:
        raw = json.loads(text)
    except json.JSONDecodeError as error:
        raise SettingError(f"{what} {text!r} is no JSON: {error}") from None
    if not isinstance(raw, dict):
        raise SettingError(f"{what} {text!r} is no table of names and values")
    return raw
