"""The pipeline again over a log: bit for bit the same after any event, or with new settings."""

from __future__ import annotations

import os
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from sim_device.board.firmware import ClockParameters
from sim_device.faults import FaultPlan
from tactile_core.bus.messages import codec
from tactile_core.bus.topics import FEATURES
from tactile_core.calibration import save
from tactile_core.log.info import info
from tactile_core.log.reader import read_messages
from tactile_core.log.recorder import RecorderSettings
from tactiled.sensing.settings import PipelineSettings
from tests.support import virtual_daemon as virtual

COUNTED = re.compile(r"^(\S+): (\d+) messages, (\d+) in the log; (\d+) bit for bit the same$", re.M)


def counts(out: str) -> dict[str, tuple[int, int, int]]:
    return {row[0]: (int(row[1]), int(row[2]), int(row[3])) for row in COUNTED.findall(out)}


def all_same(outcome: Any, least: int, board: str = "finger") -> None:
    assert outcome.code == 0, outcome.err
    found = counts(outcome.out)
    for topic in ("features", "forces", "field", "ambient", "contacts"):
        new, old, same = found[f"/tactile/{board}/{topic}"]
        assert new == old == same, (topic, outcome.out)
    assert found[f"/tactile/{board}/features"][0] >= least
    assert "estimated anew" not in outcome.out


def features(path: Path, board: str = "finger") -> list[Any]:
    topic = FEATURES.channel(board)
    return [codec().decode(FEATURES, m.data) for _, m in read_messages(path, {topic})]


