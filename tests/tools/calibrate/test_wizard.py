"""The wizard on a simulated board, whose true force is known, on virtual time."""

from __future__ import annotations

import numpy as np
import pytest

from sim_device.board.catalogue import build_skin
from sim_device.skin.environment import Surroundings
from sim_device.skin.skin import Contact
from tactile_core.bus.messages import MSG, codec, header
from tactile_core.bus.topics import FIELD, REFERENCE
from tactile_core.calibration import nominal, saves
from tactile_core.log.recorder import Recorder
from tactile_core.types import NS_PER_S, Instant
from tactile_tools.calibrate.evaluate import predict
from tactile_tools.calibrate.fit import Choice, choose, fit
from tactile_tools.calibrate.log_recording import read_log
from tactile_tools.calibrate.recipes import FORCE_RECIPES
from tactile_tools.calibrate.wizard import (
    PRESSES,
    TareRefusedError,
    Timing,
    Wizard,
    WizardError,
    parse_force,
)
from tactile_tools.cli import main

RATE_HZ = 50
BEGIN_NS = 1_700_000_000 * NS_PER_S


class Bench:
    """A person at a simulated AnySkin board: answers the questions and does as asked."""

    def __init__(self, recorder: Recorder, presses: list[tuple[float, float, float]]) -> None:
        self.skin = build_skin("anyskin", 3)
        self.array = self.skin.geometry.arrays[0]
        self.calibration = nominal("anyskin", "bench", 5)
        self.recorder, self.presses = recorder, list(presses)
        self.load: tuple[float, float, float] | None = None
        self.now = 0
        self.rest = np.zeros((5, 3))
        self.truth: list[tuple[int, float]] = []
        self.said: list[str] = []
        self.field: list[np.ndarray] = []
        recorder.attach("board0.cal.toml", "application/toml", saves(self.calibration).encode())

    def _sample(self) -> tuple[int, np.ndarray]:
        self.now += NS_PER_S // RATE_HZ
        contacts = []
        if self.load is not None:
            u, v, force = self.load
            axes = self.array.rotation[0]
            place = self.array.position[0] + axes[:, :2] @ np.array([u, v]) / 1000
            contacts = [Contact(place, -force * axes[:, 2], 0.004)]
        reading = self.skin.sample(Instant(self.now), contacts, Surroundings())
        counts = reading.counts * self.skin.chips.lsb_ut
        yaw = self.array.chip_yaw
        x, y, z = counts.T
        return self.now, np.column_stack(
            [np.cos(yaw) * x - np.sin(yaw) * y, np.sin(yaw) * x + np.cos(yaw) * y, z]
        )

    def tare(self, force: bool = False) -> str:
        del force
        self.rest = np.mean([self._sample()[1] for _ in range(RATE_HZ)], axis=0)
        return "tared"

    def collect(self, seconds: float, least: int = 0) -> list[int]:
        del least
        stamps = []
        for _ in range(round(seconds * RATE_HZ)):
            at, field = self._sample()
            stamp = BEGIN_NS + at
            message = MSG.TaxelField(
                header=header(stamp, "ee"),
                captured_ns=at,
                received_ns=at,
                sequence=0,
                array_taxels=np.array([5], np.uint16),
                field_ut=(field - self.rest).astype(np.float32).ravel(),
                temperature_c=np.array([25.0], np.float32),
            )
            self.recorder.write(FIELD, "board0", codec().encode(FIELD, message), stamp, stamp)
            stamps.append(stamp)
        return stamps

    def label(self, stamps: list[int], force: float) -> None:
        for stamp in stamps:
            vector = MSG.Vector3(0.0, 0.0, -force)
            message = MSG.WrenchStamped(
                header=header(stamp, "ee"), wrench=MSG.Wrench(vector, MSG.Vector3(0.0, 0.0, 0.0))
            )
            self.recorder.write(
                REFERENCE, "board0", codec().encode(REFERENCE, message), stamp, stamp
            )

    def ask(self, question: str) -> str:
        if "Next press" in question:
            if not self.presses:
                return ""
            return f"{self.presses[0][2]}"
        if "hold it steady" in question:
            self.load = self.presses.pop(0)
            self.collect(0.5)
        if "Take it off" in question:
            self.load = None
            self.collect(0.5)
        return "y" if "[y/N]" in question else ""


def record(tmp_path, name, presses):
    recorder = Recorder(tmp_path / name)
    bench = Bench(recorder, presses)
    wizard = Wizard(bench, bench.label, bench.ask, bench.said.append, Timing(2.0, 1.0, 2.0))
    assert wizard.run() == len(presses)
    assert any("Enter again to end" in line for line in bench.said) == (len(presses) < PRESSES)
    assert recorder.close(60)
    assert not recorder.stats.dropped
    return read_log(tmp_path / name)


def some_presses(seed, count):
    rng = np.random.default_rng(seed)
    return [
        (float(u), float(v), float(f))
        for u, v, f in zip(
            rng.uniform(-4, 4, count),
            rng.uniform(-4, 4, count),
            np.tile([1.0, 3.0, 6.0, 8.0], count)[:count],
            strict=True,
        )
    ]


def test_wizard_recording_calibrates_the_simulated_board(tmp_path):
    recording = record(tmp_path, "rec.mcap", some_presses(0, 16))
    assert recording.targets == ("normal",)
    assert recording.serial_number == "bench"
    assert recording.labels.max() == pytest.approx(8.0)
    choice = choose([recording], FORCE_RECIPES[:2])
    model = fit([recording], choice)
    other = record(tmp_path, "other.mcap", some_presses(5, 8))  # its labels are the truth
    error = predict(model, other) - other.labels
    loaded = other.labels[:, 0] > 0
    assert np.sqrt((error[~loaded] ** 2).mean()) < 0.3
    assert np.sqrt((error[loaded] ** 2).mean()) < 0.9
    uncalibrated = fit([recording], Choice(FORCE_RECIPES[0], 1e9, 0.0, (), ()))
    assert np.sqrt((error**2).mean()) < 0.4 * np.std(predict(uncalibrated, other) - other.labels)


