"""Recordings are read exactly, refused with the reason, and played at their pace."""

from __future__ import annotations

import csv
import gzip
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from sensor_proto.anyskin import AnySkinDecoder
from sensor_proto.packets import FloatSamples
from sim_device.board.recorded import PROBE_FRAME, TEMPERATURE_C, RecordingError, ReplayBoard, load
from tactile_core.types import Instant, after
from tactiled.transports import PortGone
from tactiled.transports.serial_port import SerialTransport
from tests.support.paths import DATA

NORMAL = [
    DATA / "eflesh" / f"normal_force_20250401_{name}/sensor.csv.gz" for name in ("014340", "015037")
]
ROW = "1.0,1,2,3,4,5,6"


def write(path: Path, *rows: str) -> Path:
    path.write_text("\n".join(rows) + "\n")
    return path


def read_to_the_end(host: SerialTransport) -> bytes:
    data = b""
    try:
        while True:
            chunk = host.read(60)
            assert chunk is not None
            assert isinstance(chunk.payload, bytes)
            data += chunk.payload
    except PortGone:
        return data


def decoded(data: bytes) -> list[FloatSamples]:
    return [r.message for r in AnySkinDecoder().feed(data) if isinstance(r.message, FloatSamples)]


def test_a_recording_is_read_as_written(tmp_path: Path) -> None:
    path = write(tmp_path / "r.csv", "100.5,1,2,3,4,5,6", "100.75,-1,-2,-3,1e3,0.5,7", "")
    recording = load(path)
    assert recording.seconds.tolist() == [0.0, 0.25]
    assert recording.field_ut.tolist() == [
        [[1, 2, 3], [4, 5, 6]],
        [[-1, -2, -3], [1000, 0.5, 7]],
    ]
    packed = tmp_path / "named.otherwise"
    packed.write_bytes(gzip.compress(path.read_bytes()))
    assert np.array_equal(load(packed).field_ut, recording.field_ut)
    headed = write(tmp_path / "h.csv", "time,x1,y1,z1", "0,1,2,3")
    assert load(headed).field_ut.shape == (1, 1, 3)


@pytest.mark.parametrize(
    ("rows", "line", "said"),
    [
        (["1,2,3"], 1, "3 columns given; allowed: time in s, then x, y, z"),
        (["1"], 1, "1 columns given"),
        (["1" + ",0" * 63], 1, "64 columns given"),
        ([ROW, "2,1,2,3"], 2, "4 columns given; allowed: 7"),
        ([ROW, "2,1,2,x,4,5,6"], 2, "column 4: 'x' given; allowed: a finite number"),
        ([ROW, "2,1,2,,4,5,6"], 2, "column 4: '' given"),
        ([ROW, "2,1,nan,3,4,5,6"], 2, "column 3: 'nan' given"),
        ([ROW, "inf,1,2,3,4,5,6"], 2, "column 1: 'inf' given"),
        ([ROW, "2,1,2,3,4,5,2e6"], 2, "2e6 µT given"),
        ([ROW, ROW, "0.5,1,2,3,4,5,6"], 3, "earlier than the row above"),
        (["t,x,y,z", "t,x,y,z"], 2, "column 1: 't' given"),
    ],
)
def test_invalid_recording_is_refused_with_file_and_line(
    tmp_path: Path, rows: list[str], line: int, said: str
) -> None:
    path = write(tmp_path / "r.csv", *rows)
    with pytest.raises(RecordingError) as caught:
        load(path)
    assert str(caught.value).startswith(f"{path}:{line}: ")
    assert said in str(caught.value)
    assert "allowed" in str(caught.value)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", "no rows"),
        (b"\n\n", "no rows"),
        (b"\xff\xfe\x00\x81", "not text"),
        (gzip.compress(b"1,2,3,4\n", mtime=0)[:-6], "broken gzip"),
        (b"\x1f\x8brubbish", "broken gzip"),
        (b"1,2,\x00,4\n", "allowed"),
    ],
)
def test_files_of_another_kind_are_refused(tmp_path: Path, content: bytes, said: str) -> None:
    path = tmp_path / "r.csv"
    path.write_bytes(content)
    with pytest.raises(RecordingError, match=said):
        load(path)


