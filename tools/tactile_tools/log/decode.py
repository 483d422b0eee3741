"""Decode messages by the definitions in the log itself, so that any ROS 2 log can be read."""

from __future__ import annotations

import contextlib
import json
import math
import re
import struct
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from types import SimpleNamespace
from typing import Any

import numpy as np
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.base import TypesysError

from tactile_core.bus.messages import DecodeError
from tactile_tools.log.cdr import ARRAY, BASE, NAME, SEQUENCE, CdrError, WideDecoder
from tactile_tools.log.stream import Stream

__all__ = ["ARRAY", "BASE", "NAME", "SEQUENCE", "Decoder", "Reader", "finite", "list_text", "plain"]

TIMES = ("builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration")

MAX_DEFINITION = 1 << 20
"""Longest definition that is parsed, bytes; the largest of ROS itself, with all it needs, has 20
kB."""


@dataclass(frozen=True, slots=True)
class Reader:
    """How to decode one stream. ``fields``: definitions by type name, empty for JSON."""

    decode: Callable[[bytes], Any]
    fields: dict[str, Any]
    msgtype: str


class Decoder:
    """Decodes the messages of any stream; keeps a reader for each."""

    def __init__(self) -> None:
        self._readers: dict[Stream, Reader | str] = {}

    def reader(self, stream: Stream) -> Reader:
        """Return the reader of ``stream``; `DecodeError` says why it cannot be decoded."""
        found = self._readers.get(stream)
        if found is None:
            try:
                found = _make_reader(
                    stream.msgtype, stream.encoding, stream.schema_encoding, stream.definition,
                    stream.topic,
                )  # fmt: skip
            except DecodeError as error:
                found = str(error)
            self._readers[stream] = found
        if isinstance(found, str):
            raise DecodeError(found)
        return found

    def decode(self, stream: Stream, data: bytes) -> Any:
        """Decode ``data``.

        `DecodeError` when it is not such a message or its type is unreadable.
        """
        reader = self.reader(stream)
        try:
            return reader.decode(data)
        except (
            SerdeError, ValueError, struct.error, LookupError, OverflowError, RecursionError
        ) as error:  # fmt: skip
            if len(data) <= 4 and _is_empty(reader):
                return SimpleNamespace(**{DUMMY: 0})  # some writers send nothing
            kind = stream.msgtype or f"a {stream.encoding} message"
            raise DecodeError(f"{kind} of {len(data)} bytes: {error}") from error

    def plain(self, stream: Stream, data: bytes) -> Any:
        """Decode ``data`` to dictionaries, lists, numbers and texts."""
        message = self.decode(stream, data)
        reader = self.reader(stream)
        return plain(message, reader.fields, reader.msgtype) if reader.fields else message


SUBTYPE = re.compile(r"\b([A-Za-z]\w*)/(?:srv|action)/([A-Za-z]\w*)")
"""Types of services and actions; rosbags knows only those of messages."""

WIDE_BOUND = re.compile(r"\bwstring<=\d+")

DELIMITER = re.compile(r"^=+\s*\n(?:MSG|SRV): *(\S+)\s*$", re.MULTILINE)

PARTS = re.compile(r"^---[ \t]*$", re.MULTILINE)
"""Separates request and response in the definition of a service."""

SERVICE = re.compile(r"(.*)_(Event|Request|Response)")

EVENT_INFO = "service_msgs/msg/ServiceEventInfo"

FEW = 32
"""Messages of a type decoded field by field before code for the type is made: that takes as long as
making the code does."""

MAX_DEPTH = 32
"""Deepest nesting of types; those of ROS reach six."""

MAX_STORES = 16
"""Type stores kept for further types. Different definitions of one name need one store each."""

DUMMY = "structure_needs_at_least_one_member"
"""Field that ROS gives a message without fields."""


@lru_cache(maxsize=1024)
def _make_reader(
    msgtype: str, encoding: str, schema_encoding: str, definition: bytes, topic: str
) -> Reader:
    if encoding == "json":
        return Reader(json.loads, {}, msgtype)
    if encoding != "cdr":
        raise DecodeError(
            f"{topic} is encoded as {encoding or 'nobody says what'}: only cdr (ROS 2) and json "
            "are decoded"
        )
    if not msgtype:
        raise DecodeError(f"{topic} has no schema: its type is lost")
    if len(definition) > MAX_DEFINITION:
        raise DecodeError(f"{topic} has a definition of {len(definition)} bytes")
    if schema_encoding not in ("ros2msg", "ros2idl"):
        raise DecodeError(
            f"{topic} is defined in {schema_encoding or 'no language'}: only ros2msg and ros2idl "
            "are read"
        )
    try:
        return _typed_reader(msgtype, schema_encoding, definition)
    except DecodeError as error:
        raise DecodeError(f"the definition of {topic} {error}") from None


