"""Messages by the definitions that stand in the log itself, so that any ROS 2 log is read."""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.base import TypesysError

from tactile_bus.messages import DecodeError
from tactile_tools.logs.stream import Stream

BASE, NAME, ARRAY, SEQUENCE = 1, 2, 3, 4
"""Kinds of a field in rosbags' definitions (its ``Nodetype``)."""

TIMES = ("builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration")

MAX_DEFINITION = 1 << 20
"""Bytes of a definition that is parsed: the largest of ROS's own, with all it needs, has 20 kB."""


@dataclass(frozen=True, slots=True)
class Reader:
    """How one stream is decoded. ``fields``: definitions by type name, empty for JSON."""

    decode: Callable[[bytes], Any]
    fields: dict[str, Any]
    msgtype: str


class Decoder:
    """Decodes the messages of any stream; keeps one reader a stream."""

    def __init__(self) -> None:
        self._readers: dict[Stream, Reader | str] = {}

    def reader(self, stream: Stream) -> Reader:
        """How ``stream`` is decoded; `DecodeError` says why it is not."""
        found = self._readers.get(stream)
        if found is None:
            try:
                found = _make_reader(stream)
            except DecodeError as error:
                found = str(error)
            self._readers[stream] = found
        if isinstance(found, str):
            raise DecodeError(found)
        return found

    def decode(self, stream: Stream, data: bytes) -> Any:
        """The message in ``data``; `DecodeError` when it is none or its type cannot be read."""
        reader = self.reader(stream)
        try:
            return reader.decode(data)
        except (
            SerdeError, ValueError, struct.error, LookupError, OverflowError, RecursionError
        ) as error:  # fmt: skip
            raise DecodeError(f"{stream.msgtype} of {len(data)} bytes: {error}") from error

    def plain(self, stream: Stream, data: bytes) -> Any:
        """The message as dictionaries, lists, numbers and texts."""
        message = self.decode(stream, data)
        reader = self.reader(stream)
        return plain(message, reader.fields, reader.msgtype) if reader.fields else message


@lru_cache(maxsize=256)
def _make_reader(stream: Stream) -> Reader:
    if stream.encoding == "json":
        return Reader(json.loads, {}, stream.msgtype)
    if stream.encoding != "cdr":
        raise DecodeError(
            f"{stream.topic} is encoded as {stream.encoding or 'nobody says what'}: only cdr "
            "(ROS 2) and json are decoded"
        )
    if not stream.msgtype:
        raise DecodeError(f"{stream.topic} has no schema: its type is lost")
    if len(stream.definition) > MAX_DEFINITION:
        raise DecodeError(f"{stream.topic} has a definition of {len(stream.definition)} bytes")
    parse: Callable[[str, str], Any]
    if stream.schema_encoding == "ros2msg":
        parse = get_types_from_msg
    elif stream.schema_encoding == "ros2idl":
        parse = _types_from_idl
    else:
        raise DecodeError(
            f"{stream.topic} is defined in {stream.schema_encoding or 'no language'}: only ros2msg "
            "and ros2idl are read"
        )
    try:
        types = parse(stream.definition.decode(), stream.msgtype)
        store = get_typestore(Stores.EMPTY)
        store.register(types)
        name = stream.msgtype if stream.msgtype in types else _full(stream.msgtype)
        if name not in store.fielddefs:
            raise DecodeError(f"the definition of {stream.topic} does not hold {stream.msgtype}")
        fields = dict(store.fielddefs)
        missing = _undefined(name, fields)
        if missing:
            raise DecodeError(f"the definition of {stream.topic} lacks {', '.join(missing)}")
    except (TypesysError, UnicodeDecodeError, KeyError, ValueError, RecursionError) as error:
        if isinstance(error, DecodeError):
            raise
        raise DecodeError(f"the definition of {stream.topic} cannot be read: {error}") from error
    return Reader(lambda data: store.deserialize_cdr(data, name), fields, name)


def _types_from_idl(text: str, _: str) -> Any:
    return get_types_from_idl(text)


def _full(msgtype: str) -> str:
    """``pkg/Name`` as ``pkg/msg/Name``, which is how rosbags calls it."""
    package, _, name = msgtype.rpartition("/")
    return f"{package}/msg/{name}"


def _undefined(msgtype: str, fields: dict[str, Any]) -> list[str]:
    """Types that are used and defined nowhere."""
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


def plain(message: Any, fields: dict[str, Any], msgtype: str) -> Any:
    """Dictionaries, lists, numbers and texts of a message; times as whole nanoseconds."""
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


def finite(value: Any) -> Any:
    """The same without NaN and infinities, which JSON has not: they become null."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {key: finite(each) for key, each in value.items()}
    if isinstance(value, list):
        return [finite(each) for each in value]
    return value
