"""No input ends the log: it is refused or marked, and counted (rows 42, 43)."""

from __future__ import annotations

import errno
import os
import random
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from tactile_core.bus import topics
from tactile_core.bus.messages import MAX_PAYLOAD, header, stamp_ns
from tactile_core.log.info import info
from tactile_core.log.reader import read_messages
from tactile_core.log.recorder import MAX_CHANNELS, Recorder, RecorderSettings
from tactile_core.log.writer import OTHERS
from tactile_core.types import NS_PER_S, STAMP_END_NS, WallClock, utc_text
from tests.support.waiting import wait_until

BASE_NS = 1_700_000_000_000_000_000
ITEMS = int(os.environ.get("HOSTILE_ITEMS", "20000"))

STAMPS = (0, 1, -1, -(1 << 63), 1 << 62, (1 << 64) - 1, 1 << 64, -(10**30), 10**30, BASE_NS)
NAMES = ("b0", "b0", "b0", "b1", "a/b", "*", "", "x" * 65, "\x1b[2J", "grüße")
UNKNOWN = replace(topics.LOG, template="tactile/{name}/strange", msgtype="none/msg/Such")


def test_logging_survives_many_hostile_items(tmp_path: Path, record: Any, payloads: Any) -> None:
    rng = random.Random(42)
    recorder = record(tmp_path / "a.mcap", queue_messages=ITEMS * 2)
    kinds = (topics.LOG, topics.FEATURES, topics.GEOMETRY, UNKNOWN)
    data = (payloads[topics.LOG], b"", bytes(MAX_PAYLOAD + 1), "text", None, bytearray(4))
    for k in range(ITEMS):
        name = rng.choice(NAMES) if rng.random() < 0.9 else f"made_up_{k}"
        recorder.write(
            rng.choice(kinds), name, rng.choice(data), rng.choice(STAMPS), rng.choice(STAMPS)
        )
        if k % 1000 == 0:
            recorder.metadata(f"t{rng.randrange(3)}", {"\ud800": "\udfff"})
            recorder.attach("\udc80.toml", "a/b", rng.choice((b"x", None)))
    recorder.write(topics.LOG, "b0", payloads[topics.LOG], BASE_NS, BASE_NS)
    assert recorder.close(60)
    stats = recorder.stats
    assert stats.written + sum(stats.dropped.values()) == ITEMS + 1
    assert set(stats.dropped) == {
        "too_large", "not_bytes", "bad_name", "unknown_type", "too_many_channels"
    }  # fmt: skip
    found = info(tmp_path / "a.mcap")
    assert found.whole
    assert found.messages == stats.written > ITEMS // 8
    assert 200 < len(found.channels) <= MAX_CHANNELS
    # Every loss is in the log, by channel as far as one record names them.
    for reason, count in stats.dropped.items():
        gaps = [gap for gap in found.gaps if gap.reason == reason]
        assert sum(gap.messages for gap in gaps) == count
        assert sum(sum(gap.channels.values()) for gap in gaps) == count
    assert stats.marked > ITEMS // 16
    assert found.metadata["stamps"] == {"marked": str(stats.marked)}
    assert list(read_messages(tmp_path / "a.mcap"))[-1][1].log_ns == BASE_NS


def test_unrepresentable_stamp_is_replaced_by_log_time(
    tmp_path: Path, record: Any, payloads: Any
) -> None:
    recorder = record(tmp_path / "a.mcap")
    data = payloads[topics.LOG]
    recorder.write(topics.LOG, "b0", data, BASE_NS, -1)
    recorder.write(topics.LOG, "b0", data, BASE_NS + 1, 1 << 64)
    recorder.write(topics.LOG, "b0", data, BASE_NS + 2, 5)
    recorder.write(topics.LOG, "b0", data, -5, -5)
    assert recorder.close(60)
    stamps = [(m.log_ns, m.publish_ns) for _, m in read_messages(tmp_path / "a.mcap")]
    assert stamps[:3] == [(BASE_NS, BASE_NS), (BASE_NS + 1, BASE_NS + 1), (BASE_NS + 2, 5)]
    assert stamps[3][0] == stamps[3][1] > BASE_NS
    assert recorder.stats.marked == 3
    assert recorder.trouble is None


def test_gap_record_names_a_bounded_number_of_channels(
    tmp_path: Path, record: Any, logs: Any
) -> None:
    recorder = record(tmp_path / "a.mcap")
    for k in range(200):
        recorder.write(topics.RAW, f"b{k}", bytes(MAX_PAYLOAD + 1), BASE_NS, BASE_NS)
    assert recorder.close(60)
    (gap,) = logs(tmp_path)[0].gaps
    assert (gap.messages, len(gap.channels)) == (200, 65)
    assert gap.channels[OTHERS] == 136


