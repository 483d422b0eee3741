"""A board calibrated as its owner would: real processes, and a person who does what is asked."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from tactile_core.bus.messages import MSG, codec, header
from tactile_core.bus.services import call
from tactile_core.bus.session import BusConfig, close_session, open_session
from tactile_core.bus.streams import Latest, latest
from tactile_core.bus.topics import FEATURES, FIELD, REFERENCE, service_key
from tactile_core.calibration import nominal, saves
from tactile_core.calibration.file import SUFFIX
from tactile_core.log.recorder import Recorder, RecorderSettings
from tactile_tools.calibrate.log_recording import read_log
from tactile_tools.processes import running
from tests.support.network import free_port
from tests.support.own_board import OwnBoard
from tests.support.processes import command
from tests.support.waiting import PATIENCE_S

FORCE_N = 4.0

CALIBRATE = (sys.executable, "-m", "tactile_tools.cli", "calibrate")


class Person:
    """Presses the board, and sees in the features that it feels it."""

    def __init__(self, board: OwnBoard, features: Latest) -> None:
        self._board, self._features = board, features

    def force(self) -> float:
        sample = self._features.wait(PATIENCE_S)
        assert sample is not None, "no features came"
        return float(codec().decode(FEATURES, sample.data).normal_force)

    def press(self, normal_n: float) -> None:
        """Until the skin has felt it, or that it went, for a while."""
        self._board.press(normal_n)
        deadline, steady = time.monotonic() + PATIENCE_S, 0
        while steady < 30:
            steady = steady + 1 if (self.force() > 0.5) is (normal_n > 0.5) else 0
            assert time.monotonic() < deadline, f"{normal_n} N was not felt"


@contextmanager
def served(folder: Path, *words: str) -> Iterator[tuple[str, Person]]:
    """The board and a tactiled on it, its endpoint, and a person who presses it."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    board = OwnBoard(folder / "skin")
    daemon = [command("tactiled"), "--port", str(folder / "skin"), "--kind", "anyskin", "--no-log"]
    try:
        with running([*daemon, "--listen", endpoint, *words], folder / "tactiled"):
            session = open_session(BusConfig(role="tool", connect=(endpoint,)))
            try:
                person = Person(board, latest(session, FEATURES.key("board0")))
                person.force()
                call(session, service_key("board0", "tare"), timeout=PATIENCE_S)
                yield endpoint, person
            finally:
                close_session(session)
    finally:
        board.close()


def prompt(process: subprocess.Popen[str]) -> str:
    """The next question; "" when there is none."""
    assert process.stdout is not None
    text = ""
    while not text.endswith(("tare: ", "end: ", "1kg): ", "Enter: ", "[y/N] ")):
        letter = process.stdout.read(1)
        if not letter:
            return ""
        text += letter
    return " ".join(text.split())


def test_repeated_stamps_do_not_spoil_a_recording(tmp_path: Path) -> None:
    """Stamps repeat while the estimate of a board's clock is set back, as on a busy machine."""
    path, begin = tmp_path / "rec.mcap", 1_700_000_000 * 10**9
    recorder = Recorder(path, RecorderSettings(min_free_bytes=0))
    recorder.attach(f"skin{SUFFIX}", "application/toml", saves(nominal("anyskin", "s", 5)).encode())
    zero = MSG.Vector3(0.0, 0.0, 0.0)
    stamps = [begin + 10_000_000 * (i - (i % 50 == 7)) for i in range(400)]
    for number, stamp in enumerate(stamps):
        field = MSG.TaxelField(
            header=header(stamp, "ee"), captured_ns=stamp, received_ns=stamp, sequence=number,
            array_taxels=np.array([5], np.uint16), field_ut=np.zeros(15, np.float32),
            temperature_c=np.zeros(1, np.float32),
        )  # fmt: skip
        force = MSG.Vector3(0.0, 0.0, -float(max(0, number - 150) % 40))
        reading = MSG.WrenchStamped(header(stamp, "ee"), MSG.Wrench(force, zero))
        for topic, message in ((FIELD, field), (REFERENCE, reading)):
            recorder.write(topic, "skin", codec().encode(topic, message), stamp, stamp)
    assert recorder.close(60)
    recording = read_log(path)
    assert len(recording.time_s) == len(recording.labels) == len(set(stamps)) == 392
    assert (np.diff(recording.time_s) > 0).all()


def test_user_records_fits_and_reads_the_true_force(tmp_path: Path) -> None:
    with served(tmp_path) as (endpoint, person):
        words = ["record", "--out", str(tmp_path / "rec.mcap"), "--connect", endpoint]
        process = subprocess.Popen(
            [*CALIBRATE, *words, "--rest", "2.5", "--hold", "2.0"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        assert process.stdin is not None
        forces = [f"{FORCE_N}", f"{FORCE_N / 9.80665 * 1000:.1f} g", "4N", "", ""]
        while asked := prompt(process):
            answer = ""
            if "Next press" in asked:
                answer = forces.pop(0)
            elif "Take it off" in asked:
                person.press(0.0)
            elif "hold it steady" in asked:
                assert "Put 4 N" in asked
                person.press(FORCE_N)
            process.stdin.write(answer + "\n")
            process.stdin.flush()
        assert process.wait(PATIENCE_S) == 0
    fitted = subprocess.run(
        [*CALIBRATE, "fit", str(tmp_path / "rec.mcap"), "--out", str(tmp_path / "skin.cal.toml")],
        capture_output=True,
        text=True,
        timeout=2 * PATIENCE_S,
        check=False,
    )
    assert fitted.returncode == 0, fitted.stderr
    with served(tmp_path, "--calibration", str(tmp_path / "skin.cal.toml")) as (_, person):
        person.press(FORCE_N)
        felt = float(np.median([person.force() for _ in range(50)]))
    assert felt == pytest.approx(FORCE_N, abs=0.5)
