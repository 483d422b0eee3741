"""Messages: bytes as specified by CDR, and only DecodeError for garbage."""

from __future__ import annotations

import dataclasses
import struct
from contextlib import suppress
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tactile_core.bus import topics
from tactile_core.bus.messages import (
    LATER_FIELDS,
    MAX_PAYLOAD,
    MSG,
    SHORT_NAMES,
    DecodeError,
    codec,
    header,
    message_class,
    stamp,
    stamp_ns,
)


def fields(message: Any) -> Any:
    """A message as plain values, to compare arrays."""
    if dataclasses.is_dataclass(message):
        return {f.name: fields(getattr(message, f.name)) for f in dataclasses.fields(message)}
    if isinstance(message, np.ndarray):
        return message.tolist()
    return [fields(item) for item in message] if isinstance(message, list) else message


def test_field_message_bytes_follow_the_cdr_specification() -> None:
    # OMG CDR, little-endian (encapsulation 00 01 00 00): each number is aligned to its size,
    # counted from the first byte after the encapsulation; a string has its length and a closing
    # zero.
    expected = (
        b"\x00\x01\x00\x00"
        + struct.pack("<iI", 1_700_000_000, 123_456_789)  # 0: stamp
        + struct.pack("<I", 3) + b"ee\0"  # 8: frame_id, ends at 15
        + b"\0"  # to 16
        + struct.pack("<qq", 11, 12)  # 16
        + struct.pack("<I", 7)  # 32: sequence
        + struct.pack("<I", 1) + struct.pack("<H", 1)  # 36: array_taxels, ends at 42
        + b"\0\0"  # to 44
        + struct.pack("<I3f", 3, 1.0, 2.0, 3.0)  # field_ut
        + struct.pack("<If", 1, 25.5)  # temperature_c
    )  # fmt: skip
    message = MSG.TaxelField(
        header(1_700_000_000_123_456_789, "ee"), 11, 12, 7, np.array([1], np.uint16),
        np.array([1, 2, 3], np.float32), np.array([25.5], np.float32),
    )  # fmt: skip
    assert codec().encode(topics.FIELD, message) == expected


def test_every_topic_round_trips(messages: Any, payloads: Any) -> None:
    assert set(messages) == set(topics.TOPICS)
    for topic, message in messages.items():
        assert fields(codec().decode(topic, payloads[topic])) == fields(message)


def test_stamps_are_exact_nanoseconds() -> None:
    for wall_ns in (0, 1, 999_999_999, 1_700_000_000_123_456_789):
        assert stamp_ns(stamp(wall_ns)) == wall_ns


@pytest.mark.parametrize(
    "array",
    [
        np.zeros(9),  # float64
        np.zeros(9, np.int32),  # same size as float32: would decode to other values
        np.zeros((3, 3), np.float32),
        [0.0] * 9,
    ],
)
def test_array_of_wrong_dtype_is_refused(messages: Any, array: Any) -> None:
    good = messages[topics.FORCES]
    bad = type(good)(**{**good.__dict__, "force": array})
    with pytest.raises((ValueError, TypeError)):
        codec().encode(topics.FORCES, bad)


def test_message_of_another_type_is_refused(messages: Any) -> None:
    with pytest.raises(TypeError, match="expected a tactile_msgs/msg/TaxelForces"):
        codec().encode(topics.FORCES, messages[topics.FEATURES])


def test_number_out_of_range_is_refused() -> None:
    with pytest.raises((TypeError, ValueError)):
        codec().encode("builtin_interfaces/msg/Time", MSG.Time(1 << 40, 0))


def test_oversized_messages_are_refused_in_both_directions() -> None:
    chunk = MSG.RawChunk(
        header(0, "p"), 0, 0, np.zeros(0, np.uint32), np.zeros(0, np.uint8),
        np.zeros(MAX_PAYLOAD, np.uint8),
    )  # fmt: skip
    with pytest.raises(ValueError, match="65536 allowed"):
        codec().encode(topics.RAW, chunk)
    with pytest.raises(DecodeError, match="65536 allowed"):
        codec().decode(topics.RAW, bytes(MAX_PAYLOAD + 1))


def test_unknown_types_are_named() -> None:
    with pytest.raises(DecodeError, match="no message type 'a/msg/B'"):
        codec().decode("a/msg/B", b"")
    with pytest.raises(ValueError, match="no message type 'a/msg/B'"):
        message_class("a/msg/B")
    with pytest.raises(AttributeError):
        _ = MSG.NoSuchMessage


@given(st.sampled_from(sorted(SHORT_NAMES.values())), st.binary(max_size=300))
@settings(max_examples=300, deadline=None)
def test_any_bytes_decode_or_raise_decode_error(msgtype: str, data: bytes) -> None:
    for candidate in (data, b"\x00\x01\x00\x00" + data, b"\x00\x00\x00\x00" + data):
        with suppress(DecodeError):
            codec().decode(msgtype, candidate)


@given(data=st.data())
@settings(max_examples=200, deadline=None)
def test_damaged_messages_decode_or_raise_decode_error(payloads: Any, data: Any) -> None:
    topic = data.draw(st.sampled_from(topics.TOPICS))
    damaged = bytearray(payloads[topic])
    for _ in range(data.draw(st.integers(1, 4))):
        damaged[data.draw(st.integers(0, len(damaged) - 1))] = data.draw(st.integers(0, 255))
    del damaged[data.draw(st.integers(0, len(damaged))) :]
    with suppress(DecodeError):
        codec().decode(topic, bytes(damaged))


def test_schemas_are_complete_definitions_with_hashes() -> None:
    schema = codec().schema(topics.FEATURES)
    text = schema.data.decode()
    assert schema.encoding == "ros2msg"
    assert schema.type_hash.startswith("RIHS01_")
    for part in ("uint8 TIP=3", "MSG: tactile_msgs/ContactPatch", "MSG: geometry_msgs/Wrench"):
        assert part in text


def test_channel_names_map_back_to_topics() -> None:
    for topic in topics.TOPICS:
        name = "b-0" if "{name}" in topic.template else topic.template  # a shared topic
        assert topics.find_topic(topic.channel("b-0")) == (topic, name)
        assert topics.find_topic(topic.key("b-0", "replay/run1")) == (topic, name)
    assert topics.find_topic("/rosout") is None
    with pytest.raises(ValueError, match="is not a valid name"):
        topics.FEATURES.channel("a/b")


def test_newer_fields_are_at_the_end_of_their_types() -> None:
    """Fields are only added at the end, so that logs from before can be read without them."""
    for name, later in LATER_FIELDS.items():
        fields = [field for field, _ in codec().fields(name)]
        assert set(fields[-len(later) :]) == later, name
