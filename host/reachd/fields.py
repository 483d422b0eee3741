"""Settings as frozen dataclasses whose fields carry their own unit, range and meaning.

One description a field serves validation, overrides from a configuration file and printed help.
"""

from __future__ import annotations

import dataclasses
import difflib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeVar

if TYPE_CHECKING:
    from _typeshed import DataclassInstance


class SettingError(ValueError):
    """A setting that cannot be used: says what was given, what is allowed and what to do."""


@dataclass(frozen=True, slots=True)
class Number:
    """A finite number with its range; ``above`` excludes the lower end."""

    unit: str
    meaning: str
    low: float = 0.0
    high: float = math.inf
    above: bool = True
    below: bool = False

    @property
    def allowed(self) -> str:
        """The range in words."""
        words = f"{'more than' if self.above else 'at least'} {self.low:g}"
        if math.isfinite(self.high):
            words += f" and {'less than' if self.below else 'at most'} {self.high:g}"
        return f"a number {words}{' ' + self.unit if self.unit else ''}"

    def problem(self, value: object) -> str | None:
        """What is wrong with ``value``, or None."""
        if isinstance(value, bool) or not isinstance(value, int | float):
            return f"{value!r} is not {self.allowed}"
        inside = math.isfinite(value) and self.low <= value <= self.high
        if not inside or (self.above and value == self.low) or (self.below and value == self.high):
            return f"{value!r} is not {self.allowed}"
        return None


@dataclass(frozen=True, slots=True)
class Choice:
    """One of some words."""

    words: tuple[str, ...]
    meaning: str

    @property
    def allowed(self) -> str:
        """The words."""
        return " or ".join(repr(word) for word in self.words)

    def problem(self, value: object) -> str | None:
        """What is wrong with ``value``, or None."""
        return None if value in self.words else f"{value!r} is not {self.allowed}"


@dataclass(frozen=True, slots=True)
class Flag:
    """True or false."""

    meaning: str

    @property
    def allowed(self) -> str:
        """Both words."""
        return "true or false"

    def problem(self, value: object) -> str | None:
        """What is wrong with ``value``, or None."""
        return None if isinstance(value, bool) else f"{value!r} is not {self.allowed}"


Kind = Number | Choice | Flag


def number(
    unit: str,
    meaning: str,
    low: float = 0.0,
    high: float = math.inf,
    *,
    above: bool = True,
    below: bool = False,
) -> Any:
    """Dataclass field that holds a ``Number``."""
    return dataclasses.field(metadata={"kind": Number(unit, meaning, low, high, above, below)})


def choice(words: Sequence[str], meaning: str) -> Any:
    """Dataclass field that holds one of ``words``."""
    return dataclasses.field(metadata={"kind": Choice(tuple(words), meaning)})


def flag(meaning: str) -> Any:
    """Dataclass field that holds true or false."""
    return dataclasses.field(metadata={"kind": Flag(meaning)})


def described(settings: Any) -> dict[str, Kind]:
    """Fields of ``settings`` (an instance or its class) that carry a description."""
    return {
        f.name: f.metadata["kind"] for f in dataclasses.fields(settings) if "kind" in f.metadata
    }


def check_fields(settings: Any) -> None:
    """Raise SettingError naming the first field that is out of its range."""
    for name, kind in described(settings).items():
        problem = kind.problem(getattr(settings, name))
        if problem:
            raise SettingError(f"{name} ({kind.meaning}): {problem}")


def check_known(names: Sequence[str], given: Mapping[str, object], what: str) -> None:
    """Raise SettingError on a key of ``given`` not among ``names``, with the nearest one."""
    for key in given:
        if key not in names:
            near = difflib.get_close_matches(str(key), names, n=1)
            hint = f"did you mean {near[0]!r}?" if near else f"there are: {', '.join(names)}"
            raise SettingError(f"unknown {what} {key!r}; {hint}")


S = TypeVar("S", bound="DataclassInstance")


def plain(value: object) -> object:
    """``value`` as a float where it is a whole number: configuration files write 5 for 5.0."""
    return float(value) if isinstance(value, int) and not isinstance(value, bool) else value


def replaced(settings: S, given: Mapping[str, object]) -> S:
    """``settings`` with the values ``given`` by field name; checked anew by its own rules."""
    return dataclasses.replace(settings, **{k: plain(v) for k, v in given.items()})
