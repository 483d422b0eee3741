"""Configuration layer: reads, checks and describes every TOML file of the project.

A schema is a frozen `msgspec.Struct` that forbids unknown fields. Its class variable ``replaced``
may hold remedies for keys of older versions. The types of its fields describe each key completely:
unit (`Seconds`, `Newtons`, ...), range and meaning (`msgspec.Meta`). This one description serves
three purposes:

- `load_toml` reads a file in bounded time and memory and converts it.
- Any error is one sentence that names file, line, key, value and what is allowed (`ConfigError`);
  commands print it and exit with 2.
- `describe` lists the keys for the reference in ``docs/configuration.md``.

Frozen dataclasses whose fields are annotated in the same way are checked by `check_fields` when
created, and `table_of` derives the schema of a TOML table that overrides some of their fields.
"""

from __future__ import annotations

import difflib
import math
import os
import re
import stat
import sys
import tomllib
from bisect import bisect_left
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import MISSING as NO_DEFAULT
from dataclasses import dataclass, field, fields
from enum import Enum
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, TypeVar, get_type_hints

import msgspec
from msgspec import NODEFAULT, UNSET, Meta, UnsetType
from msgspec import inspect as types

T = TypeVar("T")
KeyPath = tuple[str | int, ...]
"""Keys of tables and indices of arrays that lead to a value."""


class ConfigError(ValueError):
    """Rejected configuration or value; the message says where and why.

    ``keys``: path of the value, as far as known.
    """

    def __init__(self, message: str, keys: KeyPath = ()) -> None:
        super().__init__(message)
        self.keys = keys


# --- Types of fields: unit and range. Another Meta narrows them and explains a key. ---


def unit(name: str) -> Meta:
    """Unit of a value, for messages and the reference."""
    return Meta(extra={"unit": name})


def allowed_values(words: str) -> Meta:
    """Allowed values in words, if type and range do not express them well."""
    return Meta(extra={"allowed": words})


Seconds = Annotated[float, unit("s")]
Hertz = Annotated[float, unit("Hz")]
Metres = Annotated[float, unit("m")]
MetresPerSecond = Annotated[float, unit("m/s")]
MetresPerSecond2 = Annotated[float, unit("m/s²")]
Radians = Annotated[float, unit("rad")]
RadiansPerSecond = Annotated[float, unit("rad/s")]
RadiansPerSecond2 = Annotated[float, unit("rad/s²")]
Degrees = Annotated[float, unit("°")]
Newtons = Annotated[float, unit("N")]
NewtonMetres = Annotated[float, unit("N·m")]
Millimetres = Annotated[float, unit("mm")]
Microtesla = Annotated[float, unit("µT")]
Celsius = Annotated[float, unit("°C")]
Bytes = Annotated[int, unit("bytes")]

Positive = Annotated[float, Meta(gt=0)]
Fraction = Annotated[float, Meta(ge=0, le=1)]
Duration = Annotated[Seconds, Meta(gt=0, le=1e9)]
Rate = Annotated[Hertz, Meta(gt=0, le=1e6)]
Count = Annotated[int, Meta(gt=0)]

MinusInfinity = Annotated[
    float,
    Meta(le=sys.float_info.max, extra={"infinite": True, "allowed": "a finite number or -inf"}),
]
"""Lower bound that may be open (-inf)."""


# --- Reading a file in bounded time and memory. `tomllib` parses; the code here rejects special ---
# --- files, numbers that are too large, and endless nesting. --------------------------------------

MAX_CONFIG = 1 << 20
"""Largest configuration file in bytes: real ones have a few kB, but a wrong path may be a log of
GBs."""

MAX_DEPTH = 32
"""Deepest nesting of tables and arrays; the project's own files use five levels."""

MAX_PARTS = 256
"""Most parts of a dotted key; parsing time grows with their square."""

INTEGERS = range(-(1 << 63), 1 << 63)
"""Integer range that TOML requires; Python would accept up to 4300 digits."""

SHOWN = 60
"""Most characters of a value quoted in a message."""

