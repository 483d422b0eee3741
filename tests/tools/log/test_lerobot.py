"""Logs as a LeRobot data set: contents of its frames, and LeRobot's own loader if there is one."""

from __future__ import annotations

import json
import os
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

from tactile_core.bus.commanding import command_message
from tactile_core.bus.messages import MSG, codec, header
from tactile_core.bus.topics import COMMAND, FEATURES, FORCES, GEOMETRY
from tactile_core.log.recorder import Recorder
from tactile_core.types import Instant, Twist

BASE_NS = 1_700_000_000_000_000_000
PYTHON = "TACTILE_LEROBOT_PYTHON"
"""Names an interpreter that has lerobot-dataset and torch."""


def forces(at_ns: int, value: float, taxels: int = 2) -> Any:
    force = np.full(3 * taxels, value, np.float32)
    return MSG.TaxelForces(
        header=header(at_ns, "ee"), captured_ns=at_ns, received_ns=at_ns, uncertainty=0.0,
        sequence=0, array_taxels=np.array([taxels], np.uint16), force=force,
        status=np.zeros(taxels, np.uint8), compensated=True, calibrated=True,
        normal_bound=np.zeros(taxels, np.float32),
    )  # fmt: skip


def features(at_ns: int, normal: float, *, valid: bool = True) -> Any:
    zero = MSG.Vector3(0.0, 0.0, 0.0)
    return MSG.ContactFeatures(
        header=header(at_ns, "ee"), captured_ns=at_ns, received_ns=at_ns, uncertainty=0.0,
        sequence=0, valid=valid, reasons=[], calibrated=True, peak_force=normal, peak_side=3,
        peak_position=MSG.Point(0.1, 0.0, 0.0), normal_force=normal,
        wrench=MSG.Wrench(zero, zero), tip_force=0.0, tip_contact_time=0.0, taxels_in_contact=1,
        taxels_masked=0, patches=[], reason_codes=[], peak_force_bound=0.1,
        normal_force_bound=0.1, tip_force_bound=0.1,
    )  # fmt: skip


def geometry(taxels: int = 2) -> Any:
    zeros = np.zeros(3 * taxels, np.float32)
    return MSG.SkinGeometry(
        header=header(BASE_NS, "ee"), serial_number="1", model="pad", array_name=["pad"],
        array_side=np.array([3], np.uint8), array_rows=np.array([1], np.uint16),
        array_columns=np.array([taxels], np.uint16), position=zeros, normal=zeros,
        surface=np.zeros(2 * taxels, np.float32), array_posed=np.array([True]),
    )  # fmt: skip


Write = Callable[..., Path]


@pytest.fixture
def write(tmp_path: Path) -> Write:
    """``write(name)``: one second of a pad whose force in N is the time in s, at 100 Hz."""

    def make(
        name: str,
        seconds: float = 1.0,
        *,
        taxels: int = 2,
        board: str = "pad",
        command: bool = True,
        touch: bool = True,
        nan_from: float = np.inf,
        silent_from: float = np.inf,
    ) -> Path:
        path = tmp_path / name
        recorder = Recorder(path)
        if touch:
            data = codec().encode(GEOMETRY, geometry(taxels))
            recorder.write(GEOMETRY, board, data, BASE_NS, BASE_NS)
        for step in range(round(seconds * 100)):
            t, at = step / 100, BASE_NS + step * 10_000_000
            value = np.nan if t >= nan_from else t
            if touch:
                data = codec().encode(FORCES, forces(at, value, taxels))
                recorder.write(FORCES, board, data, at, at)
            if touch and t < silent_from:
                recorder.write(FEATURES, board, codec().encode(FEATURES, features(at, t)), at, at)
            if command:
                message = command_message(Twist(t, -t, 0.5), Instant(at), 0.06, at)
                recorder.write(COMMAND, "arm", codec().encode(COMMAND, message), at, at)
        assert recorder.close(60)
        return path

    return make


def table(folder: Path) -> Any:
    return pq.read_table(folder / "data/chunk-000/file-000.parquet")


def test_frames_hold_what_was_known_at_their_time(
    write: Write, log_tool: Callable[..., Any], tmp_path: Path
) -> None:
    out = tmp_path / "ds"
    done = log_tool("export", write("a.mcap"), "--format", "lerobot", "--out", out, "--fps", "20")
    assert done.code == 0, done.err
    rows = table(out)
    tactile = np.array(rows["observation.tactile"].to_pylist())
    times = np.array(rows["timestamp"].to_pylist())
    assert tactile.shape[1] == 6
    assert times == pytest.approx(np.arange(len(times)) / 20, abs=1e-6)
    # The force equals the time: it is never ahead of the clock, nor more than two periods behind.
    late = times - (tactile[:, 0] - tactile[0, 0])
    assert (np.abs(late) <= 0.0101).all()
    assert (np.diff(tactile[:, 0]) > 0).all()
    contact = np.array(rows["observation.contact"].to_pylist())
    assert (contact[:, 0] == 1.0).all()
    assert contact[:, 1] == pytest.approx(tactile[:, 0], abs=0.011)
    action = np.array(rows["action"].to_pylist())
    assert action[:, 0] == pytest.approx(tactile[:, 0], abs=0.011)
    assert (action[:, 2] == 0.5).all()


def test_info_says_what_every_number_is(
    write: Write, log_tool: Callable[..., Any], tmp_path: Path
) -> None:
    out = tmp_path / "ds"
    log_tool("export", write("a.mcap"), "--format", "lerobot", "--out", out, "--task", "press")
    info = json.loads((out / "meta/info.json").read_text())
    assert info["codebase_version"] == "v3.0"
    assert info["fps"] == 50
    tactile = info["features"]["observation.tactile"]
    assert tactile["names"][:4] == ["pad.pad.0.x", "pad.pad.0.y", "pad.pad.0.z", "pad.pad.1.x"]
    assert info["total_frames"] == table(out).num_rows
    tasks = pq.read_table(out / "meta/tasks.parquet").to_pydict()
    assert tasks == {"task_index": [0], "__index_level_0__": ["press"]}


