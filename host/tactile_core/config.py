"""Configuration from TOML, checked against msgspec structs.

Every error names the file, the line, what was given and what is allowed. Commands print it and
exit with 2.
"""

from __future__ import annotations

import difflib
import math
import re
from enum import Enum
from pathlib import Path
from types import GenericAlias
from typing import Annotated, Any, Literal, TypeVar, Union

import msgspec
from msgspec import Meta
from msgspec import inspect as types

from tactile_core.toml_lines import Path as KeyPath
from tactile_core.toml_lines import key_lines
from tactile_core.toml_text import (
    SHOWN,
    TomlError,
    dotted,
    leaves,
    line_of,
    parse,
    printable,
    read_text,
)

T = TypeVar("T")

Positive = Annotated[float, Meta(gt=0, description="a finite number above 0")]
Fraction = Annotated[float, Meta(ge=0, le=1, description="a number from 0 to 1")]
Duration = Annotated[float, Meta(gt=0, le=1e9, description="seconds, finite and above 0")]
FlushPeriod = Annotated[float, Meta(gt=0, le=0.5, description="seconds, above 0, at most 0.5")]
Rate = Annotated[float, Meta(gt=0, le=1e6, description="Hz, finite and above 0")]
Count = Annotated[int, Meta(gt=0, description="a whole number above 0")]
Size = Annotated[int, Meta(ge=0, description="a whole number, 0 or more")]

MAX_CONFIG = 1 << 20
"""Bytes of a configuration file: real ones have a few kB, a mistaken path may be a log of GBs."""

LOCATION = re.compile(r" - at `(key in )?\$(.*)`$")
STEP = re.compile(r"\.([^.\[\]]+)|\[(\d+|\.\.\.)\]")


class ConfigError(Exception):
    """A configuration that is refused; the message says where and why."""


def load_toml(path: Path | str, kind: type[T]) -> T:
    """Read ``path`` as a ``kind`` (a msgspec struct). `ConfigError` for anything wrong with it."""
    path = Path(path)
    try:
        return parse_toml(read_text(path, MAX_CONFIG), kind, str(path))
    except TomlError as error:
        raise ConfigError(str(error)) from error


def parse_toml(text: str, kind: type[T], name: str = "configuration") -> T:
    """Like `load_toml`, from a text; ``name`` stands for the file in messages."""
    try:
        data = parse(text, name)
    except TomlError as error:
        raise ConfigError(str(error)) from error
    lines = key_lines(text)
    for keys, value in leaves(data):
        if isinstance(value, float) and not math.isfinite(value):
            allowed = _allowed(_type_at(types.type_info(kind), keys))
            raise ConfigError(_message(name, lines, keys, value, allowed))
    unknown = _unknown(data, types.type_info(kind), ())
    if unknown is not None:
        raise ConfigError(_unknown_message(name, lines, *unknown))
    try:
        return msgspec.convert(data, kind, strict=True)
    except msgspec.ValidationError as error:
        raise ConfigError(_explain(error, name, lines, data, kind)) from error


def _explain(
    error: msgspec.ValidationError, name: str, lines: dict[KeyPath, int], data: Any, kind: Any
) -> str:
    """Our words for what msgspec found."""
    text = str(error)
    match = LOCATION.search(text)
    reason = LOCATION.sub("", text)
    keys: KeyPath = ()
    if match is not None:
        for key, index in STEP.findall(match.group(2)):
            keys = (*keys, key or (int(index) if index.isdigit() else index))
    missing = re.fullmatch(r"Object missing required field `(.+)`", reason)
    if missing is not None:
        wanted = _allowed(_type_at(types.type_info(kind), (*keys, missing.group(1))))
        where = f"{name}:{line_of(lines, keys)}"
        return f"{where}: {dotted((*keys, missing.group(1)))} is missing; it must be {wanted}"
    keys = _resolve(keys, data, kind)
    value = _value_at(data, keys)
    allowed = _allowed(_type_at(types.type_info(kind), keys))
    return _message(name, lines, keys, value, allowed or reason)


def _resolve(keys: KeyPath, data: Any, kind: Any) -> KeyPath:
    """Path of the offending value; msgspec writes ``[...]`` for any key of a table of tables."""
    if "..." not in keys:
        return keys
    at = keys.index("...")
    table = _value_at(data, keys[:at])
    for key in table if isinstance(table, dict) else range(len(table)):
        found = (*keys[:at], key)
        wanted = _python_type(_type_at(types.type_info(kind), found))
        try:
            msgspec.convert(_value_at(data, found), wanted, strict=True)
        except msgspec.ValidationError:
            return _resolve((*found, *keys[at + 1 :]), data, kind)
    return keys[:at]


def _python_type(info: Any) -> Any:
    """The type that msgspec described, for the kinds of types that TOML can fill."""
    match info:
        case types.Metadata():
            return _python_type(info.type)
        case types.StructType() | types.EnumType():
            return info.cls
        case types.LiteralType():
            return Literal[tuple(info.values)]
        case types.UnionType():
            return Union[tuple(_python_type(t) for t in info.types)]  # noqa: UP007 - made at run time
        case types.DictType():
            return GenericAlias(dict, (str, _python_type(info.value_type)))
        case types.ListType() | types.VarTupleType() | types.SetType():
            return GenericAlias(list, (_python_type(info.item_type),))
        case types.NoneType():
            return None
    base = SIMPLE.get(type(info), Any)
    limits = {name: getattr(info, name) for name in LIMITS if getattr(info, name, None) is not None}
    return Annotated[base, Meta(**limits)] if limits else base


