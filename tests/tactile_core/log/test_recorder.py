"""The recorder: bounded, never blocking, and without untraced losses."""

from __future__ import annotations

import errno
import logging
import resource
import subprocess
import sys
import textwrap
import threading
import time
from collections import defaultdict
from pathlib import Path
from typing import Any

import pytest

from tactile_core.bus import topics
from tactile_core.log.info import info
from tactile_core.log.reader import read_messages
from tactile_core.log.recorder import RecorderSettings
from tactile_core.types import WallClock
from tests.support.waiting import wait_until

BASE_NS = 1_700_000_000_000_000_000


def holes(numbers: list[int], handed_over: int) -> int:
    return handed_over - len(set(numbers))


def test_last_message_is_readable_within_one_flush(
    tmp_path: Path, record: Any, payloads: Any
) -> None:
    recorder = record(tmp_path / "a.mcap")
    recorder.write(topics.LOG, "b0", payloads[topics.LOG], BASE_NS, BASE_NS)
    wait_until(lambda: recorder.stats.written == 1)
    # The file is still open: this is what a kill would leave now.
    found = info(tmp_path / "a.mcap")
    assert found.messages == 1
    assert not found.closed


def test_every_flush_is_synced_to_disk(
    tmp_path: Path, record: Any, payloads: Any, disk: Any
) -> None:
    recorder = record(tmp_path / "a.mcap")
    before = disk.syncs
    recorder.write(topics.LOG, "b0", payloads[topics.LOG], BASE_NS, BASE_NS)
    wait_until(lambda: disk.syncs > before)


def test_flush_period_above_half_a_second_is_refused(tmp_path: Path) -> None:
    from tactile_core.config import ConfigError, parse_toml

    with pytest.raises(
        ConfigError, match=r"flush_period = 5\.0; allowed: a finite number above 0 and at most"
    ):
        parse_toml("flush_period = 5.0", RecorderSettings)


def test_close_writes_the_queue_and_reports_success(
    tmp_path: Path, record: Any, payloads: Any
) -> None:
    recorder = record(tmp_path / "a.mcap", flush_period=0.5)
    for i in range(1000):
        recorder.write(topics.FORCES, "b0", payloads[topics.FORCES], BASE_NS + i, BASE_NS + i)
    assert recorder.close(60)
    stats = recorder.stats
    assert (stats.state, stats.written, stats.queued, stats.dropped) == ("closed", 1000, 0, {})
    found = info(tmp_path / "a.mcap")
    assert found.whole
    assert found.messages == 1000


def test_messages_after_close_are_counted_as_lost(
    tmp_path: Path, record: Any, payloads: Any
) -> None:
    recorder = record(tmp_path / "a.mcap")
    recorder.close(60)
    recorder.write(topics.LOG, "b0", payloads[topics.LOG], BASE_NS, BASE_NS)
    assert recorder.stats.dropped == {"closed": 1}


def test_full_queue_drops_oldest_and_the_log_locates_the_gap(
    tmp_path: Path, record: Any, payloads: Any, disk: Any, sequences: Any
) -> None:
    recorder = record(tmp_path / "a.mcap", queue_messages=50)
    disk.moving.clear()  # a hanging disk
    for i in range(400):
        for topic in (topics.FORCES, topics.RAW):
            recorder.write(topic, "b0", payloads[topic], BASE_NS + i, BASE_NS + i)
    dropped = recorder.stats.dropped["queue_full"]
    assert dropped > 0
    disk.moving.set()
    wait_until(lambda: recorder.stats.queued == 0)
    for i in range(400, 410):
        recorder.write(topics.RAW, "b0", payloads[topics.RAW], BASE_NS + i, BASE_NS + i)
    assert recorder.close(60)
    assert recorder.stats.dropped == {"queue_full": dropped}
    found = info(tmp_path / "a.mcap")
    gaps = [gap for gap in found.gaps if gap.reason == "queue_full"]
    assert sum(gap.messages for gap in gaps) == dropped
    by_channel = defaultdict(int)
    for gap in gaps:
        for name, count in gap.channels.items():
            by_channel[name] += count
    assert sum(by_channel.values()) == dropped
    # The same losses as missing sequence numbers.
    assert {c.topic: c.missing for c in found.channels} == dict(by_channel)
    numbers = sequences(tmp_path)
    assert (
        sum(
            holes(numbers[t.channel("b0")], n) for t, n in ((topics.FORCES, 400), (topics.RAW, 410))
        )
        == dropped
    )
    # The newest messages are kept.
    assert numbers["/tactile/b0/raw"][-1] == 409
    times = [m.log_ns for c, m in read_messages(tmp_path / "a.mcap") if c.topic.endswith("forces")]
    missing = sorted(set(range(BASE_NS, BASE_NS + 400)) - set(times))
    assert gaps[0].first_ns <= missing[0]
    assert gaps[-1].last_ns >= missing[-1]