def test_recording_with_equal_stamps_is_read(tmp_path):
    recorder = Recorder(tmp_path / "rec.mcap")
    bench = Bench(recorder, some_presses(0, 15))
    sample = bench._sample

    def stalled():
        """Six frames in a hundred come in a burst, as older versions stamped them."""
        at, field = sample()
        late = at % (2 * NS_PER_S)
        return at - late if late < 0.12 * NS_PER_S else at, field

    bench._sample = stalled
    Wizard(bench, bench.label, bench.ask, bench.said.append, Timing(2.0, 1.0, 2.0)).run()
    assert recorder.close(60)
    recording = read_log(tmp_path / "rec.mcap")
    assert (np.diff(recording.time_s) > 0).all()
    assert (np.diff(recording.label_time_s) > 0).all()


class Silent:
    """A source without frames."""

    def tare(self, force=False):
        return "tared"

    def collect(self, seconds, least):
        return []


class Steady(Silent):
    """A source of twenty frames a second; each tare except a forced one may be refused."""

    def __init__(self, refusals=0):
        self.refusals = refusals
        self.forced = []

    def tare(self, force=False):
        self.forced.append(force)
        if self.refusals and not force:
            self.refusals -= 1
            raise TareRefusedError("tare refused: the field moved by 9 µT: keep the skin still")
        return "tared"

    def collect(self, seconds, least):
        return list(range(int(20 * seconds)))


class Dialogue:
    """Gives answers in order; keeps everything that was shown and labelled."""

    def __init__(self, *answers):
        self.answers, self.shown, self.labels = list(answers), [], []

    def ask(self, question):
        self.shown.append(question)
        return self.answers.pop(0)

    def run(self, source, width=80):
        def label(stamps, force):
            self.labels.append(force)

        presses = Wizard(source, label, self.ask, self.shown.append, Timing(), width).run()
        assert not self.answers
        return presses


def test_questions_repeat_until_answered_correctly():
    talk = Dialogue("", "heavy", "-3", "1e9", "nan", "200g", "", "", "", "", "n")
    assert talk.run(Steady()) == 1
    assert talk.labels == [0.0, pytest.approx(1.96133), 0.0]
    assert sum("is not a force" in line for line in talk.shown) == 4
    said: list[str] = []
    with pytest.raises(WizardError, match="only 0 frames"):
        Wizard(Silent(), lambda s, f: None, lambda q: "", said.append, Timing()).run()


def test_fifteen_presses_are_requested_and_counted():
    press = ["2", "", ""]
    talk = Dialogue("", *(press * PRESSES), "", "n")
    assert talk.run(Steady()) == PRESSES == 15
    asked = [line for line in talk.shown if "Next press" in line]
    assert "(1 of 15)" in asked[0]
    assert "(15 of 15)" in asked[-2]
    assert "(16)" in asked[-1]


def test_ending_early_needs_confirmation():
    talk = Dialogue("", "2", "", "", "", "3", "", "", "", "", "n")
    assert talk.run(Steady()) == 2
    assert sum("Enter again to end" in line for line in talk.shown) == 2


def test_last_press_can_be_undone():
    talk = Dialogue("", "u", "2", "", "", "5", "", "", "u", "undo", "3", "", "", "", "", "n")
    assert talk.run(Steady()) == 2
    assert talk.labels == [0.0, 2.0, 0.0, 3.0, 0.0]
    assert any("press of 5 N is undone" in line for line in talk.shown)
    assert sum("nothing to undo" in line for line in talk.shown) == 2


def test_refused_tare_is_retried_or_forced():
    source = Steady(refusals=2)
    assert Dialogue("", "", "f", "2", "", "", "", "", "n").run(source) == 1
    assert source.forced == [False, False, True]


@pytest.mark.parametrize("width", [40, 80])
def test_lines_fit_the_terminal_without_cutting_words(width):
    talk = Dialogue("", "f", "x" * 15, "2", "", "", "", "", "y", "")
    talk.run(Steady(refusals=1), width)
    whole = Dialogue("", "f", "x" * 15, "2", "", "", "", "", "y", "")
    whole.run(Steady(refusals=1), 1000)
    for text in talk.shown:
        assert max(len(line) for line in text.split("\n")) <= width
    assert " ".join(talk.shown).split() == " ".join(whole.shown).split()


@pytest.mark.parametrize(
    ("text", "newton"),
    [("3.2", 3.2), ("3,2 N", 3.2), ("1kg", 9.80665), ("500 g", 4.903325), ("0", None), ("x", None)],
)
def test_forces_are_parsed_as_people_write_them(text, newton):
    assert parse_force(text) == (None if newton is None else pytest.approx(newton))


def test_pointless_recording_is_refused(capsys, tmp_path):
    there = tmp_path / "there.mcap"
    there.write_bytes(b"")
    for out, words in ((there, "is there already"), (tmp_path / "x.log", "ends in .mcap")):
        assert main(["calibrate", "record", "--out", str(out)]) == 2
        assert words in capsys.readouterr().err
    words = ["calibrate", "record", "--out", str(tmp_path / "x.mcap"), "--port", "/dev/none"]
    assert main(words) == 3
    assert "/dev/none" in capsys.readouterr().err