@lru_cache(maxsize=1024)
def _typed_reader(msgtype: str, schema_encoding: str, definition: bytes) -> Reader:
    """Make the reader of a type; `DecodeError` says what is wrong with its definition."""
    try:
        types = _types(definition.decode(), msgtype, schema_encoding)
        fields = {**get_typestore(Stores.EMPTY).fielddefs, **types}
        name = next((n for n in _names(msgtype) if n in fields), "")
        if not name:
            raise DecodeError(f"does not hold {msgtype}")
        wide = _prepare(fields)
        missing = _missing_types(name, fields)
        if EVENT_INFO in missing:
            fields[EVENT_INFO] = get_typestore(Stores.ROS2_JAZZY).fielddefs[EVENT_INFO]
            missing.remove(EVENT_INFO)
        if missing:
            raise DecodeError(f"lacks {', '.join(missing[:10])}")
        _check_depth(name, fields)
        if wide:
            return Reader(WideDecoder(fields, name), fields, name)
    except DecodeError:
        raise
    except (TypesysError, UnicodeDecodeError, KeyError, ValueError, RecursionError) as error:
        raise DecodeError(f"cannot be read: {error}") from error
    return Reader(_Decode(fields, name), fields, name)


class _Decode:
    """Decodes messages of a type: the first few field by field, then by code made for the type.

    Making the code takes some ms, and a log may have thousands of types with a message each.
    """

    def __init__(self, fields: dict[str, Any], name: str) -> None:
        self._fields = fields
        self._name = name
        self._few = WideDecoder(fields, name)
        self._count = 0
        self._store: Any = None

    def __call__(self, data: bytes) -> Any:
        """Decode ``data``; raises what rosbags raises."""
        if self._store is None:
            self._count += 1
            if self._count <= FEW:
                with contextlib.suppress(CdrError):
                    return self._few(data)
            try:
                self._store = _store_for(self._fields)
            except TypesysError as error:
                raise ValueError(str(error)) from error
        return self._store.deserialize_cdr(data, self._name)


_stores: list[tuple[Any, dict[str, Any]]] = []


def _store_for(fields: dict[str, Any]) -> Any:
    """Return a type store with these definitions, perhaps with further ones that do not conflict.

    Making code for a type takes some ms, and a log may have thousands of types that share most of
    their parts.
    """
    fit = (s for s in _stores if all(s[1].get(n, each) == each for n, each in fields.items()))
    store, known = next(fit, (None, {}))
    if store is None:
        store = get_typestore(Stores.EMPTY)
        known = dict(store.fielddefs)
        if any(known.get(name, each) != each for name, each in fields.items()):
            known = {name: each for name, each in known.items() if name not in fields}
        if len(_stores) < MAX_STORES:
            _stores.append((store, known))
    new = {name: each for name, each in fields.items() if name not in known}
    known.update(new)
    store.register(new)
    return store


def _types(text: str, msgtype: str, schema_encoding: str) -> dict[str, Any]:
    """Types of a definition by name, all in the form ``package/msg/Name``."""
    if schema_encoding == "ros2idl":
        found = {_short(name): fields for name, fields in get_types_from_idl(text).items()}
        return found | _event(_short(msgtype), found)
    text = WIDE_BOUND.sub("wstring", SUBTYPE.sub(r"\1/msg/\2", text))
    name = _short(msgtype)
    head = DELIMITER.match(text)
    if head is not None:
        text = text[head.end() :].lstrip("\n")
    first = DELIMITER.search(text)
    own, others = (text, "") if first is None else (text[: first.start()], text[first.start() :])
    service = SERVICE.fullmatch(name)
    parts = PARTS.split(own)
    if service is None or len(parts) != 2:
        return _sections(own, name, others)
    types: dict[str, Any] = {}
    for part, kind in zip(parts, ("Request", "Response"), strict=True):
        types |= _sections(part, f"{service[1]}_{kind}", others)
    return types | _event(name, types)


def _sections(own: str, name: str, others: str) -> dict[str, Any]:
    """Types of a definition and of those appended to it; each distinct section is parsed once."""
    types: dict[str, Any] = {}
    heads = list(DELIMITER.finditer(others))
    ends = [*(head.start() for head in heads[1:]), len(others)]
    for head, end in zip(heads, ends, strict=False):
        types |= _section(others[head.end() : end].strip("\n"), head[1])
    return types | _section(own, name)


@lru_cache(maxsize=4096)
def _section(text: str, name: str) -> dict[str, Any]:
    return dict(get_types_from_msg(text + "\n", name))


def _event(name: str, types: dict[str, Any]) -> dict[str, Any]:
    """The type of a service's events, which its definition does not spell out."""
    service = SERVICE.fullmatch(name)
    if service is None or service[2] != "Event" or name in types:
        return {}
    sides = [
        (kind.lower(), (SEQUENCE, ((NAME, f"{service[1]}_{kind}"), 1)))
        for kind in ("Request", "Response")
    ]
    return {name: ([], [("info", (NAME, EVENT_INFO)), *sides])}