SIMPLE: dict[type, Any] = {
    types.FloatType: float,
    types.IntType: int,
    types.StrType: str,
    types.BoolType: bool,
}
LIMITS = ("gt", "ge", "lt", "le", "multiple_of", "pattern", "min_length", "max_length")


def _message(name: str, lines: dict[KeyPath, int], keys: KeyPath, value: Any, allowed: str) -> str:
    given = str(value).lower() if isinstance(value, bool | float) else _shown(value)
    return f"{name}:{line_of(lines, keys)}: {dotted(keys)} = {given}; allowed: {allowed}"


def _shown(value: Any) -> str:
    return printable(f'"{value}"' if isinstance(value, str) else str(value))


def _value_at(data: Any, keys: KeyPath) -> Any:
    for key in keys:
        data = data[key]
    return data


def _unknown_message(
    name: str, lines: dict[KeyPath, int], keys: KeyPath, allowed: list[str]
) -> str:
    key = str(keys[-1])
    near = difflib.get_close_matches(key[:SHOWN], allowed, 1)
    hint = f" (did you mean {near[0]}?)" if near else ""
    where = f"{name}:{line_of(lines, keys)}"
    return f"{where}: unknown key {dotted(keys)}{hint}; allowed: {', '.join(sorted(allowed))}"


def _unknown(data: Any, info: types.Type | None, keys: KeyPath) -> tuple[KeyPath, list[str]] | None:
    """First key that its struct does not have, with those it has."""
    if isinstance(data, dict):
        struct = _of_kind(info, types.StructType)
        fields = {f.encode_name: f.type for f in struct.fields} if struct is not None else None
        for key, value in data.items():
            if fields is not None and key not in fields and not _of_kind(info, types.DictType):
                return (*keys, key), list(fields)
            found = _unknown(value, _step(info, key), (*keys, key))
            if found is not None:
                return found
    elif isinstance(data, list):
        for index, value in enumerate(data):
            found = _unknown(value, _step(info, index), (*keys, index))
            if found is not None:
                return found
    return None


def _of_kind(info: types.Type | None, kind: type[T]) -> T | None:
    """``info``, or the member of a union, that is of ``kind``; None when there is none."""
    if isinstance(info, types.Metadata):
        return _of_kind(info.type, kind)
    if isinstance(info, types.UnionType):
        return next((found for t in info.types if (found := _of_kind(t, kind))), None)
    return info if isinstance(info, kind) else None


def _step(info: types.Type | None, key: str | int) -> types.Type | None:
    """Type of one member of a struct, table or array."""
    struct = _of_kind(info, types.StructType)
    if struct is not None and isinstance(key, str):
        return next((f.type for f in struct.fields if f.encode_name == key), None)
    table = _of_kind(info, types.DictType)
    if table is not None and isinstance(key, str):
        return table.value_type
    fixed = _of_kind(info, types.TupleType)
    if fixed is not None and isinstance(key, int) and key < len(fixed.item_types):
        return fixed.item_types[key]
    array = _of_kind(info, types.CollectionType)
    return array.item_type if array is not None else None


def _type_at(info: types.Type | None, keys: KeyPath) -> types.Type | None:
    for key in keys:
        info = _step(info, key)
    return info


NAMES: dict[type, str] = {
    types.StrType: "a text",
    types.BoolType: "true or false",
    types.IntType: "a whole number",
    types.FloatType: "a finite number",
    types.DictType: "a table",
    types.StructType: "a table",
}
BOUNDS = {"gt": "above", "ge": "at least", "lt": "below", "le": "at most"}


def _allowed(info: Any) -> str:
    """What a type allows, in words."""
    if isinstance(info, types.Metadata):
        schema = info.extra_json_schema or {}
        return str(schema.get("description") or _allowed(info.type))
    if isinstance(info, types.UnionType):
        parts = [_allowed(t) for t in info.types if not isinstance(t, types.NoneType)]
        return " or ".join(dict.fromkeys(part for part in parts if part))
    if isinstance(info, types.LiteralType):
        return ", ".join(str(value) for value in info.values)
    if isinstance(info, types.EnumType):
        members: list[Enum] = list(info.cls)
        return ", ".join(str(member.value) for member in members)
    if isinstance(info, types.TupleType):
        inner = ", ".join(_allowed(t) for t in info.item_types)
        return f"an array of {len(info.item_types)}: {inner}"
    if isinstance(info, types.ListType | types.VarTupleType | types.SetType):
        return f"an array, each element {_allowed(info.item_type)}"
    text = NAMES.get(type(info), "")
    for bound, word in BOUNDS.items():
        limit = getattr(info, bound, None)
        if limit is not None:
            text += f" {word} {limit:g}"
    pattern = getattr(info, "pattern", None)
    return f"{text} that matches {pattern}" if pattern else text