TOML_LINE = re.compile(r" \(at line (\d+), column \d+\)$")
LONG_NUMBER = re.compile(r"[0-9_]{1000,}")
_PART = r"(?:[A-Za-z0-9_-]++|\"[^\"\n]*+\"|'[^'\n]*+')"
# Possessive, and tried only where a key may begin; otherwise each line is scanned again from every
# part.
DEEP_KEY = re.compile(
    rf"(?:^|[\[{{,])[ \t]*+{_PART}(?:[ \t]*+\.[ \t]*+{_PART}){{{MAX_PARTS}}}", re.MULTILINE
)

KINDS = (
    (stat.S_ISDIR, "Is a directory"),
    (stat.S_ISFIFO, "it is a pipe, not a file"),
    (lambda _: True, "it is a device, not a file"),
)
"""Descriptions of files that are not regular."""


def load_toml(path: Path | str, kind: type[T]) -> T:
    """Load ``path`` as a ``kind`` (a msgspec struct). Raises `ConfigError` for any error in it."""
    return Document.read(path).convert(kind)


def parse_toml(text: str, kind: type[T], name: str = "configuration") -> T:
    """Like `load_toml`, from text; ``name`` replaces the file name in messages."""
    return Document.parse(text, name).convert(kind)


def convert(values: Mapping[str, Any], kind: type[T]) -> T:
    """Like `load_toml`, from plain values without a file."""
    return Document(dict(values)).convert(kind)