def test_queue_is_bounded_in_bytes(tmp_path: Path, record: Any, disk: Any) -> None:
    recorder = record(tmp_path / "a.mcap", queue_bytes=10_000, chunk_bytes=1)
    disk.moving.clear()
    for i in range(100):
        recorder.write(topics.RAW, "b0", bytes(5000), BASE_NS + i, BASE_NS + i)
    stats = recorder.stats
    assert stats.dropped["queue_full"] >= 90
    assert stats.queued <= 4  # two in the queue, the rest in the writer


def test_writing_never_waits_for_a_hanging_disk(
    tmp_path: Path, record: Any, payloads: Any, disk: Any
) -> None:
    recorder = record(tmp_path / "a.mcap", queue_messages=100)
    disk.moving.clear()
    done = threading.Event()

    def write() -> None:
        for i in range(5000):
            recorder.write(topics.FORCES, "b0", payloads[topics.FORCES], BASE_NS + i, BASE_NS)
        recorder.attach("x", "text/plain", b"x")
        recorder.metadata("y", {"z": "1"})
        done.set()

    threading.Thread(target=write, daemon=True).start()
    assert done.wait(120)
    assert not recorder.close(0.2)  # it says that it could not


def test_full_disk_is_reported_and_recorded_in_the_next_file(
    tmp_path: Path,
    record: Any,
    payloads: Any,
    disk: Any,
    caplog: Any,
    logs: Any,
    sequences: Any,
) -> None:
    recorder = record(tmp_path)
    data = payloads[topics.FORCES]
    recorder.write(topics.FORCES, "b0", data, BASE_NS, BASE_NS)
    wait_until(lambda: recorder.stats.written == 1)
    with caplog.at_level(logging.ERROR):
        disk.room = 100  # the next chunk is partly written, then ENOSPC
        for i in range(1, 50):
            recorder.write(topics.FORCES, "b0", data, BASE_NS + i, BASE_NS + i)
        wait_until(lambda: recorder.stats.state == "disk_full")
    assert "No space left on device" in caplog.text
    assert "make room" in caplog.text
    assert "No space left on device" in recorder.stats.last_error
    disk.room = None
    wait_until(lambda: recorder.stats.written == 50)
    assert recorder.stats.state == "recording"
    assert recorder.close(60)
    first, *later = logs(tmp_path)
    assert later
    assert first.messages == 1  # nothing of the incomplete chunk
    assert first.damage_count == 0
    assert [g.reason for g in later[-1].gaps] == ["disk_full"]
    assert str(first.path) in later[-1].gaps[0].detail
    # The pending chunk was kept, so nothing is missing.
    assert recorder.stats.dropped == {}
    assert sequences(tmp_path)["/tactile/b0/forces"] == list(range(50))
    assert all(found.whole for found in later)


def test_messages_lost_to_a_full_disk_are_counted(
    tmp_path: Path, record: Any, payloads: Any, disk: Any, logs: Any, sequences: Any
) -> None:
    recorder = record(tmp_path, queue_messages=20)
    data = payloads[topics.FORCES]
    recorder.write(topics.FORCES, "b0", data, BASE_NS, BASE_NS)
    wait_until(lambda: recorder.stats.written == 1)
    disk.room = 0
    recorder.write(topics.FORCES, "b0", data, BASE_NS + 1, BASE_NS + 1)
    wait_until(lambda: recorder.stats.state == "disk_full")
    for i in range(2, 100):
        recorder.write(topics.FORCES, "b0", data, BASE_NS + i, BASE_NS + i)
    assert recorder.stats.dropped == {"disk_full": 78}
    disk.room = None
    wait_until(lambda: recorder.stats.queued == 0)
    assert recorder.close(60)
    found = logs(tmp_path)
    assert sum(gap.messages for log in found for gap in log.gaps) == 78
    assert holes(sequences(tmp_path)["/tactile/b0/forces"], 100) == 78


