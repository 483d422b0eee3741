"""Logs of other recorders through every tool: losses are reported, output is harmless."""

from __future__ import annotations

import csv
import json
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet
import pytest
from mcap.writer import CompressionType, IndexType, Writer

from tactile_core.bus import topics
from tactile_core.log.info import info
from tactile_core.log.reader import read_messages
from tactile_core.log.recorder import Recorder, RecorderSettings

BASE_NS = 1_700_000_000_000_000_000
FLOAT = "std_msgs/msg/Float64"
CDR = b"\x00\x01\x00\x00"
LATCHED = "- history: 1\n  depth: 1\n  reliability: 1\n  durability: 1\n"

Row = tuple[int, int, int, float]  # channel, sequence, log time, value


def write(
    path: Path, rows: Sequence[Row], names: Sequence[str] = ("/a",), *, qos: str = "", **how: Any
) -> Path:
    """Write a log of numbers. ``qos``: of all channels; ``how``: options of the format's writer."""
    with path.open("wb") as file:
        writer = Writer(file, **how)
        writer.start(profile="ros2", library="another recorder")
        schema = writer.register_schema(FLOAT, "ros2msg", b"float64 data\n")
        metadata = {"offered_qos_profiles": qos}
        channels = [writer.register_channel(name, "cdr", schema, metadata) for name in names]
        for channel, sequence, at, value in rows:
            data = CDR + struct.pack("<d", value)
            writer.add_message(channels[channel], at, data, at, sequence)
        writer.finish()
    return path


def steady(count: int, start: int = BASE_NS, sequence: int | None = None) -> list[Row]:
    """``count`` messages at 10 Hz, numbered, or all with ``sequence``."""
    return [
        (0, k if sequence is None else sequence, start + k * 10**8, float(k)) for k in range(count)
    ]


# Numbers


def test_unnumbered_messages_are_not_counted_as_lost(
    log_tool: Any, tmp_path: Path, counts: Any
) -> None:
    path = write(tmp_path / "x.mcap", steady(100, sequence=0))
    assert log_tool("split", path, "--every", "3").code == 0
    parts = tmp_path / "x_split"
    found = json.loads(log_tool("info", parts, "--json").out)
    assert (found["files"], found["messages"]) == (4, 100)
    assert found["channels"][0]["missing"] == 0
    assert len(log_tool("cat", parts).out.splitlines()) == 100
    assert log_tool("merge", parts, "--out", tmp_path / "m.mcap").code == 0
    assert counts(tmp_path / "m.mcap") == {"/a": 100}
    assert log_tool("doctor", parts).code == 0


def test_counter_shared_by_all_channels_is_recognised(log_tool: Any, tmp_path: Path) -> None:
    rows = [(k % 3, k, BASE_NS + k * 10**7, 0.0) for k in range(300)]
    whole = write(tmp_path / "w.mcap", rows, ("/a", "/b", "/c"))
    healthy = log_tool("doctor", whole)
    assert healthy.code == 0
    assert "one counter numbers the messages of all channels; none is missing" in healthy.out
    lacking = log_tool("doctor", write(tmp_path / "l.mcap", rows[:100] + rows[107:], "abc"))
    assert lacking.code == 1
    assert "7 of its numbers are missing" in lacking.out


def test_late_messages_are_not_missing(log_tool: Any, tmp_path: Path) -> None:
    rows = steady(60)
    shuffled = rows[:20] + rows[25:40] + rows[20:23] + rows[40:]
    found = info(write(tmp_path / "x.mcap", shuffled))
    assert found.channels[0].missing == 2


# Merging


def test_equal_payloads_at_other_times_are_not_duplicates(
    log_tool: Any, tmp_path: Path, counts: Any
) -> None:
    first = write(tmp_path / "a.mcap", steady(50))
    later = write(tmp_path / "b.mcap", steady(50, BASE_NS + 10**12))
    between = write(tmp_path / "c.mcap", steady(50, BASE_NS + 5 * 10**7))
    outcome = log_tool("merge", first, later, between, "--out", tmp_path / "m.mcap")
    assert outcome.code == 0
    assert "several logs and" not in outcome.out
    assert counts(tmp_path / "m.mcap") == {"/a": 150}


