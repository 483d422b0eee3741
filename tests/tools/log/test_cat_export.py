"""Contents of a log as text for people and programs, and as tables."""

from __future__ import annotations

import csv
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet
import pytest

from tactile_core.bus import topics
from tactile_core.log.recorder import RecorderSettings

FEATURES, COMMAND, EVENT = "/tactile/finger/features", "/arm/arm/cmd_vel", "/reach/reach/event"


# cat


def test_cat_prints_every_message_for_people_and_machines(
    log_tool: Any, recorded: Any, tmp_path: Path, rows_of: Any
) -> None:
    path = recorded(tmp_path / "run.mcap")
    people = log_tool("cat", path)
    assert people.code == 0
    assert len(people.out.splitlines()) == 202
    row = next(line for line in people.out.splitlines() if FEATURES in line)
    assert "peak_force=" in row
    assert "wrench={force=(0, 0, 0) torque=(0, 0, 0)}" in row
    machines = rows_of(log_tool("cat", path, "--json").out)
    assert len(machines) == 202
    first = next(row for row in machines if row["topic"] == EVENT)
    assert first["message"]["text"] == "grüße, “quoted”"
    assert first["type"] == "tactile_msgs/msg/ReachEvent"
    assert isinstance(first["message"]["header"]["stamp"], int)


def test_cat_picks_topics_and_times(
    log_tool: Any, recorded: Any, tmp_path: Path, rows_of: Any
) -> None:
    path = recorded(tmp_path / "run.mcap")
    rows = rows_of(log_tool("cat", path, "--json", "--topic", "arm/*").out)
    assert {row["topic"] for row in rows} == {COMMAND}
    rows = rows_of(
        log_tool("cat", path, "--json", "--topic", "*features", "--from", "0.2", "--to", "0.4").out
    )
    assert len(rows) == 21
    span = ("--from", "2023-11-14T22:13:20.5", "--to", "2023-11-14T23:13:20.599+01:00")
    rows = rows_of(log_tool("cat", path, "--json", "--topic", FEATURES, *span).out)
    assert len(rows) == 10
    assert len(log_tool("cat", path, "--limit", "3").out.splitlines()) == 3
    assert "2023-11-14 22:13:20.001Z" in log_tool("cat", path, "--absolute", "--limit", "1").out


def test_cat_into_a_closed_pipe_ends_quietly(recorded: Any, tmp_path: Path) -> None:
    path = recorded(tmp_path / "run.mcap", 3.0)
    command = f"{sys.executable} -m tactile_tools.cli log cat {path} | head -2"
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True, check=False)
    assert len(done.stdout.splitlines()) == 2
    assert "Traceback" not in done.stderr
    assert "Exception" not in done.stderr


# export


@pytest.mark.parametrize("cut", [False, True])
def test_exports_contain_every_value_of_the_log(
    log_tool: Any, recorded: Any, tmp_path: Path, cut: bool, rows_of: Any
) -> None:
    path = recorded(tmp_path / "run.mcap", 1.0, chunk_bytes=4096)
    if cut:
        data = path.read_bytes()
        path.write_bytes(data[: len(data) // 2])
    rows = rows_of(log_tool("cat", path, "--json", "--topic", "*features").out)
    for kind in ("csv", "parquet", "npz"):
        outcome = log_tool("export", path, "--to", kind)
        assert outcome.code == int(cut), outcome.err  # messages were lost where it was cut off
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
    from tactile_core.bus.messages import MSG, codec, header
    from tactile_core.log.recorder import Recorder

    path = tmp_path / "run.mcap"
    recorder = Recorder(path, RecorderSettings(min_free_bytes=0))
    for i in range(3):
        force = np.arange(9, dtype=np.float32) / 10 + i
        force[4] = np.nan if i == 1 else force[4]
        message = MSG.TaxelForces(
            header(i, "ee"), i, i, 0.0, i, np.array([3], np.uint16), force[: 9 - 3 * (i == 2)],
            np.zeros(3, np.uint8), True, True, np.zeros(3, np.float32),
        )  # fmt: skip
        data = codec().encode(topics.FORCES, message)
        recorder.write(topics.FORCES, "b", data, 10**18 + i, 10**18 + i)
    assert recorder.close(60)
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


def test_exports_are_overwritten_only_on_request(
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