@pytest.fixture(scope="module")
def pressed_log(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    path = tmp_path_factory.mktemp("pressed") / "run.mcap"
    board = virtual.make_board(contacts=virtual.press, clock=ClockParameters(error=0.03))
    daemon = virtual.VirtualDaemon(path, [board], [virtual.calibration()])
    daemon.run(2.0)
    daemon.close()
    return path.read_bytes()


@pytest.fixture
def pressed(pressed_log: bytes, tmp_path: Path) -> Path:
    path = tmp_path / "run.mcap"
    path.write_bytes(pressed_log)
    return path


def test_the_same_settings_give_the_same_bytes(log_tool: Any, pressed: Path) -> None:
    all_same(log_tool("reprocess", pressed), 150)
    out = pressed.with_name("run_reprocessed.mcap")
    found = info(out)
    assert found.whole
    assert found.metadata["reprocessed"]["timing"] == "as recorded"
    assert {c.topic: c.messages for c in found.channels} == {
        c.topic: c.messages for c in info(pressed).channels
    }
    assert found.attachments.keys() == info(pressed).attachments.keys()
    # The result is a log like any other, so it can be reprocessed again.
    all_same(log_tool("reprocess", out, "--out", out.with_name("third.mcap")), 150)


def test_reprocessing_is_exact_after_any_event(log_tool: Any, tmp_path: Path) -> None:
    """Bad wire, tare, new rate, silence, unplugging, reset, a stalled pipeline, a recalibration."""
    path = tmp_path / "run.mcap"
    plan = FaultPlan(seed=3, flip=2e-5, loss=0.01, duplicate=0.01, reorder=0.01, reset=(4.9,))
    board = virtual.make_board(plan=plan, clock=ClockParameters(error=-0.02), rate=50.0)
    first = virtual.calibration()
    daemon = virtual.VirtualDaemon(path, [board], [first], inbox=20)
    daemon.run(1.0)
    report = daemon.tare()
    daemon.run(0.8)
    assert report.done()
    daemon.set_rate(60.0)
    daemon.run(0.6)
    daemon.stalled = True
    daemon.run(0.8)  # more than the queue holds
    daemon.stalled = False
    daemon.run(0.4)
    assert daemon.inbox.dropped > 0
    daemon.unplug()
    daemon.run(0.5)
    daemon.open()
    daemon.run(1.0)
    arrays = tuple(replace(a, newton_per_ut=a.newton_per_ut * 1.5) for a in first.arrays)
    daemon.recalibrate(replace(first, arrays=arrays))
    daemon.run(1.2)
    daemon.close()
    kinds = {
        codec().decode("tactile_msgs/msg/PortEvent", m.data).kind
        for _, m in read_messages(path, {"/tactile/finger/port"})
    }
    assert kinds >= {
        "opened", "lost", "tick", "skipped", "tare", "set_rate", "recalibrate", "worked", "ended"
    }  # fmt: skip
    all_same(log_tool("reprocess", path), 120)


def test_boards_on_a_can_bus_in_split_files(log_tool: Any, tmp_path: Path) -> None:
    boards = [virtual.make_can_board(seed, node, rate=50.0) for seed, node in ((7, 3), (8, 4))]
    small = RecorderSettings(min_free_bytes=0, split_bytes=40_000, flush_period=0.02)
    daemon = virtual.VirtualDaemon(
        tmp_path / "bus.mcap", boards, [virtual.calibration(7)], recorder=small
    )
    daemon.run(1.6)
    daemon.close()
    assert log_tool("split", tmp_path / "bus", "--every", "0.5").code == 0
    parts = tmp_path / "bus_split"
    assert len(list(parts.iterdir())) > 2
    outcome = log_tool("reprocess", parts, "--out", tmp_path / "o.mcap")
    all_same(outcome, 40, "finger-3")
    all_same(outcome, 40, "finger-4")


def test_new_settings_and_calibrations_give_new_features(
    log_tool: Any, pressed: Path, tmp_path: Path
) -> None:
    first = virtual.calibration()
    arrays = tuple(replace(a, newton_per_ut=a.newton_per_ut * 2) for a in first.arrays)
    save(replace(first, arrays=arrays), tmp_path / "new.cal.toml")
    out = tmp_path / "new.mcap"
    given = ("--calibration", tmp_path / "new.cal.toml", "--out", out)
    outcome = log_tool("reprocess", pressed, *given)
    assert outcome.code == 0, outcome.err
    new, old, same = counts(outcome.out)["/tactile/finger/features"]
    assert new == old
    assert same < new  # without contact both give 0 N, bit for bit
    before, after = features(pressed)[-1], features(out)[-1]
    assert after.peak_force == pytest.approx(2 * before.peak_force, rel=0.1)
    assert info(out).attachments["finger.cal.toml"][1] != info(pressed).attachments
    # The new log holds the new calibration: reprocessed alone it gives the same.
    all_same(log_tool("reprocess", out, "--out", tmp_path / "again.mcap"), 150)
    slow = log_tool(
        "reprocess", pressed, "--feature-rate", "15", "--compensation", "off", "--out",
        tmp_path / "slow.mcap",
    )  # fmt: skip
    rows = counts(slow.out)
    assert rows["/tactile/finger/ambient"][0] == 0
    assert 18 < rows["/tactile/finger/features"][0] < 40
    assert info(tmp_path / "slow.mcap").metadata["pipeline"]["feature_rate_hz"] == "15.0"
    config = tmp_path / "c.toml"
    config.write_text("[sensing]\ncontact_minimum_n = 5.0\n")
    high = log_tool("reprocess", pressed, "--config", config, "--out", tmp_path / "high.mcap")
    assert high.code == 0
    assert not any(f.patches for f in features(tmp_path / "high.mcap"))


def test_truncated_log_reprocesses_its_bytes(log_tool: Any, pressed: Path, tmp_path: Path) -> None:
    data = pressed.read_bytes()
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(data[: len(data) * 4 // 5])
    outcome = log_tool("reprocess", cut)
    assert outcome.code == 0, outcome.err
    new, old, same = counts(outcome.out)["/tactile/finger/features"]
    # Raw bytes may be logged before the features made of them, and never after.
    assert new >= old == same > 20
    assert "not closed" in outcome.out


def test_log_without_its_beginning_is_reprocessed_passively(log_tool: Any, tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    board = virtual.make_board(rate=50.0)
    daemon = virtual.VirtualDaemon(path, [board], [virtual.calibration()])
    daemon.run(0.6)
    daemon.unplug()
    daemon.run(0.1)
    daemon.open()  # the board is then asked for its identity
    daemon.run(0.8)
    daemon.close()
    assert log_tool("split", path, "--at", "0.5").code == 0
    outcome = log_tool("reprocess", tmp_path / "run_split" / "run_0001.mcap")
    assert outcome.code == 0, outcome.err
    assert "estimated anew" in outcome.out
    assert 20 < counts(outcome.out)["/tactile/finger/features"][0] < 60


def without_state(part: Path, out: Path) -> None:
    """The part as earlier versions wrote it, with less about its boards."""
    from tactile_core.log.records import MetadataRecord
    from tactile_tools.log.sources import find_series
    from tactile_tools.log.stream import Reading, Record, read_series
    from tactile_tools.log.writing import LogOutput

    with LogOutput(out) as output:
        for item in read_series(find_series([part])[0], Reading()):
            if isinstance(item, Record):
                output.write(item)
            elif not isinstance(item, MetadataRecord):
                output.attach(item)
            elif not item.name.startswith("state:"):
                output.metadata(item.name, item.values)


@pytest.mark.parametrize("medium", ["serial", "can"])
def test_later_file_alone_is_reprocessed_from_its_own_records_or_refused(
    log_tool: Any, tmp_path: Path, medium: str
) -> None:
    path = tmp_path / "run.mcap"
    contacts = {"contacts": virtual.press}
    if medium == "can":
        boards = [virtual.make_can_board(7, 3, rate=50.0, **contacts)]
    else:
        boards = [virtual.make_board(rate=50.0, **contacts)]
    daemon = virtual.VirtualDaemon(
        path, boards, [virtual.calibration()], PipelineSettings(auto_tare=True)
    )
    daemon.run(2.6)
    daemon.close()
    assert log_tool("split", path, "--at", "1.7").code == 0  # pressed: too late to tare
    part, out = tmp_path / "run_split" / "run_0001.mcap", tmp_path / "out.mcap"
    outcome = log_tool("reprocess", part, "--out", out)
    assert outcome.code == 0, outcome.err
    before, after = features(part), features(out)
    assert len(after) > 10
    valid = [f for f in after if f.valid]
    assert len(valid) > 5
    assert valid[-1].peak_force == pytest.approx(before[-1].peak_force, rel=0.05)
    assert before[-1].peak_force > 0.5
    out.unlink()
    old = tmp_path / "old.mcap"
    without_state(part, old)
    refused = log_tool("reprocess", old, "--out", out)
    assert refused.code == 1
    assert "does not say which board sent them" in refused.err.replace("\n", " ")
    assert {p.name for p in tmp_path.iterdir()} == {"run.mcap", "run_split", "old.mcap"}


def test_every_file_holds_what_reprocessing_needs(log_tool: Any, tmp_path: Path) -> None:
    small = RecorderSettings(min_free_bytes=0, split_bytes=700_000, flush_period=0.02)
    daemon = virtual.VirtualDaemon(
        tmp_path / "run.mcap", [virtual.make_board()], [virtual.calibration()], recorder=small
    )
    daemon.run(2.0)
    daemon.close()
    files = sorted(tmp_path.glob("run_*.mcap"))
    assert files
    tables = info(files[-1]).metadata
    assert tables.keys() >= {"pipeline", "port:finger", "board:finger", "state:finger"}
    assert tables["state:finger"]["descriptor"]
    assert tables["state:finger"]["rest"]


def test_log_that_cannot_be_reprocessed_is_refused(
    log_tool: Any, pressed: Path, recorded: Any, tmp_path: Path
) -> None:
    other = tmp_path / "other.cal.toml"
    save(virtual.calibration(99), other)
    silent = recorded(tmp_path / "reach.mcap", 0.1)
    bad = tmp_path / "bad.toml"
    bad.write_text("[sensing]\ntare_s = -1\n")
    pressed.with_name("run_reprocessed.mcap").touch()
    for words, text in (
        ((pressed, "--calibration", other, "--out", tmp_path / "o.mcap"), "fits none in"),
        ((pressed, "--calibration", bad, "--out", tmp_path / "o.mcap"), "bad.toml"),
        ((pressed, "--config", bad, "--out", tmp_path / "o.mcap"), "tare_s"),
        ((pressed, "--feature-rate", "-3", "--out", tmp_path / "o.mcap"), "of Hz above 0"),
        ((silent,), "holds no raw bytes"),
        ((pressed, silent, "--out", tmp_path / "o.mcap"), "2 logs given"),
        ((pressed,), "exists and is not overwritten"),
        ((pressed, "--out", pressed, "--force"), "is what is read"),
    ):
        outcome = log_tool("reprocess", *words)
        assert outcome.code == 2, outcome
        assert text in outcome.err
    assert not (tmp_path / "o.mcap").exists()


def test_newer_settings_are_named(log_tool: Any, tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    daemon = virtual.VirtualDaemon(path, [virtual.make_board()], [virtual.calibration()])
    daemon.recorder.metadata("pipeline", {"method": '"off"', "quantum": "1"})
    daemon.run(0.3)
    daemon.close()
    outcome = log_tool("reprocess", path)
    assert outcome.code == 2
    assert "quantum" in outcome.err
    assert "update tactile-reach" in outcome.err
    assert PipelineSettings().method == "consensus"


@pytest.mark.parametrize("flag", ["--config", "--calibration"])
def test_log_with_unreadable_calibration_is_not_reprocessed(
    pressed: Path, log_tool: Any, tmp_path: Path, flag: str
) -> None:
    os.mkfifo(tmp_path / "pipe.toml")
    (tmp_path / "zero.toml").symlink_to("/dev/zero")
    (tmp_path / "number.toml").write_text("rate = " + "9" * 200_000)
    (tmp_path / "deep.toml").write_text("a = " + "[" * 100_000)
    for name in ("pipe", "zero", "number", "deep"):
        outcome = log_tool(
            "reprocess", pressed, flag, tmp_path / f"{name}.toml", "--out", tmp_path / "o.mcap"
        )
        assert outcome.code == 2, outcome
        assert f"{name}.toml" in outcome.err
        assert len(outcome.err.strip().splitlines()) == 1, outcome
