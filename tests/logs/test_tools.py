"""What the log tools give, and what they say of what they cannot do."""

from __future__ import annotations

import csv
import errno
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet
import pytest
from mcap.writer import Writer

from tactile_bus import topics
from tactile_bus.log_info import info
from tactile_bus.log_reader import read_messages
from tactile_bus.mcap_file import DiskStorage
from tactile_bus.recorder import RecorderSettings

pytestmark = pytest.mark.timeout(600)

FEATURES, COMMAND, EVENT = "/tactile/finger/features", "/arm/arm/cmd_vel", "/reach/reach/event"


def counts(path: Path) -> dict[str, int]:
    return {channel.topic: channel.messages for channel in info(path).channels}


def lines(out: str) -> list[Any]:
    return [json.loads(line) for line in out.splitlines()]


# cat


def test_cat_prints_every_message_for_people_and_machines(
    log_tool: Any, recorded: Any, tmp_path: Path
) -> None:
    path = recorded(tmp_path / "run.mcap")
    people = log_tool("cat", path)
    assert people.code == 0
    assert len(people.out.splitlines()) == 202
    row = next(line for line in people.out.splitlines() if FEATURES in line)
    assert "peak_force=" in row
    assert "wrench={force=(0, 0, 0) torque=(0, 0, 0)}" in row
    machines = lines(log_tool("cat", path, "--json").out)
    assert len(machines) == 202
    first = next(row for row in machines if row["topic"] == EVENT)
    assert first["message"]["text"] == "grüße, “quoted”"
    assert first["type"] == "tactile_msgs/msg/ReachEvent"
    assert isinstance(first["message"]["header"]["stamp"], int)


def test_cat_picks_topics_and_times(log_tool: Any, recorded: Any, tmp_path: Path) -> None:
    path = recorded(tmp_path / "run.mcap")
    rows = lines(log_tool("cat", path, "--json", "--topic", "arm/*").out)
    assert {row["topic"] for row in rows} == {COMMAND}
    rows = lines(
        log_tool("cat", path, "--json", "--topic", "*features", "--from", "0.2", "--to", "0.4").out
    )
    assert len(rows) == 21
    span = ("--from", "2023-11-14T22:13:20.5", "--to", "2023-11-14T23:13:20.599+01:00")
    rows = lines(log_tool("cat", path, "--json", "--topic", FEATURES, *span).out)
    assert len(rows) == 10
    assert len(log_tool("cat", path, "--limit", "3").out.splitlines()) == 3
    assert "2023-11-14 22:13:20.001Z" in log_tool("cat", path, "--absolute", "--limit", "1").out


def test_cat_into_a_pipe_that_closes_ends_quietly(recorded: Any, tmp_path: Path) -> None:
    path = recorded(tmp_path / "run.mcap", 3.0)
    command = f"{sys.executable} -m tactile_tools.cli log cat {path} | head -2"
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True, check=False)
    assert len(done.stdout.splitlines()) == 2
    assert "Traceback" not in done.stderr
    assert "Exception" not in done.stderr


# Several files


def test_files_of_one_log_are_read_as_one(log_tool: Any, recorded: Any, tmp_path: Path) -> None:
    recorded(tmp_path / "one.mcap", 2.0)
    assert log_tool("split", tmp_path / "one.mcap", "--every", "0.5").code == 0
    parts = tmp_path / "one_split"
    assert [p.name for p in sorted(parts.iterdir())] == [f"one_{k:04d}.mcap" for k in range(5)][:4]
    whole = log_tool("cat", tmp_path / "one.mcap").out
    for given in ([parts], [parts / "one"], sorted(parts.iterdir(), reverse=True)):
        assert log_tool("cat", *given).out == whole
        found = json.loads(log_tool("info", *given, "--json").out)
        assert found["files"] == 4
        assert {row["missing"] for row in found["channels"]} == {0}
    assert log_tool("doctor", parts).code == 0
    assert "the same log goes on in one_0001.mcap" in log_tool("info", parts / "one_0000.mcap").out
    (parts / "one_0001.mcap").unlink()
    lacking = log_tool("doctor", parts)
    assert lacking.code == 1
    assert "files of this log are not here: number 1" in lacking.out