def test_rows_are_sent_when_they_are_due(tmp_path: Path) -> None:
    path = write(tmp_path / "r.csv", "5,1,2,3", "5.1,4,5,6", "5.1,7,8,9", "6,10,11,12")
    board = ReplayBoard(load(path), speed=2)
    start = Instant(10**12)
    assert board.tick(start) == PROBE_FRAME
    assert board.tick(start) == b""
    board.start(start)
    sizes = [len(board.tick(after(start, s))) // 18 for s in (0, 0.049, 0.0501, 0.4, 0.51, 9)]
    assert sizes == [1, 0, 2, 0, 1, 0]
    assert board.finished
    assert board.sent == 4


def test_looped_recording_continues_one_period_after_its_end(tmp_path: Path) -> None:
    path = write(tmp_path / "r.csv", "0,1,2,3", "0.1,4,5,6", "0.2,7,8,9")
    board = ReplayBoard(load(path), loop=True)
    board.tick(Instant(0))
    board.start(Instant(0))
    sent = b"".join(board.tick(after(Instant(0), k * 0.05)) for k in range(41))  # 2 s
    assert len(sent) == 21 * 18
    assert not board.finished


def test_postponed_recording_keeps_its_spacing(tmp_path: Path) -> None:
    board = ReplayBoard(load(write(tmp_path / "r.csv", "0,1,2,3", "0.1,4,5,6")))
    board.start(Instant(0))
    board.tick(Instant(0))
    board.postpone(5)
    assert board.tick(after(Instant(0), 5)) == b""
    assert len(board.tick(after(Instant(0), 5.11))) == 18


@pytest.mark.parametrize("magnetometers", [5, 10])
def test_real_recordings_decode_to_their_original_values(
    magnetometers: int, tmp_path: Path
) -> None:
    """With ten chips: two recordings side by side."""
    tables = []
    for name in NORMAL:
        with gzip.open(name, "rt") as file:
            tables.append(np.array([[float(c) for c in row] for row in csv.reader(file)]))
    path, table = NORMAL[0], tables[0]
    if magnetometers == 10:
        table = np.hstack([tables[0], tables[1][:, 1:]])
        path = write(tmp_path / "ten.csv", *(",".join(map(str, row)) for row in table.tolist()))
    recording = load(path)
    assert recording.magnetometers == magnetometers
    board = ReplayBoard(recording)
    out = [board.tick(Instant(0))]
    board.start(Instant(0))
    while not board.finished:
        out.append(board.tick(Instant(10**15)))
    samples = decoded(b"".join(out))
    assert len(samples) == len(table)
    got = np.array([s.field_ut for s in samples]).reshape(len(table), -1)
    assert np.array_equal(got, table[:, 1:].astype(np.float32))
    assert {float(t) for s in samples for t in s.temperature_c} == {TEMPERATURE_C}


def test_recording_passes_completely_through_simdevice_and_pty(tmp_path: Path) -> None:
    path = NORMAL[0]
    link = tmp_path / "skin0"
    process = subprocess.Popen(
        [sys.executable, "-m", "sim_device", "replay", str(path), "--as", "anyskin",
         "--pty", str(link), "--speed", "1000"],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert process.stdout is not None
    said = process.stdout.readline()
    assert f"tactiled --port {link} --kind anyskin" in said
    host = SerialTransport(str(link))
    host.open()
    data = read_to_the_end(host)
    host.close()
    _, errors = process.communicate(timeout=120)
    assert process.returncode == 0, errors
    assert not os.path.lexists(link)
    samples = decoded(data)
    expected = load(path).field_ut
    assert np.array_equal(np.array([s.field_ut for s in samples]), expected)