@dataclass(frozen=True, slots=True, eq=False)
class Document:
    """Plain values of a file, with what is needed to locate errors in it.

    ``name`` and ``text``: of the file, empty for values without one. Raises `ConfigError` for what
    no schema allows: endless nesting, numbers beyond 64 bits.
    """

    data: dict[str, Any]
    name: str = ""
    text: str = field(default="", repr=False)
    not_finite: tuple[tuple[KeyPath, float], ...] = field(init=False)

    def __post_init__(self) -> None:
        """Check every value once."""
        found = []
        for keys, value in leaves(self.data):
            if len(keys) > MAX_DEPTH:
                raise ConfigError(_too_deep(self.name, None))
            if isinstance(value, int) and value not in INTEGERS:
                digits = max(20, value.bit_length() * 3 // 10)
                raise self.error(keys, f"{dotted(keys)} is {_too_long(digits)}")
            if isinstance(value, float) and not math.isfinite(value):
                found.append((keys, value))
        object.__setattr__(self, "not_finite", tuple(found))

    @classmethod
    def read(cls, path: Path | str, limit: int = MAX_CONFIG) -> Document:
        """Parse a file of at most ``limit`` bytes. Raises `ConfigError`."""
        return cls.parse(read_text(path, limit), str(path))

    @classmethod
    def parse(cls, text: str, name: str) -> Document:
        """Parse text; ``name`` replaces the file name in messages. Raises `ConfigError`."""
        return cls(_tables(text, name), name, text)

    def convert(self, kind: type[T]) -> T:
        """Convert the values to a ``kind``. Raises `ConfigError` for anything it does not allow."""
        for keys, value in self.not_finite:
            info = _type_at(types.type_info(kind), keys)
            if math.isnan(value) or not _extra(info).get("infinite"):
                raise self.wrong(keys, allowed(info))
        try:
            return msgspec.convert(self.data, kind, strict=True)
        except msgspec.ValidationError as error:
            raise self._explained(error, kind) from error

    def error(self, keys: KeyPath, problem: str) -> ConfigError:
        """Error about the value at ``keys``, with file and line in front."""
        if not self.name:
            return ConfigError(problem, keys)
        line = f":{line_of(key_lines(self.text), keys)}" if self.text else ""
        return ConfigError(f"{self.name}{line}: {problem}", keys)

    def wrong(self, keys: KeyPath, wanted: str, found: str | None = None) -> ConfigError:
        """Error about a value that is not one of ``wanted``; ``found``: the value in words."""
        given = _shown(self.value(keys)) if found is None else found
        return self.error(keys, f"{dotted(keys)} = {given}; allowed: {wanted}")

    def missing(self, keys: KeyPath, wanted: str) -> ConfigError:
        """Error about a missing key, located at its table."""
        problem = f"{dotted(keys)} is missing; it must be {wanted}"
        return self.error(keys[:-1], problem)

    def value(self, keys: KeyPath) -> Any:
        """The plain value at ``keys``."""
        found: Any = self.data
        for key in keys:
            found = found[key]
        return found

    def _explained(self, error: msgspec.ValidationError, kind: Any) -> ConfigError:
        """Translate an error of msgspec into the project's words."""
        reason, keys = self._place(error, kind)
        info = types.type_info(kind)
        if (match := MISSING.fullmatch(reason)) is not None:
            wanted = (*keys, match.group(1))
            return self.missing(wanted, allowed(_type_at(info, wanted)))
        if (match := UNKNOWN.fullmatch(reason)) is not None:
            return self._unknown((*keys, match.group(1)), _type_at(info, keys))
        if REFUSED.match(reason) is not None:
            return self.wrong(keys, allowed(_type_at(info, keys)) or reason)
        more = getattr(error.__cause__, "keys", ())  # from a check in the schema
        return self.error((*keys, *more), f"{dotted(keys)}: {reason}" if keys else reason)

    def _unknown(self, keys: KeyPath, table: Any) -> ConfigError:
        remedy = getattr(_struct(table), "replaced", {}).get(keys[-1])
        if remedy is not None:
            return self.error(keys, f"{dotted(keys)} is of an older version: {remedy}")
        known = [f.encode_name for f in _fields(table) or ()]
        near = difflib.get_close_matches(str(keys[-1])[:SHOWN], known, 1)
        hint = f" (did you mean {near[0]}?)" if near else ""
        return self.error(
            keys, f"unknown key {dotted(keys)}{hint}; allowed: {', '.join(sorted(known))}"
        )

    def _place(self, error: msgspec.ValidationError, kind: Any) -> tuple[str, KeyPath]:
        """Message of msgspec, and the path of the value."""
        text = str(error)
        match = LOCATION.search(text)
        if match is None:
            return text, ()
        keys: KeyPath = ()
        for key, index in STEP.findall(match.group(1)):
            keys = (*keys, key or (int(index) if index.isdigit() else index))
        return LOCATION.sub("", text), self._resolved(keys, kind)

    def _resolved(self, keys: KeyPath, kind: Any) -> KeyPath:
        """Replace ``...`` in ``keys`` (any key of a table of tables) by the actual key."""
        if "..." not in keys:
            return keys
        at = keys.index("...")
        for key, value in self.value(keys[:at]).items():
            try:
                msgspec.convert(_with(self.data, keys[:at], {key: value}), kind, strict=True)
            except msgspec.ValidationError:
                return self._resolved((*keys[:at], key, *keys[at + 1 :]), kind)
        return keys[:at]


LOCATION = re.compile(r" - at `\$(.*)`$")
STEP = re.compile(r"\.([^.\[\]]+)|\[(\d+|\.\.\.)\]")
MISSING = re.compile(r"Object missing required field `(.+)`")
UNKNOWN = re.compile(r"Object contains unknown field `(.+)`", re.DOTALL)
REFUSED = re.compile(r"Expected |Invalid ")


def _with(data: Any, keys: KeyPath, value: Any) -> Any:
    """Copy of ``data`` with ``value`` at ``keys``."""
    if not keys:
        return value
    copy: Any = dict(data) if isinstance(data, dict) else list(data)
    copy[keys[0]] = _with(data[keys[0]], keys[1:], value)
    return copy


def read_text(path: Path | str, limit: int) -> str:
    """Read a text file of at most ``limit`` bytes. Never blocks: pipes and devices are rejected."""
    path = Path(path)
    try:
        fd = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC | os.O_NOCTTY)
    except (OSError, ValueError) as error:  # ValueError: zero byte in the name
        why = str(error.strerror) if isinstance(error, OSError) else str(error)
        raise ConfigError(_unreadable(path, why)) from error
    mode = os.fstat(fd).st_mode
    if not stat.S_ISREG(mode):
        os.close(fd)
        raise ConfigError(_unreadable(path, next(name for test, name in KINDS if test(mode))))
    try:
        with os.fdopen(fd, "rb") as file:
            raw = file.read(limit + 1)
    except OSError as error:
        raise ConfigError(_unreadable(path, str(error.strerror))) from error
    if len(raw) > limit:
        raise ConfigError(f"{path}: over {limit} bytes, too large for a file of this kind")
    try:
        return raw.decode()
    except UnicodeDecodeError as error:
        line = raw.count(b"\n", 0, error.start) + 1
        raise ConfigError(f"{path}:{line}: not UTF-8 text; TOML must be") from error