def test_a_split_by_size_or_moment_keeps_everything(
    log_tool: Any, recorded: Any, tmp_path: Path
) -> None:
    path = recorded(tmp_path / "run.mcap", 2.0)
    for how in (("--size", "20kB"), ("--at", "0.3", "--at", "1.1")):
        out = tmp_path / how[0].strip("-")
        assert log_tool("split", path, *how, "--out", out).code == 0
        files = sorted(out.iterdir())
        assert len(files) == 3 if how[0] == "--at" else len(files) > 2
        total: dict[str, int] = {}
        for each in files:
            assert info(each).whole
            assert info(each).attachments.keys() == {"finger.note"}
            assert info(each).metadata["board:finger"] == {"serial_number": "0011"}
            for topic, count in counts(each).items():
                total[topic] = total.get(topic, 0) + count
        assert total == counts(path)


def test_values_that_hold_begin_every_part(log_tool: Any, recorded: Any, tmp_path: Path) -> None:
    from tactile_bus.messages import MSG, codec, header
    from tactile_bus.recorder import Recorder

    none = np.zeros(0, np.float32)
    geometry = MSG.SkinGeometry(
        header(1, "ee"), "0011", "finger", [], np.zeros(0, np.uint8), np.zeros(0, np.uint16),
        np.zeros(0, np.uint16), none, none, none,
    )  # fmt: skip
    path = tmp_path / "run.mcap"
    recorder = Recorder(path, RecorderSettings(min_free_bytes=0))
    data = codec().encode(topics.GEOMETRY, geometry)
    recorder.write(topics.GEOMETRY, "finger", data, 10**18, 10**18)
    for i in range(100):
        at = 10**18 + i * 10**7
        command = codec().encode(
            topics.COMMAND,
            MSG.TwistStamped(header(at, ""), MSG.Twist(*[MSG.Vector3(0.0, 0.0, 0.0)] * 2)),
        )
        recorder.write(topics.COMMAND, "arm", command, at, at)
    assert recorder.close(10)
    log_tool("split", path, "--every", "0.25", "--out", tmp_path / "parts")
    for each in (tmp_path / "parts").iterdir():
        assert counts(each)["/tactile/finger/geometry"] == 1
    merged = tmp_path / "merged.mcap"
    assert log_tool("merge", tmp_path / "parts", "--out", merged).code == 0
    assert counts(merged) == counts(path)  # the repeated ones are told apart


def test_logs_of_two_daemons_become_one_trial(log_tool: Any, recorded: Any, tmp_path: Path) -> None:
    """The second heard what the first said and logged it too; it began a little later."""
    first = recorded(tmp_path / "tactiled.mcap", 1.0)
    second = recorded(tmp_path / "reachd.mcap", 1.0, start=0.5)
    merged = tmp_path / "trial.mcap"
    outcome = log_tool("merge", second, first, "--out", merged)
    assert outcome.code == 0, outcome.err
    both = counts(merged)
    assert both[COMMAND] == counts(first)[COMMAND] + counts(second)[COMMAND] - 50
    times = [m.log_ns for _, m in read_messages(merged)]
    assert times == sorted(times)
    found = info(merged)
    assert found.whole
    assert {channel.missing for channel in found.channels} == {0}
    assert found.attachments.keys() == {"finger.note"}
    assert found.metadata["board:finger"] == {"serial_number": "0011"}
    assert found.metadata.keys() >= {"software", "software@reachd"}
    kept = tmp_path / "kept.mcap"
    log_tool("merge", second, first, "--out", kept, "--keep-duplicates")
    assert counts(kept)[COMMAND] == 200