def _prepare(types: dict[str, Any]) -> bool:
    """Complete definitions for rosbags: fill empty messages, shorten names, mark wide strings.

    Returns whether there is any wide string.
    """
    wide = False

    def fixed(kind: Any, arguments: Any) -> tuple[Any, Any]:
        nonlocal wide
        if kind in (ARRAY, SEQUENCE):
            return kind, (fixed(*arguments[0]), arguments[1])
        if kind == NAME and arguments.rpartition("/")[2] == "wstring":
            kind, arguments = BASE, ("wstring", 0)
        elif kind == NAME:
            arguments = _short(arguments)
        wide |= kind == BASE and arguments[0] == "wstring"
        return kind, arguments

    for name, (constants, fields) in list(types.items()):
        fixed_fields = [(field, fixed(*description)) for field, description in fields]
        types[name] = (constants, fixed_fields or [(DUMMY, (BASE, ("uint8", 0)))])
    return wide


def _short(msgtype: str) -> str:
    """Return ``package/srv/Name`` and the like as ``package/msg/Name``, the form used here."""
    return SUBTYPE.sub(r"\1/msg/\2", msgtype)


def _names(msgtype: str) -> tuple[str, ...]:
    """Names that a type may have: rosbags calls ``pkg/Name`` ``pkg/msg/Name``."""
    name = _short(msgtype)
    package, _, last = name.rpartition("/")
    return name, f"{package}/msg/{last}"


def _missing_types(msgtype: str, fields: dict[str, Any]) -> list[str]:
    """Types that are used and not defined."""
    missing: list[str] = []
    todo, seen = [msgtype], set()
    while todo:
        name = todo.pop()
        if name in seen:
            continue
        seen.add(name)
        if name not in fields:
            missing.append(name)
            continue
        for _, (kind, arguments) in fields[name][1]:
            if kind in (ARRAY, SEQUENCE):
                kind, arguments = arguments[0]
            if kind == NAME:
                todo.append(arguments)
    return missing


def _is_empty(reader: Reader) -> bool:
    fields = reader.fields.get(reader.msgtype)
    return fields is not None and [name for name, _ in fields[1]] == [DUMMY]


def _check_depth(msgtype: str, fields: dict[str, Any]) -> None:
    """`DecodeError` for types that contain themselves or nest too deeply."""
    depths: dict[str, int] = {}  # 0 while the parts of a type are being examined
    todo = [msgtype]
    while todo:
        name = todo[-1]
        inner = {_inner(*each) for _, each in fields[name][1]} - {""}
        if any(depths.get(each) == 0 for each in inner if each in depths):
            raise DecodeError(f"has {name} contain itself")
        waiting = [each for each in inner if each not in depths]
        if waiting:
            depths[name] = 0
            todo += waiting
            continue
        depths[name] = 1 + max((depths[each] for each in inner), default=0)
        if depths[name] > MAX_DEPTH:
            raise DecodeError(f"nests types more than {MAX_DEPTH} times")
        todo.pop()


def _inner(kind: int, arguments: Any) -> str:
    """Name of the type within a field; empty for numbers and texts."""
    if kind in (ARRAY, SEQUENCE):
        kind, arguments = arguments[0]
    return arguments if kind == NAME else ""


def plain(message: Any, fields: dict[str, Any], msgtype: str) -> Any:
    """Return a message as dictionaries, lists, numbers and texts; times as whole nanoseconds."""
    if msgtype in TIMES:
        return int(message.sec) * 1_000_000_000 + int(message.nanosec)
    return {
        name: _plain_field(getattr(message, name), fields, *description)
        for name, description in fields[msgtype][1]
    }


def _plain_field(value: Any, fields: dict[str, Any], kind: int, arguments: Any) -> Any:
    if kind == NAME:
        return plain(value, fields, arguments)
    if kind == BASE:
        return value.item() if isinstance(value, np.generic) else value
    inner, inner_arguments = arguments[0]
    if inner == NAME:
        return [plain(each, fields, inner_arguments) for each in value]
    return value.tolist() if isinstance(value, np.ndarray) else list(value)


_encode = json.JSONEncoder(ensure_ascii=False, allow_nan=False).encode


def list_text(values: list[Any]) -> str:
    """A list as JSON, with null for NaN and infinities."""
    try:
        return _encode(values)
    except ValueError:  # seldom: looking at every number first takes longer than encoding them
        return _encode(finite(values))


def finite(value: Any) -> Any:
    """Replace NaN and infinities, which JSON lacks, by None."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {key: finite(each) for key, each in value.items()}
    if isinstance(value, list):
        return [finite(each) for each in value]
    return value