def _tables(text: str, source: str) -> dict[str, Any]:
    deep = DEEP_KEY.search(text)
    if deep is not None:
        raise ConfigError(_too_deep(source, text.count("\n", 0, deep.start()) + 1))
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        message = str(error)
        match = TOML_LINE.search(message)
        line = match.group(1) if match else str(text.count("\n") + 1)
        shown = printable(TOML_LINE.sub("", message), 200)
        raise ConfigError(f"{source}:{line}: {shown}") from error
    except RecursionError:
        raise ConfigError(_too_deep(source, None)) from None
    except ValueError as error:  # from int(), which accepts at most 4300 digits
        number = LONG_NUMBER.search(text)
        if number is None:
            raise ConfigError(f"{source}: {printable(str(error), 200)}") from error
        line = str(text.count("\n", 0, number.start()) + 1)
        raise ConfigError(f"{source}:{line}: {_too_long(len(number.group()))}") from None


def leaves(data: Any) -> Iterator[tuple[KeyPath, Any]]:
    """Yield every value that is not a table or an array, with its path, in file order.

    Of a structure nested too deeply, only the first value too deep.
    """
    waiting: list[tuple[KeyPath, Any]] = [((), data)]
    while waiting:
        keys, value = waiting.pop()
        if len(keys) <= MAX_DEPTH and isinstance(value, dict):
            waiting += [((*keys, key), value[key]) for key in reversed(value)]
        elif len(keys) <= MAX_DEPTH and isinstance(value, list):
            waiting += [((*keys, at), value[at]) for at in reversed(range(len(value)))]
        else:
            yield keys, value


def printable(text: str, limit: int = SHOWN) -> str:
    """Prepare text for a message: shorten it and escape what a terminal would interpret."""
    if len(text) > limit:
        text = text[: limit - 3] + "..."
    return "".join(
        c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in text
    )


def _unreadable(path: Path, why: str) -> str:
    return f"{printable(str(path), 200)}: cannot be read ({why}); name a TOML file that can"


def _too_long(digits: int) -> str:
    return (
        f"a whole number of about {digits} digits; allowed: finite numbers, whole ones of at most "
        "64 bits"
    )


def _too_deep(source: str, line: int | None) -> str:
    where = source if line is None else f"{source}:{line}"
    return f"{where}: nested too deeply; allowed: {MAX_DEPTH} tables and arrays in one another"


# --- Values and types in words. -------------------------------------------------------------------


def dotted(keys: KeyPath) -> str:
    """Format a path of keys as users write it."""
    text = ""
    for key in keys:
        shown = printable(str(key))
        text += f"[{key}]" if isinstance(key, int) else f".{shown}" if text else shown
    return text


def _shown(value: Any) -> str:
    if isinstance(value, bool | float):
        return str(value).lower()
    return printable(f'"{value}"' if isinstance(value, str) else str(value))


NAMES: dict[type, str] = {
    types.StrType: "a text",
    types.BoolType: "true or false",
    types.IntType: "a whole number",
    types.FloatType: "a finite number",
    types.DictType: "a table",
    types.StructType: "a table",
    types.DataclassType: "a table",
}
LISTS = types.ListType | types.VarTupleType | types.SetType | types.FrozenSetType


