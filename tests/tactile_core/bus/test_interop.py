"""Logs read by third-party readers."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import mcap_ros2.decoder
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from tactile_core.bus import topics
from tactile_core.bus.messages import codec

WALL_NS = 1_700_000_000_000_000_000


@pytest.fixture
def path(tmp_path: Path, record: Any, payloads: Any) -> Path:
    """A finished log with three messages of every topic."""
    path = tmp_path / "log.mcap"
    recorder = record(path)
    recorder.attach("b0.cal.toml", "application/toml", b"version = 1\n")
    recorder.metadata("board:b0", {"serial_number": "0011"})
    for i in range(3):
        for topic, data in payloads.items():
            recorder.write(topic, "b0", data, WALL_NS + i, WALL_NS + 2 * i)
    assert recorder.close(60)
    return path


def plain(message: Any) -> Any:
    """Convert a decoded message of any library to plain values."""
    if dataclasses.is_dataclass(message):
        # rosbags also turns a type's constants and name into fields.
        names = [
            f.name for f in dataclasses.fields(message) if f.name.islower() and f.name[0] != "_"
        ]
        return {name: plain(getattr(message, name)) for name in names}
    if hasattr(message, "__slots__"):
        return {name: plain(getattr(message, name)) for name in message.__slots__}
    if isinstance(message, np.ndarray):
        return message.tolist()
    if isinstance(message, bytes | bytearray):
        return list(message)
    if isinstance(message, list | tuple):
        return [plain(item) for item in message]
    return message


def test_mcap_library_reads_and_decodes_every_message(path: Path, messages: Any) -> None:
    with path.open("rb") as file:
        factories = [mcap_ros2.decoder.DecoderFactory()]
        reader = make_reader(file, validate_crcs=True, decoder_factories=factories)
        assert reader.get_header().profile == "ros2"
        seen = {}
        for schema, channel, message, decoded in reader.iter_decoded_messages():
            assert schema is not None
            seen.setdefault(channel.topic, []).append((schema.name, message, plain(decoded)))
        attached = {a.name: a.data for a in reader.iter_attachments()}
        tables = {m.name: m.metadata for m in reader.iter_metadata()}
    assert attached == {"b0.cal.toml": b"version = 1\n"}
    assert tables["board:b0"] == {"serial_number": "0011"}
    assert tables["software"]["name"] == "tactile-reach"
    assert set(seen) == {topic.channel("b0") for topic in messages}
    for topic, sent in messages.items():
        rows = seen[topic.channel("b0")]
        assert [row[0] for row in rows] == [topic.msgtype] * 3
        assert [row[1].sequence for row in rows] == [0, 1, 2]
        assert [row[1].log_time - WALL_NS for row in rows] == [0, 1, 2]
        assert [row[1].publish_time - WALL_NS for row in rows] == [0, 2, 4]
        assert rows[0][2] == plain(sent)


def test_summary_matches_the_data(path: Path, messages: Any) -> None:
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
        assert summary is not None
        statistics = summary.statistics
        assert statistics is not None
        assert statistics.message_count == 3 * len(messages)
        assert set(statistics.channel_message_counts.values()) == {3}
        assert statistics.attachment_count == 1
        assert statistics.message_start_time == WALL_NS
        assert statistics.message_end_time == WALL_NS + 2
        # Indexed reading uses only the chunks and offsets named in the summary.
        topic = topics.FORCES.channel("b0")
        rows = list(make_reader(file).iter_messages(topics=[topic], log_time_order=True))
        assert [message.log_time for _, _, message in rows] == [WALL_NS + i for i in range(3)]
    with path.open("rb") as file:
        kinds = [type(r).__name__ for r in StreamReader(file, validate_crcs=True).records]
    assert kinds[-1] == "Footer"


def test_rosbags_reads_log_as_a_ros2_bag(path: Path, messages: Any) -> None:
    """Like `ros2 bag reindex`: a metadata.yaml beside the file, with definitions from it."""
    rows = "".join(
        f"""
    - topic_metadata:
        name: {topic.channel("b0")}
        type: {topic.msgtype}
        serialization_format: cdr
        offered_qos_profiles: ""
      message_count: 3"""
        for topic in messages
    )
    (path.parent / "metadata.yaml").write_text(f"""
rosbag2_bagfile_information:
  version: 5
  storage_identifier: mcap
  relative_file_paths: [{path.name}]
  duration: {{nanoseconds: 2}}
  starting_time: {{nanoseconds_since_epoch: {WALL_NS}}}
  message_count: {3 * len(messages)}
  compression_format: ""
  compression_mode: ""
  topics_with_message_count:{rows}
""")
    with Reader(path.parent) as reader:
        store = get_typestore(Stores.ROS2_HUMBLE)
        for connection in reader.connections:
            if connection.msgtype.startswith("tactile_msgs"):
                types = get_types_from_msg(connection.msgdef.data, connection.msgtype)
                store.register({k: v for k, v in types.items() if k not in store.fielddefs})
        counts: dict[str, int] = {}
        for connection, _, data in reader.messages():
            decoded = store.deserialize_cdr(data, connection.msgtype)
            topic = next(t for t in messages if t.channel("b0") == connection.topic)
            assert plain(decoded) == plain(messages[topic])
            counts[connection.topic] = counts.get(connection.topic, 0) + 1
            assert store.hash_rihs01(connection.msgtype) == codec().schema(topic).type_hash
    assert counts == {topic.channel("b0"): 3 for topic in messages}
