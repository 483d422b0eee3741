"""Specification of a trial: everything its outcome depends on, as values that are its columns."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from typing import Annotated, Any, Literal

from msgspec import Meta

from reachd.strategies.parameter_fields import Parameters
from reachd.strategies.parameters import parameters
from tactile_core.config import (
    ConfigError,
    Fraction,
    Hertz,
    Metres,
    Newtons,
    check_fields,
    convert,
    given,
    table_of,
)

Coefficient = Annotated[float, Meta(ge=0.01, le=2)]
Depth = Literal["contacts", "taxels"]

DEPTHS: tuple[Depth, ...] = ("contacts", "taxels")
SETS = ("authors_sim", "hardware")
STRATEGIES = ("straight", "burrow", "excavate", "hybrid_clock", "hybrid_event")


@dataclass(frozen=True, slots=True)
class Conditions:
    """How the world and the sense of touch differ from those of the parameter set.

    None: as the set says.
    """

    objects: Annotated[
        tuple[int, int] | None, Meta(description="least and greatest number of objects")
    ] = None
    friction_objects: Annotated[
        Coefficient | None,
        Meta(description="Coulomb coefficient of object on object; other pairs at least as much"),
    ] = None
    friction_all: Annotated[
        Coefficient | None, Meta(description="Coulomb coefficient of every pair")
    ] = None
    finger_width: Annotated[
        Annotated[Metres, Meta(ge=0.02, le=0.12)] | None, Meta(description="width of the finger")
    ] = None
    noise: Annotated[
        Newtons,
        Meta(ge=0, le=100, description="standard deviation added to what is felt"),
    ] = 0.0
    feature_rate: Annotated[
        Annotated[Hertz, Meta(ge=1, le=100)] | None, Meta(description="how often touch is renewed")
    ] = None
    dead_taxels: Annotated[
        Fraction, Meta(description="part of the taxels that reports nothing")
    ] = 0.0

    def __post_init__(self) -> None:
        """Check that a world can have these values; ConfigError."""
        check_fields(self)
        if self.objects is not None:
            low, high = self.objects
            if not 0 <= low <= high:
                problem = f"objects is {low} to {high}: least first, none below 0"
                raise ConfigError(problem, ("objects",))

    def to_json(self) -> str:
        """Canonical text of what differs; "{}" if nothing does."""
        default = Conditions()
        return canonical(
            {k: v for k, v in asdict(self).items() if v != getattr(default, k)},
        )

    @classmethod
    def from_json(cls, text: str) -> Conditions:
        """Inverse of `to_json`; `ConfigError` for unknown names and values out of range."""
        return cls(**given(convert(_table(text, "conditions"), _ConditionsTable)))


_ConditionsTable = table_of("ConditionsTable", "What differs from the set.", Conditions)


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
        """Parameters of the trial; ConfigError."""
        return parameters(self.set, _table(self.parameters, "parameters"))

    @property
    def changed(self) -> Conditions:
        """Conditions of the trial; ConfigError."""
        return Conditions.from_json(self.conditions)

    @property
    def typed_depth(self) -> Depth:
        """Depth of sensing; ConfigError."""
        if self.depth not in DEPTHS:
            raise ConfigError(f"unknown depth {self.depth!r}; available: {', '.join(DEPTHS)}")
        return self.depth


IDENTITY = tuple(f.name for f in fields(TrialSpec))


def spec_of(row: Mapping[str, Any]) -> TrialSpec:
    """Specification of the trial in ``row``."""
    return TrialSpec(**{name: row[name] for name in IDENTITY})


def canonical(values: Mapping[str, Any]) -> str:
    """``values`` as text: equal for equal values."""
    return json.dumps(dict(values), sort_keys=True, separators=(",", ":"))


def _table(text: str, what: str) -> dict[str, Any]:
    """JSON object in ``text``; ConfigError."""
    try:
        raw = json.loads(text)
    except json.JSONDecodeError as error:
        raise ConfigError(f"{what} {text!r} is not JSON: {error}") from None
    if not isinstance(raw, dict):
        raise ConfigError(f"{what} {text!r} is not a table of names and values")
    return raw