def allowed(info: Any, unit: str = "") -> str:
    """Describe what a type (of `msgspec.inspect`) allows."""
    match info:
        case types.Metadata():
            own = info.extra or {}
            return str(own.get("allowed") or allowed(info.type, own.get("unit", unit)))
        case types.UnionType():
            parts = [allowed(t, unit) for t in info.types]
            return " or ".join(dict.fromkeys(part for part in parts if part))
        case types.LiteralType():
            return ", ".join(_plain(value) for value in info.values)
        case types.EnumType():
            members: list[Enum] = list(info.cls)
            return ", ".join(str(member.value) for member in members)
        case types.TupleType():
            each = [allowed(t, unit) for t in info.item_types]
            if len(set(each)) == 1:
                return f"an array of {len(each)}, each {each[0]}"
            return f"an array of {len(each)}: {', '.join(each)}"
        case _ if isinstance(info, LISTS):
            count = _bounds(info.min_length, info.max_length)
            of = f" of {count}" if count else ""
            return f"an array{of}, each element {allowed(info.item_type, unit)}"
    text = NAMES.get(type(info), "")
    if isinstance(info, types.StrType):
        text += " that is not empty" if info.min_length else ""
        text += f" that matches {info.pattern}" if info.pattern else ""
    bounds = allowed_range(info)
    if not bounds:
        return f"{text} ({unit})" if unit else text
    of = "of " if bounds.startswith("at ") else ""
    return f"{text} {of}{bounds} {unit}".rstrip()


def allowed_range(info: Any) -> str:
    """Describe the range of a number's type; empty if it has none."""
    gt, ge, lt, le = (getattr(info, name, None) for name in ("gt", "ge", "lt", "le"))
    if ge is not None and le is not None:
        return f"from {_plain(ge)} to {_plain(le)}"
    words = (("above", gt), ("at least", ge), ("below", lt), ("at most", le))
    return " and ".join(f"{word} {_plain(bound)}" for word, bound in words if bound is not None)


def _bounds(least: int | None, most: int | None) -> str:
    if least == most:
        return "" if least is None else f"{least} elements"
    if least is not None and most is not None:
        return f"{least} to {most} elements"
    return f"at most {most} elements" if least is None else f"at least {least} element(s)"


def _plain(value: object) -> str:
    if isinstance(value, int) and not isinstance(value, bool):
        return str(value)
    return f"{value:g}".replace("e+0", "e") if isinstance(value, float) else str(value)


def _extra(info: Any) -> dict[str, Any]:
    return info.extra or {} if isinstance(info, types.Metadata) else {}


def _fields(info: Any) -> tuple[types.Field, ...] | None:
    """Fields of a schema, or of the schema in a union; None if there is none."""
    if isinstance(info, types.Metadata):
        return _fields(info.type)
    if isinstance(info, types.UnionType):
        return next((found for t in info.types if (found := _fields(t)) is not None), None)
    return info.fields if isinstance(info, types.StructType | types.DataclassType) else None


def _struct(info: Any) -> Any:
    """Class of the schema, or of the schema in a union; None if there is none."""
    if isinstance(info, types.Metadata):
        return _struct(info.type)
    if isinstance(info, types.UnionType):
        return next((found for t in info.types if (found := _struct(t)) is not None), None)
    return getattr(info, "cls", None)


def _step(info: Any, key: str | int) -> Any:
    """Type of one member of a schema, table or array; None if there is none."""
    match info:
        case types.Metadata():
            return _step(info.type, key)
        case types.UnionType():
            return next((found for t in info.types if (found := _step(t, key))), None)
        case types.StructType() | types.DataclassType():
            return next((f.type for f in info.fields if f.encode_name == key), None)
        case types.DictType():
            return info.value_type
        case types.TupleType() if isinstance(key, int):
            return info.item_types[key] if key < len(info.item_types) else None
        case types.CollectionType():
            return info.item_type
    return None


def _type_at(info: Any, keys: KeyPath) -> Any:
    for key in keys:
        info = _step(info, key)
    return info


# --- Settings as frozen dataclasses, and tables that override some of them. -----------------------


