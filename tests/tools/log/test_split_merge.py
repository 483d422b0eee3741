"""Logs in several files: read as one, split, merged, and turned into a bag."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tactile_core.bus import topics
from tactile_core.bus.commanding import command_message
from tactile_core.log.info import info
from tactile_core.log.reader import read_messages
from tactile_core.log.recorder import RecorderSettings
from tactile_core.types import Twist

COMMAND = "/arm/arm/cmd_vel"


def test_split_files_are_read_as_one_log(log_tool: Any, recorded: Any, tmp_path: Path) -> None:
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


def test_split_by_size_or_time_keeps_everything(
    log_tool: Any, recorded: Any, tmp_path: Path, counts: Any
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


def test_latched_values_start_every_part(
    log_tool: Any, recorded: Any, tmp_path: Path, counts: Any
) -> None:
    from tactile_core.bus.messages import MSG, codec, header
    from tactile_core.log.recorder import Recorder

    none = np.zeros(0, np.float32)
    geometry = MSG.SkinGeometry(
        header(1, "ee"), "0011", "finger", [], np.zeros(0, np.uint8), np.zeros(0, np.uint16),
        np.zeros(0, np.uint16), none, none, none, np.zeros(0, np.bool_),
    )  # fmt: skip
    path = tmp_path / "run.mcap"
    recorder = Recorder(path, RecorderSettings(min_free_bytes=0))
    data = codec().encode(topics.GEOMETRY, geometry)
    recorder.write(topics.GEOMETRY, "finger", data, 10**18, 10**18)
    for i in range(100):
        at = 10**18 + i * 10**7
        command = codec().encode(
            topics.COMMAND,
            command_message(Twist(0.0, 0.0, 0.0), at, 0.06, at),
        )
        recorder.write(topics.COMMAND, "arm", command, at, at)
    assert recorder.close(60)
    log_tool("split", path, "--every", "0.25", "--out", tmp_path / "parts")
    for each in (tmp_path / "parts").iterdir():
        assert counts(each)["/tactile/finger/geometry"] == 1
    merged = tmp_path / "merged.mcap"
    assert log_tool("merge", tmp_path / "parts", "--out", merged).code == 0
    assert counts(merged) == counts(path)  # repeated messages are recognised


def test_logs_of_two_daemons_merge_into_one(
    log_tool: Any, recorded: Any, tmp_path: Path, counts: Any
) -> None:
    """The second daemon heard and logged what the first one published; it began a little later."""
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


@pytest.mark.parametrize(
    ("text", "tables"),
    [
        (b"# A place.\nfloat64 x  # m\n\nfloat64   y\nfloat64 z\n", 1),
        (b"float64 x\nfloat64 y\nfloat64 w\n", 2),
    ],
    ids=["other comments", "other fields"],
)
def test_only_comments_of_a_definition_may_differ_within_a_topic(
    log_tool: Any, tiny_log: Any, tmp_path: Path, text: bytes, tables: int
) -> None:
    tiny_log(tmp_path / "old.mcap")
    tiny_log(tmp_path / "new.mcap", text=text)
    merged = log_tool(
        "merge", tmp_path / "old.mcap", tmp_path / "new.mcap", "--out", tmp_path / "m.mcap"
    )
    assert merged.code == 0, merged.err
    told = log_tool("export", tmp_path / "m.mcap", "--format", "csv", "--out", tmp_path / "e")
    assert told.code == 0, told.err
    assert len(list((tmp_path / "e").glob("v*.csv"))) == tables


def test_logs_with_different_clocks_are_aligned(
    log_tool: Any, recorded: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = recorded(tmp_path / "a.mcap", 0.2)
    import tactile_core.log.recorder as module
    from tactile_core.types import WallClock

    real = WallClock.take().offset_ns
    monkeypatch.setattr(module.WallClock, "take", lambda: WallClock(real + 3_600 * 10**9))
    second = recorded(tmp_path / "b.mcap", 0.2, start=3600.1)
    told = log_tool("merge", first, second, "--out", tmp_path / "m.mcap")
    assert "the clock was set between the starts of these logs" in told.err
    log_tool("merge", first, second, "--out", tmp_path / "n.mcap", "--align")
    span = info(tmp_path / "n.mcap").span_ns
    assert span is not None
    assert (span[1] - span[0]) / 1e9 < 1.0


def test_bag_is_written_beside_files_or_from_recovered_ones(
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
