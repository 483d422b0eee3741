"""ROS 2 message types and their CDR bytes, without ROS.

The type store is built once, on first use (about 0.2 s), from the ROS 2 Humble definitions and
the project's own ``msg/*.msg`` files as package ``tactile_msgs``. Message classes are plain
dataclasses: ``MSG.TaxelForces(...)`` for the types the project uses, `message_class` for any.
"""

from __future__ import annotations

import struct
import threading
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib import resources
from typing import Any

import numpy as np
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.base import TypesysError

from tactile_core.bus.topics import Topic
from tactile_core.types import NS_PER_S, STAMP_END_NS

MAX_PAYLOAD = 65536
"""Largest message on the bus or in a log, in bytes (faults.md row 22). It keeps a forged length
field or a runaway sender from exhausting memory; the largest real message, RawChunk, stays below 20
kB."""

OWN_PACKAGE = "tactile_msgs"

SHORT_NAMES = {
    name.rsplit("/", 1)[1]: name
    for name in (
        "tactile_msgs/msg/AmbientField",
        "tactile_msgs/msg/ArmCommand",
        "tactile_msgs/msg/ArmState",
        "tactile_msgs/msg/ContactFeatures",
        "tactile_msgs/msg/ContactPatch",
        "tactile_msgs/msg/PortEvent",
        "tactile_msgs/msg/RawChunk",
        "tactile_msgs/msg/ReachEvent",
        "tactile_msgs/msg/ReachState",
        "tactile_msgs/msg/SkinGeometry",
        "tactile_msgs/msg/TaxelField",
        "tactile_msgs/msg/TaxelForces",
        "builtin_interfaces/msg/Time",
        "std_msgs/msg/Header",
        "geometry_msgs/msg/Point",
        "geometry_msgs/msg/Pose",
        "geometry_msgs/msg/PoseStamped",
        "geometry_msgs/msg/Quaternion",
        "geometry_msgs/msg/Transform",
        "geometry_msgs/msg/TransformStamped",
        "geometry_msgs/msg/Twist",
        "geometry_msgs/msg/TwistStamped",
        "geometry_msgs/msg/Vector3",
        "geometry_msgs/msg/Wrench",
        "geometry_msgs/msg/WrenchStamped",
        "diagnostic_msgs/msg/DiagnosticArray",
        "diagnostic_msgs/msg/DiagnosticStatus",
        "diagnostic_msgs/msg/KeyValue",
        "rcl_interfaces/msg/Log",
        "std_msgs/msg/ColorRGBA",
        "tf2_msgs/msg/TFMessage",
        "visualization_msgs/msg/Marker",
        "visualization_msgs/msg/MarkerArray",
    )
}
"""Types available as ``MSG.<name>``, by the last part of their name."""

LATER_FIELDS: Mapping[str, frozenset[str]] = {
    "tactile_msgs/msg/ArmState": frozenset({"commander", "command_sequence", "command_ns"}),
    "tactile_msgs/msg/ContactFeatures": frozenset(
        {"reason_codes", "peak_force_bound", "normal_force_bound", "tip_force_bound"}
    ),
    "tactile_msgs/msg/SkinGeometry": frozenset({"array_posed"}),
    "tactile_msgs/msg/TaxelForces": frozenset({"normal_bound"}),
}
"""Fields added since the first version of a type. Older logs lack them but can be read; users of
such a field must do without it there."""

NUMBER_TYPES = {
    "bool": np.bool_,
    "byte": np.uint8,
    "char": np.uint8,
    "float32": np.float32,
    "float64": np.float64,
    "int8": np.int8,
    "uint8": np.uint8,
    "int16": np.int16,
    "uint16": np.uint16,
    "int32": np.int32,
    "uint32": np.uint32,
    "int64": np.int64,
    "uint64": np.uint64,
}


class DecodeError(ValueError):
    """Bytes that are not a message of the expected type."""


@dataclass(frozen=True, slots=True)
class Schema:
    """Definition of a type for MCAP (encoding ``ros2msg``)."""

    name: str
    encoding: str
    data: bytes
    type_hash: str  # RIHS01, as used by rmw_zenoh and rosbag2