@lru_cache(maxsize=64)
def _hints(kind: Any) -> dict[str, Any]:
    return get_type_hints(kind, include_extras=True)


def check_fields(settings: object) -> None:
    """Check every field of a frozen dataclass against its type, as if it came from a file.

    The `ConfigError` names the first field out of range. Meant for ``__post_init__``.
    """
    made: Any = type(settings)
    for name, kind in _hints(made).items():
        value = getattr(settings, name)
        try:
            msgspec.convert(_finite(value), kind, strict=True)
        except ValueError as error:  # includes ValidationError
            words = allowed(types.type_info(kind)) or kind.__name__
            problem = f"{name} = {_shown(value)}; allowed: {words}"
            raise ConfigError(problem, (name,)) from error


def _finite(value: Any) -> Any:
    """Convert numpy floats, which msgspec does not accept. Raises ValueError for nan and inf."""
    if isinstance(value, tuple):
        return tuple(_finite(item) for item in value)
    if not isinstance(value, float):
        return value
    if not math.isfinite(value):
        raise ValueError(value)
    return float(value)


def table_of(
    name: str,
    doc: str,
    settings: type,
    *,
    only: Iterable[str] | None = None,
    without: Iterable[str] = (),
    rename: Mapping[str, str] | None = None,
    **others: Any,
) -> type[Any]:
    """Schema of a table in which any field of a dataclass may be given and none is required.

    ``doc``: purpose of the table. ``only``, ``without``: selection of fields. ``rename``: keys by
    field. ``others``: types of fields that a file writes differently. Keys absent from the file are
    `msgspec.UNSET`; see `given`.
    """
    hints = _hints(settings)
    chosen = [key for key in (hints if only is None else only) if key not in set(without)]
    members = []
    for key in chosen:
        default = others[key]() if isinstance(others.get(key), type) else UNSET
        kind = others.get(key, hints[key])
        if key in others and hasattr(hints[key], "__metadata__"):  # keep the description
            kind = Annotated[(kind, *hints[key].__metadata__)]
        members.append((key, kind | UnsetType, default))
    return msgspec.defstruct(
        name,
        members,
        frozen=True,
        kw_only=True,
        forbid_unknown_fields=True,
        rename=dict(rename or {}),
        namespace={"__doc__": doc, "overrides": settings},
    )


def given(table: Any) -> dict[str, Any]:
    """Values given in a table made by `table_of`, by field."""
    values = ((name, getattr(table, name)) for name in table.__struct_fields__)
    return {name: value for name, value in values if value is not UNSET}


# --- Description of a schema, for the reference. -------------------------------------------------


@dataclass(frozen=True, slots=True)
class Key:
    """Description of one key of a table.

    ``default``: as written in a file; empty if there is none, None if the key is required.
    ``range``: limits beyond the ``type``; empty if there are none.
    """

    name: str
    type: str
    unit: str
    range: str
    default: str | None
    meaning: str


@dataclass(frozen=True, slots=True)
class Section:
    """Description of one table of a file.

    ``header``: empty for the top-level keys.
    """

    header: str
    meaning: str
    keys: tuple[Key, ...]


def describe(kind: type) -> list[Section]:
    """Describe every table of a schema, each after its parent."""
    return list(_sections(types.type_info(kind), "", ""))


def _sections(info: Any, path: str, header: str) -> Iterator[Section]:
    keys, inner = [], []
    for each in _fields(info) or ():
        table, plural = _table_in(each.type)
        if table is None:
            keys.append(_key(each, info.cls))
        else:
            name = f"{path}{each.encode_name}"
            inner.append((table, f"{name}.", f"[[{name}]]" if plural else f"[{name}]"))
    yield Section(header, " ".join((info.cls.__doc__ or "").split()), tuple(keys))
    for table in inner:
        yield from _sections(*table)


def _key(each: types.Field, owner: Any) -> Key:
    kind, extent = _in_words(each.type)
    meta = _meta_of(each.type)
    unit, meaning = str(meta.get("unit", "")), str(meta.get("description", ""))
    return Key(each.encode_name, kind, unit, extent, _default(each, owner), meaning)