def test_several_logs_are_episodes(
    write: Write, log_tool: Callable[..., Any], tmp_path: Path
) -> None:
    out = tmp_path / "ds"
    logs = [write("a.mcap"), write("b.mcap", 0.5)]
    assert log_tool("export", *logs, "--format", "lerobot", "--out", out).code == 0
    episodes = pq.read_table(out / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    rows = table(out).to_pydict()
    assert [e["episode_index"] for e in episodes] == [0, 1]
    assert sum(e["length"] for e in episodes) == len(rows["index"])
    assert rows["index"] == list(range(len(rows["index"])))
    second = episodes[1]
    assert rows["frame_index"][second["dataset_from_index"]] == 0
    assert second["dataset_to_index"] == len(rows["index"])
    stats = json.loads((out / "meta/stats.json").read_text())
    values = np.array(rows["observation.tactile"])
    assert stats["observation.tactile"]["mean"] == pytest.approx(values.mean(axis=0), rel=1e-5)
    assert stats["observation.tactile"]["std"] == pytest.approx(values.std(axis=0), rel=1e-4)
    assert stats["observation.tactile"]["count"] == [len(values)]


def test_masked_taxels_become_zero_and_are_counted(
    write: Write, log_tool: Callable[..., Any], tmp_path: Path
) -> None:
    out = tmp_path / "ds"
    done = log_tool("export", write("a.mcap", nan_from=0.5), "--format", "lerobot", "--out", out)
    assert done.code == 0
    assert "not finite" in done.out
    assert np.isfinite(np.array(table(out)["observation.tactile"].to_pylist())).all()


def test_stale_touch_is_marked_as_not_valid(
    write: Write, log_tool: Callable[..., Any], tmp_path: Path
) -> None:
    out = tmp_path / "ds"
    log_tool("export", write("a.mcap", silent_from=0.4), "--format", "lerobot", "--out", out)
    valid = [row[0] for row in table(out)["observation.contact"].to_pylist()]
    assert valid[0] == 1.0
    assert valid[-1] == 0.0


def test_logs_that_differ_are_refused(
    write: Write, log_tool: Callable[..., Any], tmp_path: Path
) -> None:
    logs = [write("a.mcap"), write("b.mcap", taxels=3)]
    done = log_tool("export", *logs, "--format", "lerobot", "--out", tmp_path / "ds")
    assert done.code == 2
    assert "observation.tactile has 9 values, not 6" in done.err
    assert not (tmp_path / "ds").exists()


def test_log_without_touch_is_refused(
    write: Write, log_tool: Callable[..., Any], tmp_path: Path
) -> None:
    log = write("a.mcap", touch=False)
    done = log_tool("export", log, "--format", "lerobot", "--out", tmp_path / "ds")
    assert done.code == 2
    assert "nothing to export" in done.err


@pytest.mark.parametrize("fps", ["0", "2.5", "many", "5000"])
def test_impossible_rates_are_refused(write: Write, log_tool: Callable[..., Any], fps: str) -> None:
    done = log_tool("export", write("a.mcap"), "--format", "lerobot", "--fps", fps)
    assert done.code == 2
    assert "a whole number from 1 to 1000" in done.err


def test_only_exports_are_overwritten(
    write: Write, log_tool: Callable[..., Any], tmp_path: Path
) -> None:
    out, log = tmp_path / "ds", write("a.mcap")
    out.mkdir()
    (out / "mine.txt").write_text("keep")
    assert log_tool("export", log, "--format", "lerobot", "--out", out, "--force").code == 2
    assert (out / "mine.txt").read_text() == "keep"
    other = tmp_path / "other"
    assert log_tool("export", log, "--format", "lerobot", "--out", other).code == 0
    assert log_tool("export", log, "--format", "lerobot", "--out", other).code == 2
    assert log_tool("export", log, "--format", "lerobot", "--out", other, "--force").code == 0


def test_lerobots_own_loader_reads_the_data_set(
    write: Write, log_tool: Callable[..., Any], tmp_path: Path
) -> None:
    python = os.environ.get(PYTHON)
    if python is None:
        pytest.skip(f"{PYTHON} does not name an interpreter with lerobot-dataset")
    out = tmp_path / "ds"
    logs = [write("a.mcap"), write("b.mcap", 0.5)]
    assert (
        log_tool("export", *logs, "--format", "lerobot", "--out", out, "--task", "press").code == 0
    )
    script = Path(__file__).with_name("read_lerobot.py")
    done = subprocess.run(
        [python, script, out],
        capture_output=True,
        text=True,
        check=False,
        env=os.environ | {"HF_HUB_OFFLINE": "1", "HF_DATASETS_CACHE": str(tmp_path / "hf")},
    )
    assert done.returncode == 0, done.stderr
    said = json.loads(done.stdout.splitlines()[-1])
    rows = table(out).to_pydict()
    assert said["frames"] == len(rows["index"])
    assert said["episodes"] == 2
    assert said["fps"] == 50
    assert said["task"] == "press"
    assert said["names"][0] == "pad.pad.0.x"
    assert said["first"] == rows["observation.tactile"][0]
    assert said["last"] == rows["observation.tactile"][-1]
    assert said["action"] == rows["action"][0]
    assert said["window"] == [2, 6]
    assert said["mean"] == pytest.approx(np.mean(rows["observation.tactile"], axis=0), rel=1e-4)