class Codec:
    """CDR encoder and decoder on one type store. Thread-safe."""

    def __init__(self) -> None:
        self._store = get_typestore(Stores.ROS2_HUMBLE)
        own = {}
        self._notes: dict[str, dict[str, str]] = {}
        for entry in sorted(resources.files("tactile_core.bus").joinpath("msg").iterdir(), key=str):
            stem, _, extension = entry.name.rpartition(".")
            if extension == "msg":
                name = f"{OWN_PACKAGE}/msg/{stem}"
                text = entry.read_text(encoding="utf-8")
                own.update(get_types_from_msg(text, name))
                self._notes[f"{OWN_PACKAGE}/{stem}"] = _notes(text)
        self._store.register(own)
        self._arrays: dict[str, tuple[tuple[str, np.dtype[Any]], ...]] = {}
        self._schemas: dict[str, Schema] = {}

    def message_class(self, msgtype: str) -> Any:
        """Dataclass of ``package/msg/Name``. Raises ValueError if the store has no such type."""
        try:
            return self._store.types[msgtype]
        except KeyError:
            raise ValueError(f"no message type {msgtype!r}") from None

    def encode(self, kind: Topic | str, message: Any) -> bytes:
        """Encode as CDR bytes, little-endian with encapsulation header.

        Raises ValueError or TypeError for a message that is not of that type (wrong array type or
        shape, wrong field type, more than MAX_PAYLOAD bytes); never returns bytes that would decode
        to other values.
        """
        msgtype = kind if isinstance(kind, str) else kind.msgtype
        checks = self._arrays.get(msgtype)
        if checks is None:
            checks = self._arrays[msgtype] = self._find_arrays(msgtype)
        try:
            if message.__msgtype__ != msgtype:
                raise TypeError(f"expected a {msgtype}, got a {message.__msgtype__}")
            for name, dtype in checks:
                array = getattr(message, name)
                if array.dtype != dtype or array.ndim != 1:
                    raise ValueError(
                        f"{msgtype}.{name} is {array.dtype} with {array.ndim} axes: "
                        f"it must be {dtype} with one"
                    )
            data = bytes(self._store.serialize_cdr(message, msgtype))
        except (AttributeError, struct.error, SerdeError) as error:
            raise TypeError(
                f"{type(message).__name__} is not a valid {msgtype}: {error}"
            ) from error
        if len(data) > MAX_PAYLOAD:
            raise ValueError(f"{msgtype} of {len(data)} bytes: {MAX_PAYLOAD} allowed")
        return data

    def decode(self, kind: Topic | str, data: bytes | memoryview) -> Any:
        """Decode ``data``; raises `DecodeError` and nothing else, whatever the bytes.

        Arrays of the message are read-only views of ``data``.
        """
        msgtype = kind if isinstance(kind, str) else kind.msgtype
        if msgtype not in self._store.fielddefs:
            raise DecodeError(f"no message type {msgtype!r}")
        if len(data) > MAX_PAYLOAD:
            raise DecodeError(f"{msgtype} of {len(data)} bytes: {MAX_PAYLOAD} allowed")
        try:
            return self._store.deserialize_cdr(data, msgtype)
        except (SerdeError, ValueError, struct.error, IndexError, OverflowError) as error:
            raise DecodeError(f"{msgtype} of {len(data)} bytes: {error}") from error

    def schema(self, kind: Topic | str) -> Schema:
        """Name, encoding, definition text and hash of a type.

        Raises ValueError if it is unknown.
        """
        msgtype = kind if isinstance(kind, str) else kind.msgtype
        schema = self._schemas.get(msgtype)
        if schema is None:
            try:
                text, _ = self._store.generate_msgdef(msgtype, ros_version=2)
                type_hash = self._store.hash_rihs01(msgtype)
            except TypesysError:
                raise ValueError(f"no message type {msgtype!r}") from None
            schema = Schema(msgtype, "ros2msg", self._annotate(msgtype, text).encode(), type_hash)
            self._schemas[msgtype] = schema
        return schema

    def fields(self, msgtype: str) -> tuple[tuple[str, Any], ...]:
        """Names and rosbags descriptions of a type's fields. Raises ValueError if it is unknown."""
        definition = self._store.fielddefs.get(msgtype)
        if definition is None:
            raise ValueError(f"no message type {msgtype!r}")
        return tuple(definition[1])

    def _annotate(self, msgtype: str, text: str) -> str:
        """Add the comments of our own definitions, with their units, to the fields."""
        notes = self._notes.get(msgtype.replace("/msg/", "/"), {})
        lines = []
        for line in text.splitlines():
            if line.startswith("MSG: "):
                notes = self._notes.get(line.removeprefix("MSG: ").strip(), {})
            note = notes.get(line.rpartition(" ")[2].partition("=")[0])
            lines.append(f"{line}  # {note}" if note else line)
        return "\n".join(lines) + "\n"

    def _find_arrays(self, msgtype: str) -> tuple[tuple[str, np.dtype[Any]], ...]:
        """Fields that must be numpy arrays: a wrong type of the same size would encode silently."""
        found = []
        for name, description in self.fields(msgtype):
            if description[0] in (3, 4):  # rosbags Nodetype: array, sequence
                element: Any = description[1][0]
                if element[0] == 1 and element[1][0] in NUMBER_TYPES:  # base type
                    found.append((name, np.dtype(NUMBER_TYPES[element[1][0]])))
        return tuple(found)