def _meta_of(info: Any) -> dict[str, Any]:
    """Unit and description from the `Meta` of a type or of its elements."""
    match info:
        case types.Metadata():
            own = {**(info.extra_json_schema or {}), **(info.extra or {})}
            return {**_meta_of(info.type), **own}
        case types.UnionType():
            return {k: v for t in info.types for k, v in _meta_of(t).items()}
        case types.TupleType():
            return _meta_of(info.item_types[0])
        case types.CollectionType():
            return _meta_of(info.item_type)
    return {}


def _in_words(info: Any) -> tuple[str, str]:
    """Type and range, in words, of anything but a table."""
    match info:
        case types.Metadata():
            kind, extent = _in_words(info.type)
            return kind, str(_extra(info).get("allowed") or extent)
        case types.UnionType():
            return next(words for t in info.types if (words := _in_words(t))[0])
        case types.LiteralType() | types.EnumType():
            return "word", f"one of {allowed(info)}"
        case types.TupleType():
            members = {_in_words(t) for t in info.item_types}
            kind, extent = members.pop() if len(members) == 1 else ("number", "")
            return f"array of {len(info.item_types)} {kind}s", extent and f"each {extent}"
        case _ if isinstance(info, LISTS):
            kind, extent = _in_words(info.item_type)
            count = _bounds(info.min_length, info.max_length)
            parts = (count, f"each {extent}" if extent else "")
            kind = kind.replace("array of", "arrays of") if "array" in kind else f"{kind}s"
            return f"array of {kind}", ", ".join(part for part in parts if part)
        case types.StrType():
            return "text", "not empty" if info.min_length else ""
        case types.BoolType():
            return "true or false", ""
    name = {types.IntType: "whole number", types.FloatType: "number"}.get(type(info), "")
    return name, allowed_range(info)


def _table_in(info: Any) -> tuple[Any, bool]:
    """Schema of a table or of an array of tables, and whether it is an array."""
    if isinstance(info, types.Metadata):
        return _table_in(info.type)
    if isinstance(info, types.UnionType):
        found = (_table_in(t) for t in info.types)
        return next((each for each in found if each[0] is not None), (None, False))
    if isinstance(info, types.StructType):
        return info, False
    if isinstance(info, LISTS):
        inner, _ = _table_in(info.item_type)
        return inner, True
    return None, False


def _default(each: types.Field, kind: Any) -> str | None:
    if each.required:
        return None
    value = each.default
    if value is NODEFAULT and hasattr(kind, "overrides"):  # of `table_of`: UNSET stands for it
        value = {f.name: f.default for f in fields(kind.overrides)}[each.name]
    return "" if value in (None, NODEFAULT, NO_DEFAULT) else written(value)


def written(value: Any) -> str:
    """Format a plain value as TOML."""
    match value:
        case bool():
            return "true" if value else "false"
        case str():
            return quoted(str(value))
        case float():
            return _plain(value)
        case tuple() | list() | frozenset():
            return f"[{', '.join(written(item) for item in value)}]"
    return str(value)


def quoted(value: str) -> str:
    """Format a text as TOML: quoted and escaped."""
    escaped = "".join(
        f"\\u{ord(c):04x}" if c in '"\\' or ord(c) < 32 or ord(c) == 127 else c for c in value
    )
    return f'"{escaped}"'


# --- Line numbers of the keys of a TOML text, whose syntax `tomllib` has checked. ----------------

BARE = re.compile(r"[A-Za-z0-9_-]+")
SPACE = re.compile(r"(?:[ \t\r\n]|#[^\n]*)*")
SCALAR = re.compile(r"[^,\]}\s#]+(?:[ ]\d[^,\]}\s#]*)?")  # a date may have a space before its time
MULTILINE_QUOTES = ('"""', "'''")


def key_lines(text: str) -> dict[KeyPath, int]:
    """Line number (from 1) of every key, table and array element of valid TOML, by path."""
    scanner = _Scanner(text)
    scanner.run()
    return scanner.lines