def test_duplicates_are_kept_once_and_reported_by_topic(
    log_tool: Any, tmp_path: Path, counts: Any
) -> None:
    rows = [*steady(30), (1, 0, BASE_NS + 1, 2.0), (1, 1, BASE_NS + 1, 2.0)]
    paths = [write(tmp_path / f"{n}.mcap", rows, ("/a", "/b")) for n in "xyz"]
    outcome = log_tool("merge", *paths, "--out", tmp_path / "m.mcap")
    assert counts(tmp_path / "m.mcap") == {"/a": 30, "/b": 2}  # doubles in one log stay
    assert "/a: 60 messages were in several logs" in outcome.out
    assert "/b: 4 messages were in several logs" in outcome.out


@pytest.mark.parametrize("held", [1 << 30, 40_000])
def test_merged_log_is_ordered_despite_backward_times(
    log_tool: Any, tmp_path: Path, held: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With little memory the waiting messages go to files, which are merged now and then."""
    monkeypatch.setattr("tactile_tools.log.ordering.HELD_BYTES", held)
    monkeypatch.setattr("tactile_tools.log.ordering.MAX_RUNS", 3)
    monkeypatch.setattr("tactile_tools.log.ordering.STRETCH_MESSAGES", 50)
    rng = np.random.default_rng(1)
    rows = [
        (0, k, BASE_NS + int(at), float(at))
        for k, at in enumerate(rng.integers(0, 10**13, 3000, dtype=np.int64))
    ]
    path = write(tmp_path / "x.mcap", rows, chunk_size=2000)
    other = write(tmp_path / "y.mcap", [(0, 0, BASE_NS + 5 * 10**12, -1.0)], ("/other",))
    assert "time_backwards" in log_tool("doctor", path, "--json").out
    assert log_tool("merge", path, other, "--out", tmp_path / "m.mcap").code == 0
    merged = [
        (m.log_ns, struct.unpack("<d", m.data[4:])[0])
        for _, m in read_messages(tmp_path / "m.mcap")
    ]
    assert merged == sorted([(r[2], r[3]) for r in rows] + [(BASE_NS + 5 * 10**12, -1.0)])
    assert log_tool("doctor", tmp_path / "m.mcap").code == 0
    assert {p.name for p in tmp_path.iterdir()} == {"x.mcap", "y.mcap", "m.mcap"}


def test_metadata_and_attachments_of_equal_name_are_all_kept(log_tool: Any, tmp_path: Path) -> None:
    path = tmp_path / "x.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        for text in ("1", "2", "2"):
            writer.add_metadata("same", {"k": text})
            writer.add_attachment(1, 1, "same", "text/plain", text.encode())
        channel = writer.register_channel("/j", "json", 0)
        for k in range(20):
            writer.add_message(channel, BASE_NS + k * 10**9, b"{}", BASE_NS)
        writer.finish()
    told = log_tool("info", path).out
    assert (told.count("same: k"), told.count("attached: same")) == (3, 3)
    quick = json.loads(log_tool("info", path, "--quick", "--json").out)
    assert (len(quick["files_within"]), quick["tables"]) == (3, ["same"] * 3)
    assert log_tool("split", path, "--every", "5").code == 0
    parts = tmp_path / "x_split"
    assert len(list(parts.iterdir())) == 4
    series = json.loads(log_tool("info", parts, "--json").out)
    assert (series["attachment_count"], len(series["files_within"])) == (3, 3)
    for given in ([parts], [parts, path]):
        assert log_tool("merge", *given, "--out", tmp_path / "m.mcap", "--force").code == 0
        merged = info(tmp_path / "m.mcap")
        assert [t.values["k"] for t in merged.tables if t.name == "same"] == ["1", "2", "2"]
        assert merged.attachment_count == 3
    assert log_tool("recover", path, "--out", tmp_path / "r.mcap").code == 0
    assert info(tmp_path / "r.mcap").attachment_count == 3


def test_latched_messages_start_every_part_and_are_exported_once(
    log_tool: Any, tmp_path: Path, counts: Any
) -> None:
    map_ = (1, 0, BASE_NS, 7.0)
    path = write(tmp_path / "x.mcap", [map_, *steady(50)], ("/scan", "/map"), qos=LATCHED)
    log_tool("split", path, "--every", "2")
    parts = sorted((tmp_path / "x_split").iterdir())
    assert [counts(part)["/map"] for part in parts] == [1, 1, 1]
    assert log_tool("merge", *parts, "--out", tmp_path / "m.mcap").code == 0
    assert counts(tmp_path / "m.mcap") == {"/scan": 50, "/map": 1}


# Losses


def test_cat_and_export_end_with_1_when_messages_were_lost(log_tool: Any, tmp_path: Path) -> None:
    path = write(tmp_path / "x.mcap", steady(100), chunk_size=500, compression=CompressionType.NONE)
    assert log_tool("cat", path).code == 0
    data = bytearray(path.read_bytes())
    data[len(data) // 3] ^= 1
    path.write_bytes(data)
    told = log_tool("cat", path)
    assert told.code == 1
    assert "messages lost" in told.err
    for kind in ("csv", "parquet", "npz"):
        assert log_tool("export", path, "--to", kind).code == 1
    kept = log_tool("recover", path, "--keep-suspect", "--json")
    assert json.loads(kept.out)["suspect"] > 0
    assert info(tmp_path / "x_recovered.mcap").messages == 100


# Seeking


@pytest.mark.parametrize(
    "how",
    [
        {},
        {"repeat_channels": False, "repeat_schemas": False},
        {"use_statistics": False},
        {"index_types": IndexType.NONE},
        {"use_chunking": False},
        {"enable_crcs": False},
    ],
)
def test_time_range_is_found_without_a_summary(
    log_tool: Any, tmp_path: Path, how: dict[str, Any]
) -> None:
    path = write(tmp_path / "x.mcap", steady(100), chunk_size=400, **how)
    for _ in range(2):
        rows = log_tool(
            "cat", path, "--from", "5", "--to", "6.95", "--topic", "/a"
        ).out.splitlines()
        assert [row.split("=")[1] for row in rows] == [str(k) for k in range(50, 70)]
    quick = log_tool("info", path, "--quick", "--json")
    assert json.loads(quick.out)["messages"] == 100
    assert ("read from end to end" in quick.err) == bool(
        {"repeat_channels", "use_statistics"} & set(how)
    )


# What is shown


def test_log_contents_cannot_control_the_terminal(log_tool: Any, tmp_path: Path) -> None:
    evil = "/x\x1b[2J\x9b1m\u202e:smile:[red]\n\x00"
    path = tmp_path / "x.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile=evil, library=evil)
        schema = writer.register_schema(evil, "ros2msg", b"string data\n")
        channel = writer.register_channel(evil, "cdr", schema)
        text = evil.encode()
        data = CDR + struct.pack("<I", len(text) + 1) + text + b"\0"
        writer.add_message(channel, BASE_NS, data, BASE_NS)
        known = writer.register_channel(
            "/s", "cdr", writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data\n")
        )
        writer.add_message(known, BASE_NS, data, BASE_NS)
        writer.add_metadata(evil, {evil: evil})
        writer.add_attachment(1, 1, evil, evil, b"x")
        writer.add_metadata("gap", {"reason": evil, "detail": evil, "messages": "1"})
        writer.finish()
    shown = ""
    for words in (
        ("info", path), ("info", path, "--quick"), ("doctor", path), ("cat", path),
        ("cat", path, "--json"), ("cat", path, "--topic", "/nope"), ("info", path, "--json"),
        ("export", path, "--to", "csv"), ("merge", path, "--out", tmp_path / "m.mcap"),
        ("recover", path), ("rosbag", path, "--out", tmp_path / "bag"),
        ("split", path, "--every", "1"),
    ):  # fmt: skip
        outcome = log_tool(*words)
        shown += outcome.out + outcome.err
    assert all(line.isprintable() for line in shown.splitlines())
    assert "\\x1b[2J" in shown
    assert ":smile:[red]" in shown
    assert not any(p.name != "x" and "PWN" in p.name for p in tmp_path.rglob("*"))


def test_impossible_stamps_are_named_and_exported(log_tool: Any, tmp_path: Path) -> None:
    last = (1 << 64) - 5
    path = write(tmp_path / "x.mcap", [(0, 0, BASE_NS, 1.0), (0, 1, last, 2.0)])
    doctor = log_tool("doctor", path)
    assert doctor.code == 1
    assert f"the first {last} ns" in doctor.out
    for kind in ("csv", "parquet", "npz"):
        assert log_tool("export", path, "--to", kind).code == 0
    with (tmp_path / "x_csv" / "a.csv").open(newline="") as file:
        assert [int(row["log_time_ns"]) for row in csv.DictReader(file)] == [BASE_NS, last]
    table = pyarrow.parquet.read_table(tmp_path / "x_parquet" / "a.parquet")
    assert table["publish_time_ns"].to_pylist() == [BASE_NS, last]
    with np.load(tmp_path / "x_npz" / "a.npz") as arrays:
        assert arrays["log_time_ns"].tolist() == [BASE_NS, last]
        assert arrays["time_s"].tolist() == [0.0, (last - BASE_NS) / 1e9]
    refused = log_tool("rosbag", path, "--out", tmp_path / "bag")
    assert refused.code == 2
    assert not (tmp_path / "bag").exists()


# Exports


def test_long_and_similar_topics_get_separate_files(log_tool: Any, tmp_path: Path) -> None:
    names = ("/" + "x" * 300, "/" + "x" * 300 + "y", "/a/b", "/a_b", "/A/B", "", "/con", "../../z")
    rows = [(k, 0, BASE_NS + k, float(k)) for k in range(len(names))]
    path = write(tmp_path / "x.mcap", rows, names)
    for kind in ("csv", "npz"):
        assert log_tool("export", path, "--to", kind).code == 0
        contents = json.loads((tmp_path / f"x_{kind}" / "columns.json").read_text())
        files = {entry["topic"]: entry["file"] for entry in contents}
        assert files.keys() == set(names)
        assert len({name.lower() for name in files.values()}) == len(names)
        assert all((tmp_path / f"x_{kind}" / name).exists() for name in files.values())


def test_raw_bytes_are_exported_only_on_request(
    log_tool: Any, recorded: Any, tmp_path: Path
) -> None:
    path = recorded(tmp_path / "run.mcap", 0.2)
    other = Recorder(tmp_path / "raw.mcap", RecorderSettings(min_free_bytes=0))
    for k in range(3):
        other.write(topics.RAW, "finger", CDR, BASE_NS + k, BASE_NS + k)
    assert other.close(60)
    both = tmp_path / "both.mcap"
    log_tool("merge", path, tmp_path / "raw.mcap", "--out", both)
    outcome = log_tool("export", both, "--to", "csv")
    assert outcome.code == 0
    assert "left out: /tactile/finger/raw" in outcome.out
    assert (
        "/tactile/finger/raw"
        in log_tool("export", both, "--to", "csv", "--force", "--topic", "*/raw").err
    )  # asked for by name, and reported as undecodable


def test_service_events_and_wide_strings_are_read(
    log_tool: Any, tmp_path: Path, rows_of: Any
) -> None:
    event = CDR + struct.pack("<B3xiI", 1, 5, 6) + bytes(range(16)) + bytes(4)
    event += struct.pack("<qI4xqqI", 3, 1, 20, 22, 0)
    service = "int64 a\nint64 b\n---\nint64 sum\n"
    parts = (
        "service_msgs/ServiceEventInfo info\nexample_interfaces/AddTwoInts_Request[<=1] request\n"
        "example_interfaces/srv/AddTwoInts_Response[<=1] response\n" + "=" * 80 + "\nMSG: "
        "example_interfaces/srv/AddTwoInts_Request\nint64 a\nint64 b\n" + "=" * 80 + "\nMSG: "
        "example_interfaces/AddTwoInts_Response\nint64 sum\n"
    )
    name = "example_interfaces/srv/AddTwoInts_Event"
    wide = "grüße 🖐"
    quads = CDR + struct.pack("<I", len(wide)) + wide.encode("utf-32-le") + struct.pack("<i", 9)
    utf16 = wide.encode("utf-16-le")
    pad = bytes(-len(utf16) % 4)
    in_bytes = CDR + struct.pack("<I", len(utf16)) + utf16 + pad + struct.pack("<i", 9)
    pairs = CDR + struct.pack("<I", len(utf16) // 2) + utf16 + pad + struct.pack("<i", 9)
    path = tmp_path / "x.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2", library="x")
        for topic, msgtype, definition, data in (
            ("/srv/_service_event", name, service, event),
            ("/msg/_service_event", name, parts, event),
            ("/w4", "p/msg/W", "wstring text\nint32 n\n", quads),
            ("/w2", "p/msg/W", "wstring<=20 text\nint32 n\n", in_bytes),
            ("/w1", "p/msg/W", "wstring text\nint32 n\n", pairs),
            ("/empty", "std_msgs/msg/Empty", "", CDR + b"\0"),
        ):
            schema = writer.register_schema(msgtype, "ros2msg", definition.encode())
            writer.add_message(
                writer.register_channel(topic, "cdr", schema), BASE_NS, data, BASE_NS
            )
        writer.finish()
    told = log_tool("cat", path, "--json")
    assert told.code == 0, told.out
    rows = {row["topic"]: row["message"] for row in rows_of(told.out)}
    for topic in ("/srv/_service_event", "/msg/_service_event"):
        assert rows[topic]["request"] == [{"a": 20, "b": 22}]
        assert rows[topic]["info"]["stamp"] == 5_000_000_006
    for topic in ("/w4", "/w2", "/w1"):
        assert rows[topic] == {"text": wide, "n": 9}
    for kind in ("csv", "parquet", "npz"):
        assert log_tool("export", path, "--to", kind).code == 0
    with (tmp_path / "x_csv" / "w2.csv").open(newline="") as table:
        assert next(csv.DictReader(table))["text"] == wide


def test_recursive_definitions_are_refused(log_tool: Any, tmp_path: Path) -> None:
    path = tmp_path / "x.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2", library="x")
        deep = "".join(f"A{k} a\n{'=' * 80}\nMSG: p/A{k}\n" for k in range(300)) + "int32 x\n"
        for name, text in (("p/msg/Own", "Own a\n"), ("p/msg/Deep", deep)):
            schema = writer.register_schema(name, "ros2msg", text.encode())
            channel = writer.register_channel(f"/{name[-3:]}", "cdr", schema)
            writer.add_message(channel, BASE_NS, CDR + bytes(8), BASE_NS)
        writer.finish()
    for words in (("cat", path), ("export", path, "--to", "csv"), ("doctor", path)):
        assert log_tool(*words).code == 1
    told = log_tool("doctor", path).out
    assert "contain itself" in told
    assert "nests types more than" in told


# Bags


@pytest.mark.parametrize(
    "how",
    [
        {"index_types": IndexType.NONE},
        {"index_types": IndexType.CHUNK},
        {"use_chunking": False},
        {"repeat_schemas": False},
        {"repeat_channels": False},
        {"use_statistics": False},
    ],
)
def test_bag_of_an_unindexed_log_is_rewritten(
    log_tool: Any, tmp_path: Path, how: dict[str, Any]
) -> None:
    path = write(tmp_path / "x.mcap", steady(20), qos=LATCHED, **how)
    beside = log_tool("rosbag", path)
    assert beside.code == 2
    assert "lacks indexes" in beside.err
    assert log_tool("rosbag", path, "--out", tmp_path / "bag").code == 0
    assert info(tmp_path / "bag" / "x.mcap").indexed
    text = (tmp_path / "bag" / "metadata.yaml").read_text()
    assert "message_count: 20" in text
    assert "durability: 1" in text
    whole = write(tmp_path / "w.mcap", steady(20))
    assert log_tool("rosbag", whole, "--out", tmp_path / "same").code == 0
    assert (tmp_path / "same" / "w.mcap").read_bytes() == whole.read_bytes()


def test_recorded_qos_and_latching_are_preserved(log_tool: Any, tmp_path: Path) -> None:
    from rosbags.rosbag2 import Reader
    from rosbags.rosbag2.metadata import dump_qos_v8, parse_qos
    from ruamel.yaml import YAML

    names = (
        "- history: keep_last\n  depth: 3\n  reliability: best_effort\n  durability: volatile\n"
        "  deadline: {sec: 1, nsec: 2}\n  lifespan: {sec: 0, nsec: 0}\n  liveliness: automatic\n"
        "  liveliness_lease_duration: {sec: 0, nsec: 0}\n  avoid_ros_namespace_conventions: true\n"
    )
    numbers = dump_qos_v8(parse_qos(names))
    for qos, topic, depth, durability in (
        (names, "/a", 3, 2), (numbers, "/a", 3, 2), (LATCHED, "/map", 1, 1),
        ("", "/tf_static", 1, 1),
    ):  # fmt: skip
        path = write(tmp_path / "x.mcap", steady(3), (topic,), qos=qos)
        folder = tmp_path / f"bag{len(list(tmp_path.iterdir()))}"
        assert log_tool("rosbag", path, "--out", folder).code == 0
        bag = YAML(typ="safe").load((folder / "metadata.yaml").read_text())
        with Reader(folder) as reader:  # compares the files with the YAML
            assert sum(1 for _ in reader.messages()) == 3
        (told,) = bag["rosbag2_bagfile_information"]["topics_with_message_count"]
        offered = told["topic_metadata"]["offered_qos_profiles"]
        (profile,) = YAML(typ="safe").load(offered)
        assert (profile["depth"], profile["durability"]) == (depth, durability)
        if qos == numbers:
            assert offered == numbers
        if not qos:
            beside = log_tool("rosbag", path)
            assert "not latched when played" in beside.out
