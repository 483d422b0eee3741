"""Logs as arrays: columns, shapes for pandas, and one sentence for unreadable files."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import tactile_reach as tr
from tactile_core.bus.messages import MSG, codec, header
from tactile_core.bus.topics import FEATURES, FORCES, LOG, Topic
from tactile_core.log.recorder import Recorder

START_NS = 1_700_000_000_000_000_000


def features(sequence: int, normal: float, patches: int = 0):
    zero, here = MSG.Vector3(0.0, 0.0, 0.0), MSG.Point(0.0, 0.0, 0.0)
    return MSG.ContactFeatures(
        header=header(START_NS, "ee"), captured_ns=0, received_ns=0, uncertainty=0.0,
        sequence=sequence, valid=True, reasons=[], calibrated=True, peak_force=normal, peak_side=1,
        peak_position=here, normal_force=normal,
        wrench=MSG.Wrench(MSG.Vector3(1.0, 2.0, 3.0), zero),
        tip_force=0.0, tip_contact_time=0.0, taxels_in_contact=0, taxels_masked=0,
        patches=[MSG.ContactPatch(0, 1, 1, normal, normal, zero, here, zero, 0.1)] * patches,
        reason_codes=[], peak_force_bound=0.1, normal_force_bound=0.1, tip_force_bound=0.1,
    )  # fmt: skip


def forces(taxels: int):
    return MSG.TaxelForces(
        header=header(START_NS, "ee"), captured_ns=0, received_ns=0, uncertainty=0.0, sequence=1,
        array_taxels=np.array([taxels], np.uint16), force=np.ones(3 * taxels, np.float32),
        status=np.zeros(taxels, np.uint8), compensated=True, calibrated=True,
        normal_bound=np.zeros(taxels, np.float32),
    )  # fmt: skip


@pytest.fixture
def write(tmp_path: Path) -> Callable[..., Path]:
    def make(*messages: tuple[Topic, object], name: str = "log.mcap") -> Path:
        recorder = Recorder(tmp_path / name)
        for i, (topic, message) in enumerate(messages):
            data = codec().encode(topic, message)
            recorder.write(topic, "left", data, START_NS + i * 10_000_000, START_NS)
        assert recorder.close(60.0)
        return tmp_path / name

    return make


def test_columns_match_written_values(write: Callable[..., Path]) -> None:
    path = write(*((FEATURES, features(i, 0.5 * i, i)) for i in range(4)), (FORCES, forces(5)))
    log = tr.read_log(path)
    assert sorted(log) == ["/tactile/left/features", "/tactile/left/forces"]
    table = log["tactile/left/features"]
    assert table["normal_force"].tolist() == [0.0, 0.5, 1.0, 1.5]
    assert table["wrench.force.y"].tolist() == [2.0] * 4
    assert table["header.stamp_ns"].tolist() == [START_NS] * 4
    assert [len(patches) for patches in table["patches"]] == [0, 1, 2, 3]
    assert table.time_s == pytest.approx([0.0, 0.01, 0.02, 0.03])
    assert log.board("left")["forces"]["force"].shape == (1, 15)
    assert log.start_ns == START_NS
    assert log.closed


def test_lists_of_different_lengths_are_objects(write: Callable[..., Path]) -> None:
    log = tr.read_log(write((FORCES, forces(3)), (FORCES, forces(5))))
    assert [len(each) for each in log["/tactile/left/forces"]["force"]] == [9, 15]


def test_only_requested_topics_are_read(write: Callable[..., Path]) -> None:
    path = write((FEATURES, features(1, 1.0)), (FORCES, forces(3)))
    assert list(tr.read_log(path, ["tactile/left/forces"])) == ["/tactile/left/forces"]


def test_missing_topic_or_column_lists_available_ones(write: Callable[..., Path]) -> None:
    log = tr.read_log(write((FEATURES, features(1, 1.0))))
    with pytest.raises(KeyError, match=r"available: /tactile/left/features"):
        log["/tactile/right/features"]
    with pytest.raises(KeyError, match=r"no board 'right' .*available: left"):
        log.board("right")
    with pytest.raises(KeyError, match=r"no column 'force'.*normal_force"):
        log["/tactile/left/features"]["force"]


def test_unreadable_file_gives_one_sentence(write: Callable[..., Path], tmp_path: Path) -> None:
    no_log = tmp_path / "no.mcap"
    no_log.write_text("no log")
    for path, said in (
        (no_log, "no.mcap"), (tmp_path / "none.mcap", "none.mcap"),
        (write(name="empty.mcap"), "holds no messages"),
    ):  # fmt: skip
        with pytest.raises(tr.TactileError, match=said):
            tr.read_log(path)
    path = write((LOG, MSG.Log(MSG.Time(0, 0), 20, "a", "b", "", "", 0)), name="other.mcap")
    with pytest.raises(tr.TactileError, match="nothing of those topics"):
        tr.read_log(path, ["tactile/left/features"])