def line_of(lines: dict[KeyPath, int], keys: KeyPath) -> int:
    """Line of a key, or of its nearest known parent."""
    while keys and keys not in lines:
        keys = keys[:-1]
    return lines.get(keys, 1)


class _Scanner:
    """Scans valid TOML and records the line of each key, table and array element."""

    def __init__(self, text: str) -> None:
        self.text = text
        self.at = 0
        self.lines: dict[KeyPath, int] = {}
        self.arrays: dict[KeyPath, int] = {}  # tables so far in each array of tables
        self._breaks = [match.start() for match in re.finditer("\n", text)]

    def note(self, path: KeyPath, at: int) -> None:
        self.lines.setdefault(path, bisect_left(self._breaks, at) + 1)

    def skip_space(self) -> None:
        match = SPACE.match(self.text, self.at)
        if match is not None:
            self.at = match.end()

    def looking_at(self, token: str) -> bool:
        return self.text.startswith(token, self.at)

    def string(self) -> str:
        """Skip a quoted string; returns its raw text, the key itself unless it has escapes."""
        quote = self.text[self.at]
        if self.text[self.at : self.at + 3] in MULTILINE_QUOTES:
            quote = self.text[self.at : self.at + 3]
        start = self.at + len(quote)
        end = start
        while not self.text.startswith(quote, end):
            end += 2 if quote[0] == '"' and self.text[end] == "\\" else 1
        while len(quote) == 3 and self.text[end + 3 : end + 4] == quote[0]:
            end += 1  # quotes right before the closing ones belong to the text
        self.at = end + len(quote)
        return self.text[start:end]

    def key(self) -> tuple[str, ...]:
        """Parse a key, which may be dotted."""
        parts = []
        while True:
            self.skip_space()
            match = BARE.match(self.text, self.at)
            if match is None:
                parts.append(self.string())
            else:
                parts.append(match.group())
                self.at = match.end()
            self.skip_space()
            if not self.looking_at("."):
                return tuple(parts)
            self.at += 1

    def absolute(self, key: tuple[str, ...]) -> KeyPath:
        """Full path of a table's key; in arrays of tables, that of the last table."""
        path: KeyPath = ()
        for part in key:
            path = (*path, part)
            if path in self.arrays:
                path = (*path, self.arrays[path] - 1)
        return path

    def pair(self, table: KeyPath) -> None:
        """Parse ``key = value``."""
        start = self.at
        path: KeyPath = table
        for part in self.key():
            path = (*path, part)
            self.note(path, start)
        self.at += 1  # the equals sign
        self.skip_space()
        self.value(path)

    def value(self, path: KeyPath) -> None:
        if self.looking_at("["):
            self.at += 1
            index = 0
            while True:
                self.skip_space()
                if self.looking_at(","):
                    self.at += 1
                elif self.looking_at("]"):
                    self.at += 1
                    return
                else:
                    self.note((*path, index), self.at)
                    self.value((*path, index))
                    index += 1
        elif self.looking_at("{"):
            self.at += 1
            while True:
                self.skip_space()
                if self.looking_at(","):
                    self.at += 1
                elif self.looking_at("}"):
                    self.at += 1
                    return
                else:
                    self.pair(path)
        elif self.text[self.at] in "\"'":
            self.string()
        else:
            match = SCALAR.match(self.text, self.at)
            if match is not None:
                self.at = match.end()

    def run(self) -> None:
        table: KeyPath = ()
        while True:
            self.skip_space()
            if self.at >= len(self.text):
                return
            start = self.at
            if not self.looking_at("["):
                self.pair(table)
                continue
            double = self.looking_at("[[")
            self.at += 2 if double else 1
            *parents, last = self.key()
            table = (*self.absolute(tuple(parents)), last)
            for depth in range(1, len(table) + 1):
                self.note(table[:depth], start)
            if double:
                self.arrays[table] = self.arrays.get(table, 0) + 1
                table = (*table, self.arrays[table] - 1)
                self.note(table, start)
            elif table in self.arrays:
                table = (*table, self.arrays[table] - 1)
            self.at += 2 if double else 1
