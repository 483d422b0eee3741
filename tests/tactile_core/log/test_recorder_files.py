"""The recorder's files: splitting, retention, sharing, refusal at start."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Any

import pytest

from tactile_core.bus import topics
from tactile_core.log.info import info
from tactile_core.log.reader import read_messages
from tactile_core.log.recorder import Recorder, RecorderError, RecorderSettings
from tests.support.waiting import PATIENCE_S, wait_until

BASE_NS = 1_700_000_000_000_000_000


def test_files_split_by_size_are_self_contained(
    tmp_path: Path, record: Any, payloads: Any, logs: Any, sequences: Any
) -> None:
    recorder = record(tmp_path, split_bytes=6000, chunk_bytes=1000, flush_period=0.03)
    recorder.attach("cal.toml", "application/toml", b"x = 1\n")
    recorder.metadata("board:b0", {"serial_number": "0011"})
    recorder.write(topics.GEOMETRY, "b0", payloads[topics.GEOMETRY], BASE_NS, BASE_NS)
    count = 0
    while recorder.stats.files < 4:
        count += 1
        data = os.urandom(300)
        recorder.write(topics.RAW, "b0", data, BASE_NS + count, BASE_NS + count)
        time.sleep(0.002)
    assert recorder.close(60)
    found = logs(tmp_path)
    assert len(found) >= 4
    for number, log in enumerate(found):
        assert log.whole
        assert log.size < 6000 + 4000  # split_bytes plus the summary
        assert log.metadata["board:b0"] == {"serial_number": "0011"}
        assert log.metadata["file"]["file"] == str(number)
        assert log.attachments == {"cal.toml": ("application/toml", 6)}
        if log.messages:
            geometry = [c for c in log.channels if c.topic.endswith("geometry")]
            assert [c.messages for c in geometry] == [1]
        assert all(channel.missing == 0 for channel in log.channels)
    assert len({log.metadata["file"]["set"] for log in found}) == 1
    assert sequences(tmp_path)["/tactile/b0/raw"] == list(range(count))


def test_files_split_by_time(tmp_path: Path, record: Any, payloads: Any, logs: Any) -> None:
    recorder = record(tmp_path, split_seconds=0.15)
    deadline = time.monotonic() + PATIENCE_S
    while recorder.stats.files < 3:
        assert time.monotonic() < deadline
        recorder.write(topics.LOG, "b0", payloads[topics.LOG], BASE_NS, BASE_NS)
        time.sleep(0.01)
    assert recorder.close(60)
    assert all(log.whole for log in logs(tmp_path))


def test_changed_geometry_is_the_one_repeated_in_later_files(
    tmp_path: Path, record: Any, payloads: Any
) -> None:
    recorder = record(tmp_path, split_bytes=6000, chunk_bytes=1000)
    old, new = payloads[topics.GEOMETRY], payloads[topics.GEOMETRY] + b"\0"
    recorder.write(topics.GEOMETRY, "b0", old, BASE_NS, BASE_NS)
    recorder.write(topics.GEOMETRY, "b0", new, BASE_NS + 1, BASE_NS)
    wait_until(lambda: recorder.stats.written == 2)
    count = 2
    while recorder.stats.files < 2:
        recorder.write(topics.RAW, "b0", os.urandom(300), BASE_NS + count, BASE_NS + count)
        count += 1
        time.sleep(0.002)
    assert recorder.close(60)
    rows = [(c.topic, m.data) for c, m in read_messages(sorted(tmp_path.glob("*.mcap"))[1])]
    assert rows[0] == ("/tactile/b0/geometry", new)


def test_retention_keeps_newest_and_current_files(tmp_path: Path, record: Any) -> None:
    stranger = tmp_path / "holiday.mcap"
    stranger.write_bytes(b"not ours")
    recorder = record(tmp_path, split_bytes=3000, chunk_bytes=1000, max_files=3)
    deadline = time.monotonic() + PATIENCE_S
    count = 0
    while recorder.stats.files < 7:
        assert time.monotonic() < deadline
        recorder.write(topics.RAW, "b0", os.urandom(300), BASE_NS + count, BASE_NS)
        count += 1
        time.sleep(0.002)
        assert Path(recorder.stats.path).exists() or recorder.stats.queued
    assert recorder.close(60)
    kept = sorted(tmp_path.glob("tactile_*.mcap"))
    assert len(kept) <= 3
    assert kept[-1].stem[-4:] >= "0006"
    assert all(info(path).whole for path in kept)
    assert stranger.exists()


def test_retention_includes_files_of_earlier_runs(
    tmp_path: Path, record: Any, payloads: Any, disk: Any
) -> None:
    old = []
    for year in (2001, 2002, 2003):
        first = record(tmp_path / "x.mcap")
        first.write(topics.LOG, "b0", payloads[topics.LOG], BASE_NS, BASE_NS)
        first.close(60)
        old.append(tmp_path / f"tactile_{year}0101T000000Z_0000.mcap")
        (tmp_path / "x.mcap").rename(old[-1])
    # The last run was killed: its file has no summary but is readable.
    data = old[-1].read_bytes()
    old[-1].write_bytes(data[: len(data) - 100])
    recorder = record(tmp_path, max_files=2)
    assert not old[0].exists()
    assert not old[1].exists()
    assert old[2].exists()
    assert Path(recorder.stats.path).exists()


def test_nothing_is_deleted_when_newest_file_is_unreadable(
    tmp_path: Path, record: Any, caplog: Any
) -> None:
    old = [tmp_path / f"tactile_{year}0101T000000Z_0000.mcap" for year in (2001, 2002, 2003)]
    for path in old:
        path.write_bytes(bytes(1000))
    record(tmp_path, max_files=1)
    assert all(path.exists() for path in old)
    assert "nothing is deleted" in caplog.text


def test_file_being_written_by_another_process_is_kept(tmp_path: Path, record: Any) -> None:
    other = record(tmp_path)
    time.sleep(1.1)  # file names have a resolution of one second
    record(tmp_path, max_files=1)
    assert Path(other.stats.path).exists()


def test_two_daemons_may_log_to_one_directory(
    tmp_path: Path, record: Any, payloads: Any, logs: Any, sequences: Any
) -> None:
    both = [record(tmp_path, split_seconds=0.1) for _ in range(2)]
    for i in range(30):
        for number, recorder in enumerate(both):
            data = payloads[topics.LOG]
            recorder.write(topics.LOG, f"b{number}", data, BASE_NS + i, BASE_NS)
        time.sleep(0.01)
    assert all(recorder.close(60) for recorder in both)
    numbers = sequences(tmp_path)
    assert numbers["/tactile/b0/log"] == numbers["/tactile/b1/log"] == list(range(30))
    assert len({log.metadata["file"]["set"] for log in logs(tmp_path)}) == 2


def test_existing_file_is_not_overwritten(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    path.write_bytes(b"precious")
    with pytest.raises(RecorderError, match="exists and is not overwritten"):
        Recorder(path, RecorderSettings(min_free_bytes=0))
    assert path.read_bytes() == b"precious"


def test_unwritable_place_is_named_with_a_remedy(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for place in (tmp_path / "file" / "logs", Path("/proc/logs")):
        with pytest.raises(RecorderError, match="name a directory that this user may write to"):
            Recorder(place, RecorderSettings(min_free_bytes=0))


def test_full_disk_is_refused_at_start(tmp_path: Path, disk: Any) -> None:
    disk.free_bytes = 5 << 20
    with pytest.raises(RecorderError, match=r"0.01 GB free .* logs stop at 1.07"):
        Recorder(tmp_path, storage=disk)
    assert list(tmp_path.iterdir()) == []