def test_logs_whose_clocks_differ_are_put_together(
    log_tool: Any, recorded: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = recorded(tmp_path / "a.mcap", 0.2)
    import tactile_bus.recorder as module
    from tactile_bus.instant import WallClock

    real = WallClock.take().offset_ns
    monkeypatch.setattr(module.WallClock, "take", lambda: WallClock(real + 3_600 * 10**9))
    second = recorded(tmp_path / "b.mcap", 0.2, start=3600.1)
    told = log_tool("merge", first, second, "--out", tmp_path / "m.mcap")
    assert "the clock was set between the starts of these logs" in told.err
    log_tool("merge", first, second, "--out", tmp_path / "n.mcap", "--align")
    span = info(tmp_path / "n.mcap").span_ns
    assert span is not None
    assert (span[1] - span[0]) / 1e9 < 1.0


# export


@pytest.mark.parametrize("cut", [False, True])
def test_exports_hold_what_the_log_holds(
    log_tool: Any, recorded: Any, tmp_path: Path, cut: bool
) -> None:
    path = recorded(tmp_path / "run.mcap", 1.0, chunk_bytes=4096)
    if cut:
        data = path.read_bytes()
        path.write_bytes(data[: len(data) // 2])
    rows = lines(log_tool("cat", path, "--json", "--topic", "*features").out)
    for kind in ("csv", "parquet", "npz"):
        outcome = log_tool("export", path, "--to", kind)
        assert outcome.code == 0, outcome.err
        assert ("not closed" in outcome.err) == cut
    peak = np.array([row["message"]["peak_force"] for row in rows], np.float32)
    stamps = [row["message"]["header"]["stamp"] for row in rows]
    with (tmp_path / "run_csv" / "tactile_finger_features.csv").open(newline="") as file:
        table = list(csv.DictReader(file))
    assert [np.float32(row["peak_force"]) for row in table] == peak.tolist()
    assert [int(row["header.stamp_ns"]) for row in table] == stamps
    assert float(table[1]["time_s"]) == pytest.approx(0.01, abs=1e-6)
    assert [len(json.loads(row["patches"])) for row in table[:3]] == [0, 1, 2]
    assert table[0]["reasons.0"] == "taring"
    read = pyarrow.parquet.read_table(tmp_path / "run_parquet" / "tactile_finger_features.parquet")
    assert read["peak_force"].to_numpy().tolist() == peak.tolist()
    assert read["patches"][2].as_py()[0]["force.y"] == -1.5
    assert b"N, largest normal force" in read.schema.field("peak_force").metadata[b"comment"]
    with np.load(tmp_path / "run_npz" / "tactile_finger_features.npz") as arrays:
        assert arrays["peak_force"].tolist() == peak.tolist()
        assert arrays["header.frame_id"][0] == "ee"
        offsets = arrays["patches.offsets"]
        assert np.diff(offsets)[:3].tolist() == [0, 1, 2]
        assert len(arrays["patches.normal_force"]) == offsets[-1]
    contents = json.loads((tmp_path / "run_csv" / "columns.json").read_text())
    assert {entry["topic"] for entry in contents} == {FEATURES, COMMAND, EVENT}


def test_lists_of_numbers_are_columns_lists_or_matrices(log_tool: Any, tmp_path: Path) -> None:
    from tactile_bus.messages import MSG, codec, header
    from tactile_bus.recorder import Recorder

    path = tmp_path / "run.mcap"
    recorder = Recorder(path, RecorderSettings(min_free_bytes=0))
    for i in range(3):
        force = np.arange(9, dtype=np.float32) / 10 + i
        force[4] = np.nan if i == 1 else force[4]
        message = MSG.TaxelForces(
            header(i, "ee"), i, i, 0.0, i, np.array([3], np.uint16), force[: 9 - 3 * (i == 2)],
            np.zeros(3, np.uint8), True, True,
        )  # fmt: skip
        data = codec().encode(topics.FORCES, message)
        recorder.write(topics.FORCES, "b", data, 10**18 + i, 10**18 + i)
    assert recorder.close(10)
    for kind in ("csv", "parquet", "npz"):
        assert log_tool("export", path, "--to", kind).code == 0
    with (tmp_path / "run_csv" / "tactile_b_forces.csv").open(newline="") as file:
        table = list(csv.DictReader(file))
    assert np.float32(table[0]["force.8"]) == np.float32(0.8)
    assert table[1]["force.4"] == "nan"
    assert table[2]["force.8"] == ""
    read = pyarrow.parquet.read_table(tmp_path / "run_parquet" / "tactile_b_forces.parquet")
    assert [len(row.as_py()) for row in read["force"]] == [9, 9, 6]
    with np.load(tmp_path / "run_npz" / "tactile_b_forces.npz") as arrays:
        assert arrays["status"].shape == (3, 3)
        assert arrays["force"].shape == (24,)
        assert arrays["force.offsets"].tolist() == [0, 9, 18, 24]


def test_exports_are_overwritten_only_when_asked(
    log_tool: Any, recorded: Any, tmp_path: Path
) -> None:
    path = recorded(tmp_path / "run.mcap", 0.1)
    assert log_tool("export", path, "--to", "npz").code == 0
    again = log_tool("export", path, "--to", "npz")
    assert again.code == 2
    assert "give --force" in again.err
    assert log_tool("export", path, "--to", "npz", "--force").code == 0
    mine = tmp_path / "mine"
    mine.mkdir()
    (mine / "thesis.txt").touch()
    refused = log_tool("export", path, "--to", "npz", "--force", "--out", mine)
    assert refused.code == 2
    assert (mine / "thesis.txt").exists()


# Logs of other programs


def test_logs_of_other_programs_are_read_as_far_as_can_be(log_tool: Any, tmp_path: Path) -> None:
    path = tmp_path / "other.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="px4", library="else 3")
        kinds = {
            "json": writer.register_schema("J", "jsonschema", b"{}"),
            "msg": writer.register_schema("my/msg/Thing", "ros2msg", b"float64[3] a\nstring s\n"),
            "proto": writer.register_schema("P", "protobuf", b"\x01"),
            "bad": writer.register_schema("my/msg/Bad", "ros2msg", b"what is this\n\xff"),
        }
        channels = {
            name: writer.register_channel(f"/{name}", encoding, kinds[name])
            for name, encoding in (
                ("json", "json"), ("msg", "cdr"), ("proto", "protobuf"), ("bad", "cdr")
            )
        }  # fmt: skip
        thing = b"\x00\x01\x00\x00" + np.array([1.0, 2, 3]).tobytes() + b"\x03\x00\x00\x00hi\x00"
        for name, data in (("json", b'{"k": [1, null]}'), ("msg", thing), ("proto", b"x")):
            writer.add_message(channels[name], 10**18, data, 10**18)
        writer.add_message(channels["bad"], 10**18, thing, 10**18)
        writer.finish()
    told = log_tool("cat", path, "--json")
    assert told.code == 1
    rows = {row["topic"]: row["message"] for row in lines(told.out)}
    assert rows["/json"] == {"k": [1, None]}
    assert rows["/msg"] == {"a": [1.0, 2.0, 3.0], "s": "hi"}
    assert "only cdr (ROS 2) and json are decoded" in rows["/proto"]["error"]
    assert "cannot be read" in rows["/bad"]["error"]
    doctor = log_tool("doctor", path)
    assert doctor.code == 1
    assert "profile 'px4' is not known here" in doctor.out
    assert "/proto is encoded as protobuf" in doctor.out
    for kind in ("csv", "parquet", "npz"):
        exported = log_tool("export", path, "--to", kind)
        assert exported.code == 1
        assert "messages of /proto left out" in exported.err
        assert (tmp_path / f"other_{kind}" / f"msg.{kind}").exists()
    assert log_tool("split", path, "--every", "1", "--out", tmp_path / "s").code == 0
    assert counts(tmp_path / "s" / "other_0000.mcap") == counts(path)


def test_a_newer_version_is_told(log_tool: Any, tiny_log: Any, tmp_path: Path) -> None:
    data = tiny_log(tmp_path / "t.mcap", library="tactile-reach 99.1.2")
    outcome = log_tool("doctor", tmp_path / "t.mcap")
    assert outcome.code == 1
    assert "written by tactile-reach 99.1.2, newer than this one" in outcome.out
    assert "update tactile-reach" in outcome.out
    (tmp_path / "n.mcap").write_bytes(data.replace(b"\x89MCAP0", b"\x89MCAP1"))
    for command in ("info", "doctor", "cat", "recover"):
        newer = log_tool(command, tmp_path / "n.mcap")
        assert newer.code == 2
        assert "version '1' of the MCAP format" in newer.err


def test_doctor_tells_time_that_goes_back_clocks_that_part_and_what_is_lost(
    log_tool: Any, tmp_path: Path
) -> None:
    path = tmp_path / "odd.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2", library="x")
        schema = writer.register_schema("my/msg/T", "ros2msg", b"float64 a\n")
        channel = writer.register_channel("/t", "cdr", schema)
        writer.register_channel("/never", "cdr", schema)
        for i in range(400):
            at = 10**18 + i * 10**7
            log = at - (5 * 10**8 if i == 50 else 0)
            sent = at - (7 * 10**9 if i > 250 else 0)
            number = i + 20 * (i > 300)
            writer.add_message(channel, log, b"\x00\x01\x00\x00" + bytes(8), sent, number)
        writer.add_metadata("gap", {"reason": "disk_full", "messages": "7", "first_ns": "1"})
        writer.finish()
    outcome = log_tool("doctor", path)
    assert outcome.code == 1
    for text in (
        "/t: time goes backwards 1 times, by up to 0.490 s",
        "stamps and the log's clock part by +7.000 s",
        "gap: disk_full, 7 messages not written",
        "20 messages are missing by their numbers, most of /t",
        "channels without a message: /never",
        "readable all the same: 400 messages",
    ):
        assert text in outcome.out


# Refusals


def test_bad_arguments_are_named_with_what_is_allowed(
    log_tool: Any, recorded: Any, tmp_path: Path
) -> None:
    path = recorded(tmp_path / "run.mcap", 0.1)
    (tmp_path / "file").touch()
    for words, text in (
        (("cat", path, "--topic", "/nope*"), "no topic '/nope*'"),
        (("cat", path, "--topic", "/nope"), f"it holds {COMMAND}, {EVENT}, {FEATURES}"),
        (("cat", path, "--from", "soon"), "allowed: seconds since the start"),
        (("cat", path, "--from", "3", "--to", "2"), "nothing is between"),
        (("export", path, "--to", "xls"), "invalid choice"),
        (("export", path, "--to", "csv", "--out", tmp_path / "file"), "is a file"),
        (("split", path, "--every", "0"), "above 0"),
        (("split", path, "--size", "big"), "a size such as 500MB"),
        (("split", path), "one of the arguments"),
        (("merge", path, "--out", path), "is what is read"),
        (("merge", path, "--out", tmp_path), "is a folder"),
        (("merge", path), "--out"),
        (("replay", path, "--speed", "-1"), "above 0"),
        (("replay", path, "--topic", "x"), "no topic 'x'"),
        (("rosbag", path, tmp_path / "nothing"), "does not exist"),
        (("recover", path, "--out", path), "is what is read"),
        (("cat", tmp_path / "run_9"), "does not exist"),
    ):
        outcome = log_tool(*words)
        assert outcome.code == 2, (words, outcome)
        assert text in outcome.err, words
    assert counts(path)[FEATURES] == 10


@pytest.mark.parametrize("content", [b"", b"\x89MCAP0", b"GIF89a" + bytes(3000)])
def test_every_tool_refuses_what_is_no_log(log_tool: Any, tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "x.mcap"
    path.write_bytes(content)
    out = ("--out", tmp_path / "o.mcap")
    for words in (
        ("info",), ("doctor",), ("recover",), ("cat",), ("export", "--to", "csv"), ("replay",),
        ("split", "--every", "1"), ("merge", *out), ("reprocess",), ("rosbag",),
    ):  # fmt: skip
        outcome = log_tool(words[0], path, *words[1:])
        assert outcome.code == 2, words
        assert str(path) in outcome.err
    assert [p.name for p in tmp_path.iterdir()] == ["x.mcap"]


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read everything")
def test_files_that_may_not_be_read_are_refused(
    log_tool: Any, recorded: Any, tmp_path: Path
) -> None:
    path = recorded(tmp_path / "run.mcap", 0.1)
    path.chmod(0)
    outcome = log_tool("info", path)
    assert outcome.code == 3
    assert "permissions" in outcome.err


def test_a_file_that_the_system_refuses_is_told(
    log_tool: Any, recorded: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = recorded(tmp_path / "run.mcap", 0.1)

    def refuse(*_: Any, **__: Any) -> Any:
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr("tactile_bus.log_bytes.open", refuse, raising=False)
    for command in ("info", "cat", "doctor"):
        outcome = log_tool(command, path)
        assert outcome.code == 3
        assert "check the file's permissions" in outcome.err


def test_a_full_disk_ends_with_a_message_and_leaves_nothing(
    log_tool: Any, recorded: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = recorded(tmp_path / "run.mcap", 0.3)

    def full(*_: Any) -> int:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(DiskStorage, "write", full)
    for words in (
        ("recover", path), ("split", path, "--every", "0.1"), ("merge", path, "--out", "m.mcap"),
    ):  # fmt: skip
        monkeypatch.chdir(tmp_path)
        outcome = log_tool(*words)
        assert outcome.code == 3, outcome
        assert "No space left on device" in outcome.err
    left = {p.name for p in tmp_path.rglob("*") if p.is_file()}
    assert left == {"run.mcap"}


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no /dev/full here")
def test_output_to_a_full_device_is_told(recorded: Any, tmp_path: Path) -> None:
    path = recorded(tmp_path / "run.mcap", 1.0)
    with open("/dev/full", "w") as full:
        done = subprocess.run(
            [sys.executable, "-m", "tactile_tools.cli", "log", "cat", str(path)],
            stdout=full, stderr=subprocess.PIPE, text=True, check=False,
        )  # fmt: skip
    assert done.returncode == 3
    assert "Traceback" not in done.stderr
    assert "cannot write" in done.stderr


def test_an_export_to_a_place_that_is_not_there_is_refused(
    log_tool: Any, recorded: Any, tmp_path: Path
) -> None:
    path = recorded(tmp_path / "run.mcap", 0.1)
    for words in (
        ("export", path, "--to", "csv", "--out", "/proc/none/x"),
        ("merge", path, "--out", "/proc/none/x.mcap"),
        ("split", path, "--every", "1", "--out", "/proc/none/x"),
        ("rosbag", path, "--out", "/proc/none/x"),
    ):
        outcome = log_tool(*words)
        assert outcome.code == 3, words
        assert "name a place" in outcome.err


# rosbag


def test_a_bag_is_made_beside_the_files_or_of_recovered_ones(
    log_tool: Any, recorded: Any, tmp_path: Path
) -> None:
    path = recorded(tmp_path / "run.mcap", 0.5)
    assert log_tool("rosbag", path).code == 0
    text = (tmp_path / "metadata.yaml").read_text()
    assert "relative_file_paths" in text
    assert log_tool("rosbag", path).code == 2
    data = path.read_bytes()
    path.write_bytes(data[: len(data) * 3 // 4])
    refused = log_tool("rosbag", path, "--force")
    assert refused.code == 2
    assert "is not whole" in refused.err
    assert log_tool("rosbag", path, "--out", tmp_path / "bag").code == 0
    assert info(tmp_path / "bag" / "run.mcap").whole
    assert path.read_bytes() == data[: len(data) * 3 // 4]