def _notes(definition: str) -> dict[str, str]:
    """Comments after the fields of a ``.msg`` file, by field."""
    found = {}
    for line in definition.splitlines():
        field, _, remark = line.partition("#")
        if field.strip() and remark.strip():
            found[field.split()[1].partition("=")[0]] = remark.strip()
    return found


_building = threading.Lock()


@cache
def _codec() -> Codec:
    return Codec()


def codec() -> Codec:
    """The shared codec of this process, built on the first call (about 0.2 s)."""
    with _building:  # otherwise two first calls in parallel would build two
        return _codec()


class _Messages:
    """Attribute access to the classes named in `SHORT_NAMES`."""

    def __getattr__(self, name: str) -> Any:
        """Class of ``name``, stored as an attribute so that later access is free."""
        try:
            full = SHORT_NAMES[name]
        except KeyError:
            raise AttributeError(f"no message type {name!r}") from None
        found = codec().message_class(full)
        setattr(self, name, found)
        return found


MSG = _Messages()
"""Message classes such as ``MSG.ContactFeatures``; see `SHORT_NAMES`."""


def message_class(msgtype: str) -> Any:
    """Dataclass of any type in the store, by its full name ``package/msg/Name``."""
    return codec().message_class(msgtype)


def stamp(wall_ns: int) -> Any:
    """``builtin_interfaces/Time`` of nanoseconds since the Unix epoch.

    Its seconds are an int32, and readers reject negative ones: a time before 1970 or after
    2038-01-19 becomes 0, which in ROS means no time stamp.
    """
    if not 0 <= wall_ns < STAMP_END_NS:
        return MSG.Time(0, 0)
    seconds, nanoseconds = divmod(wall_ns, NS_PER_S)
    return MSG.Time(seconds, nanoseconds)


def header(wall_ns: int, frame_id: str) -> Any:
    """``std_msgs/Header`` at a wall-clock time."""
    return MSG.Header(stamp(wall_ns), frame_id)


def stamp_ns(time: Any) -> int:
    """Nanoseconds since the Unix epoch of a ``builtin_interfaces/Time``."""
    return int(time.sec) * NS_PER_S + int(time.nanosec)


def log_message(wall_ns: int, level: int, name: str, text: str) -> Any:
    """``rcl_interfaces/Log``; ``level`` 10 debug, 20 info, 30 warning, 40 error, 50 fatal."""
    return MSG.Log(stamp(wall_ns), level, name, text, "", "", 0)


DROPS_PREFIX = "drops."
"""Prefix of diagnostic values that count losses, ``drops.<reason>``; `log info` shows them."""


def diagnostic_status(
    name: str, level: int, text: str, hardware_id: str, values: Mapping[str, object]
) -> Any:
    """``diagnostic_msgs/DiagnosticStatus``; ``level`` 0 ok, 1 warning, 2 error, 3 stale."""
    pairs = [MSG.KeyValue(key, str(value)) for key, value in values.items()]
    return MSG.DiagnosticStatus(level, name, text, hardware_id, pairs)
