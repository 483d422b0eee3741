"""Logs of other programs and versions, and what the doctor says about unusual ones."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import Writer


def test_logs_of_other_programs_are_read_as_far_as_possible(
    log_tool: Any, tmp_path: Path, counts: Any, rows_of: Any
) -> None:
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
    rows = {row["topic"]: row["message"] for row in rows_of(told.out)}
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


def test_newer_version_is_reported(log_tool: Any, tiny_log: Any, tmp_path: Path) -> None:
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


def test_doctor_reports_backward_time_diverging_clocks_and_losses(
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