@pytest.mark.parametrize("when", ["write", "open"])
def test_unexpected_writer_failure_opens_next_file_with_a_gap(
    tmp_path: Path, record: Any, payloads: Any, disk: Any, when: str, monkeypatch: Any
) -> None:
    recorder = record(tmp_path / "a.mcap")
    data = payloads[topics.LOG]
    recorder.write(topics.LOG, "b0", data, BASE_NS, BASE_NS)
    wait_until(lambda: recorder.stats.written == 1)
    if when == "open":
        monkeypatch.setattr(disk, "open", _fails_once(disk.open))
        disk.room, disk.error = 0, errno.EIO  # first a disk error, then the error under test
    else:
        monkeypatch.setattr(disk, "write", _fails_once(disk.write))
    recorder.write(topics.LOG, "b0", data, BASE_NS + 1, BASE_NS + 1)
    wait_until(lambda: "a bug" in recorder.stats.last_error)
    disk.room = None
    wait_until(lambda: recorder.stats.state == "recording")
    recorder.write(topics.LOG, "b0", data, BASE_NS + 2, BASE_NS + 2)
    recorder.close(60)
    stats = recorder.stats
    assert (stats.written, stats.dropped) == (2, {"writer_failed": 1})
    found = [info(path) for path in sorted(tmp_path.glob("*.mcap"))]
    gaps = [gap for each in found[1:] for gap in each.gaps if gap.reason == "writer_failed"]
    assert [(gap.messages, dict(gap.channels)) for gap in gaps] == [(1, {"/tactile/b0/log": 1})]
    assert "a bug" in gaps[0].detail
    assert sum(each.messages for each in found) == 2
    assert "misses 1 messages" in (recorder.trouble or "")


def _fails_once(real: Callable[..., Any]) -> Callable[..., Any]:
    told = []

    def wrapped(*words: Any) -> Any:
        if not told:
            told.append(True)
            raise RuntimeError("a bug")
        return real(*words)

    return wrapped


def test_deleted_log_is_continued_in_another_file(
    tmp_path: Path, record: Any, payloads: Any
) -> None:
    folder = tmp_path / "logs"
    recorder = record(folder / "a.mcap")
    (folder / "a.mcap").unlink()
    folder.rmdir()
    sent = 0

    def again() -> bool:
        nonlocal sent
        sent += 1
        recorder.write(topics.LOG, "b0", payloads[topics.LOG], BASE_NS + sent, BASE_NS + sent)
        return recorder.stats.files == 2 and recorder.stats.state == "recording"

    wait_until(again)
    assert recorder.close(60)
    (path,) = folder.glob("*.mcap")
    found = info(path)
    assert found.messages > 0
    assert [gap.reason for gap in found.gaps] == ["io_error"]
    assert "deleted or moved" in (recorder.trouble or "")


DAY_NS = 86_400 * NS_PER_S


@pytest.mark.parametrize(
    ("wall_ns", "named"),
    [
        (-DAY_NS, "tactile_19"),  # 1970 and how long the machine has been up
        (-(10**18), "tactile_19"),
        (STAMP_END_NS + DAY_NS, "tactile_20380120T"),
        ((1 << 63) - 10**12, "tactile_2262"),
    ],
)
def test_log_is_written_at_any_system_time(
    tmp_path: Path, payloads: Any, wall_ns: int, named: str
) -> None:
    import time

    clock = WallClock.reading(wall_ns, time.monotonic_ns())
    recorder = Recorder(tmp_path, RecorderSettings(min_free_bytes=0), clock=clock)
    now_ns = clock.wall_ns(time.monotonic_ns())  # type: ignore[arg-type]
    recorder.write(topics.LOG, "b0", payloads[topics.LOG], now_ns, now_ns)
    assert recorder.close(60)
    (path,) = tmp_path.glob("*.mcap")
    assert path.name.startswith(named)
    found = info(path)
    assert found.messages == 1
    assert recorder.stats.marked == 0
    assert found.metadata["software"]["clock_problem"] == clock.problem
    assert "the system clock reads" in clock.problem
    if wall_ns > 0:
        assert found.channels[0].first_ns == pytest.approx(wall_ns, abs=60 * NS_PER_S)


def test_header_has_no_time_rather_than_a_wrong_one() -> None:
    for wall_ns in (-1, -(10**30), STAMP_END_NS, 10**30):
        assert stamp_ns(header(wall_ns, "").stamp) == 0
    last = STAMP_END_NS - 1
    assert stamp_ns(header(last, "").stamp) == last
    assert WallClock.reading(BASE_NS, 7).problem == ""


def test_any_time_can_be_formatted() -> None:
    assert utc_text(-1) == "1969-12-31 23:59:59"
    assert utc_text(STAMP_END_NS) == "2038-01-19 03:14:08"
    assert utc_text(10**40) == "9999-12-31 00:00:00"
    assert utc_text(-(10**40)) == "1000-01-01 00:00:00"