def test_io_error_ends_the_file_and_logging_continues_in_the_next(
    tmp_path: Path, record: Any, payloads: Any, disk: Any, logs: Any
) -> None:
    recorder = record(tmp_path)
    disk.error = errno.EIO
    disk.room = 0
    recorder.write(topics.LOG, "b0", payloads[topics.LOG], BASE_NS, BASE_NS)
    wait_until(lambda: recorder.stats.state == "io_error")
    assert recorder.stats.errors >= 1
    disk.room = None
    wait_until(lambda: recorder.stats.written == 1)
    assert recorder.close(60)
    assert [g.reason for log in logs(tmp_path) for g in log.gaps] == ["io_error"]


def test_disk_full_until_the_end_is_reported(
    tmp_path: Path, record: Any, payloads: Any, disk: Any
) -> None:
    recorder = record(tmp_path)
    disk.room = 0
    for i in range(5):
        recorder.write(topics.LOG, "b0", payloads[topics.LOG], BASE_NS + i, BASE_NS)
    assert not recorder.close(60)
    stats = recorder.stats
    assert stats.written == 0
    assert stats.dropped == {"disk_full": 5}


def test_logging_stops_before_the_disk_is_full_and_resumes(
    tmp_path: Path, record: Any, payloads: Any, disk: Any, caplog: Any, logs: Any
) -> None:
    recorder = record(tmp_path, min_free_bytes=1 << 30)
    recorder.write(topics.LOG, "b0", payloads[topics.LOG], BASE_NS, BASE_NS)
    wait_until(lambda: recorder.stats.written == 1)
    disk.free_bytes = (1 << 30) - 1
    with caplog.at_level(logging.ERROR):
        wait_until(lambda: recorder.stats.state == "low_space")
    assert "logs stop at 1.07" in caplog.text
    wait_until(lambda: logs(tmp_path)[0].whole)  # closed in order
    size = sum(path.stat().st_size for path in tmp_path.iterdir())
    recorder.write(topics.LOG, "b0", payloads[topics.LOG], BASE_NS + 1, BASE_NS)
    time.sleep(0.3)  # time for six flushes, any of which could write
    assert sum(path.stat().st_size for path in tmp_path.iterdir()) == size
    disk.free_bytes = 1 << 40
    wait_until(lambda: recorder.stats.written == 2)
    assert recorder.close(60)
    assert [g.reason for g in logs(tmp_path)[-1].gaps] == ["low_space"]


def test_stamps_use_the_clock_offset_taken_at_start(tmp_path: Path, record: Any) -> None:
    recorder = record(tmp_path / "a.mcap")
    recorder.close(60)
    offset = int(info(tmp_path / "a.mcap").metadata["software"]["clock_offset_ns"])
    assert abs(offset - WallClock.take().offset_ns) < 60e9


@pytest.mark.parametrize("pause_s", [0.001, 0.0])
def test_file_size_limit_is_handled_like_a_full_disk(
    tmp_path: Path, logs: Any, sequences: Any, pause_s: float
) -> None:
    """The kernel refuses bytes in the middle of a write: RLIMIT_FSIZE in a process of its own.

    Without a pause, the first file fails while far more data is queued than one file may hold.
    """
    limit = 40_000
    code = textwrap.dedent("""
        import os, sys, time
        from pathlib import Path
        from tactile_core.bus import topics
        from tactile_core.log.recorder import Recorder, RecorderSettings
        settings = RecorderSettings(
            min_free_bytes=0, flush_period=0.05, retry_seconds=0.05, chunk_bytes=8000
        )
        recorder = Recorder(Path(sys.argv[1]), settings)
        for i in range(400):
            recorder.write(topics.RAW, "b0", os.urandom(300), 10**18 + i, 10**18 + i)
            time.sleep(float(sys.argv[2]))
        closed = recorder.close(60)
        stats = recorder.stats
        print(closed, stats.written, stats.errors, sum(stats.dropped.values()))
    """)
    result = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path), str(pause_s)],
        capture_output=True,
        text=True,
        timeout=240,
        check=True,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit)),
    )
    closed, written, errors, dropped = result.stdout.split()
    assert (int(written), int(dropped)) == (400, 0)
    assert int(errors) >= 2
    assert "File too large" in result.stderr
    found = logs(tmp_path)
    # By chance the last messages leave no room for the summary of their file: `close` tells.
    assert closed == str(found[-1].whole)
    assert len(found) >= 3
    assert all(log.size <= limit for log in found)
    assert not any(log.damage_count for log in found)
    assert sequences(tmp_path)["/tactile/b0/raw"] == list(range(400))
